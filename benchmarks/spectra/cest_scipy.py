"""Comparison of SciPy's least squares, one Z-spectrum after another, with the batched fit of all spectra at once."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import optimize
from torch import Tensor

from benchmarks.timing import ROUNDS, Rounds
from framework.spectra.fit import Fit, fit
from framework.spectra.spectrum import CENTRES, COUNT, PRESETS, Misfit, Parameters
from plugins.data.cest.volumes import read_volume

TIGHT, ORDINARY = 1e-14, 1e-8
"""Tolerances of SciPy: the one at which its parameters are exact to 1e-6, and its default."""


class FastResiduals:
    """Residuals and Jacobian of one spectrum in NumPy, which share intermediate results to make SciPy fast."""

    def __init__(self, measured: np.ndarray, offsets: np.ndarray, size: int) -> None:
        self.measured, self.offsets, self.size = measured, offsets, size
        self.centres = np.array(CENTRES)[:, None]
        self.last = np.empty(0)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        if not np.array_equal(x, self.last):
            self.last = x.copy()
            self.amplitude, self.half = x[:COUNT, None], x[COUNT : 2 * COUNT, None] / 2
            centre = self.centres if self.size == 2 * COUNT + 1 else np.r_[0.0, x[2 * COUNT + 1 :]][:, None]
            self.distance = self.offsets - x[2 * COUNT] - centre
            self.inverse = 1 / (self.half**2 + self.distance**2)
            self.lines = self.half**2 * self.inverse
        return 1 - self.amplitude[:, 0] @ self.lines - self.measured

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        self(x)
        matrix = np.empty((self.size, len(self.offsets)))
        matrix[:COUNT] = -self.lines
        weight = self.amplitude * self.half * self.inverse**2
        moved = weight * self.distance
        matrix[COUNT : 2 * COUNT] = -moved * self.distance
        moved *= -2 * self.half
        matrix[2 * COUNT] = moved.sum(0)
        matrix[2 * COUNT + 1 :] = moved[1:] if self.size > 2 * COUNT + 1 else 0
        return matrix.T


class SciPyFit(NamedTuple):
    """Results of SciPy.

    Attributes:
        parameters: (voxel, p), fitted parameters.
        cost: (voxel,), half the sum of squares.
        milliseconds: Processor time a voxel.
    """

    parameters: np.ndarray
    cost: np.ndarray
    milliseconds: float


def fit_with_scipy(
    measured: np.ndarray,
    offsets: np.ndarray,
    model: Parameters,
    tolerance: float,
    most_evaluations: int | None = None,
) -> SciPyFit:
    solutions, tolerances = [], dict.fromkeys(("ftol", "xtol", "gtol"), tolerance)
    begin = time.process_time()
    for spectrum in measured:
        residuals = FastResiduals(spectrum, offsets, len(model.names))
        box = (model.lower, model.upper)
        jacobian: Any = residuals.jacobian
        solution = optimize.least_squares(
            residuals, model.start, jacobian, box, x_scale="jac", max_nfev=most_evaluations, **tolerances
        )
        solutions.append((solution.x, solution.cost))
    spent = time.process_time() - begin
    parameters, cost = (np.array(part) for part in zip(*solutions, strict=True))
    return SciPyFit(parameters, cost, 1e3 * spent / len(measured))


def time_call(call: Callable[[], Tensor], voxels: int) -> tuple[Tensor, float]:
    """Return the result of a call, and the median milliseconds a voxel of three calls."""
    spent = []
    for _ in range(3):
        begin = time.process_time()
        result = call()
        spent.append(time.process_time() - begin)
    return result, 1e3 * sorted(spent)[1] / voxels


def gradient_cosine(spectra: Tensor, offsets: Tensor, model: Parameters, parameters: Tensor) -> Tensor:
    """Return for each spectrum how far a fit is from a minimum, (spectrum,): 0 at a minimum, at most 1.

    The number is the largest cosine between the residuals and a column of the Jacobian. Parameters that a bound keeps
    from descending are left out.
    """
    residuals, jacobian = Misfit(spectra, offsets)(parameters, torch.arange(len(parameters)))
    gradient = (jacobian.mT @ residuals.unsqueeze(-1)).squeeze(-1)
    lower, upper = (torch.tensor(side).double() for side in (model.lower, model.upper))
    near = 1e-6 * (upper - lower)
    at_bound = (parameters <= lower + near) & (gradient > 0) | (parameters >= upper - near) & (gradient < 0)
    cosine = gradient / (jacobian.norm(dim=1) * residuals.norm(dim=1, keepdim=True))
    return cosine.masked_fill(at_bound, 0.0).abs().amax(1)


def compare_with_scipy(file: Path) -> Iterator[dict[str, object]]:
    """Yield a table row for each preset: run times and results of SciPy and of the batched fit for the whole slice.

    In each round SciPy fits another fifth of the voxels, and the batched fit has all voxels.
    """
    volume = read_volume(file)
    spectra = torch.from_numpy(volume.spectra.astype(np.float32)).double()
    offsets = torch.from_numpy(volume.offsets)
    for name, model in PRESETS.items():
        fit(spectra[:512], offsets, model)  # warm-up
        parts: list[SciPyFit] = []
        default_times, spent = [], []
        batched_fit: Fit | None = None
        for part in range(ROUNDS):
            part_spectra = spectra[part::ROUNDS].numpy()
            parts.append(fit_with_scipy(part_spectra, volume.offsets, model, TIGHT))
            default_times.append(
                fit_with_scipy(part_spectra[::4], volume.offsets, model, ORDINARY).milliseconds
            )
            begin = time.process_time()
            batched_fit = fit(spectra, offsets, model)
            spent.append(1e3 * (time.process_time() - begin) / len(spectra))
        assert batched_fit is not None
        parameters, cost = np.empty((len(spectra), len(model.names))), np.empty(len(spectra))
        for part, scipy_fit in enumerate(parts):
            parameters[part::ROUNDS], cost[part::ROUNDS] = scipy_fit.parameters, scipy_fit.cost
        side = np.array(model.upper) - np.array(model.lower)
        same = (np.abs(batched_fit.cost.numpy() / cost - 1) < 1e-9) & (batched_fit.status.numpy() > 0)
        relative = np.abs(batched_fit.parameters.numpy() - parameters)
        relative = relative / np.maximum(np.abs(parameters), 1e-2 * side)
        different = same & (relative.max(1) >= 1e-6)
        cosines = [
            gradient_cosine(spectra[different], offsets, model, estimates)
            for estimates in (batched_fit.parameters[different], torch.from_numpy(parameters[different]))
        ]
        tight, ordinary, batched = (
            Rounds(tuple(times)) for times in ([part.milliseconds for part in parts], default_times, spent)
        )
        yield {
            "numbers": f"{len(model.names)} ({name})",
            "scipy": tight.text(),
            "usual": ordinary.text(),
            "ours": batched.text(),
            "ratio": batched.times_faster(tight),
            "usual_ratio": batched.times_faster(ordinary),
            "slice": batched.median * len(spectra) / 1e3,
            "cost": f"{100 * np.mean(batched_fit.cost.numpy() <= cost * (1 + 1e-9)):.2f} %",
            "same": f"{100 * same.mean():.2f} %",
            "within": f"{100 * np.mean(relative[same].max(1) < 1e-6):.2f} %",
            "nearer": f"{100 * float((cosines[0] < cosines[1]).double().mean()):.0f} %",
            "flagged": int((batched_fit.status <= 0).sum()),
        }


AGREEMENT = {
    "numbers": "parameters",
    "scipy": "SciPy, tolerance 1e-14, ms a voxel",
    "usual": "SciPy, tolerance 1e-8, ms a voxel",
    "ours": "batched, ms a voxel",
    "ratio": "speed ratio to SciPy, 1e-14",
    "usual_ratio": "speed ratio to SciPy, 1e-8",
    "slice": "whole slice, s",
    "cost": "sum of squares ≤ SciPy's",
    "same": "same minimum",
    "within": "parameters agree",
    "nearer": "batched nearer",
    "flagged": "warnings",
}
