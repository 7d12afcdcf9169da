"""The LightningModule of the density pipeline, and the callbacks that save, stop and report a run."""

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
from framework.errors import ConfigError, NonFiniteLoss, NonFiniteParameters
from framework.model import FrozenFrontEnd, Predictor, one_pass
from framework.objective import AdversaryOptimizer, Objective
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
"""Optimisers by their names in the config."""
FUSED = ("adam", "adamw", "sgd")
"""Optimisers that are used in their fused form, which takes half the time for the step of a small network.

It makes one pass over the memory of each parameter instead of several.
"""

ONE_VALUE = "Expected more than 1 value per channel"
"""Beginning of torch's message about batch norm over a single value."""


class Training(pl.LightningModule):
    """Minimises the predictor's mean loss plus the objectives.

    Noise (dropout, latent samples, augmentation) is a function of (seed, step). A loss that is not finite stops the run
    before the optimiser uses it.

    Args:
        cached: True if batches hold cached features (training.cached_features) instead of inputs; the predictor is then
            a `FrozenFrontEnd`.
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
        """The predictor that reads the batches: of a `FrozenFrontEnd` with cached features, the predictor inside."""
        if self.cached:
            assert isinstance(self.predictor, FrozenFrontEnd)
            return self.predictor.predictor
        return self.predictor

    def training_step(self, batch: Batch, batch_index: int) -> Tensor:
        """Return the loss of a batch, averaged so that the mean gradient over ranks is that of the whole batch.

        Raises:
            NonFiniteLoss: the loss is NaN or infinite.
        """
        rows = self._share(batch)
        # Count batches, not optimiser steps, which do not advance while gradients are accumulated.
        seed_step(self.seed, self.current_epoch * 1_000_003 + batch_index, "train")
        own = own_batches(self.learner) if self._orders() > 1 else nullcontext()
        with WholeBatch(rows) if rows else own, one_pass(self.learner):
            batch = self.augment(batch)
            losses = self._losses(batch)
            loss = losses.mean()
            for objective in self.objectives:
                loss = loss + objective(self.learner, batch)
        if rows:  # Gradients are averaged over ranks, whose shares may differ by a row.
            loss = loss * (rows.count * self.trainer.world_size / rows.whole)
            value = summed(loss).item() / self.trainer.world_size
        else:
            value = loss.item()
        if not math.isfinite(value):
            raise NonFiniteLoss(self._blame(losses, batch, value))
        self.last_loss = value
        return loss

    def _losses(self, batch: Batch) -> Tensor:
        """Return the predictor's loss per sample; errors of the network become sentences."""
        try:
            return self.learner.loss(batch["input"], batch["target"])
        except NonFiniteParameters as answer:
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
        """Return how many batches, one per model that trains, are concatenated in a batch (training.batches)."""
        trainer: Any = self.trainer
        return trainer.datamodule.orders

    def _share(self, batch: Batch) -> Share | None:
        """Return this rank's part of the batch; None if a single process trains."""
        return share(len(batch["index"]), self.device) if self.trainer.world_size > 1 else None

    def on_validation_batch_start(self, batch: Batch, batch_index: int, dataloader_idx: int = 0) -> None:
        """Seed the noise of a validation batch by (seed, batch)."""
        seed_step(self.seed, batch_index, "validation")

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        """Log the mean loss of a validation batch, over all ranks."""
        rows = self._share(batch)
        with WholeBatch(rows) if rows else nullcontext():
            loss = self._losses(batch).mean()
        count = len(batch["target"])
        if rows:  # weighted by rows here, because Lightning averages the ranks' numbers of rows as integers
            loss, count = summed(loss * rows.count) / rows.whole, rows.whole
        self.log("validation/loss", loss, on_epoch=True, batch_size=count, sync_dist=True)

    def configure_optimizers(self) -> dict[str, Any]:
        """Return the optimiser and the schedule of its learning rates.

        Each adversary has its own group of parameters and its own schedule.
        """
        chosen = self.optimizer_settings
        more: dict[str, Any] = {} if chosen.momentum is None else {"momentum": chosen.momentum}
        scaler = getattr(getattr(self.trainer, "precision_plugin", None), "scaler", None)
        if (
            chosen.name in FUSED and scaler is None
        ):  # with a scaler a fused optimiser would unscale gradients after they are clipped
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
        """Give the validation loss to a schedule that depends on it."""
        if self.trainer.state.fn == "fit" and not self.trainer.sanity_checking:
            loss = float(self.trainer.callback_metrics["validation/loss"])
            see(self.lr_schedulers(), loss, self.current_epoch + 1)

    def _rivals(self) -> list[tuple[Objective, AdversaryOptimizer]]:
        """Return the objectives whose parameters are trained against the predictor, with their optimiser settings."""
        objectives = [one for one in self.objectives if isinstance(one, Objective)]
        return [(one, one.adversary_optimizer) for one in objectives if one.adversary_optimizer is not None]

    def _own(self) -> list[nn.Parameter]:
        """Return the parameters that the predictor's own optimiser settings train."""
        apart = {id(parameter) for one, _ in self._rivals() for parameter in one.parameters()}
        return [parameter for parameter in self.parameters() if id(parameter) not in apart]

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip gradients as Lightning does, but separately for each adversary and for each of several models.

        It also clips for fused optimisers in mixed precision, which Lightning refuses.
        """
        if not gradient_clip_val:
            return
        clipped: set[nn.Parameter] = set()
        several = outermost(self.predictor)
        if isinstance(several, nn.Module) and gradient_clip_algorithm != "value":
            several.clip_each_model(gradient_clip_val)
            clipped = set(several.parameters())
        for group in optimizer.param_groups:
            if gradient_clip_algorithm == "value":
                nn.utils.clip_grad_value_(group["params"], gradient_clip_val)
            else:
                left = [one for one in group["params"] if one not in clipped]
                nn.utils.clip_grad_norm_(left, gradient_clip_val)

    def _planned_steps(self) -> tuple[int, int]:
        """Return the number of optimiser steps of the whole training, and of one epoch, for the schedule.

        `trainer.estimated_stepping_batches` is not used: it starts the loader, whose workers then fetch from the first
        batch before a resumed run knows its position.
        """
        trainer: Any = self.trainer
        batches = len(trainer.datamodule.train_dataloader())
        limit = trainer.limit_train_batches
        batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        epoch = math.ceil(batches / trainer.accumulate_grad_batches)
        steps = epoch * max(1, trainer.max_epochs or 1)
        return max(1, min(steps, trainer.max_steps) if trainer.max_steps >= 0 else steps), epoch

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the description of the run to the checkpoint."""
        checkpoint["framework"] = self.description

    def _blame(self, losses: Tensor, batch: Batch, value: float) -> str:
        """Return the message about a loss that is not finite, with the samples that caused it."""
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
    """Writes last.ckpt (and keeps the one before it as previous.ckpt) and, with `keep="best"`, best.ckpt.

    Training resumes from the first two. `best` holds weights only; with Adam it takes a third of the size. `last` is
    saved at the end of every epoch with a validation, at the end of the last epoch, and every `every_steps` steps.
    `best` is saved whenever the validation loss reaches a new minimum. Each write is whole or absent
    (framework.storage.checkpoints).

    Attributes:
        kept_loss: validation loss of the weights that will be tested, nats.
        kept_epoch: epoch of these weights, from 0.
    """

    def __init__(self, folder: Path, every_steps: int | None, keep: Literal["best", "last"] = "best") -> None:
        self.folder = folder
        self.every_steps = every_steps
        self.keep: Literal["best", "last"] = keep
        self.kept_loss = math.inf
        self.kept_epoch = -1

    @property
    def kept(self) -> Path:
        """Path of the checkpoint whose weights will be tested."""
        return self.folder / f"{self.keep}.ckpt"

    def state_dict(self) -> dict[str, Any]:
        """Return the loss and epoch of the kept weights."""
        return {"kept_loss": self.kept_loss, "kept_epoch": self.kept_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the loss and epoch of the kept weights."""
        self.kept_loss = state_dict["kept_loss"]
        self.kept_epoch = state_dict["kept_epoch"]

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save last.ckpt every `every_steps` steps."""
        # Not at an epoch's last batch: a run resumed from there would skip the validation that follows.
        if self.every_steps and trainer.global_step % self.every_steps == 0 and not trainer.is_last_batch:
            self.save_last(trainer)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Record the loss of the weights to keep, and save best.ckpt if it is the lowest so far."""
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        loss = float(trainer.callback_metrics["validation/loss"])
        if self.keep == "last" or loss < self.kept_loss:
            self.kept_loss, self.kept_epoch = loss, trainer.current_epoch
            if self.keep == "best":
                trainer.save_checkpoint(self.kept, weights_only=True)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save last.ckpt after an epoch with a validation, and after the last epoch."""
        done, every = trainer.current_epoch + 1, trainer.check_val_every_n_epoch or 1
        if done % every == 0 or done == trainer.max_epochs or trainer.should_stop:
            self.save_last(trainer)

    def save_last(self, trainer: pl.Trainer) -> None:
        """Save last.ckpt, and keep the one before it as previous.ckpt."""
        last = self.folder / "last.ckpt"
        if last.exists() and trainer.is_global_zero:
            last.replace(self.folder / "previous.ckpt")
        trainer.save_checkpoint(last)


class StopEarly(EarlyStopping):
    """Stops when the validation loss had no new minimum for `patience` validations, or is not finite.

    It checks at the end of a validation, because last.ckpt is written after that and must hold the result. Lightning
    restores this result, but not that the trainer was told to stop. Without `on_train_start`, a run that was killed in
    its test would therefore train on when it is resumed.
    """

    def __init__(self, patience: int) -> None:
        super().__init__(
            "validation/loss", patience=patience, check_finite=True, check_on_train_epoch_end=False
        )

    @property
    def stopped(self) -> bool:
        """True if the trainer was told to stop; it still trains until its `min_epochs` and `min_steps`."""
        return self.stopping_reason is not EarlyStoppingReason.NOT_STOPPED

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Tell the trainer of a resumed run to stop if that was decided before."""
        trainer.should_stop = trainer.should_stop or self.stopped


class Report(pl.Callback):
    """Sends losses and the learning rate to the tracker, every `every_steps` steps and at the end of an epoch."""

    def __init__(self, tracker: Tracker, every_steps: int) -> None:
        self.tracker = tracker
        self.every_steps = every_steps

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Send the training loss, the learning rate and the scalars of the objectives."""
        if (trainer.global_step % self.every_steps == 0 or trainer.is_last_batch) and trainer.is_global_zero:
            assert isinstance(pl_module, Training)
            rate = trainer.optimizers[0].param_groups[0]["lr"]
            told = {
                f"train/{name}": float(value)
                for one in pl_module.objectives
                if isinstance(one, Objective)
                for name, value in one.logged_terms.items()
            }
            self.tracker.log_metrics(
                {"train/loss": pl_module.last_loss, "train/learning_rate": rate, **told},
                trainer.global_step,
                trainer.current_epoch,
            )

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Send the validation loss."""
        if not trainer.sanity_checking and trainer.is_global_zero and trainer.state.fn == "fit":
            loss = float(trainer.callback_metrics["validation/loss"])
            self.tracker.log_metrics({"validation/loss": loss}, trainer.global_step, trainer.current_epoch)


class StopAtBatch(pl.Callback):
    """Delays a signal during the fit until the batch ends; then last.ckpt is saved and the run stops.

    In the last batch of an epoch the signal waits for the end of the epoch.
    """

    def __init__(self, stopper: Stopper, keep: KeepCheckpoints) -> None:
        self.stopper = stopper
        self.keep = keep

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Delay signals from now on."""
        self.stopper.wait = True
        # Lightning has installed its own handler, whose broadcast inside a signal makes several ranks hang.
        self.stopper.install()

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let signals act at once again."""
        self.stopper.wait = False

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save last.ckpt and stop if a signal has come, except at the last batch of an epoch."""
        if self._told(trainer) and not trainer.is_last_batch:
            self.keep.save_last(trainer)
            self.stopper.stop()

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save last.ckpt and stop if a signal has come."""
        if self._told(trainer):
            self.keep.save_last(trainer)
            self.stopper.stop()

    def _told(self, trainer: pl.Trainer) -> bool:
        """Return whether any rank has received a signal, so that all ranks save and stop together."""
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
        """Stop without saving if a signal has come."""
        # No checkpoint is saved here: a run resumed from it would skip the rest of the validation.
        if self._told(trainer):
            self.stopper.stop()
