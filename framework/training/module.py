"""The one LightningModule of the density pipeline, and the callbacks that keep a run whole."""

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks.early_stopping import EarlyStopping, EarlyStoppingReason
from torch import Tensor, nn

from framework.configuration.settings import OptimizerSettings
from framework.data import Batch, Data
from framework.distributions.noise import seed_step
from framework.errors import ConfigError, NonFiniteAnswer, NonFiniteLoss
from framework.model import FrozenFrontEnd, Predictor, one_pass
from framework.objective import Objective, Rival
from framework.tracking.signals import Stopper
from framework.tracking.tracker import Tracker
from framework.training.ranks import Share, WholeBatch, gathered, share, summed
from framework.training.schedules import schedule, see, smooth
from framework.uncertainty import outermost, own_batches

OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "sgd": torch.optim.SGD,
    "nadam": torch.optim.NAdam,
    "radam": torch.optim.RAdam,
}
FUSED = ("adam", "adamw", "sgd")
"""One pass over the memory of each parameter instead of several, half the time of a small network's step."""

ONE_VALUE = "Expected more than 1 value per channel"
"""What torch says of batch norm over one value."""


class Training(pl.LightningModule):
    """Minimises the predictor's mean loss plus the objectives.

    Noise (dropout, latent draws, augmentation) is a function of (seed, step); a loss that is not finite stops the
    run before the optimiser sees it.

    Args:
        cached: whether batches hold cached features (training.cached_features) and not inputs; the predictor is a
            `FrozenFrontEnd` then.
    """

    def __init__(
        self,
        predictor: Predictor,
        objectives: Sequence[Objective],
        data: Data,
        optimizer: OptimizerSettings,
        seed: int,
        description: dict[str, Any],
        *,
        cached: bool = False,
    ) -> None:
        super().__init__()
        self.predictor = predictor
        self.objectives = nn.ModuleList(objectives)
        self.augment = data.augment
        self.optimizer_settings = optimizer
        self.seed = seed
        self.description = description
        self.cached = cached

    @property
    def learner(self) -> Predictor:
        """What reads the batches."""
        if self.cached:
            assert isinstance(self.predictor, FrozenFrontEnd)
            return self.predictor.predictor
        return self.predictor

    def training_step(self, batch: Batch, batch_index: int) -> Tensor:
        rows = self._share(batch)
        # by batches, not by optimiser steps: those stand still while gradients are accumulated
        seed_step(self.seed, self.current_epoch * 1_000_003 + batch_index, "train")
        own = own_batches(self.learner) if self._orders() > 1 else nullcontext()
        with WholeBatch(rows) if rows else own, one_pass(self.learner):
            batch = self.augment(batch)
            losses = self._losses(batch)
            loss = losses.mean()
            for objective in self.objectives:
                loss = loss + objective(self.learner, batch)
        if rows:  # gradients are averaged over ranks, whose shares may differ by a row
            loss = loss * (rows.count * self.trainer.world_size / rows.whole)
            value = summed(loss).item() / self.trainer.world_size
        else:
            value = loss.item()
        if not math.isfinite(value):
            raise NonFiniteLoss(self._blame(losses, batch, value))
        self.last_loss = value
        return loss

    def _losses(self, batch: Batch) -> Tensor:
        try:
            return self.learner.loss(batch["input"], batch["target"])
        except NonFiniteAnswer as answer:
            raise NonFiniteLoss(
                f"After step {self.global_step} (epoch {self.current_epoch}) the network's {answer} Earlier "
                "checkpoints are kept. Lower optimizer.learning_rate, set trainer.gradient_clip_val, or train in "
                "trainer.precision=32-true."
            ) from answer
        except ValueError as error:
            if ONE_VALUE not in str(error):
                raise
            raise ConfigError(
                f"A training batch of {len(batch['input'])} leaves batch norm one value of each channel, and its "
                "variance needs two. Give a batch_size (and a training split) of at least 2, or choose layers without "
                "batch norm."
            ) from error

    def _orders(self) -> int:
        """How many models' batches a batch holds, one after the other (training.batches)."""
        trainer: Any = self.trainer
        return trainer.datamodule.orders

    def _share(self, batch: Batch) -> Share | None:
        """This rank's part of the batch; None where one process trains."""
        return share(len(batch["index"]), self.device) if self.trainer.world_size > 1 else None

    def on_validation_batch_start(self, batch: Batch, batch_index: int, dataloader_idx: int = 0) -> None:
        seed_step(self.seed, batch_index, "validation")

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        rows = self._share(batch)
        with WholeBatch(rows) if rows else nullcontext():
            loss = self._losses(batch).mean()
        count = len(batch["target"])
        if rows:  # by rows here, since Lightning averages the ranks' numbers of rows as whole numbers
            loss, count = summed(loss * rows.count) / rows.whole, rows.whole
        self.log("validation/loss", loss, on_epoch=True, batch_size=count, sync_dist=True)

    def configure_optimizers(self) -> dict[str, Any]:
        chosen = self.optimizer_settings
        more: dict[str, Any] = {} if chosen.momentum is None else {"momentum": chosen.momentum}
        scaler = getattr(getattr(self.trainer, "precision_plugin", None), "scaler", None)
        if (
            chosen.name in FUSED and scaler is None
        ):  # else a fused one would unscale gradients after they are clipped
            more["fused"] = True
        groups: list[dict[str, Any]] = [{"params": self._own()}]
        groups += [
            {
                "params": list(one.parameters()),
                "lr": rival.learning_rate,
                "betas": rival.betas,
                "weight_decay": 0.0,
            }
            for one, rival in self._rivals()
        ]
        optimizer = OPTIMIZERS[chosen.name](
            groups, lr=chosen.learning_rate, weight_decay=chosen.weight_decay, **more
        )
        total, epoch = self._planned_steps()
        factors = [schedule(chosen, total, epoch)]
        factors += [
            partial(smooth, total=total if rival.schedule == "cosine" else None)
            for _, rival in self._rivals()
        ]
        rates = torch.optim.lr_scheduler.LambdaLR(optimizer, factors)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rates, "interval": "step"}}

    def on_validation_end(self) -> None:
        if self.trainer.state.fn == "fit" and not self.trainer.sanity_checking:
            loss = float(self.trainer.callback_metrics["validation/loss"])
            see(self.lr_schedulers(), loss, self.current_epoch + 1)

    def _rivals(self) -> list[tuple[Objective, Rival]]:
        objectives = [one for one in self.objectives if isinstance(one, Objective)]
        return [(one, one.rival) for one in objectives if one.rival is not None]

    def _own(self) -> list[nn.Parameter]:
        """What the predictor's own optimiser moves."""
        apart = {id(parameter) for one, _ in self._rivals() for parameter in one.parameters()}
        return [parameter for parameter in self.parameters() if id(parameter) not in apart]

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """As Lightning does, but each rival's gradients by themselves, and those of models that train together; of
        fused optimisers in mixed precision too, which Lightning refuses."""
        if not gradient_clip_val:
            return
        clipped: set[nn.Parameter] = set()
        several = outermost(self.predictor)
        if isinstance(several, nn.Module) and gradient_clip_algorithm != "value":
            several.clip_each(gradient_clip_val)
            clipped = set(several.parameters())
        for group in optimizer.param_groups:
            if gradient_clip_algorithm == "value":
                nn.utils.clip_grad_value_(group["params"], gradient_clip_val)
            else:
                left = [one for one in group["params"] if one not in clipped]
                nn.utils.clip_grad_norm_(left, gradient_clip_val)

    def _planned_steps(self) -> tuple[int, int]:
        """Optimiser steps until the end, and of one epoch, for the schedule.

        Not `trainer.estimated_stepping_batches`: it starts the loader, whose workers then fetch from the first batch
        before a resumed run knows where it is.
        """
        trainer: Any = self.trainer
        batches = len(trainer.datamodule.train_dataloader())
        limit = trainer.limit_train_batches
        batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        epoch = math.ceil(batches / trainer.accumulate_grad_batches)
        steps = epoch * max(1, trainer.max_epochs or 1)
        return max(1, min(steps, trainer.max_steps) if trainer.max_steps >= 0 else steps), epoch

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["framework"] = self.description

    def _blame(self, losses: Tensor, batch: Batch, value: float) -> str:
        bad = (~losses.detach().isfinite()).nonzero().flatten().tolist()
        rows = [int(batch["index"][row]) for row in bad]
        if self.trainer.world_size > 1:
            rows = [row for some in gathered(rows) for row in some]
        who = f"samples {rows[:10]} of the training split" if rows else "an objective, not a sample"
        return (
            f"The training loss became {value} at step {self.global_step} (epoch {self.current_epoch}), through {who}. "
            "The weights were not changed by this step and the last checkpoint is kept. Look at these samples, lower "
            "optimizer.learning_rate, or set trainer.gradient_clip_val."
        )


