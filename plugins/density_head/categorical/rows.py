"""Rows of the contract: class probabilities, with log-probabilities from 50 digits."""

from collections.abc import Iterator

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow

TWO = Target("class", ("off", "on"))
FIVE = Target("class", ("a", "b", "c", "d", "e"))
LOGITS = ((0.0, 0.0), (1e-8, 0.0), (3.0, -2.0), (50.0, -50.0), (1e4, -1e4), (-1e4, 1e4), (1e30, -1e30))


def exact(logits: list[float], label: int) -> float:
    """Return l_k - log Σ exp l_j, less the largest logit: 50 digits are too few if exponents differ by thousands."""
    with mpmath.workdps(50):
        largest = max(logits)
        total = mpmath.fsum(mpmath.e ** (mpmath.mpf(logit) - largest) for logit in logits)
        return float(mpmath.mpf(logits[label]) - largest - mpmath.log(total))


def softmax(head: DensityHead) -> Iterator[Case]:
    """Yield cases with two logits that differ; the others equal the second."""
    for first, second in LOGITS:
        raw = torch.tensor([first] + [second] * (head.size - 1), dtype=torch.float32).double()
        value = torch.arange(head.size)
        log_prob = torch.tensor(
            [exact(raw.tolist(), label) for label in range(head.size)], dtype=torch.float64
        )
        yield Case(f"logits {first:g}, {second:g}", raw.expand(head.size, -1), value, log_prob)


def logistic(head: DensityHead) -> Iterator[Case]:
    """Yield cases with -log(1 + exp(∓r)) (eq. 2.10-2.11)."""
    for raw in (0.0, 1e-8, -2.0, 40.0, -700.0, 1e4, 1e30):
        number = torch.tensor(raw, dtype=torch.float32).double()
        log_prob = [exact([0.0, number.item()], label) for label in (0, 1)]
        value = torch.arange(2)
        yield Case(f"r = {raw:g}", number.expand(2, 1), value, torch.tensor(log_prob, dtype=torch.float64))


ROWS = {
    "categorical": (HeadRow("five classes", FIVE, cases=softmax), HeadRow("two classes", TWO, cases=softmax)),
    "bernoulli": (HeadRow("two classes", TWO, cases=logistic),),
}
