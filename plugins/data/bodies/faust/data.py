"""FAUST: real scans of ten people in ten poses, with registered meshes; the contract is framework.data's."""

import hashlib
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
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.geometry import clouds
from framework.geometry.meshes import read, stream
from framework.storage.generated import read_mark
from framework.target import Target
from plugins.data.bodies.faust.layout import SUBJECTS, Scan, scans

Subjects = Annotated[list[Annotated[int, Field(ge=0, lt=SUBJECTS)]], Field(min_length=1)]


class Faust(Data):
    """FAUST's training scans and their registrations, split by person (Bogo et al. 2014).

    Inputs are points drawn from a scan's vertices, normalised robustly (geometry.clouds); targets the registration's
    vertices in the same frame, x, y, z of vertex 0, then of vertex 1, ...; "centre" (batch, 3) and "scale" (batch,),
    metres, lead back; "subject" (batch,) is the person, 0 to 9. The scans of the test set have no registrations and are
    for `mode=predict`.

    Args:
        root: the folder that holds `training` (and `test`).
        points: of a cloud; scans have some 170,000.
        validation, test: people of these splits; all others are for training.
        data_seed: of the points, whatever the seed of the run.

    Raises:
        DataError: no root, a scan without its registration or the other way round, a file that cannot be read,
            registrations of different meshes, a split without scans.
    """

    varies = False
    columns = ("x", "y", "z")
    bibtex = """@inproceedings{bogo2014faust,
  title = {{FAUST}: Dataset and Evaluation for {3D} Mesh Registration},
  author = {Bogo, Federica and Romero, Javier and Loper, Matthew and Black, Michael J.},
  booktitle = {IEEE Conference on Computer Vision and Pattern Recognition (CVPR)},
  year = {2014}
}"""

    def __init__(
        self,
        *,
        root: str | None = None,
        points: Annotated[int, Field(ge=100, le=1_000_000)] = 10_000,
        validation: Subjects = [7],  # noqa: B006 - never written
        test: Subjects = [8, 9],  # noqa: B006 - never written
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
    ) -> None:
        self.root = root
        self.points = points
        self.validation_subjects = validation
        self.test_subjects = test
        self.data_seed = data_seed

    def prepare(self) -> None:
        folder, found = scans(self.root)
        first, faces = _registered(found[0], None)
        self.target = Target(
            "real", tuple(f"{axis}{vertex}" for vertex in range(len(first)) for axis in "xyz")
        )
        self.faces = faces
        self.input_shape = (self.points, 3)
        self.groups = ("scans",)
        self.synthetic = read_mark(folder) is not None
        self.skipped = 0
        held = {"validation": set(self.validation_subjects), "test": set(self.test_subjects)}
        if both := held["validation"] & held["test"]:
            raise DataError(
                f"data.validation and data.test both name the people {sorted(both)}; wanted each in one."
            )
        chosen = {
            "train": [scan for scan in found if scan.subject not in held["validation"] | held["test"]],
            **{name: [scan for scan in found if scan.subject in people] for name, people in held.items()},
        }
        for name, some in chosen.items():
            if not some:
                people = sorted({scan.subject for scan in found})
                raise DataError(
                    f"{folder}: no scan for the {name} split; its people are {people}. Set data.validation and "
                    "data.test so that every split has one."
                )
        self._digest = hashlib.sha256()
        self._splits = {name: self._table(some, len(first)) for name, some in chosen.items()}

    def _table(self, some: Sequence[Scan], vertices: int) -> Fields:
        inputs, targets = [], []
        for scan in some:
            registered, _ = _registered(scan, vertices)
            inputs.append(self._cloud(scan.scan))
            targets.append(torch.from_numpy(registered).float())
            self._digest.update(f"{scan.number}".encode() + registered.tobytes())
        found = normalised(clouds.pad(inputs))
        target = (torch.stack(targets) - found["centre"][:, None]) / found["scale"][:, None, None]
        return Fields(
            **found,
            target=target.flatten(1),
            subject=torch.tensor([scan.subject for scan in some]),
            group=torch.zeros(len(some), dtype=torch.int64),
            index=torch.arange(len(some)),
        )

    def _cloud(self, file: Path) -> Tensor:
        """Points of a scan, without replacement where it has enough; which depends on its name and the seed alone."""
        vertices = read(file).vertices
        if len(vertices) > self.points:
            kept = stream(self.data_seed, file.name).choice(len(vertices), self.points, replace=False)
            vertices = vertices[np.sort(kept)]
        return torch.from_numpy(vertices).float()

    def train(self) -> Dataset[Batch]:
        return self._splits["train"]

    def validation(self) -> Dataset[Batch]:
        return self._splits["validation"]

    def test(self) -> Dataset[Batch]:
        return self._splits["test"]

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        found = clouds.pad([self._cloud(file) for file in files])
        return Fields(**normalised(found), index=torch.arange(len(files)))

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        sizes = {name: str(len(split)) for name, split in self._splits.items()}
        return {
            "root": str(self.root),
            "version": "FAUST training",
            "points": str(self.points),
            "data_seed": str(self.data_seed),
            **sizes,
            "sha256": self._digest.hexdigest(),
        }

    def picture(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.picture(inputs[..., [2, 0, 1]])  # its third axis is up


def normalised(batch: Tensor) -> Batch:
    """The fields "input", "centre" and "scale" of clouds in metres."""
    found = clouds.normalised(batch[..., :3], "robust")
    return {"input": found.clouds, "centre": found.centre.float(), "scale": found.scale.float()}


def _registered(scan: Scan, vertices: int | None) -> tuple[np.ndarray, np.ndarray]:
    mesh = read(scan.registration)
    if vertices not in (None, len(mesh.vertices)):
        raise DataError(
            f"{scan.registration}: {len(mesh.vertices)} vertices, the first registration has {vertices}; wanted one "
            "mesh throughout. Restore it from its source."
        )
    return mesh.vertices, mesh.faces
