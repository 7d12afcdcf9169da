"""A user's own meshes and point clouds in folders named by class."""
