"""Reading of files as point clouds, many of which are kept in memory.

Files are read and their surfaces sampled once. The result is kept in the cache folder, under a hash of everything that
it depends on, so that a second run starts at once.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int, Int64
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from framework.datasets import images
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.geometry import meshes
from framework.geometry.clouds import pad
from framework.geometry.mesh_files import NORMALS, XYZ
from framework.storage import cache
from framework.storage.arrays import archive
from framework.storage.files import replacing
from framework.storage.names import as_bytes
from framework.storage.progress import tracked
from framework.storage.reading import guarded, read_bytes

VERSION = 1
"""Version of the conversion by `cloud`; a changed conversion takes a new number, and thus a new place in the cache."""
SURFACE_POINTS = 2048
"""Number of points drawn from a mesh where no number is given (thesis §6.5.1)."""
COARSE = 1e-3
"""Rounding to float32, as a share of a cloud's extent, that is refused."""


@dataclass(frozen=True)
class Reading:
    """Settings for turning a file into a cloud.

    Attributes:
        points: number of points drawn from the surface of a mesh (None: 2048), and largest number kept of a cloud
            (None: all).
        columns: attributes beside x, y, z. A mesh's normals are those of its faces; its other attributes are
            interpolated.
        seed: seed of the draws; each draw depends only on it and on the file's name.
        centred: subtract each cloud's mean before it is rounded to float32.
        surface: refuse files without faces.
    """

    points: int | None
    columns: tuple[str, ...] = ()
    seed: int = 0
    centred: bool = False
    surface: bool = False

    @property
    def all_columns(self) -> tuple[str, ...]:
        """Names of all columns of a cloud."""
        return (*XYZ, *self.columns)


class Packed(NamedTuple):
    """Clouds of any sizes, one after another; cloud i is points[offset[i] : offset[i + 1]]."""

    points: Float32[Tensor, "points columns"]
    offset: Int64[Tensor, "clouds_and_one"]

    @classmethod
    def of(cls, clouds: Sequence[Float32[np.ndarray, "_points columns"]], columns: int) -> "Packed":
        """Return the clouds packed one after another."""
        table = np.concatenate([np.empty((0, columns), np.float32), *clouds])
        return cls(torch.from_numpy(table), torch.from_numpy(np.cumsum([0, *map(len, clouds)])))

    def largest(self) -> int:
        """Return the number of points of the largest cloud; 0 without clouds."""
        return int(self.offset.diff().max()) if len(self.offset) > 1 else 0


class Loaded(NamedTuple):
    """Clouds of the files that could be read, numbers of these files, and errors of the others."""

    packed: Packed
    good: tuple[int, ...]
    faults: tuple[DataError, ...]


class Clouds(Dataset[dict[str, Tensor]]):
    """Data set of some of the packed clouds ("input", (points, columns)) with fields that are in memory.

    A fetched batch is padded to its largest cloud with rows of NaN (`framework.geometry.clouds`).
    """

    def __init__(self, packed: Packed, chosen: Int[np.ndarray, "samples"], **fields: Tensor) -> None:
        self.packed = packed
        self.chosen = torch.from_numpy(np.asarray(chosen, np.int64))
        self.fields = Fields(**fields, index=torch.arange(len(chosen)))

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        cloud = int(self.chosen[index])
        first, end = self.packed.offset[cloud : cloud + 2].tolist()
        return {"input": self.packed.points[first:end], **self.fields[index]}

    def __getitems__(self, indices: Sequence[int]) -> dict[str, Tensor]:
        clouds = [self[index]["input"] for index in indices]
        return {"input": pad(clouds), **self.fields.__getitems__(indices)}


def cloud(file: Path, how: Reading) -> Float32[np.ndarray, "points columns"]:
    """Return the cloud of a file: points of a mesh's surface, or the file's own points.

    Raises:
        DataError: `framework.geometry.meshes` raises it; or a column is missing; or the coordinates are too far from 0
            for float32.
    """
    mesh = meshes.read(file)
    random = meshes.stream(how.seed, file.name)
    if len(mesh.faces) or how.surface:
        drawn = meshes.sample(mesh, how.points or SURFACE_POINTS, random)
        points = drawn.points
        of_faces = meshes.normals(mesh)[drawn.face]
        own = [name for name in how.columns if name not in NORMALS]
        # interpolate with the weights of the drawn points: attributes that are linear on a face stay linear
        corners = mesh.attribute(own)[mesh.faces[drawn.face]]
        of_vertices = np.einsum("pc,pcn->pn", drawn.weights, corners)
        attributes = [
            of_faces[:, NORMALS.index(name)] if name in NORMALS else of_vertices[:, own.index(name)]
            for name in how.columns
        ]
        table = np.column_stack([points, *attributes])
    else:
        table = np.concatenate([mesh.vertices, mesh.attribute(how.columns)], 1)
        table = subsampled(table, how.points, random)
    return rounded(table, str(file), centred=how.centred)


