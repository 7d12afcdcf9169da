"""Losses of predicted images other than the distance of their numbers: network features and discriminators."""
