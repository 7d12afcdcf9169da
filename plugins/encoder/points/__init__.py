"""An encoder that chooses a fixed number of points of each cloud."""
