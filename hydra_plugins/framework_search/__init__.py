"""Hydra sweepers for searches: random points of a space, and the samplers of Optuna.

Hydra imports this module at every start; therefore it imports nothing heavy.
"""

import logging
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from framework.errors import ConfigError, count_of, did_you_mean
from hydra_plugins.framework_pool import EngineLauncher

if TYPE_CHECKING:
    from framework.sweeps.ranking import Trial
    from hydra_plugins.framework_search._space import Domain
    from hydra_plugins.framework_search._study import Study

DIRECTIONS = ("minimize", "maximize")
SAMPLERS = ("tpe", "random", "quasi_random", "nsga2")
PRUNERS = ("median", "halving")
INDEPENDENT = ("random", "quasi_random")
"""Samplers whose suggestions do not depend on the values of earlier trials, so that all trials can run at once."""
AT_ONCE = 10
"""Number of trials that run at once with a launcher that has no limit."""

log = logging.getLogger(__name__)


class Search(Sweeper):
    """Hydra sweeper that runs trials of a search space, ranks them, and writes the best one as an experiment.

    Args:
        name: name of the sweeper.
        trials: number of different trials; if the search space has fewer points, every point is run once.
        seed: seed of the search.
        metric: key of results.json by which trials are ranked; None: the value that a job returns, its best validation
            loss in nats. A list of two keys asks for the Pareto front.
        direction: "minimize" or "maximize", for each metric; None: the direction that the metric declares.
        params: sweeps by key, in Hydra's grammar; a sweep of the same key on the command line takes precedence.
    """

    def __init__(
        self,
        name: str,
        trials: int,
        seed: int,
        metric: str | Sequence[str | None] | None,
        direction: str | Sequence[str | None] | None,
        params: Mapping[str, Any] | None,
    ) -> None:
        self.name = name
        self.trials = trials
        self.seed = seed
        self.metrics = _as_list(metric)
        self.directions = _as_list(direction)
        if self.directions == [None]:
            self.directions *= len(self.metrics)
        self.params = dict(params or {})

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Store the config, and create the launcher that the config chooses."""
        self.hydra_context = hydra_context
        self.config = config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> list[Sequence[JobReturn]]:
        """Run the trials, rank them, and return their results.

        Raises:
            ConfigError: a setting or a sweep is invalid; raised before any job runs.
            Exception: the error of a failed job; raised after all jobs have ended.
        """
        from hydra_plugins.framework_search import _space

        assert self.config is not None
        assert self.hydra_context is not None
        self._check()
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        overrides = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        space = _space.parse_space(parser.parse_overrides(overrides))
        folder = Path(str(self.config.hydra.sweep.dir))
        returned, trials, description = self._run(folder, space)
        self._rank(folder, space, trials, description, self.hydra_context.config_loader)
        if isinstance(self.launcher, EngineLauncher) and (failure := self.launcher.failure()) is not None:
            raise failure
        for result in returned:
            _ = result.return_value  # raises the error of a failed job
        return [returned]

    @abstractmethod
    def _run(self, folder: Path, space: "Mapping[str, Domain]") -> "tuple[list[JobReturn], list[Trial], str]":
        """Run the trials; return the results of this command's jobs, all trials of the search, and its name."""

    def _check(self) -> None:
        """Raise a ConfigError if a setting has an invalid value."""
        self._require_whole("trials", 1)
        self._require_whole("seed", 0)
        for direction in self.directions:
            self._require_one_of("direction", direction, DIRECTIONS)
        if len(self.metrics) > 2 or any(not isinstance(metric, str | None) for metric in self.metrics):
            raise ConfigError(
                f"hydra.sweeper.metric = {self.metrics!r}, but must be one or two keys of results.json, or null."
            )
        if len(set(self.metrics)) < len(self.metrics):
            raise ConfigError(
                f"hydra.sweeper.metric = {self.metrics!r} has the same metric twice. Give another one."
            )
        if len(self.directions) != len(self.metrics):
            raise ConfigError(
                f"hydra.sweeper.direction has {len(self.directions)} entries, but there are {len(self.metrics)} "
                "metrics. Give one direction for each metric, or null."
            )

    def _require_whole(self, name: str, least: int) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ConfigError(
                f"hydra.sweeper.{name} = {value!r}, but a whole number of at least {least} is required."
            )

    def _require_one_of(self, name: str, value: object, options: Sequence[str], *, null: bool = True) -> None:
        if value not in (*options, *[None] * null):
            listed = [*options, *["null"] * null]
            raise ConfigError(
                f"hydra.sweeper.{name} = {value!r}, but must be {', '.join(listed[:-1])} or {listed[-1]}."
                f"{did_you_mean(str(value), options)}"
            )

    def _begin(self, folder: Path) -> None:
        """Create the folder of the sweep, and write the config of the command into it."""
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, folder / "multirun.yaml")

    def _rank(
        self,
        folder: Path,
        space: "Mapping[str, Domain]",
        trials: "Sequence[Trial]",
        description: str,
        loader: ConfigLoader,
    ) -> None:
        from framework.sweeps import ranking  # imported late: Hydra imports this module at every start
        from hydra_plugins.framework_search import _best

        varied = [key for key, domain in space.items() if domain.size > 1]
        result = ranking.rank(folder, trials, varied, self.metrics, self.directions)
        summary = "no trial has a finite value"
        if result.best is not None:
            summary = f"{result.summary}; trial {result.best.folder.name} of {len(trials)} (seed {self.seed})"
            _best.write_best(folder, result.best.overrides, loader, summary)
            ranking.write_results(folder, self.name, result, varied)
            if len(self.metrics) == 2:
                summary = f"{count_of(len(result.front), 'trial')} on the front; the first has {summary}"
        assert self.config is not None
        logger = {"logger": OmegaConf.to_container(self.config.logger)}
        ranking.close_ranking(folder, f"{description} of {count_of(len(trials), 'trial')}; {summary}", logger)


