"""Contract-test cases: few trees, for classes and for reals, fitted to random features by the tests.

The cases have no reference values: test_extra_trees.py and test_gradient_boosting.py compare the heads with the
libraries that grow the trees.
"""

from framework.target import Target
from framework.testing.rows import HeadRow

TWO, FIVE = Target("class", ("a", "b")), Target("class", ("a", "b", "c", "d", "e"))
ONE_REAL, TWO_REALS = Target("real", ("height",)), Target("real", ("x", "y"))
ROWS = {
    "extra_trees": (
        HeadRow("five classes", FIVE, {"trees": 7}),
        HeadRow("one real", ONE_REAL, {"trees": 7, "leaf": 5}),
        HeadRow("two reals", TWO_REALS, {"trees": 5, "leaf": 5}),
    ),
    "xgboost": (
        HeadRow("five classes", FIVE, {"rounds": 5}),
        HeadRow("exact splits", TWO, {"rounds": 5, "splits": "exact"}),
        HeadRow("one real", ONE_REAL, {"rounds": 5, "depth": 2}),
        HeadRow("two reals", TWO_REALS, {"rounds": 5, "depth": 2}),
    ),
}
