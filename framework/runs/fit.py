"""Fitting of the session's predictor: by gradient with Lightning, or in one step if its head has no gradient."""

import sys
import time
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import pytorch_lightning as pl
import torch
from pytorch_lightning.profilers import AdvancedProfiler, PyTorchProfiler, SimpleProfiler
from rich.console import Console
from torch import distributed as dist
from torch import nn

from framework.configuration.loading import fill, predictor_weights
from framework.configuration.settings import TRAINER_OURS, CallbackSettings, Settings, device_of
from framework.data import Batch, Data
from framework.encoder import ChecksTraining, FitsInputs
from framework.errors import ConfigError, count_of, significant
from framework.model import FrozenFrontEnd, Model, fitted_models, learns
from framework.runs.job import PRUNED, RECORD
from framework.runs.resuming import begin_again, blame_checkpoint, resume_arguments
from framework.runs.run import PROFILE, RANGE_TEST, Run
from framework.runs.session import Session, trained_batches
from framework.storage.checkpoints import read
from framework.storage.first_rank import first_rank
from framework.storage.processor import fast_bfloat16
from framework.storage.progress import PlainConsole
from framework.tracking.signals import Stopped
from framework.training.cached_features import CachedFeatures, fits
from framework.training.callbacks import build_callbacks
from framework.training.checkpoint import WholeCheckpoints
from framework.training.fitting import fit_at_once, mean_loss
from framework.training.module import (
    FollowTraining,
    KeepCheckpoints,
    LoadedBatches,
    LogMetrics,
    NoProfiler,
    StopAtBatch,
    StopEarly,
    StopIfPruned,
    Training,
)
from framework.training.progress import Progress
from framework.training.range_test import RangeTestResult, measure_losses, range_test_figure, suggest
from framework.training.rank_processes import end_together
from framework.uncertainty import SelfTraining, outermost, self_training

