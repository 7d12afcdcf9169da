"""Time a training step against bare PyTorch loops.

    python -m benchmarks.framework.step_overhead

All loops run the same batches, fused optimiser and gradient clipping, in turn in one process. One bare loop trains this
framework's model, the other the same network and loss written in plain torch. Writes step_overhead.md beside this file.
"""

import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from benchmarks.pages import machine, write_page
from benchmarks.timing import Rounds, require_idle
from framework.configuration.assembly import build_predictor, resolve_all
from framework.configuration.schema import build, resolve
from framework.configuration.settings import OptimizerSettings
from framework.data import Batch, Splits
from framework.datasets.fields import Fields
from framework.model import Predictor
from framework.target import Target
from framework.tracking.signals import Stopper
from framework.tracking.tracker import NoTracker
from framework.training.batches import Batches
from framework.training.module import OPTIMIZERS, KeepCheckpoints, LogMetrics, StopAtBatch, Training

ROUNDS = 7


@dataclass(frozen=True)
class Case:
    """A model, its batches, and the same in plain torch."""

    name: str
    config: dict[str, Any]
    data: "Memory"
    batch: int
    plain: Callable[[], nn.Module]

    @property
    def steps(self) -> int:
        """Steps of an epoch."""
        return len(self.data.fields) // self.batch


class Memory:
    """Training samples in memory."""

    def __init__(self, target: Target, inputs: Tensor, labels: Tensor) -> None:
        self.inputs, self.labels = inputs, labels
        self.target, self.input_shape = target, tuple(inputs.shape[1:])
        self.fields = Fields(input=inputs, target=labels, index=torch.arange(len(inputs)))

    def splits(self) -> Splits:
        return Splits(self.fields, self.fields, self.fields)

    def augment(self, batch: Batch) -> Batch:
        return batch


def crops() -> Memory:
    """Random crops, shaped like the main experiment's."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (64 * 40, 3, 48, 48), dtype=torch.uint8, generator=generator)
    target = Target("angle", ("azimuth", "elevation", "tilt"))
    return Memory(target, images, torch.rand(len(images), 3, generator=generator))


def points() -> Memory:
    """Points of a plane in two classes, shaped like the moons'."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(50 * 400, 2, generator=generator)
    return Memory(Target("class", ("first", "second")), inputs, (inputs[:, 0] > 0).long())


class PlainBiternion(nn.Module):
    """biternion_vgg's network by itself, and torch's own von Mises density of three angles."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = build(
            "encoder",
            resolve("encoder", {"name": "biternion_vgg"}),
            input_shape=(3, 48, 48),
            input_columns=(),
        )
        self.last = nn.Linear(self.encoder.output_shape[0], 9)

    def forward(self, images: Tensor, target: Tensor) -> Tensor:
        cosine, sine, spread = self.last(self.encoder(images)).chunk(3, -1)
        concentration = nn.functional.softplus(spread) + 1e-3
        density = torch.distributions.VonMises(torch.atan2(sine, cosine), concentration, validate_args=False)
        return -density.log_prob(target).sum(-1).mean()


class PlainMoons(nn.Module):
    """`moons/vanilla_128` in plain torch."""

    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Sequential(
            nn.Linear(2, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 1)
        )

    def forward(self, inputs: Tensor, target: Tensor) -> Tensor:
        return nn.functional.binary_cross_entropy_with_logits(
            self.network(inputs).squeeze(-1), target.to(inputs.dtype)
        )


def bare(model: nn.Module, loss: Callable[[Tensor], Tensor], case: Case) -> float:
    """Milliseconds a step of the plainest loop; `loss` gets the rows of a batch."""
    optimizer = OPTIMIZERS["adamw"](model.train().parameters(), lr=1e-3)
    order = torch.randperm(len(case.data.fields)).split(case.batch)
    start = time.perf_counter()
    for rows in order:
        optimizer.zero_grad()
        loss(rows).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return 1e3 * (time.perf_counter() - start) / len(order)


def plain(case: Case) -> float:
    """Milliseconds a step of the plainest loop around plain torch."""
    model, inputs, target = case.plain(), case.data.inputs, case.data.labels
    return bare(model, lambda rows: model(inputs[rows], target[rows]), case)


def with_predictor(case: Case) -> float:
    """Milliseconds a step of the plainest loop around this framework's model."""
    model, inputs, target = predictor_of(case), case.data.inputs, case.data.labels
    return bare(model, lambda rows: model.loss(inputs[rows], target[rows]).mean(), case)


