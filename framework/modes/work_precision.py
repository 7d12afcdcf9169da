"""mode=work_precision: error against run time along a declared knob of a trained model."""

from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console

from framework.configuration.assembly import build_metrics
from framework.configuration.schema import check
from framework.configuration.settings import Positive, Settings
from framework.data import Batch, Data
from framework.density_head import DensityHead
from framework.errors import ConfigError, did_you_mean
from framework.evaluation import reference
from framework.evaluation.splits import on_device
from framework.evaluation.tradeoff import first_knob, owners, rows, tradeoff
from framework.metric import Metric
from framework.modes.test import loaded
from framework.reports.report import picture
from framework.reports.table import Better, csv, results_table
from framework.runs.run import Run, opened
from framework.training.batches import Batches

ERROR, AXIS = "error_nats", "error of the mean log-likelihood (nats, RMS)"
"""What is drawn of a head's knob where no metrics are named, and the label of its axis."""


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str
    knob: str | None = None
    values: list[Positive] | None = None
    repeats: Annotated[int, Field(ge=2)] = 5
    reference: Positive = 10_000
    limit: Positive = 200
    metrics: list[str] | None = None


def run(values: dict[str, Any], settings: Settings, folder: Path, overrides: list[str]) -> None:
    """Write work_precision.csv and .png; print the table with Pareto points marked."""
    with opened(folder, values, settings, overrides) as run:
        _run(run, _Options.model_validate(check(_Options, values["mode"], "mode")))


def _run(run: Run, options: _Options) -> None:
    from framework.reports.tradeoff_picture import Floor, error_against_run_time

    predictor, data, described = loaded(run)
    config, settings = described["config"], run.settings
    metrics = [metric for metric in build_metrics(config, data.target) if "outliers" not in metric.splits]
    knob = options.knob or first_knob(predictor)
    parts = owners(predictor, knob)
    better = _chosen(options.metrics, metrics, own=isinstance(parts[0], DensityHead))
    measured = [key for key in better if key not in reference.COLUMNS]
    compared = len(measured) < len(better)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    predictor.to(device)
    curve = tradeoff(
        predictor,
        _kept(run, data, device, options.limit),
        metrics if measured else (),
        knob=knob,
        values=options.values or parts[0].knobs[knob],
        reference=options.reference if compared else None,
        samples=settings.samples,
        repeats=options.repeats,
        seed=settings.seed,
    )
    name = " + ".join([config["density_head"]["name"], *(part["name"] for part in config["uncertainty"])])
    found = rows({name: curve}, better, synthetic=data.synthetic)
    path = run.folder / "work_precision.csv"
    csv(found, None, path)
    run.tracker.log_artifact(path)
    for row, point in zip(found, curve.points, strict=True):
        numbers = {key: value for key, value in point.numbers.items() if key in row}
        numbers["milliseconds"] = point.milliseconds
        run.tracker.log_metrics(
            {f"work_precision/{key}": value for key, value in numbers.items()}, point.value, 0
        )
    headings = {key: heading for metric in metrics for key, heading in metric.columns.items()}
    headings = (reference.COLUMNS if compared else {}) | {key: headings[key] for key in measured}
    floors = {}
    if curve.reference is not None:
        error = curve.reference.standard_error
        floors[ERROR] = Floor(error, f"below {error:.1g} nats the reference itself is uncertain")
    figure = error_against_run_time(
        found,
        {key: AXIS if key == ERROR else headings[key] for key in better},
        better,
        title=f"{name} on {', '.join(data.groups)}: {'metrics' if measured else 'error'} against run time along {knob}",
        synthetic=data.synthetic,
        floors=floors,
        note=f"{curve.device}, {curve.threads} threads",
    )
    where = picture(run, figure, "work_precision.png")
    columns = {"method": "method", "value": knob, **headings, "milliseconds_per_sample": "ms / sample"}
    for key in better:
        columns[f"{key}_pareto"] = "Pareto" if len(better) == 1 else f"Pareto: {headings[key]}"
    console = Console()
    console.print(results_table(found, columns, title=f"{name}: {curve.samples} samples"))
    console.print(f"{path}\n{where}", soft_wrap=True, highlight=False)


def _chosen(names: list[str] | None, metrics: list[Metric], *, own: bool) -> Better:
    """The keys to measure, and which way they are better.

    Args:
        names: the keys asked for; None: the error against a reference, or every metric where the knob is not the
            model's `own`, its head's.

    Raises:
        ConfigError: nothing of such a name says which way it is better.
    """
    known: dict[str, Literal["higher", "lower"]] = {
        key: metric.better[key] for metric in metrics for key in metric.columns if key in metric.better
    }
    keys = names or ([ERROR] if own else list(known))
    known |= reference.BETTER
    for key in keys:
        if key not in known:
            raise ConfigError(
                f"mode.metrics: no metric gives {key!r} and says which way it is better.{did_you_mean(key, known)} "
                f"There are: {', '.join(known)}."
            )
    if not keys:
        raise ConfigError("No metric says which way it is better; choose some with metric=[...].")
    return {key: known[key] for key in keys}


def _kept(run: Run, data: Data, device: torch.device, limit: int) -> list[Batch]:
    """The first `limit` test samples, in batches."""
    settings = run.settings
    batches = Batches(data, batch_size=settings.batch_size, workers=settings.workers, seed=settings.seed)
    kept, seen = [], 0
    for batch in on_device(batches.test_dataloader(), device):
        kept.append({name: tensor[: limit - seen] for name, tensor in batch.items()})
        seen += len(kept[-1]["index"])
        if seen >= limit:
            break
    return kept
