"""Networks that read point sets: PointNet and DeepSets."""
