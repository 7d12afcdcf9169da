"""Densities over black and white images: how likely each pixel is white."""
