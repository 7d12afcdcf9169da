"""Behaviour of a model on outliers, which belong to none of its training classes."""
