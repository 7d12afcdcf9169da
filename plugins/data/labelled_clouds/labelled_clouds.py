"""Point clouds with classes, from files: what a loader does once it knows which file has which label.

Files are read and their surfaces sampled once; the result is kept below the cache folder, under a hash of everything it
depends on, so that a second run starts at once.
"""

import hashlib
import json
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, Int64
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from torch import Tensor
from torch.utils.data import Dataset

from framework.datasets import images
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.geometry import meshes
from framework.geometry.clouds import pad
from framework.geometry.mesh_files import NORMALS, XYZ
from framework.storage import cache
from framework.storage.files import replacing

VERSION = 1
"""Of what `cloud` makes of a file; a change takes a new number, and with it a new place in the cache."""
SURFACE_POINTS = 2048
"""Drawn from a mesh where no number is asked for (thesis §6.5.1)."""
SPLITS = ("train", "validation", "test")
COARSE = 1e-3
"""Rounding to float32, as a share of a cloud's extent, that is refused."""


@dataclass(frozen=True)
class Reading:
    """How a file becomes a cloud.

    Attributes:
        points: drawn from the surface of a mesh, None: 2048; of a cloud of more points so many are kept, None: all.
        columns: wanted beside x, y, z. A mesh's normals are those of its faces; its other attributes are interpolated.
        seed: of the draws; each depends on it and on the file's name alone.
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
        return (*XYZ, *self.columns)


class Packed(NamedTuple):
    """Clouds of any sizes one after another; cloud i is points[offset[i] : offset[i + 1]]."""

    points: Float32[Tensor, "points columns"]
    offset: Int64[Tensor, "clouds_and_one"]

    def largest(self) -> int:
        return int(self.offset.diff().max()) if len(self.offset) > 1 else 0


class Loaded(NamedTuple):
    """The clouds of the files that could be read, which files these are, and what is wrong with the others."""

    packed: Packed
    good: tuple[int, ...]
    faults: tuple[DataError, ...]


class Clouds(Dataset[dict[str, Tensor]]):
    """Some of the packed clouds ("input", (points, columns)) beside fields that are in memory.

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
    """The cloud of a file: points of a mesh's surface, or the file's own.

    Raises:
        DataError: as `framework.geometry.meshes`; a column is missing; the coordinates are too far from 0 for float32.
    """
    mesh = meshes.read(file)
    random = meshes.stream(how.seed, file.name)
    if len(mesh.faces) or how.surface:
        drawn = meshes.sample(mesh, how.points or SURFACE_POINTS, random)
        points = drawn.points
        of_faces = meshes.normals(mesh)[drawn.face]
        own = [name for name in how.columns if name not in NORMALS]
        # weights as a column vector each: what is linear on a face stays so
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
    """At most `points` rows, drawn without replacement, in their order; None: all."""
    if points is None or len(table) <= points:
        return table
    return table[np.sort(random.choice(len(table), points, replace=False))]


