"""Contract-test cases: ensembles and Monte Carlo dropout, for each kind of target.

No case of dropout has an identity, a setting with which the wrapper equals the model: with one sample the density is
that of one stochastic pass (test_mc_dropout.py).
"""

from framework.target import Target
from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

ROWS = {
    "ensemble": (
        WrapperRow("classes", CLASSES, identity={"members": 1}),
        WrapperRow("one angle", ANGLE, identity={"members": 1}),
        WrapperRow("two reals", REALS, {"members": 3}, identity={"members": 1}),
    ),
    "mc_dropout": (
        WrapperRow("classes", CLASSES, {"samples": 5}),
        WrapperRow("one angle", ANGLE, {"samples": 5}),
        WrapperRow("two angles", Target("angle", ("azimuth", "elevation")), {"samples": 3}),
        WrapperRow("reals", REALS, {"samples": 5}),
        WrapperRow("one sample", CLASSES, {"samples": 1}),
    ),
}
