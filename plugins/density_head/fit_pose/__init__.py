"""Density of a body's pose, which is fitted to an image by gradient descent through a renderer."""
