"""Exponents of the powers of two by which coordinates are scaled."""

import torch

MOST = {torch.float32: 126, torch.float64: 1000}
"""Largest exponent of two, by dtype, for which the power and its inverse are finite."""