def predictor_of(case: Case) -> Predictor:
    return build_predictor(resolve_all(case.config), case.data.target, case.data.input_shape, seed=0)


class Clock(pl.Callback):
    """Wall time from the first batch's fetch to the last one's end."""

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.start = time.perf_counter()

    def on_train_batch_end(self, *arguments: object, **more: object) -> None:
        self.end = time.perf_counter()


def ours(case: Case) -> float:
    """Milliseconds a step of the framework's training, journal and callbacks included."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        predictor = predictor_of(case)
        training = Training(predictor, [], case.data, OptimizerSettings(name="adamw"), 0, {})  # type: ignore[arg-type]
        batches = Batches(case.data, batch_size=case.batch, workers=0, seed=0)  # type: ignore[arg-type]
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
            callbacks=[LogMetrics(tracker, 10), StopAtBatch(Stopper(), keep), clock],
        )
        batches.attach(trainer)
        trainer.fit(training, datamodule=batches)
        tracker.close("FINISHED")
    return 1e3 * (clock.end - clock.start) / case.steps


def config(data: str, encoder: str, head: str, **more: Any) -> dict[str, Any]:
    return {
        "data": data,  # says what the target is; the batches come from memory
        "encoder": {encoder: {"name": encoder, **more}},
        "density_head": head,
        "metric": {},
    }


def main() -> None:
    torch.set_num_threads(1)
    require_idle()
    warnings.filterwarnings("ignore")
    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    cases = [
        Case(
            "biternion_vgg + von_mises, 3 × 48 × 48, batch 64",
            config("pascal3d", "biternion_vgg", "von_mises"), crops(), 64, PlainBiternion,
        ),
        Case(
            "mlp of 2 × 128 + bernoulli (`moons/vanilla_128`), batch 50",
            config("moons", "mlp", "bernoulli", widths=[128, 128]), points(), 50, PlainMoons,
        ),
    ]  # fmt: skip
    loops = {"plain torch": plain, "bare loop, this model": with_predictor, "framework": ours}
    rows = []
    for case in cases:
        turns = [[loop(case) for loop in loops.values()] for _ in range(ROUNDS + 1)][1:]  # the first warms up
        found = {
            name: Rounds(tuple(column)) for name, column in zip(loops, zip(*turns, strict=True), strict=True)
        }
        times = [one.text() for one in found.values()]
        ratios = [found[name].times_faster(found["framework"], 3) for name in list(loops)[:2]]
        rows.append(f"| {' | '.join([case.name, *times, *ratios])} |")
    text = "\n".join(
        [
            "# Training step: framework over bare PyTorch loops",
            "",
            f"Wall time, one thread, all loops in turn in one process: median of {ROUNDS} rounds (least to largest). "
            "All have the same batches, AdamW (fused) and gradient clipping. A ratio is that of the framework's time "
            "to the loop's: 1 means that the framework costs nothing.",
            "",
            f"| model | {', ms a step | '.join(loops)}, ms a step | over plain torch | over the bare loop |",
            "|---|---:|---:|---:|---:|---:|",
            *rows,
            "",
            f"{machine('torch', 'pytorch-lightning')} Command: `python -m benchmarks.framework.step_overhead`.",
            "",
        ]
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
