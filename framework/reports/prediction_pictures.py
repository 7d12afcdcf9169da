"""Figures of the predictions for samples of the test split, according to the kind of data."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.distributions import Distribution
from torch.utils.data import Subset

from framework.data import Data
from framework.distributions.circular import angular_distance, wrap
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.density import circular_grid
from framework.distributions.noise import Draw
from framework.evaluation.splits import on_device, predicted
from framework.reports.class_picture import choose_classified, classified
from framework.reports.landscape_picture import Plane, half_width, landscapes, probabilities
from framework.reports.viewing_circles import choose, viewing_circles
from framework.runs.session import Session

PICTURED = 128
"""Number of test samples from which the samples in a figure are chosen."""


UNRESOLVED, DRAWS, TIMES = 0.01, 1000, 10
"""Limit on the error of a grid's total probability, above which the grid does not resolve the density.

The density is then estimated from DRAWS samples, drawn TIMES times.
"""


def prediction_pictures(session: Session) -> Iterator[tuple[str, Figure]]:
    """Yield the names and figures."""
    kind = session.target.kind
    if kind == "angle":
        yield "predicted_densities", _densities(session)
    if kind == "class" and session.data.plane:
        yield "landscape", _landscape(session)
    elif kind == "class":
        yield "classified", _classified(session)


@torch.no_grad()
def _densities(session: Session) -> Figure:
    """Return the figure of the densities of the first angle on the viewing circle.

    The samples are chosen from the first PICTURED samples of the test split.
    """
    predictor, data = session.predictor, session.data
    inputs: list[Tensor] = []
    columns: list[tuple[Tensor, ...]] = []
    angles = torch.zeros(0)
    settings = session.settings
    for number, batch in enumerate(on_device(session.blocks().test_dataloader(), session.device)):
        if len(inputs) >= PICTURED:
            break
        draw = Draw(settings.seed, number)
        prediction = predicted(predictor, batch, settings.samples, draw)
        first = prediction.marginal(0)
        with draw("pictures"):
            angles, log_density = around(first)
        entropy, truth, point = first.entropy(), batch["target"][:, 0], prediction.point[:, 0]
        symmetry = batch.get("symmetry", torch.ones_like(batch["index"]))
        columns.append((log_density, entropy, deviation(truth, point, symmetry), truth, point, symmetry))
        inputs.extend(batch["input"].cpu())
    joined = (torch.cat(some, -1).cpu().numpy() for some in zip(*columns, strict=True))
    log_density, entropy, error, truth, point, symmetry = joined
    chosen = choose(entropy, error, log_density)
    order = [index for row in chosen.values() for index in row]
    return viewing_circles(
        [data.preview(inputs[index]) for index in order],
        log_density[:, order],
        angles.cpu().numpy(),
        np.where(symmetry == 0, np.nan, truth)[order],
        point[order],
        [_caption(error[index], entropy[index], symmetry[index]) for index in order],
        [_equally_true(truth[index], symmetry[index]) for index in order],
        rows={name: len(row) for name, row in chosen.items()},
        title=f"{session.title}: predicted density of {data.target.names[0]}",
        synthetic=data.synthetic,
        directions=data.directions,
    )


@torch.no_grad()
def _classified(session: Session) -> Figure:
    """Return the figure of classified samples, chosen from the whole test split."""
    predictor, data = session.predictor, session.data
    dataset = data.splits().test
    length: int = len(dataset)  # pyright: ignore[reportArgumentType]
    some = Subset(dataset, np.unique(np.linspace(0, length - 1, PICTURED).round().astype(int)).tolist())
    inputs: list[Tensor] = []
    shares, labels = [np.zeros((0, len(data.target.names)))], [np.zeros(0, np.int64)]
    for batch in on_device(session.blocks().of(some), session.device):
        shares.append(class_probabilities(predictor(batch["input"])).cpu().numpy())
        labels.append(batch["target"].cpu().numpy())
        inputs.extend(batch["input"].cpu())
    probability, label = np.concatenate(shares), np.concatenate(labels)
    chosen = choose_classified(probability, label)
    order = [index for row in chosen.values() for index in row]
    return classified(
        [data.preview(inputs[index]) for index in order],
        probability[order],
        label[order],
        data.target.names,
        rows={name: len(row) for name, row in chosen.items()},
        title=f"{session.title}: samples of the test split",
        synthetic=data.synthetic,
    )


def _landscape(session: Session) -> Figure:
    """Return the figure of class probabilities over the plane of the inputs, with test samples and outliers."""
    predictor, data, outliers = session.predictor, session.data, session.outliers
    points, labels = _first(data)
    others = _first(outliers)[0] if outliers is not None else points[:0]
    plane = Plane(points, labels, others, data.target.names, half_width(points, others))
    if len(data.columns) == 2:
        one, two = (f"{name}, as the model reads it" for name in data.columns)
        plane = replace(plane, axes=(one, two))
    return landscapes(
        {"": probabilities(predictor.cpu(), plane.half_width)},
        plane,
        title=f"{session.title}: predictions over the inputs",
        synthetic=data.synthetic,
    )


def around(density: Distribution, points: int = 720) -> tuple[Tensor, Tensor]:
    """Return angles (points,) and the log-density of one angle there, (points, batch), however narrow the density is.

    If the density is too narrow for the grid, it is estimated by the share of draws in each cell of the grid.
    """
    angles, log_density = circular_grid(density, points)
    width = 2 * math.pi / points
    on_grid = DRAWS * TIMES * width * log_density.double().exp()  # expected number of draws
    unresolved = (on_grid.sum(0) / (DRAWS * TIMES) - 1).abs() > UNRESOLVED
    if not bool(unresolved.any()):
        return angles, log_density
    drawn = torch.cat([density.sample(torch.Size((DRAWS,))) for _ in range(TIMES)]).squeeze(-1)
    place = ((wrap(drawn).double() + math.pi) / width).round().long() % points
    found = torch.zeros_like(on_grid).scatter_add_(0, place, torch.ones_like(place, dtype=on_grid.dtype))
    # Values on the grid are kept unless the draws contradict them, so that tails stay smooth.
    wrong = unresolved & ((found - on_grid).abs() > 5 * (on_grid + 1).sqrt())
    return angles, torch.where(wrong, (found / (DRAWS * TIMES * width)).log(), log_density.double())


def deviation(truth: Tensor, point: Tensor, symmetry: Tensor) -> Tensor:
    """Return the angular distance to the nearest of the equally true angles, radians; 0 if all angles are true."""
    folds = symmetry.clamp(min=1)
    return torch.where(symmetry == 0, 0.0, angular_distance(folds * truth, folds * point) / folds)


def _caption(error: float, entropy: float, symmetry: int) -> str:
    """Return the text below a panel."""
    said = f"error {math.degrees(error):.0f}°" if symmetry else "any direction is true"
    note = f", {symmetry}-fold symmetric" if symmetry > 1 else ""
    return f"{said}, entropy {entropy:.2f} nats{note}"


def _equally_true(truth: float, symmetry: int) -> np.ndarray:
    """Return every angle that is as true as the annotated one; none if all angles are true."""
    return truth + 2 * math.pi / symmetry * np.arange(symmetry) if symmetry else np.zeros(0)


def _first(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and targets of the first PICTURED test samples."""
    dataset = data.splits().test
    count = min(PICTURED, len(dataset))  # type: ignore[arg-type]
    items = [dataset[index] for index in range(count)]
    inputs = torch.stack([item["input"] for item in items]).numpy()
    return inputs, torch.stack([item["target"] for item in items]).numpy()
