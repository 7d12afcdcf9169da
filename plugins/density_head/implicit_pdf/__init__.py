"""Density of rotations from a network that reads features and a rotation, normalised on a grid (Murphy et al. 2021)."""
