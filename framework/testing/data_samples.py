"""The samples of a split that a check looks at, and whether two are the same."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from torch import Tensor

from framework.data import Batch, Data
from framework.testing.finding import Worst

MOST = 400
"""Samples of a split; of more, so many evenly spread."""


def few(length: int, most: int) -> list[int]:
    """All numbers below `length`, or `most` of them evenly spread, with the first and the last."""
    if length <= most:
        return list(range(length))
    return np.linspace(0, length - 1, most).round().astype(int).tolist()


def parts(data: Data) -> dict[str, Any]:
    """The splits by name."""
    return data.splits()._asdict()


def total(data: Data) -> int:
    """Samples of all splits."""
    return sum(map(len, parts(data).values()))


def samples(split: Any) -> Iterator[tuple[int, Batch]]:
    """Number and sample, as `split[number]` gives it."""
    for number in few(len(split), MOST):
        yield number, split[number]


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


def equal_splits(found: Data, wanted: Data, what: str, worst: Worst, *, only: tuple[str, ...] = ()) -> None:
    """Every split's samples have the same fields (or `only` these) to the last bit."""
    for (name, split), other in zip(parts(found).items(), parts(wanted).values(), strict=True):
        worst.same(f"{what}: length of {name}", len(split), len(other))
        for (number, sample), (_, same) in zip(samples(split), samples(other), strict=False):
            equal_fields(sample, same, f"{what}: {name} {number}", worst, only=only)


def equal_fields(found: Batch, wanted: Batch, what: str, worst: Worst, *, only: tuple[str, ...] = ()) -> None:
    if not only:
        worst.same(f"{what}: fields", sorted(found), sorted(wanted))
    for key in only or set(found) & set(wanted):
        worst.same_bits(f"{what}: {key}", found[key], wanted[key])
