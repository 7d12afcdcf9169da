"""Engines that start the jobs of a sweep: the interface of all engines, and the pool of processes on this machine.

A job is the same on every engine: a command, a folder and a record (`framework.sweeps.jobs.Job`). An engine only starts
a job, notices its end, and cancels it. If its jobs outlive the launcher, a later launcher can also watch and cancel
jobs that an earlier launcher has started.
"""

import os
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from framework.errors import ConfigError
from framework.sweeps.processes import Forks, Process, SeparateProcess, Starter

CONSOLE = "console.log"
LOCK = ".lock"


class Engine(Protocol):
    """Protocol of an engine.

    Attributes:
        threads: Number of threads of each job, for which `OMP_NUM_THREADS` is set unless the user has set it.
        interval: Seconds between two looks at the running jobs.
        outlives: Whether the engine's jobs continue when the launcher has ended.
    """

    threads: int
    interval: float
    outlives: bool

    def start(
        self, command: Sequence[str], environment: Mapping[str, str], folder: Path, lock: int
    ) -> Process:
        """Start a job.

        Args:
            command: Python command of the job.
            environment: Environment variables of the job in addition to those of its machine.
            folder: Absolute path of the job's folder, whose file `CONSOLE` receives the job's output.
            lock: Descriptor of the lock of that folder, which the caller holds. If the returned process has a handle,
                the caller records the handle and releases the lock, and the job acquires the lock itself. Otherwise the
                job inherits the descriptor.

        Raises:
            UserError: The engine refuses the job.
        """
        ...

    def close(self) -> None:
        """Release what the engine holds in this process, after the jobs have ended; jobs that outlive it go on."""
        ...


class Pool:
    """Engine that runs each job in a process on this machine.

    Args:
        at_once: Number of jobs that run at the same time; each gets an equal part of the cores.
        modules: Modules that a server process imports before it is forked for each job; None: no forks.
    """

    interval = 0.05
    outlives = False

    def __init__(self, at_once: int, modules: Sequence[str] | None = None) -> None:
        # The cores are divided by `at_once`, not by the number of jobs, because results depend on the number of threads
        # in the last bits, and a resumed job must give the same bits as an uninterrupted one.
        self.threads = max(1, cores() // at_once)
        self._forks = None if modules is None else Forks(modules)
        self._starter: Starter = self._forks or SeparateProcess

    def start(
        self, command: Sequence[str], environment: Mapping[str, str], folder: Path, lock: int
    ) -> Process:
        with (folder / CONSOLE).open("ab") as console:
            return self._starter(command, {**os.environ, **environment}, console.fileno(), lock)

    def close(self) -> None:
        if self._forks is not None:
            self._forks.close()


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def require_module(name: str, extra: str, choice: str) -> None:
    """Refuse a launcher or sweeper if the package on which it is built is not installed.

    Args:
        name: Name of the package's module.
        extra: Name of the optional dependency that installs the package.
        choice: Override that chooses the launcher or sweeper.

    Raises:
        ConfigError: The package is missing.
    """
    if find_spec(name) is None:
        raise ConfigError(
            f"{choice} needs the package {name}, which is not installed. Install it: "
            f"pip install 'robust-visual-learning[{extra}]'"
        )
