"""Rows of the contract: ensembles over every kind of target."""

from framework.target import Target
from framework.testing.rows import WrapperRow

ROWS = {
    "ensemble": (
        WrapperRow("classes", Target("class", ("a", "b", "c")), identity={"members": 1}),
        WrapperRow("one angle", Target("angle", ("azimuth",)), identity={"members": 1}),
        WrapperRow("two reals", Target("real", ("x", "y")), {"members": 3}, identity={"members": 1}),
    )
}
