"""Comparison of the predicted azimuth density with the true posterior of the azimuth of a symmetric object."""

import math
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.checks import refuse_nan
from framework.distributions.circular import grid, wrap
from framework.errors import ConfigError, DataError
from framework.metric import Directions, Metric
from framework.prediction import Prediction
from framework.target import Target

CHUNK = 16  # azimuths that are evaluated at once: CHUNK × batch × components numbers should fit the processor's cache


class TruePosterior(Metric):
    """Agreement of the predicted azimuth density with the known symmetry of the object.

    The metric reads the batch field "symmetry", int64. The value 1 means no symmetry. A value n ≥ 2 means that the
    azimuth is known only up to 2π/n; the true posterior then has n modes at the annotated azimuth + 2πk/n, each of mass
    1/n. The value 0 means that the object looks the same from all sides; the true posterior is then uniform.

    - `azimuth_entropy`: mean entropy of the azimuth, nats, over all samples.
    - `mode_mass_<k>_of_<n>`: mass within ±π/(2n) of mode k, mean over the samples with n modes; best: 1/n.
    - `mode_mass_min`: the smallest of these means, near 0 if the density misses a mode; best: 1/(largest n).
    - `uniform_gap`: log 2π minus the entropy, nats, mean over the samples with symmetry 0; best: 0.

    A result is NaN if no sample has the symmetry to which the result refers. Integrals are sums over `points` equally
    spaced azimuths: each sample costs `points` evaluations of the azimuth marginal. A density that is too narrow for
    the grid (its sum on the grid is not 1 within 1e-4) is evaluated from `prediction.samples` draws instead.

    Args:
        target: a target that contains an angle named "azimuth".
        points: number of azimuths on the grid; the grid resolves von Mises concentrations κ up to points²/40.
        largest_symmetry: largest n that is allowed in the field "symmetry".

    Raises:
        ConfigError: the target has no azimuth; or, at the first update, the data have no field "symmetry".
        DataError: a symmetry is below 0 or above `largest_symmetry`.
        UserError: entropies are NaN.
    """

    bibtex = "prokudin2018deep"
    columns: ClassVar[dict[str, str]] = {
        "azimuth_entropy": "azimuth entropy",
        "mode_mass_min": "least mode mass",
        "uniform_gap": "gap to uniform",
    }
    better: ClassVar[Directions] = {"mode_mass_min": "higher", "uniform_gap": "lower"}
    count: Tensor
    entropy: Tensor
    samples_with: Tensor
    mass: Tensor
    gap: Tensor

    def __init__(
        self,
        target: Target,
        *,
        points: Annotated[int, Field(ge=180)] = 720,
        largest_symmetry: Annotated[int, Field(ge=2, le=36)] = 16,
    ) -> None:
        super().__init__()
        if target.kind != "angle" or "azimuth" not in target.names:
            raise ConfigError(
                "metric true_posterior requires an angle named azimuth, but this data set's targets are of kind "
                f"{target.kind!r}: {target.listed_names}. Leave this metric out."
            )
        self.azimuth = target.names.index("azimuth")
        self.points = points
        self.largest = largest_symmetry
        zero = torch.zeros((), dtype=torch.float64)
        rows = self.largest + 1
        self.add_state("count", zero, dist_reduce_fx="sum")
        self.add_state("entropy", zero.clone(), dist_reduce_fx="sum")
        self.add_state("gap", zero.clone(), dist_reduce_fx="sum")
        # `samples_with` is indexed by symmetry n, `mass` by n and mode k
        self.add_state("samples_with", zero.new_zeros(rows), dist_reduce_fx="sum")
        self.add_state("mass", zero.new_zeros(rows, self.largest), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        symmetry = self._symmetry(prediction)
        if len(symmetry) == 0:
            return
        azimuth = prediction.target[:, self.azimuth]
        density = prediction.marginal(self.azimuth)
        entropy, mass = entropy_and_mode_mass(
            density, azimuth, symmetry, self.largest, self.points, prediction.samples
        )
        refuse_nan(entropy, "entropies of the azimuth")
        self.count += len(symmetry)
        self.entropy += entropy.sum()
        self.gap += (math.log(2 * math.pi) - entropy)[symmetry == 0].sum()
        self.samples_with += torch.bincount(symmetry, minlength=len(self.samples_with))
        self.mass.index_add_(0, symmetry, mass)

    def compute(self) -> dict[str, Tensor]:
        results = {
            "azimuth_entropy": self.entropy / self.count,
            "mode_mass_min": self.entropy.new_tensor(torch.nan),
            "uniform_gap": self.gap / self.samples_with[0],
        }
        means = {
            f"mode_mass_{mode}_of_{modes}": self.mass[modes, mode] / self.samples_with[modes]
            for modes in range(2, self.largest + 1)
            if self.samples_with[modes] > 0
            for mode in range(modes)
        }
        if means:
            results["mode_mass_min"] = torch.stack(list(means.values())).min()
        return results | means

    def _symmetry(self, prediction: Prediction) -> Int[Tensor, "batch"]:
        if "symmetry" not in prediction.batch:
            raise ConfigError(
                'metric true_posterior requires the batch field "symmetry", but this data set records no symmetry of '
                f"its objects (fields: {', '.join(prediction.batch)}). Leave this metric out, or choose a data set "
                "with "
                "this field."
            )
        symmetry = prediction.batch["symmetry"].long()
        wrong = (symmetry < 0) | (symmetry > self.largest)
        if wrong.any():
            raise DataError(
                f"metric true_posterior got the symmetry {int(symmetry[wrong][0])}, expected 0 (continuous), 1 (none) "
                f"or the number of modes up to largest_symmetry={self.largest}. Correct the data, or increase "
                "largest_symmetry."
            )
        return symmetry


def entropy_and_mode_mass(
    density: Distribution,
    azimuth: Float[Tensor, "batch"],
    symmetry: Int[Tensor, "batch"],
    modes: int,
    points: int,
    samples: int,
) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch modes"]]:
    """Return the entropy (nats) of a density of one angle, and its mass around each mode of the true posterior.

    For the symmetry n, the mass of mode k < n is that in the window of ±π/(2n) around azimuth + 2πk/n. Both integrals
    use the trapezium rule on the circle. A grid cell that the edge of a window cuts counts with the part inside the
    window. If the density is too narrow for the grid of `points` angles, both are estimated from `samples` draws.

    Args:
        density: density of the azimuth, batch_shape (batch,).
        azimuth: annotated azimuth, radians.
        symmetry: n of each sample; 0 is read as 1.
        modes: largest n; the masses of modes that a sample does not have are 0.
        points: number of angles on the grid.
        samples: number of draws for a density that is too narrow.
    """
    step = 2 * math.pi / points
    # the grid starts at the annotated azimuth, so that windows and modes lie at the same grid points for every sample
    relative = grid(points, dtype=torch.float64, device=azimuth.device)
    angles = wrap(azimuth.double() + relative.unsqueeze(-1)).to(azimuth.dtype)
    angles = angles.unsqueeze(-1)  # (points, batch, 1)
    log_density = torch.cat([density.log_prob(chunk).double() for chunk in angles.split(CHUNK)])
    weight = log_density.exp() * step
    total = weight.sum(0)
    # p log p → 0 as p → 0; the clamp keeps 0 · (-inf) from being NaN
    entropy = -(weight * log_density.clamp(min=-1e4)).sum(0) / total
    mass = _mass_by_mode(relative.unsqueeze(-1).expand_as(weight), weight / total, symmetry, modes, step)
    narrow = ~((total - 1).abs() < 1e-4)
    if narrow.any():
        draws = density.sample(torch.Size((samples,)))
        offset = wrap(draws.squeeze(-1).double() - azimuth.double())
        equal_weights = torch.full_like(offset, 1 / samples)
        entropy = torch.where(narrow, -density.log_prob(draws).double().mean(0), entropy)
        mass = torch.where(
            narrow.unsqueeze(-1), _mass_by_mode(offset, equal_weights, symmetry, modes, 0.0), mass
        )
    return entropy, mass


def _mass_by_mode(
    offset: Float[Tensor, "points batch"],
    weight: Float[Tensor, "points batch"],
    symmetry: Int[Tensor, "batch"],
    modes: int,
    step: float,
) -> Float[Tensor, "batch modes"]:
    count = symmetry.clamp(min=1)
    circle = 2 * math.pi
    nearest = (offset * count / circle).round()
    distance = (offset - nearest * circle / count).abs()
    half_width = math.pi / (2 * count)
    if step > 0:
        inside = ((half_width - distance) / step + 0.5).clamp(0, 1)
    else:
        inside = (distance <= half_width).double()
    mass = weight.new_zeros(len(symmetry), modes)
    return mass.scatter_add_(1, nearest.long().remainder(count).T, (weight * inside).T)
