"""Changes of the learning rate during training: factors on it, one for each optimiser step."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from torch.optim.lr_scheduler import LambdaLR

from framework.configuration.settings import OptimizerSettings

WARMUP_SHARE = 0.25
"""Largest share of a training that its warm-up takes.

A training shorter than four times `warmup_steps` warms up for a quarter of its steps. Longer trainings are not
affected; `cest` has 400 steps and warms up for 100 of them.
"""


def warmup(chosen: OptimizerSettings, steps: int) -> int:
    """Return the number of warm-up steps in a training of this many `steps`."""
    return min(chosen.warmup_steps, int(WARMUP_SHARE * steps))


def schedule(chosen: OptimizerSettings, steps: int, epoch: int) -> Callable[[int], float]:
    """Return the function from the number of an optimiser step, from 0, to the factor on the learning rate.

    Args:
        chosen: settings of the optimiser.
        steps: number of steps of the whole training.
        epoch: number of steps of one epoch.
    """
    warming = warmup(chosen, steps)
    if chosen.schedule == "plateau":
        return Plateau(chosen.factor, chosen.patience, warming)
    if chosen.schedule == "step":
        starts = [milestone * epoch for milestone in chosen.milestones]
        return partial(stepped, starts=starts, factor=chosen.factor, warmup_steps=warming)
    total = steps if chosen.schedule == "cosine" else None
    return partial(smooth, total=total, warmup_steps=warming)


def warm(step: int, warmup_steps: int) -> float:
    """Return the factor of the warm-up: it rises linearly to 1."""
    return min(1.0, (step + 1) / (warmup_steps + 1))


def smooth(step: int, *, total: int | None, warmup_steps: int = 0) -> float:
    """Return the factor at a step: 1 throughout if `total` is None, or half a cosine from 1 to 0 over `total` steps.

    It is multiplied by the factor of the warm-up.
    """
    if total is None:
        return warm(step, warmup_steps)
    return warm(step, warmup_steps) * 0.5 * (1 + math.cos(math.pi * min(1.0, step / total)))


def stepped(step: int, *, starts: list[int], factor: float, warmup_steps: int = 0) -> float:
    """Return the factor at a step, which is multiplied by `factor` at each of the steps in `starts`."""
    return warm(step, warmup_steps) * factor ** sum(step >= start for start in starts)


class Plateau:
    """Schedule that multiplies by `factor` after `patience` epochs without a new minimum of the validation loss.

    Torch's ReduceLROnPlateau is not used: Lightning steps it after an epoch's checkpoint is written, so a resumed run
    would miss that step. The state of this class is in the checkpoint, because LambdaLR keeps the attributes of the
    functions that it calls.
    """

    def __init__(self, factor: float, patience: int, warmup_steps: int = 0) -> None:
        self.factor = factor
        self.patience = patience
        self.warmup_steps = warmup_steps
        self.reductions = 0
        self.best = math.inf
        self.since = 0

    def __call__(self, step: int) -> float:
        """Return the factor at a step."""
        return warm(step, self.warmup_steps) * self.factor**self.reductions

    def see(self, loss: float, epochs: int) -> None:
        """Add the validation loss after `epochs` epochs."""
        if loss < self.best:
            self.best, self.since = loss, epochs
        elif epochs - self.since >= self.patience:
            self.reductions += 1
            self.since = epochs


def see(schedules: Any, loss: float, epochs: int) -> None:
    """Give the validation loss to the plateaus of a `LambdaLR`; the next step already has the new rate."""
    if not isinstance(schedules, LambdaLR):
        return
    plateaus = [one for one in schedules.lr_lambdas if isinstance(one, Plateau)]
    for one in plateaus:
        one.see(loss, epochs)
    if plateaus:
        groups = schedules.optimizer.param_groups
        for group, base, factor in zip(groups, schedules.base_lrs, schedules.lr_lambdas, strict=True):
            group["lr"] = base * factor(schedules.last_epoch)
