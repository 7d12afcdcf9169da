"""mode=train: fit, calibrate, test, report."""

import ctypes
import inspect
import logging
import platform
import time
import warnings
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import EarlyStopping, RichProgressBar
from rich.console import Console

from framework.configuration.assembly import (
    Resolved,
    build_data,
    build_metrics,
    build_objectives,
    build_outliers,
    build_predictor,
    citations,
    resolve_all,
)
from framework.configuration.settings import TRAINER_OURS, Settings, check_trainer_keys
from framework.data import Data
from framework.errors import ConfigError
from framework.evaluation.splits import on_device
from framework.model import Preceded, Predictor
from framework.reports.report import report_test, report_training
from framework.runs.job import leave_value
from framework.runs.loading import PREFIX, description, fill, weights
from framework.runs.run import Run, opened
from framework.training.batches import Batches, seed_step
from framework.training.cached_features import Encoded, fits
from framework.training.checkpoint import WholeCheckpoints, latest_good, read
from framework.training.fitting import fit_at_once, fitted_models, mean_loss
from framework.training.module import KeepCheckpoints, Report, StopAtBatch, Training

TRAINED = {"last.ckpt", "previous.ckpt", "best.ckpt"}
"""Checkpoints that training can go on from; model.ckpt holds weights alone."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def run(values: dict[str, Any], settings: Settings, folder: Path, overrides: list[str]) -> float:
    """Returns the validation loss of the kept weights, nats: what a sweeper minimises."""
    with opened(folder, values, settings, overrides) as run:
        loss = _run(run)
    leave_value(folder, loss)
    return loss


def _run(run: Run) -> float:
    console = Console()
    settings = run.settings
    if settings.threads:
        torch.set_num_threads(settings.threads)
    quiet()
    keep_memory()
    check_trainer_keys(settings.trainer, set(inspect.signature(pl.Trainer.__init__).parameters) - {"self"})
    resolved = resolve_all(run.values)
    console.print(f"run folder: {run.folder}")
    data = build_data(resolved)
    data.prepare()
    describe_data(run, data)
    outliers = build_outliers(resolved, data)  # before training: a wrong root is said now
    if outliers is not None:
        describe_data(run, outliers, "outliers")
    record_citations(run, citations(resolved))

    predictor = build_predictor(resolved, data.target, data.input_shape, settings.seed, columns=data.columns)
    described = description(resolved, data)
    batches = _batches(run, data)
    if fitted_models(predictor):
        device = torch.device("cpu")
        loss = _fit_at_once(run, predictor, resolved, data, console)
    else:
        device, loss = _train(run, predictor, resolved, data, described, console)
    predictor.eval().to(device)
    seed_step(settings.seed, 0, "calibrate")
    predictor.calibrate(on_device(batches.val_dataloader(), device))
    save_model(run.checkpoints / "model.ckpt", predictor, described)
    run.tracker.log_artifact(run.checkpoints / "model.ckpt", "checkpoints")
    metrics = build_metrics(resolved, data.target)
    report_test(run, predictor, resolved, data, batches, metrics, device, console, outliers)
    return loss


def _batches(run: Run, data: Data) -> Batches:
    settings = run.settings
    return Batches(data, batch_size=settings.batch_size, workers=settings.workers, seed=settings.seed)


def _train(
    run: Run,
    predictor: Predictor,
    resolved: Resolved,
    data: Data,
    described: dict[str, Any],
    console: Console,
) -> tuple[torch.device, float]:
    """By gradient; leaves the kept weights in the predictor. Gives the device, and their validation loss."""
    settings = run.settings
    objectives = build_objectives(resolved)
    fed = data if objectives else _encoded(run, predictor, data, console)  # those may change or add inputs
    training = Training(
        predictor, objectives, fed, settings.optimizer, settings.seed, described, encoded=fed is not data
    )
    keep = KeepCheckpoints(
        run.checkpoints,
        settings.trainer.get("checkpoint_every_steps"),
        settings.trainer.get("keep") or "best",
    )
    trainer = _trainer(run, keep)
    _fit(run, training, _batches(run, fed), trainer, console)
    fill(predictor, weights(read(keep.kept)), str(keep.kept))
    report_training(run, kept_epoch=keep.kept_epoch, synthetic=data.synthetic)
    return trainer.strategy.root_device, keep.kept_loss


def _fit_at_once(run: Run, predictor: Predictor, resolved: Resolved, data: Data, console: Console) -> float:
    """Of heads that learn from the whole training split; the validation loss, nats."""
    if resolved["objective"]:
        raise ConfigError(
            f"density_head={resolved['density_head']['name']} is fitted at once and has no gradient, which objectives "
            "work by. Leave objective out."
        )
    fed = _encoded(run, predictor, data, console)
    inner = predictor.predictor if fed is not data and isinstance(predictor, Preceded) else predictor
    batches = _batches(run, fed)
    start = time.perf_counter()
    fit_at_once(inner, batches, run.settings.seed)
    loss = mean_loss(inner.eval(), batches.val_dataloader())
    console.print(f"fitted in {time.perf_counter() - start:.1f} s; validation loss {loss:.4f} nats")
    run.tracker.log_metrics({"validation/loss": loss}, 0, 0)
    return loss


def _encoded(run: Run, predictor: Predictor, data: Data, console: Console) -> Data:
    """The data with features computed before training, where that gives what computing them in each step would."""
    if not isinstance(predictor, Preceded) or data.varies or not fits(data, predictor.features):
        return data
    encoded = Encoded(data, predictor.features, batch_size=64, workers=run.settings.workers)
    start = time.perf_counter()
    count = encoded.compute()
    seconds = time.perf_counter() - start
    console.print(
        f"features of {count} samples computed once in {seconds:.1f} s ({1e3 * seconds / max(1, count):.2g} ms each)"
    )
    return encoded


def _fit(run: Run, training: Training, batches: Batches, trainer: pl.Trainer, console: Console) -> None:
    resume = latest_good(run.checkpoints, names=TRAINED) if run.resumed else None
    if run.resumed and resume is None:
        run.tracker.drop_after(0)
        console.print("nothing to resume from yet: starting from the beginning.")
    if resume is not None:
        step = int(read(resume)["global_step"])
        run.tracker.drop_after(step)
        console.print(f"resuming from {resume} (step {step}).")
    batches.attach(trainer)
    trainer.fit(training, datamodule=batches, ckpt_path=resume, weights_only=True)


def _trainer(run: Run, keep: KeepCheckpoints) -> pl.Trainer:
    chosen = dict(run.settings.trainer)
    patience = chosen.get("patience")
    callbacks: list[pl.Callback] = [
        Report(run.tracker, chosen.get("log_every_steps") or 10),
        keep,
        StopAtBatch(run.stopper, keep),
    ]
    if patience:
        callbacks.append(EarlyStopping("validation/loss", patience=patience, check_finite=True))
    terminal = Console(stderr=True).is_terminal
    if terminal:
        callbacks.append(RichProgressBar())
    arguments = {key: value for key, value in chosen.items() if key not in TRAINER_OURS}
    defaults = {"enable_progress_bar": terminal, "enable_model_summary": False, "num_sanity_val_steps": 0}
    return pl.Trainer(
        **{**defaults, **arguments},
        logger=False,
        enable_checkpointing=False,
        callbacks=callbacks,
        plugins=[WholeCheckpoints()],
        use_distributed_sampler=False,
        default_root_dir=run.folder,
    )


def keep_memory() -> None:
    """Let glibc keep freed memory: a training step frees and asks for the same megabytes again and again.

    Without it each step pays for thousands of page faults, a quarter of a small network's time. Elsewhere than on
    glibc nothing happens.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        library.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def quiet() -> None:
    """Lightning's notices about hardware it did not find, and a deprecation inside it, tell our user nothing."""
    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=".*LeafSpec", module="pytorch_lightning")
    warnings.filterwarnings("ignore", message=".*does not have many workers", module="pytorch_lightning")
    # ours is resumable, by another way than the one Lightning looks for
    warnings.filterwarnings(
        "ignore", message=".*your dataloader is not resumable", module="pytorch_lightning"
    )


def describe_data(run: Run, data: Data, role: str = "data") -> None:
    """Tag the run with what it was fed."""
    run.tracker.set_tags(
        {f"{role}.{key}": value for key, value in data.fingerprint().items()}
        | {f"{role}.synthetic": str(data.synthetic).lower(), f"{role}.skipped": str(data.skipped)}
    )


def record_citations(run: Run, found: dict[str, str]) -> None:
    """Write what to cite into the run folder and the store."""
    path = run.folder / "citations.bib"
    path.write_text("\n\n".join(dict.fromkeys(found.values())) + "\n", encoding="utf-8")
    run.tracker.log_artifact(path)


def save_model(path: Path, predictor: Predictor, described: dict[str, Any]) -> None:
    """A checkpoint of weights and description alone, for `framework.load`."""
    state = {f"{PREFIX}{key}": value.cpu() for key, value in predictor.state_dict().items()}
    WholeCheckpoints().save_checkpoint({"framework": described, "state_dict": state}, path)
