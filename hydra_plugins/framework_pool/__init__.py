"""Hydra launcher that runs jobs through `framework.sweeps.jobs`.

Hydra imports this module at every start; therefore it imports nothing heavy.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from framework.configuration.composition import in_quotes
from framework.errors import ConfigError
from framework.storage.enclosed import require_enclosed
from framework.storage.files import hold_lock
from framework.sweeps import jobs as sweep
from framework.sweeps.processes import Forks, Fresh, Starter

_OF_THE_SWEEP = (
    "hydra/launcher",
    "hydra.launcher",
    "hydra/sweeper",
    "hydra.sweeper",
    "hydra.sweep.",
    "hydra.mode=",
)
_LOCK = ".numbers.lock"
_COMPOSING = "framework.configuration.composition"


class PoolLauncher(Launcher):
    """Launcher that runs each job of a multirun as its own process, several at once; see `framework.sweeps.jobs`.

    Args:
        jobs: number of jobs that run at once; None for half the cores.
        retries: how often a job that was killed is started again (it resumes from its checkpoint).
        devices: CUDA devices to assign, one to each running job, e.g. [0, 1]; None shows all devices to all jobs.
        fork: whether jobs are forks of one process that has already imported what their modes need, which would take
            each job seconds; None forks on Linux if there are several jobs. A job is its own process either way.
    """

    def __init__(
        self,
        jobs: int | None = None,
        retries: int = 0,
        devices: Sequence[int | str] | None = None,
        fork: bool | None = None,
    ) -> None:
        self.at_once = jobs or max(1, sweep.cores() // 2)
        self.retries = retries
        self.devices = [str(device) for device in devices or ()]
        self.fork = fork
        self.launched: list[list[str]] = []
        self.parent: str | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keep the sweep's configuration, and refuse a sweep folder that is not enclosed."""
        self.loader = hydra_context.config_loader
        self.config = config
        require_enclosed(Path(str(config.hydra.sweep.dir)))  # before Hydra writes multirun.yaml into it

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the jobs and return their results; some sweepers call this once for each batch of jobs."""
        from framework.sweeps import (
            comparison,
            rehearsal,
        )  # imported late: Hydra imports this module at every start

        setup_globals()
        hydra = self.config.hydra
        configure_log(hydra.hydra_logging, hydra.verbose)
        folder = Path(str(hydra.sweep.dir)).absolute()
        if not job_overrides:
            _leave_nothing(folder)
            swept = [one for one in hydra.overrides.task if one.endswith(")")]
            raise ConfigError(
                f"{' '.join(swept) or 'The sweep'} has no value, so there is no job. Give a range that holds a number, "
                "or a glob that fits a name."
            )
        configs = [self.loader.load_sweep_config(self.config, list(overrides)) for overrides in job_overrides]
        # number the jobs for the rehearsal, which runs before the lock because it takes long and other sweeps wait
        for index, config in enumerate(configs, initial_job_idx):
            _place(folder, config, index)
        try:
            values = [_plain(config, folder) for config in configs]
            rehearsal.refuse_mistakes(list(zip(job_overrides, values, strict=True)))
            folder.mkdir(parents=True, exist_ok=True)
            with hold_lock(folder / _LOCK):  # another sweep may begin in this folder
                jobs = self._jobs(folder, configs, job_overrides, initial_job_idx)
                sweep.reserve(jobs)
        except ConfigError:
            _leave_nothing(folder)
            raise
        if not self.launched:
            self.parent = comparison.begin(folder, values[0])
        self.launched += [job.overrides for job in jobs]
        try:
            with self._starter(jobs, values) as starter:
                sweep.run(
                    jobs,
                    at_once=self.at_once,
                    retries=self.retries,
                    devices=self.devices,
                    parent=self.parent,
                    starter=starter,
                    store=comparison.store_of(values[0]),
                )
        finally:
            comparison.summarise(folder, self.launched, values[0])
        failure = sweep.failure(jobs)
        return [_returned(job, failure) for job in jobs]

    @contextmanager
    def _starter(self, jobs: Sequence[sweep.Job], values: Sequence[Mapping[str, Any]]) -> Iterator[Starter]:
        from framework.modes import MODES  # imported late: Hydra imports this module at every start

        several = sum(not job.completed for job in jobs) > 1
        if not (several and sys.platform == "linux" if self.fork is None else self.fork):
            yield Fresh
            return
        modes = {(one.get("mode") or {}).get("name") for one in values} & set(MODES)
        forks = Forks([_COMPOSING, *sorted(f"framework.modes.{name}" for name in modes)])
        try:
            yield forks
        finally:
            forks.close()

    def _jobs(
        self, folder: Path, configs: Sequence[DictConfig], job_overrides: Sequence[Sequence[str]], first: int
    ) -> list[sweep.Job]:
        known = sweep.records(folder)
        taken = {path for earlier in known.values() for path, _ in earlier}
        jobs = []
        for index, (config, given) in enumerate(zip(configs, job_overrides, strict=True), first):
            overrides = list(filter_overrides(given))
            key = sweep.hashed(*sorted(overrides))
            if known.get(key):
                path, record = known[key].pop(0)
                number = record["number"]
            else:
                place = partial(_place, folder, config)
                number, record = sweep.free_number(place, index, taken), {}
                path = place(number)
            taken.add(path)
            jobs.append(
                sweep.Job(
                    number=number,
                    overrides=overrides,
                    arguments=[
                        *self._passed_on(),
                        *given,
                        f"hydra.job.num={number}",
                        f"hydra.run.dir={in_quotes(str(path))}",
                    ],
                    folder=path,
                    key=key,
                    config=sweep.hashed(OmegaConf.to_yaml(_without_hydra(config))),
                    record=record,
                )
            )
        return jobs

    def _passed_on(self) -> list[str]:
        """Return the other arguments of the sweep's command line that a job needs to compose the same configuration."""
        hydra = self.config.hydra
        given: Any = OmegaConf.to_container(hydra.overrides.hydra, resolve=False)
        folders = [
            source.path for source in hydra.runtime.config_sources if source.provider == "command-line"
        ]
        return [  # options first: Hydra takes overrides in one piece only
            f"--config-name={hydra.job.config_name}",
            *(f"--config-dir={folder}" for folder in folders),
            *(override for override in given if not override.startswith(_OF_THE_SWEEP)),
            "hydra.mode=RUN",
        ]


