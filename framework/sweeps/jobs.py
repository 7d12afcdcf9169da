"""Running of a sweep on one machine, with a process and a record per job, several at a time; a sweep can be resumed."""

import fcntl
import hashlib
import json
import logging
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from framework.errors import ConfigError, UserError
from framework.runs.job import PARENT, RECORD, VALUE, find_job_folders, read_record
from framework.storage.enclosed import read_plain, read_stream
from framework.storage.files import lacks_locks, warn_unlocked, write_whole
from framework.storage.names import as_bytes
from framework.storage.plain_values import plain_numbers
from framework.storage.reading import translate_errors
from framework.sweeps.processes import Process, SeparateProcess, Starter
from framework.tracking.signals import ENDING, SIGNALS, Stopped, ends_with_parent, handled_signals

COMMAND: Sequence[str] = (sys.executable, "-P", "-m", "framework")
"""Command of a job, to which its overrides are added. It is no setting, because a config must not run code."""
CONSOLE = "console.log"
LONGEST_VALUE = 4096
"""Largest size, in bytes, of the file with the value that a job returned."""

log = logging.getLogger(__name__)


@dataclass
class Job:
    """One job of a sweep.

    The record of a job, job.json, has number, overrides, key and config as below. The record also has command, pid,
    tries, started and ended (seconds since 1970, of the last try), processor_seconds, error and status. The processor
    time covers all tries, threads and processes of the job; it is null if the sweep was killed during one of the tries.
    The status is "queued", "running", "completed", "failed" (the job exited with an error) or "died" (the job was
    killed, or stopped by a signal).

    Attributes:
        number: Number of the job in the sweep.
        overrides: Overrides of the job.
        arguments: Arguments of the job's command.
        folder: Folder of the job.
        key: Hash of the overrides, which identifies the job in the sweep.
        config: Hash of the whole composed config; a job that has completed with the same hash is not run again.
        attempts: Number of times that this command has started the job.
        waits: Whether the job waits, because a process of another sweep was found in its folder.
        unlocked: Whether the folder is on a file system without locks.
        record: Content of job.json.
    """

    number: int
    overrides: list[str]
    arguments: list[str]
    folder: Path
    key: str
    config: str
    attempts: int = 0
    waits: bool = False
    unlocked: bool = False
    record: dict[str, Any] = field(default_factory=dict)

    @property
    def completed(self) -> bool:
        """Return whether the job has completed with its present config."""
        return self.record.get("status") == "completed" and self.record.get("config") == self.config

    @property
    def identity(self) -> dict[str, Any]:
        """Return the entries of the record that identify the job and never change."""
        return {"key": self.key, "number": self.number, "overrides": self.overrides}

    def reread(self) -> bool:
        """Read job.json again, which another sweep may have changed; return False if it now describes another job."""
        record = read_record(self.folder)
        if record.get("key") == self.key:
            self.record = record
            return True
        overrides = " ".join(map(str, record.get("overrides", ())))
        error = f"its folder now belongs to the job {overrides!r}; repeat the sweep, and the job gets a new folder"
        self.record = {**self.identity, "status": "failed", "error": error}
        return False

    def update(self, **values: Any) -> None:
        """Set the given keys of the record, in memory and on disk."""
        self.record |= values
        write_whole(self.folder / RECORD, json.dumps(self.record, indent=1).encode())

    def value(self) -> float | None:
        """Return the value that the job wrote for the sweeper (`runs.job.write_value`); None if it wrote none."""
        path = self.folder / VALUE
        with translate_errors(path, "a number", "Delete the file, and the job runs again."):
            return (
                float(plain_numbers(json.loads(read_plain(path, LONGEST_VALUE)))) if path.is_file() else None
            )


def short_hash(*parts: str) -> str:
    """Return a hash of texts, 16 hexadecimal digits."""
    return hashlib.sha256(as_bytes("\0".join(parts))).hexdigest()[:16]


def find_records(folder: Path) -> dict[str, list[tuple[Path, dict[str, Any]]]]:
    """Return the folder and the record of every job of earlier sweeps in `folder`, by `Job.key`.

    Several jobs may have the same key.
    """
    records_by_key: dict[str, list[tuple[Path, dict[str, Any]]]] = {}
    for path in find_job_folders(folder):
        record = read_record(path)
        records_by_key.setdefault(str(record.get("key")), []).append((path, record))
    return records_by_key


def free_number(subfolder: Callable[[int], Path], number: int, used: set[Path]) -> int:
    """Return the first job number, from `number` on, whose folder `subfolder(...)` is not in `used`.

    Raises:
        ConfigError: `hydra.sweep.subdir` gives two jobs the same folder.
    """
    for candidate in range(number, number + len(used) + 1):
        if subfolder(candidate) not in used:
            return candidate
    raise ConfigError(
        f"hydra.sweep.subdir gives two jobs the folder {subfolder(number)}, but each job needs its own. "
        "Use the default, ${hydra.job.num}."
    )


