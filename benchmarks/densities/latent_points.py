"""Comparison of the variance of three quasi-random sequences with that of independent points, for `latent.py`."""

from collections.abc import Callable

import torch
from torch import Tensor

from framework.distributions.closed_forms import normal_quantile
from plugins.density_head.latent.monte_carlo import lattice


def kronecker(count: int, dimensions: int) -> Tensor:
    """Return the points i (g⁻¹, g⁻², …) mod 1 with g^(d+1) = g + 1 (Roberts 2018), (count, dimensions)."""
    root = 1.5
    for _ in range(100):
        root = (1 + root) ** (1 / (dimensions + 1))
    powers = torch.tensor([root**-power for power in range(1, dimensions + 1)], dtype=torch.float64)
    return torch.remainder(torch.outer(torch.arange(count, dtype=torch.float64), powers), 1.0)


def sobol(count: int, dimensions: int) -> Tensor:
    """Return the first points of the Sobol sequence, (count, dimensions)."""
    return torch.quasirandom.SobolEngine(dimensions).draw(count, dtype=torch.float64)


SEQUENCES = {
    "Kronecker": kronecker,
    "Sobol": sobol,
    "lattice": lambda count, dimensions: lattice(0, count, dimensions),
}
INTEGRANDS: tuple[Callable[[Tensor], Tensor], ...] = (
    lambda z: torch.exp(2 * torch.cos(z.sum(-1) / z.shape[-1] ** 0.5 - 0.5)),
    lambda z: torch.exp(50 * (torch.cos(z.sum(-1) / z.shape[-1] ** 0.5 - 0.5) - 1)),
    lambda z: torch.exp(-2 * (z - 0.4).square().sum(-1)),
    lambda z: torch.exp(z.sum(-1) / z.shape[-1] ** 0.5 / 2),
    lambda z: torch.exp(10 * torch.cos(2 * z[..., 0] - 0.3 * z.sum(-1))),
)


def sequences(repeats: int = 400) -> list[dict[str, object]]:
    """Return the variance of independent points divided by that of each randomly shifted sequence.

    A row has the geometric mean of this ratio over the integrands, and the smallest ratio.
    """
    rows: list[dict[str, object]] = []
    torch.manual_seed(0)
    for dimensions in (1, 2, 4, 8):
        for count in (62, 64, 125, 512):
            shift = torch.rand(repeats, 1, dimensions, dtype=torch.float64)
            row: dict[str, object] = {"dimensions": dimensions, "points": count}
            z = torch.randn(4 * repeats, count, dimensions, dtype=torch.float64)
            independent = torch.stack([integrand(z).mean(1).var() for integrand in INTEGRANDS])
            for name, sequence in SEQUENCES.items():
                z = normal_quantile(torch.remainder(sequence(count, dimensions) + shift, 1.0))
                ratios = independent / torch.stack([integrand(z).mean(1).var() for integrand in INTEGRANDS])
                # ratios above a million count as a million, so that they do not dominate the mean
                row[name] = float(ratios.clamp(max=1e6).log().mean().exp())
                row[f"{name}, worst"] = float(ratios.min())
            rows.append(row)
    return rows
