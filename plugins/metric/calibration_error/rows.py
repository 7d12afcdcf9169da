"""Contract-test cases: confidence in the predicted class, and in the positive class."""

from framework.target import Target
from framework.testing.rows import MetricRow

TWO = Target("class", ("off", "on"))

OF_SHARES = {
    "perfect beats random": "a single bin of p(y = 1) compares only class frequencies, which both predictions have "
    "right"
}
ROWS = {
    "calibration_error": (
        MetricRow("five classes", Target("class", ("a", "b", "c", "d", "e"))),
        MetricRow("two classes, four bins", TWO, {"bins": 4}),
        MetricRow("positive class", TWO, {"probability": "positive"}),
        MetricRow("one bin", TWO, {"bins": 1}, leave_out=OF_SHARES),
    )
}