def reserve(jobs: Sequence[Job]) -> None:
    """Write a record for each job that has none, so that no other sweep uses the job's folder.

    The caller must have acquired the lock of the sweep's folder before it chose the jobs' numbers.
    """
    for job in jobs:
        if not job.record:
            job.folder.mkdir(parents=True, exist_ok=True)
            job.update(**job.identity, status="queued", error=None)


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(
    jobs: Sequence[Job],
    *,
    at_once: int,
    retries: int = 0,
    devices: Sequence[str] = (),
    parent: str | None = None,
    starter: Starter = SeparateProcess,
    store: str | None = None,
) -> None:
    """Run every job that has not completed, and return when all have ended, successfully or not.

    SIGINT, SIGTERM and SIGHUP are passed on to the jobs, which close their runs. A second signal stops the jobs
    immediately, and a third kills them.

    Args:
        jobs: Jobs of the sweep.
        at_once: Number of jobs that run at the same time; each gets an equal part of the cores.
        retries: Number of times that a job that died is started again.
        devices: CUDA devices to distribute, one to each running job; if empty, all jobs see all devices.
        parent: Id of the tracking run under which the jobs are recorded.
        starter: Function that starts the process of a job.
        store: Address of the tracking store that the command names.

    Raises:
        Stopped: A signal was received.
    """
    queue = deque(job for job in jobs if not job.completed)
    for job in queue:
        job.folder.mkdir(parents=True, exist_ok=True)
        lock = _lock(job)
        if lock is not None:
            if not (job.folder / RECORD).exists() or (job.reread() and not job.completed):
                job.update(**job.identity, status="queued", error=None)
            os.close(lock)
    log.info(
        f"{len(jobs)} jobs, {len(jobs) - len(queue)} of them already completed; {at_once} at a time with "
        f"{max(1, cores() // at_once)} cores each"
    )
    running: list[_Running] = []
    passed_on = 0
    started_by, orphaned_at = os.getppid(), None
    with _signals() as received, ThreadPoolExecutor(1, "sync") as sending:
        while running or (queue and not received):
            for number in received[passed_on:]:
                _pass_on(number, passed_on, running)
                passed_on += 1
            if orphaned_at is None and os.getppid() != started_by and ends_with_parent():
                orphaned_at = time.monotonic()
            if orphaned_at is not None and time.monotonic() - orphaned_at > ENDING:
                for active in running:
                    active.process.kill()
            for _ in range(len(queue)):
                if received or len(running) == at_once:
                    break
                job = queue.popleft()
                lock = _lock(job)
                if lock is None:
                    queue.append(job)
                    continue
                # Another sweep may have run the job while this one waited for the folder.
                if not job.reread() or job.completed:
                    os.close(lock)
                else:
                    slot = min(set(range(at_once)) - {active.slot for active in running})
                    running.append(
                        _start(job, slot, lock, _environment(at_once, slot, devices, parent), starter)
                    )
            for active in list(running):
                code = active.process.poll()
                if active.job.record["pid"] != active.process.pid:
                    active.job.update(pid=active.process.pid)
                if code is None:
                    continue
                running.remove(active)
                _end(active, code)
                if parent is not None:
                    sending.submit(_sync, active.job.folder, store)
                if active.job.record["status"] == "died" and active.job.attempts <= retries and not received:
                    queue.append(active.job)
            time.sleep(0.05)
    if received:
        raise Stopped(received[0])


def _sync(folder: Path, store: str | None) -> None:
    """Send the journal lines that a finished job has not sent; `comparison` closes and sends runs of killed jobs."""
    from framework.tracking.ended import sync  # imported late: Hydra imports this module at every start

    try:
        sync(folder, store)
    except UserError as error:
        log.warning(f"{folder}: {error}")


def failure(jobs: Sequence[Job]) -> UserError | None:
    """Return an error that lists the jobs that did not complete; None if all completed."""
    bad = [job for job in jobs if job.record.get("status") != "completed"]
    if not bad:
        return None
    lines = [
        f"  #{job.number} {job.record.get('status')}: {job.record.get('error')}  ({job.folder / CONSOLE})"
        for job in bad
    ]
    return UserError(
        f"{len(bad)} of {len(jobs)} jobs did not complete:\n" + "\n".join(lines) + "\n"
        "To run only these jobs again, repeat the command with hydra.sweep.dir=<folder of this sweep>."
    )


