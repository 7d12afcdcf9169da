"""Contract-test cases: targets of one and of three real numbers."""

from framework.target import Target
from framework.testing.rows import MetricRow

REALS = (
    MetricRow("one real", Target("real", ("height",))),
    MetricRow("three reals", Target("real", ("x", "y", "z"))),
)
ROWS = {"mae": REALS, "rmse": REALS}
