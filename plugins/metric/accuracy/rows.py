"""Contract-test cases: targets of two and of five classes."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "accuracy": (
        MetricRow("two classes", Target("class", ("off", "on"))),
        MetricRow("five classes", Target("class", ("a", "b", "c", "d", "e"))),
    )
}
