"""Contract-test cases: one for each kind of target."""

from framework.target import Target
from framework.testing.rows import WrapperRow

CLASSES, ANGLE, REALS = (
    Target("class", ("a", "b", "c")),
    Target("angle", ("azimuth",)),
    Target("real", ("x", "y")),
)
ROWS = {
    "batch_ensemble": (
        WrapperRow("classes", CLASSES, identity={"members": 1}),
        WrapperRow("one angle", ANGLE, {"members": 3}, identity={"members": 1}),
        WrapperRow("two reals", REALS, {"members": 4, "spread": 0.1}, identity={"members": 1}),
    )
}
