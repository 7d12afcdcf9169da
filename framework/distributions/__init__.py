"""Densities that no method owns, and everything that a density may be asked."""
