"""mode=work_precision: error against run time along a declared knob of a trained model."""

from dataclasses import asdict
from typing import Annotated, Any

import torch
from pydantic import Field
from rich.console import Console

from framework.configuration.assembly import build_metrics
from framework.configuration.config import Config, Options
from framework.configuration.settings import Positive
from framework.data import Batch, Data
from framework.density_head import DensityHead
from framework.errors import ConfigError, did_you_mean
from framework.evaluation.splits import on_device
from framework.evaluation.work_precision import COLUMNS, rows, work_precision, write
from framework.model import Model, Predictor
from framework.reports.report import picture
from framework.reports.table import results_table
from framework.runs.run import Run, opened
from framework.runs.session import Session, for_trained
from framework.training.batches import Batches
from framework.uncertainty import Uncertainty


class WorkPrecisionOptions(Options):
    """Which knob is turned, to which values, and what is measured."""

    knob: str | None = None
    values: list[Positive] | None = None
    repeats: Annotated[int, Field(ge=2)] = 5
    reference: Positive = 10_000
    limit: Positive = 200
    metrics: list[str] | None = None


def run(config: Config) -> None:
    """Write work_precision.csv and .png; print the table with Pareto points marked."""
    options = config.options(WorkPrecisionOptions)
    session = for_trained(config)
    with opened(config) as run:
        session.record(run)
        _run(run, session, options)


def _run(run: Run, session: Session, options: WorkPrecisionOptions) -> None:
    from framework.reports import pictures

    predictor, data, described = session.predictor, session.data, {"config": session.parts}
    if options.metrics is not None or not isinstance(predictor, Model):
        _metrics_against_time(run, options, predictor, data, described)
        return
    knobs = predictor.head.knobs
    knob = options.knob or next(iter(knobs), "")
    settings = run.settings
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    predictor.to(device)
    kept = _kept(run, data, device, options.limit)
    curve = work_precision(
        predictor,
        kept,
        knob=knob,
        values=options.values or knobs.get(knob, ()),
        reference=options.reference,
        repeats=options.repeats,
        seed=settings.seed,
    )
    name = described["config"]["density_head"]["name"]
    path = run.folder / "work_precision.csv"
    write({name: curve}, path, synthetic=data.synthetic)
    run.tracker.log_artifact(path)
    for point in curve.points:
        numbers = {key: value for key, value in asdict(point).items() if isinstance(value, float)}
        run.tracker.log_metrics(
            {f"work_precision/{key}": value for key, value in numbers.items()}, int(point.value), 0
        )
    figure = pictures.work_precision(
        {name: curve.points},
        title=f"{name} on {', '.join(data.groups)}: error against run time along {knob}",
        synthetic=data.synthetic,
        reference_error=curve.reference.standard_error,
    )
    where = picture(run, figure, "work_precision.png")
    console = Console()
    console.print(
        results_table(
            rows({name: curve}, synthetic=data.synthetic), COLUMNS, title=f"{name}: {curve.samples} samples"
        )
    )
    console.print(f"{path}\n{where}", soft_wrap=True, highlight=False)


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


def _metrics_against_time(
    run: Run, options: WorkPrecisionOptions, predictor: Predictor, data: Data, described: dict[str, Any]
) -> None:
    """The metrics of the test split themselves, where there is no reference to be off from: of wrappers, say."""
    from framework.evaluation import tradeoff
    from framework.reports import tradeoff_picture

    config = described["config"]
    metrics = [metric for metric in build_metrics(config, data.target) if "outliers" not in metric.splits]
    headings = {key: heading for metric in metrics for key, heading in metric.columns.items()}
    lower = {key: way == "lower" for metric in metrics for key, way in metric.better.items()}
    keys = options.metrics or [key for key in headings if key in lower]
    for key in keys:
        if key not in lower:
            raise ConfigError(
                f"mode.metrics: no metric gives {key!r} and says which way it is better.{did_you_mean(key, lower)} "
                f"There are: {', '.join(lower) or 'none; choose some with metric=[...]'}."
            )
    parts = [part for part in predictor.modules() if isinstance(part, Uncertainty | DensityHead)]
    knob = options.knob or next((name for part in parts for name in part.knobs), "")
    values = options.values or tradeoff.owners(predictor, knob)[0].knobs[knob]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    predictor.to(device)
    turns = tradeoff.tradeoff(
        predictor,
        _kept(run, data, device, options.limit),
        metrics,
        knob=knob,
        values=values,
        samples=run.settings.samples,
        seed=run.settings.seed,
        repeats=options.repeats,
    )
    name = " + ".join([config["density_head"]["name"], *(part["name"] for part in config["uncertainty"])])
    found = tradeoff.rows({name: turns}, keys, lower, synthetic=data.synthetic)
    path = run.folder / "work_precision.csv"
    tradeoff.write(found, path)
    run.tracker.log_artifact(path)
    for turn in turns:
        numbers = {**{key: turn.metrics[key] for key in keys}, "milliseconds": turn.milliseconds}
        run.tracker.log_metrics(
            {f"work_precision/{key}": value for key, value in numbers.items()}, turn.value, 0
        )
    figure = tradeoff_picture.tradeoff(
        {name: turns},
        {key: headings[key] for key in keys},
        title=f"{name} on {', '.join(data.groups)}: metrics against run time along {knob}",
        synthetic=data.synthetic,
        note=tradeoff.device_note(predictor),
    )
    where = picture(run, figure, "work_precision.png")
    console = Console()
    columns = {
        "method": "method",
        "value": knob,
        **{key: headings[key] for key in keys},
        "milliseconds_per_sample": "ms / sample",
    }
    console.print(results_table(found, columns, title=f"{name}: {options.limit} samples at most"))
    console.print(f"{path}\n{where}", soft_wrap=True, highlight=False)
