"""Contract rows: the parameters with which a plugin is checked, and references for its results.

A plugin lists its rows in a file `rows.py` beside the module of its class, or in a folder above for a family of
plugins. There, `ROWS` is a dictionary from the name of a plugin to its rows, for example `HeadRow` for a density head.
A plugin without rows is checked with its default parameters and without a reference.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from framework.density_head import DensityHead
from framework.target import Target

CLASSES, ANGLE, REALS = (
    Target("class", ("a", "b", "c")),
    Target("angle", ("azimuth",)),
    Target("real", ("x", "y")),
)
"""One small target of each kind, for rows that need no particular target."""


@dataclass(frozen=True)
class Case:
    """Extreme distribution parameters of a density head, with log-densities from an independent source.

    Attributes:
        name: Description of what is extreme, for example "κ = 1e12".
        raw: Raw parameters, (batch, size) float64, each exactly representable in float32.
        value: Target values, (batch, *event), each exactly representable in float32; int64 for classes.
        log_prob: Log-density at `value`, (batch,) float64, nats, to full float64 accuracy.
    """

    name: str
    raw: Tensor
    value: Tensor
    log_prob: Tensor


@dataclass(frozen=True)
class Row:
    """Base class of contract rows, with the attributes that all rows have.

    Attributes:
        name: Description that distinguishes the row from the plugin's other rows.
        limits: Property → largest error that passes, where it differs from the default.
        leave_out: Property that is not checked → reason.
    """

    name: str
    limits: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    leave_out: Mapping[str, str] = field(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class HeadRow(Row):
    """Parameters with which a density head is checked.

    Attributes:
        target: Target that the head predicts.
        config: Parameters of the plugin.
        cases: Function from the head, in evaluation mode and float64, to reference cases; None where no reference is
            known.
        values: Function from a number of samples to targets, (sample, *event), for a head whose density is 0 for some
            real numbers, such as a head of positive numbers. None: random real numbers, at which no density may be 0.
        scale: Standard deviation of random raw parameters. Densities of three numbers, and densities whose log_prob
            draws random numbers, are integrated only at this scale; it must make them broad enough for a grid, except
            if the three numbers are angles. All other densities are also integrated at scales from 1e-2 to 1e3.
    """

    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    cases: Callable[[DensityHead], Iterable[Case]] | None = None
    scale: float = 1.0
    values: Callable[[int], Tensor] | None = None


@dataclass(frozen=True)
class EncoderRow(Row):
    """Parameters with which an encoder of vectors, or of images of up to 3 channels, is checked; see also CloudRow.

    Attributes:
        input_shape: Shape of the input of one sample.
        config: Parameters of the plugin.
        columns: Names of the entries of the input's last dimension, as in `Data.columns`.
        inputs: Function from a number of samples to inputs, for an encoder that does not accept random numbers.
    """

    input_shape: tuple[int, ...]
    config: Mapping[str, Any] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    inputs: Callable[[int], Tensor] | None = None


@dataclass(frozen=True)
class CloudRow(EncoderRow):
    """Parameters with which an encoder of point clouds is checked.

    A cloud has shape (points, columns), with x, y, z in the first three columns. The features must depend neither on
    padding nor on the order of the points. The encoder must refuse a malformed cloud with an error that names it.
    """


@dataclass(frozen=True)
class MetricRow(Row):
    """Parameters with which a metric is checked.

    Attributes:
        target: Target of the predictions. A metric that reads images gets those of `framework.testing.balls`.
        fields: Further batch fields that the metric reads: name → function from a number of samples to a tensor with
            that first dimension.
        size: Height and width, pixels, of the predicted images, for a metric that reads images.
        config: Parameters of the plugin.
    """

    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Callable[[int], Tensor]] = field(default_factory=dict)
    size: tuple[int, int] = (24, 32)


@dataclass(frozen=True)
class WrapperRow(Row):
    """Parameters with which an uncertainty wrapper is checked.

    Attributes:
        target: Target of the wrapped model.
        identity: Parameters with which the wrapper must equal the wrapped model to the last bit, for example
            {"members": 1}; None where there are none.
        config: Parameters of the plugin.
    """

    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class ObjectiveRow(Row):
    """Parameters with which an objective is checked; inputs are vectors of `framework.testing.plain.LENGTH` numbers.

    Attributes:
        target: Target of the predictor.
        fields: Further batch fields that the objective reads: name → function from a number of samples to a tensor with
            that first dimension.
        config: Parameters of the plugin.
    """

    target: Target
    config: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Callable[[int], Tensor]] = field(default_factory=dict)


@dataclass(frozen=True)
class RendererRow(Row):
    """Parameters with which a renderer is checked.

    Attributes:
        config: Parameters of the plugin.
    """

    config: Mapping[str, Any] = field(default_factory=dict)


Damage = Literal["missing", "empty", "cut", "garbage", "folder"]
"""Damage to a file: it is removed, emptied, cut in half, filled with random bytes, or replaced by a folder."""
DAMAGES: tuple[Damage, ...] = ("missing", "empty", "cut", "garbage", "folder")
"""Every kind of damage."""


NEEDS_ROWS: Mapping[str, str] = dict.fromkeys(
    (
        "synthetic is stated",
        "damaged files are named",
        "files left out are counted",
        "own files",
        "damaged own files are named",
    ),
    "only a rows.py can state the expected result",
)
"""Property of a data set that cannot be checked without a `rows.py` → reason."""


@dataclass(frozen=True)
class DataRow(Row):
    """Parameters with which a data set is checked. It should be small, because it is prepared a dozen times.

    Attributes:
        config: Parameters of the plugin.
        write: Function that writes the files of the data set to an empty folder, in the official layout if there is
            one. It returns the parameters that locate the files, for example {"root": ...}. None for generated data.
        synthetic: Value that `Data.synthetic` must have; None accepts any.
        files: Function that writes two or more different user files for `Data.read` to an empty folder, and returns
            their paths.
        fragile: Glob pattern → kinds of damage. After each damage to the first file that matches the pattern, `prepare`
            must raise an error that names the file. Leave out damage that cannot be detected: for example, half of a
            list of names is still a list of names.
        skip: Parameters with which the data set skips and counts unreadable files. One file of the first pattern in
            `fragile` is made unreadable for this check. Without these parameters, the error must name each of them,
            such as `data.unreadable=skip`.
        changes: Parameters, each with a value that changes the samples and therefore the fingerprint.
    """

    config: Mapping[str, Any] = field(default_factory=dict)
    write: Callable[[Path], Mapping[str, Any]] | None = None
    synthetic: bool | None = None
    files: Callable[[Path], Sequence[Path]] | None = None
    fragile: Mapping[str, Collection[Damage]] = field(default_factory=dict)
    skip: Mapping[str, Any] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)
