"""Compare the run time of a training step of the framework with that of Lightning alone and of plain PyTorch loops.

    python -m benchmarks.framework.step_overhead

The framework's steps are those of its command, and their times are read from the journal of the run. The other loops
use the same numbers of samples, the same batch size, fused optimiser and gradient clipping. The script writes
step_overhead.md beside this file.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import LightningModule, Trainer
from torch import Tensor, nn

from benchmarks.commands import ROOT
from benchmarks.pages import machine, publish
from benchmarks.timing import Rounds, require_idle
from framework.configuration.assembly import assemble, build_predictor
from framework.configuration.schema import build, resolve
from framework.configuration.settings import Settings
from framework.model import Predictor
from framework.target import Target
from framework.training.module import OPTIMIZERS

ROUNDS = 5
QUIET = ("threads=1", "logger=none", "pictures=false")
"""Settings of the command in every case: one thread, and nothing beside the training that could disturb its times."""


@dataclass(frozen=True)
class Case:
    """A training of the framework, and the same network, loss and numbers of samples for the plain loops.

    Attributes:
        name: Name in the table.
        command: Settings of the command.
        parts: Data set, encoder and density head of the predictor in the second plain loop.
        target: Target of the predictor.
        plain: Function that returns the network with its loss in plain PyTorch.
        samples: Function that returns inputs and targets.
        batch: Number of samples of a batch.
        epochs: Number of epochs.
        optimizer: Name of the optimiser.
        clip: Largest norm of the gradient; None: gradients are not clipped.
    """

    name: str
    command: tuple[str, ...]
    parts: dict[str, Any]
    target: Target
    plain: Callable[[], nn.Module]
    samples: Callable[[], tuple[Tensor, Tensor]]
    batch: int
    epochs: int
    optimizer: str
    clip: float | None


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


def points(count: int) -> tuple[Tensor, Tensor]:
    """Return random points of the plane in two classes."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(count, 2, generator=generator)
    return inputs, (inputs[:, 0] > 0).long()


def crops(count: int) -> tuple[Tensor, Tensor]:
    """Return random images of the shape of the main experiment, with three random angles each."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (count, 3, 48, 48), dtype=torch.uint8, generator=generator)
    return images, torch.rand(count, 3, generator=generator)


MOONS_PARTS = {
    "data": "moons",
    "encoder": {"mlp": {"name": "mlp", "widths": [128, 128]}},
    "density_head": "bernoulli",
    "metric": {},
}
PASCAL_PARTS = {
    "data": "pascal3d",
    "encoder": {"biternion_vgg": {"name": "biternion_vgg"}},
    "density_head": "von_mises",
    "metric": {},
}
MOONS = Target("class", ("first", "second"))
CASES = (
    Case(
        "`moons/vanilla_128`: mlp of 2 × 128 + bernoulli, batches of 100, 5 steps an epoch",
        ("experiment=moons/vanilla_128", "trainer.check_val_every_n_epoch=200", "trainer.max_epochs=200"),
        MOONS_PARTS, MOONS, PlainMoons, lambda: points(500), 100, 200, "adam", None,
    ),
    Case(
        "`moons/vanilla_128 data.train=100000`: the same, 1,000 steps an epoch",
        ("experiment=moons/vanilla_128", "data.train=100000", "trainer.max_epochs=1"),
        MOONS_PARTS, MOONS, PlainMoons, lambda: points(100_000), 100, 1, "adam", None,
    ),
    Case(
        "`pascal3d/von_mises data.mirror=false data.jitter=0`: biternion_vgg + von_mises, batches of 16",
        ("experiment=pascal3d/von_mises", "data.mirror=false", "data.jitter=0", "trainer.max_epochs=1"),
        PASCAL_PARTS, Target("angle", ("azimuth", "elevation", "tilt")), PlainBiternion, lambda: crops(16 * 75), 16, 1,
        "adamw", 1.0,
    ),
)  # fmt: skip


class Batches:
    """Batches of the training data, in a new random order in each epoch."""

    def __init__(self, inputs: Tensor, target: Tensor, size: int) -> None:
        self.inputs, self.target, self.size = inputs, target, size

    def __len__(self) -> int:
        return -(-len(self.inputs) // self.size)

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        for rows in torch.randperm(len(self.inputs)).split(self.size):
            yield self.inputs[rows], self.target[rows]


class PlainModule(LightningModule):
    """A model in plain PyTorch for Lightning's trainer, which does nothing at a step but train it."""

    def __init__(self, case: Case) -> None:
        super().__init__()
        self.model, self.optimizer = case.plain(), case.optimizer

    def training_step(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        return self.model(*batch)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return OPTIMIZERS[self.optimizer](self.parameters(), lr=1e-3, fused=True)

    def on_train_start(self) -> None:
        self.start = time.perf_counter()

    def on_train_end(self) -> None:
        self.seconds = time.perf_counter() - self.start


def time_plain_loop(
    parameters: Sequence[nn.Parameter], loss: Callable[[Tensor, Tensor], Tensor], case: Case
) -> float:
    """Return the milliseconds a step of a plain PyTorch loop.

    Args:
        parameters: Parameters that are trained.
        loss: Function that returns the loss of a batch, a scalar.
        case: Training data and settings.
    """
    batches = Batches(*case.samples(), case.batch)
    optimizer = OPTIMIZERS[case.optimizer](parameters, lr=1e-3, fused=True)
    steps = 0
    start = time.perf_counter()
    for _ in range(case.epochs):
        for inputs, target in batches:
            optimizer.zero_grad()
            loss(inputs, target).backward()
            if case.clip is not None:
                nn.utils.clip_grad_norm_(parameters, case.clip)
            optimizer.step()
            steps += 1
    return 1e3 * (time.perf_counter() - start) / steps


def time_plain_model(case: Case) -> float:
    """Return the milliseconds a step of a plain loop that trains the model in plain PyTorch."""
    model = case.plain().train()
    return time_plain_loop(list(model.parameters()), model, case)


def time_predictor(case: Case) -> float:
    """Return the milliseconds a step of a plain loop that trains this framework's model."""
    shape = tuple(case.samples()[0].shape[1:])
    model: Predictor = build_predictor(assemble(Settings.of(case.parts)).parts, case.target, shape, seed=0)
    return time_plain_loop(
        list(model.train().parameters()), lambda inputs, target: model.loss(inputs, target).mean(), case
    )


def time_lightning(case: Case) -> float:
    """Return the milliseconds a step of Lightning's trainer, without callbacks and loggers, on the plain model."""
    module = PlainModule(case)
    trainer = Trainer(
        accelerator="cpu", max_epochs=case.epochs, gradient_clip_val=case.clip, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, Batches(*case.samples(), case.batch))
    return 1e3 * module.seconds / trainer.global_step


def time_framework(case: Case) -> float:
    """Return the milliseconds a step of the framework's command."""
    return time_steps((*case.command, *QUIET))


def time_steps(settings: Sequence[str], **variables: str) -> float:
    """Return the milliseconds a step of a training command, from the times in the journal of its run.

    Args:
        settings: Settings of the command.
        variables: Additional environment variables.
    """
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, "-m", "framework", *settings, f"hydra.run.dir={folder}"],
            cwd=ROOT, check=True, stdout=subprocess.DEVNULL, env={**os.environ, **variables},
        )  # fmt: skip
        lines = [json.loads(line) for line in (Path(folder) / "journal.jsonl").read_text().splitlines()]
    steps = [(line["step"], line["time"]) for line in lines if "train/loss" in line.get("values", ())]
    (first_step, start), (last_step, end) = steps[0], steps[-1]
    return 1e3 * (end - start) / (last_step - first_step)


