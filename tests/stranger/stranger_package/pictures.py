"""A data set of images whose targets are images: squares of one colour, to be told from a faded picture (synthetic)."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from framework.data import Splits
from framework.datasets.fields import Fields
from framework.geometry.srgb import linear_from_srgb
from framework.target import Target
from stranger_package.data import Signal, Signalled


class Faded(Signalled):
    """An input is (3, 16, 12): a square of one colour on white, half faded, with noise; the target is the square."""

    bibtex = ""
    varies = True

    def __init__(
        self,
        *,
        samples: int = 60,
        signal_at: int | None = None,
        signal_number: int = 9,
        signal_marker: str = "",
    ) -> None:
        self.samples = samples
        self.signal = Signal(signal_at, signal_number, signal_marker)
        self.input_shape = (3, 16, 12)
        self.target = Target("image", ("red", "green", "blue"), size=(16, 12))
        self.groups = ("squares",)
        self.synthetic = True
        self.skipped = 0

    def prepare(self) -> None:
        generator = torch.Generator().manual_seed(0)
        self.images = torch.ones(self.samples, 16, 12, 3)
        self.masks = torch.zeros(self.samples, 16, 12, dtype=torch.bool)
        for image, mask in zip(self.images, self.masks, strict=True):
            row, column = (int(torch.randint(0, most, (), generator=generator)) for most in (10, 6))
            image[row : row + 6, column : column + 6] = torch.rand(3, generator=generator)
            mask[row : row + 6, column : column + 6] = True
        noise = 0.05 * torch.randn(self.images.shape, generator=generator)
        self.inputs = (0.5 + self.images / 2 + noise).movedim(-1, 1).contiguous()

    def splits(self) -> Splits:
        ends = (0, int(0.6 * self.samples), int(0.8 * self.samples), self.samples)
        return Splits(*(self._part(slice(start, end)) for start, end in pairwise(ends)))

    def _part(self, rows: slice) -> Fields:
        count = len(self.images[rows])
        return Fields(
            input=self.inputs[rows],
            target=self.images[rows],
            color=linear_from_srgb(self.images[rows]),
            mask=self.masks[rows],
            index=torch.arange(count),
            group=torch.zeros(count, dtype=torch.int64),
        )

    def fingerprint(self) -> Mapping[str, str]:
        return {"name": "faded", "samples": str(self.samples)}

    def preview(self, inputs: Tensor) -> np.ndarray:
        return (inputs.clamp(0, 1).movedim(0, -1) * 255).byte().numpy()
