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
    """Sweeper that draws trials at random, runs and ranks them all, and writes the best as an experiment.

    A draw is a function of (seed, number of the trial, key) alone: more trials, or another parameter, do not change the
    existing draws. [Bergstra & Bengio, JMLR 13, 2012]

    Args:
        trials: number of different trials; a space that holds fewer is run whole.
        seed: seed of the draws.
        metric: a key of results.json; None for the value that a job returns, the best validation loss in nats.
        direction: "minimize" or "maximize"; None for the direction that the metric itself declares.
        params: sweeps by key, in Hydra's grammar; a sweep on the command line replaces that of its key.
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
        """Keep the configuration, and make the launcher that it chooses."""
        self.hydra_context = hydra_context
        self.config = config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> list[Sequence[JobReturn]]:
        """Draw the trials, run them, rank them, and return their results.

        Raises:
            ConfigError: the search makes no sense; this is raised before anything runs.
            Exception: the error of a failed job; this is raised after all jobs.
        """
        from hydra_plugins.framework_random_search import _draws

        assert self.config is not None
        assert self.launcher is not None
        assert self.hydra_context is not None
        self._check()
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        given = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        space = _draws.space(parser.parse_overrides(given))
        drawn, repeated = _draws.draw(space, self.trials, self.seed)
        log.info(_draws.described(space, len(drawn), self.trials, repeated))
        folder = Path(str(self.config.hydra.sweep.dir))
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, folder / "multirun.yaml")
        self.validate_batch_is_legal(drawn)
        # launch all trials in one batch, so that a launcher that runs several at once is always busy
        returned = self.launcher.launch(drawn, initial_job_idx=0)
        self._rank(folder, space, returned, self.hydra_context.config_loader)
        for one in returned:
            _ = one.return_value  # raises what a job failed with
        return [returned]

    def _check(self) -> None:
        for name, least in (("trials", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(
                    f"hydra.sweeper.{name} = {value!r}: wanted a whole number of at least {least}."
                )
        if self.direction not in (None, *DIRECTIONS):
            raise ConfigError(
                f"hydra.sweeper.direction = {self.direction!r}: wanted minimize, maximize or null."
                f"{did_you_mean(str(self.direction), DIRECTIONS)}"
            )

    def _rank(
        self, folder: Path, space: Mapping[str, Any], returned: Sequence[JobReturn], loader: ConfigLoader
    ) -> None:
        from framework.sweeps import comparison  # imported late: Hydra imports this module at every start
        from hydra_plugins.framework_random_search import _best

        trials = [
            comparison.Trial(
                folder=_folder(one),
                overrides=list(one.overrides or ()),
                value=one.return_value if one.status == JobStatus.COMPLETED else None,
                completed=one.status == JobStatus.COMPLETED,
            )
            for one in returned
        ]
        varied = [key for key, domain in space.items() if domain.size > 1]
        ranking = comparison.rank(folder, trials, varied, self.metric, self.direction)
        found = "no trial has a finite value"
        if ranking.best is not None:
            found = f"{ranking.said}; trial {ranking.best.folder.name} of {len(trials)} (seed {self.seed})"
            _best.write(folder, ranking.best.overrides, loader, found)
        assert self.config is not None
        logger = {"logger": OmegaConf.to_container(self.config.logger)}
        comparison.close_ranking(folder, f"a random search of {len(trials)} trials; {found}", logger)


def _folder(one: JobReturn) -> Path:
    """Return a job's folder; if a launcher ran the job in this process, `working_dir` is where it was started."""
    if one.hydra_cfg is not None:
        return Path(str(one.hydra_cfg.hydra.runtime.output_dir))
    return Path(str(one.working_dir))
