"""A data set whose inputs are features that fixed encoders compute once per sample."""

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
from framework.training.batches import Batches, track_batches

LARGEST = 8 * 2**30
"""Largest size, in bytes, of the features of a split that are kept in memory.

Features of a larger size are not cached but computed in every epoch.
"""


@final
class CachedFeatures(Data):
    """Data set that wraps another one and has precomputed features as inputs.

    The features of a split are computed when the split is first read.

    Args:
        data: the original data set, prepared; its `augment` must leave batches unchanged.
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
        train, validation, test = (_LazyFeatures(split, self._compute) for split in data.splits())
        self.computed = train, validation
        self._splits = Splits(train, validation, test)

    def prepare(self) -> None:
        """Do nothing, because the original data set is already prepared."""

    def splits(self) -> Splits:
        """Return the splits of the original data set, with features as inputs."""
        return self._splits

    def compute(self) -> int:
        """Compute the features of the training and validation splits now, and return the number of samples."""
        return sum(len(split.fields) for split in self.computed)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        """Return the samples of a user's files with features as inputs."""
        return _LazyFeatures(self.data.read(files), self._compute)

    def augment(self, batch: Batch) -> Batch:
        """Return the batch itself."""
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        """Return the fingerprint of the original data set."""
        return self.data.fingerprint()

    def preview(self, inputs: Tensor) -> np.ndarray:
        """Raise a ConfigError, because features cannot be drawn."""
        raise ConfigError(
            "Features cannot be drawn. Call `preview` of the data set from which they were computed."
        )

    @torch.no_grad()
    def _compute(self, dataset: Dataset[Batch]) -> Fields:
        """Return all fields of a data set in memory, in its order, with features as inputs."""
        count: int = len(dataset)  # pyright: ignore[reportArgumentType]
        fields: dict[str, Tensor] = {}
        row = 0
        for batch in track_batches(self.batches.of(dataset), "computing features"):
            batch_fields = {**batch, "input": self.features(batch["input"])}
            for name, rows in batch_fields.items():
                if name not in fields:
                    fields[name] = rows.new_empty(count, *rows.shape[1:])
                fields[name][row : row + len(rows)] = rows
            row += len(batch["input"])
        return Fields(**fields)


@final
class _LazyFeatures(Dataset[Batch]):
    """A split whose features are computed when it is first read."""

    def __init__(self, dataset: Dataset[Batch], compute: Callable[[Dataset[Batch]], Fields]) -> None:
        self.dataset = dataset
        self.compute = compute

    @cached_property
    def fields(self) -> Fields:
        """All fields of the split, computed at the first access."""
        return self.compute(self.dataset)

    def __len__(self) -> int:
        return len(self.dataset)  # pyright: ignore[reportArgumentType]

    def __getitem__(self, index: int) -> Batch:
        return self.fields[index]

    def __getitems__(self, indices: Sequence[int]) -> Mapping[str, Tensor]:
        return self.fields.__getitems__(indices)


def fits(data: Data, features: Callable[[Tensor], Tensor]) -> bool:
    """Return whether the features of the training split, the largest split, take at most LARGEST bytes."""
    dataset = data.splits().train
    count: int = len(dataset)  # pyright: ignore[reportArgumentType]
    if count == 0:
        return True
    with torch.no_grad():
        sample_features = features(
            next(iter(Batches(data, batch_size=1, workers=0, seed=0).of(dataset)))["input"]
        )
    return count * sample_features.numel() * sample_features.element_size() <= LARGEST
