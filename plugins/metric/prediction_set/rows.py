"""Rows of the contract.

The contract's densities have no sets: test_prediction_set_metric.py runs the checks that need them, on sets.
"""

from framework.target import Target
from framework.testing.rows import MetricRow

NO_SET = "it judges sets, which the contract's densities have none of; its own test runs this check on sets"
CHECKS = (
    "named numbers",
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
            "classes": Target("class", ("a", "b", "c")),
            "one angle": Target("angle", ("azimuth",)),
            "one real": Target("real", ("height",)),
        }.items()
    )
}
