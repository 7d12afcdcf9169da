"""Records, settings and speed of the runs of a sweep, for benchmark scripts."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

if TYPE_CHECKING:
    from framework.training.batches import Batches


class Run(NamedTuple):
    """A finished run: its folder, and the content of its results.json."""

    folder: Path
    results: dict[str, Any]

    def config(self) -> dict[str, Any]:
        """Return the configuration of the run."""
        return yaml.safe_load((self.folder / "config.yaml").read_text(encoding="utf-8"))


def read_runs(*sweeps: str | Path) -> list[Run]:
    """Return the finished runs of sweeps: one sweep after the other, the runs of each sweep by the names of folders."""
    paths = [path for sweep in sweeps for path in sorted(Path(sweep).glob("*/results.json"))]
    return [Run(path.parent, json.loads(path.read_text(encoding="utf-8"))) for path in paths]


def record(run: Path) -> dict[str, Any]:
    """Return the record of a job from its folder (framework.sweeps.jobs); empty for a run outside a sweep."""
    path = run / "job.json"
    if not path.exists():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))


def processor_seconds(job: Mapping[str, Any]) -> float:
    """Return the processor time of a whole job in seconds; NaN if the record does not have it."""
    seconds = job.get("processor_seconds")
    return math.nan if seconds is None else float(seconds)


def wall_seconds(job: Mapping[str, Any]) -> float:
    """Return the wall time of a whole job in seconds; NaN if the record does not have its end."""
    return job["ended"] - job["started"] if "ended" in job else math.nan


def settings(runs: Iterable[Path], *keys: str) -> list[str]:
    """Return the different values of each setting over the configurations of the runs, such as "15" or "15 and 30".

    Args:
        runs: folders of the runs.
        keys: names of the settings, such as "trainer.max_epochs"; the result has one text for each.
    """
    configs = [yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8")) for run in runs]
    texts = []
    for key in keys:
        values = set()
        for config in configs:
            for part in key.split("."):
                config = config[part]
            values.add(config)
        texts.append(" and ".join(str(value) for value in sorted(values)))
    return texts


def milliseconds_per_sample(run: Path, loaders: "dict[str, Batches]", batch: int = 16) -> float:
    """Return the milliseconds per sample, in a batch, for the density and the point prediction of a run's model.

    Args:
        run: folder of the run.
        loaders: cache of the loaders of the data sets, by their settings; a missing one is added.
        batch: samples of a batch.
    """
    # imported here, so that the records of jobs can be read without torch
    import torch

    from framework.configuration.assembly import build_data
    from framework.configuration.loading import load_with_description
    from framework.evaluation.splits import cost
    from framework.training.batches import Batches

    model, description = load_with_description(run)
    settings = json.dumps(description.config["data"], sort_keys=True, default=str)
    if settings not in loaders:
        data = build_data(description.config)
        data.prepare()
        loaders[settings] = Batches(data, batch_size=batch, workers=0, seed=0)
    inputs = next(iter(loaders[settings].test_dataloader()))
    return cost(model, inputs, samples=1000, device=torch.device("cpu")).milliseconds_per_sample
