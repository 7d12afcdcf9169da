"""mode=predict: write point predictions and uncertainties for a user's own files or the test split to a CSV file.

Predicted images are written as files beside the CSV file. So are maps of the predictions, if the data set draws them
(`framework.data.Mapped`).
"""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from framework.configuration.config import Config, Options
from framework.configuration.paths import flatten
from framework.configuration.settings import Settings
from framework.data import Batch, Data, Mapped
from framework.distributions.intervals import DRAWS
from framework.distributions.noise import Draw
from framework.distributions.protocol import value_set
from framework.errors import ConfigError, count_of
from framework.evaluation.prediction_sets import (
    interval_columns,
    require_interval,
    require_matching_set,
    set_columns,
)
from framework.evaluation.splits import BLOCK, predict
from framework.model import Predictor
from framework.prediction import Prediction, table_columns
from framework.runs.run import open_run
from framework.runs.session import Session, for_trained, note_idle_samples
from framework.runs.user_files import UNREADABLE, list_files, print_left_out, select_files
from framework.storage.names import spell_name
from framework.storage.text import defuse_formulas
from framework.target import Target
from framework.training.batches import Batches, track_batches

ERRORS = ("_low_error", "_high_error", "_low_error_deg", "_high_error_deg")
ENDS = ("_low", "_high", "_low_deg", "_high_deg")


class PredictOptions(Options):
    """Options of mode=predict.

    Attributes:
        files: File or folder of files to predict for; None for the test split.
        interval: Probability of the prediction intervals; None for no intervals.
    """

    files: str | None = None
    interval: Annotated[float, Field(gt=0, lt=1)] | None = None


def run(config: Config) -> None:
    """Predict, and write predictions.csv into the run folder."""
    options = config.options(PredictOptions)
    files, folders = list_files(Path(options.files).expanduser()) if options.files else ([], [])
    session = for_trained(config, prepare=not files)
    print_left_out(session.console, "folders", "not looked into", folders)
    if options.interval:
        require_interval(session.target, options.interval, by="mode.interval")
    remark = _apply_budget(session, None if files else session.data, options.interval)
    unreadable: list[Path] = []
    if len(files) > 1:
        files, unreadable = select_files(session.data, files, session.parts["data"], session.console)
    with open_run(session.config) as run:
        if remark:
            run.tracker.set_tags({"budget": remark})
        if unreadable:
            (run.folder / UNREADABLE).write_text(
                "".join(f"{spell_name(file)}\n" for file in unreadable), encoding="utf-8"
            )
        images = run.folder / "images"
        table, mapped = predictions(
            session.predictor,
            session.data,
            session.target,
            files,
            session.settings,
            images,
            options.interval,
            partial(note_idle_samples, session),
        )
        path = run.folder / "predictions.csv"
        with path.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(map(defuse_formulas, table))
            for row in zip(*table.values(), strict=True):
                writer.writerow(map(defuse_formulas, row))
        run.tracker.log_artifact(path)
        origin = "" if files else " for the test split, because mode.files is not set,"
        count = count_of(len(table["sample"]), "prediction")
        session.console.print(f"{count}{origin} in {path}", soft_wrap=True)
        if options.interval and any(key.endswith(ERRORS) for key in table):
            session.console.print(
                f"The ends of intervals with a standard error other than 0 are order statistics of {DRAWS:,} random "
                "values, because the densities have no distribution function. The standard errors are in separate "
                "columns.",
                soft_wrap=True,
            )
        if isinstance(session.data, Mapped) and mapped:
            for map_file in _maps(session.data, files, mapped, run.folder / "maps"):
                run.tracker.log_artifact(map_file, "maps")
            session.console.print(f"maps in {run.folder / 'maps'}", soft_wrap=True)


def _apply_budget(session: Session, data: Data | None, mass: float | None) -> str:
    """Set the knobs of the session's model to meet the command's budget, and print and return the reason.

    Without a budget, the function changes and prints nothing, and returns "".

    Args:
        session: Session of the command.
        data: Prepared data whose validation split is used; None prepares the data of the model.
        mass: Probability of the intervals.

    Raises:
        ConfigError: No setting meets the budget, or the budget sets the batch size.
    """
    budget = session.settings.budget
    if not budget.limits:
        return ""
    if budget.batch_size not in (None, BLOCK):
        raise ConfigError(
            f"budget.batch_size = {budget.batch_size}: mode=predict always predicts {BLOCK} samples at once. Leave "
            "budget.batch_size out."
        )
    from framework.deployment.loaded import apply_budget

    def row(prediction: Prediction) -> None:
        table_columns(session.target, prediction)
        interval_or_set_columns(session.target, prediction, mass)

    assert session.stored is not None
    description = apply_budget(
        session.predictor,
        session.stored,
        budget,
        paths=flatten(session.settings.stored),
        data=data,
        settings=session.settings,
        batch_size=BLOCK,
        work=row,
    )
    remark = description.remarks[-1]
    session.console.print(remark, soft_wrap=True, highlight=False, markup=False)
    return remark


