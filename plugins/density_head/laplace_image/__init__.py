"""Densities over images: a colour for each pixel, and how far off it may be."""
