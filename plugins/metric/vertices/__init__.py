"""Distances between predicted and true vertices, and errors of correspondences through predicted meshes."""
