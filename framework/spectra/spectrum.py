"""Z-spectra as one minus a sum of Lorentzian lines, one for each pool of protons, with first and second derivatives.

Z(Δω) = 1 - Σ_i A_i (w_i/2)² / ((w_i/2)² + (Δω - δ_i)²), with amplitudes A; offsets Δω, widths w (at half maximum) and
centres δ are in ppm (Zaiss et al. 2011; Windschuh et al. 2015). The centre of water is the shift of the static field
B0, and the centres of the other pools are counted from it.
"""

from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.spectra import compiled

POOLS = ("water", "amide", "noe", "mt", "amine")
COUNT = len(POOLS)
CENTRES = (0.0, 3.5, -3.5, -2.5, 2.0)
"""Centres of the pools, ppm from water."""
Preset = Literal["ten", "fifteen"]
"""Names of the sets of fitted parameters."""


class Parameters(NamedTuple):
    """The fitted parameters of spectra: their names, bounds and start values, and how many of them are the target.

    Attributes:
        names: names with units; amplitudes are shares of the unsaturated signal.
        lower: lower bounds.
        upper: upper bounds.
        start: values at which the search starts.
        target_count: number of parameters that are the target; the parameters after them are fitted too.
    """

    names: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    start: tuple[float, ...]
    target_count: int

    @classmethod
    def of(cls, preset: Preset) -> "Parameters":
        """Return the parameters of the spectral lines of five proton pools for a preset.

        "ten": ten amplitudes and widths are the target; the shift of water is fitted too, and the centres of the other
        pools are fixed (thesis §4.1). "fifteen": amplitudes, widths and centres are the target, and nothing is fixed.
        """
        return PRESETS[preset]

    @property
    def second_start(self) -> tuple[float, ...]:
        """Second start, from which `framework.spectra.fit.fit` repeats the search for some spectra."""
        return tuple(ELSEWHERE.get(name, at) for name, at in zip(self.names, self.start, strict=True))

    @property
    def target(self) -> tuple[str, ...]:
        """Names of the target's numbers."""
        return self.names[: self.target_count]


def _parameters(free: bool) -> Parameters:
    """Return the parameters of five spectral lines; if `free` is true, the centres of all lines are fitted."""
    columns = (
        *((f"{pool}_amplitude", 0.0, 1.0, start) for pool, start in zip(POOLS, AMPLITUDES, strict=True)),
        *((f"{pool}_width_ppm", *box) for pool, box in zip(POOLS, WIDTHS, strict=True)),
        *((f"{pool}_centre_ppm", *box) for pool, box in zip(POOLS, PLACES, strict=True)),
    )
    chosen = columns if free else columns[: 2 * COUNT + 1]
    names, lower, upper, start = zip(*chosen, strict=True)
    return Parameters(names, lower, upper, start, len(chosen) if free else 2 * COUNT)


AMPLITUDES = (0.75, 0.02, 0.1, 0.15, 0.1)
"""Starts of the amplitudes."""
WIDTHS = ((0.2, 8.0, 1.0), (0.3, 8.0, 0.6), (0.5, 12.0, 4.0), (8.0, 200.0, 50.0), (0.3, 8.0, 6.0))
"""Lower bound, upper bound and start of each width, ppm; wide, so that few fits end at a bound."""
PLACES = ((-1.0, 1.0, 0.0), (3.0, 4.0, 3.5), (-4.5, -2.5, -3.5), (-4.5, 0.5, -2.5), (1.2, 2.8, 2.0))
"""Lower bound, upper bound and start of each centre, ppm; wide, so that few fits end at a bound."""
ELSEWHERE = {"amide_amplitude": 0.03, "amide_width_ppm": 1.2, "amine_amplitude": 0.05, "amine_width_ppm": 2.0}
"""Values at which the second start differs from the first: a broader line of amide and a narrower line of amine."""
PRESETS: dict[Preset, Parameters] = {"ten": _parameters(False), "fifteen": _parameters(True)}


def centres(parameters: Float[Tensor, "batch p"]) -> Float[Tensor, "batch pool"]:
    """Return the centres of the lines, ppm."""
    shift = parameters[:, 2 * COUNT : 2 * COUNT + 1]
    fixed = parameters.new_tensor(CENTRES)
    if parameters.shape[1] == 2 * COUNT + 1:
        return shift + fixed
    return torch.cat((shift, shift + parameters[:, 2 * COUNT + 1 :]), 1)


