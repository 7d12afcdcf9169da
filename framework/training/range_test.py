"""Learning rate from a range test: the rate grows from step to step, and the fastest fall of the loss is the choice.

This is the test of Smith (2017), "Cyclical learning rates for training neural networks", section 3.3. Lightning's own
LearningRateFinder is not used for four measured reasons: it ends after two steps if the loss is negative, as that of a
density can be; a loss that is not finite ends it with an error; its first smoothed losses are too low (the first by
half); and it takes the derivative by the rate instead of by its logarithm, which prefers the smallest rates.
"""

import json
import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytorch_lightning as pl
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from framework.configuration.settings import OptimizerSettings
from framework.data import Batch, Data
from framework.errors import CheckpointError, ConfigError, NonFiniteLoss
from framework.model import Predictor
from framework.objective import Objective
from framework.storage.files import write_whole
from framework.storage.plain_values import is_number, read_json
from framework.tracking.signals import Stopper
from framework.training.batches import Batches
from framework.training.module import BatchCallback, LoadedBatches, Training

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOWEST, HIGHEST = 1e-7, 1.0
"""Learning rates of the first and the last step."""
STEPS = 100
"""Number of steps, whose rates have equal ratios."""
HALF_WINDOW = 7
"""Number of steps before and after a step with which the slope of the loss at this step is fitted: half a decade."""
CERTAIN = 4.5
"""Smallest number of standard errors by which a slope must lie below zero to count as a fall of the loss.

With 15 points of a loss that does not change, the quotient has Student's t distribution with 13 degrees of freedom
and lies below -4.5 with probability 0.0003.
"""
KEPT = (
    *("accelerator", "devices", "strategy", "precision", "gradient_clip_val", "gradient_clip_algorithm"),
    *("accumulate_grad_batches", "limit_train_batches", "deterministic", "benchmark"),
)
"""Arguments of Lightning's Trainer that the range test has in common with the training."""


@dataclass(frozen=True)
class RangeTestResult:
    """Losses of a range test, and the learning rate that follows from them.

    Attributes:
        rates: learning rate of each step.
        losses: training loss of each step, nats; shorter than STEPS if a loss was not finite, which ended the test.
        learning_rate: rate at which the loss falls fastest.
        slope: slope of the loss at this rate, nats per decade of the rate; negative.
        slope_error: standard error of the slope.
        lowest: rate at which the loss, averaged over the neighbouring steps, is lowest.
    """

    rates: tuple[float, ...]
    losses: tuple[float, ...]
    learning_rate: float
    slope: float
    slope_error: float
    lowest: float

    def sentence(self) -> str:
        """Return the learning rate and the reason for it."""
        ended = (
            f"; the loss was no longer finite after {self.rates[-1]:.2g}" if len(self.rates) < STEPS else ""
        )
        return (
            f"learning rate: {self.learning_rate:.2g}, where the loss of a range test over {len(self.rates)} steps "
            f"falls fastest, by {-self.slope:.2g} ± {self.slope_error:.1g} nats per decade of the rate. The loss is "
            f"lowest near {self.lowest:.2g}{ended}."
        )

    def save(self, path: Path) -> None:
        """Write the result to a JSON file."""
        write_whole(path, json.dumps(asdict(self), indent=1).encode())

    @classmethod
    def read(cls, path: Path) -> "RangeTestResult":
        """Return the result in a file of a run folder, which is not trusted.

        Raises:
            CheckpointError: the file holds no result of a range test.
        """
        content = read_json(path, "the result of a range test", "Start a new run.")
        lists = [content.get(name) for name in ("rates", "losses")]
        numbers = [content.get(name) for name in ("learning_rate", "slope", "slope_error", "lowest")]
        if (
            not all(isinstance(values, list) and all(map(is_number, values)) for values in lists)
            or not all(map(is_number, numbers))
            or not 0 < numbers[0] <= HIGHEST  # type: ignore[operator]
        ):
            raise CheckpointError(f"{path} is not the result of a range test. Start a new run.")
        return cls(tuple(lists[0]), tuple(lists[1]), *numbers)  # type: ignore[arg-type]


