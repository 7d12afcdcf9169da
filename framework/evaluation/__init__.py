"""Metrics over splits, the cost of a prediction, and error against run time."""
