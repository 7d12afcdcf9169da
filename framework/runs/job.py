"""A run as one job of a sweep: what the sweep tells it, and what it leaves behind."""

import json
import os
import sys
from pathlib import Path
from typing import Any

from framework.errors import ConfigError, DataError, quoted
from framework.storage.files import write_whole
from framework.storage.first_rank import first_rank
from framework.storage.plain_values import read_json

PARENT = "FRAMEWORK_SWEEP_PARENT"
"""Environment variable that tells a job the tracking run its sweep is recorded under."""
SYNCED_WITHIN = 60.0
"""Seconds: what a shorter job has to tell the tracking store, the sweep sends when it has ended."""
RECORD = "job.json"
VALUE = "value.json"
_COMMAND = "multirun.yaml"
"""What Hydra leaves in the folder of a sweep."""


_NUMBER, _TEXT = (int, float), (str, type(None))
_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("overrides", "command"), (list,)),
    **dict.fromkeys(("key", "status"), (str,)),
    **dict.fromkeys(("error", "config"), _TEXT),
    **dict.fromkeys(("started", "ended", "processor_seconds", "pid"), (*_NUMBER, type(None))),
    **dict.fromkeys(("number", "tries"), (int,)),
}


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record of the job in a folder (`framework.sweeps.jobs.Job`); it may be a stranger's.

    Raises:
        DataError: there is none, or it is not what a sweep writes.
    """
    path, remedy = folder / RECORD, "Delete it, and the job runs anew."
    record = read_json(path, "the record of a job", remedy)
    wrong = [
        key
        for key, kinds in _KINDS.items()
        if key in record and (not isinstance(record[key], kinds) or isinstance(record[key], bool))
    ]
    if "overrides" not in record or (
        not wrong and not all(isinstance(one, str) for one in record["overrides"])
    ):
        wrong.append("overrides")
    if "key" in record and "number" not in record:
        wrong.append("number")
    if wrong:
        found = quoted(record.get(wrong[0]))
        raise DataError(f"{path} says {wrong[0]} = {found}; wanted what a sweep writes. {remedy}")
    return record


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


def refuse_idle(folder: Path, sentence: str) -> None:
    """Refuse a setting that has no effect; in a job of a sweep, whose other jobs may read it, only say so.

    Args:
        folder: of the run.
        sentence: about the setting (`framework.configuration.modes.sets_nothing`).

    Raises:
        ConfigError: the run is no job of a sweep.
    """
    if not ((folder / RECORD).is_file() or (folder.parent / _COMMAND).is_file()):
        raise ConfigError(sentence)
    if first_rank():
        sys.stdout.write(f"note: {sentence}\n")
