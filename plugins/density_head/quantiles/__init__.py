"""Densities given by quantiles, and their head."""
