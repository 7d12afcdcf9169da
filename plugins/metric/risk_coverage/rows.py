"""Contract-test cases: classes, real numbers and angles, with both confidences."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "risk_coverage": (
        MetricRow("two classes", Target("class", ("off", "on"))),
        MetricRow("five classes, mode", Target("class", ("a", "b", "c", "d", "e")), {"confidence": "mode"}),
        MetricRow("two reals", Target("real", ("x", "y"))),
        MetricRow("one angle", Target("angle", ("azimuth",))),
        MetricRow(
            "three angles, mode", Target("angle", ("azimuth", "elevation", "tilt")), {"confidence": "mode"}
        ),
    )
}
