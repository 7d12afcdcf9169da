"""Rows of the contract: Monte Carlo dropout, for each kind of target.

No row names an identity: with one sample the density is that of one stochastic pass (test_mc_dropout.py), not the
model's.
"""

from framework.target import Target
from framework.testing.rows import WrapperRow

ROWS = {
    "mc_dropout": (
        WrapperRow("classes", Target("class", ("a", "b", "c")), {"samples": 5}),
        WrapperRow("one angle", Target("angle", ("azimuth",)), {"samples": 5}),
        WrapperRow("two angles", Target("angle", ("azimuth", "elevation")), {"samples": 3}),
        WrapperRow("reals", Target("real", ("x", "y")), {"samples": 5}),
        WrapperRow("one sample", Target("class", ("a", "b", "c")), {"samples": 1}),
    )
}
