"""Example of a renderer."""
