"""Continuous ranked probability score."""
