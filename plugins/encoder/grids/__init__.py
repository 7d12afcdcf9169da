"""Point clouds on grids: which cells they occupy, how far they are from each, and convolutions over grids."""
