"""Rows of the contract: one temperature for every kind of target."""

from framework.target import Target
from framework.testing.rows import WrapperRow

ROWS = {
    "temperature": (
        WrapperRow("classes", Target("class", ("a", "b", "c")), identity={}),
        WrapperRow("one angle", Target("angle", ("azimuth",)), identity={}),
        WrapperRow("two reals", Target("real", ("x", "y")), identity={}),
        WrapperRow("never sharper", Target("real", ("height",)), {"lower": 1.0}, identity={"upper": 1.0}),
    )
}
