"""Contract-test cases: a Gaussian, and a CVAE over the numbers of two frames, around the mean in the input."""

from collections.abc import Mapping

from framework.target import Target
from framework.testing.flights import TWO_FRAMES
from framework.testing.rows import HeadRow

THREE = Target("real", ("x", "y", "z"))
TVAE = {
    "name": "cvae", "latent": 2, "hidden": 8, "training_samples": 1, "samples": 10, "component": {"name": "gaussian"},
}  # fmt: skip
BOUND: Mapping[str, str] = dict.fromkeys(
    ("integral", "samples follow log_prob", "entropy", "mode"),
    "log_prob is the importance-weighted bound (eq. 3.19); all other results are of the mixture sampled from the prior",
)
DEEP = {"float32 against float64": 256.0}
"""Limits of checks that are wider than usual, because rounding errors grow over seven layers in sequence.

The last layer multiplies outputs of the layer before by a latent vector.
"""
ROWS = {
    "hybrid": (
        HeadRow("three numbers", THREE, {"further": 4, "hidden": 8}),
        HeadRow(
            "a CVAE over two frames",
            TWO_FRAMES,
            {"further": 4, "hidden": 8, "component": TVAE},
            limits=DEEP,
            leave_out=BOUND,
        ),
    ),
}
