"""Example of a data set."""
