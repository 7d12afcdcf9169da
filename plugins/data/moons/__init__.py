"""Data sets of points in the plane: two interleaved half circles with overlapping noise, and outliers far from both."""
