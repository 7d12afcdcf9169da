"""Point clouds on grids: occupancy, truncated distance fields, and convolutions over grids."""
