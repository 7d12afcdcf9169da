"""Coloured points as an image: the nearest point of each pixel, and the surface between points."""
