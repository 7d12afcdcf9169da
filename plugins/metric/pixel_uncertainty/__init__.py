"""Whether predicted images say how far off each pixel may be."""
