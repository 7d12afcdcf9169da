"""Data sets, a folder for each or for a family that shares code."""
