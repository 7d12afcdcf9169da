"""Contract-test cases: images of few pixels, with log-densities from a 50-digit reference."""

from collections.abc import Iterator

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow

SILHOUETTE = Target("image", ("subject",), size=(2, 3))
PARTS = Target("image", ("skin", "cloth"), size=(1, 2))
WHITE = (-1e30, 0.0, 1e-7, 0.0625, 0.25, 0.5, 0.875, 0.9990234375, 1.0, 3.0)


def bernoulli_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with the reference log p: the sum of log w for numbers of 0, and of log(1 - w) for numbers of 1.

    w is the clamped feature of the number.
    """
    for white in WHITE:
        raw = torch.full((2, *head.raw_shape), white, dtype=torch.float64)
        with mpmath.workdps(50):
            bounded_white = min(max(mpmath.mpf(white), mpmath.mpf(1e-3)), mpmath.mpf(1 - 1e-3))
            log_prob = [float(head.size * mpmath.log(part)) for part in (bounded_white, 1 - bounded_white)]
        channels, *size = head.raw_shape
        value = torch.tensor([0.0, 1.0]).double().reshape(2, 1, 1, 1).expand(2, *size, channels)
        yield Case(f"w = {white:g}", raw, value, torch.tensor(log_prob, dtype=torch.float64))


DISCRETE = {
    "integral by draws": "the density is over 0 and 1, not over reals; test_bernoulli_image.py sums the probabilities"
}
ROWS = {
    "bernoulli_image": (
        HeadRow("a silhouette", SILHOUETTE, cases=bernoulli_cases, leave_out=DISCRETE),
        HeadRow("two parts", PARTS, cases=bernoulli_cases, leave_out=DISCRETE),
    )
}
