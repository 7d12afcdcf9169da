"""Convolutions over grids of numbers in space."""
