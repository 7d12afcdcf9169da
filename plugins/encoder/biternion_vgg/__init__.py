"""The six-convolution network of Biternion nets, for small images."""
