"""Example of an uncertainty wrapper."""
