"""Networks that read point sets: PointNet, PointNet++, DeepSets and DGCNN."""
