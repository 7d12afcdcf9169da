"""Hydra launchers that run jobs through `framework.sweeps.jobs`, each on an engine of `framework.sweeps.engines`.

Hydra imports this module at every start; therefore it imports nothing heavy.
"""

import logging
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
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
from framework.storage.files import hold_lock, remove_empty_folders
from framework.sweeps import jobs as sweep
from framework.sweeps.engines import Engine, Pool, cores
from framework.sweeps.sending import JournalSender

log = logging.getLogger(__name__)

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


class EngineLauncher(Launcher):
    """Base class of Hydra launchers; a subclass gives the engine (`framework.sweeps.engines`) that starts the jobs.

    Args:
        jobs: number of jobs that run at once; None: all.
        retries: number of times that a killed job is started again; the job then resumes from its checkpoint.
        devices: CUDA devices to assign, one to each running job; None: every job sees all devices.
        eager: whether the command returns as soon as all jobs are started, without waiting for their ends.
    """

    def __init__(
        self,
        jobs: int | None,
        retries: int,
        devices: Sequence[int | str] | None = None,
        eager: bool = False,
    ) -> None:
        self.at_once = jobs
        self.retries = retries
        self.devices = [str(device) for device in devices or ()]
        self.eager = eager
        self.launched: list[sweep.Job] = []
        self.parent: str | None = None
        self._watch: Callable[[sweep.Job], None] | None = None
        self._search: ExitStack | None = None  # what ends with the `batches` block
        self._search_engine: Engine | None = None
        self._search_sender: JournalSender | None = None

    def _check(self) -> None:
        """Raise a ConfigError if the engine is not installed or a setting is wrong; called before any job starts."""

    @abstractmethod
    def _engine(self, jobs: Sequence[sweep.Job], values: Sequence[Mapping[str, Any]]) -> Engine:
        """Return the engine that starts the jobs; `values` has the plain config of each job."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Store the sweep's config; raise a DataError if the sweep's folder contains a link or a special file."""
        self.loader = hydra_context.config_loader
        self.config = config
        require_enclosed(Path(str(config.hydra.sweep.dir)))  # before Hydra writes multirun.yaml into it

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the jobs and return their results; some sweepers call this method once for each batch of jobs.

        Args:
            job_overrides: Overrides of each job.
            initial_job_idx: Number of the first job.
        """
        # imported late: Hydra imports this module at every start
        from framework.sweeps import comparison

        setup_globals()
        hydra = self.config.hydra
        configure_log(hydra.hydra_logging, hydra.verbose)
        folder = Path(str(hydra.sweep.dir)).absolute()
        if not job_overrides:
            _remove_empty_sweep(folder)
            swept = [override for override in hydra.overrides.task if override.endswith(")")]
            raise ConfigError(
                f"{' '.join(swept) or 'The sweep'} has no value, so there is no job. Give a range that contains a "
                "number, or a glob that matches a name."
            )
        if self._search is None:
            configs, values = self.check(job_overrides, initial_job_idx)
        else:
            configs, values = self._compose(job_overrides, initial_job_idx)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with hold_lock(folder / _LOCK):  # another sweep may begin in this folder
                jobs = self._jobs(folder, configs, job_overrides, initial_job_idx)
                sweep.reserve(jobs)
        except ConfigError:
            _remove_empty_sweep(folder)
            raise
        if not self.launched:
            self.parent = comparison.begin(folder, values[0])
            if self._search is not None:
                self._search.callback(self._summarise, folder, values[0])
        self.launched += jobs
        with ExitStack() as stack:
            if self._search is None:
                stack.callback(self._summarise, folder, values[0])
            sender = self._sender_of(comparison.store_of(values[0]), stack)
            sweep.run(
                jobs,
                self._engine_of(jobs, values, stack),
                at_once=self.at_once or len(jobs),
                retries=self.retries,
                devices=self.devices,
                parent=self.parent,
                sender=sender,
                eager=self.eager,
                watch=self._watch,
            )
        if unfinished := sum(job.is_elsewhere for job in jobs):
            log.info(
                f"{unfinished} of {len(jobs)} jobs go on without this command. To wait for them and to see the table, "
                f"repeat the command with hydra.sweep.dir={folder}"
            )
        failure = self.failure()
        return [_job_return(job, failure) for job in jobs]

    @contextmanager
    def batches(self, watch: Callable[[sweep.Job], None] | None = None) -> Iterator[None]:
        """Return a context in which a search may call `launch` once for each batch of jobs.

        All batches share one engine, and the table of all jobs is printed when the context ends. In the context,
        `launch` does not check the configs of the jobs, because the search has called `check` for its whole space.

        Args:
            watch: Function that is called repeatedly for each running job; None for no function.
        """
        self._watch = watch
        try:
            with ExitStack() as self._search:
                yield
        finally:
            self._watch = self._search = self._search_engine = self._search_sender = None

    def check(
        self, job_overrides: Sequence[Sequence[str]], first: int = 0
    ) -> tuple[list[DictConfig], list[dict[str, Any]]]:
        """Check the settings of the launcher and the configs of all jobs, before any job starts.

        Args:
            job_overrides: Overrides of each job.
            first: Number of the first job; the other jobs have the numbers that follow.

        Returns:
            The composed config of each job, and the same configs as plain dictionaries.

        Raises:
            ConfigError: The engine is not installed, a setting of the launcher is wrong, or the config of a job has a
                mistake (`framework.sweeps.rehearsal`).
        """
        from framework.sweeps import rehearsal

        self._check()
        # The check runs before the lock of the folder is acquired, because it takes long and others wait.
        try:
            configs, values = self._compose(job_overrides, first)
            rehearsal.refuse_mistakes(list(zip(job_overrides, values, strict=True)))
        except ConfigError:
            _remove_empty_sweep(Path(str(self.config.hydra.sweep.dir)).absolute())
            raise
        return configs, values

    def failure(self) -> Exception | None:
        """Return an error that lists the jobs of this command that did not complete; None if all completed."""
        return sweep.failure(self.launched)

    def _compose(
        self, job_overrides: Sequence[Sequence[str]], first: int
    ) -> tuple[list[DictConfig], list[dict[str, Any]]]:
        folder = Path(str(self.config.hydra.sweep.dir)).absolute()
        configs = [self.loader.load_sweep_config(self.config, list(overrides)) for overrides in job_overrides]
        for index, config in enumerate(configs, first):
            _job_folder(folder, config, index)
        return configs, [_plain_values(config, folder) for config in configs]

    def _engine_of(
        self, jobs: Sequence[sweep.Job], values: Sequence[Mapping[str, Any]], stack: ExitStack
    ) -> Engine:
        """Return the engine of a batch, which is closed with `stack` or, in a search, with the search."""
        if self._search is None or all(job.completed for job in jobs):
            return stack.enter_context(closing(self._engine(jobs, values)))
        if self._search_engine is None:
            self._search_engine = self._search.enter_context(closing(self._engine(jobs, values)))
        return self._search_engine

    def _sender_of(self, store: str | None, stack: ExitStack) -> JournalSender | None:
        """Return what sends the journals of a batch, which ends with `stack` or, in a search, with the search."""
        if self.parent is None:
            return None
        if self._search is None:
            return stack.enter_context(JournalSender(store))
        if self._search_sender is None:
            self._search_sender = self._search.enter_context(JournalSender(store))
        return self._search_sender

    def _summarise(self, folder: Path, config: Mapping[str, Any]) -> None:
        from framework.sweeps import comparison

        comparison.summarise(folder, [job.overrides for job in self.launched], config)

    def _jobs(
        self, folder: Path, configs: Sequence[DictConfig], job_overrides: Sequence[Sequence[str]], first: int
    ) -> list[sweep.Job]:
        known = sweep.find_records(folder)
        used = {path for earlier in known.values() for path, _ in earlier}
        jobs = []
        for index, (config, arguments) in enumerate(zip(configs, job_overrides, strict=True), first):
            overrides = list(filter_overrides(arguments))
            key = sweep.short_hash(*sorted(overrides))
            if known.get(key):
                path, record = known[key].pop(0)
                number = record["number"]
            else:
                folder_of = partial(_job_folder, folder, config)
                number, record = sweep.free_number(folder_of, index, used), {}
                path = folder_of(number)
            used.add(path)
            jobs.append(
                sweep.Job(
                    number=number,
                    overrides=overrides,
                    arguments=[
                        *self._shared_arguments(),
                        *arguments,
                        f"hydra.job.num={number}",
                        f"hydra.run.dir={in_quotes(str(path))}",
                    ],
                    folder=path,
                    key=key,
                    config=sweep.short_hash(OmegaConf.to_yaml(_without_hydra(config))),
                    record=record,
                )
            )
        return jobs

    def _shared_arguments(self) -> list[str]:
        """Return the arguments that all jobs share: name and folders of the config, and overrides of Hydra's config."""
        hydra = self.config.hydra
        hydra_overrides: Any = OmegaConf.to_container(hydra.overrides.hydra, resolve=False)
        folders = [
            source.path for source in hydra.runtime.config_sources if source.provider == "command-line"
        ]
        return [  # options first, because Hydra accepts overrides only without options between them
            f"--config-name={hydra.job.config_name}",
            *(f"--config-dir={folder}" for folder in folders),
            *(override for override in hydra_overrides if not override.startswith(_OF_THE_SWEEP)),
            "hydra.mode=RUN",
        ]


