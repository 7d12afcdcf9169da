"""The contract of a data set: named, labelled samples for training, validation and test."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from framework.errors import DataError
from framework.target import Target

Batch = dict[str, Tensor]
"""Named fields of a batch, first dimension the samples: "input"; "target" (radians for angles); "index", int64, the
sample's number in its split; "group", int64 index into `Data.groups`; and what a plugin adds, said in its README.

Optional is "symmetry", int64, set by a data set that knows it (generated objects, say) and read by the pictures of
densities: n where the object looks the same after 1/n of a turn about its vertical axis, so that n values of the
first angle are equally right; 1 where none is, as where the field is missing; 0 where any turn looks the same, so that
there is no direction.

Optional are "color", "mask" and "depth" too: the true image, laid out as `framework.renderer.Renderer.channels` says,
read by metrics of images."""


class Frame(NamedTuple):
    """Where the targets of some samples lie: the user's own numbers are location + scale · target.

    Attributes:
        location: (batch, number).
        scale: (batch, number), above 0.
    """

    location: Tensor
    scale: Tensor


class Splits(NamedTuple):
    """The splits of a data set; disjoint.

    Attributes:
        train: what is trained on.
        validation: early stopping and calibration see it, training does not.
        test: seen by nothing but the test stage.
    """

    train: Dataset[Batch]
    validation: Dataset[Batch]
    test: Dataset[Batch]


class Data(ABC):
    """Gives the three splits of a data set; order, batching, workers and resuming are the framework's.

    The constructor only keeps its keyword-only parameters (the config): it reads nothing. `prepare` does the work
    and is called once before anything but `read`; after it all attributes below are set. Bad input raises a DataError
    that says which file, what was wanted and what to do; a sample that cannot be read is never replaced silently.

    A data set that cannot be shipped may be generated: its generator writes the official layout to the cache
    (`framework.storage.cache.folder`) and the same loader reads it; `synthetic` is then True, and the framework says so
    wherever a number or picture made from it appears.
    """

    group: ClassVar[str] = "data"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""
    target: Target
    """What is to be predicted."""
    input_shape: tuple[int, ...]
    """Shape of one input, without the batch dimension; of point clouds (points, columns), of the largest of them."""
    suffixes: tuple[str, ...] = ()
    """Of the files that `read` reads, in small letters, so that others may lie beside them; () where any may be one."""
    companions: tuple[str, ...] = ()
    """How the names of files end that are read along with another one and hold no samples, in small letters."""
    columns: tuple[str, ...] = ()
    """What the numbers of an input's last dimension are called, where they have names: ("x", "y", "z", "red", ...)."""
    plane: bool = False
    """Whether an input is two numbers, a place in a plane, over which what a classifier says can be drawn."""
    varies: bool = True
    """Whether `augment` may change a batch."""
    title: str = ""
    """What pictures and tables call the data; where empty its only group, or else the plugin's name."""
    directions: tuple[str, ...] = ()
    """Where the first angle says from where an object is seen: words for 0°, 90°, 180° and 270°, seen from above
    counter-clockwise. Pictures of other angles show degrees."""
    groups: tuple[str, ...]
    """Names by which results are also reported apart (object classes, say); one name where there is one."""
    synthetic: bool
    """Whether the samples were generated."""
    skipped: int = 0
    """How many samples were left out because they could not be read (only when the config allows it)."""
    remarks: tuple[str, ...] = ()
    """What is not read of the user's files, and what looks odd in them, for the first lines of a run: clauses such as
    "left out: 'note' (words)". Set by `prepare`."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        # plugins written before `splits` have three methods of the splits' names
        if "splits" not in vars(cls) and all(callable(getattr(cls, name, None)) for name in Splits._fields):
            cls.splits = _from_three_methods  # type: ignore[method-assign]
        super().__init_subclass__(**keywords)

    @abstractmethod
    def prepare(self) -> None:
        """Find or generate the data, check its layout, read what is needed to set the attributes.

        Raises:
            DataError: a missing root, a wrong layout, an unreadable file, a label that is not finite, an empty split.
        """

    def check_files(self) -> None:  # noqa: B027 - most data have nothing to look at
        """Look whether a user's own files are as `prepare` wants them, as far as that takes seconds.

        A sweep asks before its jobs start. By default nothing is looked at.

        Raises:
            DataError: as `prepare`.
        """

    @abstractmethod
    def splits(self) -> Splits:
        """The three splits. Items are dicts of tensors without batch dimension; a dataset that can fetch many items
        faster at once also has `__getitems__(indices) -> Batch`, already batched (framework.datasets.fields)."""

    @abstractmethod
    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        """Unlabelled samples from a user's own files, for `mode=predict`: "input" and "index" only. Needs no `prepare`.

        Raises:
            DataError: there is no file, or one cannot be read; names it.
        """

    def inputs(self, given: Any) -> Tensor:
        """What a user gives a trained model, as a batch of inputs; needs no `prepare`.

        By default files are `read`, and an array of inputs, or of one input, is taken as it is. A data set that scales
        its inputs, or whose users have something else at hand (a table, an image), says so here.

        Raises:
            DataError: it is none of these, or of another shape.
        """
        files = [given] if isinstance(given, str | Path) else given
        if isinstance(files, Sequence) and files and all(isinstance(item, str | Path) for item in files):
            dataset = self.read([Path(item) for item in files])
            items = [dataset[index]["input"] for index in range(len(dataset))]  # type: ignore[arg-type]
            if len({item.shape for item in items}) > 1:
                raise DataError("These files give inputs of different sizes. Give them one by one.")
            return torch.stack(items)
        return as_inputs(given, self.input_shape)

    def asked(self, given: Any) -> Batch:
        """What a user gives a trained model, with whatever `frame` reads beside "input". Raises as `inputs`."""
        return {"input": self.inputs(given)}

    def frame(self, batch: Batch) -> Frame | None:
        """Of samples whose target of reals lies in a frame of the input's own (a normalised cloud's), so that answers
        can be given in the user's; None, the default, where targets are in the user's own unit."""
        return None

    def state_dict(self) -> Mapping[str, Any]:
        """What `inputs` and `read` need beside the config, as plain values and tensors: it travels with the model."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take that of a model's training data; `prepare` after it makes inputs as that model reads them.

        Raises:
            DataError: it belongs to another kind of data.
        """
        if state:
            raise DataError(
                f"{type(self).__name__} keeps nothing beside its config, but was given {', '.join(state)}. Give the "
                "data that the model was trained on."
            )

    @abstractmethod
    def augment(self, batch: Batch) -> Batch:
        """A training batch, randomly varied, on whatever device it is; or the batch itself.

        Random numbers come from torch's global generator, which the framework seeds by (seed, step) before the call,
        so that a resumed run sees the same variations. What changes the target (a mirror) changes it too.
        """

    @abstractmethod
    def fingerprint(self) -> Mapping[str, str]:
        """What identifies the data: root, version, number of samples a split, a hash over names and labels."""

    @abstractmethod
    def picture(self, inputs: Tensor) -> np.ndarray:
        """One input as a person would see it: (height, width, 3) uint8."""


class Mapped(ABC):
    """What a data set derives from as well when the samples of one file are places (a volume's voxels), of which people
    want maps."""

    @abstractmethod
    def write_maps(self, file: Path, point: Tensor, deviation: Tensor, folder: Path) -> Sequence[Path]:
        """Write what is predicted for one file; called by `mode=predict`, after `read`. The files it wrote.

        Args:
            file: the user's.
            point, deviation: (sample, number) of its samples in the order of `read`, in the target's unit: what is
                predicted, and its standard deviation.
            folder: where to write; exists, and others' maps may be there.
        """


def as_inputs(given: Any, shape: tuple[int, ...]) -> Tensor:
    """An array, or whatever NumPy makes one of, as a batch of inputs of `shape`; one input becomes a batch of one.

    Clouds, of shape (points, columns), may have any number of points.

    Raises:
        DataError: it is no array of numbers, or of another shape.
    """
    wanted = "×".join(["any number", str(shape[-1])] if len(shape) == 2 else map(str, shape)) or "one number"
    try:
        found = (
            given
            if isinstance(given, Tensor)
            else torch.from_numpy(np.require(given, requirements=["C", "W"]))
        )
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{type(given).__name__} is no input of this model; wanted an array of inputs of shape {wanted}, or files."
        ) from error
    if found.is_complex():
        raise DataError(
            "complex numbers are no input of this model; wanted real ones. Give their magnitudes, say."
        )
    if found.dim() == len(shape):
        found = found[None]
    fixed = shape[1:] if len(shape) == 2 else shape
    if found.dim() != len(shape) + 1 or tuple(found.shape[found.dim() - len(fixed) :]) != tuple(fixed):
        raise DataError(
            f"an array of shape {'×'.join(map(str, found.shape))} is no batch of inputs of shape {wanted}; give "
            f"(batch, {', '.join(map(str, shape))}), or one input."
        )
    return found


def _from_three_methods(data: Any) -> Splits:
    return Splits(data.train(), data.validation(), data.test())
