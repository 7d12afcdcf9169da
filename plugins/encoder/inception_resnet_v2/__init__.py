"""Inception-ResNet-v2, for large images, from a weight file or from scratch."""
