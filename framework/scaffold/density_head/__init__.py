"""Example of a density head."""
