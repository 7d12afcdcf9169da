"""Base class of the data sets of labelled clouds: splits, fingerprint, and image of a cloud."""

import hashlib
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
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
from framework.datasets.class_folders import FileList
from framework.errors import DataError, count_of, shorten
from framework.geometry import meshes
from framework.geometry.meshes import READERS
from framework.storage.names import as_bytes
from framework.target import Target
from plugins.data.labelled_clouds.reading import Clouds, Packed, Reading, load_files, load_unlabelled
from plugins.data.labelled_clouds.rotated import Rotated

Unreadable = Literal["error", "skip"]


class CloudSet(NamedTuple):
    """All clouds of a data set, with their classes and splits.

    Attributes:
        source: Source of the clouds, for messages.
        description: Entries of the fingerprint besides sizes, names, labels and splits.
        classes: Names of the classes as `spell_name` returns them, in the order of the labels.
        packed: The clouds.
        labels: Class of each cloud.
        names: Name of each cloud.
        splits: Name of the split of each cloud.
        fields: Further fields of each cloud.
        skipped: Number of files that could not be read.
        synthetic: Whether the clouds were generated.
        validated_on: Name of the split whose clouds are used for validation.
        rotations: Number of copies of a training cloud, rotated about the up axis.
        remarks: Clauses about parts of the user's files that are not read.
        needed: Names of the splits that must not be empty.
    """

    source: str
    description: Mapping[str, str]
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
    needed: tuple[str, ...] = Splits._fields


class LabelledClouds(Data):
    """Base class of data sets of labelled clouds; a data set adds its constructor, its citation, and `load_clouds`."""

    suffixes = tuple(READERS)
    varies = False
    reading: Reading
    """Settings for turning files into clouds."""

    @abstractmethod
    def load_clouds(self) -> CloudSet:
        """Return all clouds, read from files.

        Raises:
            DataError: The clouds cannot be read, for one of the reasons that `prepare` lists.
        """

    def prepare(self) -> None:
        cloud_set = self.load_clouds()
        self.target = Target("class", cloud_set.classes)
        self.input_shape = (cloud_set.packed.largest(), len(self.columns))
        self.synthetic, self.skipped = cloud_set.synthetic, cloud_set.skipped
        self.remarks = cloud_set.remarks
        clouds = split_clouds(cloud_set)
        train = clouds["train"]
        if cloud_set.rotations > 1:
            train = Rotated(train, cloud_set.rotations)
        self._splits = Splits(train, clouds["validation"], clouds["test"])
        self._fingerprint = {
            **cloud_set.description,
            **{name: str(len(split)) for name, split in clouds.items()},
            "sha256": digest(cloud_set.names, cloud_set.labels.tolist(), cloud_set.splits.tolist()),
        }

    def splits(self) -> Splits:
        return self._splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return load_unlabelled(files, self.reading)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return self._fingerprint

    def preview(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.draw_cloud(inputs, self.columns)


def load_listed(
    listed: FileList,
    root: Path,
    reading: Reading,
    cache_folder: str,
    unreadable: Unreadable,
    remedy: str | None = None,
) -> tuple[FileList, Packed, tuple[str, ...]]:
    """Return the list of the files that could be read, their clouds, and a hash of the content of each file.

    Args:
        listed: The files.
        root: Folder to which the names of the files are relative.
        reading: Settings for turning files into clouds.
        cache_folder: Name of the cache folder that stores the clouds.
        unreadable: Treatment of files that cannot be read.
        remedy: Advice in the message about files that cannot be read; None: to correct them or to leave them out.

    Raises:
        DataError: Some files cannot be read and are not to be skipped.
    """
    loaded = load_files(listed.files, root, reading, cache_folder)
    if loaded.faults and unreadable == "error":
        total = len(listed.files)
        advice = remedy or images.advise_unreadable(loaded.faults, total, "data.unreadable=skip")
        raise DataError(images.fault_message(loaded.faults, total, advice))
    return listed.select(loaded.good), loaded.packed, loaded.hashes


def describe_unread(listed: FileList, reading: Reading) -> tuple[str, ...]:
    """Return clauses for a message that say which parts of the user's files are not read.

    The clauses name the number of files of other kinds, and the columns of the first file that are not read. If the
    first file is a mesh, a clause says that points are drawn from its faces.
    """
    remarks = []
    if listed.ignored:
        remarks.append(f"left out: {count_of(listed.ignored, 'file')} of other kinds")
    if listed.files:
        mesh = meshes.read(listed.files[0])
        unread = [name for name in mesh.columns if name not in reading.columns]
        if unread:
            remarks.append(
                f"left out: the columns {shorten(', '.join(unread))} of {listed.files[0].name}; list them in "
                "data.columns to read them"
            )
        if len(mesh.faces):
            remarks.append(f"points are drawn from the faces of {listed.files[0].name}")
    return tuple(remarks)


def split_clouds(cloud_set: CloudSet) -> dict[str, Clouds]:
    """Return the clouds of each split, with "target", "group" (the same for all clouds) and the further fields.

    Raises:
        DataError: A split is empty.
    """
    clouds = {}
    for name in Splits._fields:
        source = cloud_set.validated_on if name == "validation" else name
        chosen = np.flatnonzero(cloud_set.splits == source)
        fields = {key: values[torch.from_numpy(chosen)] for key, values in cloud_set.fields.items()}
        target = torch.from_numpy(cloud_set.labels[chosen])
        group = torch.zeros(len(chosen), dtype=torch.int64)
        clouds[name] = Clouds(cloud_set.packed, chosen, target=target, group=group, **fields)
    sizes = {name: len(split) for name, split in clouds.items()}
    require_samples(sizes, cloud_set.source, cloud_set.needed)
    return clouds


def require_samples(sizes: Mapping[str, int], source: str, needed: Collection[str] = Splits._fields) -> None:
    """Refuse an empty split.

    Args:
        sizes: Name of a split → number of its samples.
        source: Source of the clouds, for the message.
        needed: Names of the splits that must not be empty.

    Raises:
        DataError: A split is empty.
    """
    for split, size in sizes.items():
        if size == 0 and split in needed:
            counts = ", ".join(f"{name} {number}" for name, number in sizes.items())
            raise DataError(
                f"{source}: The {split} split is empty ({counts}). At least one sample of each class is used for "
                "training. Add files, or change the shares."
            )


def digest(names: Sequence[str], labels: Sequence[int], splits: Sequence[str]) -> str:
    """Return a hash of names, labels and splits."""
    lines = (f"{split} {label} {name}\n" for name, label, split in zip(names, labels, splits, strict=True))
    return hashlib.sha256(as_bytes("".join(lines))).hexdigest()
