"""Point clouds on grids: occupancy, truncated distances, and a 3D network."""
