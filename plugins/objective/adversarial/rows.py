"""Rows of the contract: adversarial training, for each kind of target."""

from framework.target import Target
from framework.testing.rows import ObjectiveRow

CLASSES = Target("class", ("a", "b", "c"))
ANGLES = Target("angle", ("azimuth", "elevation"))
REALS = Target("real", ("x", "y"))

ROWS = {
    "adversarial": (
        ObjectiveRow("classes", CLASSES),
        ObjectiveRow("angles", ANGLES),
        ObjectiveRow("reals", REALS),
        ObjectiveRow("far", CLASSES, {"epsilon": 10.0, "weight": 0.5}),
    )
}
