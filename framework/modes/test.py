"""mode=test: test a trained model again, on its own data or on other data."""

from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from framework.configuration.assembly import (
    build_data,
    build_metrics,
    build_outliers,
    citations,
    require_outliers,
)
from framework.configuration.schema import resolve
from framework.configuration.settings import Settings
from framework.data import Data
from framework.errors import CheckpointError, ConfigError
from framework.model import Predictor
from framework.modes.train import describe_data, record_citations
from framework.reports.report import report_test
from framework.runs.loading import load_with_description
from framework.runs.run import Run, opened
from framework.training.batches import Batches


def run(values: dict[str, Any], settings: Settings, folder: Path, overrides: list[str]) -> None:
    """Print the table row of `checkpoint`."""
    with opened(folder, values, settings, overrides) as run:
        predictor, data, described = loaded(run)
        record_citations(run, citations(described["config"]))
        batches = Batches(data, batch_size=settings.batch_size, workers=settings.workers, seed=settings.seed)
        metrics = build_metrics(described["config"], data.target)
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        outliers = build_outliers(described["config"], data)
        config = described["config"]
        report_test(run, predictor, config, data, batches, metrics, device, Console(), outliers)


def loaded(run: Run, *, prepare: bool = True) -> tuple[Predictor, Data, dict[str, Any]]:
    """The model of `checkpoint`, with the data named on the command line, or else the data it was trained on.

    Without `prepare` the data can only read a user's own files: nothing is generated or loaded for that.

    Raises:
        ConfigError: no checkpoint is named.
        CheckpointError: the data does not fit the model.
    """
    settings = run.settings
    if settings.threads:
        torch.set_num_threads(settings.threads)
    if settings.checkpoint is None:
        raise ConfigError(
            f"mode={run.values['mode']['name']} needs checkpoint=<run folder, checkpoint file or MLflow run id>."
        )
    predictor, described = load_with_description(settings.checkpoint, uri=settings.logger.uri)
    return predictor, data_for(run, described, settings.checkpoint, prepare=prepare), described


def data_for(run: Run, described: dict[str, Any], source: str, *, prepare: bool = True) -> Data:
    """The data to test a stored model on; what the command line says of data, outliers and metrics goes into
    `described`.

    Raises:
        ConfigError: a metric wants outliers and there are none.
        CheckpointError: the data does not fit the model of `source`.
    """
    if run.values.get("data"):
        described["config"]["data"] = resolve("data", run.values["data"])
    if run.values.get("metric"):
        chosen = run.values["metric"]
        described["config"]["metric"] = [
            resolve("metric", part, f"metric.{key}") for key, part in chosen.items()
        ]
    if run.values.get("outliers"):
        described["config"]["outliers"] = resolve("data", run.values["outliers"], "outliers")
    require_outliers(described["config"])
    data = build_data({"data": resolve("data", described["config"]["data"])})
    if not prepare:
        return data
    data.prepare()
    describe_data(run, data)
    wanted = (
        tuple(described["input_shape"]),
        described["target"]["kind"],
        tuple(described["target"]["names"]),
    )
    found = (data.input_shape, data.target.kind, data.target.names)
    if wanted != found:
        raise CheckpointError(
            f"{source} reads inputs of shape {wanted[0]} and predicts {wanted[1]} {wanted[2]}, but the "
            f"data has inputs of shape {found[0]} and targets {found[1]} {found[2]}. Give the data it was trained on."
        )
    return data
