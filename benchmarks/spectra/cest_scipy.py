"""SciPy's least squares of one Z-spectrum after another, in lean NumPy, against all of them at once."""

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
"""SciPy's tolerances: at which its parameters are right to 1e-6, and its default."""


class Lean:
    """Residuals and Jacobian of one spectrum in NumPy, with what both need computed once: SciPy at its best."""

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
        found = np.empty((self.size, len(self.offsets)))
        found[:COUNT] = -self.lines
        weight = self.amplitude * self.half * self.inverse**2
        moved = weight * self.distance
        found[COUNT : 2 * COUNT] = -moved * self.distance
        moved *= -2 * self.half
        found[2 * COUNT] = moved.sum(0)
        found[2 * COUNT + 1 :] = moved[1:] if self.size > 2 * COUNT + 1 else 0
        return found.T


class Timed(NamedTuple):
    """Parameters (voxel, p), half the sum of squares, milliseconds a voxel."""

    parameters: np.ndarray
    cost: np.ndarray
    milliseconds: float


def scipys(
    measured: np.ndarray, offsets: np.ndarray, wanted: Parameters, tolerance: float, most: int | None = None
) -> Timed:
    found, tolerances = [], dict.fromkeys(("ftol", "xtol", "gtol"), tolerance)
    begin = time.process_time()
    for one in measured:
        lean = Lean(one, offsets, len(wanted.names))
        box = (wanted.lower, wanted.upper)
        jacobian: Any = lean.jacobian
        ended = optimize.least_squares(
            lean, wanted.start, jacobian, box, x_scale="jac", max_nfev=most, **tolerances
        )
        found.append((ended.x, ended.cost))
    spent = time.process_time() - begin
    parameters, cost = (np.array(part) for part in zip(*found, strict=True))
    return Timed(parameters, cost, 1e3 * spent / len(measured))


def timed(call: Callable[[], Tensor], voxels: int) -> tuple[Tensor, float]:
    """What it gives, and the middle of three calls' milliseconds a voxel."""
    spent = []
    for _ in range(3):
        begin = time.process_time()
        found = call()
        spent.append(time.process_time() - begin)
    return found, 1e3 * sorted(spent)[1] / voxels


def slope(spectra: Tensor, offsets: Tensor, wanted: Parameters, found: Tensor) -> Tensor:
    """The greatest cosine between residuals and a column of the Jacobian that no bound holds: 0 at a minimum."""
    residuals, jacobian = Misfit(spectra, offsets)(found, torch.arange(len(found)))
    gradient = (jacobian.mT @ residuals.unsqueeze(-1)).squeeze(-1)
    lower, upper = (torch.tensor(side).double() for side in (wanted.lower, wanted.upper))
    near = 1e-6 * (upper - lower)
    held = (found <= lower + near) & (gradient > 0) | (found >= upper - near) & (gradient < 0)
    cosine = gradient / (jacobian.norm(dim=1) * residuals.norm(dim=1, keepdim=True))
    return cosine.masked_fill(held, 0.0).abs().amax(1)


def agreement(file: Path) -> Iterator[dict[str, object]]:
    """Fit the whole slice by SciPy and at once, for each preset; SciPy has a fifth of the voxels in each round."""
    volume = read_volume(file)
    spectra = torch.from_numpy(volume.spectra.astype(np.float32)).double()
    offsets = torch.from_numpy(volume.offsets)
    for name, wanted in PRESETS.items():
        fit(spectra[:512], offsets, wanted)  # to warm up
        parts: list[Timed] = []
        usual, spent = [], []
        ours: Fit | None = None
        for part in range(ROUNDS):
            own = spectra[part::ROUNDS].numpy()
            parts.append(scipys(own, volume.offsets, wanted, TIGHT))
            usual.append(scipys(own[::4], volume.offsets, wanted, ORDINARY).milliseconds)
            begin = time.process_time()
            ours = fit(spectra, offsets, wanted)
            spent.append(1e3 * (time.process_time() - begin) / len(spectra))
        assert ours is not None
        parameters, cost = np.empty((len(spectra), len(wanted.names))), np.empty(len(spectra))
        for part, theirs in enumerate(parts):
            parameters[part::ROUNDS], cost[part::ROUNDS] = theirs.parameters, theirs.cost
        side = np.array(wanted.upper) - np.array(wanted.lower)
        same = (np.abs(ours.cost.numpy() / cost - 1) < 1e-9) & (ours.status.numpy() > 0)
        off = np.abs(ours.parameters.numpy() - parameters)
        off = off / np.maximum(np.abs(parameters), 1e-2 * side)
        apart = same & (off.max(1) >= 1e-6)
        slopes = [
            slope(spectra[apart], offsets, wanted, found)
            for found in (ours.parameters[apart], torch.from_numpy(parameters[apart]))
        ]
        tight, ordinary, batched = (
            Rounds(tuple(times)) for times in ([part.milliseconds for part in parts], usual, spent)
        )
        yield {
            "numbers": f"{len(wanted.names)} ({name})",
            "scipy": tight.text(),
            "usual": ordinary.text(),
            "ours": batched.text(),
            "ratio": batched.times_faster(tight),
            "usual_ratio": batched.times_faster(ordinary),
            "slice": batched.median * len(spectra) / 1e3,
            "cost": f"{100 * np.mean(ours.cost.numpy() <= cost * (1 + 1e-9)):.2f} %",
            "same": f"{100 * same.mean():.2f} %",
            "within": f"{100 * np.mean(off[same].max(1) < 1e-6):.2f} %",
            "nearer": f"{100 * float((slopes[0] < slopes[1]).double().mean()):.0f} %",
            "flagged": int((ours.status <= 0).sum()),
        }


AGREEMENT = {
    "numbers": "numbers fitted",
    "scipy": "SciPy to 1e-14, ms a voxel",
    "usual": "SciPy to 1e-8, ms",
    "ours": "batched, ms",
    "ratio": "ratio to the first",
    "usual_ratio": "ratio to the second",
    "slice": "slice, s",
    "cost": "cost ≤ SciPy's",
    "same": "well-posed, same minimum",
    "within": "of these, all numbers within 1e-6",
    "nearer": "of the others, batched nearer the minimum",
    "flagged": "flagged",
}
