"""A data set whose inputs are features that fixed encoders computed once per sample."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.datasets.fields import Fields
from framework.errors import ConfigError
from framework.training.batches import Batches, told

LARGEST = 8 * 2**30
"""Size of the features of one split, in bytes, up to which they are held in memory.

Larger features are computed in every epoch.
"""


@final
class CachedFeatures(Data):
    """Another data set's samples with features as inputs; each split is computed when it is first requested.

    Args:
        data: a prepared data set whose `augment` leaves batches as they are.
        features: function from a batch of inputs to features.
        batch_size: number of samples encoded at once.
        workers: number of loading processes.
    """

    bibtex = ""

    def __init__(
        self, data: Data, features: Callable[[Tensor], Tensor], *, batch_size: int, workers: int
    ) -> None:
        self.data = data
        self.features = features
        self.batches = Batches(data, batch_size=batch_size, workers=workers, seed=0)
        self.target = data.target
        self.groups = data.groups
        self.synthetic = data.synthetic
        self.skipped = data.skipped
        self.varies = False
        train, validation, test = (_Computed(split, self._computed) for split in data.splits())
        self.computed = train, validation
        self._splits = Splits(train, validation, test)

    def prepare(self) -> None:
        """Do nothing, because the data set is prepared."""

    def splits(self) -> Splits:
        """Return the splits, with features as inputs."""
        return self._splits

    def compute(self) -> int:
        """Compute now the features that training reads, and return the number of their samples."""
        return sum(len(split.fields) for split in self.computed)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        """Return the features of a user's own files."""
        return _Computed(self.data.read(files), self._computed)

    def augment(self, batch: Batch) -> Batch:
        """Return the batch itself."""
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        """Return what identifies the data set."""
        return self.data.fingerprint()

    def preview(self, inputs: Tensor) -> np.ndarray:
        """Refuse to draw features."""
        raise ConfigError("Features have no picture; ask the data they were computed from.")

    @torch.no_grad()
    def _computed(self, dataset: Dataset[Batch]) -> Fields:
        """Return all fields in memory, in the order of the data set."""
        count: int = len(dataset)  # pyright: ignore[reportArgumentType]
        fields: dict[str, Tensor] = {}
        row = 0
        for batch in told(self.batches.of(dataset), "computing features"):
            found = {**batch, "input": self.features(batch["input"])}
            for name, some in found.items():
                if name not in fields:
                    fields[name] = some.new_empty(count, *some.shape[1:])
                fields[name][row : row + len(some)] = some
            row += len(batch["input"])
        return Fields(**fields)


@final
class _Computed(Dataset[Batch]):
    """A split whose features are computed when it is first read."""

    def __init__(self, dataset: Dataset[Batch], compute: Callable[[Dataset[Batch]], Fields]) -> None:
        self.dataset = dataset
        self.compute = compute

    @cached_property
    def fields(self) -> Fields:
        """All fields of the split."""
        return self.compute(self.dataset)

    def __len__(self) -> int:
        return len(self.dataset)  # pyright: ignore[reportArgumentType]

    def __getitem__(self, index: int) -> Batch:
        return self.fields[index]

    def __getitems__(self, indices: Sequence[int]) -> Mapping[str, Tensor]:
        return self.fields.__getitems__(indices)


def fits(data: Data, features: Callable[[Tensor], Tensor]) -> bool:
    """Return whether the features of the training split, which is the largest, can be held in memory."""
    dataset = data.splits().train
    count: int = len(dataset)  # pyright: ignore[reportArgumentType]
    if count == 0:
        return True
    with torch.no_grad():
        one = features(next(iter(Batches(data, batch_size=1, workers=0, seed=0).of(dataset)))["input"])
    return count * one.numel() * one.element_size() <= LARGEST
