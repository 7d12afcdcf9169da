"""Skinned models of the human body: their files, meshes, poses and motions, and the default body."""
