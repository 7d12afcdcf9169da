"""Rotations, cameras, meshes and point clouds."""
