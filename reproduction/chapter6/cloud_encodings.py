"""Measure how encodings change with shift, rotation and stray points, and how much of a grid is empty (thesis Ch. 6).

    python -m reproduction.chapter6.cloud_encodings

Writes cloud_encodings.md beside this file; a minute on one core. Shapes are the generated CAD models of
data=modelnet40.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import math
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.clouds.shapes import shapes
from benchmarks.pages import machine, write_page
from framework.geometry.clouds import Normalisation
from framework.reports.table import markdown
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.encoding import encode, prepared
from plugins.encoder.grids.occupancy import occupancy
from plugins.encoder.grids.tdf import truncated_distance

HERE = Path(__file__).resolve()
POINTS = 2048
STEPS = (0.1, 0.01, 0.001)
"""Of a shift, in radii of the ball; of a turn, in radians."""
SIDES = (8, 16, 32, 64)
STRAY = ((0.001, 1.0), (0.01, 1.0), (0.1, 1.0), (0.001, 10.0), (0.01, 10.0), (0.1, 10.0), (0.3, 10.0))
"""Shares of a cloud's points that are replaced, and how far off in radii: in the ball, or ten of them away."""
BASIS = prepared(basis("ball_uniform", 512, 1.0, 13).float())
Encode = Callable[[Tensor], Tensor]
ENCODINGS: dict[str, Encode] = {
    "512 distances": lambda clouds: encode(clouds, BASIS, ["distance"], "none").features["distance"],
    "512 vectors": lambda clouds: encode(clouds, BASIS, ["delta"], "none").features["delta"].flatten(1),
    "32³ occupancy": lambda clouds: occupancy(clouds, 32).float(),
    "8³ occupancy": lambda clouds: occupancy(clouds, 8).float(),
    "32³ truncated distances": lambda clouds: truncated_distance(clouds, 32, 1.0),
    "8³ truncated distances": lambda clouds: truncated_distance(clouds, 8, 1.0),
}


def shifted(clouds: Tensor, step: float) -> Tensor:
    """In a direction of each cloud's own."""
    towards = torch.randn(len(clouds), 1, 3, generator=torch.Generator().manual_seed(1))
    return clouds + step * towards / towards.norm(dim=-1, keepdim=True)


def turned(clouds: Tensor, step: float) -> Tensor:
    """About the upright axis."""
    cosine, sine = math.cos(step), math.sin(step)
    turn = torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=clouds.dtype)
    return clouds @ turn.T


def mean(values: Tensor) -> tuple[float, float]:
    """And its standard error over shapes."""
    found = values.double()
    return found.mean().item(), (found.std() / math.sqrt(len(found))).item()


def power(larger: Tensor, smaller: Tensor) -> tuple[float, float]:
    """Of the step, by which a root mean square over shapes grows over its last decade; its jackknife standard error.

    Args:
        larger, smaller: squares at both ends of that decade.
    """
    whole = (larger.mean() / smaller.mean()).log10().item() / 2
    count = len(larger)
    rest = ((larger.sum() - larger) / (smaller.sum() - smaller)).log10() / 2
    return whole, math.sqrt((count - 1) / count * ((rest - rest.mean()) ** 2).sum().item())


def movement(clouds: Tensor) -> list[dict[str, object]]:
    """By how much features change, as a share of how much they differ between two shapes (root mean squares)."""
    rows: list[dict[str, object]] = []
    for name, made in ENCODINGS.items():
        before = made(clouds)
        apart = (before - before.roll(1, 0)).norm(dim=1).mean()
        for words, move in (("shift", shifted), ("turn", turned)):
            row: dict[str, object] = {"encoding": name, "move": words, "synthetic": True}
            sizes, largest = [], []
            for step in STEPS:
                change = made(move(clouds, step)) - before
                share = change.norm(dim=1) / apart
                row[f"share {step:g}"], row[f"share {step:g}_sem"] = mean(share)
                sizes.append(share.double())
                largest.append(change.abs().max().item())
            row["power"], row["power_sem"] = power(sizes[-2].square(), sizes[-1].square())
            row["largest"] = largest[-1]
            rows.append(row)
    return rows