FEW_STEPS = 200
"""Number of steps below which a training on a user's data ends with a note.

The recommended start for images has 20 epochs, which are only 20 steps if all images fit into one batch.
"""
PROFILERS = {"simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler}
"""Profilers of Lightning whose report the run folder receives, by the value of `trainer.profiler`."""


class Fitted(NamedTuple):
    """Result of a fit.

    Attributes:
        loss: Validation loss of the fitted weights, nats.
        epoch: Epoch of these weights, from 0; None if Lightning does not train the predictor: its head is fitted in one
            step, a wrapper trains its models itself, or it has nothing to learn (a renderer, for example).
        pruned: Whether a search has ended the training.
    """

    loss: float
    epoch: int | None
    pruned: bool = False


def fit(session: Session, run: Run) -> Fitted:
    """Fit the session's predictor, and return the validation loss and the epoch of the fitted weights.

    Only the first rank loads the fitted weights into the predictor; the other ranks return after training without
    loading them.
    """
    if session.settings.checkpoint is None:  # weights of another training belong to its own fitted encoders
        _fit_encoders(session)
    wrapper = self_training(session.predictor)
    if wrapper is not None:
        return Fitted(_train_itself(session, run, wrapper), None)
    if not learns(session.predictor):
        return Fitted(_fit_at_once(session, run), None)
    return _fit_by_gradient(session, run)


@torch.no_grad()
def _fit_encoders(session: Session) -> None:
    """Fit encoders of class `FitsInputs` to the training split, and let those of class `ChecksTraining` check it.

    Each encoder reads the features of those before it.

    Raises:
        ConfigError: such an encoder follows an encoder that is trained.
    """
    front = list(session.predictor.encoders) if isinstance(session.predictor, FrozenFrontEnd) else []
    # the first encoder of a model is trained, but no trained encoder precedes it
    firsts = [
        encoder
        for model in session.predictor.modules()
        if isinstance(model, Model)
        for encoder in list(model.encoders)[:1]
    ]
    for module in session.predictor.modules():
        if _reads_inputs(module) and not any(module is encoder for encoder in (*front, *firsts)):
            raise ConfigError(
                f"{type(module).__name__} reads the inputs before training, but an encoder that is trained precedes "
                "it. Put it first in encoder=[...]."
            )
    places = [(encoder, front[:number]) for number, encoder in enumerate(front)]
    for encoder, before in [*places, *((encoder, front) for encoder in firsts)]:
        if isinstance(encoder, FitsInputs) and encoder.needs_fit:
            encoder.fit_inputs(batch["input"] for batch in _training_batches(session, before))
        if isinstance(encoder, ChecksTraining):
            encoder.check_training(_training_batches(session, before))


def _reads_inputs(module: nn.Module) -> bool:
    """Return whether a module is an encoder that reads the inputs of the training split before training."""
    return isinstance(module, ChecksTraining) or (isinstance(module, FitsInputs) and module.needs_fit)


def _training_batches(session: Session, encoders: Iterable[nn.Module]) -> Iterator[Batch]:
    """Yield the batches of the training split, with the features of a chain of encoders in place of the inputs."""
    for batch in session.batches().of(session.data.splits().train):
        features = batch["input"]
        for encoder in encoders:
            features = encoder(features)
        yield {**batch, "input": features}


def _fit_at_once(session: Session, run: Run) -> float:
    fed = _cache_features(session) if fitted_models(session.predictor) else session.data
    inner = session.predictor
    if fed is not session.data and isinstance(inner, FrozenFrontEnd):
        inner = inner.predictor
    batches = session.batches(fed)
    start = time.perf_counter()
    fit_at_once(inner, batches, session.settings.seed)
    loss = mean_loss(inner.eval(), batches.val_dataloader())
    session.console.print(f"fitted in {time.perf_counter() - start:.1f} s; validation loss {loss:.4f} nats")
    _log_only_loss(run, loss)
    return loss


def _train_itself(session: Session, run: Run, wrapper: SelfTraining) -> float:
    """Let a wrapper train its models on the training and the validation split, and return the loss, nats.

    The loss of a sample is computed by models that were not trained on this sample.
    """
    fed = _cache_features(session)
    front = session.predictor if isinstance(session.predictor, FrozenFrontEnd) else None
    start = time.perf_counter()
    with torch.no_grad():
        loaded = list(trained_batches(session.batches(fed)))
        if front is not None and fed is session.data:
            loaded = [{**batch, "input": front.features(batch["input"])} for batch in loaded]
    inputs, target = (torch.cat([batch[name] for batch in loaded]) for name in ("input", "target"))
    settings = session.settings
    batches = settings.trainer.get("limit_train_batches")  # set by `debug=fast`, for example
    most_steps = batches * settings.trainer.get("max_epochs", 1) if isinstance(batches, int) else None
    loss = wrapper.train_models(
        inputs, target, seed=settings.seed, batch_size=settings.batch_size, most_steps=most_steps
    )
    session.console.print(
        f"trained on {len(inputs)} samples of training and validation in {time.perf_counter() - start:.1f} s; loss of "
        f"samples that a model did not see {loss:.4f} nats"
    )
    _log_only_loss(run, loss)
    return loss


def _log_only_loss(run: Run, loss: float) -> None:
    """Log the only validation loss of a model that Lightning does not train."""
    if run.resumed:
        run.tracker.drop_after(-1)  # a killed run may have logged its loss, which has step 0
    run.tracker.log_metrics({"validation/loss": loss}, 0, 0)


def _fit_by_gradient(session: Session, run: Run) -> Fitted:
    settings = session.settings
    fed = (
        session.data if session.objectives else _cache_features(session)
    )  # objectives may change or add inputs
    optimizer = settings.optimizer
    if optimizer.learning_rate == "auto":
        optimizer = optimizer.model_copy(update={"learning_rate": _find_learning_rate(session, run, fed)})
    training = Training(
        session.predictor,
        session.objectives,
        fed,
        optimizer,
        settings.seed,
        session.description(),
        cached=fed is not session.data,
    )
    keep = KeepCheckpoints(
        run.checkpoints,
        settings.trainer.get("checkpoint_every_steps"),
        settings.trainer.get("keep") or "best",
    )
    trainer = _trainer(run, keep, session.console)
    batches = session.batches(fed)
    several = outermost(session.predictor)
    batches.orders = several.model_count if several else 1
    loaded = LoadedBatches(batches, trainer)
    resume = begin_again(run, session.console, trainer.world_size, batches.orders)
    with blame_checkpoint(resume, training), end_together(trainer, run.stopper, partial(_give_up, run)):
        trainer.fit(training, datamodule=loaded, ckpt_path=resume, weights_only=True)
        _leave_process_group()
    early = any(isinstance(callback, StopEarly) and callback.stopped for callback in trainer.callbacks)  # type: ignore[attr-defined]
    ended, kept_epoch = trainer.current_epoch, keep.kept_epoch + 1
    reason = ", which have the lowest validation loss" if keep.keep == "best" and kept_epoch != ended else ""
    session.console.print(
        f"{'stopped early at' if early else 'ended at'} epoch {ended}; kept the weights of epoch {kept_epoch}{reason}",
        soft_wrap=True,
        highlight=False,
    )
    is_shortened = {"limit_train_batches", "max_steps", "max_time"} & settings.trainer.keys()
    if not (early or is_shortened or session.data.synthetic):
        session.console.print(few_steps(trainer.global_step, trainer.current_epoch), end="", soft_wrap=True)
    if first_rank():
        fill(session.predictor, predictor_weights(read(keep.kept_path)), str(keep.kept_path))
    session.device = trainer.strategy.root_device
    pruned = any(isinstance(callback, StopIfPruned) and callback.pruned for callback in trainer.callbacks)  # type: ignore[attr-defined]
    return Fitted(keep.kept_loss, keep.kept_epoch, pruned)


def few_steps(steps: int, epochs: int) -> str:
    """Return a line that says that a training took few steps; "" if it did not.

    Args:
        steps: number of steps of the optimizer.
        epochs: number of epochs.
    """
    if steps >= FEW_STEPS:
        return ""
    return (
        f"note: {steps} steps in {epochs} epochs are few for a network. If the loss still falls, raise "
        "trainer.max_epochs or lower batch_size.\n"
    )


def _find_learning_rate(session: Session, run: Run, fed: Data) -> float:
    """Find the learning rate by a range test, print the reason, record it and draw a figure.

    A resumed run keeps the rate that it has recorded.

    Args:
        session: session of the training.
        run: run in progress.
        fed: data with which the model is trained: the session's data, or precomputed features of these data.
    """
    path = run.folder / RANGE_TEST
    if run.resumed and path.is_file():
        result = RangeTestResult.read(path)
        session.console.print(
            f"learning rate: {result.learning_rate:.2g}, found when this run began",
            soft_wrap=True,
            highlight=False,
        )
        return result.learning_rate
    settings = session.settings
    several = outermost(session.predictor)
    batches = session.batches(fed)
    batches.orders = several.model_count if several else 1
    rates, losses = measure_losses(
        session.predictor,
        session.objectives,
        fed,
        batches,
        settings.optimizer,
        _with_precision(settings.trainer),
        run.stopper,
        cached=fed is not session.data,
    )
    result = suggest(rates, losses)
    session.console.print(result.sentence(), soft_wrap=True, highlight=False)
    if first_rank():
        result.save(path)
        run.tracker.log_artifact(path)
    run.tracker.set_tags(
        {"learning_rate": f"{result.learning_rate:.4g}", "learning_rate.reason": result.sentence()}
    )
    run.tracker.log_metrics({"learning_rate": result.learning_rate}, 0, 0)
    if settings.pictures and first_rank():
        from framework.figures.style import save_figure

        folder = run.folder / "figures"
        folder.mkdir(exist_ok=True)
        title = f"{session.title}: learning rate"
        figure = range_test_figure(result, title, synthetic=session.data.synthetic)
        run.tracker.log_artifact(save_figure(figure, folder / "learning_rate", settings.pictures), "figures")
    return result.learning_rate


def _give_up(run: Run, error: BaseException) -> None:
    """Record the error and close the run; the caller ends the process afterwards, because training cannot continue."""
    stopped = isinstance(error, Stopped)
    sentence = f"stopped by {error.signal}" if isinstance(error, Stopped) else str(error)
    sys.stderr.write(f"{sentence.rstrip('.')}; continue with: python -m framework {resume_arguments(run)}\n")
    run.tracker.set_tags({"error": sentence})
    run.tracker.close("KILLED" if stopped else "FAILED")


def _leave_process_group() -> None:
    """Leave the process group of the ranks, so that rank 0, which works on alone, waits for no other rank."""
    if dist.is_available() and dist.is_initialized():
        dist.barrier()
        dist.destroy_process_group()


def _cache_features(session: Session) -> Data:
    """Return the session's data with precomputed features as inputs; the data unchanged if that is not possible.

    Features can be precomputed if the first encoders have fixed features, the data are not augmented, and the features
    fit into memory.
    """
    predictor, data = session.predictor, session.data
    if not isinstance(predictor, FrozenFrontEnd) or data.varies or not fits(data, predictor.features):
        return data
    cached = CachedFeatures(data, predictor.features, batch_size=64, workers=session.settings.workers)
    start = time.perf_counter()
    count = cached.compute()
    seconds = time.perf_counter() - start
    session.console.print(
        f"features of {count_of(count, 'sample')} computed once in {seconds:.1f} s "
        f"({significant(1e3 * seconds / max(1, count), 2)} ms each)"
    )
    return cached


def _trainer(run: Run, keep: KeepCheckpoints, console: Console) -> pl.Trainer:
    chosen = run.settings.bounded_trainer
    patience = chosen.get("patience")
    named = run.settings.callbacks
    _require_fitting(named, run.settings)
    callbacks: list[pl.Callback] = [
        LogMetrics(run.tracker, chosen.get("log_every_steps") or 10),
        FollowTraining(),
        *build_callbacks(named, keep, console),
        StopAtBatch(run.stopper, keep),
    ]
    if patience:
        callbacks.append(
            StopEarly(patience, **(named.early_stopping.model_dump() if named.early_stopping else {}))
        )
    if (run.folder / RECORD).is_file():  # the run is a job of a sweep, which may be a search that prunes
        callbacks.append(StopIfPruned(run.folder / PRUNED))
    if chosen.get("enable_progress_bar", True):
        terminal = PlainConsole(stderr=True, quiet=console.quiet)
        callbacks.append(Progress(terminal if terminal.is_terminal else console))
    arguments = _with_precision({key: value for key, value in chosen.items() if key not in TRAINER_OURS})
    if chosen.get("precision") == "auto":
        precision = arguments["precision"]
        console.print(f"precision: {precision}, which trainer.precision=auto chooses for this processor")
        run.tracker.set_tags({"precision": precision})
    arguments |= {"enable_progress_bar": False}  # Lightning's own progress bar
    if arguments.get("profiler") in PROFILERS:
        arguments["profiler"] = PROFILERS[arguments["profiler"]](dirpath=run.folder, filename="profile")
        console.print(f"profile: {run.folder / PROFILE}, after the training", soft_wrap=True, highlight=False)
    defaults = {"enable_model_summary": False, "num_sanity_val_steps": 0, "profiler": NoProfiler()}
    return pl.Trainer(
        **{**defaults, **arguments},
        logger=False,
        enable_checkpointing=False,
        callbacks=callbacks,
        plugins=[WholeCheckpoints()],
        use_distributed_sampler=False,
        default_root_dir=run.folder,
    )


def _require_fitting(callbacks: CallbackSettings, settings: Settings) -> None:
    """Refuse callbacks that contradict other settings of the training.

    Raises:
        ConfigError: The message says which setting to change.
    """
    if callbacks.early_stopping is not None and not settings.trainer.get("patience"):
        raise ConfigError(
            "trainer.callbacks=[early_stopping] has no effect with trainer.patience=null, which never stops. Set "
            "trainer.patience to a number of validations, or leave early_stopping out."
        )
    if callbacks.gradient_accumulation is None:
        return
    if (settings.trainer.get("accumulate_grad_batches") or 1) != 1:
        raise ConfigError(
            "trainer.callbacks=[gradient_accumulation] and trainer.accumulate_grad_batches both say how many batches a "
            "step has. Leave one of them out."
        )
    if settings.optimizer.schedule == "step":
        raise ConfigError(
            "optimizer.schedule=step counts epochs of equally many steps, but gradient_accumulation changes the number "
            "of steps of an epoch. Choose another schedule, or leave gradient_accumulation out of trainer.callbacks."
        )


def _with_precision(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of Lightning's Trainer in which the precision "auto" is replaced by that of this machine."""
    if arguments.get("precision") != "auto":
        return arguments
    return {**arguments, "precision": _fast_precision(arguments.get("accelerator"))}


def _fast_precision(accelerator: str | None) -> str:
    """Return the precision that `trainer.precision=auto` means on this machine."""
    on_cpu = accelerator in (None, "auto", "cpu") and device_of(accelerator).type == "cpu"
    return "bf16-mixed" if on_cpu and fast_bfloat16(device_of("cpu")) else "32-true"
