"""Contract-test cases: temperatures for every kind of target, and Platt scaling for two and for several classes."""

from framework.target import Target
from framework.testing.rows import WrapperRow

TWO, THREE, FIVE = (Target("class", names) for names in (("off", "on"), tuple("abc"), tuple("abcde")))
ROWS = {
    "temperature": (
        WrapperRow("classes", THREE, identity={}),
        WrapperRow("one angle", Target("angle", ("azimuth",)), identity={}),
        WrapperRow("two reals", Target("real", ("x", "y")), identity={}),
        WrapperRow("never sharper", Target("real", ("height",)), {"lower": 1.0}, identity={"upper": 1.0}),
    ),
    "platt": (
        WrapperRow("two classes", TWO, identity={}),
        WrapperRow("five classes", FIVE, identity={}),
        WrapperRow("labels as they are", FIVE, {"smoothing": False}, identity={}),
    ),
}
