"""Densities over black and white images, with the probability of each pixel to be white."""
