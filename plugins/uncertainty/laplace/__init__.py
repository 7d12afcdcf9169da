"""The last-layer Laplace approximation: a Gaussian posterior of the weights of the final linear layer."""
