"""Compare the run time of a training step of the framework with that of plain PyTorch loops.

    python -m benchmarks.framework.step_overhead

All loops use the same batches, fused optimiser and gradient clipping. They run one after the other in one process. One
plain loop trains this framework's model, the other trains the same network and loss written in plain PyTorch. The
script writes step_overhead.md beside this file.
"""

import logging
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

from benchmarks.pages import machine, publish
from benchmarks.timing import Rounds, require_idle
from framework.configuration.assembly import assemble, build_predictor
from framework.configuration.schema import build, resolve
from framework.configuration.settings import OptimizerSettings, Settings
from framework.data import Batch, Splits
from framework.datasets.fields import Fields
from framework.model import Predictor
from framework.target import Target
from framework.tracking.signals import Stopper
from framework.tracking.tracker import NoTracker
from framework.training.batches import Batches
from framework.training.module import (
    OPTIMIZERS,
    KeepCheckpoints,
    LoadedBatches,
    LogMetrics,
    StopAtBatch,
    Training,
)

ROUNDS = 7


@dataclass(frozen=True)
class Case:
    """A model, its training data, and the same network and loss in plain PyTorch."""

    name: str
    config: dict[str, Any]
    data: "InMemoryData"
    batch: int
    plain: Callable[[], nn.Module]

    @property
    def steps(self) -> int:
        """Number of steps in an epoch."""
        return len(self.data.fields) // self.batch


class InMemoryData:
    """Training samples in memory."""

    def __init__(self, target: Target, inputs: Tensor, labels: Tensor) -> None:
        self.inputs, self.labels = inputs, labels
        self.target, self.input_shape = target, tuple(inputs.shape[1:])
        self.fields = Fields(input=inputs, target=labels, index=torch.arange(len(inputs)))

    def splits(self) -> Splits:
        return Splits(self.fields, self.fields, self.fields)

    def augment(self, batch: Batch) -> Batch:
        return batch


def crops() -> InMemoryData:
    """Return random images of the same shape as in the main experiment, with three random angles each."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (64 * 40, 3, 48, 48), dtype=torch.uint8, generator=generator)
    target = Target("angle", ("azimuth", "elevation", "tilt"))
    return InMemoryData(target, images, torch.rand(len(images), 3, generator=generator))


def points() -> InMemoryData:
    """Return random points of the plane in two classes, of the same shape as the data set moons."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(50 * 400, 2, generator=generator)
    return InMemoryData(Target("class", ("first", "second")), inputs, (inputs[:, 0] > 0).long())


class PlainBiternion(nn.Module):
    """The network of biternion_vgg with PyTorch's own von Mises density of three angles."""

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
    """The model of `moons/vanilla_128` in plain PyTorch."""

    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Sequential(
            nn.Linear(2, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 1)
        )

    def forward(self, inputs: Tensor, target: Tensor) -> Tensor:
        return nn.functional.binary_cross_entropy_with_logits(
            self.network(inputs).squeeze(-1), target.to(inputs.dtype)
        )


def time_plain_loop(model: nn.Module, loss: Callable[[Tensor], Tensor], case: Case) -> float:
    """Return the milliseconds a step of a plain PyTorch loop.

    Args:
        model: Model that is trained.
        loss: Function that returns the loss of a batch from the indices of its samples.
        case: Training data and batch size.
    """
    optimizer = OPTIMIZERS["adamw"](model.train().parameters(), lr=1e-3)
    order = torch.randperm(len(case.data.fields)).split(case.batch)
    start = time.perf_counter()
    for rows in order:
        optimizer.zero_grad()
        loss(rows).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return 1e3 * (time.perf_counter() - start) / len(order)


def time_plain_model(case: Case) -> float:
    """Return the milliseconds a step of a plain loop that trains the model in plain PyTorch."""
    model, inputs, target = case.plain(), case.data.inputs, case.data.labels
    return time_plain_loop(model, lambda rows: model(inputs[rows], target[rows]), case)


def time_predictor(case: Case) -> float:
    """Return the milliseconds a step of a plain loop that trains this framework's model."""
    model, inputs, target = build_case_predictor(case), case.data.inputs, case.data.labels
    return time_plain_loop(model, lambda rows: model.loss(inputs[rows], target[rows]).mean(), case)


def build_case_predictor(case: Case) -> Predictor:
    return build_predictor(
        assemble(Settings.of(case.config)).parts, case.data.target, case.data.input_shape, seed=0
    )


class Clock(pl.Callback):
    """Clock that measures the wall time from the start of an epoch to the end of its last batch."""

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.start = time.perf_counter()

    def on_train_batch_end(self, *arguments: object, **more: object) -> None:
        self.end = time.perf_counter()


def time_framework(case: Case) -> float:
    """Return the milliseconds a step of the framework's training, including journal and callbacks."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        predictor = build_case_predictor(case)
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
        trainer.fit(training, datamodule=LoadedBatches(batches, trainer))
        tracker.close("FINISHED")
    return 1e3 * (clock.end - clock.start) / case.steps


def make_config(data: str, encoder: str, head: str, **more: Any) -> dict[str, Any]:
    return {
        "data": data,  # only decides the kind of target; the batches come from memory
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
            make_config("pascal3d", "biternion_vgg", "von_mises"), crops(), 64, PlainBiternion,
        ),
        Case(
            "mlp of 2 × 128 + bernoulli (`moons/vanilla_128`), batch 50",
            make_config("moons", "mlp", "bernoulli", widths=[128, 128]), points(), 50, PlainMoons,
        ),
    ]  # fmt: skip
    loops = {
        "plain loop, plain model": time_plain_model,
        "plain loop, framework's model": time_predictor,
        "framework": time_framework,
    }
    rows = []
    for case in cases:
        rounds_of_loops = [[loop(case) for loop in loops.values()] for _ in range(ROUNDS + 1)][
            1:
        ]  # the first round warms up
        times = {
            name: Rounds(tuple(column))
            for name, column in zip(loops, zip(*rounds_of_loops, strict=True), strict=True)
        }
        cells = [rounds.text() for rounds in times.values()]
        ratios = [times[name].times_faster(times["framework"], 3) for name in list(loops)[:2]]
        rows.append(f"| {' | '.join([case.name, *cells, *ratios])} |")
    text = "\n".join(
        [
            "# Training step: run time of the framework and of plain PyTorch loops",
            "",
            "This page compares the time of a training step in this framework with the time of a step in a plain "
            "PyTorch loop. The difference is what the framework itself costs.",
            "",
            "Three loops train each model on generated data. `plain loop, plain model` is a PyTorch loop with a "
            "network and a loss that are written in plain PyTorch. `plain loop, framework's model` is the same loop "
            "with the same network as a model of this framework. `framework` is the training of this framework, "
            "including its journal and callbacks. All loops use the same batches, the fused AdamW optimiser and "
            "gradient clipping.",
            "",
            f"Each time is the median of {ROUNDS} rounds (least to largest) of wall time on one thread. The loops "
            "alternate in one process. The last two columns hold the framework's time divided by the time of a plain "
            "loop. A ratio of 1 means that the framework costs no time.",
            "",
            f"| model | {', ms a step | '.join(loops)}, ms a step | ratio to plain loop, plain model | ratio to plain "
            "loop, framework's model |",
            "|---|---:|---:|---:|---:|---:|",
            *rows,
            "",
            f"{machine('torch', 'pytorch-lightning')} Command: `python -m benchmarks.framework.step_overhead`.",
            "",
        ]
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
