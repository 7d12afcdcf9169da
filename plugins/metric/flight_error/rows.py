"""Contract-test cases: positions of a ball at the next two frames."""

from collections.abc import Mapping

from framework.testing.flights import TWO_FRAMES
from framework.testing.rows import MetricRow

RANDOM_DRAWS: Mapping[str, str] = dict.fromkeys(
    ("batches do not matter", "order does not matter", "states merge", "reset and copy"),
    "the sampled flights depend on earlier random numbers",
)
ROWS = {"flight_error": (MetricRow("two frames", TWO_FRAMES, {"height": 0.0}, leave_out=RANDOM_DRAWS),)}
