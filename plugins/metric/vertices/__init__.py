"""Distances of predicted vertices from the true ones, and errors of the correspondences that predicted meshes give."""
