"""Rows of the contract: slopes and biases for two and for several classes."""

from framework.target import Target
from framework.testing.rows import WrapperRow

TWO, FIVE = Target("class", ("off", "on")), Target("class", ("a", "b", "c", "d", "e"))
ROWS = {
    "platt": (
        WrapperRow("two classes", TWO, identity={}),
        WrapperRow("five classes", FIVE, identity={}),
        WrapperRow("labels as they are", FIVE, {"smoothing": False}, identity={}),
    )
}
