"""Running of the jobs of a sweep on an engine, with a record per job, several at a time; a sweep can be resumed."""

import hashlib
import json
import logging
import os
import re
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from framework.errors import ConfigError, UserError, count_of
from framework.runs.job import PARENT, PRUNED, RECORD, VALUE, find_job_folders, read_record
from framework.storage.enclosed import read_plain, read_stream
from framework.storage.files import try_lock, warn_unlocked, write_whole
from framework.storage.names import as_bytes
from framework.storage.plain_values import plain_numbers
from framework.storage.reading import translate_errors
from framework.sweeps.engines import CONSOLE, LOCK, Engine
from framework.sweeps.processes import Process
from framework.sweeps.sending import JournalSender
from framework.tracking.signals import CLOSED, ENDING, SIGNALS, Stopped, collected_signals, ends_with_parent

COMMAND: Sequence[str] = (sys.executable, "-P", "-m", "framework")
"""Command of a job, to which its overrides are added. It is not a setting, because a config must not run code."""
OUTLIVING = "slurm:"
"""Beginning of the handles of jobs that outlive the sweep's command."""
MOST_LISTED = 8
"""Largest number of jobs with the same error whose numbers are listed."""
MOST_LOSSES = 3
"""Largest number of times that a command starts a job again because the job was lost with its node."""
LONGEST_VALUE = 4096
"""Largest size, in bytes, of the file with the value that a job returned."""

log = logging.getLogger(__name__)


