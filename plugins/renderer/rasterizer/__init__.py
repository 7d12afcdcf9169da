"""Triangle meshes drawn on one CPU core."""
