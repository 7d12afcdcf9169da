"""Rows of the contract: observed frames of thrown balls."""

from framework.testing.flights import thrown
from framework.testing.rows import EncoderRow

ROWS = {
    name: (EncoderRow("a thrown ball", (30,), {"future": 3}, inputs=thrown),)
    for name in ("ballistic", "extrapolation")
}
