"""The matrix Fisher density of rotations: azimuth, elevation and tilt jointly (thesis §3.7)."""
