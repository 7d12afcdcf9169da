"""Probability integral transform."""
