"""Contract-test cases: targets of one and of several real numbers and angles."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "crps": (
        MetricRow("one real", Target("real", ("height",))),
        MetricRow("three reals", Target("real", ("x", "y", "z"))),
        MetricRow("one angle", Target("angle", ("azimuth",))),
        MetricRow("three angles", Target("angle", ("azimuth", "elevation", "tilt"))),
    )
}
