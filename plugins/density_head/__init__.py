"""Density heads."""
