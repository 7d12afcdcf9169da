"""A data set that the framework does not ship."""

import os
import resource
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from framework.data import Batch, Data
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.target import Target


class Signal:
    """Sends this process a signal at one of its training batches, the first of which is 1, or at the first picture of
    what was tested, which is 0; not where a file says that it was sent already."""

    def __init__(self, at: int | None, number: int, marker: str) -> None:
        self.at, self.number, self.marker = at, number, Path(marker)
        self.batches = 0

    def count(self) -> None:
        self.batches += 1
        self.reached(self.batches)

    def reached(self, place: int) -> None:
        if place == self.at and not self.marker.exists():
            self.marker.touch()
            os.kill(os.getpid(), self.number)


class Signalled(Data):
    """Base of data sets that send a signal, and that read no files."""

    signal: Signal

    def read(self, files: Sequence[Path]) -> Fields:
        raise DataError(f"{self.groups[0]} has no files; predict without mode.files.")

    def augment(self, batch: Batch) -> Batch:
        """Unchanged; sends itself `signal_number` at training batch `signal_at`, unless the marker file is there."""
        self.signal.count()
        return batch


class Dial(Signalled):
    """Two numbers, the noisy tip of a needle, from which its angle is to be read (synthetic)."""

    bibtex = ""

    def __init__(
        self,
        *,
        samples: Annotated[int, Field(ge=30)] = 240,
        noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.1,
        bad_label: int | None = None,
        signal_at: int | None = None,
        signal_number: int = 9,
        signal_marker: str = "",
        longest_file: int | None = None,
    ) -> None:
        self.samples = samples
        self.noise = noise
        self.bad_label = bad_label
        self.signal = Signal(signal_at, signal_number, signal_marker)
        self.longest_file = longest_file
        self.target = Target("angle", ("needle",))
        self.input_shape = (2,)
        self.groups = ("dial",)
        self.synthetic = True
        self.skipped = 0

    def prepare(self) -> None:
        if self.longest_file is not None:  # stands for a disk that is full from then on
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.longest_file, resource.RLIM_INFINITY))
        generator = torch.Generator().manual_seed(0)
        angle = (torch.rand(self.samples, generator=generator) * 2 - 1) * torch.pi
        tip = torch.stack([angle.cos(), angle.sin()], -1)
        self.inputs = tip + self.noise * torch.randn(self.samples, 2, generator=generator)
        self.angle = angle[:, None]
        if self.bad_label is not None:
            self.angle[self.bad_label] = torch.nan

    def _part(self, start: float, end: float) -> Fields:
        rows = slice(int(start * self.samples), int(end * self.samples))
        count = len(self.inputs[rows])
        return Fields(
            input=self.inputs[rows],
            target=self.angle[rows],
            index=torch.arange(count),
            group=torch.zeros(count, dtype=torch.int64),
        )

    def train(self) -> Fields:
        return self._part(0, 0.6)

    def validation(self) -> Fields:
        return self._part(0.6, 0.8)

    def test(self) -> Fields:
        return self._part(0.8, 1)

    def fingerprint(self) -> Mapping[str, str]:
        return {"name": "dial", "samples": str(self.samples)}

    def preview(self, inputs: Tensor) -> np.ndarray:
        self.signal.reached(0)
        canvas = np.full((24, 24, 3), 255, dtype=np.uint8)
        column, row = (12 + 9 * inputs.clamp(-1.2, 1.2).numpy() * (1, -1)).astype(int)
        canvas[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 0
        return canvas
