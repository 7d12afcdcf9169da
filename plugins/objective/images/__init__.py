"""Losses of predicted images beside the distance of their numbers: features of networks, and discriminators."""
