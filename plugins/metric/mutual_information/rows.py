"""Contract-test cases: classes, real numbers and angles."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "mutual_information": (
        MetricRow("classes", Target("class", ("a", "b", "c"))),
        MetricRow("reals", Target("real", ("x", "y"))),
        MetricRow("an angle", Target("angle", ("azimuth",))),
    )
}
