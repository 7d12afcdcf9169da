"""A data set held in memory as named tensors, fetched a whole batch at a time."""

from collections.abc import Mapping, Sequence

from torch import Tensor
from torch.utils.data import Dataset, default_collate

from framework.data import Batch


class Fields(Dataset[dict[str, Tensor]]):
    """Named tensors with one common first dimension; `__getitems__` indexes each once per batch.

    Raises:
        ValueError: the tensors' lengths differ.
    """

    def __init__(self, **fields: Tensor) -> None:
        lengths = {name: len(tensor) for name, tensor in fields.items()}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"fields differ in length: {lengths}; wanted one length.")
        self.fields = fields
        self.length = next(iter(lengths.values()))

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return {name: tensor[index] for name, tensor in self.fields.items()}

    def __getitems__(self, indices: Sequence[int]) -> Mapping[str, Tensor]:
        return {name: tensor[list(indices)] for name, tensor in self.fields.items()}


def fetched(dataset: Dataset[Batch], indices: Sequence[int]) -> Batch:
    """Some samples as a batch, at once where the dataset can do that, as a loader fetches them."""
    at_once = getattr(dataset, "__getitems__", None)
    return as_batch(at_once(indices) if at_once else [dataset[index] for index in indices])


def as_batch(items: Mapping[str, Tensor] | list[Batch]) -> Batch:
    """Collation: what a dataset's `__getitems__` batched stays as it is, single items are stacked."""
    return dict(items) if isinstance(items, Mapping) else default_collate(items)