def spectrum(
    parameters: Float[Tensor, "batch p"], offsets: Float[Tensor, "offset"]
) -> Float[Tensor, "batch offset"]:
    """Return the Z-spectrum at the offsets, the share of the water signal that remains after saturation.

    Args:
        parameters: parameters of the preset "ten" or "fifteen" (`Parameters.of`).
        offsets: frequency offsets of the saturation from water, ppm.
    """
    amplitude, width = parameters[:, :COUNT, None], parameters[:, COUNT : 2 * COUNT, None]
    square = (width / 2).square()
    lines = amplitude * square / (square + (offsets - centres(parameters).unsqueeze(-1)).square())
    return 1 - lines.sum(1)


class Misfit:
    """The residuals of many spectra, Z(parameters) - measured, for framework.least_squares.solver.

    Args:
        measured: (spectrum, offset) float64, NaN where nothing was measured.
        offsets: (offset,) float64, ppm.
    """

    def __init__(self, measured: Float[Tensor, "spectrum offset"], offsets: Float[Tensor, "offset"]) -> None:
        self.measured = measured.contiguous()
        self.offsets = offsets

    def __call__(self, parameters: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residuals (batch, offset) and their Jacobian (batch, offset, p).

        `rows` are the rows of `measured` that belong to the rows of `parameters`.
        """
        amplitude, half = parameters[:, :COUNT, None], parameters[:, COUNT : 2 * COUNT, None] / 2
        # With e = 1 / (h² + d²): ∂Z/∂A = -h² e, ∂Z/∂w = -A h d² e², ∂Z/∂δ = -2 A h² d e².
        distance = self.offsets - centres(parameters).unsqueeze(-1)
        square = distance.square()
        inverse = (square + half.square()).reciprocal_()
        jacobian = parameters.new_empty(*parameters.shape, len(self.offsets))
        lines = jacobian[:, :COUNT]
        torch.mul(inverse, -half.square(), out=lines)
        residuals = torch.bmm(amplitude.mT, lines).squeeze(1).add_(1).sub_(self.measured[rows])
        inverse.square_().mul_(amplitude * half)
        torch.mul(square.neg_(), inverse, out=jacobian[:, COUNT : 2 * COUNT])
        moved = distance.mul_(inverse).mul_(-2 * half)
        jacobian[:, 2 * COUNT] = moved.sum(1)
        if parameters.shape[1] > 2 * COUNT + 1:
            jacobian[:, 2 * COUNT + 1 :] = moved[:, 1:]
        return residuals, jacobian.mT

    def normal(self, parameters: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the cost, its gradient, the normal matrix and the number of measured offsets, computed on the CPU.

        The cost (batch,) is half the sum of squared residuals r. With their Jacobian J, the gradient (batch, p) is Jᵀr,
        and the normal matrix (batch, p, p) is JᵀJ. The number of measured offsets is (batch,). `rows` are the rows of
        `measured` that belong to the rows of `parameters`.
        """
        gram = parameters.new_empty(*parameters.shape, parameters.shape[1])
        cost, gradient, measured_counts = (
            gram.new_empty(len(gram)),
            torch.empty_like(parameters),
            torch.empty_like(rows),
        )
        compiled.compute_sums(
            *self._arrays(parameters, rows),
            *(part.numpy() for part in (cost, gradient, gram, measured_counts)),
        )
        return cost, gradient, gram, measured_counts

    def curvature(self, parameters: Tensor, rows: Tensor) -> Tensor:
        """Return the sum over offsets of the residual times ∇²Z, (batch, p, p), computed on the CPU.

        ∇²Z is the matrix of second derivatives of Z by the parameters. `rows` are the rows of `measured` that belong to
        the rows of `parameters`.
        """
        curvature = parameters.new_empty(*parameters.shape, parameters.shape[1])
        compiled.compute_curvature(*self._arrays(parameters, rows), curvature.numpy())
        return curvature

    def _arrays(self, *tensors: Tensor) -> tuple[np.ndarray, ...]:
        parameters, rows = (tensor.contiguous().numpy() for tensor in tensors)
        return parameters, rows, self.measured.numpy(), self.offsets.numpy(), np.array(CENTRES)
