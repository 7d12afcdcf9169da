"""Figures of predictions for samples of the test split; the kind of target decides which figures are drawn."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.distributions import Distribution
from torch.utils.data import Subset

from framework.data import Batch, Data
from framework.distributions.circular import angular_distance, wrap
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.density import circular_grid
from framework.distributions.noise import Draw
from framework.distributions.protocol import value_set
from framework.evaluation.prediction_sets import set_columns
from framework.evaluation.splits import on_device, predict
from framework.reports.class_picture import choose_classified, draw_classified
from framework.reports.interval_picture import Intervals, draw_intervals
from framework.reports.landscape_picture import Plane, draw_landscapes, half_width, probabilities
from framework.reports.viewing_circles import choose, viewing_circles
from framework.runs.session import Session

PICTURED = 128
"""Number of test samples from which the samples of a figure are chosen."""
MOST_NUMBERS, MASS = 4, 0.9
"""Largest number of real numbers in a target whose intervals are drawn, and the probability of these intervals.

If the model predicts sets of one number with a stated probability, these sets are drawn instead.
"""
POINTS = 720
"""Number of angles at which a density on the circle is drawn."""
UNRESOLVED, DRAWS, TIMES = 0.01, 1000, 10
"""Largest difference from 1 of a density's integral over a grid, at which the grid counts as fine enough.

If the difference is larger, the density is estimated from DRAWS × TIMES random values.
"""


def prediction_pictures(session: Session) -> Iterator[tuple[str, Figure]]:
    """Yield the name and the figure of each plot that exists for the target of the session."""
    kind = session.target.kind
    if kind == "angle":
        yield "predicted_densities", _densities_figure(session)
    if kind == "class" and session.data.plane:
        yield "landscape", _landscape_figure(session)
    elif kind == "class":
        yield "classified", _classified_figure(session)
    if kind == "real" and len(session.target.names) <= MOST_NUMBERS:
        yield "predicted_intervals", _intervals_figure(session)


@torch.no_grad()
def _densities_figure(session: Session) -> Figure:
    """Return the figure of the predicted densities of the first angle, for samples among the first PICTURED ones."""
    predictor, data = session.predictor, session.data
    inputs: list[Tensor] = []
    columns: list[tuple[Tensor, ...]] = []
    angles = torch.zeros(0)
    settings = session.settings
    for number, batch in enumerate(on_device(session.blocks().test_dataloader(), session.device)):
        if len(inputs) >= PICTURED:
            break
        draw = Draw(settings.seed, number)
        prediction = predict(predictor, batch, settings.samples, draw)
        first = prediction.marginal(0)
        with draw("pictures"):
            angles, log_density = log_density_on_circle(first)
        entropy, truth, point = first.entropy(), batch["target"][:, 0], prediction.point[:, 0]
        symmetry = batch.get("symmetry", torch.ones_like(batch["index"]))
        columns.append((log_density, entropy, deviation(truth, point, symmetry), truth, point, symmetry))
        inputs.extend(batch["input"].cpu())
    log_density, entropy, error, truth, point, symmetry = (
        torch.cat(parts, -1).cpu().numpy() for parts in zip(*columns, strict=True)
    )
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
def _classified_figure(session: Session) -> Figure:
    """Return the figure of classified test samples, chosen from PICTURED samples at equal distances in the split."""
    predictor, data = session.predictor, session.data
    inputs: list[Tensor] = []
    shares, labels = [np.zeros((0, len(data.target.names)))], [np.zeros(0, np.int64)]
    for batch in _spread_batches(session):
        shares.append(class_probabilities(predictor(batch["input"])).cpu().numpy())
        labels.append(batch["target"].cpu().numpy())
        inputs.extend(batch["input"].cpu())
    probability, label = np.concatenate(shares), np.concatenate(labels)
    chosen = choose_classified(probability, label)
    order = [index for row in chosen.values() for index in row]
    return draw_classified(
        [data.preview(inputs[index]) for index in order],
        probability[order],
        label[order],
        data.target.names,
        rows={name: len(row) for name, row in chosen.items()},
        title=f"{session.title}: samples of the test split",
        synthetic=data.synthetic,
    )


@torch.no_grad()
def _intervals_figure(session: Session) -> Figure:
    """Return the figure of prediction intervals, for PICTURED samples at equal distances in the test split.

    The intervals are the prediction sets of one number if the model predicts them, and otherwise the central intervals
    with the probability MASS.
    """
    target, settings = session.target, session.settings
    mass, parts = MASS, []
    for number, batch in enumerate(_spread_batches(session)):
        prediction = predict(session.predictor, batch, settings.samples, Draw(settings.seed, number))
        sets = value_set(prediction.density)
        if sets is not None and sets.stated_probability is not None and len(target.names) == 1:
            mass = sets.stated_probability
            columns = set_columns(target, prediction)
            low, high = (
                torch.tensor(columns[f"{target.names[0]}_{end}"])[:, None] for end in ("low", "high")
            )
        else:
            low, high, *_ = prediction.interval(mass)
        parts.append([part.double().cpu().numpy() for part in (low, high, prediction.point, batch["target"])])
    low, high, point, truth = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return draw_intervals(
        [
            Intervals(name, mass, low[:, index], high[:, index], point[:, index], truth[:, index])
            for index, name in enumerate(target.names)
        ],
        title=f"{session.title}: prediction intervals of test samples",
        synthetic=session.data.synthetic,
    )


def _spread_batches(session: Session) -> Iterator[Batch]:
    """Yield batches, on the session's device, of PICTURED samples at equal distances in the test split."""
    dataset = session.data.splits().test
    length: int = len(dataset)  # pyright: ignore[reportArgumentType]
    rows = np.unique(np.linspace(0, length - 1, PICTURED).round().astype(int)).tolist()
    yield from on_device(session.blocks().of(Subset(dataset, rows)), session.device)


