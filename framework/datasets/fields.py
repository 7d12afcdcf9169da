"""A data set in memory: named tensors that are indexed once per batch."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.utils.data import Dataset, default_collate

from framework.data import Batch


class Fields(Dataset[dict[str, Tensor]]):
    """Data set of named tensors with one common first dimension, the sample.

    `__getitems__` returns a batch by indexing each tensor once.

    Raises:
        ValueError: the tensors' lengths differ.
    """

    def __init__(self, **fields: Tensor) -> None:
        lengths = {name: len(tensor) for name, tensor in fields.items()}
        if len(set(lengths.values())) != 1:
            raise ValueError(
                f"The fields have the lengths {lengths}, but all must have the same length. Give every field one row "
                "for each sample."
            )
        self.fields = fields
        self.length = next(iter(lengths.values()))

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return {name: tensor[index] for name, tensor in self.fields.items()}

    def __getitems__(self, indices: Sequence[int]) -> Mapping[str, Tensor]:
        rows = torch.tensor(
            indices, dtype=torch.int64
        )  # once, because a list would be converted for each field
        return {name: tensor[rows] for name, tensor in self.fields.items()}


class FetchedInBatches(Dataset[Batch], ABC):
    """Base of data sets whose samples are computed in batches when they are fetched."""

    @abstractmethod
    def __getitems__(self, indices: Sequence[int]) -> Batch:
        """Return the samples with the indices `indices` as a batch."""

    def __getitem__(self, index: int) -> Batch:
        return {name: values[0] for name, values in self.__getitems__([index]).items()}


def fetch(dataset: Dataset[Batch], indices: Sequence[int]) -> Batch:
    """Return the samples `indices` as a batch, read with `__getitems__` if the data set has it, or one by one."""
    at_once = getattr(dataset, "__getitems__", None)
    return as_batch(at_once(indices) if at_once else [dataset[index] for index in indices])


def as_batch(items: Mapping[str, Tensor] | list[Batch]) -> Batch:
    """Return `items` as a batch: a batch from `__getitems__` stays as it is, a list of single samples is stacked."""
    return dict(items) if isinstance(items, Mapping) else default_collate(items)
