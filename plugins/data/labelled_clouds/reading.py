"""Reading of files as point clouds, which are kept in memory.

Files are read, and points are drawn from their surfaces, only once. The clouds are stored in the cache under a hash of
everything that they depend on, so that a second run starts at once.
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
from framework.datasets.new_files import DIGITS, hash_contents
from framework.errors import DataError
from framework.geometry import meshes
from framework.geometry.clouds import pad
from framework.geometry.mesh_files import NORMALS, XYZ
from framework.storage import cache
from framework.storage.arrays import read_npz
from framework.storage.files import replacing
from framework.storage.names import as_bytes
from framework.storage.progress import track_progress
from framework.storage.reading import read_bytes, translate_errors

VERSION = 2
"""Version of the cached clouds; increase it if `read_cloud` or their file changes, so that old files are not used."""
SURFACE_POINTS = 2048
"""Number of points drawn from a mesh if no number is given (thesis §6.5.1)."""
MAX_ROUNDING = 1e-3
"""Largest rounding error of float32, as a share of a cloud's extent, that is accepted."""


@dataclass(frozen=True)
class Reading:
    """Settings for turning a file into a cloud.

    Attributes:
        points: Number of points drawn from the surface of a mesh (None: 2048), and largest number of points read of a
            cloud (None: all).
        columns: Attributes in addition to x, y, z. The normals of points of a mesh are the normals of its faces; its
            other attributes are interpolated.
        seed: Seed of the random points, which depend only on the seed and on the name of the file.
        centred: Whether to subtract each cloud's mean before the cloud is rounded to float32.
        surface: Whether files without faces are refused.
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
        """Return the clouds packed one after another; each of them has `columns` columns."""
        table = np.concatenate([np.empty((0, columns), np.float32), *clouds])
        return cls(torch.from_numpy(table), torch.from_numpy(np.cumsum([0, *map(len, clouds)])))

    def digest(self) -> str:
        """Return a hash of the clouds."""
        content = hashlib.sha256(self.offset.numpy().tobytes())
        content.update(self.points.contiguous().numpy().data)
        return content.hexdigest()

    def largest(self) -> int:
        """Return the number of points of the largest cloud; 0 without clouds."""
        return int(self.offset.diff().max()) if len(self.offset) > 1 else 0


class Loaded(NamedTuple):
    """Clouds of the files that could be read.

    Attributes:
        packed: The clouds.
        good: Indices of these files.
        faults: Errors of the other files.
        hashes: Hash of the content of each of these files (`framework.datasets.new_files`).
    """

    packed: Packed
    good: tuple[int, ...]
    faults: tuple[DataError, ...]
    hashes: tuple[str, ...]


class Clouds(Dataset[dict[str, Tensor]]):
    """Data set with some of the packed clouds as "input", (points, columns), and with further fields.

    A batch is padded to its largest cloud with rows of NaN (`framework.geometry.clouds`).

    Args:
        packed: All clouds.
        chosen: Indices of the clouds that belong to this data set.
        fields: Further fields, whose first dimension counts the samples of this data set.
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


def read_cloud(file: Path, reading: Reading) -> Float32[np.ndarray, "points columns"]:
    """Return the cloud of a file: random points of a mesh's surface, or the file's own points.

    Raises:
        DataError: The file cannot be read, a column is missing, or the coordinates are too far from 0 for float32.
    """
    mesh = meshes.read(file)
    random = meshes.stream(reading.seed, file.name)
    if len(mesh.faces) or reading.surface:
        sample = meshes.sample(mesh, reading.points or SURFACE_POINTS, random)
        points = sample.points
        of_faces = meshes.normals(mesh)[sample.face]
        interpolated = [name for name in reading.columns if name not in NORMALS]
        # with the barycentric weights of the points, attributes that are linear on a face stay linear
        corners = mesh.attribute(interpolated)[mesh.faces[sample.face]]
        of_vertices = np.einsum("pc,pcn->pn", sample.weights, corners)
        attributes = [
            of_faces[:, NORMALS.index(name)] if name in NORMALS else of_vertices[:, interpolated.index(name)]
            for name in reading.columns
        ]
        table = np.column_stack([points, *attributes])
    else:
        table = np.concatenate([mesh.vertices, mesh.attribute(reading.columns)], 1)
        table = subsample(table, reading.points, random)
    return round_to_float32(table, str(file), centred=reading.centred)


