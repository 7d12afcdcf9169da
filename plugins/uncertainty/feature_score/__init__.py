"""Outlier scores from the features in front of the final layer: distances to the training data, and energy."""
