"""Contract-test cases: one for each kind of target. No epoch is collected here; test_swag.py collects some first."""

from framework.target import Target
from framework.testing.rows import WrapperRow

CLASSES, ANGLE, REALS = (
    Target("class", ("a", "b", "c")),
    Target("angle", ("azimuth",)),
    Target("real", ("x", "y")),
)
ROWS = {
    "swag": (
        WrapperRow("classes", CLASSES, identity={}),
        WrapperRow("one angle", ANGLE, {"samples": 5}, identity={}),
        WrapperRow("two reals", REALS, {"samples": 3, "rank": 0, "start": 0.0}, identity={}),
    )
}
