"""Engine that runs the jobs of a sweep on a SLURM cluster, submitted by submitit.

The jobs outlive the command. SLURM may queue a job again by itself, at the job's time limit or after the failure of a
node; so a job has ended only if it has left an exit code, or if SLURM has not listed it as waiting or running for a
while. This module asks `squeue` and not `sacct`, because many clusters have no accounting.
"""

import getpass
import logging
import math
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from framework.errors import ConfigError, UserError, shorten
from framework.storage.names import as_bytes
from framework.sweeps.engines import Process, require_module
from framework.sweeps.node import STOP, NodeJob, read_node

SUBMITTED = ".slurm"
"""Folder, in the folder of the sweep, with a folder for each command that submitted jobs.

Such a folder holds the batch files of the jobs and the output of SLURM and submitit. Its name is random: a node
unpickles the job from a file that submitit names by the job's number, and the folder of a sweep that another person
sent may hold files with such names.
"""
_ENDED = {
    **dict.fromkeys(("COMPLETED", "CANCELLED", "FAILED", "OUT_OF_MEMORY", "DEADLINE"), 2.0),
    **dict.fromkeys(("TIMEOUT", "NODE_FAIL", "PREEMPTED", "BOOT_FAIL", "REVOKED"), 10.0),
}
"""States of a job that does not run, and the seconds after which the job has ended for good.

Before that, the file system of the nodes may not show the job's last file yet, or SLURM may queue the job again.
"""
_UNLISTED = "UNLISTED"
_LOST = ("NODE_FAIL", "BOOT_FAIL", "PREEMPTED", "FAILED (JobLaunchFailure)")
"""States, some with their reason, of a job that ended through no fault of its own.

SLURM gives the reason JobLaunchFailure in two cases: the node could not launch the job, or the job's batch script was
killed by a signal that SLURM was not asked to send. The script only starts `srun`; a job that is killed for its memory,
its time or by its user has another state.
"""
_INTERVAL, _SHORT_INTERVAL = 5.0, 1.0
"""Seconds between two calls of squeue: usually, and while the state of a job is expected to change."""

_log = logging.getLogger(__name__)


class SlurmSettings(BaseModel):
    """Resources of each job, as SLURM names them.

    Attributes:
        partition: Partition of the jobs; None: the cluster's default.
        time: Time limit, minutes; a job that reaches it is queued again, and resumes from its checkpoint.
        cpus: Cores of each task.
        gpus: GPUs of each node.
        mem: Memory of each node, GiB; None: the cluster's default.
        nodes: Nodes of each job.
        tasks_per_node: Processes on each node.
        requeues: Number of times that a job is queued again at its time limit.
        warning: Seconds before the time limit at which a job stops and stores its checkpoint.
        extra: Other options of sbatch by name, such as {"account": "vision"}.
    """

    model_config = ConfigDict(extra="forbid")
    partition: str | None = None
    time: Annotated[int, Field(gt=0)] = 60
    cpus: Annotated[int, Field(gt=0)] = 1
    gpus: Annotated[int, Field(ge=0)] = 0
    mem: Annotated[float, Field(gt=0)] | None = None
    nodes: Annotated[int, Field(gt=0)] = 1
    tasks_per_node: Annotated[int, Field(gt=0)] = 1
    requeues: Annotated[int, Field(ge=0)] = 10
    warning: Annotated[int, Field(gt=0)] = 120
    extra: dict[str, str | int | float | bool] = {}


