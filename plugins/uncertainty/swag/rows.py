"""Contract-test cases: one for each kind of target. No epoch is collected here; test_swag.py collects some first."""

from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

ROWS = {
    "swag": (
        WrapperRow("classes", CLASSES, identity={}),
        WrapperRow("one angle", ANGLE, {"samples": 5}, identity={}),
        WrapperRow("two reals", REALS, {"samples": 3, "rank": 0, "start": 0.0}, identity={}),
    )
}
