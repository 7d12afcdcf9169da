"""Runs of a sweep, as a benchmark reads them: their records, settings and speed."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from framework.training.batches import Batches


def record(run: Path) -> dict[str, Any]:
    """Return the record of the job whose folder it is (framework.sweeps.jobs); empty for a run outside of a sweep."""
    path = run / "job.json"
    if not path.exists():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))


def processor_seconds(job: Mapping[str, Any]) -> float:
    """Return the processor seconds of a whole job; NaN where they are not known."""
    spent = job.get("processor_seconds")
    return math.nan if spent is None else float(spent)


def by_the_clock(job: Mapping[str, Any]) -> float:
    """Return the seconds from a job's start to its end; NaN where they are not known."""
    return job["ended"] - job["started"] if "ended" in job else math.nan


def settings(runs: Iterable[Path], *keys: str) -> list[str]:
    """Return the values that a setting has in the runs' configs, each once: "15" or "15 and 30".

    Args:
        keys: such as "trainer.max_epochs"; one answer each.
    """
    configs = [yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8")) for run in runs]
    found = []
    for key in keys:
        values = set()
        for config in configs:
            for part in key.split("."):
                config = config[part]
            values.add(config)
        found.append(" and ".join(str(value) for value in sorted(values)))
    return found


def milliseconds_per_sample(run: Path, loaders: "dict[str, Batches]", batch: int = 16) -> float:
    """Return the milliseconds of one sample in a batch: density and point prediction of the run's model.

    Args:
        loaders: those of the data seen so far.
    """
    # here, since the records of jobs are read without torch
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
