"""Pictures of what is predicted for samples of the test split, as the kind of data calls for."""

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
"""How many test samples those that are shown are chosen from."""


UNRESOLVED, DRAWS, TIMES = 0.01, 1000, 10
"""A grid whose mass is off by more does not resolve the density; so many draws, so many times, then do."""


def prediction_pictures(session: Session) -> Iterator[tuple[str, Figure]]:
    """The pictures with their names."""
    kind = session.target.kind
    if kind == "angle":
        yield "predicted_densities", _densities(session)
    if kind == "class" and session.data.plane:
        yield "landscape", _landscape(session)
    elif kind == "class":
        yield "classified", _classified(session)


@torch.no_grad()
def _densities(session: Session) -> Figure:
    """Of the first angle, on the viewing circle over their images, chosen from the first samples of the test split."""
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
        [data.picture(inputs[index]) for index in order],
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
    """Chosen from all over the test split."""
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
        [data.picture(inputs[index]) for index in order],
        probability[order],
        label[order],
        data.target.names,
        rows={name: len(row) for name, row in chosen.items()},
        title=f"{session.title}: samples of the test split",
        synthetic=data.synthetic,
    )


def _landscape(session: Session) -> Figure:
    """Class probabilities over the plane of the inputs, with test samples and outliers."""
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
    """Angles (points,) and the log-density there (points, batch) of one angle, however narrow it is.

    Where it is too narrow for the grid, the share of draws between two of its points stands for the density there.
    """
    angles, log_density = circular_grid(density, points)
    width = 2 * math.pi / points
    on_grid = DRAWS * TIMES * width * log_density.double().exp()  # draws to expect
    unresolved = (on_grid.sum(0) / (DRAWS * TIMES) - 1).abs() > UNRESOLVED
    if not bool(unresolved.any()):
        return angles, log_density
    drawn = torch.cat([density.sample(torch.Size((DRAWS,))) for _ in range(TIMES)]).squeeze(-1)
    place = ((wrap(drawn).double() + math.pi) / width).round().long() % points
    found = torch.zeros_like(on_grid).scatter_add_(0, place, torch.ones_like(place, dtype=on_grid.dtype))
    # what the grid says stands unless the draws contradict it: tails stay smooth
    wrong = unresolved & ((found - on_grid).abs() > 5 * (on_grid + 1).sqrt())
    return angles, torch.where(wrong, (found / (DRAWS * TIMES * width)).log(), log_density.double())


def deviation(truth: Tensor, point: Tensor, symmetry: Tensor) -> Tensor:
    """Angular distance to the nearest angle that is as true as the annotated one, radians; 0 where all angles are."""
    folds = symmetry.clamp(min=1)
    return torch.where(symmetry == 0, 0.0, angular_distance(folds * truth, folds * point) / folds)


def _caption(error: float, entropy: float, symmetry: int) -> str:
    said = f"error {math.degrees(error):.0f}°" if symmetry else "any direction is true"
    note = f", {symmetry}-fold symmetric" if symmetry > 1 else ""
    return f"{said}, entropy {entropy:.2f} nats{note}"


def _equally_true(truth: float, symmetry: int) -> np.ndarray:
    """Every angle that is as right as the annotated one; none marked where all angles are."""
    return truth + 2 * math.pi / symmetry * np.arange(symmetry) if symmetry else np.zeros(0)


def _first(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and targets of the first PICTURED test samples."""
    dataset = data.splits().test
    count = min(PICTURED, len(dataset))  # type: ignore[arg-type]
    items = [dataset[index] for index in range(count)]
    inputs = torch.stack([item["input"] for item in items]).numpy()
    return inputs, torch.stack([item["target"] for item in items]).numpy()
