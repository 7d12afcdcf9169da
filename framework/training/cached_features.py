"""A data set whose inputs are features, computed once per sample: what precedes everything that is learned."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import final

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data
from framework.datasets.fields import Fields
from framework.errors import ConfigError
from framework.training.batches import Batches

LARGEST = 8 * 2**30
"""Bytes of features of one split that are held in memory; more are computed in every epoch."""


@final
class Encoded(Data):
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
        self.splits: dict[str, Dataset[Batch]] = {}

    def prepare(self) -> None:
        """Nothing: the data is prepared."""

    def train(self) -> Dataset[Batch]:
        return self._split("train", self.data.train)

    def validation(self) -> Dataset[Batch]:
        return self._split("validation", self.data.validation)

    def test(self) -> Dataset[Batch]:
        return self._split("test", self.data.test)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return self._computed(self.data.read(files))

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return self.data.fingerprint()

    def picture(self, inputs: Tensor) -> np.ndarray:
        raise ConfigError("Features have no picture; ask the data they were computed from.")

    def _split(self, name: str, dataset: Callable[[], Dataset[Batch]]) -> Dataset[Batch]:
        if name not in self.splits:
            self.splits[name] = self._computed(dataset())
        return self.splits[name]

    @torch.no_grad()
    def _computed(self, dataset: Dataset[Batch]) -> Fields:
        """Every field in memory, in the order of the data set."""
        count: int = len(dataset)  # pyright: ignore[reportArgumentType]
        fields: dict[str, Tensor] = {}
        row = 0
        for batch in self.batches.of(dataset):
            found = {**batch, "input": self.features(batch["input"])}
            for name, some in found.items():
                if name not in fields:
                    fields[name] = some.new_empty(count, *some.shape[1:])
                fields[name][row : row + len(some)] = some
            row += len(batch["input"])
        return Fields(**fields)


def fits(data: Data, features: Callable[[Tensor], Tensor]) -> bool:
    """Whether the features of the training split, its largest, can be held in memory."""
    dataset = data.train()
    count: int = len(dataset)  # pyright: ignore[reportArgumentType]
    if count == 0:
        return True
    with torch.no_grad():
        one = features(next(iter(Batches(data, batch_size=1, workers=0, seed=0).of(dataset)))["input"])
    return count * one.numel() * one.element_size() <= LARGEST
