"""Callbacks of Lightning that a config may choose by name (`trainer.callbacks=[...]`), with checked settings.

The list is closed, so that a config or a stranger's run folder cannot name code to run. Each callback of the list
continues with the same bits when a run is resumed: its state is in the checkpoint, or it has none.
"""

from copy import deepcopy
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import GradientAccumulationScheduler
from pytorch_lightning.callbacks.weight_averaging import WeightAveraging
from pytorch_lightning.utilities.model_summary import summarize
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text
from torch import Tensor

from framework.configuration.settings import (
    CallbackSettings,
    GradientAccumulationSettings,
    ModelSummarySettings,
    WeightAveragingSettings,
)
from framework.errors import ConfigError
from framework.training.module import BatchCallback, KeepCheckpoints, Training
from framework.uncertainty import FollowsTraining


def build_callbacks(chosen: CallbackSettings, keep: KeepCheckpoints, console: Console) -> list[pl.Callback]:
    """Return the chosen callbacks in the order in which Lightning must call them, with `keep` among them.

    `early_stopping` is not in the list: its settings change `StopEarly`, which the caller builds.

    Args:
        chosen: callbacks and their settings.
        keep: callback that writes checkpoints. Callbacks that change what a checkpoint stores precede it.
        console: console on which a callback prints.
    """
    before: list[pl.Callback] = []
    after: list[pl.Callback] = []
    if chosen.gradient_accumulation is not None:
        before.append(AccumulateGradients(chosen.gradient_accumulation))
    if chosen.model_summary is not None:
        before.append(PrintSummary(chosen.model_summary, console))
    if chosen.weight_averaging is not None:
        average = AverageWeights(chosen.weight_averaging)
        before.append(average)
        after.append(ReturnWeights(average))
    return [*before, keep, *after]


class PrintSummary(BatchCallback):
    """Callback that prints a table of the parts of the model before the training.

    The table that Lightning writes has a column of FLOPs, which are 0 because the parts have not computed anything yet.
    It is not printed; the cost of the model after the test holds its FLOPs.

    Args:
        settings: depth of the parts that are listed.
        console: console to print on.
    """

    def __init__(self, settings: ModelSummarySettings, console: Console) -> None:
        self.settings = settings
        self.console = console

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print the table."""
        summary = summarize(pl_module, max_depth=self.settings.max_depth)
        table = Table(box=box.SIMPLE_HEAD)
        table.add_column("part")
        table.add_column("class")
        table.add_column("parameters", justify="right")
        for name, kind, count in zip(
            summary.layer_names, summary.layer_types, summary.param_nums, strict=True
        ):
            table.add_row(Text(name), Text(kind), f"{count:,}")
        self.console.print(table)
        self.console.print(
            f"parameters: {summary.total_parameters:,}, of which {summary.trainable_parameters:,} are trained",
            soft_wrap=True,
            highlight=False,
        )


class AccumulateGradients(GradientAccumulationScheduler):
    """Callback that accumulates gradients over more or fewer batches from an epoch on.

    Args:
        settings: number of batches of a step, from each listed epoch on.
    """

    def __init__(self, settings: GradientAccumulationSettings) -> None:
        super().__init__({0: 1, **settings.batches})

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Set the number of batches of a step for the present epoch, in the middle of which a resumed run may begin."""
        super().on_train_start(trainer, pl_module)
        self.on_train_epoch_start(trainer)


class AverageWeights(WeightAveraging):
    """Callback that validates and keeps an average of the weights over the optimiser steps.

    The average is an exponential moving average, or the mean with equal weights (Izmailov et al. 2018, "Averaging
    weights leads to wider optima and better generalization", there over epochs). Buffers with floating-point numbers,
    such as the statistics of batch norm, are averaged in the same way; other buffers are copied. Checkpoints store the
    average as the weights of the model, and beside it the trained weights, with which a resumed run continues.

    Validation uses the average. `ReturnWeights` returns the trained weights after the checkpoints of the validation
    have been written, because Lightning stores the average only in checkpoints from which training can resume.

    Args:
        settings: decay of the average, and its first epoch.
    """

    def __init__(self, settings: WeightAveragingSettings) -> None:
        super().__init__(use_buffers=True, avg_fn=self._average)
        self.decay = settings.decay
        self.first_epoch = settings.first_epoch
        self._epoch = 0

    def _average(self, average: Tensor, current: Tensor, count: Any) -> Tensor:
        """Return the new average; equal numbers give this number to the last bit."""
        if not average.is_floating_point():
            return current
        weight = 1 / (int(count) + 1) if self.decay is None else 1 - self.decay
        return torch.lerp(average, current.to(average.dtype), weight)

    def should_update(self, step_idx: int | None = None, epoch_idx: int | None = None) -> bool:
        """Return whether the weights after this step enter the average: from epoch `first_epoch` on."""
        return step_idx is not None and self._epoch >= self.first_epoch

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Copy the model for the average, without the data set to which it refers.

        Raises:
            ConfigError: A wrapper collects weights itself, which the average would mix.
        """
        assert isinstance(pl_module, Training)
        collects = next(
            (part for part in pl_module.predictor.modules() if isinstance(part, FollowsTraining)), None
        )
        if collects is not None:
            raise ConfigError(
                f"trainer.callbacks=[weight_averaging] averages all numbers of the model, but "
                f"{type(collects).__name__} collects weights itself. Leave this callback or this wrapper out."
            )
        augment = pl_module.augment
        pl_module.augment = _unchanged  # a method of the data set, which would be copied with the model
        try:
            super().setup(trainer, pl_module, stage)
        finally:
            pl_module.augment = augment

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Add the present weights to the average."""
        self._epoch = trainer.current_epoch
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def on_validation_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Exchange the trained weights for their average."""
        self._begin(pl_module)
        super().on_validation_epoch_start(trainer, pl_module)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Do nothing, so that the average stays in the model until `return_weights` is called."""

    def return_weights(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Exchange the average for the trained weights after a validation."""
        super().on_validation_epoch_end(trainer, pl_module)

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Store in a checkpoint the average as the weights of the model, and the trained weights beside it."""
        self._begin(pl_module)
        super().on_save_checkpoint(trainer, pl_module, checkpoint)

    def _begin(self, pl_module: pl.LightningModule) -> None:
        """Set the average to the present weights if no weights have entered it yet."""
        if self._average_model is not None and int(self._average_model.n_averaged) == 0:
            self._average_model.module.load_state_dict(deepcopy(pl_module.state_dict()))


class ReturnWeights(BatchCallback):
    """Callback that puts the trained weights back into the model at the very end of a validation.

    Args:
        average: callback that put the average into the model before the validation.
    """

    def __init__(self, average: AverageWeights) -> None:
        self.average = average

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Exchange the average in the model for the trained weights."""
        self.average.return_weights(trainer, pl_module)


def _unchanged(batch: Any) -> Any:
    return batch
