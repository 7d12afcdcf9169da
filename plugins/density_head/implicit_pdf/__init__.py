"""Density of rotations by a network of features and rotation, normalised on a grid (Murphy et al. 2021)."""
