"""What the runs of a sweep say of themselves: what they took, how they were set."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml


def record(run: Path) -> dict[str, Any]:
    """Of the job whose folder it is (framework.sweeps.jobs); of a run by itself there is nothing."""
    path = run / "job.json"
    if not path.exists():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))


def processor_seconds(job: Mapping[str, Any]) -> float:
    """Of the whole job, whatever ran beside it; NaN where it is not known."""
    spent = job.get("processor_seconds")
    return math.nan if spent is None else float(spent)


def by_the_clock(job: Mapping[str, Any]) -> float:
    """Seconds from a job's start to its end; NaN where they are not known."""
    return job["ended"] - job["started"] if "ended" in job else math.nan


def settings(runs: Iterable[Path], *keys: str) -> list[str]:
    """The values that a setting has in the runs' configs, each once: "15" or "15 and 30".

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
