"""A run as one job of a sweep: what the sweep tells it, and what it leaves behind."""

import json
import os
from pathlib import Path

from framework.storage.files import write_whole

PARENT = "FRAMEWORK_SWEEP_PARENT"
"""Environment variable that tells a job the tracking run its sweep is recorded under."""
SYNCED_WITHIN = 60.0
"""Seconds: what a shorter job has to tell the tracking store, the sweep sends when it has ended."""
RECORD = "job.json"
VALUE = "value.json"
_COMMAND = "multirun.yaml"
"""What Hydra leaves in the folder of a sweep."""


def by_number(folder: Path) -> list[tuple[int, str]]:
    """A key that sorts folders by name, 2 before 10."""
    return [(len(part), part) for part in folder.parts]


def recorded(folder: Path) -> list[Path]:
    """The folders of a sweep's jobs, sorted `by_number`, however deep they lie; not those of a sweep below it."""
    found = []
    for name, below, files in os.walk(folder):
        here = Path(name)
        # A damaged record may be a folder: whoever reads it says so.
        is_job = RECORD in files or RECORD in below
        if is_job:
            found.append(here)
        if is_job or (here != folder and _COMMAND in files):
            below.clear()
    return sorted(found, key=by_number)


def leave_value(folder: Path, value: float) -> None:
    """Leave the number that a sweeper which optimises is to get; nothing where `folder` is of no sweep."""
    if (folder / RECORD).is_file():
        write_whole(folder / VALUE, json.dumps(value).encode())
