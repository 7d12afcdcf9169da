"""A user's own meshes and point clouds; the contract is framework.data's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data
from framework.datasets import cloud_picture, images
from framework.errors import DataError
from framework.geometry.mesh_files import XYZ
from framework.geometry.meshes import stream
from framework.target import Target
from plugins.data.labelled_clouds import labelled_clouds
from plugins.data.labelled_clouds.labelled_clouds import Reading
from plugins.data.labelled_clouds.point_cloud_folder.layout import WANTED, listed


class PointCloudFolder(Data):
    """Your own files, without writing code: meshes and clouds in folders named by class; the class is predicted.

    Surfaces are sampled uniformly by area, clouds are taken as they are, each with its own number of points.

    Args:
        root: the folder.
        points: drawn from a mesh (None: 2048); of a cloud of more points so many are kept (None: all).
        columns: attributes wanted beside x, y, z. "normal_x", "normal_y", "normal_z" of a mesh are its faces'.
        validation, test: shares of the files, of every class alike, where folders do not say it. With validation = 0
            the training split serves as validation too: early stopping and calibration then see what training saw.
        centred: subtract each cloud's mean in float64, before it is rounded to float32 (coordinates of a map).
        unreadable: what becomes of files that cannot be read.
        data_seed: of points and splits, whatever the seed of the run.
    """

    bibtex = """@misc{point_cloud_folder,
  title = {Point clouds of the user's own},
  note = {Cite the source of these files}
}"""
    varies = False
    groups = ("point_cloud_folder",)
    synthetic = False

    def __init__(
        self,
        *,
        root: str | None = None,
        points: Annotated[int, Field(ge=1, le=100_000_000)] | None = None,
        columns: list[str] | None = None,
        validation: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.15,
        test: Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)] = 0.15,
        centred: bool = False,
        unreadable: Literal["error", "skip"] = "error",
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
    ) -> None:
        wanted = tuple(name for name in dict.fromkeys(columns or ()) if name not in XYZ)
        self.root = root
        self.reading = Reading(points, wanted, data_seed, centred)
        self.columns = self.reading.all_columns
        self.shares = (validation, test)
        self.unreadable = unreadable

    def prepare(self) -> None:
        if self.root is None:
            raise DataError(f"data.root is not set. {WANTED}")
        if sum(self.shares) >= 1:
            raise DataError(
                f"data.validation + data.test = {sum(self.shares):g}: wanted less than 1, so that files are left for "
                "training."
            )
        root = Path(self.root).expanduser()
        found = listed(root)
        loaded = labelled_clouds.load(found.files, root, self.reading, "point_cloud_folder")
        if loaded.faults and self.unreadable == "error":
            remedy = "Restore them, or set data.unreadable=skip to leave them out."
            raise DataError(images.fault_message(loaded.faults, len(found.files), remedy))
        self.target = Target("class", found.classes)
        self.input_shape = (loaded.packed.largest(), len(self.columns))
        self.skipped = len(loaded.faults)
        self._ignored = found.ignored
        labels = np.array(found.labels)[list(loaded.good)]
        split = self._split(labels, [found.splits[number] for number in loaded.good])
        source = {"validation": "train"} if not self.shares[0] and "validation" not in split else None
        self._splits = labelled_clouds.apart(loaded.packed, labels, split, str(root), source=source)
        missing = set(range(len(found.classes))) - set(labels[split == "train"].tolist())
        if missing:
            raise DataError(
                f"{root}: no training sample of {found.classes[min(missing)]}; wanted one of every class. Add files."
            )
        names = [found.files[number].relative_to(root).as_posix() for number in loaded.good]
        self._digest = labelled_clouds.digest(names, labels.tolist(), split.tolist())

    def _split(self, labels: np.ndarray, given: Sequence[str | None]) -> np.ndarray:
        """The split of every sample: what the folders say, and the rest drawn from the seed."""
        split = np.array([name or "train" for name in given], dtype="<U10")
        random = stream(self.reading.seed, "splits")
        validation, test = self.shares
        if None in given:
            held_out = labelled_clouds.spared(labels, test, random)
            split[held_out] = "test"
            validation /= 1 - test  # of what is left
        if "validation" not in given and validation:
            learned = np.flatnonzero(split == "train")
            split[learned[labelled_clouds.spared(labels[learned], validation, random)]] = "validation"
        return split

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
            "version": "point_cloud_folder 1",
            **{name: str(len(clouds)) for name, clouds in self._splits.items()},
            "columns": ", ".join(self.columns),
            "points": f"{self.reading.points}, seed {self.reading.seed}",
            "ignored": str(self._ignored),
            "sha256": self._digest,
        }

    def picture(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.picture(inputs, self.columns)