@torch.no_grad()
def predictions(
    predictor: Predictor,
    data: Data,
    target: Target,
    files: Sequence[Path],
    settings: Settings,
    images: Path,
    mass: float | None = None,
    examine: Callable[[Batch], None] = lambda batch: None,
) -> tuple[dict[str, list[str]], list[tuple[Tensor, Tensor]]]:
    """Return the columns of the CSV table by name, and the tensors from which the data set draws maps.

    A row has the name of a sample, the point prediction, the entropy of the density in nats, and the prediction set. If
    the model predicts no sets, the row has the central interval instead. The row also has the standard errors of the
    interval's ends if these are estimated from random values. If the data set draws maps of `files`, the tensors are,
    for each batch, the point predictions and the standard deviations, each (batch, number); otherwise there are no
    tensors.

    Args:
        predictor: Trained predictor.
        data: Data set that reads the files, or whose test split is predicted.
        target: Target that is predicted.
        files: Files to predict for; empty for the test split.
        settings: Settings of the command, of which `seed`, `samples` and `workers` are used.
        images: Folder for predicted images; the row then contains the name of the image file.
        mass: Probability of the interval; None leaves it out.
        examine: Function that is called with the first batch.
    """
    dataset = data.read(files) if files else data.splits().test
    loader = Batches(data, batch_size=BLOCK, workers=settings.workers, seed=settings.seed).of(dataset)
    names = _names(data, files, len(dataset))  # type: ignore[arg-type]
    cells: dict[str, list[str]] = {}
    mapped: list[tuple[Tensor, Tensor]] = []
    for number, batch in enumerate(track_batches(loader, "predicting")):
        if number == 0:
            examine(batch)
        prediction = predict(predictor, batch, settings.samples, Draw(settings.seed, number))
        prediction = prediction.in_frame(data.frame(batch))
        columns: dict[str, Sequence[Any] | Tensor] = {}
        if target.kind == "class":
            columns["class"] = [target.names[label] for label in prediction.point.long().tolist()]
        elif target.kind == "image":
            columns["image"] = _write_images(prediction.image("color"), images, number * BLOCK)
        columns |= table_columns(target, prediction)
        if isinstance(data, Mapped) and files:
            mapped.append((prediction.point.cpu(), prediction.deviation().cpu()))
        columns |= interval_or_set_columns(target, prediction, mass)
        for key, column in columns.items():
            cells.setdefault(key, []).extend(format_cells(column, key))
    errors = [key for key in cells if key.endswith(ERRORS)] if mass else []
    if all(cell == "0" for key in errors for cell in cells[key]):
        for key in errors:
            del cells[key]
    return {"sample": names, **cells}, mapped


def _write_images(batch: Tensor, folder: Path, first: int) -> list[str]:
    """Write a batch of images in linear RGB to a folder, numbered from `first`; return their names in the table."""
    from framework.datasets.png import encode_png  # imports Pillow, which other targets do not need

    folder.mkdir(exist_ok=True)
    names = [f"{number:05}.png" for number in range(first, first + len(batch))]
    for name, image in zip(names, batch, strict=True):
        (folder / name).write_bytes(encode_png(image))
    return [f"{folder.name}/{name}" for name in names]


def interval_or_set_columns(
    target: Target, prediction: Prediction, mass: float | None
) -> Mapping[str, Sequence[Any] | Tensor]:
    """Return the columns of the prediction sets or, if the model has none, of the intervals of probability `mass`.

    If the model has no sets and `mass` is None, there are no columns.

    Raises:
        ConfigError: the prediction sets have no ends, or not the probability `mass`.
    """
    sets = value_set(prediction.density)
    if sets is None:
        return interval_columns(target, prediction.interval(mass)) if mass else {}
    if mass:
        require_matching_set(sets, mass, by="mode.interval")
    return set_columns(target, prediction)


def _maps(
    data: Mapped, files: Sequence[Path], mapped: Sequence[tuple[Tensor, Tensor]], folder: Path
) -> Iterator[Path]:
    folder.mkdir(exist_ok=True)
    counts = [len(data.read([file])) for file in files]  # type: ignore[attr-defined]
    parts = (torch.cat(part).split(counts) for part in zip(*mapped, strict=True))
    for file, point, deviation in zip(files, *parts, strict=True):
        yield from data.write_maps(file, point, deviation, folder)


def _names(data: Data, files: Sequence[Path], samples: int) -> list[str]:
    """Return a name for each sample: its file, with the row if files have several; without files, "test <number>"."""
    if not files:
        return [f"test {number}" for number in range(samples)]
    if samples == len(files):
        return [spell_name(file) for file in files]
    counts = [samples] if len(files) == 1 else [len(data.read([file])) for file in files]  # type: ignore[arg-type]
    return [
        f"{name} row {row}"
        for name, count in zip(map(spell_name, files), counts, strict=True)
        for row in range(count)
    ]


def format_cells(column: Sequence[Any] | Tensor, key: str) -> Iterator[str]:
    """Yield the texts of a column, with 15 significant digits for the ends of intervals and 10 for other numbers.

    The ends of an interval need more digits, because they may differ little compared with their size in the user's
    unit. `key` is the name of the column, which tells whether it holds such ends.
    """
    pattern = "%.15g" if key.endswith(ENDS) else "%.10g"
    for value in column.tolist() if isinstance(column, Tensor) else column:
        yield value if isinstance(value, str) else pattern % value
