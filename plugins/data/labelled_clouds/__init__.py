"""Data sets of point clouds with classes: ModelNet40, DALES and a user's own folders."""
