"""Contract-test cases: none of their densities has prediction sets, so that most checks are left out.

test_prediction_set_metric.py runs these checks with densities that have prediction sets.
"""

from framework.target import Target
from framework.testing.rows import ANGLE, CLASSES, MetricRow

NO_SET = "the densities of the contract tests have no prediction sets; the metric's own test runs this check on sets"
CHECKS = (
    "named numbers",
    "remarks are sentences",
    "batches do not matter",
    "order does not matter",
    "states merge",
    "reset and copy",
    "computing changes nothing",
    "predictions are left as they are",
    "perfect beats random",
    "standard errors",
    "turns do not matter",
    "unit",
    "NaN is not hidden",
)
ROWS = {
    "prediction_set": tuple(
        MetricRow(name, target, leave_out=dict.fromkeys(CHECKS, NO_SET))
        for name, target in {
            "classes": CLASSES,
            "one angle": ANGLE,
            "one real": Target("real", ("height",)),
        }.items()
    )
}
