"""Choice of the samples of a split to check, and comparisons of samples to the last bit.

A comparison records an error for each difference in `worst` (`framework.testing.finding.Worst`). Its argument `label`
describes the compared samples in the finding.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from framework.configuration.schema import build, resolve
from framework.data import Batch, Data
from framework.datasets.fields import Fields
from framework.testing.finding import SEED, Worst

FEW = 400
"""Smallest number of samples of a split that are checked; a shorter split is checked entirely."""
MOST = 5000
"""Largest number of samples of a split that are checked; a longer split is sampled at random."""
BYTES = 2**27
"""Limit on the memory of the checked samples of a split, bytes, where more than FEW are checked."""
SECONDS = 1.5
"""Limit on the processor time to fetch the checked samples of a split, seconds, where more than FEW are checked."""


def prepared(name: str, **config: Any) -> Any:
    """Return the prepared data set of the plugin `name`, built with the parameters `config`."""
    data = build("data", resolve("data", {"name": name, **config}))
    data.prepare()
    return data


def fields_of(data: Data, split: str) -> Mapping[str, Tensor]:
    """Return the fields of a split that holds them all in memory."""
    dataset = getattr(data.splits(), split)
    assert isinstance(dataset, Fields)
    return dataset.fields


def spaced_indices(length: int, most: int) -> list[int]:
    """Return all indices below `length`, or `most` of them, evenly spaced, with the first and the last."""
    if length <= most:
        return list(range(length))
    return np.linspace(0, length - 1, most).round().astype(int).tolist()


def indices_to_check(split: Any) -> list[int]:
    """Return the indices of all samples, or of as many as the limits on number (MOST), memory and time allow.

    A long split is divided into equally long blocks, and one sample of each block is drawn at random, so that periodic
    faults are found. The first and the last sample are included.
    """
    length = len(split)
    if length <= FEW:
        return list(range(length))
    start = time.process_time()
    tried = [split[number] for number in spaced_indices(length, 8)]
    seconds = (time.process_time() - start) / len(tried)
    size = max(sum(value.numel() * value.element_size() for value in sample.values()) for sample in tried)
    most = max(FEW, min(MOST, BYTES // max(size, 1), int(SECONDS / max(seconds, 1e-6))))
    if length <= most:
        return list(range(length))
    edges = np.linspace(0, length, most + 1).astype(int)
    random_picks = np.random.default_rng(SEED).integers(edges[:-1], edges[1:]).tolist()
    return [0, *random_picks[1:-1], length - 1]


def splits_by_name(data: Data) -> dict[str, Any]:
    """Return the splits of a data set by name."""
    return data.splits()._asdict()


def total_samples(data: Data) -> int:
    """Return the number of samples in all splits."""
    return sum(map(len, splits_by_name(data).values()))


def samples(split: Any) -> Iterator[tuple[int, Batch]]:
    """Yield the index and the sample, as `split[index]` returns it, of at most FEW samples."""
    for number in spaced_indices(len(split), FEW):
        yield number, split[number]


def batches(indices: Sequence[int], sizes: Sequence[int]) -> Iterator[list[int]]:
    """Yield `indices` in consecutive batches, whose sizes repeat the sequence `sizes`."""
    start = count = 0
    while start < len(indices):
        size = sizes[count % len(sizes)]
        yield list(indices[start : start + size])
        start, count = start + size, count + 1


def remove_padding(inputs: Tensor) -> Tensor:
    """Return a cloud without its padding, the rows of NaN at its end; return any other input unchanged."""
    if inputs.dim() != 2 or not inputs.is_floating_point():
        return inputs
    valid_rows = (~inputs.isnan().all(-1)).nonzero()
    return inputs[: int(valid_rows[-1]) + 1] if len(valid_rows) else inputs[:0]


Hashes = Mapping[str, int]
"""Field of a sample → hash of its dtype, shape and content."""


def hash_samples(batch: Batch) -> list[Hashes]:
    """Return the hashes of every sample of a batch; the padding of clouds is ignored."""
    rows: dict[str, list[int]] = {}
    for key, values in batch.items():
        if key == "input" and values.dim() == 3 and values.is_floating_point() and values.isnan().any():
            rows[key] = [_hash_rows(remove_padding(cloud)[None])[0] for cloud in values]
        else:
            rows[key] = _hash_rows(values)
    return [dict(zip(rows, row, strict=True)) for row in zip(*rows.values(), strict=True)]


def _hash_rows(values: Tensor) -> list[int]:
    kind = (str(values.dtype), tuple(values.shape[1:]))
    values = values.detach()
    if values.is_floating_point():
        values = values + 0  # so that -0 equals 0
    flat = values.contiguous().reshape(len(values), values[0].numel()).view(torch.uint8).numpy()
    return [hash((kind, row.tobytes())) for row in flat]


@dataclass(frozen=True)
class Contents:
    """Hashes of the checked samples of a split.

    Attributes:
        length: Number of samples of the split.
        hashes: Index of a checked sample → its hashes.
    """

    length: int
    hashes: Mapping[int, Hashes]


def hash_split(split: Any, indices: Sequence[int] | None = None) -> Contents:
    """Return the hashes of samples as `split[index]` returns them.

    Args:
        split: Split of a data set.
        indices: Indices of the samples; None for those that `indices_to_check` returns.
    """
    indices = indices_to_check(split) if indices is None else indices
    one_by_one = ((number, split[number]) for number in indices)
    hashes = {
        number: hash_samples({key: value[None] for key, value in sample.items()})[0]
        for number, sample in one_by_one
    }
    return Contents(len(split), hashes)


def check_equal_hashes(
    actual: Hashes, expected: Hashes, label: str, worst: Worst, *, only: Sequence[str] = ()
) -> None:
    """Check that two samples have equal hashes in all fields, or in the fields `only` if this is not empty."""
    if not only and actual == expected:
        return
    if not only:
        worst.same(f"{label}: fields", sorted(actual), sorted(expected))
    for key in only or sorted(set(actual) & set(expected)):
        worst.count(actual[key] != expected[key], f"{label}: {key} differs")


def check_equal_splits(
    actual: Data, expected: Mapping[str, Contents], label: str, worst: Worst, *, only: tuple[str, ...] = ()
) -> None:
    """Check that every split of `actual` has the same samples as `expected`, in all fields or in the fields `only`."""
    for name, split in splits_by_name(actual).items():
        before = expected[name]
        worst.same(f"{label}: length of {name}", len(split), before.length)
        indices = [number for number in before.hashes if number < len(split)]
        for number, hashes in hash_split(split, indices).hashes.items():
            check_equal_hashes(
                hashes, before.hashes[number], f"{label}: {name} sample {number}", worst, only=only
            )


def check_equal_fields(actual: Batch, expected: Batch, label: str, worst: Worst) -> None:
    """Check that two samples or batches are equal to the last bit in all fields."""
    worst.same(f"{label}: fields", sorted(actual), sorted(expected))
    for key in set(actual) & set(expected):
        worst.same_bits(f"{label}: {key}", actual[key], expected[key])