def _leave_nothing(folder: Path) -> None:
    """Remove the folder of a sweep that never began, if it holds only the command that Hydra wrote into it."""
    left = list(folder.glob("*"))
    if {file.name for file in left} <= {"multirun.yaml", _LOCK}:
        for file in left:
            file.unlink()
        with suppress(OSError):  # another sweep may begin in it
            folder.rmdir()


def _returned(job: sweep.Job, failure: Exception | None) -> JobReturn:
    status = JobStatus.COMPLETED if job.completed else JobStatus.FAILED
    found = JobReturn(overrides=job.overrides, working_dir=str(job.folder), status=status)
    found.return_value = job.value() if job.completed else failure
    return found


def _place(folder: Path, config: DictConfig, number: int) -> Path:
    with read_write(config), read_write(config.hydra), open_dict(config):  # `_plain` has closed the inner one
        config.hydra.job.num = number
        config.hydra.job.id = str(number)
    return folder / str(config.hydra.sweep.subdir)


def _without_hydra(config: DictConfig) -> DictConfig:
    return OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])


def _plain(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Return a job's configuration as plain values, as the job itself will see it except for its folder."""
    with read_write(config), read_write(config.hydra), open_dict(config):
        config.hydra.runtime.output_dir = str(folder)
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)
    try:
        values = OmegaConf.to_container(_without_hydra(config), resolve=True)
    finally:
        HydraConfig.instance().cfg = before
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}
