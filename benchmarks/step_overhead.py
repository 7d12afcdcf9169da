"""What a training step costs above a bare PyTorch loop on the same model: python benchmarks/step_overhead.py

Both loops run the same model, batches, fused optimiser and gradient clipping, alternating in one process; the ratio of
their medians is the figure. Writes step_overhead.md beside this file.
"""

import logging
import statistics
import sys
import tempfile
import time
import warnings
from pathlib import Path

import pytorch_lightning as pl
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks.machine import machine
from framework.configuration.assembly import build_predictor, resolve_all
from framework.configuration.settings import OptimizerSettings
from framework.data import Batch, Splits
from framework.datasets.fields import Fields
from framework.target import Target
from framework.tracking.signals import Stopper
from framework.tracking.tracker import NoTracker
from framework.training.batches import Batches
from framework.training.module import OPTIMIZERS, KeepCheckpoints, Report, StopAtBatch, Training

BATCH, STEPS, ROUNDS = 64, 40, 7
CONFIG = {
    "data": "pascal3d",
    "encoder": {"biternion_vgg": {"name": "biternion_vgg"}},
    "density_head": "von_mises",
    "metric": {},
}


class Crops:
    """Random crops in memory, shaped like the default experiment's."""

    target = Target("angle", ("azimuth", "elevation", "tilt"))
    input_shape = (3, 48, 48)

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        count = BATCH * STEPS
        self.fields = Fields(
            input=torch.randint(0, 256, (count, 3, 48, 48), dtype=torch.uint8, generator=generator),
            target=torch.rand(count, 3, generator=generator),
            index=torch.arange(count),
        )

    def splits(self) -> Splits:
        return Splits(self.fields, self.fields, self.fields)

    def augment(self, batch: Batch) -> Batch:
        return batch


def bare(data: Crops) -> float:
    """Milliseconds a step of the plainest loop."""
    predictor = build_predictor(resolve_all(CONFIG), data.target, data.input_shape, seed=0).train()
    optimizer = OPTIMIZERS["adamw"](predictor.parameters(), lr=1e-3)
    order = torch.randperm(len(data.fields)).split(BATCH)
    start = time.perf_counter()
    for rows in order:
        batch = data.fields.__getitems__(rows.tolist())
        optimizer.zero_grad()
        loss = predictor.loss(batch["input"], batch["target"]).mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(predictor.parameters(), 1.0)
        optimizer.step()
    return 1e3 * (time.perf_counter() - start) / len(order)


class Clock(pl.Callback):
    """Wall time from the first batch's fetch to the last one's end."""

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.start = time.perf_counter()

    def on_train_batch_end(self, *arguments: object, **more: object) -> None:
        self.end = time.perf_counter()


def ours(data: Crops, folder: Path) -> float:
    """Milliseconds a step of the framework's training, journal and callbacks included."""
    predictor = build_predictor(resolve_all(CONFIG), data.target, data.input_shape, seed=0)
    training = Training(predictor, [], data, OptimizerSettings(name="adamw"), 0, {})  # type: ignore[arg-type]
    batches = Batches(data, batch_size=BATCH, workers=0, seed=0)  # type: ignore[arg-type]
    tracker = NoTracker(folder)
    tracker.open()
    keep = KeepCheckpoints(folder, None)
    clock = Clock()
    trainer = pl.Trainer(
        max_epochs=1,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
        gradient_clip_val=1.0,
        use_distributed_sampler=False,
        callbacks=[Report(tracker, 10), StopAtBatch(Stopper(), keep), clock],
    )
    batches.attach(trainer)
    trainer.fit(training, datamodule=batches)
    tracker.close("FINISHED")
    return 1e3 * (clock.end - clock.start) / STEPS


def main() -> None:
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    data = Crops()
    pairs = []
    for _ in range(ROUNDS + 1):
        with tempfile.TemporaryDirectory() as folder:
            pairs.append((bare(data), ours(data, Path(folder))))
    bares, framed = zip(*pairs[1:], strict=True)  # the first round warms up
    ratio = statistics.median(framed) / statistics.median(bares)
    text = (
        "# Training step: framework over bare PyTorch loop\n\n"
        f"`python benchmarks/step_overhead.py`: biternion_vgg + von_mises, batch {BATCH}, 3×48×48, one thread, "
        f"{STEPS} steps, median of {ROUNDS} alternating rounds.\n\n"
        "| loop | ms / step |\n|---|---|\n"
        f"| bare | {statistics.median(bares):.2f} |\n| framework | {statistics.median(framed):.2f} |\n\n"
        f"Ratio **{ratio:.3f}** (rounds: {', '.join(f'{b / a:.3f}' for a, b in pairs[1:])}).\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    Path(__file__).with_suffix(".md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
