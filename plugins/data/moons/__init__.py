"""Two interleaved half circles with overlapping noise, and points far from both, as data sets."""