class KeepCheckpoints(pl.Callback):
    """Writes last.ckpt (and keeps the one before it as previous.ckpt) and, where it is to be kept, best.ckpt.

    Training goes on from the first two; `best` holds weights alone, with Adam a third of the size. `last` is saved at
    the end of every epoch that was validated, of the last one, and every `every_steps` steps; `best` whenever the
    validation loss is lower than ever. Each write is whole or absent (framework.storage.checkpoints).

    Attributes:
        kept_loss: validation loss of the weights that will be tested, nats.
        kept_epoch: theirs, from 0.
    """

    def __init__(self, folder: Path, every_steps: int | None, keep: Literal["best", "last"] = "best") -> None:
        self.folder = folder
        self.every_steps = every_steps
        self.keep: Literal["best", "last"] = keep
        self.kept_loss = math.inf
        self.kept_epoch = -1

    @property
    def kept(self) -> Path:
        """The checkpoint whose weights will be tested."""
        return self.folder / f"{self.keep}.ckpt"

    def state_dict(self) -> dict[str, Any]:
        return {"kept_loss": self.kept_loss, "kept_epoch": self.kept_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.kept_loss = state_dict["kept_loss"]
        self.kept_epoch = state_dict["kept_epoch"]

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        # not at an epoch's last batch: a run resumed from there would skip the validation that is about to come
        if self.every_steps and trainer.global_step % self.every_steps == 0 and not trainer.is_last_batch:
            self.save_last(trainer)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        loss = float(trainer.callback_metrics["validation/loss"])
        if self.keep == "last" or loss < self.kept_loss:
            self.kept_loss, self.kept_epoch = loss, trainer.current_epoch
            if self.keep == "best":
                trainer.save_checkpoint(self.kept, weights_only=True)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        done, every = trainer.current_epoch + 1, trainer.check_val_every_n_epoch or 1
        if done % every == 0 or done == trainer.max_epochs or trainer.should_stop:
            self.save_last(trainer)

    def save_last(self, trainer: pl.Trainer) -> None:
        last = self.folder / "last.ckpt"
        if last.exists() and trainer.is_global_zero:
            last.replace(self.folder / "previous.ckpt")
        trainer.save_checkpoint(last)


class StopEarly(EarlyStopping):
    """Stops when the validation loss was not lower than ever for `patience` validations, or is not finite.

    It looks when a validation ends, since last.ckpt is written after that and must hold what was found. Lightning
    restores what was found, but not that the trainer was told to stop: a run that was killed in its test would train
    on where it is resumed.
    """

    def __init__(self, patience: int) -> None:
        super().__init__(
            "validation/loss", patience=patience, check_finite=True, check_on_train_epoch_end=False
        )

    @property
    def stopped(self) -> bool:
        """Whether the trainer was told to stop; it goes on until its `min_epochs` and `min_steps` all the same."""
        return self.stopping_reason is not EarlyStoppingReason.NOT_STOPPED

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        trainer.should_stop = trainer.should_stop or self.stopped


class Report(pl.Callback):
    """Sends losses and the learning rate to the tracker, every so many steps and at the end of an epoch."""

    def __init__(self, tracker: Tracker, every_steps: int) -> None:
        self.tracker = tracker
        self.every_steps = every_steps

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if (trainer.global_step % self.every_steps == 0 or trainer.is_last_batch) and trainer.is_global_zero:
            assert isinstance(pl_module, Training)
            rate = trainer.optimizers[0].param_groups[0]["lr"]
            told = {
                f"train/{name}": float(value)
                for one in pl_module.objectives
                if isinstance(one, Objective)
                for name, value in one.told.items()
            }
            self.tracker.log_metrics(
                {"train/loss": pl_module.last_loss, "train/learning_rate": rate, **told},
                trainer.global_step,
                trainer.current_epoch,
            )

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if not trainer.sanity_checking and trainer.is_global_zero and trainer.state.fn == "fit":
            loss = float(trainer.callback_metrics["validation/loss"])
            self.tracker.log_metrics({"validation/loss": loss}, trainer.global_step, trainer.current_epoch)


class StopAtBatch(pl.Callback):
    """While fitting, a signal waits for the batch to end, or for the epoch's end if it is the last one; then last.ckpt
    is saved and the run stops."""

    def __init__(self, stopper: Stopper, keep: KeepCheckpoints) -> None:
        self.stopper = stopper
        self.keep = keep

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.stopper.wait = True
        # Lightning has put its own handler before ours, whose broadcast from inside of a signal hangs several ranks
        self.stopper.install()

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.stopper.wait = False

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._told(trainer) and not trainer.is_last_batch:
            self.keep.save_last(trainer)
            self.stopper.stop()

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if self._told(trainer):
            self.keep.save_last(trainer)
            self.stopper.stop()

    def _told(self, trainer: pl.Trainer) -> bool:
        """Whether a signal has come, to whichever rank: they save and stop together."""
        return trainer.strategy.reduce_boolean_decision(self.stopper.received is not None, all=False)

    def on_validation_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        # The last checkpoint stands: one saved inside validation would skip the rest of it on resuming.
        if self._told(trainer):
            self.stopper.stop()
