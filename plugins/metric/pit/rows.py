"""Contract-test cases: targets of one and of several real numbers and angles."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "pit": (
        MetricRow("one real", Target("real", ("height",))),
        MetricRow("two reals", Target("real", ("x", "y"))),
        MetricRow("one angle", Target("angle", ("azimuth",)), {"bins": 5}),
        MetricRow("three angles", Target("angle", ("azimuth", "elevation", "tilt"))),
    )
}