@dataclass
class Job:
    """One job of a sweep.

    The record of a job, job.json, has the number, the overrides, the key and the config that the attributes describe.
    It also has command, pid, tries, started and ended (seconds since 1970, of the last try), processor_seconds, error
    and status. The processor time covers all tries, threads and processes of the job; it is null if the sweep was
    killed during one of the tries. A job that runs on a node of a cluster (SLURM, Ray) also has a handle, the name by
    which the engine knows the job. The status is "queued", "running", "completed", "failed" (the job exited with an
    error) or "died" (the job was killed, or stopped by a signal).

    Attributes:
        number: Number of the job in the sweep.
        overrides: Overrides of the job.
        arguments: Arguments of the job's command.
        folder: Folder of the job.
        key: Hash of the overrides, which identifies the job in the sweep.
        config: Hash of the whole composed config; a job that has completed with the same hash is not run again.
        attempts: Number of times that this command has started the job.
        losses: Number of times that the job was lost with its node during this command.
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
    losses: int = 0
    waits: bool = False
    unlocked: bool = False
    record: dict[str, Any] = field(default_factory=dict)

    @property
    def completed(self) -> bool:
        """Return whether the job has completed with its present config."""
        return self.record.get("status") == "completed" and self.record.get("config") == self.config

    @property
    def is_elsewhere(self) -> bool:
        """Return whether an engine whose jobs outlive the sweep may still run the job."""
        return runs_elsewhere(self.record)

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


def runs_elsewhere(record: Mapping[str, Any]) -> bool:
    """Return whether an engine whose jobs outlive the sweep may still run the job of a record.

    The tasks of Ray also have a handle, but they end with the command.
    """
    return record.get("status") == "running" and str(record.get("handle")).startswith(OUTLIVING)


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


def run(
    jobs: Sequence[Job],
    engine: Engine,
    *,
    at_once: int,
    retries: int = 0,
    devices: Sequence[str] = (),
    parent: str | None = None,
    sender: JournalSender | None = None,
    eager: bool = False,
    watch: Callable[[Job], None] | None = None,
) -> None:
    """Run every job that has not completed, and return when all have ended, successfully or not.

    A job that an earlier command started on an engine whose jobs outlive the command is taken up again. A job that was
    lost with its node is started again, independently of `retries`.

    SIGINT, SIGTERM and SIGHUP are passed on to the jobs, which close their runs. A second signal stops the jobs
    immediately, and a third kills them. If the jobs outlive this process, SIGHUP is not passed on.

    Args:
        jobs: Jobs of the sweep.
        engine: Engine that starts the jobs.
        at_once: Number of jobs that run at the same time.
        retries: Number of times that a job that died is started again.
        devices: CUDA devices to distribute, one to each running job; if empty, all jobs see all devices.
        parent: Id of the tracking run under which the jobs are recorded.
        sender: Object that sends the journals of ended jobs to the tracking store; None without a store.
        eager: Return as soon as every job has been started and, for each job that has not ended, the engine has
            confirmed that the job waits or runs. The jobs must outlive this process.
        watch: Function that is called for each running job in turn, about every `engine.interval` seconds.

    Raises:
        Stopped: A signal was received.
    """
    queue = deque(sorted((job for job in jobs if not job.completed), key=lambda job: not job.is_elsewhere))
    for job in queue:
        job.folder.mkdir(parents=True, exist_ok=True)
        lock = _lock(job)
        if lock is not None:
            if not (job.folder / RECORD).exists() or (
                job.reread() and not job.completed and not job.is_elsewhere
            ):
                job.update(**job.identity, status="queued", error=None)
            os.close(lock)
    log.info(
        f"{count_of(len(jobs), 'job')}, {len(jobs) - len(queue)} of them already completed; {at_once} at a time with "
        f"{count_of(engine.threads, 'core')} each"
    )
    running: list[_Running] = []
    passed_on = 0
    started_by, orphaned_at = os.getppid(), None
    if sender is not None:
        for job in jobs:
            if job.completed:  # the command that ran the job may have been killed before it sent the journal
                sender.add(job.folder)
    with collected_signals() as received:
        while running or (queue and not received):
            if engine.outlives and received[:1] == [CLOSED]:
                log.info(f"The terminal is closed: {len(running)} jobs go on without this command")
                break
            for number in received[passed_on:]:
                _pass_on(number, passed_on, running)
                passed_on += 1
            orphaned = os.getppid() != started_by and ends_with_parent() and not engine.outlives
            if orphaned_at is None and orphaned:
                orphaned_at = time.monotonic()
            if orphaned_at is not None and time.monotonic() - orphaned_at > ENDING:
                for active in running:
                    active.process.kill()
            for _ in range(len(queue)):
                if received or len(running) >= at_once:
                    break
                job = queue.popleft()
                lock = _lock(job)
                if lock is None:
                    if (attached := _attach(job)) is None:
                        _wait(job)
                        queue.append(job)
                    else:
                        running.append(attached)
                    continue
                # Another sweep may have run the job while this one waited for the folder.
                if not job.reread() or job.completed:
                    os.close(lock)
                elif (attached := _attach(job)) is not None:
                    os.close(lock)
                    running.append(attached)
                else:
                    slot = min(set(range(at_once)) - {active.slot for active in running})
                    environment = _environment(engine, slot, devices, parent)
                    if (started := _start(job, slot, lock, environment, engine)) is not None:
                        running.append(started)
            for active in list(running):
                if watch is not None:
                    watch(active.job)
                code = active.process.poll()
                if active.job.record.get("pid") != active.process.pid:
                    active.job.update(pid=active.process.pid)
                if code is None:
                    continue
                running.remove(active)
                job = active.job
                if active.lock is None and (
                    not job.reread() or job.record.get("handle") != active.process.handle
                ):
                    queue.append(job)  # another sweep has started the job again
                    continue
                if active.lock is None and job.record.get("status") != "running":
                    continue  # another sweep has recorded how the job ended
                _end(active, code)
                if sender is not None:
                    sender.add(job.folder)
                if job.record["status"] == "died" and not received:
                    job.losses += active.process.lost
                    if job.attempts - job.losses <= retries and job.losses <= MOST_LOSSES:
                        queue.append(job)
            if eager and not queue and all(active.process.alive for active in running):
                break
            time.sleep(engine.interval)
    if received:
        raise Stopped(received[0])


def failure(jobs: Sequence[Job]) -> UserError | None:
    """Return an error that lists the jobs that did not complete; None if all completed.

    Jobs with the same error are listed together, with the path of the first job's console output.
    """
    bad = [job for job in jobs if job.record.get("status") != "completed" and not job.is_elsewhere]
    if not bad:
        return None
    alike: dict[tuple[object, object], list[Job]] = {}
    for job in bad:
        alike.setdefault((job.record.get("status"), job.record.get("error")), []).append(job)
    lines = []
    for (status, error), group in alike.items():
        numbers = ", ".join(f"#{job.number}" for job in group[:MOST_LISTED])
        more = f" and {len(group) - MOST_LISTED} more" if len(group) > MOST_LISTED else ""
        lines.append(f"  {numbers}{more} {status}: {error}  ({group[0].folder / CONSOLE})")
    return UserError(
        f"{len(bad)} of {count_of(len(jobs), 'job')} did not complete:\n" + "\n".join(lines) + "\n"
        "To run only these jobs again, repeat the command with hydra.sweep.dir=<folder of this sweep>."
    )


@dataclass
class _Running:
    job: Job
    process: Process
    slot: int
    lock: int | None


def _environment(engine: Engine, slot: int, devices: Sequence[str], parent: str | None) -> dict[str, str]:
    environment = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", str(engine.threads))}
    # Printed text must be written to the file even if the process is killed.
    environment |= {"PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    if devices:
        environment["CUDA_VISIBLE_DEVICES"] = devices[slot % len(devices)]
    if parent is not None:
        environment[PARENT] = parent
    return environment


def _earlier_seconds(record: Mapping[str, Any], config: str) -> float | None:
    """Return the processor seconds of a job's earlier tries with this config; None if not all of them are known."""
    if record.get("config") != config:
        return 0.0
    return None if record.get("ended") is None else record.get("processor_seconds")


