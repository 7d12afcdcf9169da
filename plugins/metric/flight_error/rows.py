"""Rows of the contract: positions of a ball at the next two frames."""

from collections.abc import Mapping

from framework.testing.flights import TWO_FRAMES
from framework.testing.rows import MetricRow

DRAWN: Mapping[str, str] = dict.fromkeys(
    ("batches do not matter", "order does not matter", "states merge", "reset and copy"),
    "which flights are drawn depends on what was drawn before",
)
ROWS = {"flight_error": (MetricRow("two frames", TWO_FRAMES, {"height": 0.0}, leave_out=DRAWN),)}
