"""Measure how encodings change with shift, rotation and stray points, and how much of a grid is empty (thesis Ch. 6).

    python -m reproduction.chapter6.cloud_encodings

The script takes a minute on one core and writes cloud_encodings.md beside this file. The shapes are the generated CAD
models of data=modelnet40.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.clouds.shapes import shapes
from benchmarks.pages import machine, publish
from framework.geometry.clouds import Normalisation
from framework.reports.table import markdown
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.encoding import encode, prepare_basis
from plugins.encoder.grids.occupancy import occupancy
from plugins.encoder.grids.tdf import truncated_distance

HERE = Path(__file__).resolve()
POINTS = 2048
STEPS = (0.1, 0.01, 0.001)
"""Lengths of a shift in radii of the ball, or angles of a rotation in radians."""
SIDES = (8, 16, 32, 64)
STRAY = ((0.001, 1.0), (0.01, 1.0), (0.1, 1.0), (0.001, 10.0), (0.01, 10.0), (0.1, 10.0), (0.3, 10.0))
"""Share of the points that are moved, and their distance in radii; 1 stands for random places in the ball."""
BASIS = prepare_basis(basis("ball_uniform", 512, 1.0, 13).float())
Encode = Callable[[Tensor], Tensor]
ENCODINGS: dict[str, Encode] = {
    "512 distances": lambda clouds: encode(clouds, BASIS, ["distance"], "none").features["distance"],
    "512 vectors": lambda clouds: encode(clouds, BASIS, ["delta"], "none").features["delta"].flatten(1),
    "32³ occupancy": lambda clouds: occupancy(clouds, 32).float(),
    "8³ occupancy": lambda clouds: occupancy(clouds, 8).float(),
    "32³ truncated distances": lambda clouds: truncated_distance(clouds, 32, 1.0),
    "8³ truncated distances": lambda clouds: truncated_distance(clouds, 8, 1.0),
}


def shift(clouds: Tensor, step: float) -> Tensor:
    """Shift each cloud by a step in a random direction."""
    towards = torch.randn(len(clouds), 1, 3, generator=torch.Generator().manual_seed(1))
    return clouds + step * towards / towards.norm(dim=-1, keepdim=True)


def rotate(clouds: Tensor, step: float) -> Tensor:
    """Rotate clouds about the upright axis by an angle in radians."""
    cosine, sine = math.cos(step), math.sin(step)
    turn = torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=clouds.dtype)
    return clouds @ turn.T


def mean_and_error(values: Tensor) -> tuple[float, float]:
    """Return the mean over shapes and its standard error."""
    numbers = values.double()
    return numbers.mean().item(), (numbers.std() / math.sqrt(len(numbers))).item()


def growth_power(larger: Tensor, smaller: Tensor) -> tuple[float, float]:
    """Return the exponent with which a root mean square over shapes grows with the step, and its standard error.

    The standard error is the jackknife estimate.

    Args:
        larger: squared changes of the shapes at the larger step.
        smaller: squared changes at a step ten times as small.
    """
    whole = (larger.mean() / smaller.mean()).log10().item() / 2
    count = len(larger)
    rest = ((larger.sum() - larger) / (smaller.sum() - smaller)).log10() / 2
    return whole, math.sqrt((count - 1) / count * ((rest - rest.mean()) ** 2).sum().item())


def measure_movement(clouds: Tensor) -> list[dict[str, object]]:
    """Measure how much the features of each encoding change when clouds are shifted or rotated.

    Changes are divided by the mean distance between the features of two different shapes.

    Returns:
        One row for each encoding and kind of movement, by column name.
    """
    rows: list[dict[str, object]] = []
    for name, encoding in ENCODINGS.items():
        before = encoding(clouds)
        shape_distance = (before - before.roll(1, 0)).norm(dim=1).mean()
        for words, move in (("shift", shift), ("rotation", rotate)):
            row: dict[str, object] = {"encoding": name, "move": words, "synthetic": True}
            sizes, largest = [], []
            for step in STEPS:
                change = encoding(move(clouds, step)) - before
                share = change.norm(dim=1) / shape_distance
                row[f"share {step:g}"], row[f"share {step:g}_sem"] = mean_and_error(share)
                sizes.append(share.double())
                largest.append(change.abs().max().item())
            row["power"], row["power_sem"] = growth_power(sizes[-2].square(), sizes[-1].square())
            row["largest"] = largest[-1]
            rows.append(row)
    return rows


def measure_empty(clouds: Tensor) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for side in SIDES:
        share, error = mean_and_error((occupancy(clouds, side) == 0).double().mean(1))
        rows.append({"encoding": f"{side}³ occupancy", "zero": share, "zero_sem": error, "synthetic": True})
    for name in ("512 distances", "32³ truncated distances"):
        features = ENCODINGS[name](clouds)
        empty_value = 0.0 if "512" in name else 1.0  # a truncated distance that is cut off
        share, error = mean_and_error((features == empty_value).double().mean(1))
        rows.append({"encoding": name, "zero": share, "zero_sem": error, "synthetic": True})
    return rows


def move_points(clouds: Tensor, share: float, far: float) -> Tensor:
    """Move a share of each cloud's points: anywhere into the unit ball if `far` is 1, else to the radius `far`."""
    generator = torch.Generator().manual_seed(2)
    count = math.ceil(share * clouds.shape[1])
    towards = torch.randn(len(clouds), count, 3, generator=generator)
    radius = torch.rand(len(clouds), count, 1, generator=generator) ** (1 / 3) if far == 1 else far
    changed = clouds.clone()
    changed[:, :count] = radius * towards / towards.norm(dim=-1, keepdim=True)
    return changed


