"""Contract-test cases: outlier exposure, for each kind of target and divergence."""

from framework.target import Target
from framework.testing.rows import ANGLE, CLASSES, REALS, ObjectiveRow

ANGLES = Target("angle", ("azimuth", "elevation"))
BOX = {"low": -4.0, "high": 4.0}  # the range of the thesis's toy data

ROWS = {
    "outlier_exposure": (
        ObjectiveRow("classes", CLASSES, BOX),
        ObjectiveRow("classes, cross-entropy", CLASSES, {**BOX, "divergence": "cross_entropy"}),
        ObjectiveRow("seven outliers", CLASSES, {**BOX, "count": 7, "weight": 0.3}),
        ObjectiveRow("one angle", ANGLE, BOX),
        ObjectiveRow("two angles", ANGLES, BOX),
        ObjectiveRow("reals", REALS, {**BOX, "prior_scale": 5.0}),
    )
}
