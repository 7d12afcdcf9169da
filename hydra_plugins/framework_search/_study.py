"""Optuna's study of a search: its storage, the trials that it suggests, and the values and losses of the trials."""

import json
import logging
import math
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, NSGAIISampler, QMCSampler, RandomSampler, TPESampler
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial

from framework.errors import ConfigError, UserError, shorten
from framework.runs.job import PRUNED
from framework.storage.files import hold_lock, write_whole
from framework.storage.reading import translate_errors
from framework.sweeps.jobs import Job, short_hash
from framework.tracking.journal import Journal
from framework.tracking.stores import require_no_password, without_password
from hydra_plugins.framework_search._space import Choice, Domain, overrides_of

FILE, LOCK = "study.jsonl", ".study.lock"
REMEDY = "Delete the file and repeat the command; jobs that have completed do not run again."
"""Advice for a damaged file of a study."""
REPEATS = 100
"""Number of consecutive suggestions that only repeat earlier trials, after which a search counts as converged."""
INTERVAL = 0.5
"""Smallest time, seconds, between two readings of the validation losses of a running trial."""
COMMAND, WAYS, FOLDER = "command", "ways", "folder"
"""Names of attributes that Optuna stores.

COMMAND, an attribute of the study, holds the search space, the fixed overrides and the names of the metrics. WAYS, also
of the study, holds the directions of the metrics. FOLDER, an attribute of each trial in a database, holds a hash of the
path of the sweep's folder.
"""

log = logging.getLogger(__name__)


@dataclass
class Point:
    """Point of the search space with everything that the study knows of it; several trials may have this point.

    Attributes:
        overrides: Overrides of the point.
        params: Values of the point, as the study stores them.
        number: Number of the first trial.
        state: State of the trial that says most about the point: complete, pruned, running or failed.
        values: Values of the metrics, the lower the better; empty unless the state is complete.
        is_own: Whether the point's job is or was in the folder of this sweep.
    """

    overrides: list[str]
    params: dict[str, Any]
    number: int
    state: TrialState
    values: list[float]
    is_own: bool


_INFORMATIVE = (
    TrialState.FAIL,
    TrialState.WAITING,
    TrialState.RUNNING,
    TrialState.PRUNED,
    TrialState.COMPLETE,
)
"""States of a trial, the one that says most about its point last."""


@dataclass
class _Losses:
    """Validation losses of a running trial, as far as the study knows them."""

    trial: Trial
    journal: Journal | None = None
    file: int = -1
    read: int = 0
    epoch: int = -1
    looked: float = field(default=-math.inf)


@dataclass(frozen=True)
class Sampling:
    """Settings of the sampler and the pruner.

    Attributes:
        sampler: "tpe", "random", "quasi_random" or "nsga2".
        seed: Seed of the sampler.
        population: Number of trials of a generation of "nsga2".
        pruner: "median" or "halving"; None: no trial is pruned.
    """

    sampler: str
    seed: int
    population: int
    pruner: str | None = None


