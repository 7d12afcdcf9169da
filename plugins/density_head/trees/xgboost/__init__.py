"""Gradient-boosted trees as a density head."""
