"""Contract-test cases: eq. 2.26 for two classes, Brier's own sum for more classes."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "brier": (
        MetricRow("two classes", Target("class", ("off", "on"))),
        MetricRow("five classes", Target("class", ("a", "b", "c", "d", "e"))),
    )
}