class Study:
    """Study of a search; several commands may work on it at the same time.

    What a sampler suggests is a function of the seed, the number of the trial and the trials that have ended, so that a
    search that goes on does not repeat its draws.

    Args:
        folder: Folder of the sweep.
        storage: Address of a PostgreSQL database; None: the file `FILE` in the folder.
        name: Name of the study in the database.
        space: Search space.
        fixed: Overrides that change the result of a trial and are the same for all trials.
        metrics: Names of the metrics.
        sampling: Settings of the sampler and the pruner.

    Raises:
        ConfigError: The database cannot be reached, or the study belongs to another search.
        DataError: The file is damaged.
    """

    def __init__(
        self,
        folder: Path,
        storage: str | None,
        name: str,
        space: Mapping[str, Domain],
        fixed: Sequence[str],
        metrics: Sequence[str],
        sampling: Sampling,
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.folder = folder
        self.space = space
        self.storage = storage
        self._distributions = {key: _distribution(domain) for key, domain in space.items() if domain.size > 1}
        self._losses: dict[str, _Losses] = {}
        self._home = "" if storage is None else short_hash(str(folder))
        with self._reached():
            self._study = optuna.create_study(
                study_name=name,
                storage=_open_file(folder) if storage is None else _open_database(storage),
                directions=[StudyDirection.MINIMIZE] * len(metrics),
                load_if_exists=True,
                sampler=SeededSampler(sampling),
                pruner=_pruner(sampling.pruner),
            )
            self._require_same(sorted(fixed), list(metrics))

    @property
    def varied(self) -> list[str]:
        """Return the keys with several values, without prefix."""
        return [key.lstrip("+") for key in self._distributions]

    @property
    def ways(self) -> list[str | None]:
        """Return the direction of each metric, "minimize" or "maximize"; None for each metric before `store_ways`."""
        with self._reached():
            stored = self._study.user_attrs.get(WAYS, [None] * len(self._study.directions))
            known = {"minimize", "maximize", None}
            if len(stored) != len(self._study.directions) or not known.issuperset(stored):
                raise ValueError(f"the directions of the metrics are {shorten(stored)}")
        return stored

    def store_ways(self, ways: Sequence[str]) -> None:
        """Store the direction of each metric, "minimize" or "maximize".

        The values that `tell` stores do not depend on the directions: their sign is such that lower values are better.
        """
        with self._reached():
            self._study.set_user_attr(WAYS, list(ways))

    def take_up(self, is_running: Callable[[Sequence[str]], bool]) -> None:
        """Let `suggest` return again the trials of this sweep's folder that failed, or whose command was killed.

        Args:
            is_running: Function that returns whether the job with the given overrides runs now.
        """
        with self._reached(), hold_lock(self.folder / LOCK):
            for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
                if self._is_here(trial) and not is_running(self._overrides(trial.params)):
                    self._finish(trial.number, TrialState.FAIL)
            for point in self.points():
                if point.state == TrialState.FAIL and point.is_own:
                    self._enqueue(point.params)

    def take_over(self) -> bool:
        """Let `suggest` return again the trials that other commands run in this sweep's folder.

        The launcher does not start the job of such a trial a second time, but waits for its end.

        Returns:
            Whether there are such trials.
        """
        with self._reached(), hold_lock(self.folder / LOCK):
            trials = self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
            running = [trial for trial in trials if self._is_here(trial)]
            for trial in running:
                self._finish(trial.number, TrialState.FAIL)
                if set(trial.params) == set(self._distributions):
                    self._enqueue(trial.params)
        return bool(running)

    def points(self) -> list[Point]:
        """Return the points of all trials, in the order in which they were suggested first."""
        points: dict[tuple[str, ...], Point] = {}
        with self._reached():
            for trial in self._study.get_trials(deepcopy=False):
                params = trial.params or trial.system_attrs.get("fixed_params", {})
                if set(params) != set(self._distributions):
                    continue  # another command draws the values of this trial, or was killed before it had all
                overrides = self._overrides(params)
                complete = trial.state == TrialState.COMPLETE
                values: list[float] = list(trial.values or ()) if complete else []
                point = Point(overrides, params, trial.number, trial.state, values, self._is_here(trial))
                earlier = points.setdefault(tuple(overrides), point)
                if _INFORMATIVE.index(trial.state) > _INFORMATIVE.index(earlier.state):
                    earlier.state, earlier.values = trial.state, values
                earlier.is_own = earlier.is_own or point.is_own
        return list(points.values())

    def suggest(self, count: int, trials: int) -> list[list[str]]:
        """Return the overrides of the next trials, none of which repeats another trial of the study.

        If the sampler suggests an earlier trial again, Optuna gets the values of the earlier trial for the repetition.

        Args:
            count: Largest number of trials to return.
            trials: Number of different points after which the search ends.

        Returns:
            At most `count` trials; fewer if the study then has `trials` points, if it has every point of its space, or
            if the sampler suggests only what it has suggested before.
        """
        suggested: list[list[str]] = []
        largest = math.prod(domain.size for domain in self.space.values())
        repeats = 0
        with self._reached(), hold_lock(self.folder / LOCK):
            points = {tuple(point.overrides): point for point in self.points()}
            waiting = {key for key, point in points.items() if point.state == TrialState.WAITING}
            while len(suggested) < count and repeats < REPEATS:
                if len(points) >= min(trials, largest) and not waiting:
                    break
                trial = self._study.ask(self._distributions)
                _ = trial.relative_params  # gives a trial that was enqueued a generation too
                if self._home:
                    trial.set_user_attr(FOLDER, self._home)
                overrides = self._overrides(trial.params)
                key = tuple(overrides)
                if key not in points or key in waiting:
                    repeats = 0
                    suggested.append(overrides)
                    waiting.discard(key)
                    points[key] = Point(overrides, trial.params, trial.number, TrialState.RUNNING, [], True)
                    self._losses[_key(overrides)] = _Losses(trial)
                    continue
                repeats += 1
                if points[key].state == TrialState.COMPLETE:
                    self._study.tell(trial, points[key].values)
                else:
                    self._study.tell(trial, state=TrialState.FAIL)
        if repeats == REPEATS:
            log.info(f"the sampler has suggested no new trial {REPEATS} times in a row, so the search ends")
        return suggested

    def tell(self, overrides: Sequence[str], values: Sequence[float] | None, *, pruned: bool = False) -> None:
        """Store how a suggested trial has ended.

        Args:
            overrides: Overrides of the trial.
            values: Values of the metrics, the lower the better; None for a trial that failed or was pruned.
            pruned: Whether the trial was pruned.
        """
        trial = self._losses.pop(_key(overrides)).trial
        with self._reached():
            if values is not None and all(map(math.isfinite, values)):
                if not self._finish(trial.number, TrialState.COMPLETE, list(values)):
                    self._study.add_trial(
                        create_trial(values=values, params=trial.params, distributions=self._distributions)
                    )
            else:
                self._finish(trial.number, TrialState.PRUNED if pruned else TrialState.FAIL)

    def watch(self, job: Job) -> None:
        """Store the new validation losses of a running job, and ask it to stop if the pruner finds them too high."""
        losses = self._losses.get(job.key)
        if losses is None or time.monotonic() - losses.looked < INTERVAL:
            return
        losses.looked = time.monotonic()
        path = job.folder / "journal.jsonl"
        if not path.is_file() or (job.folder / PRUNED).is_file():
            return
        number = path.stat().st_ino
        if losses.journal is None or number != losses.file:  # a resumed run replaces its journal
            losses.journal, losses.file, losses.read = Journal(path), number, 0
        before = losses.epoch
        while records := losses.journal.read(losses.read):
            losses.read = records[-1]["n"]
            for record in records:
                loss = record.get("values", {}).get("validation/loss")
                if loss is not None and record["epoch"] > losses.epoch:
                    losses.epoch = record["epoch"]
                    with self._reached(), suppress(optuna.exceptions.UpdateFinishedTrialError):
                        losses.trial.report(float(loss), losses.epoch)
        if losses.epoch == before:
            return
        with self._reached():
            prune = losses.trial.should_prune()
        if prune:
            sentence = (
                f"The validation loss of epoch {losses.epoch + 1} is higher than that of other trials.\n"
            )
            write_whole(job.folder / PRUNED, sentence.encode())
            log.info(f"#{job.number} is asked to stop after epoch {losses.epoch + 1}")

    def _finish(self, number: int, state: TrialState, values: Sequence[float] | None = None) -> bool:
        """End a trial, and return whether it has this state now; another command may have ended it differently."""
        try:
            return self._study.tell(number, values, state, skip_if_finished=True).state == state
        except optuna.exceptions.UpdateFinishedTrialError:  # it ended at this moment
            return False

    def _enqueue(self, params: dict[str, Any]) -> None:
        self._study.enqueue_trial(params, user_attrs={FOLDER: self._home} if self._home else None)

    def _overrides(self, params: Mapping[str, Any]) -> list[str]:
        values = {key: domain.at(0.0) for key, domain in self.space.items()}
        for key, value in params.items():
            domain = self.space[key]
            values[key] = str(value) if isinstance(domain, Choice) else domain.text(value)
        return overrides_of(values)

    def _is_here(self, trial: FrozenTrial) -> bool:
        return trial.user_attrs.get(FOLDER, self._home) == self._home

    def _require_same(self, fixed: list[str], metrics: list[str]) -> None:
        """Refuse a study that was begun for another search space, other settings or other metrics."""
        space = {key: repr(distribution) for key, distribution in self._distributions.items()}
        command = {"space": space, "fixed": fixed, "metrics": metrics}
        known = self._study.user_attrs.get(COMMAND)
        if known is None:
            self._study.set_user_attr(COMMAND, command)
        elif known != json.loads(json.dumps(command)):
            part = next(part for part in command if command[part] != known.get(part))
            raise ConfigError(
                f"The study in {self._place} was begun with {part} {shorten(known.get(part))}, but this command has "
                f"{shorten(command[part])}. Repeat the first command, or give another folder (hydra.sweep.dir)"
                + (". " if self.storage is None else " or another name (hydra.sweeper.study).")
            )

    @property
    def _place(self) -> str:
        return str(self.folder / FILE) if self.storage is None else without_password(self.storage)

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """Convert errors inside the block to errors with a sentence for users.

        They come from a file of an untrusted source, or from a database that cannot be reached.
        """
        from sqlalchemy.exc import SQLAlchemyError

        try:
            yield
        except (UserError, OSError):  # the disk may be full
            raise
        except (optuna.exceptions.StorageInternalError, SQLAlchemyError) as error:
            raise _unreachable(self.storage or "", error) from error
        except Exception:
            if self.storage is not None:
                raise
            with translate_errors(self.folder / FILE, "a study of Optuna", REMEDY):
                raise


class SeededSampler(BaseSampler):
    """Sampler of Optuna that is seeded anew for each trial, by the number of the trial.

    Args:
        settings: Settings of the sampler.
    """

    def __init__(self, settings: Sampling) -> None:
        self.settings = settings
        self.before_trial(None, None)

    def before_trial(self, study: Any, trial: Any) -> None:
        """Seed the sampler by the number of a trial; None for `trial` seeds it before the first trial."""
        number = -1 if trial is None else trial.number
        seed, other = (_seed(self.settings.seed, number, use) for use in ("sampler", "independent"))
        # Mutations of NSGA-II are drawn independently. Optuna gives the same seed to both, which would correlate them.
        self._independent: BaseSampler | None = (
            RandomSampler(other) if self.settings.sampler == "nsga2" else None
        )
        match self.settings.sampler:
            case "tpe":
                self._sampler: BaseSampler = TPESampler(seed=seed)
            case "random":
                self._sampler = RandomSampler(seed)
            case "nsga2":
                self._sampler = NSGAIISampler(seed=seed, population_size=self.settings.population)
            case "quasi_random":  # a point of the sequence is determined by its index, which the study counts
                with warnings.catch_warnings():  # Optuna may change the interface
                    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                    self._sampler = QMCSampler(seed=_seed(self.settings.seed, 0, "sampler"), scramble=True)

    def infer_relative_search_space(self, study: Any, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """Return the parameters that the sampler draws jointly (Optuna's relative search space)."""
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Any, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Draw the parameters in `search_space` jointly, and return their values by name."""
        return self._sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: Any, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Draw one parameter independently of the others, and return its value."""
        sampler = self._independent or self._sampler
        return sampler.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: Any, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """Let the sampler store what it needs of a trial that has ended."""
        self._sampler.after_trial(study, trial, state, values)


class _FileLock(JournalFileOpenLock):
    """Lock of the file of a study, which ends with its process even if that is killed.

    Optuna's own locks are links or files that a killed process leaves behind. A line that a killed process wrote only
    in part is removed, because Optuna could not read the file any more after the next line.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path = path

    def acquire(self) -> bool:
        """Wait for the lock."""
        self._acquired = hold_lock(self._path.with_name(f".{self._path.name}.lock"))
        self._acquired.__enter__()
        with self._path.open("rb+") as file:
            end = file.seek(0, 2)
            file.seek(max(0, end - 1))
            if end and file.read(1) != b"\n":
                file.seek(0)
                file.truncate(file.read().rfind(b"\n") + 1)
        return True

    def release(self) -> None:
        """Release the lock."""
        self._acquired.__exit__(None, None, None)


def _open_file(folder: Path) -> BaseStorage:
    path = folder / FILE
    with translate_errors(path, "a study of Optuna", REMEDY):
        return JournalStorage(JournalFileBackend(str(path), lock_obj=_FileLock(path)))


def require_address(storage: str) -> None:
    """Refuse an address that is not one of PostgreSQL, or that contains a password.

    Raises:
        ConfigError: The address is refused.
    """
    if not re.match(r"postgresql(\+\w+)?://", storage):
        raise ConfigError(
            f"hydra.sweeper.storage={shorten(without_password(storage))}: expected "
            "postgresql://<user>@<host>/<database>, or null for a file in the folder of the sweep."
        )
    try:
        require_no_password(storage)
    except ConfigError:
        raise ConfigError(
            f"hydra.sweeper.storage={shorten(without_password(storage))} was given with a password, which is refused, "
            "because commands and configs are stored and other users can see them. Put the password into the "
            "environment variable PGPASSWORD or the file ~/.pgpass, and leave it out of the address."
        ) from None


def _open_database(storage: str) -> BaseStorage:
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import SQLAlchemyError

    try:
        url = make_url(storage)
        if url.drivername == "postgresql":
            url = url.set(drivername="postgresql+psycopg2")
        return RDBStorage(
            url.render_as_string(hide_password=False), engine_kwargs={"connect_args": {"connect_timeout": 10}}
        )
    except ImportError as error:
        raise ConfigError(
            f"hydra.sweeper.storage={without_password(storage)} needs a driver for PostgreSQL that is not installed "
            f"({shorten(error)}). Install it: pip install psycopg2-binary"
        ) from error
    except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
        raise _unreachable(storage, error) from error


def _unreachable(storage: str, error: Exception) -> ConfigError:
    reason = str(error.__cause__ or error).splitlines()[0]
    return ConfigError(
        f"The study in hydra.sweeper.storage={shorten(without_password(storage))} cannot be reached "
        f"({shorten(without_password(reason))}). Start the database or correct the address, and repeat the command "
        "with the same hydra.sweep.dir; trials that have ended do not run again."
    )


def _pruner(name: str | None) -> BasePruner:
    match name:
        case "median":
            return MedianPruner()
        case "halving":
            return SuccessiveHalvingPruner()
        case _:
            return NopPruner()


def _distribution(domain: Domain) -> BaseDistribution:
    """Return the distribution of a domain with several values."""
    if not isinstance(domain, Choice):
        if domain.whole:
            return IntDistribution(int(domain.start), int(domain.end) - 1, log=domain.logarithmic)
        return FloatDistribution(
            domain.start, math.nextafter(domain.end, domain.start), log=domain.logarithmic
        )
    if isinstance(domain.options, range):
        low, high = sorted((domain.options[0], domain.options[-1]))
        return IntDistribution(low, high, step=abs(domain.options.step))
    return CategoricalDistribution(list(dict.fromkeys(map(str, domain.options))))


def _seed(seed: int, number: int, use: str) -> int:
    return int.from_bytes(sha256(f"{seed}\0{number}\0{use}".encode()).digest()[:4], "big")


def _key(overrides: Sequence[str]) -> str:
    """Return the key of the job with some overrides (`framework.sweeps.jobs.Job.key`)."""
    return short_hash(*sorted(overrides))
