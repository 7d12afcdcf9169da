"""Rows of the contract: scans of three people."""

import torch

from framework.target import Target
from framework.testing.rows import MetricRow

NAMES = tuple(f"{axis}{vertex}" for vertex in range(5) for axis in "xyz")
FIELDS = {
    "centre": lambda count: torch.arange(3.0 * count).reshape(count, 3) / 10,
    "scale": lambda count: torch.linspace(0.5, 1.5, count),
    "subject": lambda count: torch.arange(count) % 3,
}
ROWS = {"correspondence": (MetricRow("five vertices", Target("real", NAMES), fields=FIELDS),)}
