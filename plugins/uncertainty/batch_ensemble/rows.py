"""Contract-test cases: one for each kind of target."""

from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

ROWS = {
    "batch_ensemble": (
        WrapperRow("classes", CLASSES, identity={"members": 1}),
        WrapperRow("one angle", ANGLE, {"members": 3}, identity={"members": 1}),
        WrapperRow("two reals", REALS, {"members": 4, "spread": 0.1}, identity={"members": 1}),
    )
}
