"""Rows of the contract: few rounds, for classes and for reals. The checks fit it to drawn features first.

No reference is given: the head against the library's own predictions is in test_xgboost.py.
"""

from framework.target import Target
from framework.testing.rows import HeadRow

ROWS = {
    "xgboost": (
        HeadRow("five classes", Target("class", ("a", "b", "c", "d", "e")), {"rounds": 5}),
        HeadRow("exact splits", Target("class", ("a", "b")), {"rounds": 5, "splits": "exact"}),
        HeadRow("one real", Target("real", ("height",)), {"rounds": 5, "depth": 2}),
        HeadRow("two reals", Target("real", ("x", "y")), {"rounds": 5, "depth": 2}),
    )
}
