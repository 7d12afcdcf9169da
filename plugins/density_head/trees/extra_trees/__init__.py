"""Extremely randomised trees as a density head."""
