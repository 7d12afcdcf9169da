"""Mutual information of target and model: the part of the entropy that more training data would remove."""
