"""Data sets ModelNet40, a user's own folders, and DALES; framework.data describes the contract."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field

from framework.configuration.paths import FilePath, Words
from framework.errors import DataError
from framework.geometry.mesh_files import NORMALS, XYZ
from framework.geometry.meshes import stream
from framework.storage.generated import read_mark
from plugins.data.labelled_clouds import folders
from plugins.data.labelled_clouds.archive import read_archive
from plugins.data.labelled_clouds.labelled_clouds import (
    Found,
    LabelledClouds,
    Unreadable,
    hold_out,
    loaded,
    unread,
)
from plugins.data.labelled_clouds.reading import Packed, Reading, rounded, subsampled
from plugins.data.labelled_clouds.shapes.generator import VERSION, Models, generated
from plugins.data.labelled_clouds.shares import folds

FOLDS = 5
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Share = Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """Settings for drawing points from surfaces, uniformly by area.

    Attributes:
        points: number of points of each surface (thesis §6.5.1: 2048).
        normals: whether to add the faces' normals as columns.
        data_seed: seed of the points and of the validation split; it does not depend on the seed of the run.
    """

    points: Annotated[int, Field(ge=1, le=1_000_000)] = 2048
    normals: bool = False
    data_seed: Seed = 0


class ModelNet40(LabelledClouds):
    """CAD models of everyday things as points of their surfaces, z up; generated where no root is given.

    The points of a mesh depend only on `data_seed` and its file's name. They are drawn once and kept in the cache.

    Args:
        root: the unpacked ModelNet40; None for a generated set in its layout, with its 40 classes.
        surfaces: how meshes become points.
        classes: names of the classes to use; None for all.
        validation_share: share of the official training split for validation, equal in every class. With 0 the whole
            split is used for training, as in the thesis, and validation results are then over training clouds.
        rotations: number of copies of each training cloud, rotated about the up axis in equal steps (thesis §6.5.1).
        unreadable: treatment of files that cannot be read: refuse or skip.
        models: settings of the generated models.
    """

    bibtex = """@inproceedings{wu2015modelnet,
  title = {{3D ShapeNets}: A Deep Representation for Volumetric Shapes},
  author = {Wu, Zhirong and Song, Shuran and Khosla, Aditya and Yu, Fisher and Zhang, Linguang and Tang, Xiaoou and
            Xiao, Jianxiong},
  booktitle = {IEEE Conference on Computer Vision and Pattern Recognition (CVPR)},
  pages = {1912--1920},
  year = {2015}
}"""
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

    def found(self) -> Found:
        if self.root is None:
            root, name = generated(self.models), f"synthetic, seed {self.models.generator_seed}"
            remedy = {"remedy": f"Delete {root}: the models are generated anew."}
        else:
            root, name, remedy = Path(self.root).expanduser(), self.root, {}
        listed = folders.official(root, self.classes)
        how, place = replace(self.reading, surface=True), "modelnet40/clouds"
        kept, packed = loaded(listed, root, how, place, self.unreadable, **remedy)
        hold_out(kept.splits, kept.labels, self.validation_share, stream(self.reading.seed, "validation"))
        synthetic = read_mark(root) is not None
        return Found(
            where=str(root),
            about={
                "root": name,
                "version": f"generator {VERSION}" if synthetic else "ModelNet40",
                "rotations": str(self.rotations),
                "points": f"{self.reading.points}, seed {self.reading.seed}",
            },
            classes=kept.classes,
            packed=packed,
            labels=kept.labels,
            names=[file.name for file in kept.files],
            splits=kept.splits,
            skipped=len(listed.files) - len(kept.files),
            synthetic=synthetic,
            validated_on="validation" if self.validation_share else "train",
            rotations=self.rotations,
        )


class PointCloudFolder(LabelledClouds):
    """Your own meshes and clouds, without writing code, in folders named by class; the class is predicted.

    Surfaces are sampled uniformly by area. Clouds are used as they are, each with its own number of points.

    Args:
        root: the folder.
        points: number of points drawn from a mesh (None: 2048), and largest number kept of a cloud (None: all).
        columns: attributes to read beside x, y, z. "normal_x", "normal_y", "normal_z" of a mesh are its faces' normals.
        validation: share of the files for validation, equal in every class, where folders do not say it. With 0 the
            training split serves as validation too: early stopping and calibration then use training data.
        test: share of the files for the test, likewise.
        centred: whether to subtract each cloud's mean in float64, before it is rounded to float32 (map coordinates).
        unreadable: treatment of files that cannot be read: refuse or skip.
        data_seed: seed of points and splits; it does not depend on the seed of the run.
    """

    bibtex = """@misc{point_cloud_folder,
  title = {Point clouds of the user's own},
  note = {Cite the source of these files}
}"""
    groups = ("point_cloud_folder",)

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        points: Annotated[int, Field(ge=1, le=100_000_000)] | None = None,
        columns: list[Words] | None = None,
        validation: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.15,
        test: Share = 0.15,
        centred: bool = False,
        unreadable: Unreadable = "error",
        data_seed: Seed = 0,
    ) -> None:
        wanted = tuple(name for name in dict.fromkeys(columns or ()) if name not in XYZ)
        self.root = root
        self.reading = Reading(points, wanted, data_seed, centred)
        self.columns = self.reading.all_columns
        self.unreadable: Unreadable = unreadable
        self.shares = (validation, test)

    def found(self) -> Found:
        if self.root is None:
            raise DataError(f"data.root is not set. {folders.WANTED}")
        if sum(self.shares) >= 1:
            raise DataError(
                f"data.validation + data.test = {sum(self.shares):g}: wanted less than 1, so that files are left for "
                "training."
            )
        root = Path(self.root).expanduser()
        self.title = root.resolve().name
        listed = folders.listed(root)
        kept, packed = loaded(listed, root, self.reading, "point_cloud_folder", self.unreadable)
        splits = self._drawn(kept)
        missing = set(range(len(kept.classes))) - set(kept.labels[splits == "train"].tolist())
        if missing and "train" in splits:
            raise DataError(
                f"{root}: no training sample of {kept.classes[min(missing)]}; wanted one of every class. Add files."
            )
        return Found(
            where=str(root),
            about={
                "root": self.root,
                "version": "point_cloud_folder 1",
                "columns": ", ".join(self.columns),
                "points": f"{self.reading.points}, seed {self.reading.seed}",
                "ignored": str(kept.ignored),
            },
            classes=kept.classes,
            packed=packed,
            labels=kept.labels,
            names=[file.relative_to(root).as_posix() for file in kept.files],
            splits=splits,
            skipped=len(listed.files) - len(kept.files),
            validated_on="validation" if self.shares[0] or "validation" in splits else "train",
            remarks=unread(kept, self.reading),
        )

    def _drawn(self, kept: folders.Listed) -> np.ndarray:
        """Return the split of every sample: as the folders say, and otherwise drawn from the seed."""
        splits = np.where(kept.splits == "", "train", kept.splits)
        random = stream(self.reading.seed, "splits")
        validation, test = self.shares
        if "" in kept.splits:
            hold_out(splits, kept.labels, test, random, "test")
            validation /= 1 - test  # the share of what is left
        if "validation" not in kept.splits and validation:
            hold_out(splits, kept.labels, validation, random)
        return splits


class Dales(LabelledClouds):
    """Buildings, cars, fences, poles and trees from airborne laser scans, 100 to 28,000 points each, metres.

    Objects are dealt into five folds with equal shares of every class; one fold is the test split. A batch is padded to
    its largest cloud. Batches also hold "object", int64, the object's number in the archive.

    Args:
        root: the archive.
        fold: index of the fold that is the test split.
        points: largest number of points that is kept of an object; None for all.
        validation_share: share of the other folds for validation, equal in every class.
        data_seed: seed of folds, validation and points; it does not depend on the seed of the run.
    """

    bibtex = """@inproceedings{varney2020dales,
  title = {{DALES}: A Large-scale Aerial {LiDAR} Data Set for Semantic Segmentation},
  author = {Varney, Nina and Asari, Vijayan K. and Graehling, Quinn},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition Workshops (CVPRW)},
  pages = {717--726},
  year = {2020}
}"""
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

    def found(self) -> Found:
        archive = read_archive(self.root)
        seed, clouds = self.reading.seed, []
        for number, identity in enumerate(archive.identity):
            table = archive.points[archive.offset[number] : archive.offset[number + 1]]
            table = subsampled(table, self.reading.points, stream(seed, f"object {identity}"))
            clouds.append(rounded(table, f"{self.root}, object {number}", centred=False))
        tested = folds(archive.label, FOLDS, stream(seed, "folds")) == self.fold
        splits = np.where(tested, "test", "train").astype("<U10")
        hold_out(splits, archive.label, self.validation_share, stream(seed, f"validation {self.fold}"))
        return Found(
            where=str(self.root),
            about={
                "root": str(self.root),
                "version": "DALES objects",
                "fold": f"{self.fold} of {FOLDS}, seed {seed}",
                "points": str(self.reading.points or "all"),
            },
            classes=archive.classes,
            packed=Packed.of(clouds, 3),
            labels=archive.label,
            names=[str(number) for number in archive.identity],
            splits=splits,
            fields={"object": torch.from_numpy(archive.identity)},
        )
