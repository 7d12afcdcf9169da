"""Base class of the data sets of labelled clouds: splits, fingerprint and image from the clouds that were found."""

import hashlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.datasets import cloud_picture, images
from framework.errors import DataError, shorten
from framework.geometry import meshes
from framework.geometry.meshes import READERS
from framework.storage.names import as_bytes, spelled
from framework.target import Target
from plugins.data.labelled_clouds.folders import Listed
from plugins.data.labelled_clouds.reading import Clouds, Packed, Reading, load, unlabelled
from plugins.data.labelled_clouds.rotated import Rotated
from plugins.data.labelled_clouds.shares import spared

Unreadable = Literal["error", "skip"]


class Found(NamedTuple):
    """Clouds of a data set before they are split.

    Attributes:
        where: source of the clouds, for messages.
        about: entries of the fingerprint beside sizes, names, labels and splits.
        classes: names of the classes, in the order of the labels.
        packed: the clouds.
        labels: class of each cloud.
        names: name of each cloud.
        splits: name of the split of each cloud.
        fields: further fields of each cloud.
        skipped: number of files that could not be read.
        synthetic: whether the clouds were generated.
        validated_on: the split whose clouds are used for validation.
        rotations: number of copies of a training cloud, rotated about the up axis.
        remarks: sentences on what of the user's files is not read.
    """

    where: str
    about: Mapping[str, str]
    classes: tuple[str, ...]
    packed: Packed
    labels: Int[np.ndarray, "clouds"]
    names: Sequence[str]
    splits: NDArray
    fields: Mapping[str, Tensor] = {}
    skipped: int = 0
    synthetic: bool = False
    validated_on: str = "validation"
    rotations: int = 1
    remarks: tuple[str, ...] = ()


class LabelledClouds(Data):
    """Base class of data sets of clouds with classes; a data set adds its constructor, its citation, and `found`."""

    suffixes = tuple(READERS)
    varies = False
    reading: Reading
    """Settings for turning files into clouds."""

    @abstractmethod
    def found(self) -> Found:
        """Return all clouds, read from files.

        Raises:
            DataError: the clouds cannot be read, for the reasons of `prepare`.
        """

    def prepare(self) -> None:
        found = self.found()
        self.target = Target("class", tuple(map(spelled, found.classes)))
        self.input_shape = (found.packed.largest(), len(self.columns))
        self.synthetic, self.skipped, self.remarks = found.synthetic, found.skipped, found.remarks
        clouds = apart(found)
        train = clouds["train"]
        if found.rotations > 1:
            train = Rotated(train, found.rotations)
        self._splits = Splits(train, clouds["validation"], clouds["test"])
        self._fingerprint = {
            **found.about,
            **{name: str(len(some)) for name, some in clouds.items()},
            "sha256": digest(found.names, found.labels.tolist(), found.splits.tolist()),
        }

    def splits(self) -> Splits:
        return self._splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return unlabelled(files, self.reading)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return self._fingerprint

    def preview(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.draw_cloud(inputs, self.columns)


def loaded(
    listed: Listed,
    root: Path,
    how: Reading,
    place: str,
    unreadable: Unreadable,
    remedy: str = "Restore them, or set data.unreadable=skip to leave them out.",
) -> tuple[Listed, Packed]:
    """Return the files that could be read, and their clouds, from the cache folder `place` if they are there.

    Raises:
        DataError: some files cannot be read, and are not to be skipped.
    """
    found = load(listed.files, root, how, place)
    if found.faults and unreadable == "error":
        raise DataError(images.fault_message(found.faults, len(listed.files), remedy))
    return listed.only(found.good), found.packed


def unread(listed: Listed, how: Reading) -> tuple[str, ...]:
    """Return remarks on what is not read: files of other kinds, and unread columns of the first file."""
    said = []
    if listed.ignored:
        said.append(f"left out: {listed.ignored} files of other kinds")
    if listed.files:
        mesh = meshes.read(listed.files[0])
        others = [name for name in mesh.columns if name not in how.columns]
        if others:
            said.append(
                f"left out: the columns {shorten(', '.join(others))} of {listed.files[0].name}; data.columns reads them"
            )
        if len(mesh.faces):
            said.append(f"the faces of {listed.files[0].name} are read as points drawn from them")
    return tuple(said)


def hold_out(
    splits: NDArray,
    labels: Int[np.ndarray, "clouds"],
    share: float,
    random: np.random.Generator,
    name: str = "validation",
) -> None:
    """Rename the split of a share of the training clouds, equal in every class."""
    learned = np.flatnonzero(splits == "train")
    splits[learned[spared(labels[learned], share, random)]] = name


def apart(found: Found) -> dict[str, Clouds]:
    """Return the clouds of each split, with "target", "group" (one for all) and the further fields of each cloud.

    Raises:
        DataError: a split is empty.
    """
    clouds = {}
    for name in Splits._fields:
        chosen = np.flatnonzero(found.splits == (found.validated_on if name == "validation" else name))
        own = {key: values[torch.from_numpy(chosen)] for key, values in found.fields.items()}
        target, group = torch.from_numpy(found.labels[chosen]), torch.zeros(len(chosen), dtype=torch.int64)
        clouds[name] = Clouds(found.packed, chosen, target=target, group=group, **own)
    require_samples({name: len(some) for name, some in clouds.items()}, found.where)
    return clouds


def require_samples(sizes: Mapping[str, int], where: str) -> None:
    """Refuse an empty split.

    Raises:
        DataError: a split is empty; the message names it and says how many samples the others have.
    """
    for split, size in sizes.items():
        if size == 0:
            shown = ", ".join(f"{name} {number}" for name, number in sizes.items())
            raise DataError(
                f"{where}: the {split} split is empty ({shown}). A class keeps at least one sample for training: add "
                "files, or change the shares."
            )


def digest(names: Sequence[str], labels: Sequence[int], splits: Sequence[str]) -> str:
    """Return a hash of names, labels and splits."""
    lines = (f"{split} {label} {name}\n" for name, label, split in zip(names, labels, splits, strict=True))
    return hashlib.sha256(as_bytes("".join(lines))).hexdigest()
