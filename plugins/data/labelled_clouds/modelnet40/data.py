"""ModelNet40 as point clouds; the contract is framework.data's."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data
from framework.datasets import cloud_picture, images
from framework.errors import DataError
from framework.geometry.mesh_files import NORMALS
from framework.geometry.meshes import stream
from framework.storage.generated import read_mark
from framework.target import Target
from plugins.data.labelled_clouds import labelled_clouds
from plugins.data.labelled_clouds.labelled_clouds import Reading
from plugins.data.labelled_clouds.modelnet40.generator import VERSION, generated
from plugins.data.labelled_clouds.modelnet40.layout import listed
from plugins.data.labelled_clouds.modelnet40.rotated import Rotated

DataSeed = Annotated[int, Field(ge=0, lt=2**31)]


class ModelNet40(Data):
    """CAD models of everyday things as points of their surfaces, z up; generated where no root is given.

    A mesh's points depend on `data_seed` and its file's name alone. They are drawn once and kept in the cache.

    Args:
        root: the unpacked ModelNet40; None: a generated set in its layout, 23 classes.
        points: of each surface, uniform by area (thesis §6.5.1: 2048).
        classes: some of them; None: all.
        normals: add the faces' normals as columns.
        validation_share: of the official training split, of every class alike.
        rotations: a training cloud comes so many times, turned about the up axis in equal steps (thesis §6.5.1).
        unreadable: what becomes of files that cannot be read.
        data_seed: of points and validation split, whatever the seed of the run.
        train_models, test_models: generated models of each class.
        generator_seed: of these.
    """

    bibtex = """@inproceedings{wu2015modelnet,
  title = {{3D ShapeNets}: A Deep Representation for Volumetric Shapes},
  author = {Wu, Zhirong and Song, Shuran and Khosla, Aditya and Yu, Fisher and Zhang, Linguang and Tang, Xiaoou and
            Xiao, Jianxiong},
  booktitle = {IEEE Conference on Computer Vision and Pattern Recognition (CVPR)},
  pages = {1912--1920},
  year = {2015}
}"""
    varies = False
    groups = ("modelnet40",)

    def __init__(
        self,
        *,
        root: str | None = None,
        points: Annotated[int, Field(ge=1, le=1_000_000)] = 2048,
        classes: list[str] | None = None,
        normals: bool = False,
        validation_share: Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)] = 0.15,
        rotations: Annotated[int, Field(ge=1, le=360)] = 1,
        unreadable: Literal["error", "skip"] = "error",
        data_seed: DataSeed = 0,
        train_models: Annotated[int, Field(ge=2, le=10_000)] = 60,
        test_models: Annotated[int, Field(ge=1, le=10_000)] = 25,
        generator_seed: DataSeed = 0,
    ) -> None:
        self.root = root
        self.reading = Reading(points, NORMALS if normals else (), data_seed)
        self.columns = self.reading.all_columns
        self.classes = classes
        self.validation_share = validation_share
        self.rotations = rotations
        self.unreadable = unreadable
        self.models = (train_models, test_models, generator_seed)

    def prepare(self) -> None:
        root = Path(self.root).expanduser() if self.root is not None else generated(*self.models)
        found = listed(root, self.classes)
        self.target = Target("class", found.classes)
        self.input_shape = (self.reading.points or 0, len(self.columns))
        self.synthetic = read_mark(root) is not None
        files = found.files["train"] + found.files["test"]
        loaded = labelled_clouds.load(files, root, replace(self.reading, surface=True), "modelnet40/clouds")
        if loaded.faults and self.unreadable == "error":
            remedy = "Restore them, or set data.unreadable=skip to leave them out."
            if self.root is None:
                remedy = f"Delete {root}: the models are generated anew."
            raise DataError(images.fault_message(loaded.faults, len(files), remedy))
        self.skipped = len(loaded.faults)
        labels = np.array(found.labels["train"] + found.labels["test"])[list(loaded.good)]
        split = np.array(["train"] * len(found.files["train"]) + ["test"] * len(found.files["test"]))
        split = split[list(loaded.good)].astype("<U10")
        learned = np.flatnonzero(split == "train")
        random = stream(self.reading.seed, "validation")
        held_out = labelled_clouds.spared(labels[learned], self.validation_share, random)
        split[learned[held_out]] = "validation"
        self._splits = labelled_clouds.apart(loaded.packed, labels, split, str(root))
        names = [files[number].name for number in loaded.good]
        self._digest = labelled_clouds.digest(names, labels.tolist(), split.tolist())

    def train(self) -> Dataset[Batch]:
        clouds = self._splits["train"]
        return clouds if self.rotations == 1 else Rotated(clouds, self.rotations)

    def validation(self) -> Dataset[Batch]:
        return self._splits["validation"]

    def test(self) -> Dataset[Batch]:
        return self._splits["test"]

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return labelled_clouds.unlabelled(files, self.reading)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        generated_root = f"synthetic, seed {self.models[2]}"
        return {
            "root": generated_root if self.root is None else self.root,
            "version": f"generator {VERSION}" if self.synthetic else "ModelNet40",
            **{name: str(len(clouds)) for name, clouds in self._splits.items()},
            "rotations": str(self.rotations),
            "points": f"{self.reading.points}, seed {self.reading.seed}",
            "sha256": self._digest,
        }

    def picture(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.picture(inputs, self.columns)
