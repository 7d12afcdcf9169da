"""The contract of a data set: named, labelled samples for training, validation and test."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from framework.errors import DataError
from framework.target import Target

Batch = dict[str, Tensor]
"""Named fields of a batch; the first dimension of each counts the samples.

Every batch has "input", "index" (int64, the number of the sample in its split) and, where samples are labelled,
"target" (radians for angles) and "group" (int64, an index into `Data.groups`). A plugin may add fields, which its
README describes.

"symmetry", int64, is optional. A data set sets it if it knows the symmetry of an object, for example of a generated
one. The figures of densities read it. The value n means that the object looks the same after a rotation by 360°/n about
its vertical axis, so that n values of the first angle are equally right. 1 means no symmetry, and so does a missing
field. 0 means that the object looks the same after every rotation, so that it has no direction.

"color", "mask" and "depth" are optional too. They hold the true image in the layout of
`framework.renderer.Renderer.channels`, and metrics of images read them.
"""


class Frame(NamedTuple):
    """Affine map from the targets of a batch to the user's unit: location + scale · target.

    Attributes:
        location: (batch, number).
        scale: (batch, number), above 0.
    """

    location: Tensor
    scale: Tensor


class Splits(NamedTuple):
    """The three splits of a data set; no sample is in two of them.

    Attributes:
        train: samples for training.
        validation: samples for early stopping and calibration; training does not see them.
        test: samples for the test stage only.
    """

    train: Dataset[Batch]
    validation: Dataset[Batch]
    test: Dataset[Batch]


class Preprocessing(NamedTuple):
    """Computation of an exported model before its first layer.

    Attributes:
        module: module from a user's arrays, (batch, *input_shape) float64, to the model's inputs.
        location: mean of a typical array, of the shape `input_shape`; `mode=export` compares the exported model with
            the original one on arrays around it.
        scale: standard deviation of a typical array, of the shape `input_shape`.
        missing: words, in small letters, that mark a missing number in a table, if `module` fills NaN; None if it does
            not.
        ranges: smallest and largest number of each column in the training rows, (2, *input_shape), in the unit of the
            user's arrays; the exported model names rows far outside. None if the ranges are not known.
    """

    module: nn.Module
    location: Tensor
    scale: Tensor
    missing: tuple[str, ...] | None = None
    ranges: Tensor | None = None


class Data(ABC):
    """A data set with three splits. The framework handles order, batching, workers and resuming.

    The constructor only keeps its keyword-only parameters (the config) and reads nothing. The framework calls `prepare`
    once before it uses the splits. After this call all attributes below are set. Methods that work without `prepare`
    say so. Bad input raises a DataError that says which file is bad, what was expected and what to do. A sample that
    cannot be read is never replaced silently.

    A data set that cannot be shipped may be generated. Its generator writes the official layout to the cache
    (`framework.storage.cache.folder`), and the same loader reads it. `synthetic` is then True, and the framework says
    so beside every number and figure that comes from it.
    """

    group: ClassVar[str] = "data"
    bibtex: ClassVar[str]
    """Citation of the data set: BibTeX entries, or their keys in the `references.bib` of the package; "" for none."""
    target: Target
    """Description of the predicted quantity."""
    input_shape: tuple[int, ...]
    """Shape of one input, without the batch dimension; for point clouds (points, columns) of the largest cloud."""
    suffixes: tuple[str, ...] = ()
    """Suffixes, in lower case, of the files that `read` reads. () allows every suffix.

    A folder may hold other files beside them.
    """
    companions: tuple[str, ...] = ()
    """Endings, in lower case, of files that are read along with another file and hold no samples themselves."""
    columns: tuple[str, ...] = ()
    """Names of the numbers in the last dimension of an input, if they have names: ("x", "y", "z", "red", ...)."""
    plane: bool = False
    """True if an input is two numbers, a point in a plane.

    A figure can then show the class probabilities over the plane.
    """
    varies: bool = True
    """True if `augment` may change a batch."""
    title: str = ""
    """Name of the data in figures and tables.

    If it is empty, figures and tables show the name of the only group or, if there are several, the plugin's name.
    """
    directions: tuple[str, ...] = ()
    """Words for 0°, 90°, 180° and 270° of the first angle, if that angle is the direction from which an object is seen.

    The directions count counter-clockwise as seen from above. Figures of other angles show degrees.
    """
    groups: tuple[str, ...]
    """Names of the groups for which results are also reported separately, such as object classes.

    If there is only one group, there is one name.
    """
    synthetic: bool
    """True if the samples were generated."""
    skipped: int = 0
    """Number of samples that were left out because they could not be read (only if the config allows this)."""
    remarks: tuple[str, ...] = ()
    """Clauses about parts of the user's files that are not read or look odd, such as "left out: 'note' (words)".

    `prepare` sets them, and the first lines of a run print them.
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        # Plugins written before `splits` existed have one method per split, named like it.
        if "splits" not in vars(cls) and all(callable(getattr(cls, name, None)) for name in Splits._fields):
            cls.splits = _from_three_methods  # type: ignore[method-assign]
        super().__init_subclass__(**keywords)

    @abstractmethod
    def prepare(self) -> None:
        """Find or generate the data, check its layout, and read what is needed to set the attributes.

        Raises:
            DataError: the root is missing, the layout is wrong, a file is unreadable, a label is not finite, or a split
                is empty. For an unreadable file, the message names the setting that leaves such files out, if there is
                one.
        """

    def check_files(self) -> None:
        """Check, as far as is possible in a few seconds, that `prepare` can read a user's own files.

        A sweep calls it before its jobs start. The default only checks that the path in `root` exists, if the data set
        has a setting of this name: if it does not, it calls `prepare`, which raises an error at once. Data sets without
        a given `root` may be generated by `prepare`, which takes longer.

        Raises:
            DataError: a file is missing or wrong; the message says what to do.
        """
        root = getattr(self, "root", None)
        if root is not None and not Path(root).expanduser().exists():
            self.prepare()

    @abstractmethod
    def splits(self) -> Splits:
        """Return the three splits.

        Items are dicts of tensors without a batch dimension. A dataset that can fetch many items at once
        also has `__getitems__(indices) -> Batch`, which returns them as a batch (framework.datasets.fields).
        """

    @abstractmethod
    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        """Return the unlabelled samples of a user's own files, with "input" and "index" only, for `mode=predict`.

        This method works without `prepare`.

        Raises:
            DataError: there is no file, or a file cannot be read; the message names that file.
        """

    def inputs(self, user_data: Any) -> Tensor:
        """Return the data that a user gives to a trained model, as a batch of inputs; works without `prepare`.

        The default calls `read` on files, and takes an array of inputs, or of one input, as it is. A data set overrides
        this method if it scales its inputs, or if its users have another format at hand (a table, an image).

        Raises:
            DataError: `user_data` is neither files nor an array of inputs, or the array has another shape.
        """
        files = [user_data] if isinstance(user_data, str | Path) else user_data
        if isinstance(files, Sequence) and files and all(isinstance(item, str | Path) for item in files):
            dataset = self.read([Path(item) for item in files])
            items = [dataset[index]["input"] for index in range(len(dataset))]  # type: ignore[arg-type]
            if len({item.shape for item in items}) > 1:
                raise DataError(
                    "The files hold inputs of different sizes, but a batch needs inputs of one size. Give the files "
                    "one by one."
                )
            return torch.stack(items)
        return as_inputs(user_data, self.input_shape)

    def user_batch(self, user_data: Any) -> Batch:
        """Return the data that a user gives to a trained model, as a batch: "input", and the fields that `frame` reads.

        Raises:
            DataError: `inputs` refuses `user_data`.
        """
        return {"input": self.inputs(user_data)}

    def frame(self, batch: Batch) -> Frame | None:
        """Return the affine map (`Frame`) that converts targets and predictions of a batch to the user's unit.

        A data set of real targets overrides this if the origin and the unit of each target depend on its input, for
        example on the centre and the size of a point cloud. The default, None, means that targets are in the user's
        unit.
        """
        return None

    def preprocessing(self) -> Preprocessing | None:
        """Return the computation by which `inputs` converts an array, for `mode=export`; works without `prepare`.

        A data set whose `inputs` changes the numbers of an array (standardises them, for example) overrides this. The
        default, None, means that arrays are the model's inputs as they are.
        """
        return None

    def state_dict(self) -> Mapping[str, Any]:
        """Return the state that `inputs` and `read` need in addition to the config, as plain values and tensors.

        The state is stored in the checkpoint of a model that is trained on these data.
        """
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Set the state of the data on which a model was trained, as `state_dict` returned it.

        Afterwards `inputs`, `read` and `prepare` give inputs in the form that this model reads.

        Raises:
            DataError: the state belongs to another kind of data.
        """
        if state:
            raise DataError(
                f"{type(self).__name__} has no stored state, but the model's data set has stored {', '.join(state)}. "
                "Give the data that the model was trained on."
            )

    @abstractmethod
    def augment(self, batch: Batch) -> Batch:
        """Return a training batch with random variations, on the batch's device; without variations, the batch itself.

        Random numbers come from torch's global generator. The framework seeds it by (seed, step) before the call, so
        that a resumed run sees the same variations. A variation that changes the target (a mirror) changes "target"
        too.
        """

    @abstractmethod
    def fingerprint(self) -> Mapping[str, str]:
        """Return entries that identify the data: root, version, samples per split, and a hash of names and labels."""

    @abstractmethod
    def preview(self, inputs: Tensor) -> np.ndarray:
        """Return an image of one input for a person to look at, (height, width, 3) uint8."""


class Mapped(ABC):
    """Additional base class of a data set in which one file gives many samples, whose predictions form maps.

    An example is a data set whose samples are the voxels of a volume.
    """

    @abstractmethod
    def write_maps(self, file: Path, point: Tensor, deviation: Tensor, folder: Path) -> Sequence[Path]:
        """Write maps of the predictions for one file and return the files written.

        `mode=predict` calls it after `read`.

        Args:
            file: the user's file.
            point: (sample, number), point predictions for the samples of the file in the order of `read`, in the
                target's unit.
            deviation: (sample, number), standard deviations of the predicted densities, in the same unit.
            folder: folder for the maps; it exists, and may hold maps of other files.
        """


def shape_fits(shape: tuple[int, ...], expected: tuple[int, ...]) -> bool:
    """Return whether an input has the expected shape; a cloud, (points, columns), may have fewer points."""
    if len(expected) == 2 and len(shape) == 2:
        return 0 < shape[0] <= expected[0] and shape[1] == expected[1]
    return shape == expected


def as_inputs(user_data: Any, shape: tuple[int, ...]) -> Tensor:
    """Return an array, or an object that NumPy can convert to an array, as a batch of inputs of `shape`.

    One input becomes a batch of one. Clouds, of shape (points, columns), may have any number of points.

    Raises:
        DataError: `user_data` is not an array of numbers, or has another shape.
    """
    expected_shape = (
        "×".join(["any number", str(shape[-1])] if len(shape) == 2 else map(str, shape)) or "one number"
    )
    try:
        inputs = (
            user_data
            if isinstance(user_data, Tensor)
            else torch.from_numpy(np.require(user_data, requirements=["C", "W"]))
        )
    except (TypeError, ValueError) as error:
        raise DataError(
            f"Got an object of type {type(user_data).__name__}, but the model reads files or an array of inputs of "
            f"shape {expected_shape}. Give one of these."
        ) from error
    if inputs.is_complex():
        raise DataError(
            "Got complex numbers, but the model reads real numbers. Give their magnitudes, for example."
        )
    if inputs.dim() == len(shape):
        inputs = inputs[None]
    fixed = shape[1:] if len(shape) == 2 else shape
    if inputs.dim() != len(shape) + 1 or tuple(inputs.shape[inputs.dim() - len(fixed) :]) != tuple(fixed):
        raise DataError(
            f"Got an array of shape {'×'.join(map(str, inputs.shape))}, but the model reads inputs of shape "
            f"{expected_shape}. Give an array of shape (batch, {', '.join(map(str, shape))}), or one input."
        )
    return inputs


def _from_three_methods(data: Any) -> Splits:
    """Return the splits of a data set of an old plugin, which has one method for each split instead of `splits`."""
    return Splits(data.train(), data.validation(), data.test())
