"""Metrics over splits, what a prediction costs, and error against run time."""