class RangeTest(Training):
    """Training whose learning rate grows from LOWEST to HIGHEST in STEPS steps.

    Attributes:
        losses: losses of the batches, by optimiser step.
    """

    losses: dict[int, list[float]]

    def on_train_start(self) -> None:
        """Forget earlier losses."""
        self.losses = {}

    def training_step(self, batch: Batch, batch_index: int) -> Tensor | None:  # type: ignore[override]
        """Return the loss; a loss that is not finite ends the test instead of raising an error."""
        try:
            loss = super().training_step(batch, batch_index)
        except NonFiniteLoss:
            self.trainer.should_stop = True
            return None
        self.losses.setdefault(self.global_step, []).append(self.last_loss)
        return loss

    def configure_optimizers(self) -> dict[str, Any]:
        """Return the optimiser of the settings with a rate that grows by the same factor in each step."""
        configured = super().configure_optimizers()
        schedule = LambdaLR(configured["optimizer"], lambda step: rate_of_step(step) / LOWEST)
        return {**configured, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class _InstallSignals(BatchCallback):
    def __init__(self, stopper: Stopper) -> None:
        self.stopper = stopper

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.stopper.install()  # Lightning has replaced the handlers of signals


def rate_of_step(step: int) -> float:
    """Return the learning rate of a step, from 0."""
    return LOWEST * (HIGHEST / LOWEST) ** (step / (STEPS - 1))


def measure_losses(
    predictor: Predictor,
    objectives: Sequence[Objective],
    data: Data,
    batches: Batches,
    optimizer: OptimizerSettings,
    arguments: dict[str, Any],
    stopper: Stopper,
    *,
    cached: bool = False,
) -> tuple[list[float], list[float]]:
    """Return the learning rates and the losses of a range test with a copy of the predictor, which stays unchanged.

    Noise and the order of the batches are functions of the seed of `batches`, so that the result is reproducible.

    Args:
        predictor: predictor with its first weights.
        objectives: objectives of the training loss.
        data: data of the training.
        batches: batches of the training, which no trainer uses yet.
        optimizer: settings of the optimiser; its rate and its schedule are replaced.
        arguments: arguments of Lightning's Trainer for the training, of which those in KEPT are used.
        stopper: handler of signals.
        cached: True if `batches` hold cached features instead of inputs; `predictor` is then a `FrozenFrontEnd`.

    Raises:
        ConfigError: an objective trains an adversary, whose rate is not that of the predictor; or several processes
            train.
    """
    adversary = next((part for part in objectives if part.adversary_optimizer is not None), None)
    if adversary is not None:
        raise ConfigError(
            f"optimizer.learning_rate = 'auto' finds one learning rate, but {type(adversary).__name__} trains an "
            "adversary with a rate of its own. Set optimizer.learning_rate to a number."
        )
    settings = optimizer.model_copy(
        update={"learning_rate": LOWEST, "schedule": "constant", "warmup_steps": 0, "milestones": []}
    )
    test = RangeTest(
        deepcopy(predictor).train(),
        deepcopy(list(objectives)),
        data,
        settings,
        batches.seed,
        {},
        cached=cached,
    )
    trainer = pl.Trainer(
        **{key: value for key, value in arguments.items() if key in KEPT},
        max_steps=STEPS,
        max_epochs=-1,
        limit_val_batches=0,
        num_sanity_val_steps=0,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[_InstallSignals(stopper)],
        use_distributed_sampler=False,
    )
    if trainer.world_size > 1:
        raise ConfigError(
            f"optimizer.learning_rate = 'auto' needs a training by one process, but {trainer.world_size} train. Find "
            "the rate with trainer.devices=1 first, and then set optimizer.learning_rate to it."
        )
    trainer.fit(test, datamodule=LoadedBatches(batches, trainer))
    steps = sorted(test.losses)
    return [rate_of_step(step) for step in steps], [float(np.mean(test.losses[step])) for step in steps]


def suggest(rates: list[float], losses: list[float]) -> RangeTestResult:
    """Return the learning rate at which the loss falls fastest with the logarithm of the rate.

    The slope at a step is that of a line fitted by least squares to the losses of the 2 · HALF_WINDOW + 1 steps around
    it. A rate is considered if its slope is at least CERTAIN standard errors below 0, and if the rate is at most that
    with the lowest mean loss of these steps.

    Args:
        rates: learning rates, ascending by a constant factor.
        losses: finite loss at each rate, nats.

    Raises:
        ConfigError: the loss falls at no rate.
    """
    width = 2 * HALF_WINDOW + 1
    remedy = "Set optimizer.learning_rate to a number, such as 1e-3, or check the data and the model."
    if len(losses) < width:
        raise ConfigError(
            f"optimizer.learning_rate = 'auto': the loss was finite in only {len(losses)} steps of the range test, at "
            f"rates of at most {rates[-1] if rates else LOWEST:.2g}, and {width} are required. {remedy}"
        )
    logarithms = np.log10(rates)
    windows = np.lib.stride_tricks.sliding_window_view(np.asarray(losses, dtype=float), width)
    places = np.lib.stride_tricks.sliding_window_view(logarithms, width)
    centred = places - places.mean(1, keepdims=True)
    spread = (centred**2).sum(1)
    slopes = (centred * windows).sum(1) / spread
    residuals = windows - windows.mean(1, keepdims=True) - slopes[:, None] * centred
    errors = np.sqrt((residuals**2).sum(1) / (width - 2) / spread)
    lowest = int(windows.mean(1).argmin())
    falls = slopes < -CERTAIN * errors
    falls[lowest + 1 :] = False
    if not falls.any():
        raise ConfigError(
            f"optimizer.learning_rate = 'auto': in a range test of {len(losses)} steps with rates from {rates[0]:.2g} "
            f"to {rates[-1]:.2g}, the training loss never falls by more than its noise, so that no rate can be "
            f"suggested. {remedy}"
        )
    steepest = int(np.where(falls, slopes, math.inf).argmin())
    return RangeTestResult(
        tuple(rates),
        tuple(losses),
        float(rates[steepest + HALF_WINDOW]),
        float(slopes[steepest]),
        float(errors[steepest]),
        float(rates[lowest + HALF_WINDOW]),
    )


def range_test_figure(result: RangeTestResult, title: str, *, synthetic: bool) -> "Figure":
    """Return a figure of the loss against the learning rate, with the chosen rate and the fitted slope."""
    from matplotlib.ticker import LogLocator

    from framework.figures.style import BLUE, GREY, RED, titled_figure

    width = 2 * HALF_WINDOW + 1
    rates, losses = np.asarray(result.rates), np.asarray(result.losses)
    smooth = np.lib.stride_tricks.sliding_window_view(losses, width).mean(1)
    figure = titled_figure((6.4, 3.8), title, synthetic)
    axes = figure.add_subplot()
    axes.plot(rates, losses, ".", color=GREY, markersize=3, label="loss of a batch")
    axes.plot(
        rates[HALF_WINDOW : len(rates) - HALF_WINDOW], smooth, color=BLUE, label=f"mean of {width} steps"
    )
    centre = int(np.searchsorted(rates, result.learning_rate * 0.999))
    around = rates[centre - HALF_WINDOW : centre + HALF_WINDOW + 1]
    line = smooth[centre - HALF_WINDOW] + result.slope * np.log10(around / result.learning_rate)
    axes.plot(around, line, color=RED, linewidth=2.5, label="steepest fall")
    axes.axvline(
        result.learning_rate, color=RED, linestyle=":", label=f"chosen rate: {result.learning_rate:.2g}"
    )
    # a loss that grows beyond all bounds at the highest rates would hide its fall
    start, low = float(smooth[0]), float(smooth.min())
    top = max(start + (start - low), float(np.quantile(losses[: centre + HALF_WINDOW + 1], 0.99)))
    bottom = min(float(np.quantile(losses, 0.01)), low)
    margin = 0.05 * (top - bottom)
    axes.set(
        xscale="log",
        xlabel="learning rate",
        ylabel="training loss, nats",
        ylim=(bottom - margin, top + margin),
    )
    axes.xaxis.set_major_locator(LogLocator(numticks=9))
    axes.xaxis.set_major_formatter("{x:g}")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure
