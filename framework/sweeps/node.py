"""Running of a sweep's job on a node of a cluster, and the file in which the node records how the job ended.

A node runs a job only if the record job.json still holds the handle with which the cluster started it: in the meantime,
the launcher may have cancelled the job, or started it again with another handle. The folder of the sweep is on a file
system that all nodes share. A node and the launcher exchange nothing but files of the job's folder: only the launcher
writes job.json, and only the node writes node.json.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

from framework.errors import DataError, UserError
from framework.runs.job import RECORD, read_record
from framework.storage.files import try_lock, write_whole
from framework.storage.plain_values import is_number, read_json
from framework.sweeps.engines import CONSOLE, LOCK
from framework.tracking.signals import end_with_parent

NODE = "node.json"
"""File with the state of a job on its node.

It has handle, host, seconds (processor time; null while the job runs, or if an end was not observed), code (exit code
as in `subprocess.Popen`; null until the job has ended for good) and reason (what ended the job, if the exit code does
not say it).
"""
STOP = signal.SIGUSR1
"""Signal by which the cluster asks for the end of a job.

The process that receives it sends SIGTERM to the job's command once. The processes of the command ignore STOP, because
some clusters send it to all processes, and a run that receives two signals does not wait for the end of its batch.
"""
PATIENCE = 0.1
"""Seconds between two attempts to acquire the lock, and between two looks at the command."""


def read_node(folder: Path, handle: str) -> dict[str, Any] | None:
    """Return the state that the job `handle` has left in its folder; None if the folder has no state of this job."""
    try:
        state = read_json(folder / NODE, "the state of a job") if (folder / NODE).is_file() else {}
    except DataError:
        return None
    code, seconds, reason = state.get("code"), state.get("seconds"), state.get("reason")
    valid = (
        state.get("handle") == handle
        and isinstance(state.get("host"), str)
        and (code is None or (type(code) is int and (code >= 0 or -code in set(signal.Signals))))
        and (seconds is None or is_number(seconds))
        and (reason is None or isinstance(reason, str))
    )
    return {"code": code, "seconds": seconds, "reason": reason, "host": state["host"]} if valid else None


@dataclass
class NodeJob:
    """Function object that runs a job; a cluster calls it on a node.

    Attributes:
        command: Python command of the job.
        environment: Environment variables of the job in addition to those of the node.
        folder: Absolute path of the job's folder.
        directory: Working directory of the job.
        handle: Name by which the engine knows the job; None: the id that SLURM has given it.
    """

    command: Sequence[str]
    environment: Mapping[str, str]
    folder: str
    directory: str
    handle: str | None = None

    def __post_init__(self) -> None:
        self._pid: int | None = None
        self._code: int | None = None
        self._seconds: float | None = None
        self._stopped = False
        self._orphaned = False

    def __call__(self) -> None:
        """Run the command and write node.json.

        Raises:
            UserError: The sweep has cancelled the job, or has started it again with another handle.
        """
        handle, rank = self.handle, 0
        if handle is None:
            handle, rank = f"slurm:{os.environ['SLURM_JOB_ID']}", int(os.environ["SLURM_PROCID"])
            for number in (STOP, signal.SIGTERM):
                signal.signal(number, self._stop)
        if rank:  # if rank 0 ends with an error, SLURM ends the other ranks
            sys.exit(self._run(f"console.{rank}.log"))
        folder = Path(self.folder)
        while (lock := try_lock(folder / LOCK)) is None:
            time.sleep(PATIENCE)
        try:
            self._run_locked(handle, folder, lock[0])
        finally:
            os.close(lock[0])
        if self.handle is None and self._code:
            sys.exit(
                self._code if self._code > 0 else 128 - self._code
            )  # so that SLURM's own lists say it too

    def _run_locked(self, handle: str, folder: Path, lock: int) -> None:
        record = read_record(folder) if (folder / RECORD).is_file() else {}
        if record.get("handle") != handle or record.get("status") != "running":
            raise UserError(f"{folder}: the sweep has cancelled {handle}, or has started the job again.")
        earlier = read_node(folder, handle)
        spent: float | None = 0.0 if earlier is None else earlier["seconds"]
        state: dict[str, Any] = {
            "handle": handle,
            "host": os.environ.get("SLURMD_NODENAME", socket.gethostname()),
            "seconds": None,
            "code": None,
            "reason": None,
        }
        _write(folder, state)
        try:
            state["code"] = self._run(CONSOLE, lock)
            if self._orphaned and self._code != 0:  # SLURM itself says what becomes of the job
                state |= {"code": None} if self.handle is None else {"reason": "the daemon of its node died"}
        except Exception as error:  # SLURM does not queue the job again at its time limit
            if self._code is None:
                raise
            state |= {"code": self._code, "reason": str(error) if self._stopped else None}
        finally:  # a job that SLURM queues again leaves by SystemExit, and has no exit code yet
            seconds = None if spent is None or self._seconds is None else spent + self._seconds
            _write(folder, state | {"seconds": seconds})

    def checkpoint(self) -> Any:
        """Stop the command before the time limit, and return the job for SLURM to queue again (called by submitit).

        The result is None if the command has already ended by itself.
        """
        from submitit.helpers import DelayedSubmission

        if self._pid is not None and self._has_ended():
            return None
        self._stop()
        self._wait()
        return DelayedSubmission(replace(self))

    def _run(self, console: str, lock: int | None = None) -> int:
        """Run the command, kill all processes that it leaves, and return its exit code."""
        end_with_this = end_with_parent()

        def begin() -> None:
            end_with_this()
            for number in (STOP, signal.SIGUSR2):
                signal.signal(number, signal.SIG_IGN)

        with (Path(self.folder) / console).open("ab") as output:
            process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self.environment},
                cwd=self.directory,
                pass_fds=() if lock is None else (lock,),
                start_new_session=True,
                preexec_fn=begin,
            )
        self._pid = process.pid
        if self._stopped:
            os.kill(self._pid, signal.SIGTERM)
        code = process.returncode = self._wait()
        return code

    def _wait(self) -> int:
        """Wait for the end of the command, kill all processes that it leaves, and return its exit code."""
        started_by = os.getppid()
        while True:
            try:
                while not self._has_ended():
                    time.sleep(PATIENCE)
                    if os.getppid() != started_by:
                        self._orphaned = True
                        self._stop()
                break
            except KeyboardInterrupt:  # how Ray cancels a task
                self._stop()
        if self._pid is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._pid, signal.SIGKILL)
        return 128 + signal.SIGTERM if self._code is None else self._code

    def _has_ended(self) -> bool:
        # not `Popen.poll`, whose lock the code that a signal interrupts may hold
        if self._pid is not None and self._code is None:
            try:
                ended, status, usage = os.wait4(self._pid, os.WNOHANG)
            except ChildProcessError:  # the call whose result a signal or an exception has discarded
                self._code = -signal.SIGTERM
                return True
            if ended:
                self._code = os.waitstatus_to_exitcode(status)
                self._seconds = usage.ru_utime + usage.ru_stime
        return self._pid is None or self._code is not None

    def _stop(self, number: int = STOP, frame: FrameType | None = None) -> None:
        """Ask the command to end, once, because a second signal would not wait for the end of its batch."""
        first, self._stopped = not self._stopped, True
        if first and self._pid is not None and not self._has_ended():
            os.kill(self._pid, signal.SIGTERM)


def _write(folder: Path, state: Mapping[str, Any]) -> None:
    write_whole(folder / NODE, json.dumps(state).encode())
