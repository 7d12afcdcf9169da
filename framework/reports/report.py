"""What a run says at its end: the result table, its numbers as JSON, the pictures, and where to look next."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich.console import Console
from torch.utils.data import Subset

from framework.configuration.assembly import Resolved
from framework.data import Batch, Data
from framework.distributions.circular import angular_distance
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.density import circular_entropy, circular_grid
from framework.evaluation.cost import Cost
from framework.evaluation.splits import Evaluation, cost, evaluate, on_device
from framework.metric import Metric, Pictured
from framework.model import Predictor
from framework.prediction import Prediction
from framework.reports.table import COST_BETTER, COST_COLUMNS, Better, results_table
from framework.runs.run import Run, stored_overrides
from framework.training.batches import Batches

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURED = 128
"""How many test samples the gallery of predicted densities is chosen from."""


def report_test(
    run: Run,
    predictor: Predictor,
    resolved: Resolved,
    data: Data,
    batches: Batches,
    metrics: Sequence[Metric],
    device: torch.device,
    console: Console,
    outliers: Data | None = None,
) -> None:
    """Test, measure the cost, print the table, write results.json and the pictures, tell the tracker.

    Args:
        outliers: prepared, where a metric reads them.
    """
    loader = batches.test_dataloader()
    settings = run.settings
    found = evaluate(
        predictor,
        loader,
        metrics,
        groups=data.groups,
        samples=settings.samples,
        seed=settings.seed,
        device=device,
        outliers=() if outliers is None else batches.of(outliers.splits().test),
    )
    spent = cost(predictor, next(iter(loader)), samples=settings.samples, device=device)
    columns = {key: heading for metric in metrics for key, heading in metric.columns.items()}
    better: Better = {**{key: way for metric in metrics for key, way in metric.better.items()}, **COST_BETTER}
    synthetic = data.synthetic or (outliers is not None and outliers.synthetic)
    results = _results(run, resolved, data, found, spent, columns, better)
    results["synthetic"] = synthetic
    path = run.folder / "results.json"
    path.write_text(json.dumps(results, indent=1), encoding="utf-8")
    step = 0
    run.tracker.log_metrics({f"test/{key}": value for key, value in found.total.items()}, step, 0)
    for name, numbers in found.groups.items():
        run.tracker.log_metrics({f"test/{name}/{key}": value for key, value in numbers.items()}, step, 0)
    run.tracker.log_metrics(
        {
            f"cost/{key}": float(value)
            for key, value in asdict(spent).items()
            if isinstance(value, int | float)
        },
        step,
        0,
    )
    run.tracker.log_artifact(path)
    if settings.pictures:
        for name, figure in _pictures(run, predictor, data, batches, outliers, device, results):
            picture(run, figure, name)
        for metric in found.metrics:
            if isinstance(metric, Pictured):
                figure = metric.figure(results["experiment"], synthetic=synthetic)
                picture(run, figure, f"{metric.picture}.png")
    rows = [
        results,
        *({**results, **numbers, "method": f"  {name}"} for name, numbers in found.groups.items()),
    ]
    title = f"{results['experiment']} on {results['data']}, {len(loader.dataset)} test samples"  # type: ignore[arg-type]
    console.print(
        results_table(rows, {"method": "method", **columns, **COST_COLUMNS}, title=title, better=better)
    )
    _next_steps(run, spent, console)


def _pictures(
    run: Run,
    predictor: Predictor,
    data: Data,
    batches: Batches,
    outliers: Data | None,
    device: torch.device,
    results: dict[str, Any],
) -> Iterator[tuple[str, "Figure"]]:
    """Those that the kind of data calls for, with their file names."""
    if data.target.kind == "angle":
        yield "predicted_densities.png", gallery(predictor, data, batches, device, run.settings.samples)
    if data.target.kind == "class" and data.input_shape == (2,):
        yield "landscape.png", landscape(predictor, data, outliers, device, results["method"])
    elif data.target.kind == "class":
        yield "classified.png", contact_sheet(predictor, data, batches, device)


def _results(
    run: Run,
    resolved: Resolved,
    data: Data,
    found: Evaluation,
    spent: Cost,
    columns: dict[str, str],
    better: Better,
) -> dict[str, Any]:
    name = run.settings.experiment_name
    wrappers = [part["name"] for part in resolved["uncertainty"]]
    if name:  # an experiment's name stands for its own wrappers
        method = name.rpartition("/")[2]
        changed = any(item.lstrip("+~").startswith("uncertainty") for item in stored_overrides(run.folder))
        wrappers = wrappers if changed else []
    else:
        method = str(resolved["density_head"]["name"])
    return {
        "method": " + ".join([method, *wrappers]),
        "experiment": name or "no experiment",
        "data": ", ".join(data.groups),
        "seed": run.settings.seed,
        **{key: _plain(value) for key, value in found.total.items()},
        "groups": {
            name: {k: _plain(v) for k, v in numbers.items()} for name, numbers in found.groups.items()
        },
        **{key: _plain(value) for key, value in asdict(spent).items()},
        "columns": columns,
        "better": better,
        "folder": str(run.folder),
    }


def _plain(value: Any) -> Any:
    """JSON has no NaN: a number that could not be had is null, which tables print as "not available"."""
    return None if isinstance(value, float) and math.isnan(value) else value


def report_training(run: Run, *, kept_epoch: int, synthetic: bool) -> None:
    """The training curve, from the journal; nothing where pictures are not wanted."""
    if not run.settings.pictures:
        return
    from framework.reports.pictures import training_curve

    train: list[tuple[float, float]] = []
    validation: list[tuple[float, float]] = []
    steps_per_epoch = 1.0
    for line in run.tracker.journal.lines():
        if "train/loss" in line.values:
            train.append((line.step, line.values["train/loss"]))
        if "validation/loss" in line.values:
            steps_per_epoch = line.step / (line.epoch + 1)
            validation.append((line.epoch + 1, line.values["validation/loss"]))
    figure = training_curve(
        [step / steps_per_epoch for step, _ in train],
        [loss for _, loss in train],
        validation,
        best_epoch=kept_epoch + 1,
        title=run.settings.experiment_name or "training",
        synthetic=synthetic,
    )
    picture(run, figure, "training_curve.png")


def picture(run: Run, figure: "Figure", name: str) -> Path:
    """Save a figure into the run folder and send it to the store."""
    path = run.folder / "figures" / name
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=110)
    run.tracker.log_artifact(path, "figures")
    return path


@torch.no_grad()
def gallery(
    predictor: Predictor, data: Data, batches: Batches, device: torch.device, samples: int
) -> "Figure":
    """Predicted densities of the first angle on the viewing circle, over their images: certain, ambiguous, failed."""
    from framework.reports.pictures import choose, viewing_circles

    images: list[np.ndarray] = []
    columns: dict[str, list[np.ndarray]] = {
        "density": [],
        "truth": [],
        "point": [],
        "entropy": [],
        "error": [],
        "symmetry": [],
    }
    angles = np.zeros(0)
    for batch in on_device(batches.test_dataloader(), device):
        if len(images) >= PICTURED:
            break
        angles = _collect(predictor, data, batch, samples, images, columns)
    joined = {key: np.concatenate(value, axis=-1) for key, value in columns.items()}
    chosen = choose(joined["entropy"], joined["error"], joined["density"])
    order = [index for row in chosen.values() for index in row]
    symmetry = joined["symmetry"][order]
    return viewing_circles(
        [images[index] for index in order],
        joined["density"][:, order],
        angles,
        joined["truth"][order],
        joined["point"][order],
        [
            _caption(
                float(joined["entropy"][index]),
                float(joined["error"][index]),
                int(joined["symmetry"][index]),
            )
            for index in order
        ],
        modes=[
            _modes(truth, int(fold)) for truth, fold in zip(joined["truth"][order], symmetry, strict=True)
        ],
        rows={name: len(row) for name, row in chosen.items()},
        title=f"{', '.join(data.groups)}: predicted density of the {data.target.names[0]}",
        synthetic=data.synthetic,
    )


@torch.no_grad()
def contact_sheet(predictor: Predictor, data: Data, batches: Batches, device: torch.device) -> "Figure":
    """Classified samples from all over the test split: certain, ambiguous, failed."""
    from framework.reports.class_picture import choose_classified, classified

    dataset = data.splits().test
    length: int = len(dataset)  # pyright: ignore[reportArgumentType]
    some = Subset(dataset, np.unique(np.linspace(0, length - 1, PICTURED).round().astype(int)).tolist())
    inputs: list[torch.Tensor] = []
    probabilities, labels = [np.zeros((0, len(data.target.names)))], [np.zeros(0, np.int64)]
    for batch in on_device(batches.of(some), device):
        probabilities.append(class_probabilities(predictor(batch["input"])).cpu().numpy())
        labels.append(batch["target"].cpu().numpy())
        inputs.extend(batch["input"].cpu())
    probability, label = np.concatenate(probabilities), np.concatenate(labels)
    chosen = choose_classified(probability, label)
    order = [index for row in chosen.values() for index in row]
    return classified(
        [data.picture(inputs[index]) for index in order],
        probability[order],
        label[order],
        data.target.names,
        rows={name: len(row) for name, row in chosen.items()},
        title=f"{', '.join(data.groups)}: samples of the test split",
        synthetic=data.synthetic,
    )


def landscape(
    predictor: Predictor, data: Data, outliers: Data | None, device: torch.device, caption: str
) -> "Figure":
    """The probabilities of a classifier of two inputs over their plane, with test samples and outliers."""
    from framework.reports.landscape_picture import Plane, half_width, landscapes, probabilities

    points, labels = _points_of(data)
    others = _points_of(outliers)[0] if outliers is not None else points[:0]
    plane = Plane(points, labels, others, data.target.names, half_width(points, others))
    return landscapes(
        {caption: probabilities(predictor.cpu(), plane.half_width)},
        plane,
        title=f"{', '.join(data.groups)}: probability landscape",
        synthetic=data.synthetic,
    )


def _points_of(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and targets of the first PICTURED test samples."""
    dataset = data.splits().test
    count = min(PICTURED, len(dataset))  # type: ignore[arg-type]
    items = [dataset[index] for index in range(count)]
    inputs = torch.stack([item["input"] for item in items]).numpy()
    return inputs, torch.stack([item["target"] for item in items]).numpy()