def measure_recognition(clouds: Tensor) -> list[dict[str, object]]:
    """Measure how often a cloud is recognised after some of its points were moved.

    A disturbed cloud counts as recognised if its features are nearer to those of its undisturbed cloud than to those of
    any other undisturbed cloud.

    Returns:
        One row for each normalisation, with the share of recognised clouds for each disturbance in `STRAY`.
    """
    rows: list[dict[str, object]] = []
    order = torch.randperm(clouds.shape[1], generator=torch.Generator().manual_seed(3))
    clouds = clouds[:, order]  # points of a generated surface are ordered by faces
    for name in ("unit_ball", "robust"):
        normalisation: Normalisation = name  # type: ignore[assignment]
        known = encode(clouds, BASIS, ["distance"], normalisation).features["distance"]
        row: dict[str, object] = {"normalisation": name, "synthetic": True}
        for share, far in STRAY:
            disturbed = encode(move_points(clouds, share, far), BASIS, ["distance"], normalisation).features[
                "distance"
            ]
            recognised = torch.cdist(disturbed, known).argmin(1) == torch.arange(len(clouds))
            key = f"{share:g} {far:g}"
            row[key], row[f"{key}_sem"] = mean_and_error(recognised)
        rows.append(row)
    return rows


def main() -> None:
    torch.set_num_threads(1)
    clouds, _ = shapes(POINTS, 3)
    moved = {
        "encoding": "encoding",
        "move": "motion",
        **{f"share {step:g}": f"change, step {step:g}" for step in STEPS},
        "power": "power of the step",
        "largest": "largest change of one feature",
    }
    empty_columns = {"encoding": "encoding", "zero": "share of features without information"}
    disturbed = {"normalisation": "normalisation"} | {
        f"{share:g} {far:g}": f"{100 * share:g} % {'in the ball' if far == 1 else f'at {far:g} radii'}"
        for share, far in STRAY
    }
    text = (
        "# How encodings change with shift, rotation and stray points (synthetic data)\n\n"
        "This page measures how the features of a point cloud change when the cloud is shifted, rotated or disturbed "
        "by stray points. It compares basis point sets (distances or vectors to the nearest point of the cloud), "
        "occupancy grids and grids of truncated distances. The clouds are "
        f"{len(clouds)} synthetic CAD shapes of {POINTS} points, in the unit ball. ± is the standard error over "
        "shapes. The command is `python -m reproduction.chapter6.cloud_encodings`.\n\n"
        "## Shift and rotation (§6.4.1)\n\n"
        "To measure how smoothly an encoding changes, each cloud is moved by a small step. The columns of changes "
        "show the distance between the features before and after the step, divided by the mean distance between the "
        "features of two different shapes. A step is a shift, in radii of the ball, or a rotation about the upright "
        "axis, in radians. **Power of the step** is the exponent with which the root mean square of this change "
        "grows between the steps 0.001 and 0.01. It is 1 if all features change smoothly. It is 0.5 if some "
        "features jump, and the share of these features is proportional to the step. **Largest change of one "
        "feature** is for the step 0.001.\n\n"
        f"{markdown(measure_movement(clouds), moved)}\n\n"
        "## Empty cells (§6.2, §6.4.1)\n\n"
        "The table shows for each encoding of a point cloud the share of features that carry no information: empty "
        "cells of an occupancy grid, distances of 0, and truncated distances at their upper limit.\n\n"
        f"{markdown(measure_empty(clouds), empty_columns)}\n\n"
        "## Stray points (§6.5.2)\n\n"
        "To measure the effect of stray points, a share of the points of each cloud is moved elsewhere: to random "
        "places in the ball, or to a distance of 10 radii. The table shows the share of disturbed clouds that are "
        "still recognised. A cloud is recognised if its encoding, 512 distances from basis points, is more similar "
        "to the encoding of its own undisturbed cloud than to the encoding of any other undisturbed cloud. The two "
        "rows differ in "
        "how clouds are normalised before the encoding: `unit_ball` scales by the farthest point, `robust` limits "
        "the effect of outliers.\n\n"
        f"{markdown(measure_recognition(clouds), disturbed)}\n\n"
        f"{machine('torch', 'numba')}\n"
    )
    publish(HERE, text)


if __name__ == "__main__":
    main()
