"""The LightningModule of the density pipeline, and the callbacks that save, stop and report a run."""

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import GradientAccumulationScheduler
from pytorch_lightning.callbacks.early_stopping import EarlyStopping, EarlyStoppingReason
from pytorch_lightning.profilers import PassThroughProfiler
from torch import Tensor, nn
from torch.utils.data import DataLoader

from framework.configuration.settings import OptimizerSettings
from framework.data import Batch, Data
from framework.distributions.noise import seed_step
from framework.errors import ConfigError, NonFiniteLoss, NonFiniteParameters
from framework.model import FrozenFrontEnd, Predictor, SharedResult, one_pass, shared_results
from framework.objective import AdversaryOptimizer, Objective
from framework.tracking.signals import Stopper
from framework.tracking.tracker import Tracker
from framework.training.batches import Batches
from framework.training.ranks import Share, WholeBatch, gather_rows, rank_share, sum_over_ranks
from framework.training.schedules import make_schedule, smooth_factor, update_plateaus
from framework.uncertainty import FollowsTraining, outermost, own_batches

OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "sgd": torch.optim.SGD,
    "nadam": torch.optim.NAdam,
    "radam": torch.optim.RAdam,
}
"""Optimisers by their names in the config."""
FUSED = ("adam", "adamw", "sgd")
"""Optimisers that are used in torch's fused form, which halves the time of a small network's step.

The fused form passes over the memory of each parameter once instead of several times.
"""

ONE_VALUE = "Expected more than 1 value per channel"
"""Beginning of torch's error message about batch norm in training over a single value per channel."""


