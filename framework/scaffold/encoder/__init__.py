"""Example of an encoder."""
