"""Data set for every kind of target with typical mistakes of beginners, and metrics of a third party."""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch, Data, Splits
from framework.datasets.fields import Fields
from framework.density_head import DensityHead
from framework.distributions.circular import circular
from framework.errors import DataError
from framework.metric import Metric
from framework.prediction import Prediction
from framework.target import Target

SAMPLES = 120
NO_SAMPLE = torch.Size()


class Trial(Data):
    """Two numbers near a circle (synthetic), with a target of the chosen kind."""

    def __init__(
        self,
        *,
        kind: Literal["angle", "angles", "real", "reals", "class"] = "angle",
        fault: Literal["none", "flat", "column", "wide", "label", "last label", "below"] = "none",
    ) -> None:
        self.kind, self.fault = kind, fault
        self.groups = ("trial",)
        self.synthetic = True

    def prepare(self) -> None:
        generator = torch.Generator().manual_seed(0)
        angle = (torch.rand(SAMPLES, 1, generator=generator) * 2 - 1) * torch.pi
        self.inputs = torch.cat([angle.cos(), angle.sin()], -1)
        self.input_shape = (2,)
        if self.kind == "class":
            self.target = Target("class", ("left", "right"))
            truth = (angle[:, 0] > 0).long()
        else:
            names = ("pan", "tilt")[: 1 + self.kind.endswith("s")]
            self.target = Target("angle" if self.kind.startswith("angle") else "real", names)
            truth = torch.cat([angle, angle / 2], -1)[:, : len(names)]
        self.truth = {
            "none": lambda: truth,
            "flat": lambda: truth.flatten()[:SAMPLES],
            "column": lambda: truth[..., None],
            "wide": lambda: torch.cat([truth, truth], -1),
            "label": lambda: truth.index_fill(0, torch.tensor([5]), 7),
            "last label": lambda: truth.index_fill(0, torch.tensor([SAMPLES - 1]), 7),
            "below": lambda: truth.index_fill(0, torch.tensor([5]), -1),
        }[self.fault]()

    def splits(self) -> Splits:
        def part(start: int, end: int) -> Fields:
            count = end - start
            return Fields(
                input=self.inputs[start:end],
                target=self.truth[start:end],
                index=torch.arange(count),
                group=torch.zeros(count, dtype=torch.int64),
            )

        return Splits(part(0, 72), part(72, 96), part(96, SAMPLES))

    def read(self, files: Sequence[str]) -> Fields:
        raise DataError("a trial has no files; predict without mode.files.")

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return {"name": "trial", "kind": self.kind}

    def preview(self, inputs: Tensor) -> np.ndarray:
        return np.full((8, 8, 3), 255, dtype=np.uint8)


class Silent(Distribution):
    """Uniform density over several angles, which provides no marginal of a single angle."""

    arg_constraints: ClassVar = {}
    support = circular

    def __init__(self, raw: Tensor) -> None:
        self.raw = raw
        super().__init__(raw.shape[:-1], raw.shape[-1:], validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        return (0 * self.raw - math.log(2 * math.pi)).sum(-1).expand(value.shape[:-1])

    def sample(self, sample_shape: torch.Size = NO_SAMPLE) -> Tensor:
        return 2 * math.pi * torch.rand(*sample_shape, *self.raw.shape, device=self.raw.device)

    def entropy(self) -> Tensor:
        return (0 * self.raw + math.log(2 * math.pi)).sum(-1)

    @property
    def mode(self) -> Tensor:
        return torch.zeros_like(self.raw)


class SilentHead(DensityHead):
    """Density head that always returns the uniform density."""

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="silent")
        self.size = len(target.names)

    def forward(self, raw: Tensor) -> Silent:
        return Silent(raw)

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        pass


class MeanEntropy(Metric):
    """Metric that does not declare whether lower or higher values are better."""

    columns: ClassVar = {"mean_entropy": "mean entropy"}
    count: Tensor
    total: Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("count", "total"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        self.count += len(prediction.target)
        self.total += prediction.entropy.double().sum()

    def compute(self) -> dict[str, Tensor]:
        return {"mean_entropy": self.total / self.count}


class Listed(MeanEntropy):
    """Metric that returns several numbers under one name."""

    def compute(self) -> dict[str, Tensor]:
        return {"mean_entropy": (self.total / self.count).expand(3)}
