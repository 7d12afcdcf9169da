"""Samples of a split that checks look at, and comparisons of samples to the last bit."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from framework.data import Batch, Data
from framework.testing.finding import SEED, Worst

FEW = 400
"""Number of samples of a split that are always checked, or all where there are fewer."""
MOST = 5000
"""Largest number of samples of a split that are checked, drawn at random where there are more."""
BYTES = 2**27
"""Limit on the memory of the checked samples of a split beyond FEW, bytes."""
SECONDS = 1.5
"""Limit on the processor time to fetch the checked samples of a split beyond FEW, seconds."""


def few(length: int, most: int) -> list[int]:
    """Return all numbers below `length`, or `most` of them, evenly spaced, with the first and the last."""
    if length <= most:
        return list(range(length))
    return np.linspace(0, length - 1, most).round().astype(int).tolist()


def numbers(split: Any) -> list[int]:
    """Return the numbers of all samples, or of as many as MOST, BYTES and SECONDS allow.

    The split is divided into equally long blocks, and one sample is drawn at random from each, so that periodic faults
    show. The first and the last sample are included.
    """
    length = len(split)
    if length <= FEW:
        return list(range(length))
    start = time.process_time()
    tried = [split[number] for number in few(length, 8)]
    seconds = (time.process_time() - start) / len(tried)
    size = max(sum(value.numel() * value.element_size() for value in sample.values()) for sample in tried)
    most = max(FEW, min(MOST, BYTES // max(size, 1), int(SECONDS / max(seconds, 1e-6))))
    if length <= most:
        return list(range(length))
    edges = np.linspace(0, length, most + 1).astype(int)
    drawn = np.random.default_rng(SEED).integers(edges[:-1], edges[1:]).tolist()
    return [0, *drawn[1:-1], length - 1]


def parts(data: Data) -> dict[str, Any]:
    """Return the splits of a data set by name."""
    return data.splits()._asdict()


def total(data: Data) -> int:
    """Return the number of samples in all splits."""
    return sum(map(len, parts(data).values()))


def samples(split: Any) -> Iterator[tuple[int, Batch]]:
    """Yield number and sample, as `split[number]` returns it, of at most FEW samples."""
    for number in few(len(split), FEW):
        yield number, split[number]


def batches(asked: Sequence[int], sizes: Sequence[int]) -> Iterator[list[int]]:
    """Yield the numbers in batches of these sizes, which repeat in turn."""
    start = turn = 0
    while start < len(asked):
        size = sizes[turn % len(sizes)]
        yield list(asked[start : start + size])
        start, turn = start + size, turn + 1


def fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    """Return whether an input has the data set's shape; a cloud, (points, columns), may have fewer points."""
    if len(wanted) == 2 and len(shape) == 2:
        return 0 < shape[0] <= wanted[0] and shape[1] == wanted[1]
    return shape == wanted


def trimmed(inputs: Tensor) -> Tensor:
    """Return a cloud without its padding, the rows of NaN at its end; return any other input as it is."""
    if inputs.dim() != 2 or not inputs.is_floating_point():
        return inputs
    there = (~inputs.isnan().all(-1)).nonzero()
    return inputs[: int(there[-1]) + 1] if len(there) else inputs[:0]


Marks = Mapping[str, int]
"""Field of a sample → hash of its dtype, shape and content, to the last bit."""


def marks(batch: Batch) -> list[Marks]:
    """Return the marks of every sample of a batch; clouds are taken without their padding."""
    rows: dict[str, list[int]] = {}
    for key, values in batch.items():
        if key == "input" and values.dim() == 3 and values.is_floating_point() and values.isnan().any():
            rows[key] = [_mark(trimmed(cloud)[None])[0] for cloud in values]
        else:
            rows[key] = _mark(values)
    return [dict(zip(rows, row, strict=True)) for row in zip(*rows.values(), strict=True)]


def _mark(values: Tensor) -> list[int]:
    kind = (str(values.dtype), tuple(values.shape[1:]))
    values = values.detach()
    if values.is_floating_point():
        values = values + 0  # so that -0 equals 0
    flat = values.contiguous().reshape(len(values), values[0].numel()).view(torch.uint8).numpy()
    return [hash((kind, row.tobytes())) for row in flat]


@dataclass(frozen=True)
class Contents:
    """Contents of a split at the first look.

    Attributes:
        length: Number of samples.
        marks: Number of a checked sample → its marks.
    """

    length: int
    marks: Mapping[int, Marks]


def contents(split: Any, asked: Sequence[int] | None = None) -> Contents:
    """Return the marks of the samples `asked`, or of those to check if None, as `split[number]` returns them."""
    asked = numbers(split) if asked is None else asked
    one_by_one = ((number, split[number]) for number in asked)
    found = {
        number: marks({key: value[None] for key, value in sample.items()})[0] for number, sample in one_by_one
    }
    return Contents(len(split), found)


def equal_marks(found: Marks, wanted: Marks, what: str, worst: Worst, *, only: Sequence[str] = ()) -> None:
    """Check that two samples have the same content in all fields, or in those of `only`; quick where they are equal."""
    if not only and found == wanted:
        return
    if not only:
        worst.same(f"{what}: fields", sorted(found), sorted(wanted))
    for key in only or sorted(set(found) & set(wanted)):
        worst.count(found[key] != wanted[key], f"{what}: {key} is another")


def equal_splits(
    found: Data, wanted: Mapping[str, Contents], what: str, worst: Worst, *, only: tuple[str, ...] = ()
) -> None:
    """Check that the samples of every split have the same content in all fields, or in those of `only`."""
    for name, split in parts(found).items():
        before = wanted[name]
        worst.same(f"{what}: length of {name}", len(split), before.length)
        asked = [number for number in before.marks if number < len(split)]
        for number, one in contents(split, asked).marks.items():
            equal_marks(one, before.marks[number], f"{what}: {name} {number}", worst, only=only)


def equal_fields(found: Batch, wanted: Batch, what: str, worst: Worst, *, only: tuple[str, ...] = ()) -> None:
    """Check that two samples or batches agree to the last bit in all fields, or in those of `only`."""
    if not only:
        worst.same(f"{what}: fields", sorted(found), sorted(wanted))
    for key in only or set(found) & set(wanted):
        worst.same_bits(f"{what}: {key}", found[key], wanted[key])
