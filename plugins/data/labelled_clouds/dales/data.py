"""DALES objects; the contract is framework.data's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data
from framework.datasets import cloud_picture
from framework.geometry.meshes import stream
from framework.target import Target
from plugins.data.labelled_clouds import labelled_clouds
from plugins.data.labelled_clouds.dales.archive import Archive, read_archive
from plugins.data.labelled_clouds.labelled_clouds import Packed, Reading

FOLDS = 5


class Dales(Data):
    """Buildings, cars, fences, poles and trees from airborne laser scans, 100 to 28,000 points each, metres.

    Objects are dealt into five folds, every class alike; one fold is the test split. A batch is padded to its largest
    cloud. Batches also hold "object", int64, the archive's number of the object.

    Args:
        root: the archive.
        fold: which fold is tested.
        points: of larger objects so many points are kept; None: all.
        validation_share: of the other folds, of every class alike.
        data_seed: of folds, validation and points, whatever the seed of the run.
    """

    bibtex = """@inproceedings{varney2020dales,
  title = {{DALES}: A Large-scale Aerial {LiDAR} Data Set for Semantic Segmentation},
  author = {Varney, Nina and Asari, Vijayan K. and Graehling, Quinn},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition Workshops (CVPRW)},
  pages = {717--726},
  year = {2020}
}"""
    varies = False
    groups = ("dales",)
    synthetic = False
    skipped = 0

    def __init__(
        self,
        *,
        root: str | None = None,
        fold: Annotated[int, Field(ge=0, lt=FOLDS)] = 0,
        points: Annotated[int, Field(ge=1, le=100_000_000)] | None = None,
        validation_share: Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)] = 0.15,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
    ) -> None:
        self.root = root
        self.fold = fold
        self.reading = Reading(points, (), data_seed)
        self.columns = self.reading.all_columns
        self.validation_share = validation_share

    def prepare(self) -> None:
        archive = read_archive(self.root)
        packed = self._packed(archive)
        self.target = Target("class", archive.classes)
        self.input_shape = (packed.largest(), len(self.columns))
        seed = self.reading.seed
        fold = labelled_clouds.folds(archive.label, FOLDS, stream(seed, "folds"))
        split = np.where(fold == self.fold, "test", "train").astype("<U10")
        learned = np.flatnonzero(fold != self.fold)
        random = stream(seed, f"validation {self.fold}")
        held_out = labelled_clouds.spared(archive.label[learned], self.validation_share, random)
        split[learned[held_out]] = "validation"
        identity = torch.from_numpy(archive.identity)
        self._splits = labelled_clouds.apart(packed, archive.label, split, str(self.root), object=identity)
        names = [str(number) for number in archive.identity]
        self._digest = labelled_clouds.digest(names, archive.label.tolist(), split.tolist())

    def _packed(self, archive: Archive) -> Packed:
        """The objects as float32, the larger ones subsampled."""
        clouds = []
        for number in range(len(archive.label)):
            table = archive.points[archive.offset[number] : archive.offset[number + 1]]
            random = stream(self.reading.seed, f"object {archive.identity[number]}")
            table = labelled_clouds.subsampled(table, self.reading.points, random)
            clouds.append(labelled_clouds.rounded(table, f"{self.root}, object {number}", centred=False))
        offset = np.cumsum([0, *map(len, clouds)])
        return Packed(torch.from_numpy(np.concatenate(clouds)), torch.from_numpy(offset))

    def train(self) -> Dataset[Batch]:
        return self._splits["train"]

    def validation(self) -> Dataset[Batch]:
        return self._splits["validation"]

    def test(self) -> Dataset[Batch]:
        return self._splits["test"]

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return labelled_clouds.unlabelled(files, self.reading)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return {
            "root": str(self.root),
            "version": "DALES objects",
            **{name: str(len(clouds)) for name, clouds in self._splits.items()},
            "fold": f"{self.fold} of {FOLDS}, seed {self.reading.seed}",
            "points": str(self.reading.points or "all"),
            "sha256": self._digest,
        }

    def picture(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.picture(inputs)