class RandomSearch(Search):
    """Hydra sweeper that draws jobs (trials) at random, and needs no further package.

    A drawn value is a function of (seed, number of the trial, key) only, so more trials or another parameter do not
    change the values of existing trials. [Bergstra & Bengio, JMLR 13, 2012]

    Args:
        trials: number of different trials; if the search space has fewer points, every point is run once.
        seed: seed of the draws.
        metric, direction, params: as in `Search`.
    """

    def __init__(
        self,
        trials: int = 20,
        seed: int = 0,
        metric: str | Sequence[str | None] | None = None,
        direction: str | Sequence[str | None] | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__("random_search", trials, seed, metric, direction, params)

    def _run(self, folder: Path, space: "Mapping[str, Domain]") -> "tuple[list[JobReturn], list[Trial], str]":
        from hydra_plugins.framework_search import _draws, _trials

        assert self.launcher is not None
        drawn_trials, repeated = _draws.draw(space, self.trials, self.seed)
        log.info(_draws.describe(space, len(drawn_trials), self.trials, repeated))
        self._begin(folder)
        self.validate_batch_is_legal(drawn_trials)
        # All trials are launched in one batch, so that a launcher that runs several at once is always busy.
        returned = list(self.launcher.launch(drawn_trials, initial_job_idx=0))
        return returned, [_trials.trial_of(result) for result in returned], "a random search"


class OptunaSearch(Search):
    """Hydra sweeper whose trials a sampler of Optuna suggests, in batches that run under any launcher.

    The study is stored, so that a command that is repeated goes on with it, and several commands can work on it.

    Args:
        trials: number of different trials of the study, together with those of earlier and other commands.
        seed: seed of the sampler.
        sampler: "tpe", "random", "quasi_random" or "nsga2".
        metric: key of results.json by which trials are ranked; None: the value that a job returns, its best validation
            loss in nats; with the sampler "nsga2" this value and the milliseconds per sample. A list of two keys asks
            for the Pareto front.
        direction: "minimize" or "maximize", for each metric; None: the direction that the metric declares.
        batch: number of trials that are suggested and run together; None: as many as the launcher runs at once, or all
            trials if the sampler does not depend on the values of earlier ones.
        population: number of trials of a generation of "nsga2"; None: a fifth of the trials, at least 4 and at most 50.
        pruner: "median" or "halving", which end a training whose validation losses are higher than those of other
            trials; None: every trial is trained to its end.
        storage: address of a PostgreSQL database, without password; None: a file in the folder of the sweep.
        study: name of the study in the database; None: the folder of the sweep.
        params: sweeps by key, in Hydra's grammar; a sweep of the same key on the command line takes precedence.
    """

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        trials: int = 20,
        seed: int = 0,
        sampler: str = "tpe",
        metric: str | Sequence[str | None] | None = None,
        direction: str | Sequence[str | None] | None = None,
        batch: int | None = None,
        population: int | None = None,
        pruner: str | None = None,
        storage: str | None = None,
        study: str | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> None:
        if sampler == "nsga2" and metric is None:
            metric = [None, "milliseconds_per_sample"]
        super().__init__("optuna", trials, seed, metric, direction, params)
        self.sampler = sampler
        self.batch = batch
        self.population = population
        self.pruner = pruner
        self.storage = storage
        self.study = study

    def _check(self) -> None:
        from framework.sweeps.engines import require_module

        super()._check()
        self._require_one_of("sampler", self.sampler, SAMPLERS, null=False)
        self._require_one_of("pruner", self.pruner, PRUNERS)
        if self.batch is not None:
            self._require_whole("batch", 1)
        if self.population is not None:
            self._require_whole("population", 2)
            if self.sampler != "nsga2":
                raise ConfigError(
                    f"hydra.sweeper.population has no effect with hydra.sweeper.sampler={self.sampler}. Leave it out."
                )
        if self.study is not None and self.storage is None:
            raise ConfigError(
                "hydra.sweeper.study has no effect without hydra.sweeper.storage, because without a database the "
                "folder of the sweep holds one study. Leave it out, or set hydra.sweeper.storage."
            )
        if self.pruner is not None and self.metrics != [None]:
            raise ConfigError(
                "hydra.sweeper.pruner compares validation losses, so trials must be ranked by them and by nothing "
                "else: set hydra.sweeper.metric=null and another sampler than nsga2, or leave the pruner out."
            )
        if self.pruner is not None and self.directions == ["maximize"]:
            raise ConfigError(
                "hydra.sweeper.pruner ends trials with high losses. Leave hydra.sweeper.direction out."
            )
        launcher = self.launcher
        if self.pruner is not None and not isinstance(launcher, EngineLauncher):
            raise ConfigError("hydra.sweeper.pruner needs hydra/launcher=pool, slurm or ray.")
        if isinstance(launcher, EngineLauncher) and launcher.eager:
            raise ConfigError(
                "hydra.launcher.eager=true ends the command before its jobs have values, but the sampler needs them. "
                "Set hydra.launcher.eager=false."
            )
        require_module("optuna", "search", "hydra/sweeper=optuna")
        if self.storage is not None:
            from hydra_plugins.framework_search import _study

            _study.require_address(self.storage)

    def _run(self, folder: Path, space: "Mapping[str, Domain]") -> "tuple[list[JobReturn], list[Trial], str]":
        from framework.sweeps import ranking
        from hydra_plugins.framework_search import _best, _space, _study, _trials

        launcher = self.launcher
        assert launcher is not None
        on_engine = launcher if isinstance(launcher, EngineLauncher) else None
        self._begin(folder)
        if on_engine is not None:
            on_engine.check(_space.extremes(space))
        else:
            self.validate_batch_is_legal(_space.extremes(space))
        study = _study.Study(
            folder.absolute(),
            self.storage,
            self.study or str(folder),
            space,
            [
                f"{key}={domain.at(0.0)}"
                for key, domain in space.items()
                if domain.size == 1 and _best.counts(key)
            ],
            [metric or ranking.RETURNED for metric in self.metrics],
            _study.Sampling(
                self.sampler, self.seed, self.population or min(50, max(4, self.trials // 5)), self.pruner
            ),
        )
        self.directions = [
            direction or stored for direction, stored in zip(self.directions, study.ways, strict=True)
        ]
        study.take_up(_trials.running_in(folder))
        at_once = self._at_once()
        ended = sum(point.state.is_finished() for point in study.points())
        log.info(
            f"search with Optuna ({self.sampler}) over {', '.join(key.lstrip('+') for key in study.varied)}: "
            f"{self.trials} trials, {ended} of them ended; {at_once} are suggested at a time"
        )
        returned: list[JobReturn] = []
        watch = study.watch if self.pruner is not None else None
        with on_engine.batches(watch) if on_engine is not None else nullcontext():
            while (suggested := study.suggest(at_once, self.trials)) or study.take_over():
                if not suggested:
                    continue
                results = launcher.launch(suggested, initial_job_idx=len(returned))
                returned += results
                self._tell(folder, study, suggested, results)
        return returned, _trials.trials_of(study, returned), f"a search with Optuna ({self.sampler})"

    def _at_once(self) -> int:
        if self.batch is not None:
            return self.batch
        if self.sampler in INDEPENDENT:
            return self.trials
        return getattr(self.launcher, "at_once", 1) or AT_ONCE

    def _tell(
        self,
        folder: Path,
        study: "Study",
        suggested: Sequence[Sequence[str]],
        results: Sequence[JobReturn],
    ) -> None:
        """Tell the study the values of a batch."""
        from framework.sweeps import ranking
        from hydra_plugins.framework_search import _trials

        trials = [_trials.trial_of(result) for result in results]
        measured = ranking.measure(folder, trials, self.metrics, self.directions)
        if None in self.directions and None not in measured.ways:
            self.directions = ["maximize" if way == "higher" else "minimize" for way in measured.ways]
            study.store_ways(self.directions)
        for index, (overrides, trial) in enumerate(zip(suggested, trials, strict=True)):
            values = measured.objectives(index) if trial.completed else None
            study.tell(overrides, values, pruned=trial.note == _trials.PRUNED)


def _as_list(value: Any) -> list[Any]:
    return [value] if value is None or isinstance(value, str) else list(value)
