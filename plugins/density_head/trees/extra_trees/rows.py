"""Rows of the contract: a forest of few trees, for classes and for reals. The checks fit it to drawn features first.

No reference is given: the forest against the library that grew it, and the smoothing, are in test_extra_trees.py.
"""

from framework.target import Target
from framework.testing.rows import HeadRow

ROWS = {
    "extra_trees": (
        HeadRow("five classes", Target("class", ("a", "b", "c", "d", "e")), {"trees": 7}),
        HeadRow("one real", Target("real", ("height",)), {"trees": 7, "leaf": 5}),
        HeadRow("two reals", Target("real", ("x", "y")), {"trees": 5, "leaf": 5}),
    )
}
