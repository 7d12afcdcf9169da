"""Example of a metric."""
