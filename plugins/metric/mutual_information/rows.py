"""Contract-test cases: classes, real numbers and angles."""

from framework.testing.rows import ANGLE, CLASSES, REALS, MetricRow

ROWS = {
    "mutual_information": (
        MetricRow("classes", CLASSES),
        MetricRow("reals", REALS),
        MetricRow("an angle", ANGLE),
    )
}
