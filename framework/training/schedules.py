"""Schedules of the learning rate: functions that return the factor on the learning rate at each optimiser step."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from torch.optim.lr_scheduler import LambdaLR

from framework.configuration.settings import OptimizerSettings

WARMUP_SHARE = 0.25
"""Largest share of a training's steps that the warm-up takes.

If a training has fewer than 4 · `warmup_steps` steps, the warm-up takes a quarter of them. In a longer training, the
warm-up takes `warmup_steps` steps.
"""


def count_warmup_steps(settings: OptimizerSettings, steps: int) -> int:
    """Return the number of warm-up steps in a training of `steps` steps."""
    return min(settings.warmup_steps, int(WARMUP_SHARE * steps))


def make_schedule(settings: OptimizerSettings, steps: int, epoch: int) -> Callable[[int], float]:
    """Return the schedule: a function from the optimiser step, from 0, to the factor that multiplies the learning rate.

    Args:
        settings: settings of the optimiser.
        steps: number of steps of the whole training.
        epoch: number of steps of one epoch.
    """
    warmup_steps = count_warmup_steps(settings, steps)
    if settings.schedule == "plateau":
        return Plateau(settings.factor, settings.patience, warmup_steps)
    if settings.schedule == "step":
        starts = [milestone * epoch for milestone in settings.milestones]
        return partial(step_factor, starts=starts, factor=settings.factor, warmup_steps=warmup_steps)
    total = steps if settings.schedule == "cosine" else None
    return partial(smooth_factor, total=total, warmup_steps=warmup_steps)


def warmup_factor(step: int, warmup_steps: int) -> float:
    """Return the factor of the warm-up at a step; it rises linearly to 1 in `warmup_steps` steps."""
    return min(1.0, (step + 1) / (warmup_steps + 1))


def smooth_factor(step: int, *, total: int | None, warmup_steps: int = 0) -> float:
    """Return the warm-up's factor at a step, multiplied by a cosine decay unless `total` is None.

    The decay is half a period of a cosine, which falls from 1 to 0 in `total` steps.
    """
    if total is None:
        return warmup_factor(step, warmup_steps)
    return warmup_factor(step, warmup_steps) * 0.5 * (1 + math.cos(math.pi * min(1.0, step / total)))


def step_factor(step: int, *, starts: list[int], factor: float, warmup_steps: int = 0) -> float:
    """Return the warm-up's factor at a step, multiplied by `factor` once for each step in `starts` that is reached."""
    return warmup_factor(step, warmup_steps) * factor ** sum(step >= start for start in starts)


class Plateau:
    """Schedule that multiplies the rate by `factor` after `patience` epochs without a lower validation loss.

    The rate also rises linearly during the first `warmup_steps` steps (`warmup_factor`).

    Torch's ReduceLROnPlateau is not used: Lightning passes the loss to it after writing an epoch's checkpoint, so a
    resumed run would miss this loss. The state of this class is stored in checkpoints, because LambdaLR stores the
    attributes of the functions that it calls.
    """

    def __init__(self, factor: float, patience: int, warmup_steps: int = 0) -> None:
        self.factor = factor
        self.patience = patience
        self.warmup_steps = warmup_steps
        self.reductions = 0
        self.best = math.inf
        self.since = 0

    def __call__(self, step: int) -> float:
        """Return the factor that multiplies the learning rate at a step."""
        return warmup_factor(step, self.warmup_steps) * self.factor**self.reductions

    def record_loss(self, loss: float, epochs: int) -> None:
        """Record the loss after `epochs` epochs; reduce the factor if the loss has not fallen for `patience` epochs."""
        if loss < self.best:
            self.best, self.since = loss, epochs
        elif epochs - self.since >= self.patience:
            self.reductions += 1
            self.since = epochs


def update_plateaus(schedules: Any, loss: float, epochs: int) -> None:
    """Record a validation loss in the `Plateau` schedules of a `LambdaLR`, and set the rates for the next step.

    Args:
        schedules: a `LambdaLR`; nothing is done for an object of another class.
        loss: validation loss.
        epochs: number of epochs after which it was measured.
    """
    if not isinstance(schedules, LambdaLR):
        return
    plateaus = [factor for factor in schedules.lr_lambdas if isinstance(factor, Plateau)]
    for plateau in plateaus:
        plateau.record_loss(loss, epochs)
    if plateaus:
        groups = schedules.optimizer.param_groups
        for group, base, factor in zip(groups, schedules.base_lrs, schedules.lr_lambdas, strict=True):
            group["lr"] = base * factor(schedules.last_epoch)
