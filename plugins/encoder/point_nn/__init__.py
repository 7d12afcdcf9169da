"""Point-NN: an encoder of clouds that has no parameters."""