def empty(clouds: Tensor) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for side in SIDES:
        share, error = mean((occupancy(clouds, side) == 0).double().mean(1))
        rows.append({"encoding": f"{side}³ occupancy", "zero": share, "zero_sem": error, "synthetic": True})
    for name in ("512 distances", "32³ truncated distances"):
        found = ENCODINGS[name](clouds)
        nothing = 0.0 if "512" in name else 1.0  # a truncated distance that is cut off
        share, error = mean((found == nothing).double().mean(1))
        rows.append({"encoding": name, "zero": share, "zero_sem": error, "synthetic": True})
    return rows


def strayed(clouds: Tensor, share: float, far: float) -> Tensor:
    """Some of each cloud's points put elsewhere: within the ball where `far` is 1, else so far off."""
    generator = torch.Generator().manual_seed(2)
    count = math.ceil(share * clouds.shape[1])
    towards = torch.randn(len(clouds), count, 3, generator=generator)
    radius = torch.rand(len(clouds), count, 1, generator=generator) ** (1 / 3) if far == 1 else far
    changed = clouds.clone()
    changed[:, :count] = radius * towards / towards.norm(dim=-1, keepdim=True)
    return changed


def stray(clouds: Tensor) -> list[dict[str, object]]:
    """Of how many disturbed clouds the code is still nearest to that of the same cloud undisturbed."""
    rows: list[dict[str, object]] = []
    order = torch.randperm(clouds.shape[1], generator=torch.Generator().manual_seed(3))
    clouds = clouds[:, order]  # the points of a generated surface come face by face
    for how in ("unit_ball", "robust"):
        normalisation: Normalisation = how  # type: ignore[assignment]
        known = encode(clouds, BASIS, ["distance"], normalisation).features["distance"]
        row: dict[str, object] = {"normalisation": how, "synthetic": True}
        for share, far in STRAY:
            asked = encode(strayed(clouds, share, far), BASIS, ["distance"], normalisation).features[
                "distance"
            ]
            found = torch.cdist(asked, known).argmin(1) == torch.arange(len(clouds))
            key = f"{share:g} {far:g}"
            row[key], row[f"{key}_sem"] = mean(found)
        rows.append(row)
    return rows


def main() -> None:
    torch.set_num_threads(1)
    clouds, _ = shapes(POINTS, 3)
    moved = {
        "encoding": "encoding",
        "move": "move",
        **{f"share {step:g}": f"step {step:g}" for step in STEPS},
        "power": "power of the step",
        "largest": f"largest change of one number, step {STEPS[-1]:g}",
    }
    disturbed = {"normalisation": "normalisation"} | {
        f"{share:g} {far:g}": f"{100 * share:g} % {'in the ball' if far == 1 else f'{far:g} radii off'}"
        for share, far in STRAY
    }
    text = (
        "# How encodings change with shift, rotation and stray points (synthetic data)\n\n"
        f"`python -m reproduction.chapter6.cloud_encodings`: {len(clouds)} synthetic CAD shapes of {POINTS} points, "
        "in the unit ball. ± is the standard error over shapes.\n\n"
        "**Shift and rotation** (§6.4.1). The change of the features relative to the mean distance between two shapes' "
        "features, for steps in radii or radians; and the power of the step with which its root mean square grows over "
        "the last decade. The power is 1 for smooth features and 0.5 where some features jump with each step.\n\n"
        f"{markdown(movement(clouds), moved)}\n\n"
        "**Empty cells** (§6.2, §6.4.1). The share of features without information: empty cells of an occupancy grid, "
        "distances of 0, truncated distances that are cut off.\n\n"
        f"{markdown(empty(clouds), {'encoding': 'encoding', 'zero': 'share'})}\n\n"
        "**Stray points** (§6.5.2). A share of each cloud's points is moved elsewhere. The table shows how many clouds "
        "are still recognised: their 512 distances are nearest to those of the same cloud without stray points.\n\n"
        f"{markdown(stray(clouds), disturbed)}\n\n"
        f"{machine('torch', 'numba')}\n"
    )
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
