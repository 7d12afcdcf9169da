"""Contract rows: targets with which `mode=check` tests the plugin."""

from framework.target import Target
from framework.testing.rows import ObjectiveRow

NOISE = {"order does not matter": "every input gets its own noise"}
ROWS = {
    "example": (
        ObjectiveRow("classes", Target("class", ("a", "b", "c")), leave_out=NOISE),
        ObjectiveRow("an angle", Target("angle", ("azimuth",)), leave_out=NOISE),
        ObjectiveRow("two numbers", Target("real", ("x", "y")), {"deviation": 1.0}, leave_out=NOISE),
    )
}
