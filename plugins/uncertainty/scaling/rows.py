"""Contract-test cases: temperatures for every kind of target, and Platt scaling for two and for several classes."""

from framework.target import Target
from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

TWO, FIVE = Target("class", ("off", "on")), Target("class", tuple("abcde"))
ROWS = {
    "temperature": (
        WrapperRow("classes", CLASSES, identity={}),
        WrapperRow("one angle", ANGLE, identity={}),
        WrapperRow("two reals", REALS, identity={}),
        WrapperRow("never sharper", Target("real", ("height",)), {"lower": 1.0}, identity={"upper": 1.0}),
    ),
    "platt": (
        WrapperRow("two classes", TWO, identity={}),
        WrapperRow("five classes", FIVE, identity={}),
        WrapperRow("labels as they are", FIVE, {"smoothing": False}, identity={}),
    ),
}
