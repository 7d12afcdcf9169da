"""Distances between predicted and true vertices, and errors of the matches between scans that predicted meshes give."""
