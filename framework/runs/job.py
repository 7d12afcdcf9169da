"""A run as one job of a sweep: the settings that the sweep passes to it, and the files that the job leaves."""

import json
import os
import sys
from pathlib import Path
from typing import Any

from framework.errors import ConfigError, DataError, quote
from framework.storage.files import write_whole
from framework.storage.first_rank import first_rank
from framework.storage.plain_values import read_json

PARENT = "FRAMEWORK_SWEEP_PARENT"
"""Environment variable that gives a job the id of the tracking run under which its sweep is recorded."""
SYNCED_WITHIN = 60.0
"""Seconds; for a job shorter than this, the sweep sends its journal to the tracking store after it has ended."""
RECORD = "job.json"
VALUE = "value.json"
_COMMAND = "multirun.yaml"
"""File that Hydra leaves in the folder of a sweep."""


_NUMBER, _TEXT = (int, float), (str, type(None))
_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("overrides", "command"), (list,)),
    **dict.fromkeys(("key", "status"), (str,)),
    **dict.fromkeys(("error", "config"), _TEXT),
    **dict.fromkeys(("started", "ended", "processor_seconds", "pid"), (*_NUMBER, type(None))),
    **dict.fromkeys(("number", "tries"), (int,)),
}


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record of the job in a folder (`framework.sweeps.jobs.Job`), which may come from an untrusted source.

    Raises:
        DataError: There is no record, or a sweep would not write such a record.
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
        found = quote(record.get(wrong[0]))
        raise DataError(f"{path} says {wrong[0]} = {found}; wanted what a sweep writes. {remedy}")
    return record


def by_number(folder: Path) -> list[tuple[int, str]]:
    """Return a key that sorts folders by name, with 2 before 10."""
    return [(len(part), part) for part in folder.parts]


def recorded(folder: Path) -> list[Path]:
    """Return the folders of a sweep's jobs at any depth, sorted `by_number`, without those of a sweep inside it."""
    found = []
    for name, below, files in os.walk(folder):
        here = Path(name)
        # A damaged record may be a folder; the function that reads it raises the error.
        is_job = RECORD in files or RECORD in below
        if is_job:
            found.append(here)
        if is_job or (here != folder and _COMMAND in files):
            below.clear()
    return sorted(found, key=by_number)


def leave_value(folder: Path, value: float) -> None:
    """Write the number that an optimising sweeper reads; do nothing if `folder` does not belong to a sweep."""
    if (folder / RECORD).is_file():
        write_whole(folder / VALUE, json.dumps(value).encode())


def refuse_idle(folder: Path, sentence: str) -> None:
    """Refuse a setting that has no effect; in a job of a sweep, only print a note, since other jobs may read it.

    Args:
        folder: Folder of the run.
        sentence: Sentence about the setting (`framework.configuration.modes.idle_sentence`).

    Raises:
        ConfigError: The run is not a job of a sweep.
    """
    if not ((folder / RECORD).is_file() or (folder.parent / _COMMAND).is_file()):
        raise ConfigError(sentence)
    if first_rank():
        sys.stdout.write(f"note: {sentence}\n")