def main() -> None:
    torch.set_num_threads(1)
    require_idle()
    loops = {
        "plain loop, plain model": time_plain_model,
        "plain loop, framework's model": time_predictor,
        "Lightning alone, plain model": time_lightning,
        "framework's command": time_framework,
    }
    rows = []
    for case in CASES:
        rounds_of_loops = [[loop(case) for loop in loops.values()] for _ in range(ROUNDS)]
        times = {
            name: Rounds(tuple(column))
            for name, column in zip(loops, zip(*rounds_of_loops, strict=True), strict=True)
        }
        *others, framework = times.values()
        ratios = [other.times_faster(framework, 3) for other in others]
        rows.append(f"| {' | '.join([case.name, *(rounds.text() for rounds in times.values()), *ratios])} |")
    text = "\n".join(
        [
            "# Training step: run time of the framework, of Lightning and of plain PyTorch loops",
            "",
            "This page compares the time of a training step of this framework with the time of a step in a plain "
            "PyTorch loop, and in Lightning's trainer, on which the framework is built. The difference is what the "
            "framework and Lightning cost.",
            "",
            "The column `framework's command` is the training of `python -m framework` with the settings in the first "
            f"column and `{' '.join(QUIET)}`. Its times are read from the journal of the run: the time between the "
            "first and the last logged step, divided by the number of steps. They include everything that the "
            "framework does at a step and between two epochs, such as reading batches, callbacks, schedules and the "
            "journal. `plain loop, plain model` is a PyTorch loop with a network and a loss that are written in plain "
            "PyTorch. `plain loop, framework's model` is the same loop with the same network as a model of this "
            "framework. `Lightning alone, plain model` is Lightning's trainer without callbacks, loggers and "
            "validation, whose module returns the loss of the model in plain PyTorch. These loops "
            "use the same number of samples, batch size, fused optimiser and clipping of gradients as the command.",
            "",
            f"Each time of a training step is the median of {ROUNDS} rounds (least to largest) of wall time on one "
            "thread. The framework and the other loops run in turn. The last three columns hold the framework's time "
            "divided by the time of another loop. A ratio of 1 means that the framework costs no time.",
            "",
            f"| training | {', ms a step | '.join(loops)}, ms a step | ratio to plain loop, plain model | ratio to "
            "plain loop, framework's model | ratio to Lightning alone |",
            "|---|---:|---:|---:|---:|---:|---:|---:|",
            *rows,
            "",
            f"{machine('torch', 'pytorch-lightning')} Command: `python -m benchmarks.framework.step_overhead`.",
            "",
        ]
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
