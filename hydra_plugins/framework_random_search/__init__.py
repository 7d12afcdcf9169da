"""Hydra sweeper for random search.

Hydra imports this module at every start; therefore it imports nothing heavy.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from framework.errors import ConfigError, did_you_mean

DIRECTIONS = ("minimize", "maximize")

log = logging.getLogger(__name__)


class RandomSearch(Sweeper):
    """Hydra sweeper that draws jobs (trials) at random, runs and ranks them, and writes the best one as an experiment.

    A drawn value is a function of (seed, number of the trial, key) only, so more trials or another parameter do not
    change the values of existing trials. [Bergstra & Bengio, JMLR 13, 2012]

    Args:
        trials: number of different trials; if the search space has fewer points, every point is run once.
        seed: seed of the draws.
        metric: key of results.json by which trials are ranked; None: the value that a job returns, its best validation
            loss in nats.
        direction: "minimize" or "maximize"; None: the direction that the metric declares.
        params: sweeps by key, in Hydra's grammar; a sweep of the same key on the command line takes precedence.
    """

    def __init__(
        self,
        trials: int = 20,
        seed: int = 0,
        metric: str | None = None,
        direction: str | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> None:
        self.trials = trials
        self.seed = seed
        self.metric = metric
        self.direction = direction
        self.params = dict(params or {})

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Store the config, and create the launcher that the config chooses."""
        self.hydra_context = hydra_context
        self.config = config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> list[Sequence[JobReturn]]:
        """Draw the trials, run them, rank them, and return their results.

        Raises:
            ConfigError: a setting or a sweep is invalid; raised before any job runs.
            Exception: the error of a failed job; raised after all jobs have ended.
        """
        from hydra_plugins.framework_random_search import _draws

        assert self.config is not None
        assert self.launcher is not None
        assert self.hydra_context is not None
        self._check()
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        overrides = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        space = _draws.parse_space(parser.parse_overrides(overrides))
        drawn_trials, repeated = _draws.draw(space, self.trials, self.seed)
        log.info(_draws.describe(space, len(drawn_trials), self.trials, repeated))
        folder = Path(str(self.config.hydra.sweep.dir))
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, folder / "multirun.yaml")
        self.validate_batch_is_legal(drawn_trials)
        # All trials are launched in one batch, so that a launcher that runs several at once is always busy.
        returned = self.launcher.launch(drawn_trials, initial_job_idx=0)
        self._rank(folder, space, returned, self.hydra_context.config_loader)
        for result in returned:
            _ = result.return_value  # raises the error of a failed job
        return [returned]

    def _check(self) -> None:
        for name, least in (("trials", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(
                    f"hydra.sweeper.{name} = {value!r}, but a whole number of at least {least} is required."
                )
        if self.direction not in (None, *DIRECTIONS):
            raise ConfigError(
                f"hydra.sweeper.direction = {self.direction!r}, but must be minimize, maximize or null."
                f"{did_you_mean(str(self.direction), DIRECTIONS)}"
            )

    def _rank(
        self, folder: Path, space: Mapping[str, Any], returned: Sequence[JobReturn], loader: ConfigLoader
    ) -> None:
        from framework.sweeps import comparison  # imported late: Hydra imports this module at every start
        from hydra_plugins.framework_random_search import _best

        trials = [
            comparison.Trial(
                folder=_folder(result),
                overrides=list(result.overrides or ()),
                value=result.return_value if result.status == JobStatus.COMPLETED else None,
                completed=result.status == JobStatus.COMPLETED,
            )
            for result in returned
        ]
        varied = [key for key, domain in space.items() if domain.size > 1]
        ranking = comparison.rank(folder, trials, varied, self.metric, self.direction)
        summary = "no trial has a finite value"
        if ranking.best is not None:
            summary = (
                f"{ranking.summary}; trial {ranking.best.folder.name} of {len(trials)} (seed {self.seed})"
            )
            _best.write_best(folder, ranking.best.overrides, loader, summary)
        assert self.config is not None
        logger = {"logger": OmegaConf.to_container(self.config.logger)}
        comparison.close_ranking(folder, f"a random search of {len(trials)} trials; {summary}", logger)


def _folder(result: JobReturn) -> Path:
    """Return a job's folder.

    If a launcher ran the job in this process, `working_dir` is not the job's folder, but the folder of the command.
    """
    if result.hydra_cfg is not None:
        return Path(str(result.hydra_cfg.hydra.runtime.output_dir))
    return Path(str(result.working_dir))
