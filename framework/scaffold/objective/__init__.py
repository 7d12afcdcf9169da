"""Example of an objective."""
