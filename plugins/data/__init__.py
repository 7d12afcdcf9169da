"""Data sets, one folder for each or for a family that shares code."""
