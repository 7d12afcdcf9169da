"""Contract-test cases: finite mixtures, with log-densities summed in NumPy from the head's parameters."""

from collections.abc import Iterator

import numpy as np
import torch
from scipy import special

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.mixture.head import MixtureHead

ONE = Target("angle", ("azimuth",))
TWO = Target("angle", ("azimuth", "elevation"))
VIEWPOINT = Target("angle", ("azimuth", "elevation", "tilt"))
CLASSES = Target("class", ("a", "b", "c"))
REAL, REALS = Target("real", ("height",)), Target("real", ("x", "y"))
HEAVY = {
    "components": 3,
    "component": {"name": "student_t", "degrees_of_freedom": 2.5, "balance": 0.0},
}
GAUSSIANS = {"components": 3, "component": {"name": "gaussian"}}
NESTED = {"components": 2, "component": {"name": "mixture", "components": 3}}


def component(head: MixtureHead, number: np.ndarray, value: np.ndarray) -> float:
    """Return the log-density of a component with raw parameters `number` at `value`, nats.

    It is computed by the component's head, which has contract-test cases of its own.
    """
    return head.component(torch.from_numpy(number)).log_prob(torch.from_numpy(value)).item()


def expected_log_prob(head: MixtureHead, raw: np.ndarray, value: np.ndarray) -> float:
    """Return the log-density log Σ_k w_k p_k (eq. 3.10), nats, with the largest term factored out."""
    count, size = head.components, head.component.size
    numbers = raw[count : count + count * size].reshape(count, size)
    if count > 1:
        numbers = numbers + raw[-size:] + head.spread.detach().numpy()
    terms = [component(head, number, value) for number in numbers]
    return float(np.logaddexp.reduce(np.array(terms) + special.log_softmax(raw[:count])))


def hard_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with ordinary raw parameters, vanishing weights, and narrow components far from each other."""
    assert isinstance(head, MixtureHead)
    generator = torch.Generator().manual_seed(7)
    ordinary = torch.randn(6, head.size, generator=generator)
    numbers = head.component(torch.zeros(head.component.size)).event_shape.numel()
    value = 3 * torch.randn(6, numbers, generator=generator)
    lopsided, narrow = ordinary.clone(), ordinary.clone()
    lopsided[:, 0] += 1e4
    narrow[:, head.components :] *= 30
    for name, raw in {"ordinary": ordinary, "weights vanish": lopsided, "narrow": narrow}.items():
        raw, target = raw.double(), value.double()
        rows = zip(raw.numpy(), target.numpy(), strict=True)
        log_prob = torch.tensor([expected_log_prob(head, *row) for row in rows], dtype=torch.float64)
        yield Case(name, raw, target, log_prob)


ROWS = {
    "mixture": (
        HeadRow("five components", ONE, cases=hard_cases, scale=3.0),
        HeadRow(
            "one component",
            ONE,
            {"components": 1},
            cases=hard_cases,
            scale=3.0,
            leave_out={"every raw parameter is read": "the only weight is 1 for any logit"},
        ),
        HeadRow("two angles", TWO, {"components": 3}, cases=hard_cases),
        HeadRow("a real number", REAL, GAUSSIANS, cases=hard_cases),
        HeadRow("two real numbers", REALS, GAUSSIANS, cases=hard_cases),
        HeadRow("two numbers with heavy tails", REALS, HEAVY, cases=hard_cases),
        HeadRow("mixture of mixtures", ONE, NESTED),
        HeadRow(
            "rotations",
            VIEWPOINT,
            {"components": 2, "component": {"name": "matrix_fisher"}},
            scale=0.5,
            leave_out={
                "mode": "matrix_fisher's mode is the likeliest rotation, not the likeliest angles",
                "tempered: power": "matrix_fisher raises only the density of rotations to the power, not cos e",
            },
        ),
        HeadRow("classes", CLASSES, {"component": {"name": "categorical"}}),
    )
}
