"""Densities over images: a colour for each pixel, and the scale of its error."""
