"""Angular deviation of the point prediction, its mean and its median."""