class Slurm:
    """Engine whose jobs are jobs of SLURM.

    Args:
        folder: Folder of the sweep, on a file system that all nodes share.
        settings: Resources of each job.
    """

    interval = 0.2
    outlives = True

    def __init__(self, folder: Path, settings: SlurmSettings) -> None:
        self.threads = settings.cpus
        self._submitted = folder / SUBMITTED / secrets.token_hex(8)
        from submitit import SlurmExecutor

        self._executor = SlurmExecutor(self._submitted, max_num_timeout=settings.requeues)
        self._parameters: dict[str, Any] = {
            "time": settings.time,
            "nodes": settings.nodes,
            "ntasks_per_node": settings.tasks_per_node,
            "cpus_per_task": settings.cpus,
            "signal_delay_s": settings.warning,
            "stderr_to_stdout": True,
            # since SLURM 22.05 srun does not inherit the number of cores of a task
            "srun_args": [f"--cpus-per-task={settings.cpus}", "--kill-on-bad-exit=1"],
            "additional_parameters": {**settings.extra, "requeue": True},
        }
        if settings.partition is not None:
            self._parameters["partition"] = settings.partition
        if settings.gpus:
            self._parameters["gpus_per_node"] = settings.gpus
        if settings.mem is not None:
            self._parameters["mem"] = f"{round(settings.mem * 1024)}M"

    def start(
        self, command: Sequence[str], environment: Mapping[str, str], folder: Path, lock: int
    ) -> Process:
        from submitit.core.utils import FailedJobError, FailedSubmissionError

        self._executor.update_parameters(**self._parameters, job_name=job_name(folder))
        try:
            job = self._executor.submit(NodeJob(command, environment, str(folder), str(Path.cwd())))
        except (FailedJobError, FailedSubmissionError) as error:
            raise UserError(f"SLURM refuses the job: {shorten(' '.join(str(error).split()))}") from error
        for link in self._submitted.glob(".submission_file_*"):
            link.unlink()  # a link to the batch file; a folder of runs that contains links is refused
        return SlurmProcess(f"slurm:{job.job_id}", folder, submitted=True)

    def close(self) -> None:
        pass


class SlurmProcess:
    """Job of SLURM; an implementation of the protocol `Process`.

    Args:
        handle: Handle of the job, "slurm:" and its id.
        folder: Folder of the job in the sweep.
        submitted: Whether this process has submitted the job.
    """

    pid = None

    def __init__(self, handle: str, folder: Path, submitted: bool = False) -> None:
        self.handle: str | None = handle
        self.alive = submitted
        self.seconds: float | None = None
        self.reason: str | None = None
        self.lost = False
        self._id = handle.partition(":")[2]
        self._folder = folder
        self._name = job_name(folder)
        self._since = time.monotonic()
        self._ended_at: float | None = None
        self._cancelled = False
        self._code: int | None = None

    def poll(self) -> int | None:
        if self._code is not None:
            return self._code
        state = self._left()
        # SLURM may queue a job that was stopped or killed again
        if state is not None and (0 <= state["code"] < 128 or self._cancelled or state["reason"]):
            return self._finish(state)
        expected = self._cancelled or state is not None or self._ended_at is not None
        listed = QUEUE.state(self._id, self._since, expected=expected)
        if listed is None:
            return None
        if (
            listed.name != self._name
        ):  # the handle comes from a file of another person, and is that of another job
            listed = Listed(_UNLISTED, "", "")
        if listed.state not in (*_ENDED, _UNLISTED):
            self.alive, self._ended_at = True, None
            return None
        self._ended_at = self._ended_at or time.monotonic()
        if time.monotonic() - self._ended_at < _ENDED.get(listed.state, 10.0):
            return None
        list(self._folder.iterdir())  # so that a network file system shows the latest files
        state = self._left()
        self.lost = listed.is_lost and (state is None or not 0 <= state["code"] < 128)
        if state is not None:
            return self._finish(state, listed)
        self.reason = f"ended by SLURM: {listed} (job {self._id})"
        self._code = -signal.SIGKILL
        return self._code

    def _left(self) -> dict[str, Any] | None:
        """Return the state that the job has left on its node; None if it has left no exit code."""
        state = read_node(self._folder, f"slurm:{self._id}")
        return None if state is None or state["code"] is None else state

    def _finish(self, state: Mapping[str, Any], listed: "Listed | None" = None) -> int:
        self._code, self.seconds, self.reason = state["code"], state["seconds"], state["reason"]
        if state["code"] < 0:
            words = "" if listed is None else f"; SLURM: {listed}"
            name = signal.Signals(-state["code"]).name
            self.reason = f"killed by {name} on {shorten(state['host'])}{words}"
        return state["code"]

    def send(self, number: int) -> None:
        self._cancel(["--state=PENDING"], [f"--signal={STOP.name.removeprefix('SIG')}"])

    def kill(self) -> None:
        if self._code is None:
            self._cancel([])

    def _cancel(self, *commands: Sequence[str]) -> None:
        """Call scancel for each list of options, if the job is verified to be a job of this sweep."""
        if not self.alive:
            QUEUE.ask()
            listed = QUEUE.state(self._id, self._since, expected=True)
            if listed is None or listed.name != self._name:
                return
        self._cancelled = True
        for options in commands:
            subprocess.run(["scancel", *options, self._id], capture_output=True, check=False)


