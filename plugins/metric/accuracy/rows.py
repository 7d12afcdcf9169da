"""Rows of the contract: two classes and several."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "accuracy": (
        MetricRow("two classes", Target("class", ("off", "on"))),
        MetricRow("five classes", Target("class", ("a", "b", "c", "d", "e"))),
    )
}
