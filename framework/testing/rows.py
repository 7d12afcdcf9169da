"""Rows of the contract: a plugin states parameters and references in its `rows.py`, and every check runs on them.

`rows.py` stands beside the module that holds the plugin's class, or for a family in a folder above it; its `ROWS` is a
dictionary from the plugin's name to its rows, of `HeadRow` for a density head, and so on. A plugin without rows is
checked with its default parameters and no reference.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from framework.density_head import DensityHead
from framework.target import Target


@dataclass(frozen=True)
class Case:
    """Stiff or extreme raw numbers of a density head with log-densities from an independent source.

    Attributes:
        name: what is extreme here: "κ = 1e12".
        raw: (batch, size) float64 raw numbers that float32 holds exactly.
        value: (batch, *event) targets that float32 holds exactly, int64 for classes.
        log_prob: (batch,) float64, the log-density there, nats, to full float64 accuracy.
    """

    name: str
    raw: Tensor
    value: Tensor
    log_prob: Tensor


@dataclass(frozen=True)
class HeadRow:
    """One parametrisation of a density head.

    Attributes:
        name: what distinguishes it from the plugin's other rows.
        target: what it predicts.
        config: its parameters.
        cases: the reference: a built head (evaluation mode, float64) → cases. None where none is known.
        scale: standard deviation of the normal raw numbers on which densities of three numbers, and those that draw,
            are integrated, such that they are broad enough for a grid; others follow at scales of 1e-2 to 1e3 too.
        limits: property → limit, where it is not the contract's own.
        leave_out: property → why this density cannot have it.
    """

    name: str
    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    cases: Callable[[DensityHead], Iterable[Case]] | None = None
    scale: float = 1.0
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class EncoderRow:
    """One parametrisation of an encoder: of images of 3 or fewer channels, of vectors; of clouds see CloudRow.

    Attributes:
        name: what distinguishes it from the plugin's other rows.
        input_shape: of one sample.
        config, limits, leave_out: as in HeadRow.
        columns: names of its last dimension, as `Data.columns`.
        inputs: number of samples → inputs, where it does not read any numbers.
    """

    name: str
    input_shape: tuple[int, ...]
    config: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    inputs: Callable[[int], Tensor] | None = None


@dataclass(frozen=True)
class CloudRow(EncoderRow):
    """One parametrisation of an encoder of point clouds, of shape (points, columns) with x, y, z in the first three.

    Such an encoder sees a set: neither padding nor the order of its points matters, and bad clouds are named.
    """


@dataclass(frozen=True)
class MetricRow:
    """One parametrisation of a metric.

    Attributes:
        name: what distinguishes it from the plugin's other rows.
        target: what is predicted; a metric that reads images sees a ball there (`framework.testing.balls`).
        fields: further fields of a batch that it reads: number of samples → tensor with that first dimension.
        size: height and width of the images that are predicted, where it reads some.
        config, limits, leave_out: as in HeadRow.
    """

    name: str
    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Callable[[int], Tensor]] = field(default_factory=dict)
    size: tuple[int, int] = (24, 32)
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class WrapperRow:
    """One parametrisation of an uncertainty wrapper.

    Attributes:
        name: what distinguishes it from the plugin's other rows.
        target: what is predicted.
        identity: parameters with which it must be the model it wraps, to the last bit ({"members": 1}); None where
            there are none.
        config, limits, leave_out: as in HeadRow.
    """

    name: str
    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] | None = None
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ObjectiveRow:
    """One parametrisation of an objective, on inputs that are vectors of `framework.testing.wrappers.LENGTH` numbers.

    Attributes:
        name: what distinguishes it from the plugin's other rows.
        target: what is predicted.
        fields: further fields of a batch that it reads: number of samples → tensor with that first dimension.
        config, limits, leave_out: as in HeadRow.
    """

    name: str
    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Callable[[int], Tensor]] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RendererRow:
    """One parametrisation of a renderer.

    Attributes:
        name: what distinguishes it from the plugin's other rows.
        config, limits, leave_out: as in HeadRow.
    """

    name: str
    config: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


Damage = Literal["missing", "empty", "cut", "garbage", "folder"]
"""What can happen to a file: it is gone, has no bytes, half of them, others, or a folder stands in its place."""
DAMAGES: tuple[Damage, ...] = ("missing", "empty", "cut", "garbage", "folder")


SAID_BY_ROWS: Mapping[str, str] = dict.fromkeys(
    (
        "synthetic is said",
        "damaged files are named",
        "files left out are counted",
        "own files",
        "damaged own files are named",
    ),
    "a rows.py has to say what is wanted",
)
"""What of a data set without rows cannot be checked, and why."""


@dataclass(frozen=True)
class DataRow:
    """One parametrisation of a data set, as small as it goes: it is prepared a dozen times.

    Attributes:
        name: what distinguishes it from the plugin's other rows.
        config, limits, leave_out: as in HeadRow.
        write: fills an empty folder with what the data set reads, the official layout where there is one, and returns
            the parameters that say where it is ({"root": ...}). None where data are generated.
        synthetic: what `Data.synthetic` has to say; None: anything.
        files: fills an empty folder with two or more files of a user's own, no two alike, for `Data.read`.
        fragile: pattern of files below what was written or generated → the damage to the first of them that `prepare`
            has to name. Half a list of names is a list of names: such damage nobody can see.
        skip: parameters that have files of the first of these patterns left out and counted where they cannot be read.
        changes: parameters each of which changes the samples, and with them the fingerprint.
    """

    name: str
    config: Mapping[str, Any] = field(default_factory=dict)
    write: Callable[[Path], Mapping[str, Any]] | None = None
    synthetic: bool | None = None
    files: Callable[[Path], Sequence[Path]] | None = None
    fragile: Mapping[str, Collection[Damage]] = field(default_factory=dict)
    skip: Mapping[str, Any] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)