def subsampled(table: NDArray, points: int | None, random: np.random.Generator) -> NDArray:
    """Return at most `points` rows, drawn without replacement, in their order; all rows if `points` is None."""
    if points is None or len(table) <= points:
        return table
    return table[np.sort(random.choice(len(table), points, replace=False))]


def rounded(table: NDArray, source: str, *, centred: bool) -> Float32[np.ndarray, "points columns"]:
    """Return a cloud as float32, after subtracting its mean if `centred` is true.

    Raises:
        DataError: the coordinates exceed float32, or are so far from 0 that rounding would blur the shape.
    """
    if centred:
        table = np.concatenate([table[:, :3] - table[:, :3].mean(0), table[:, 3:]], 1)
    reach, extent = np.abs(table[:, :3]).max(), np.ptp(table[:, :3], axis=0).max()
    step = reach * np.finfo(np.float32).eps
    if reach > 1e37 or (extent > 0 and step > COARSE * extent):
        raise DataError(
            f"{source}: its coordinates reach {reach:.3g} and differ by {extent:.3g}: float32 would round them by "
            f"{step:.1g}. Subtract their mean (data.centred=true where the data have that key), or choose other units."
        )
    return table.astype(np.float32)


def load(files: Sequence[Path], root: Path, how: Reading, place: str) -> Loaded:
    """Return the clouds of all files, from the cache folder `place` if they were read before, else with a progress bar.

    Args:
        files: the files.
        root: folder to which the files' names in the cache's key are relative.
        how: settings for turning files into clouds.
        place: name of the cache folder.
    """
    kept = cache.folder(place) / f"{_key(files, root, how)}.npz"
    try:
        with guarded(kept, "clouds"):
            found = archive(read_bytes(kept))
            packed = Packed(torch.from_numpy(found["points"]), torch.from_numpy(found["offset"]))
            faults = {int(number): text for number, text in json.loads(str(found["faults"])).items()}
    except DataError:  # the cached file is missing or damaged: read the files again
        packed, faults = _read_all(files, how)
        try:
            with replacing(kept) as part, part.open("wb") as stream:
                points, offset = packed.points.numpy(), packed.offset.numpy()
                np.savez(stream, points=points, offset=offset, faults=np.array(json.dumps(faults)))
        except OSError as error:
            raise DataError(
                f"{kept} cannot be written ({error}). Free space there, or set FRAMEWORK_CACHE to another folder."
            ) from error
    good = tuple(number for number in range(len(files)) if number not in faults)
    return Loaded(packed, good, tuple(map(DataError, faults.values())))


def _key(files: Sequence[Path], root: Path, how: Reading) -> str:
    digest = hashlib.sha256(f"{VERSION} {how}\n".encode())
    for file in files:
        state = file.stat()
        name = as_bytes(file.relative_to(root).as_posix())
        digest.update(name + f" {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:32]


def _read_all(files: Sequence[Path], how: Reading) -> tuple[Packed, dict[int, str]]:
    """Return the clouds of the files that can be read, and the error messages of the others by number."""
    clouds, faults = [], {}
    for number, file in enumerate(tracked(files, "reading clouds", len(files), "files")):
        try:
            clouds.append(cloud(file, how))
        except DataError as error:
            faults[number] = str(error)
    return Packed.of(clouds, len(how.all_columns)), faults


def unlabelled(files: Sequence[Path], how: Reading) -> Clouds:
    """Return a data set of a user's own files, "input" and "index", in their order.

    Raises:
        DataError: there are no files, or some cannot be read; the message names the first ten.
    """
    if not files:
        raise DataError(f"No file was given; wanted at least one of {', '.join(meshes.READERS)}.")
    packed, faults = _read_all([Path(file) for file in files], how)
    if faults:
        reasons = [DataError(text) for text in faults.values()]
        raise DataError(images.fault_message(reasons, len(files), "Leave them out, or restore them."))
    return Clouds(packed, np.arange(len(files)))