class PoolLauncher(EngineLauncher):
    """Hydra launcher that runs each job of a sweep in its own process on this machine, several at once.

    Args:
        jobs: number of jobs that run at once; None: half the number of cores.
        retries: number of times that a killed job is started again; the job then resumes from its checkpoint.
        devices: CUDA devices to assign, one to each running job, such as [0, 1]; None: every job sees all devices.
        fork: whether jobs are forks of one process that has already imported the modules of their modes, which saves
            seconds per job; None: fork on Linux if there are several jobs. Every job has its own process in both cases.
    """

    def __init__(
        self,
        jobs: int | None = None,
        retries: int = 0,
        devices: Sequence[int | str] | None = None,
        fork: bool | None = None,
    ) -> None:
        self.processes = jobs or max(1, cores() // 2)
        super().__init__(self.processes, retries, devices)
        self.fork = fork

    def _engine(self, jobs: Sequence[sweep.Job], values: Sequence[Mapping[str, Any]]) -> Engine:
        from framework.modes import MODES  # imported late: Hydra imports this module at every start

        several = self._search is not None or sum(not job.completed for job in jobs) > 1
        if not (several and sys.platform == "linux" if self.fork is None else self.fork):
            return Pool(self.processes)
        modes = {(config.get("mode") or {}).get("name") for config in values} & set(MODES)
        return Pool(self.processes, [_COMPOSING, *sorted(f"framework.modes.{name}" for name in modes)])


class SlurmLauncher(EngineLauncher):
    """Hydra launcher that submits each job of a sweep to SLURM (`framework.sweeps.slurm`).

    Args:
        jobs: number of jobs that are submitted at once; None: all.
        retries: number of times that a killed job is submitted again; the job then resumes from its checkpoint.
        eager: whether the command returns as soon as all jobs are submitted. The same command, given again later,
            waits for the jobs and prints the table of their results.
        settings: resources of each job; see `SlurmSettings`.
    """

    def __init__(
        self, jobs: int | None = None, retries: int = 0, eager: bool = False, **settings: Any
    ) -> None:
        super().__init__(jobs, retries, eager=eager)
        self.settings = settings

    def _check(self) -> None:
        from framework.configuration.schema import check
        from framework.sweeps import slurm

        slurm.require_programs()
        self.checked = slurm.SlurmSettings(**check(slurm.SlurmSettings, self.settings, "hydra.launcher"))

    def _engine(self, jobs: Sequence[sweep.Job], values: Sequence[Mapping[str, Any]]) -> Engine:
        from framework.sweeps import slurm

        return slurm.Slurm(Path(str(self.config.hydra.sweep.dir)).absolute(), self.checked)


class RayLauncher(EngineLauncher):
    """Hydra launcher that runs each job of a sweep as a task of Ray (`framework.sweeps.ray_tasks`).

    Args:
        jobs: number of tasks that are submitted at once; None: all, and Ray runs those for which there are resources.
        retries: number of times that a killed job is started again; the job then resumes from its checkpoint.
        settings: cluster, and resources of each job; see `RaySettings`.
    """

    def __init__(self, jobs: int | None = None, retries: int = 0, **settings: Any) -> None:
        super().__init__(jobs, retries)
        self.settings = settings

    def _check(self) -> None:
        from framework.configuration.schema import check
        from framework.sweeps import ray_tasks
        from framework.sweeps.engines import require_module

        require_module("ray", "ray", "hydra/launcher=ray")
        self.checked = ray_tasks.RaySettings(**check(ray_tasks.RaySettings, self.settings, "hydra.launcher"))

    def _engine(self, jobs: Sequence[sweep.Job], values: Sequence[Mapping[str, Any]]) -> Engine:
        from framework.sweeps import ray_tasks

        return ray_tasks.Ray(self.checked, connect=not all(job.completed for job in jobs))


def _remove_empty_sweep(folder: Path) -> None:
    """Remove the folder of a sweep that never began, if it contains no files but Hydra's multirun.yaml and the lock."""
    files = list(folder.glob("*"))
    if {file.name for file in files} <= {"multirun.yaml", _LOCK}:
        for file in files:
            file.unlink()
        remove_empty_folders(folder)  # it stays if another sweep has begun in it


def _job_return(job: sweep.Job, failure: Exception | None) -> JobReturn:
    # a job that goes on without this command has no value yet, and is not a failure
    status = JobStatus.COMPLETED if job.completed or job.is_elsewhere else JobStatus.FAILED
    job_return = JobReturn(overrides=job.overrides, working_dir=str(job.folder), status=status)
    job_return.return_value = job.value() if job.completed else None if job.is_elsewhere else failure
    return job_return


def _job_folder(folder: Path, config: DictConfig, number: int) -> Path:
    with (
        read_write(config),
        read_write(config.hydra),
        open_dict(config),
    ):  # `_plain_values` closes the inner config
        config.hydra.job.num = number
        config.hydra.job.id = str(number)
    return folder / str(config.hydra.sweep.subdir)


def _without_hydra(config: DictConfig) -> DictConfig:
    return OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])


def _plain_values(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Return a job's config as plain values, without Hydra's own keys. Its run folder is the folder of the sweep."""
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
