"""The samples of a split that a check looks at, and whether two are the same."""

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
"""Samples of a split that are always looked at, where there are as many."""
MOST = 5000
"""Samples of a split at most; of more, so many drawn at random from all of it."""
BYTES = 2**27
"""Of the samples of a split that are looked at, where they are more than FEW."""
SECONDS = 1.5
"""Of processor time in which those are fetched, where they are more than FEW."""


def few(length: int, most: int) -> list[int]:
    """All numbers below `length`, or `most` of them evenly spread, with the first and the last."""
    if length <= most:
        return list(range(length))
    return np.linspace(0, length - 1, most).round().astype(int).tolist()


def numbers(split: Any) -> list[int]:
    """All samples, or as many as MOST, BYTES and SECONDS allow: one from each of equally long stretches, at random so
    that nothing periodic hides from them, with the first and the last."""
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
    """The splits by name."""
    return data.splits()._asdict()


def total(data: Data) -> int:
    """Samples of all splits."""
    return sum(map(len, parts(data).values()))


def samples(split: Any) -> Iterator[tuple[int, Batch]]:
    """Number and sample, as `split[number]` gives it, of a few."""
    for number in few(len(split), FEW):
        yield number, split[number]


def batches(asked: Sequence[int], sizes: Sequence[int]) -> Iterator[list[int]]:
    """The numbers in batches of these sizes in turn, over and over."""
    start = turn = 0
    while start < len(asked):
        size = sizes[turn % len(sizes)]
        yield list(asked[start : start + size])
        start, turn = start + size, turn + 1


def fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    """Whether an input is of the data set's shape; a cloud, (points, columns), may have fewer points."""
    if len(wanted) == 2 and len(shape) == 2:
        return 0 < shape[0] <= wanted[0] and shape[1] == wanted[1]
    return shape == wanted


def trimmed(inputs: Tensor) -> Tensor:
    """A cloud without its padding, the rows of NaN at its end; anything else as it is."""
    if inputs.dim() != 2 or not inputs.is_floating_point():
        return inputs
    there = (~inputs.isnan().all(-1)).nonzero()
    return inputs[: int(there[-1]) + 1] if len(there) else inputs[:0]


Marks = Mapping[str, int]
"""Of a sample: field → a number that says its type, shape and content, to the last bit."""


def marks(batch: Batch) -> list[Marks]:
    """Of every sample of a batch; clouds without their padding."""
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
        values = values + 0  # -0 is 0
    flat = values.contiguous().reshape(len(values), values[0].numel()).view(torch.uint8).numpy()
    return [hash((kind, row.tobytes())) for row in flat]


@dataclass(frozen=True)
class Contents:
    """What a split held when it was looked at first.

    Attributes:
        length: number of samples.
        marks: number → that of the sample, of those that are looked at.
    """

    length: int
    marks: Mapping[int, Marks]


def contents(split: Any, asked: Sequence[int] | None = None) -> Contents:
    """Of these samples, or of those that are looked at, as `split[number]` gives them."""
    asked = numbers(split) if asked is None else asked
    one_by_one = ((number, split[number]) for number in asked)
    found = {
        number: marks({key: value[None] for key, value in sample.items()})[0] for number, sample in one_by_one
    }
    return Contents(len(split), found)


def equal_marks(found: Marks, wanted: Marks, what: str, worst: Worst, *, only: Sequence[str] = ()) -> None:
    """The same fields (or `only` these) with the same content; to be quick where they are equal."""
    if not only and found == wanted:
        return
    if not only:
        worst.same(f"{what}: fields", sorted(found), sorted(wanted))
    for key in only or sorted(set(found) & set(wanted)):
        worst.count(found[key] != wanted[key], f"{what}: {key} is another")


def equal_splits(
    found: Data, wanted: Mapping[str, Contents], what: str, worst: Worst, *, only: tuple[str, ...] = ()
) -> None:
    """Every split's samples have the same fields (or `only` these) to the last bit."""
    for name, split in parts(found).items():
        before = wanted[name]
        worst.same(f"{what}: length of {name}", len(split), before.length)
        asked = [number for number in before.marks if number < len(split)]
        for number, one in contents(split, asked).marks.items():
            equal_marks(one, before.marks[number], f"{what}: {name} {number}", worst, only=only)


def equal_fields(found: Batch, wanted: Batch, what: str, worst: Worst, *, only: tuple[str, ...] = ()) -> None:
    if not only:
        worst.same(f"{what}: fields", sorted(found), sorted(wanted))
    for key in only or set(found) & set(wanted):
        worst.same_bits(f"{what}: {key}", found[key], wanted[key])