class LoadedBatches(pl.LightningDataModule):
    """Lightning's view of `Batches`, to which it attaches the trainer.

    The trainer needs `use_distributed_sampler=False`, because `Batches` divides the samples among ranks.

    Args:
        batches: loaders of the batches.
        trainer: the trainer, which says at which batch to start, the rank and the device.
    """

    def __init__(self, batches: Batches, trainer: pl.Trainer) -> None:
        super().__init__()
        self.batches = batches
        batches.attach(trainer)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return the loader of the training batches."""
        return self.batches.train_dataloader()

    def val_dataloader(self) -> DataLoader[Batch]:
        """Return the batches of the validation split."""
        return self.batches.val_dataloader()


class Training(pl.LightningModule):
    """LightningModule that minimises the predictor's mean loss plus the objectives.

    Noise (dropout, latent samples, augmentation) is a function of (seed, step). A loss that is not finite raises an
    error before the optimiser step.

    Args:
        predictor: predictor that is trained.
        objectives: terms that are added to the loss.
        data: data set, whose `augment` varies the batches.
        optimizer: settings of the optimiser and of its schedule.
        seed: seed of the noise.
        description: description of the model, which is added to checkpoints (`configuration.description`).
        cached: True if batches hold cached features (training.cached_features) instead of inputs; the predictor is then
            a `FrozenFrontEnd`.

    Attributes:
        begun_epochs: number of epochs that have begun since the training began or was resumed.
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
        self.begun_epochs = 0

    def on_train_epoch_start(self) -> None:
        """Count the epochs."""
        self.begun_epochs += 1

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute, without torch's slow checks if it is the name of the hook that Lightning is running.

        Lightning sets this name 50 times in each step.
        """
        if name == "_current_fx_name":  # the checks of torch's modules would take 0.1 ms in each step
            self.__dict__[name] = value
        else:
            super().__setattr__(name, value)

    # Lightning would look for these hooks in the model and in the loaders at every step, which takes 0.06 ms.
    def _on_before_batch_transfer(self, batch: Batch, dataloader_idx: int = 0) -> Batch:
        return batch

    def _apply_batch_transfer_handler(
        self, batch: Batch, device: torch.device | None = None, dataloader_idx: int = 0
    ) -> Batch:
        device = device or self.device
        if device.type == "cpu":
            return batch
        return {name: tensor.to(device, non_blocking=True) for name, tensor in batch.items()}

    @property
    def learner(self) -> Predictor:
        """Predictor that reads the batches; with cached features, it is the one inside the `FrozenFrontEnd`."""
        if self.cached:
            assert isinstance(self.predictor, FrozenFrontEnd)
            return self.predictor.predictor
        return self.predictor

    @cached_property
    def _shared_results(self) -> list[SharedResult[Any]]:
        return shared_results(self.learner)

    def training_step(self, batch: Batch, batch_index: int) -> Tensor:
        """Return the loss of this rank's rows, weighted so that the mean over ranks is the loss of the whole batch.

        Raises:
            NonFiniteLoss: the loss is NaN or infinite.
        """
        rows = self._share(batch)
        # Count batches, not optimiser steps, which do not advance while gradients are accumulated.
        seed_step(self.seed, self.current_epoch * 1_000_003 + batch_index, "train")
        noise_mode = own_batches(self.learner) if self._orders() > 1 else nullcontext()
        with WholeBatch(rows) if rows else noise_mode, one_pass(self.learner, self._shared_results):
            batch = self.augment(batch)
            losses = self._losses(batch)
            loss = losses.mean()
            for objective in self.objectives:
                loss = loss + objective(self.learner, batch)
        if rows:  # Lightning averages gradients over ranks, whose shares may differ by a row.
            loss = loss * (rows.count * self.trainer.world_size / rows.whole)
            value = sum_over_ranks(loss).item() / self.trainer.world_size
        else:
            value = loss.item()
        if not math.isfinite(value):
            raise NonFiniteLoss(self._non_finite_message(losses, batch, value))
        self.last_loss = value
        return loss

    def _losses(self, batch: Batch) -> Tensor:
        """Return the predictor's loss per sample; errors of the network become messages that say what to change."""
        try:
            return self.learner.loss(batch["input"], batch["target"])
        except NonFiniteParameters as error:
            raise NonFiniteLoss(
                f"Training failed after step {self.global_step} (epoch {self.current_epoch}). {error} Earlier "
                "checkpoints are kept. Lower optimizer.learning_rate, set trainer.gradient_clip_val, or train in "
                "trainer.precision=32-true."
            ) from error
        except ValueError as error:
            if ONE_VALUE not in str(error):
                raise
            raise ConfigError(
                f"A training batch of {len(batch['input'])} gives batch norm one value per channel, but the variance "
                "needs two. Set batch_size to at least 2, use a training split of at least 2 samples, or choose "
                "layers without batch norm."
            ) from error

    def _orders(self) -> int:
        """Return the number of models that train together; each batch contains one batch per model (`Batches`)."""
        trainer: Any = self.trainer
        return trainer.datamodule.batches.orders

    def _share(self, batch: Batch) -> Share | None:
        """Return the rows of the whole batch that this rank has; None if a single process trains."""
        return rank_share(len(batch["index"]), self.device) if self.trainer.world_size > 1 else None

    def on_validation_batch_start(self, batch: Batch, batch_index: int, dataloader_idx: int = 0) -> None:
        """Seed the noise of a validation batch by the seed and the number of the batch."""
        seed_step(self.seed, batch_index, "validation")

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        """Log the mean loss of a validation batch, over all ranks."""
        rows = self._share(batch)
        with WholeBatch(rows) if rows else nullcontext():
            loss = self._losses(batch).mean()
        count = len(batch["target"])
        if rows:  # weighted here, because Lightning would average the ranks' batch sizes as integers
            loss, count = sum_over_ranks(loss * rows.count) / rows.whole, rows.whole
        self.log("validation/loss", loss, on_epoch=True, batch_size=count, sync_dist=True)

    def configure_optimizers(self) -> dict[str, Any]:
        """Return the optimiser and the schedule of its learning rates.

        Each adversary has its own parameter group and its own schedule.
        """
        settings = self.optimizer_settings
        options: dict[str, Any] = {} if settings.momentum is None else {"momentum": settings.momentum}
        scaler = getattr(getattr(self.trainer, "precision_plugin", None), "scaler", None)
        # With a scaler, a fused optimiser would unscale gradients after they are clipped.
        if settings.name in FUSED and scaler is None:
            options["fused"] = True
        groups: list[dict[str, Any]] = [{"params": self._predictor_parameters()}]
        groups += [
            {
                "params": list(objective.parameters()),
                "lr": adversary.learning_rate,
                "betas": adversary.betas,
                "weight_decay": 0.0,
            }
            for objective, adversary in self._adversaries()
        ]
        optimizer = OPTIMIZERS[settings.name](
            groups, lr=settings.rate, weight_decay=settings.weight_decay, **options
        )
        total, epoch = self._planned_steps()
        factors = [make_schedule(settings, total, epoch)]
        factors += [
            partial(smooth_factor, total=total if adversary.schedule == "cosine" else None)
            for _, adversary in self._adversaries()
        ]
        rates = torch.optim.lr_scheduler.LambdaLR(optimizer, factors)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rates, "interval": "step"}}

    def on_validation_end(self) -> None:
        """Pass the validation loss to the schedules that depend on it (`Plateau`)."""
        if self.trainer.state.fn == "fit" and not self.trainer.sanity_checking:
            loss = float(self.trainer.callback_metrics["validation/loss"])
            update_plateaus(self.lr_schedulers(), loss, self.current_epoch + 1)

    def _adversaries(self) -> list[tuple[Objective, AdversaryOptimizer]]:
        """Return the objectives whose parameters are trained against the predictor, with their optimiser settings."""
        objectives = [module for module in self.objectives if isinstance(module, Objective)]
        return [
            (objective, objective.adversary_optimizer)
            for objective in objectives
            if objective.adversary_optimizer is not None
        ]

    def _predictor_parameters(self) -> list[nn.Parameter]:
        """Return the parameters to which the settings `optimizer` apply: all except those of the adversaries."""
        excluded = {
            id(parameter) for objective, _ in self._adversaries() for parameter in objective.parameters()
        }
        return [parameter for parameter in self.parameters() if id(parameter) not in excluded]

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip gradients as Lightning does, but separately for each adversary and for each of several models.

        Unlike Lightning, it also clips with fused optimisers in mixed precision.
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
                remaining = [parameter for parameter in group["params"] if parameter not in clipped]
                gradients = [parameter.grad for parameter in remaining if parameter.grad is not None]
                norm = nn.utils.get_total_norm(gradients)
                # torch would also multiply by a factor of 1; on other devices, the comparison would wait for them
                if norm.device.type != "cpu" or not gradient_clip_val / (norm + 1e-6) >= 1:
                    nn.utils.clip_grads_with_norm_(remaining, gradient_clip_val, norm)

    def _planned_steps(self) -> tuple[int, int]:
        """Return the planned number of optimiser steps of the whole training, and that of one epoch.

        `trainer.estimated_stepping_batches` is not used, because it starts the loader: the workers of a resumed run
        would fetch from the first batch on, before the run's position is known.
        """
        trainer: Any = self.trainer
        batches = len(trainer.datamodule.train_dataloader())
        limit = trainer.limit_train_batches
        batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        epoch = math.ceil(batches / trainer.accumulate_grad_batches)
        epochs = max(1, trainer.max_epochs or 1)
        schedule = next(
            (
                callback
                for callback in trainer.callbacks
                if isinstance(callback, GradientAccumulationScheduler)
            ),
            None,
        )
        steps = epoch * epochs
        if schedule is not None:
            steps = sum(
                math.ceil(batches / schedule.get_accumulate_grad_batches(number)) for number in range(epochs)
            )
        return max(1, min(steps, trainer.max_steps) if trainer.max_steps >= 0 else steps), epoch

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the model's description (`configuration.description`) and the number of processes to a checkpoint."""
        checkpoint["framework"] = self.description
        checkpoint["processes"] = self.trainer.world_size

    def _non_finite_message(self, losses: Tensor, batch: Batch, value: float) -> str:
        """Return the error message for a loss that is not finite; it names the samples that caused it."""
        bad = (~losses.detach().isfinite()).nonzero().flatten().tolist()
        rows = [int(batch["index"][row]) for row in bad]
        if self.trainer.world_size > 1:
            rows = [row for rank_rows in gather_rows(rows) for row in rank_rows]
        cause = f"samples {rows[:10]} of the training split" if rows else "an objective, not a sample"
        return (
            f"The training loss became {value} at step {self.global_step} (epoch {self.current_epoch}), caused by "
            f"{cause}. This step did not change the weights, and the last checkpoint is kept. Check these samples, "
            "lower optimizer.learning_rate, or set trainer.gradient_clip_val."
        )


