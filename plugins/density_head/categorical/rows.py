"""Contract-test cases: class probabilities, with log-probabilities from a 50-digit reference."""

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
    """Return the log-probability l_k - log Σ_j exp l_j of class `label`, computed with 50 digits.

    The largest logit is subtracted first, since 50 digits are too few for exponents that differ by thousands.
    """
    with mpmath.workdps(50):
        largest = max(logits)
        total = mpmath.fsum(mpmath.e ** (mpmath.mpf(logit) - largest) for logit in logits)
        return float(mpmath.mpf(logits[label]) - largest - mpmath.log(total))


def softmax_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases in which the first logit has one value, and all other logits share a second value."""
    for first, second in LOGITS:
        raw = torch.tensor([first] + [second] * (head.size - 1), dtype=torch.float32).double()
        value = torch.arange(head.size)
        log_prob = torch.tensor(
            [exact(raw.tolist(), label) for label in range(head.size)], dtype=torch.float64
        )
        yield Case(f"logits {first:g}, {second:g}", raw.expand(head.size, -1), value, log_prob)


def logistic_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases of the log-probabilities -log(1 + exp(∓r)) of the two classes (eq. 2.10-2.11)."""
    for raw in (0.0, 1e-8, -2.0, 40.0, -700.0, 1e4, 1e30):
        number = torch.tensor(raw, dtype=torch.float32).double()
        log_prob = [exact([0.0, number.item()], label) for label in (0, 1)]
        value = torch.arange(2)
        yield Case(f"r = {raw:g}", number.expand(2, 1), value, torch.tensor(log_prob, dtype=torch.float64))


ROWS = {
    "categorical": (
        HeadRow("five classes", FIVE, cases=softmax_cases),
        HeadRow("two classes", TWO, cases=softmax_cases),
    ),
    "bernoulli": (HeadRow("two classes", TWO, cases=logistic_cases),),
}
