"""What the jobs of a sweep took."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def record(run: Path) -> dict[str, Any]:
    """Of the job whose folder it is (framework.sweeps.jobs)."""
    return json.loads((run / "job.json").read_text(encoding="utf-8"))


def processor_seconds(job: Mapping[str, Any]) -> float:
    """Of the whole job, whatever ran beside it; NaN where it is not known."""
    spent = job.get("processor_seconds")
    return math.nan if spent is None else float(spent)
