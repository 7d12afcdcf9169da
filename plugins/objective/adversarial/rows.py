"""Contract-test cases: adversarial training, for each kind of target."""

from framework.target import Target
from framework.testing.rows import CLASSES, REALS, ObjectiveRow

ANGLES = Target("angle", ("azimuth", "elevation"))
JOINT = {"different members train separately": "x' follows the gradient of the joint loss of all members"}

ROWS = {
    "adversarial": (
        ObjectiveRow("classes", CLASSES, leave_out=JOINT),
        ObjectiveRow("angles", ANGLES, leave_out=JOINT),
        ObjectiveRow("reals", REALS, leave_out=JOINT),
        ObjectiveRow("far", CLASSES, {"epsilon": 10.0, "weight": 0.5}, leave_out=JOINT),
    )
}
