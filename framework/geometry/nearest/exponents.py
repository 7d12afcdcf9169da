"""Exponents of the powers of two that coordinates are scaled by."""

import torch

MOST = {torch.float32: 126, torch.float64: 1000}
"""Exponents of two up to which a power is finite, and its inverse too, by type of number."""
