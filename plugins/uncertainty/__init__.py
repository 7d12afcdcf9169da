"""Uncertainty wrappers."""
