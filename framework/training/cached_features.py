"""A data set whose inputs are features, computed once per sample: what precedes everything that is learned."""

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
"""Bytes of features of one split that are held in memory; more are computed in every epoch."""


@final
class CachedFeatures(Data):
    """Another data set's samples with features for inputs; each split is computed when it is first asked for.

    Args:
        data: prepared, and such that `augment` leaves its batches as they are.
        features: of a batch of inputs.
        batch_size: samples encoded at once.
        workers: loading processes.
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
        """Nothing: the data is prepared."""

    def splits(self) -> Splits:
        return self._splits

    def compute(self) -> int:
        """Compute what training reads, now; of how many samples."""
        return sum(len(split.fields) for split in self.computed)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return _Computed(self.data.read(files), self._computed)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return self.data.fingerprint()

    def picture(self, inputs: Tensor) -> np.ndarray:
        raise ConfigError("Features have no picture; ask the data they were computed from.")

    @torch.no_grad()
    def _computed(self, dataset: Dataset[Batch]) -> Fields:
        """Every field in memory, in the order of the data set."""
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
        return self.compute(self.dataset)

    def __len__(self) -> int:
        return len(self.dataset)  # pyright: ignore[reportArgumentType]

    def __getitem__(self, index: int) -> Batch:
        return self.fields[index]

    def __getitems__(self, indices: Sequence[int]) -> Mapping[str, Tensor]:
        return self.fields.__getitems__(indices)


def fits(data: Data, features: Callable[[Tensor], Tensor]) -> bool:
    """Whether the features of the training split, its largest, can be held in memory."""
    dataset = data.splits().train
    count: int = len(dataset)  # pyright: ignore[reportArgumentType]
    if count == 0:
        return True
    with torch.no_grad():
        one = features(next(iter(Batches(data, batch_size=1, workers=0, seed=0).of(dataset)))["input"])
    return count * one.numel() * one.element_size() <= LARGEST
