"""Networks that read point sets: PointNet, PointNet++ and DeepSets."""
