"""A run as one job of a sweep: the settings that the sweep passes to it, and the files that the job leaves."""

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from framework.errors import ConfigError, DataError, count_of, quote
from framework.storage.enclosed import require_enclosed
from framework.storage.files import write_whole
from framework.storage.first_rank import first_rank
from framework.storage.plain_values import read_json

PARENT = "FRAMEWORK_SWEEP_PARENT"
"""Environment variable with the id of the sweep's run in the tracking store, which becomes the parent of the job."""
SYNCED_WITHIN = 60.0
"""Seconds before a job sends anything to the tracking store; the journal of a shorter job is sent by its sweep."""
RECORD = "job.json"
VALUE = "value.json"
PRUNED = "pruned.txt"
"""File with which a search asks a job to end its training, because other trials have lower validation losses."""
_COMMAND = "multirun.yaml"
"""File that Hydra leaves in the folder of a sweep."""
_MODEL = "checkpoints/model.ckpt"


_NUMBER, _TEXT = (int, float), (str, type(None))
_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("overrides", "command"), (list,)),
    **dict.fromkeys(("key", "status"), (str,)),
    **dict.fromkeys(("error", "config", "handle"), _TEXT),
    **dict.fromkeys(("started", "ended", "processor_seconds", "pid"), (*_NUMBER, type(None))),
    **dict.fromkeys(("number", "tries"), (int,)),
}


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record of the job in a folder (`framework.sweeps.jobs.Job`), which may come from an untrusted source.

    Raises:
        DataError: The record is missing, damaged, or different from what a sweep writes.
    """
    path, remedy = folder / RECORD, "Delete the file; the job then runs again."
    record = read_json(path, "the record of a job", remedy)
    wrong = [
        key
        for key, kinds in _KINDS.items()
        if key in record and (not isinstance(record[key], kinds) or isinstance(record[key], bool))
    ]
    if "overrides" not in record or (
        not wrong and not all(isinstance(item, str) for item in record["overrides"])
    ):
        wrong.append("overrides")
    if "key" in record and "number" not in record:
        wrong.append("number")
    if wrong:
        value = quote(record.get(wrong[0]))
        raise DataError(f"{path} contains {wrong[0]} = {value}, which no sweep writes. {remedy}")
    return record


def natural_order_key(folder: Path) -> list[tuple[int, str]]:
    """Return a sort key for folders that puts the name 2 before the name 10."""
    return [(len(part), part) for part in folder.parts]


def find_job_folders(folder: Path) -> list[Path]:
    """Return the folders of a sweep's jobs at any depth, sorted by `natural_order_key`.

    If the folder of another sweep lies in this folder, the jobs of the other sweep are left out.
    """
    job_folders = []
    for name, below, files in os.walk(folder):
        path = Path(name)
        # a record may be damaged and be a folder; the function that reads the record raises the error
        is_job = RECORD in files or RECORD in below
        if is_job:
            job_folders.append(path)
        if is_job or (path != folder and _COMMAND in files):
            below.clear()
    return sorted(job_folders, key=natural_order_key)


def find_members(members: str | Sequence[str]) -> list[str | Path]:
    """Return the run folders, checkpoint files or MLflow run ids of the members.

    If `members` is a folder, the members are the runs directly in it that contain a trained model, sorted by name. If
    the folder contains no such run, the members are the jobs with a trained model at any depth.

    Raises:
        ConfigError: There are fewer than two members.
    """
    if not isinstance(members, str):
        listed: list[str | Path] = list(members)
    else:
        folder = Path(members).expanduser()
        require_enclosed(folder, ConfigError)
        runs = sorted((path.parent.parent for path in folder.glob(f"*/{_MODEL}")), key=natural_order_key)
        listed = [*(runs or (job for job in find_job_folders(folder) if (job / _MODEL).is_file()))]
    if len(listed) < 2:
        raise ConfigError(
            f"mode.members = {members!r} names {count_of(len(listed), 'trained model')}, but at "
            "least two are required. Give the folder of a sweep (outputs/sweeps/<time>), or a list of run folders, "
            "checkpoint files or MLflow run ids."
        )
    return listed


def write_value(folder: Path, value: float) -> None:
    """Write the number that a sweeper minimises; do nothing if the run in `folder` is not a job of a sweep."""
    if (folder / RECORD).is_file():
        write_whole(folder / VALUE, json.dumps(value).encode())


def refuse_idle(folder: Path, sentence: str) -> None:
    """Refuse a setting that has no effect; in a job of a sweep, print `sentence` instead.

    In a sweep the setting is not refused, because other jobs of the sweep may read it.

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
