"""Contract-test cases: von Mises heads, with log-densities from a 50-digit reference."""

import math
from collections.abc import Iterator
from typing import Any

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.von_mises.head import LARGEST_CONCENTRATION

ONE = Target("angle", ("azimuth",))
TWO = Target("angle", ("azimuth", "elevation"))
THREE = Target("angle", ("azimuth", "elevation", "tilt"))
CONCENTRATIONS = (0.0, 1e-30, 1e-8, 1e-3, 0.5, 3.75, 10.0, 50.0, 1e3, 1e4, 1e6, 1e8, LARGEST_CONCENTRATION)
OFFSETS = (0.0, 1e-8, 1e-3, 1.0, 3.0, -math.pi, 2 * math.pi, 1e6)


def exact(offset: float, concentration: float) -> Any:
    """Return the log-density κ cos d - log(2π I0(κ)) (eq. 3.3), nats, computed with 50 digits.

    d is the distance `offset` from the mean, and κ the concentration.
    """
    with mpmath.workdps(50):
        kappa = mpmath.mpf(concentration)
        return kappa * mpmath.cos(mpmath.mpf(offset)) - mpmath.log(2 * mpmath.pi * mpmath.besseli(0, kappa))


def predicted_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with pairs (κ, 0) and r = 0, which give mean 0 and concentration κ without rounding.

    Each angle has the same offsets from the mean, in a cyclic order that starts one offset later for each angle.
    """
    angles = head.size // 3
    for concentration in CONCENTRATIONS:
        kappa = torch.tensor(concentration, dtype=torch.float32).item()
        raw = torch.tensor([kappa, 0.0, 0.0], dtype=torch.float64).repeat(len(OFFSETS), angles)
        offset = torch.tensor(OFFSETS, dtype=torch.float32).double()
        value = torch.stack([offset.roll(angle) for angle in range(angles)], -1)
        # the head keeps pairs off zero by 2e-18 and κ within its range
        kappa = min(max(kappa, 2e-18), LARGEST_CONCENTRATION) if kappa < 1e-18 or kappa > 1 else kappa
        log_prob = [float(sum(exact(number, kappa) for number in row)) for row in value.tolist()]
        yield Case(f"κ = {concentration:g}", raw, value, torch.tensor(log_prob, dtype=torch.float64))


def fixed_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with the untrained κ = 1, which does not depend on the length of the pair."""
    for length in (1e-10, 1.0, 1e10):
        raw = torch.tensor([[length, 0.0]], dtype=torch.float32).double().repeat(len(OFFSETS), 1)
        value = torch.tensor(OFFSETS, dtype=torch.float32).double()[:, None]
        log_prob = [float(exact(number, 1.0)) for number in value[:, 0].tolist()]
        yield Case(f"pair of length {length:g}", raw, value, torch.tensor(log_prob, dtype=torch.float64))


ROWS = {
    "von_mises": (
        HeadRow("one angle", ONE, cases=predicted_cases),
        HeadRow("narrow", ONE, scale=3.0),
        HeadRow("two angles, narrow", TWO, {"floor": 0.5}, scale=3.0),
        HeadRow("three angles", THREE, cases=predicted_cases),
        HeadRow("fixed concentration", ONE, {"concentration": "fixed"}, cases=fixed_cases),
        HeadRow("least concentration 1", THREE, {"floor": 1.0}),
    )
}
