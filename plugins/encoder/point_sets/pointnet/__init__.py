"""PointNet: one network for every point, and the largest number over the cloud."""
