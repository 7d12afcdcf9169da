"""mode=work_precision: error against run time along a declared knob of a trained head."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console

from framework.batches import Batches
from framework.errors import ConfigError
from framework.evaluation import on_device
from framework.model import Model
from framework.modes.test import loaded
from framework.report import picture
from framework.run import Run, opened
from framework.schema import check
from framework.settings import Positive, Settings
from framework.table import results_table
from framework.work_precision import COLUMNS, rows, work_precision, write


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str
    knob: str | None = None
    values: list[Positive] | None = None
    repeats: Annotated[int, Field(ge=2)] = 5
    reference: Positive = 10_000
    limit: Positive = 200


def run(values: dict[str, Any], settings: Settings, folder: Path, overrides: list[str]) -> None:
    """Write work_precision.csv and .png; print the table with Pareto points marked."""
    with opened(folder, values, settings, overrides) as run:
        _run(run, _Options.model_validate(check(_Options, values["mode"], "mode")))


def _run(run: Run, options: _Options) -> None:
    from framework import pictures

    predictor, data, described = loaded(run)
    if not isinstance(predictor, Model):
        raise ConfigError("mode=work_precision wants a model without an uncertainty wrapper around it.")
    knobs = predictor.head.knobs
    knob = options.knob or next(iter(knobs), "")
    settings = run.settings
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    predictor.to(device)
    batches = Batches(data, batch_size=settings.batch_size, workers=settings.workers, seed=settings.seed)
    kept, seen = [], 0
    for batch in on_device(batches.test_dataloader(), device):
        kept.append({name: tensor[: options.limit - seen] for name, tensor in batch.items()})
        seen += len(kept[-1]["index"])
        if seen >= options.limit:
            break
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