def _landscape_figure(session: Session) -> Figure:
    """Return the figure of class probabilities over the plane of the inputs, with test samples and outliers."""
    predictor, data, outliers = session.predictor, session.data, session.outliers
    points, labels = _first(data)
    outlier_points = _first(outliers)[0] if outliers is not None else points[:0]
    plane = Plane(points, labels, outlier_points, data.target.names, half_width(points, outlier_points))
    if len(data.columns) == 2:
        first, second = (f"{name}, as the model reads it" for name in data.columns)
        plane = replace(plane, axes=(first, second))
    return draw_landscapes(
        {"": probabilities(predictor.cpu(), plane.half_width)},
        plane,
        title=f"{session.title}: predictions over the inputs",
        synthetic=data.synthetic,
    )


def log_density_on_circle(density: Distribution) -> tuple[Tensor, Tensor]:
    """Return POINTS angles on the circle, (POINTS,), and the log-densities at these angles, (POINTS, batch), nats.

    If a density is too narrow for this grid, it is estimated from the share of its random values in each grid cell.
    """
    angles, log_density = circular_grid(density, POINTS)
    width = 2 * math.pi / POINTS
    on_grid = DRAWS * TIMES * width * log_density.double().exp()  # expected number of draws
    unresolved = (on_grid.sum(0) / (DRAWS * TIMES) - 1).abs() > UNRESOLVED
    if not bool(unresolved.any()):
        return angles, log_density
    values = torch.cat([density.sample(torch.Size((DRAWS,))) for _ in range(TIMES)]).squeeze(-1)
    cell = ((wrap(values).double() + math.pi) / width).round().long() % POINTS
    counts = torch.zeros_like(on_grid).scatter_add_(0, cell, torch.ones_like(cell, dtype=on_grid.dtype))
    # The grid's values are kept unless the random values contradict them, so that tails stay smooth.
    contradicted = unresolved & ((counts - on_grid).abs() > 5 * (on_grid + 1).sqrt())
    return angles, torch.where(contradicted, (counts / (DRAWS * TIMES * width)).log(), log_density.double())


def deviation(truth: Tensor, point: Tensor, symmetry: Tensor) -> Tensor:
    """Return the distance of a point prediction to the nearest true angle, radians.

    An object with n-fold `symmetry` has n true angles, 2π/n apart. A `symmetry` of 0 means that every angle is true;
    the distance is then 0.
    """
    turns = symmetry.clamp(min=1)
    return torch.where(symmetry == 0, 0.0, angular_distance(turns * truth, turns * point) / turns)


def _caption(error: float, entropy: float, symmetry: int) -> str:
    """Return the text below a panel, with the error (given in radians), the entropy (nats) and the symmetry."""
    error_text = f"error {math.degrees(error):.0f}°" if symmetry else "any direction is true"
    note = f", {symmetry}-fold symmetric" if symmetry > 1 else ""
    return f"{error_text}, entropy {entropy:.2f} nats{note}"


def _equally_true(truth: float, symmetry: int) -> np.ndarray:
    """Return all true angles of an object with n-fold `symmetry`, radians; [] for 0, where every angle is true."""
    return truth + 2 * math.pi / symmetry * np.arange(symmetry) if symmetry else np.zeros(0)


def _first(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and targets of the first PICTURED test samples."""
    dataset = data.splits().test
    count = min(PICTURED, len(dataset))  # type: ignore[arg-type]
    items = [dataset[index] for index in range(count)]
    inputs = torch.stack([item["input"] for item in items]).numpy()
    return inputs, torch.stack([item["target"] for item in items]).numpy()
