"""Trials of a search, from the results of jobs and from the study of Optuna."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.utils import JobReturn, JobStatus

from framework.runs import job as files
from framework.storage.files import try_lock
from framework.sweeps.engines import LOCK
from framework.sweeps.jobs import Job, find_records, short_hash
from framework.sweeps.ranking import Trial

if TYPE_CHECKING:
    from hydra_plugins.framework_search._study import Point, Study

PRUNED = "pruned"
"""Note that the table of trials shows for a pruned trial."""


def trial_of(result: JobReturn) -> Trial:
    """Return the trial of a job that has ended."""
    completed = result.status == JobStatus.COMPLETED
    folder = _folder(result)
    pruned = completed and result.return_value is None and (folder / files.PRUNED).is_file()
    return Trial(
        folder=folder,
        overrides=list(result.overrides or ()),
        value=result.return_value if completed else None,
        completed=completed and not pruned,
        note=PRUNED if pruned else "did not complete",
    )


def trials_of(study: "Study", returned: Sequence[JobReturn]) -> list[Trial]:
    """Return all trials of a study in their order.

    Args:
        study: Study with the trials of this command, of earlier ones, and of other machines.
        returned: Results of the jobs of this command.
    """
    trials = {tuple(sorted(result.overrides or ())): trial_of(result) for result in returned}
    records = find_records(study.folder)
    for point in study.points():
        key = tuple(sorted(point.overrides))
        if key not in trials:
            known = records.get(short_hash(*key))
            trials[key] = _earlier_trial(point, *known[0]) if known else _trial_elsewhere(point, study.folder)
    return list(trials.values())


def running_in(folder: Path) -> Callable[[Sequence[str]], bool]:
    """Return a function of overrides that returns whether the job with these overrides runs now in a sweep's folder."""
    records = find_records(folder.absolute())

    def is_running(overrides: Sequence[str]) -> bool:
        for path, _ in records.get(short_hash(*sorted(overrides)), ()):
            locked = try_lock(path / LOCK)
            if locked is None:
                return True
            os.close(locked[0])
        return False

    return is_running


def _earlier_trial(point: "Point", folder: Path, record: dict[str, object]) -> Trial:
    """Return the trial of a job that an earlier or another command ran in this folder."""
    job = Job(0, point.overrides, [], folder, "", "", record=record)
    pruned = point.state.name == "PRUNED"
    completed = record.get("status") == "completed" and not pruned
    note = PRUNED if pruned else str(record.get("status"))
    return Trial(folder, point.overrides, job.value() if completed else None, completed, note)


def _trial_elsewhere(point: "Point", folder: Path) -> Trial:
    """Return the trial of a job whose folder another machine has."""
    path, note = folder / f"elsewhere {point.number}", point.state.name.lower()
    return Trial(path, point.overrides, None, bool(point.values), note, point.values or None)


def _folder(result: JobReturn) -> Path:
    """Return a job's folder.

    If a launcher ran the job in this process, `working_dir` is not the job's folder, but the folder of the command.
    """
    if result.hydra_cfg is not None:
        return Path(str(result.hydra_cfg.hydra.runtime.output_dir))
    return Path(str(result.working_dir))