@dataclass(frozen=True)
class Listed:
    """One line of squeue: state of a job, reason of the state, and name of the job."""

    state: str
    reason: str
    name: str

    @property
    def is_lost(self) -> bool:
        """Return whether the job ended through no fault of its own."""
        return self.state in _LOST or str(self) in _LOST

    def __str__(self) -> str:
        return self.state if self.reason in ("", "None") else f"{self.state} ({self.reason})"


class _Queue:
    """Jobs of this user, as squeue last listed them; one call of squeue serves all jobs of a sweep."""

    def __init__(self) -> None:
        self._asked_at = -math.inf
        self._jobs: dict[str, Listed] | None = None
        self._warned = False

    def state(self, identity: str, since: float, *, expected: bool) -> Listed | None:
        """Return squeue's line about a job; None if SLURM does not answer, or has not been asked yet.

        Args:
            identity: Id of the job.
            since: Time (`time.monotonic`) since which SLURM must have been asked.
            expected: Whether the state is expected to change soon.
        """
        age = time.monotonic() - self._asked_at
        if age > _INTERVAL or (age > _SHORT_INTERVAL and (expected or self._asked_at < since)):
            self.ask()
        if self._jobs is None or self._asked_at < since:
            return None
        return self._jobs.get(identity, Listed(_UNLISTED, "", ""))

    def ask(self) -> None:
        """Call squeue."""
        options = ("--noheader", f"--user={getpass.getuser()}", "--states=all", "--format=%i|%T|%r|%j")
        asked_at = time.monotonic()
        listing = subprocess.run(["squeue", *options], capture_output=True, text=True, check=False)
        self._asked_at, self._jobs = asked_at, None
        if listing.returncode == 0:
            lines = (line.split("|", 3) for line in listing.stdout.splitlines() if line.count("|") >= 3)
            self._jobs = {identity: Listed(*rest) for identity, *rest in lines}
        elif not self._warned:
            _log.warning(
                "squeue does not answer (%s); the sweep waits", shorten(" ".join(listing.stderr.split()))
            )
        self._warned = listing.returncode != 0


QUEUE = _Queue()


def job_name(folder: Path) -> str:
    """Return the name that SLURM has for the job in `folder`.

    A handle that was read from a file may belong to another job of SLURM. The name shows whether it belongs to the job
    in this folder.
    """
    return f"sweep-{sha256(as_bytes(str(folder))).hexdigest()[:16]}"


def require_programs() -> None:
    """Refuse the engine if submitit or a command of SLURM is not installed.

    Raises:
        ConfigError: One of them is missing.
    """
    require_module("submitit", "slurm", "hydra/launcher=slurm")
    if missing := [name for name in ("sbatch", "squeue", "scancel", "srun") if shutil.which(name) is None]:
        raise ConfigError(
            f"hydra/launcher=slurm needs the commands of SLURM, but {', '.join(missing)} is not on PATH. Run the "
            "command on a machine from which jobs can be submitted, such as the login node of the cluster."
        )