def rounded(table: NDArray, source: str, *, centred: bool) -> Float32[np.ndarray, "points columns"]:
    """A cloud as float32, its mean subtracted before where `centred` says so.

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
    """The clouds of all files, from the cache folder `place` where they were read before; a progress bar where not.

    Args:
        root: what the files' names in the cache's key are relative to.
    """
    kept = cache.folder(place) / f"{_key(files, root, how)}.npz"
    try:
        with kept.open("rb") as stream, np.load(stream) as found:
            points, offset = torch.from_numpy(found["points"]), torch.from_numpy(found["offset"])
            faults = json.loads(str(found["faults"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # not there, or damaged: read anew
        points, offset, faults = _read_all(files, how)
        _keep(kept, points=points.numpy(), offset=offset.numpy(), faults=np.array(json.dumps(faults)))
    bad = {int(number) for number in faults}
    good = tuple(number for number in range(len(files)) if number not in bad)
    return Loaded(Packed(points, offset), good, tuple(DataError(text) for text in faults.values()))


def _key(files: Sequence[Path], root: Path, how: Reading) -> str:
    digest = hashlib.sha256(f"{VERSION} {how}\n".encode())
    for file in files:
        state = file.stat()
        digest.update(f"{file.relative_to(root).as_posix()} {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:32]


def _read_all(files: Sequence[Path], how: Reading) -> tuple[Tensor, Tensor, dict[str, str]]:
    clouds, faults = [], {}
    for number in tracked(len(files), "Reading clouds"):
        try:
            clouds.append(cloud(files[number], how))
        except DataError as error:
            faults[str(number)] = str(error)
    sizes = [0, *map(len, clouds)]
    table = np.concatenate(clouds) if clouds else np.empty((0, 3 + len(how.columns)), np.float32)
    return torch.from_numpy(table), torch.from_numpy(np.cumsum(sizes)), faults


def _keep(file: Path, points: NDArray, offset: NDArray, faults: NDArray) -> None:
    """Write an archive whole or not at all."""
    try:
        with replacing(file) as part, part.open("wb") as stream:
            np.savez(stream, points=points, offset=offset, faults=faults)
    except OSError as error:
        raise DataError(
            f"{file} cannot be written ({error}). Free space there, or set FRAMEWORK_CACHE to another folder."
        ) from error


def tracked(count: int, what: str) -> Iterator[int]:
    """0 … count - 1, with a progress bar on a terminal."""
    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bar:
        yield from bar.track(range(count), count, description=what)


def unlabelled(files: Sequence[Path], how: Reading) -> Clouds:
    """A user's own files, "input" and "index", in their order.

    Raises:
        DataError: there are none, or some cannot be read; names the first ten.
    """
    if not files:
        raise DataError(f"No file was given; wanted at least one of {', '.join(meshes.READERS)}.")
    points, offset, faults = _read_all([Path(file) for file in files], how)
    if faults:
        reasons = [DataError(text) for text in faults.values()]
        raise DataError(images.fault_message(reasons, len(files), "Leave them out, or restore them."))
    return Clouds(Packed(points, offset), np.arange(len(files)))


def spared(
    labels: Int[np.ndarray, "samples"], share: float, random: np.random.Generator
) -> Bool[np.ndarray, "samples"]:
    """Which samples to hold out: `share` of all, of every class alike, but never the last of a class.

    Classes give their whole parts, and those with the largest rests one more each, until the number is reached.
    """
    held = np.zeros(len(labels), bool)
    counts = np.bincount(labels) if len(labels) else np.zeros(1, np.int64)
    wanted = share * counts
    give = np.minimum(np.floor(wanted).astype(np.int64), np.maximum(counts - 1, 0))
    rest = np.where(counts - give > 1, wanted - give, -1.0)
    missing = round(share * len(labels)) - int(give.sum())
    for label in np.lexsort([random.random(len(counts)), -rest])[: max(missing, 0)]:
        give[label] += rest[label] > 0
    for label, number in enumerate(give):
        held[random.permutation(np.flatnonzero(labels == label))[:number]] = True
    return held


def folds(
    labels: Int[np.ndarray, "samples"], count: int, random: np.random.Generator
) -> Int[np.ndarray, "samples"]:
    """The fold of each sample: every class is dealt out in turn, so that folds differ by at most one of each."""
    order = np.concatenate(
        [random.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    )
    fold = np.empty(len(labels), np.int64)
    fold[order] = np.arange(len(labels)) % count
    return fold


def apart(
    packed: Packed,
    labels: Int[np.ndarray, "clouds"],
    split: NDArray,
    where: str,
    *,
    source: Mapping[str, str] | None = None,
    **fields: Tensor,
) -> dict[str, Clouds]:
    """The clouds of each split, with "target", "group" (one for all) and the `fields` of every cloud.

    Args:
        split: the name of each cloud's split.
        where: what is split, for messages.
        source: of a split whose clouds are another's.

    Raises:
        DataError: a split is empty.
    """
    found = {}
    for name in SPLITS:
        chosen = np.flatnonzero(split == (source or {}).get(name, name))
        own = {key: values[torch.from_numpy(chosen)] for key, values in fields.items()}
        target, group = torch.from_numpy(labels[chosen]), torch.zeros(len(chosen), dtype=torch.int64)
        found[name] = Clouds(packed, chosen, target=target, group=group, **own)
    require_samples({name: len(clouds) for name, clouds in found.items()}, where)
    return found


def require_samples(sizes: Mapping[str, int], where: str) -> None:
    """Refuse an empty split.

    Raises:
        DataError: names it, and says how many samples the others have.
    """
    for split, size in sizes.items():
        if size == 0:
            shown = ", ".join(f"{name} {number}" for name, number in sizes.items())
            raise DataError(
                f"{where}: the {split} split is empty ({shown}). A class keeps at least one sample for training: add "
                "files, or change the shares."
            )


def digest(names: Sequence[str], labels: Sequence[int], splits: Sequence[str]) -> str:
    """A hash over names, labels and splits."""
    lines = (f"{split} {label} {name}\n" for name, label, split in zip(names, labels, splits, strict=True))
    return hashlib.sha256("".join(lines).encode()).hexdigest()
