"""Rows of the contract: the parameters and references that a plugin states in its `rows.py` for the contract tests.

`rows.py` stands beside the module of the plugin's class, or for a family in a folder above it. Its `ROWS` is a
dictionary from the plugin's name to its rows, for example `HeadRow` for a density head. A plugin without rows is
checked with its default parameters and without a reference.
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
    """Stiff or extreme distribution parameters of a density head, with log-densities from an independent source.

    Attributes:
        name: What is extreme here: "κ = 1e12".
        raw: Distribution parameters, (batch, size) float64, each exactly representable in float32.
        value: Targets, (batch, *event), each exactly representable in float32; int64 for classes.
        log_prob: Log-density at `value`, (batch,) float64, nats, to full float64 accuracy.
    """

    name: str
    raw: Tensor
    value: Tensor
    log_prob: Tensor


@dataclass(frozen=True)
class HeadRow:
    """Parametrisation of a density head.

    Attributes:
        name: What distinguishes the row from the plugin's other rows.
        target: Target that the head predicts.
        config: Parameters of the head.
        cases: Function from a built head (evaluation mode, float64) to reference cases; None where no reference is
            known.
        scale: Standard deviation of the normal distribution parameters at which densities of three numbers, and
            densities that draw, are integrated. It must make them broad enough for a grid. Other densities are also
            integrated at scales from 1e-2 to 1e3.
        limits: Property → limit, where it differs from the contract's own.
        leave_out: Property → reason why this density cannot have it.
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
    """Parametrisation of an encoder of vectors or of images with at most 3 channels; CloudRow is for point clouds.

    Attributes:
        name: What distinguishes the row from the plugin's other rows.
        input_shape: Shape of the input of one sample.
        config, limits, leave_out: See HeadRow.
        columns: Names of the last dimension of the input, as `Data.columns`.
        inputs: Function from a number of samples to inputs, for an encoder that does not accept arbitrary numbers.
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
    """Parametrisation of an encoder of point clouds.

    A cloud has shape (points, columns), with x, y, z in the first three columns. Such an encoder reads a set: its
    features depend neither on padding nor on the order of the points, and it must refuse malformed clouds with an error
    that names them.
    """


@dataclass(frozen=True)
class MetricRow:
    """Parametrisation of a metric.

    Attributes:
        name: What distinguishes the row from the plugin's other rows.
        target: Target that is predicted; a metric that reads images gets images of a ball (`framework.testing.balls`).
        fields: Further batch fields that the metric reads: name → function from a number of samples to a tensor with
            that first dimension.
        size: Height and width in pixels of the predicted images, where the metric reads some.
        config, limits, leave_out: See HeadRow.
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
    """Parametrisation of an uncertainty wrapper.

    Attributes:
        name: What distinguishes the row from the plugin's other rows.
        target: Target that is predicted.
        identity: Parameters with which the wrapper must equal the model that it wraps, to the last bit ({"members":
            1}); None where there are none.
        config, limits, leave_out: See HeadRow.
    """

    name: str
    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] | None = None
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ObjectiveRow:
    """Parametrisation of an objective; the inputs are vectors of `framework.testing.wrappers.LENGTH` numbers.

    Attributes:
        name: What distinguishes the row from the plugin's other rows.
        target: Target that is predicted.
        fields: Further batch fields that the objective reads: name → function from a number of samples to a tensor with
            that first dimension.
        config, limits, leave_out: See HeadRow.
    """

    name: str
    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Callable[[int], Tensor]] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RendererRow:
    """Parametrisation of a renderer.

    Attributes:
        name: What distinguishes the row from the plugin's other rows.
        config, limits, leave_out: See HeadRow.
    """

    name: str
    config: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    leave_out: Mapping[str, str] = field(default_factory=dict)


Damage = Literal["missing", "empty", "cut", "garbage", "folder"]
"""Damage to a file: it is removed, emptied, cut in half, filled with other bytes, or replaced by a folder."""
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
"""Properties that cannot be checked of a data set without rows, and the reason."""


@dataclass(frozen=True)
class DataRow:
    """Parametrisation of a data set, as small as possible, because it is prepared a dozen times.

    Attributes:
        name: What distinguishes the row from the plugin's other rows.
        config, limits, leave_out: See HeadRow.
        write: Function that fills an empty folder with the files that the data set reads, in the official layout where
            there is one, and returns the parameters that locate them ({"root": ...}). None where data are generated.
        synthetic: Value that `Data.synthetic` must have; None accepts any.
        files: Function that fills an empty folder with two or more user files for `Data.read`, no two of them equal.
        fragile: Pattern of written or generated files → kinds of damage to the first match that `prepare` must report
            by name. Leave out damage that cannot be detected: half of a list of names is still a list of names.
        skip: Parameters with which unreadable files of the first pattern are left out and counted.
        changes: Parameters that each change the samples, and therefore the fingerprint.
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