def _caption(entropy: float, error: float, symmetry: int) -> str:
    note = {0: ", no true direction", 1: ""}.get(symmetry, f", {symmetry}-fold symmetric")
    return f"error {math.degrees(error):.0f}°, entropy {entropy:.2f} nats{note}"


def _collect(
    predictor: Predictor,
    data: Data,
    batch: Batch,
    samples: int,
    images: list[np.ndarray],
    columns: dict[str, list[np.ndarray]],
) -> np.ndarray:
    """Add a batch to the columns; the grid angles its densities are given at."""
    prediction = Prediction(predictor(batch["input"]), batch, samples)
    first = prediction.marginal(0)
    images.extend(data.picture(item) for item in batch["input"].cpu())
    angles, log_density = circular_grid(first)
    columns["density"].append(log_density.cpu().numpy())
    columns["entropy"].append(circular_entropy(first).cpu().numpy())
    truth, point = batch["target"][:, 0], prediction.point[:, 0]
    columns["truth"].append(truth.cpu().numpy())
    columns["point"].append(point.cpu().numpy())
    columns["error"].append(angular_distance(truth, point).cpu().numpy())
    symmetry = batch.get("symmetry", torch.ones_like(batch["index"]))
    columns["symmetry"].append(symmetry.cpu().numpy())
    return angles.cpu().numpy()


def _modes(truth: float, symmetry: int) -> np.ndarray:
    """Every angle that is as right as the annotated one; none marked where all angles are."""
    return truth + 2 * math.pi / symmetry * np.arange(symmetry) if symmetry else np.zeros(0)


def _next_steps(run: Run, spent: Cost, console: Console) -> None:
    lines = [
        f"measured on {spent.device}, {spent.threads} threads, batches of {spent.batch_size}; "
        f"one sample alone takes {spent.latency_milliseconds:.2f} ms",
        f"run folder:    {run.folder}   (figures/, results.json, citations.bib, checkpoints/model.ckpt)",
        f"all runs:      {run.tracker.url}",
        f"in a notebook: framework.load('{run.folder}')",
        f"what to cite:  {run.folder / 'citations.bib'}",
    ]
    console.print("\n".join(lines), soft_wrap=True, highlight=False)
