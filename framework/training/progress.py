"""Progress of a training: a bar on a terminal, or lines in a log, one per epoch and one every half minute."""

import time
from typing import Any, final

import pytorch_lightning as pl
from rich import progress
from rich.console import Console

from framework.training.module import BatchCallback, Training

BAR_INTERVAL = 0.1
"""Seconds between two updates of the bar, which is drawn ten times a second."""


@final
class Progress(BatchCallback):
    """Callback that shows the epoch (from 1), its mean training loss so far, and the last validation loss.

    If the validation loss was measured after an earlier epoch, the text names this epoch. The line about a finished
    epoch without a validation holds no validation loss.

    Args:
        console: the console to write to; it is quiet in all ranks but the first.
        seconds: time between two lines within a long epoch, if the console is not a terminal.
    """

    def __init__(self, console: Console, seconds: float = 30.0) -> None:
        self.console = console
        self.seconds = seconds
        self._total, self._steps, self._last_line_time = 0.0, 0, 0.0
        self._validated_epoch: int | None = None
        self._bar: progress.Progress | None = None
        self._task = progress.TaskID(0)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the bar, if the console is a terminal."""
        self._last_line_time = time.monotonic()
        if self.console.is_terminal and not self.console.quiet:
            columns = (
                progress.TextColumn("{task.description}"),
                progress.BarColumn(),
                progress.MofNCompleteColumn(),
            )
            times = (progress.TimeElapsedColumn(), progress.TimeRemainingColumn())
            self._bar = progress.Progress(*columns, *times, console=self.console)
            self._task = self._bar.add_task("")
            self._bar.start()

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Reset the bar and the mean loss."""
        self._total, self._steps = 0.0, 0
        if self._bar is not None:
            self._bar.reset(self._task, total=trainer.num_training_batches, description=self._text(trainer))

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance the bar. Without a bar, write a line if the last line was written more than `seconds` ago."""
        assert isinstance(pl_module, Training)
        self._total += pl_module.last_loss
        self._steps += 1
        if self._bar is not None:
            if time.monotonic() - self._last_line_time > BAR_INTERVAL or trainer.is_last_batch:
                self._last_line_time = time.monotonic()
                self._bar.update(self._task, completed=batch_idx + 1, description=self._text(trainer))
        elif time.monotonic() - self._last_line_time > self.seconds:
            self._line(trainer, f", step {batch_idx + 1} of {trainer.num_training_batches}")

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Remember the epoch of this validation loss."""
        if not trainer.sanity_checking:
            self._validated_epoch = trainer.current_epoch

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write a line about the finished epoch, if there is no bar."""
        if self._bar is None:
            self._line(trainer, finished=True)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Stop the bar."""
        if self._bar is not None:
            self._bar.stop()

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Stop the bar."""
        self.on_train_end(trainer, pl_module)

    def _line(self, trainer: pl.Trainer, step: str = "", *, finished: bool = False) -> None:
        self._last_line_time = time.monotonic()
        self.console.print(self._text(trainer, step, finished=finished), soft_wrap=True, highlight=False)

    def _text(self, trainer: pl.Trainer, step: str = "", *, finished: bool = False) -> str:
        epochs = trainer.max_epochs or 0
        text = f"epoch {trainer.current_epoch + 1}" + (f" of {epochs}" if epochs > 0 else "") + step
        if self._steps:
            text += f": loss {self._total / self._steps:.4g}"
        validation, validated_epoch = trainer.callback_metrics.get("validation/loss"), self._validated_epoch
        if validation is None or validated_epoch is None:
            return text
        if validated_epoch == trainer.current_epoch:
            return f"{text}, validation loss {float(validation):.4g}"
        if finished:
            return text
        return f"{text}, validation loss {float(validation):.4g} after epoch {validated_epoch + 1}"
