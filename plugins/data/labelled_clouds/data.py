"""Data sets ModelNet40, a user's own folders, and DALES; framework.data describes the contract."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from framework.configuration.paths import FilePath, Words
from framework.datasets.class_folders import FileList, describe_layouts, list_files
from framework.datasets.class_names import compare_classes, describe_dominant
from framework.datasets.new_files import (
    TestShare,
    Trained,
    are_all_for_test,
    describe_tested_share,
    index_labels,
    leave_out_trained,
    restore_trained,
)
from framework.datasets.shares import assign_folds, check_shares, choose_splits, hold_out
from framework.errors import DataError
from framework.geometry.mesh_files import NORMALS, XYZ
from framework.geometry.meshes import READERS, stream
from framework.storage.generated import read_mark
from framework.storage.names import spell_name
from plugins.data.labelled_clouds import folders
from plugins.data.labelled_clouds.archive import read_archive
from plugins.data.labelled_clouds.labelled_clouds import (
    CloudSet,
    LabelledClouds,
    Unreadable,
    describe_unread,
    load_listed,
)
from plugins.data.labelled_clouds.reading import Packed, Reading, round_to_float32, subsample
from plugins.data.labelled_clouds.shapes.generator import VERSION, Models, generate_models

FOLDS = 5
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Share = Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """Settings for drawing points from surfaces, uniformly by area.

    Attributes:
        points: Number of points drawn from each surface (thesis §6.5.1: 2048).
        normals: Whether to add the faces' normals as columns.
        data_seed: Seed of the points and of the validation split, independent of the seed of the run.
    """

    points: Annotated[int, Field(ge=1, le=1_000_000)] = 2048
    normals: bool = False
    data_seed: Seed = 0


class FoldersOfClouds(LabelledClouds):
    """Base class of clouds in folders, which stores by content the files that a model was trained on."""

    _trained: Trained | None = None
    _own = Trained()

    def state_dict(self) -> Mapping[str, Any]:
        return (self._trained or self._own).state()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._trained = restore_trained(state, type(self).__name__)


class ModelNet40(FoldersOfClouds):
    """CAD models of everyday objects, as points drawn from their surfaces, z up; generated if no root is given.

    The points of a mesh depend only on `data_seed` and the name of the file. They are drawn once and stored in the
    cache.

    Args:
        root: The unpacked ModelNet40; None for a generated set in the same layout and with the same 40 classes.
        surfaces: Settings for drawing points from the meshes.
        classes: Names of the classes to use; None for all.
        validation_share: Share of the official training split for validation, equal in every class. With 0 the whole
            split is used for training, as in the thesis, and validation uses training clouds too.
        rotations: Number of copies of each training cloud, rotated about the up axis in equal steps (thesis §6.5.1).
        unreadable: Treatment of files that cannot be read. "error" refuses them, "skip" leaves them out.
        models: Settings of the generated models.
    """

    bibtex = "wu2015modelnet"
    groups = ("modelnet40",)

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        surfaces: Surfaces,
        classes: list[str] | None = None,
        validation_share: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.15,
        rotations: Annotated[int, Field(ge=1, le=360)] = 1,
        unreadable: Unreadable = "error",
        models: Models,
    ) -> None:
        self.root = root
        self.models = models
        self.classes = classes
        self.reading = Reading(surfaces.points, NORMALS if surfaces.normals else (), surfaces.data_seed)
        self.columns = self.reading.all_columns
        self.unreadable: Unreadable = unreadable
        self.validation_share = validation_share
        self.rotations = rotations

    def check_files(self) -> None:
        if self.root is not None:
            root = Path(self.root).expanduser()
            folders.list_official(root, self.classes, test_only=self._trained is not None)

    def load_clouds(self) -> CloudSet:
        if self.root is None:
            root, name = generate_models(self.models), f"synthetic, seed {self.models.generator_seed}"
            remedy = {"remedy": f"Delete {root}; the models are then generated again."}
        else:
            root, name, remedy = Path(self.root).expanduser(), self.root, {}
        trained = self._trained
        listed = folders.list_official(root, self.classes, test_only=trained is not None)
        reading = replace(self.reading, surface=True)
        readable, packed, hashes = load_listed(
            listed, root, reading, "modelnet40/clouds", self.unreadable, **remedy
        )
        names = [spell_name(readable.classes[label]) for label in readable.labels]
        classes, labels = index_labels(names, trained, root)
        stated = readable.splits.copy()
        random = stream(self.reading.seed, "validation")
        hold_out(readable.splits, readable.labels, self.validation_share, random)
        content = packed.digest()
        splits, known = leave_out_trained(stated, readable.splits, hashes, trained, content, root)
        self._own = Trained.on(content, classes, hashes, splits)
        synthetic = read_mark(root) is not None
        return CloudSet(
            source=str(root),
            description={
                "root": name,
                "version": f"generator {VERSION}" if synthetic else "ModelNet40",
                "rotations": str(self.rotations),
                "points": f"{self.reading.points}, seed {self.reading.seed}",
            },
            classes=classes,
            packed=packed,
            labels=labels,
            names=[file.name for file in readable.files],
            splits=splits,
            skipped=len(listed.files) - len(readable.files),
            synthetic=synthetic,
            validated_on="validation" if self.validation_share else "train",
            rotations=self.rotations,
            remarks=known,
            needed=("train", "validation", "test") if trained is None else ("test",),
        )


class PointCloudFolder(FoldersOfClouds):
    """A user's own meshes and clouds in folders that are named by class; the target is the class.

    Points of meshes are drawn from their surfaces, uniformly by area. Clouds are used unchanged, each with its own
    number of points.

    Args:
        root: The folder.
        points: Number of points drawn from a mesh (None: 2048), and largest number of points read of a cloud (None:
            all).
        columns: Attributes to read in addition to x, y, z. "normal_x", "normal_y", "normal_z" of a mesh are the normals
            of its faces.
        validation: Share of the files for validation, equal in every class, if there are no folders of that split. With
            0 the training split is also used for validation: early stopping and calibration then use training data.
        test: Share of the files for the test, equal in every class, if there are no folders of that split; 1 makes all
            files test files, for a model that was trained on other files.
        centred: Whether to subtract each cloud's mean in float64 before the cloud is rounded to float32; map
            coordinates need this.
        unreadable: Treatment of files that cannot be read. "error" refuses them, "skip" leaves them out.
        data_seed: Seed of points and splits, independent of the seed of the run.
    """

    bibtex = "point_cloud_folder"
    groups = ("point_cloud_folder",)

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        points: Annotated[int, Field(ge=1, le=100_000_000)] | None = None,
        columns: list[Words] | None = None,
        validation: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.15,
        test: TestShare = 0.15,
        centred: bool = False,
        unreadable: Unreadable = "error",
        data_seed: Seed = 0,
    ) -> None:
        further_columns = tuple(name for name in dict.fromkeys(columns or ()) if name not in XYZ)
        self.root = root
        self.reading = Reading(points, further_columns, data_seed, centred)
        self.columns = self.reading.all_columns
        self.unreadable: Unreadable = unreadable
        self.shares = (validation, test)

    def check_files(self) -> None:
        self._list_files()

    def _list_files(self) -> tuple[Path, FileList]:
        """Return the folder and its files.

        Raises:
            DataError: The folder is missing or has another layout.
        """
        if self.root is None:
            raise DataError(f"data.root is not set. {describe_layouts(READERS)}")
        check_shares(*self.shares)
        root, trained = Path(self.root).expanduser(), self._trained
        return root, list_files(root, READERS, 2 if trained is None else 1, test_only=trained is not None)

    def load_clouds(self) -> CloudSet:
        root, listed = self._list_files()
        self.title = root.resolve().name
        trained = self._trained
        readable, packed, hashes = load_listed(
            listed, root, self.reading, "point_cloud_folder", self.unreadable
        )
        content = packed.digest()
        names = [spell_name(readable.classes[label]) for label in readable.labels]
        classes, labels = index_labels(names, trained, root)
        if are_all_for_test(readable.splits, self.shares[1], trained, content, root):
            splits = np.full(len(labels), "test")
        else:
            random = stream(self.reading.seed, "splits")
            splits = choose_splits(readable.splits, labels, *self.shares, random)
        splits, left_out = leave_out_trained(readable.splits, splits, hashes, trained, content, root)
        missing = set(range(len(classes))) - set(labels[splits == "train"].tolist())
        if missing and "train" in splits and trained is None:
            raise DataError(
                f"{root}: The class {classes[min(missing)]} has no training sample, but every class needs one. Add "
                "files."
            )
        self._own = Trained.on(content, classes, hashes, splits)
        return CloudSet(
            source=str(root),
            description={
                "root": str(self.root),
                "version": "point_cloud_folder 1",
                "columns": ", ".join(self.columns),
                "points": f"{self.reading.points}, seed {self.reading.seed}",
                "ignored": str(readable.ignored),
            },
            classes=classes,
            packed=packed,
            labels=labels,
            names=[file.relative_to(root).as_posix() for file in readable.files],
            splits=splits,
            skipped=len(listed.files) - len(readable.files),
            validated_on="validation" if self.shares[0] or "validation" in splits else "train",
            remarks=(
                *compare_classes(readable.classes, f"data.root = {root}"),
                *describe_unread(readable, self.reading),
                *describe_tested_share(readable.splits, splits, trained, content, root),
                *left_out,
                *describe_dominant(classes, labels[splits == "test"]),
            ),
            needed=("train", "validation", "test") if trained is None else ("test",),
        )


class Dales(LabelledClouds):
    """Buildings, cars, fences, poles and trees from airborne laser scans, 100 to 28,000 points each, metres.

    The objects are divided into five folds with equal shares of every class; one fold is the test split. A batch is
    padded to its largest cloud. Batches also hold "object", int64, the number of the object in the scans.

    Args:
        root: The archive.
        fold: Index of the fold that is the test split.
        points: Largest number of points that is read of an object; None for all.
        validation_share: Share of the other folds for validation, equal in every class.
        data_seed: Seed of the folds, of the validation split and of the points, independent of the seed of the run.
    """

    bibtex = "varney2020dales"
    groups = ("dales",)

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        fold: Annotated[int, Field(ge=0, lt=FOLDS)] = 0,
        points: Annotated[int, Field(ge=1, le=100_000_000)] | None = None,
        validation_share: Share = 0.15,
        data_seed: Seed = 0,
    ) -> None:
        self.root = root
        self.fold = fold
        self.reading = Reading(points, (), data_seed)
        self.columns = self.reading.all_columns
        self.validation_share = validation_share

    def check_files(self) -> None:
        read_archive(self.root)

    def load_clouds(self) -> CloudSet:
        archive = read_archive(self.root)
        seed, clouds = self.reading.seed, []
        for number, identity in enumerate(archive.identity):
            table = archive.points[archive.offset[number] : archive.offset[number + 1]]
            table = subsample(table, self.reading.points, stream(seed, f"object {identity}"))
            clouds.append(round_to_float32(table, f"{self.root}, object {number}", centred=False))
        in_test = assign_folds(archive.label, FOLDS, stream(seed, "folds")) == self.fold
        splits = np.where(in_test, "test", "train").astype("<U10")
        hold_out(splits, archive.label, self.validation_share, stream(seed, f"validation {self.fold}"))
        return CloudSet(
            source=str(self.root),
            description={
                "root": str(self.root),
                "version": "DALES objects",
                "fold": f"{self.fold} of {FOLDS}, seed {seed}",
                "points": str(self.reading.points or "all"),
            },
            classes=tuple(map(spell_name, archive.classes)),
            packed=Packed.of(clouds, 3),
            labels=archive.label,
            names=[str(number) for number in archive.identity],
            splits=splits,
            fields={"object": torch.from_numpy(archive.identity)},
        )