def _attach(job: Job) -> _Running | None:
    """Take up a job that an earlier command started, if it still runs and this machine can reach its engine.

    A job whose config has changed since is cancelled instead.
    """
    if (job.folder / RECORD).exists() and job.reread() and job.is_elsewhere:
        process = _process_of(str(job.record["handle"]), job.folder)
        if process is not None and job.record.get("config") == job.config:
            log.info(f"#{job.number} was started earlier as {job.record['handle']}")
            return _Running(job, process, -1, None)
        if process is not None and not job.waits:
            process.kill()
    return None


def _process_of(handle: str, folder: Path) -> Process | None:
    """Return the process of a job that an earlier command started; None if this machine cannot reach its engine."""
    if not re.fullmatch(r"slurm:[0-9]+", handle) or shutil.which("squeue") is None:
        return None
    from framework.sweeps.slurm import SlurmProcess  # imported late: Hydra imports this module at every start

    return SlurmProcess(handle, folder)


def _start(job: Job, slot: int, lock: int, environment: Mapping[str, str], engine: Engine) -> _Running | None:
    """Record that a job starts, and start it; return None if the engine refuses it."""
    job.attempts += 1
    for left in (VALUE, PRUNED):
        (job.folder / left).unlink(missing_ok=True)
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
        handle=None,
    )
    try:
        process = engine.start(job.record["command"], environment, job.folder, lock)
    except UserError as error:
        job.update(status="failed", error=str(error), ended=time.time())
        os.close(lock)
        log.info(f"#{job.number} failed: {error}")
        return None
    if process.handle is not None:
        job.update(handle=process.handle)
        os.close(lock)  # the job acquires the lock where it runs
    log.info(f"#{job.number} started: {' '.join(job.overrides)}")
    return _Running(job, process, slot, lock if process.handle is None else None)


def _end(active: _Running, code: int) -> None:
    """Record how a job ended: its status, its error message and its processor time."""
    job = active.job
    active.process.kill()  # processes that a killed job left behind, such as data loaders and other ranks
    if active.process.reason is not None:
        status, error = "died", active.process.reason
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
    if active.lock is not None:
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


def _lock(job: Job) -> int | None:
    """Lock the job's folder and return the lock's descriptor; None if a process of another sweep holds the lock.

    On a file system without locks, a warning is logged.
    """
    path = job.folder / LOCK
    locked = try_lock(path)
    if locked is None:
        return None
    descriptor, missing = locked
    if missing is not None:
        if not job.attempts and not job.unlocked:
            warn_unlocked(path, missing)
        job.unlocked = True
    return descriptor


def _wait(job: Job) -> None:
    """Log once that a job waits for its folder."""
    if not job.waits:
        log.info(f"#{job.number} waits, because a process of another sweep still uses {job.folder}")
    job.waits = True
