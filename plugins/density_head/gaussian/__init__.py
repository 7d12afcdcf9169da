"""The Gaussian density of real numbers, and its head."""