class BatchCallback(pl.Callback):
    """Callback without the hooks in the middle of a step, which none of this framework's callbacks uses.

    Lightning skips a hook that cannot be called. An empty hook would take 2 µs, and all empty hooks together 50 µs in
    each step.
    """

    on_train_batch_start: Any = None
    on_before_zero_grad: Any = None
    on_before_backward: Any = None
    on_after_backward: Any = None
    on_before_optimizer_step: Any = None

    @staticmethod
    def ends_step(trainer: pl.Trainer) -> bool:
        """Return whether the present training batch is the last one of an optimiser step.

        With accumulated gradients a step has several batches. Between them, nothing may be saved: a checkpoint does not
        hold the gradients of the step's first batches.
        """
        return (
            trainer.is_last_batch or (trainer.fit_loop.batch_idx + 1) % trainer.accumulate_grad_batches == 0
        )


class NoProfiler(PassThroughProfiler):
    """Profiler that measures nothing; it saves 1 µs in each of the 50 hooks of a step, compared with Lightning's."""

    _nothing = nullcontext()

    def profile(self, action_name: str) -> Any:
        """Return a context without any effect."""
        return self._nothing


class FollowTraining(BatchCallback):
    """Callback that calls the wrappers of class `FollowsTraining` after each epoch.

    It must precede `KeepCheckpoints`, whose checkpoints store what the wrappers collect.
    """

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let the wrappers read the weights."""
        assert isinstance(pl_module, Training) and trainer.max_epochs is not None
        for module in pl_module.predictor.modules():
            if isinstance(module, FollowsTraining):
                module.after_epoch(trainer.current_epoch, trainer.max_epochs)


class KeepCheckpoints(BatchCallback):
    """Callback that writes last.ckpt, previous.ckpt (the last.ckpt before it) and, with `keep="best"`, best.ckpt.

    Training can resume from last.ckpt and previous.ckpt. best.ckpt holds weights only; with Adam it has a third of the
    size of the other two.

    last.ckpt is saved after every epoch with a validation, after the last epoch, and every `every_steps` steps.
    best.ckpt is saved whenever the validation loss reaches a new minimum. Every write is atomic
    (framework.storage.checkpoints).

    Args:
        folder: folder of the checkpoints.
        every_steps: number of steps between two saves of last.ckpt within an epoch; None: there are no such saves.
        keep: which weights are tested: those with the lowest validation loss ("best") or those of the last epoch.

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
    def kept_path(self) -> Path:
        """Path of the checkpoint whose weights will be tested."""
        return self.folder / f"{self.keep}.ckpt"

    def state_dict(self) -> dict[str, Any]:
        """Return the loss and epoch of the kept weights."""
        return {"kept_loss": self.kept_loss, "kept_epoch": self.kept_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the loss and epoch of the kept weights."""
        self.kept_loss = state_dict["kept_loss"]
        self.kept_epoch = state_dict["kept_epoch"]

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save last.ckpt every `every_steps` steps."""
        # Not at an epoch's last batch: a run resumed from there would skip the validation that follows.
        due = self.every_steps and trainer.global_step % self.every_steps == 0 and not trainer.is_last_batch
        if due and self.ends_step(trainer):
            self.save_last(trainer)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Record the loss of the weights to keep; with `keep="best"`, save best.ckpt if no loss was lower so far."""
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        loss = float(trainer.callback_metrics["validation/loss"])
        if self.keep == "last" or loss < self.kept_loss:
            self.kept_loss, self.kept_epoch = loss, trainer.current_epoch
            if self.keep == "best":
                trainer.save_checkpoint(self.kept_path, weights_only=True)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save last.ckpt after an epoch with a validation, and after the last epoch."""
        epochs, every = trainer.current_epoch + 1, trainer.check_val_every_n_epoch or 1
        if epochs % every == 0 or epochs == trainer.max_epochs or trainer.should_stop:
            self.save_last(trainer)

    def save_last(self, trainer: pl.Trainer) -> None:
        """Save last.ckpt, and keep the one before it as previous.ckpt."""
        last = self.folder / "last.ckpt"
        if last.exists() and trainer.is_global_zero:
            last.replace(self.folder / "previous.ckpt")
        trainer.save_checkpoint(last)


class StopEarly(BatchCallback, EarlyStopping):
    """Callback that stops a training after `patience` validations without a lower loss, or if the loss is not finite.

    A loss counts as lower if it is lower by at least `min_delta`. Training also stops if the loss is below
    `stopping_threshold`.

    The check runs at the end of a validation, because last.ckpt is written afterwards and must record whether the
    training stops early. When a run is resumed, Lightning restores this decision, but not the trainer's flag to stop,
    which `on_train_start` sets again. Otherwise a run that was killed during its test would continue to train.
    """

    def __init__(
        self, patience: int, min_delta: float = 0.0, stopping_threshold: float | None = None
    ) -> None:
        super().__init__(
            "validation/loss",
            min_delta=min_delta,
            patience=patience,
            stopping_threshold=stopping_threshold,
            check_finite=True,
            check_on_train_epoch_end=False,
        )

    @property
    def stopped(self) -> bool:
        """True if training shall stop early; the trainer still trains until its `min_epochs` and `min_steps`."""
        return self.stopping_reason is not EarlyStoppingReason.NOT_STOPPED

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Stop a resumed run whose early stopping was triggered before."""
        trainer.should_stop = trainer.should_stop or self.stopped


class StopIfPruned(BatchCallback):
    """Callback that stops a training at the end of a validation if a search has asked for it by a file.

    Args:
        path: File with which a search asks the run to stop.

    Attributes:
        pruned: Whether the training was stopped.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pruned = False

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Stop the training in all ranks if any rank finds the file `path`, with which a search asks for it."""
        if not trainer.sanity_checking and trainer.state.fn == "fit":
            self.pruned = trainer.strategy.reduce_boolean_decision(self.path.is_file(), all=False)
            trainer.should_stop = trainer.should_stop or self.pruned


class LogMetrics(BatchCallback):
    """Callback that logs training loss and learning rate every `every_steps` steps, and the loss of every validation.

    The last step of an epoch is logged too.

    Args:
        tracker: tracker that receives the numbers.
        every_steps: number of steps between two entries.
    """

    def __init__(self, tracker: Tracker, every_steps: int) -> None:
        self.tracker = tracker
        self.every_steps = every_steps

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log the training loss, the learning rate and the values in `Objective.logged_terms`."""
        due = trainer.global_step % self.every_steps == 0 or trainer.is_last_batch
        if due and self.ends_step(trainer) and trainer.is_global_zero:
            assert isinstance(pl_module, Training)
            rate = trainer.optimizers[0].param_groups[0]["lr"]
            objective_terms = {
                f"train/{name}": float(value)
                for objective in pl_module.objectives
                if isinstance(objective, Objective)
                for name, value in objective.logged_terms.items()
            }
            self.tracker.log_metrics(
                {"train/loss": pl_module.last_loss, "train/learning_rate": rate, **objective_terms},
                trainer.global_step,
                trainer.current_epoch,
            )

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log the validation loss."""
        if not trainer.sanity_checking and trainer.is_global_zero and trainer.state.fn == "fit":
            loss = float(trainer.callback_metrics["validation/loss"])
            self.tracker.log_metrics({"validation/loss": loss}, trainer.global_step, trainer.current_epoch)


class StopAtBatch(BatchCallback):
    """Callback that handles a signal at the end of the current training step: it saves last.ckpt and stops the run.

    A signal during the last batch of an epoch is handled at the end of the epoch.

    Args:
        stopper: handler of the signals.
        keep: callback that saves last.ckpt.
    """

    def __init__(self, stopper: Stopper, keep: KeepCheckpoints) -> None:
        self.stopper = stopper
        self.keep = keep

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Delay signals until the end of a batch from now on."""
        self.stopper.wait = True
        # Replace Lightning's handler, whose broadcast inside a signal handler makes several ranks hang.
        self.stopper.install()

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let signals take effect immediately again."""
        self.stopper.wait = False

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save last.ckpt and stop if a signal was received, except at the last batch of an epoch."""
        if self.ends_step(trainer) and self._signal_received(trainer) and not trainer.is_last_batch:
            self.keep.save_last(trainer)
            self.stopper.stop()

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save last.ckpt and stop if a signal was received."""
        if self._signal_received(trainer):
            self.keep.save_last(trainer)
            self.stopper.stop()

    def _signal_received(self, trainer: pl.Trainer) -> bool:
        """Return whether any rank received a signal; all ranks get the same answer, so that all save and stop."""
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
        """Stop without saving if a signal was received."""
        # No checkpoint is saved here: a run resumed from it would skip the rest of the validation.
        if self._signal_received(trainer):
            self.stopper.stop()
