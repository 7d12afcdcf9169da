"""A run as one job of a sweep: what the sweep tells it, and what it leaves behind."""

import json
from pathlib import Path

from framework.storage.files import write_whole

PARENT = "FRAMEWORK_SWEEP_PARENT"
"""Environment variable that tells a job the tracking run its sweep is recorded under."""
SYNCED_WITHIN = 60.0
"""Seconds: what a shorter job has to tell the tracking store, the sweep sends when it has ended."""
RECORD = "job.json"
VALUE = "value.json"


def leave_value(folder: Path, value: float) -> None:
    """Leave the number that a sweeper which optimises is to get; nothing where `folder` is of no sweep."""
    if (folder / RECORD).is_file():
        write_whole(folder / VALUE, json.dumps(value).encode())
