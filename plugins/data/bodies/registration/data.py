"""Scans of random bodies, with all vertices of each for target; the contract is framework.data's."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.datasets import cloud_picture
from framework.datasets.fields import Fields
from framework.geometry import clouds
from framework.geometry.meshes import Mesh, read
from framework.target import Target
from plugins.data.bodies import body_files, default_body
from plugins.data.bodies.body import Body, BodyModel, with_joints
from plugins.data.bodies.registration import poses
from plugins.data.bodies.registration.scanner import KINDS, Scanner, scan

VERSION = 1
"""Of what is drawn; a change takes a new number."""
SPLITS = ("train", "validation", "test")
XYZ = ("x", "y", "z")
Size = Annotated[int, Field(ge=1, le=10_000_000)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Registration(Data):
    """Synthetic scans of people of random shape and pose; the target is every vertex of the body (thesis §6.5.2).

    A body is drawn (poses; adults of random traits), posed by linear blend skinning and scanned
    (scanner). Nothing of that is kept: a sample is a function of (`data_seed`, split, number),
    made when it is fetched. Inputs are clouds about the origin, normalised robustly (geometry.clouds); targets are in
    the same frame, x, y, z of vertex 0, then of vertex 1, ...; "centre" (batch, 3) and "scale" (batch,), metres, lead
    back.

    Args:
        train, validation, test: bodies of each split.
        points: of a scan, at most.
        noise: largest standard deviation of a coordinate, metres; each scan has its own, uniform below.
        partial, outliers: shares of scans with missing parts and with points that are not the body's.
        cut, strangers: the largest share of points such a scan lacks or has too many.
        body: file of a body model of the SMPL family (.npz, .pkl); None: the default body, extracted on first use.
        shape_spread: standard deviation of the first ten shape coefficients of a body from a file.
        data_seed: of the draws, whatever the seed of the run.

    Raises:
        DataError: the body cannot be had or read.
    """

    varies = False
    columns = XYZ
    bibtex = """@inproceedings{prokudin2019efficient,
  title = {Efficient Learning on Point Clouds with Basis Point Sets},
  author = {Prokudin, Sergey and Lassner, Christoph and Romero, Javier},
  booktitle = {IEEE/CVF International Conference on Computer Vision (ICCV)},
  year = {2019}
}
@inproceedings{bregier2026anny,
  title = {Human Mesh Modeling for {A}nny {B}ody},
  author = {Br{\\'e}gier, Romain and Fiche, Gu{\\'e}nol{\\'e} and Bravo-S{\\'a}nchez, Laura and Lucas, Thomas and
    Armando, Matthieu and Weinzaepfel, Philippe and Rogez, Gr{\\'e}gory and Baradel, Fabien},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year = {2026}
}"""

    def __init__(
        self,
        *,
        train: Size = 48_000,
        validation: Size = 400,
        test: Size = 1_000,
        points: Annotated[int, Field(ge=100, le=1_000_000)] = 10_000,
        noise: Annotated[float, Field(ge=0, le=0.1, allow_inf_nan=False)] = 0.004,
        partial: Share = 0.2,
        outliers: Share = 0.2,
        cut: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.2,
        strangers: Annotated[float, Field(ge=0, le=0.3, allow_inf_nan=False)] = 0.1,
        body: str | None = None,
        shape_spread: Annotated[float, Field(ge=0, le=5, allow_inf_nan=False)] = 1.0,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
    ) -> None:
        self.sizes = {"train": train, "validation": validation, "test": test}
        self.scanner = Scanner(points, noise, cut, strangers)
        self.shares = (1 - min(1, partial + outliers), partial, outliers)
        self.body = body
        self.shape_spread = shape_spread
        self.data_seed = data_seed

    def prepare(self) -> None:
        body, self.traits = chosen_body(self.body)
        self.model = BodyModel(body)
        self._body = body
        self._where = poses.skeleton(body)
        vertices = len(body.template)
        self.target = Target("real", tuple(f"{axis}{vertex}" for vertex in range(vertices) for axis in XYZ))
        self.input_shape = (self.scanner.points, 3)
        self.groups = KINDS
        self.synthetic = True
        self.skipped = 0
        self._drawn_splits = [self._drawn(number) for number in range(len(SPLITS))]

    def _drawn(self, split: int) -> "Scans":
        count = self.sizes[SPLITS[split]]
        random = np.random.default_rng([self.data_seed, split])
        if self.traits is None:
            shape = random.normal(0, self.shape_spread, (count, min(10, self._body.shapes.shape[2])))
        else:
            shape = self.traits.coefficients(
                torch.from_numpy(adults(self.traits.labels, count, random))
            ).numpy()
        movements = poses.draw(count, random)
        share = np.array(self.shares) / sum(self.shares)
        kind = random.choice(len(KINDS), count, p=share)
        dtype = self.model.template.dtype
        return Scans(
            self.model,
            torch.from_numpy(shape).to(dtype),
            torch.from_numpy(poses.rotations(self._body, self._where, movements)).to(dtype),
            torch.from_numpy(kind),
            self.scanner,
            (self.data_seed, split),
            # a quarter of a millimetre is nothing to learn from, and targets of all training bodies may be kept at once
            torch.float16 if SPLITS[split] == "train" else torch.float32,
        )

    def splits(self) -> Splits:
        return Splits(*self._drawn_splits)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        found = [torch.from_numpy(read(file).vertices).float() for file in files]
        return Fields(**normalised(clouds.pad(found)), index=torch.arange(len(found)))

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        digest = hashlib.sha256(np.ascontiguousarray(self._body.template).tobytes())
        for split in self._drawn_splits:
            for values in (split.shape, split.pose, split.kind):
                digest.update(values.numpy().tobytes())
        return {
            "root": "generated",
            "version": f"registration {VERSION}",
            "body": self._body.source,
            "scanner": str(self.scanner),
            "data_seed": str(self.data_seed),
            **{name: str(size) for name, size in self.sizes.items()},
            "sha256": digest.hexdigest(),
        }

    def picture(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.picture(inputs[..., [2, 0, 1]])  # its third axis is up


class Scans(Dataset[Batch]):
    """Bodies that are posed and scanned when they are fetched.

    Args:
        shape, pose: of every body, for `model`.
        kind: of every scan, places in KINDS.
        seed: of the scans, which also depend on the sample's number.
        precision: of the targets.
    """

    def __init__(
        self,
        model: BodyModel,
        shape: Float[Tensor, "body shape"],
        pose: Float[Tensor, "body joint 3"],
        kind: Tensor,
        scanner: Scanner,
        seed: tuple[int, int],
        precision: torch.dtype,
    ) -> None:
        self.model = model
        self.shape = shape
        self.pose = pose
        self.kind = kind
        self.scanner = scanner
        self.seed = seed
        self.precision = precision

    def __len__(self) -> int:
        return len(self.shape)

    def __getitem__(self, index: int) -> Batch:
        return {name: values[0] for name, values in self.__getitems__([index]).items()}

    @torch.no_grad()
    def __getitems__(self, indices: Sequence[int]) -> Batch:
        chosen = torch.tensor(list(indices), dtype=torch.int64)
        vertices = self.model(self.shape[chosen], self.pose[chosen])
        faces = self.model.faces.numpy()
        seen = [
            scan(
                Mesh(f"body {index}", one.double().numpy(), faces),
                KINDS[int(self.kind[index])],
                self.scanner,
                np.random.default_rng([*self.seed, index]),
            )
            for index, one in zip(indices, vertices, strict=True)
        ]
        fields = normalised(clouds.pad([torch.from_numpy(points).float() for points in seen]))
        local = (vertices - fields["centre"][:, None]) / fields["scale"][:, None, None]
        return {
            **fields,
            "target": local.to(self.precision).flatten(1),
            "group": self.kind[chosen],
            "index": chosen,
        }


def normalised(batch: Float[Tensor, "batch points columns"]) -> Batch:
    """The fields "input", "centre" and "scale" of clouds in metres."""
    found = clouds.normalised(batch[..., :3], "robust")
    return {"input": found.clouds, "centre": found.centre.float(), "scale": found.scale.float()}


def chosen_body(file: str | None) -> tuple[Body, default_body.Traits | None]:
    """The body of a file, as it is; or the default body with the joints that poses turn, and its traits."""
    if file is not None:
        return body_files.read(Path(file).expanduser()), None
    body, traits = default_body.default_body()
    return with_joints(body, poses.JOINTS), traits


def adults(
    labels: Sequence[str], count: int, random: np.random.Generator
) -> Float[np.ndarray, "person trait"]:
    """Random traits of adults: gender and age uniform (2/3 is young, 1 old), else normal within 0.05…0.95."""
    found = random.random((count, len(labels)))
    for place, label in enumerate(labels):
        if label == "age":
            low, high = 0.6, 0.95
            found[:, place] = low + (high - low) * found[:, place]
        elif label != "gender":
            spread = 0.09 if label == "height" else 0.22
            found[:, place] = random.normal(0.5, spread, count).clip(0.05, 0.95)
    return found