def subsample(table: NDArray, points: int | None, random: np.random.Generator) -> NDArray:
    """Return at most `points` rows of `table`, drawn without replacement; all rows if `points` is None.

    The rows keep their order.
    """
    if points is None or len(table) <= points:
        return table
    return table[np.sort(random.choice(len(table), points, replace=False))]


def round_to_float32(table: NDArray, source: str, *, centred: bool) -> Float32[np.ndarray, "points columns"]:
    """Return a cloud as float32, after subtracting the mean of its coordinates if `centred` is true.

    Args:
        table: the points; the coordinates are the first three columns.
        source: name of the cloud in messages.
        centred: whether the mean is subtracted.

    Raises:
        DataError: The coordinates exceed float32, or are so far from 0 that rounding would blur the shape.
    """
    if centred:
        table = np.concatenate([table[:, :3] - table[:, :3].mean(0), table[:, 3:]], 1)
    largest, extent = np.abs(table[:, :3]).max(), np.ptp(table[:, :3], axis=0).max()
    step = largest * np.finfo(np.float32).eps
    if largest > 1e37 or (extent > 0 and step > MAX_ROUNDING * extent):
        raise DataError(
            f"{source}: The coordinates are up to {largest:.3g} in size and differ by {extent:.3g}, so float32 would "
            f"round them by {step:.1g}. Subtract their mean (data.centred=true, if the data set has that key), or "
            "choose other units."
        )
    return table.astype(np.float32)


def load_files(files: Sequence[Path], root: Path, reading: Reading, cache_folder: str) -> Loaded:
    """Return the clouds of all files, from the cache if it holds them; otherwise read them with a progress bar.

    Args:
        files: The files.
        root: Folder to which the names of the files in the cache's key are relative.
        reading: Settings for turning files into clouds.
        cache_folder: Name of the cache folder.
    """
    cache_file = cache.folder(cache_folder) / f"{_key(files, root, reading)}.npz"
    try:
        with translate_errors(cache_file, "clouds"):
            arrays = read_npz(read_bytes(cache_file))
            packed = Packed(torch.from_numpy(arrays["points"]), torch.from_numpy(arrays["offset"]))
            faults = {int(number): text for number, text in json.loads(str(arrays["faults"])).items()}
            hashes = arrays["hashes"].tolist()
    except DataError:  # the cached file is missing or damaged: read the files again
        packed, faults = _read_all(files, reading)
        hashes = hash_contents(files)
        try:
            with replacing(cache_file) as part, part.open("wb") as stream:
                points, offset = packed.points.numpy(), packed.offset.numpy()
                texts, digests = np.array(json.dumps(faults)), np.array(hashes, f"<U{DIGITS}")
                np.savez(stream, points=points, offset=offset, faults=texts, hashes=digests)
        except OSError as error:
            raise DataError(
                f"{cache_file} cannot be written ({error}). Free space on that disk, or set FRAMEWORK_CACHE to another "
                "folder."
            ) from error
    good = tuple(number for number in range(len(files)) if number not in faults)
    of_good = tuple(hashes[number] for number in good)
    return Loaded(packed, good, tuple(map(DataError, faults.values())), of_good)


def _key(files: Sequence[Path], root: Path, reading: Reading) -> str:
    """Return a hash of the settings and of the files' names, sizes and times of modification."""
    digest = hashlib.sha256(f"{VERSION} {reading}\n".encode())
    for file in files:
        state = file.stat()
        name = as_bytes(file.relative_to(root).as_posix())
        digest.update(name + f" {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:32]


def _read_all(files: Sequence[Path], reading: Reading) -> tuple[Packed, dict[int, str]]:
    """Return the clouds of the files that can be read, and the error messages of the other files by their indices."""
    clouds, faults = [], {}
    for number, file in enumerate(track_progress(files, "reading clouds", len(files), "files")):
        try:
            clouds.append(read_cloud(file, reading))
        except DataError as error:
            faults[number] = str(error)
    return Packed.of(clouds, len(reading.all_columns)), faults


def load_unlabelled(files: Sequence[Path], reading: Reading) -> Clouds:
    """Return a data set of a user's own files with the fields "input" and "index", in the order of the files.

    Raises:
        DataError: There are no files, or some cannot be read; the message names the first ten.
    """
    if not files:
        raise DataError(f"No file was given. Give at least one file of {', '.join(meshes.READERS)}.")
    packed, faults = _read_all([Path(file) for file in files], reading)
    if faults:
        reasons = [DataError(text) for text in faults.values()]
        raise DataError(
            images.fault_message(reasons, len(files), "Leave them out, or copy them again from their source.")
        )
    return Clouds(packed, np.arange(len(files)))
