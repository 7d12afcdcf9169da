"""How far predicted vertices are from the true ones, and correspondences through them from where they should be."""
