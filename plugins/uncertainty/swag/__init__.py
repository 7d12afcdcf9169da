"""SWA-Gaussian: a Gaussian over the weights of the last epochs of training."""
