"""Residual networks for images: 18 to 101 layers, from random weights or from a local weight file."""