@dataclass
class _Running:
    job: Job
    process: Process
    slot: int
    lock: int


def _environment(at_once: int, slot: int, devices: Sequence[str], parent: str | None) -> dict[str, str]:
    # The cores are divided by `at_once`, not by the number of jobs, because results depend on the number of threads in
    # the last bits, and a resumed job must give the same bits as an uninterrupted one.
    environment = {"OMP_NUM_THREADS": str(max(1, cores() // at_once)), **os.environ}
    # Printed text must be written to the file even if the process is killed.
    environment |= {"PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    if devices:
        environment["CUDA_VISIBLE_DEVICES"] = devices[slot % len(devices)]
    if parent is not None:
        environment[PARENT] = parent
    return environment


def _earlier_seconds(record: Mapping[str, Any], config: str) -> float | None:
    """Return the processor seconds of a job's earlier tries with this config; None if the end of a try was missed."""
    if record.get("config") != config:
        return 0.0
    return None if record.get("ended") is None else record.get("processor_seconds")


def _start(job: Job, slot: int, lock: int, environment: Mapping[str, str], starter: Starter) -> _Running:
    job.attempts += 1
    (job.folder / VALUE).unlink(missing_ok=True)
    job.update(
        **job.identity,
        status="running",
        tries=job.record.get("tries", 0) + 1,
        processor_seconds=_earlier_seconds(job.record, job.config),
        config=job.config,
        command=[*COMMAND, *job.arguments],
        started=time.time(),
        ended=None,
        error=None,
        pid=None,
    )
    with (job.folder / CONSOLE).open("ab") as console:
        process = starter(job.record["command"], environment, console.fileno(), lock)
    log.info(f"#{job.number} started: {' '.join(job.overrides)}")
    return _Running(job, process, slot, lock)


def _end(active: _Running, code: int) -> None:
    """Record how a job ended: its status, its error message and its processor time."""
    job = active.job
    active.process.kill()  # processes that a killed job left behind, such as data loaders and other ranks
    if active.process.seconds is None:
        status, error = "died", "its exit code is not known, because its parent process died"
    elif code == 0:
        status, error = "completed", None
    elif code < 0:
        status, error = "died", f"killed by {signal.Signals(-code).name}"
        if code == -signal.SIGKILL:
            error += ", as the system does when memory runs out"
    elif code - 128 in (*SIGNALS, signal.SIGKILL):  # SIGKILL if one of several ranks was killed
        status, error = "died", f"stopped by {signal.Signals(code - 128).name}"
    else:
        status, error = "failed", f"{_last_line(job.folder / CONSOLE)} (exit code {code})"
    before = job.record["processor_seconds"]
    seconds = active.process.seconds
    processor_seconds = None if before is None or seconds is None else before + seconds
    job.update(status=status, error=error, ended=time.time(), processor_seconds=processor_seconds)
    os.close(active.lock)
    log.info(
        f"#{job.number} {status} after {job.record['ended'] - job.record['started']:.1f} s"
        + (f": {error} ({job.folder / CONSOLE})" if error else "")
    )


def _last_line(console: Path) -> str:
    """Return the last non-empty line of a console file, in which Python and this framework state the error."""
    with read_stream(console) as stream:
        stream.seek(max(0, os.fstat(stream.fileno()).st_size - 4096))
        lines = stream.read(4096).decode("utf-8", "replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")[:500]


def _pass_on(number: int, before: int, running: Sequence[_Running]) -> None:
    for active in running:
        if before < 2:
            active.process.send(number if before == 0 else signal.SIGTERM)
        else:
            active.process.kill()
    log.info(f"{signal.Signals(number).name}: {len(running)} running jobs are asked to stop")


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect signals inside the `with` block; yield the list to which the number of each received signal is added."""
    received: list[int] = []
    numbers = handled_signals()
    before = [signal.signal(number, lambda number, frame: received.append(number)) for number in numbers]
    try:
        yield received
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _lock(job: Job) -> int | None:
    """Lock the job's folder and return the lock's descriptor; None if a process of another sweep holds the lock.

    On a file system without `flock`, a POSIX record lock is used, which ends with this process. On a file system
    without either lock, a warning is logged.
    """
    path = job.folder / ".lock"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if not lacks_locks(error):
                raise
            try:
                fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as record_error:
                if not lacks_locks(record_error):
                    raise
                if not job.attempts and not job.unlocked:
                    warn_unlocked(path, record_error)
                job.unlocked = True
    except (BlockingIOError, PermissionError):
        os.close(descriptor)
        if not job.waits:
            log.info(f"#{job.number} waits, because a process of another sweep still uses {job.folder}")
        job.waits = True
        return None
    return descriptor
