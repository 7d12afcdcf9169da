"""Contract-test cases: the projected normal head, with log-densities by integrals along a ray with 40 digits."""

from collections.abc import Iterator

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.projected_normal.head import LARGEST_FACTOR, LARGEST_MEAN, ProjectedNormalHead

ONE, TWO = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation"))
RAWS = {
    "uniform": [0.0, 0.0, 0.0, 0.0],
    "two peaks": [0.125, 0.0, 1.5, -0.5],
    "generic": [1.5, -0.5, 0.5, 1.0],
    "concentrated": [40.0, 8.0, -0.25, 0.5],
    "concentrated, stretched": [-64.0, 32.0, 4.0, -8.0],
    "raw 1e4": [1e4, -1e4, 0.5, 0.5],
    "raw 1e30": [-1e30, 1e30, 1e30, -1e30],
}
VALUES = (0.0, 0.5, -2.5, 3.0, 7.0)


def exact(raw: list[float], value: float) -> float:
    """Return log ∫₀^∞ r N(r u; μ, (LLᵀ)⁻¹) dr in closed form by mpmath's error function, nats."""
    with mpmath.workdps(60):
        x, y, s, t = (mpmath.mpf(number) for number in raw)
        square = x * x + y * y
        growth = mpmath.sqrt(1 + square / 16)
        if square > 1:
            growth = min(growth, LARGEST_MEAN / mpmath.sqrt(square))
        bounded = [LARGEST_FACTOR * mpmath.tanh(number / LARGEST_FACTOR) for number in (s, t)]
        lower = mpmath.matrix([[mpmath.exp(bounded[0]), 0], [bounded[1], mpmath.exp(-bounded[0])]])
        u = lower.T * mpmath.matrix([mpmath.cos(value), mpmath.sin(value)])
        m = lower.T * mpmath.matrix([x * growth, y * growth])
        a, b, c = (u.T * u)[0], (u.T * m)[0], (m.T * m)[0]
        d = b / mpmath.sqrt(a)
        # ∫ r exp(-(a r² - 2 b r + c)/2) dr
        ray = (
            mpmath.exp(-c / 2) + d * mpmath.sqrt(2 * mpmath.pi) * mpmath.ncdf(d) * mpmath.exp((d * d - c) / 2)
        ) / a
        if mpmath.fabs(ray) < mpmath.mpf(10) ** -50 * mpmath.exp(-c / 2) or d < -20:
            part = mpmath.quad(
                lambda r: r * mpmath.exp(-(r * r) / 2 + d * r),
                [0, 1 / abs(d), 10 / abs(d), 60 / abs(d), 200 / abs(d)],
            )
            ray = mpmath.exp(-c / 2) * part / a
        return float(mpmath.log(ray / (2 * mpmath.pi)))


def cases(head: DensityHead) -> Iterator[Case]:
    """Yield a case for each set of raw parameters."""
    assert isinstance(head, ProjectedNormalHead)
    for name, numbers in RAWS.items():
        raw = torch.tensor(numbers).float().double()
        value = torch.tensor(VALUES).float().double()
        log_prob = [exact(raw.tolist(), angle) for angle in value.tolist()]
        yield Case(
            name,
            raw.expand(len(VALUES), 4),
            value[:, None],
            torch.tensor(log_prob, dtype=torch.float64),
        )


ROWS = {
    "projected_normal": (
        HeadRow("one angle", ONE, cases=cases),
        HeadRow("isotropic", ONE, {"shape": "isotropic"}),
        HeadRow("two angles", TWO),
    )
}
