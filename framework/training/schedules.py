"""How a learning rate changes while a model trains: factors on it, one for each optimiser step."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from torch.optim.lr_scheduler import LambdaLR

from framework.configuration.settings import OptimizerSettings

WARMUP_SHARE = 0.25
"""Largest part of a training that its warm-up takes: a training shorter than four times `warmup_steps` warms up for a
quarter of its steps. Longer ones are not changed by this; `cest` has 400 steps, for 100 of which it warms up."""


def warmup(chosen: OptimizerSettings, steps: int) -> int:
    """Return the steps of the warm-up in a training of so many `steps`."""
    return min(chosen.warmup_steps, int(WARMUP_SHARE * steps))


def schedule(chosen: OptimizerSettings, steps: int, epoch: int) -> Callable[[int], float]:
    """The factor by the number of the optimiser step, from 0.

    Args:
        steps: of the whole training.
        epoch: steps of one epoch.
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
    return min(1.0, (step + 1) / (warmup_steps + 1))


def smooth(step: int, *, total: int | None, warmup_steps: int = 0) -> float:
    """1 all along, or half a cosine from 1 to 0 over `total` steps."""
    if total is None:
        return warm(step, warmup_steps)
    return warm(step, warmup_steps) * 0.5 * (1 + math.cos(math.pi * min(1.0, step / total)))


def stepped(step: int, *, starts: list[int], factor: float, warmup_steps: int = 0) -> float:
    """Times `factor` from each of `starts` on, steps."""
    return warm(step, warmup_steps) * factor ** sum(step >= start for start in starts)


class Plateau:
    """Times `factor` whenever the validation loss has not been lower than ever for `patience` epochs.

    Not torch's ReduceLROnPlateau, which Lightning steps after an epoch's checkpoint is written: a resumed run would
    miss that step. What this has seen is in the checkpoint, since LambdaLR keeps the attributes of what it calls.
    """

    def __init__(self, factor: float, patience: int, warmup_steps: int = 0) -> None:
        self.factor = factor
        self.patience = patience
        self.warmup_steps = warmup_steps
        self.reductions = 0
        self.best = math.inf
        self.since = 0

    def __call__(self, step: int) -> float:
        return warm(step, self.warmup_steps) * self.factor**self.reductions

    def see(self, loss: float, epochs: int) -> None:
        """Take in the validation loss after so many epochs."""
        if loss < self.best:
            self.best, self.since = loss, epochs
        elif epochs - self.since >= self.patience:
            self.reductions += 1
            self.since = epochs


def see(schedules: Any, loss: float, epochs: int) -> None:
    """Tell a `LambdaLR` over a `Plateau` the validation loss; the next step already has the new rate."""
    if not isinstance(schedules, LambdaLR):
        return
    plateaus = [one for one in schedules.lr_lambdas if isinstance(one, Plateau)]
    for one in plateaus:
        one.see(loss, epochs)
    if plateaus:
        groups = schedules.optimizer.param_groups
        for group, base, factor in zip(groups, schedules.base_lrs, schedules.lr_lambdas, strict=True):
            group["lr"] = base * factor(schedules.last_epoch)
