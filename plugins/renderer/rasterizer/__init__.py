"""A renderer that draws triangle meshes on one CPU core."""
