"""Contract rows: targets and parameters with which `mode=check` tests the plugin."""

from framework.target import Target
from framework.testing.rows import WrapperRow

ROWS = {
    "example": (
        WrapperRow("one angle", Target("angle", ("azimuth",)), identity={"members": 1}),
        WrapperRow("two numbers", Target("real", ("x", "y")), {"members": 2}, identity={"members": 1}),
        WrapperRow("classes", Target("class", ("a", "b", "c")), identity={"members": 1}),
    )
}
