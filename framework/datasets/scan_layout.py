"""Layout of a folder of scanned people: registered meshes, cameras, photographs and masks; reader and writer.

    train.txt, validation.txt, test.txt        names of subjects, one per line
    topology_<topology>.npz                    optional: faces, uv, uv_faces of every registration, for texture.png
    subjects/<name>/registration_<topology>.ply    vertices in metres, y up, with 8-bit sRGB colours; faces
    subjects/<name>/cameras.json               {"views": [{"name", "height", "width", "K", "R", "t"}, ...]}
    subjects/<name>/images/<view>.png          8-bit sRGB: the subject's colours wherever the mask is above 0
    subjects/<name>/masks/<view>.png           8-bit grey: share of the pixel that the subject covers
    subjects/<name>/texture.png                optional

Cameras follow OpenCV: a point X, in metres, is seen at the first two numbers of K (R X + t) divided by the third, which
is its depth. The centres of pixels have whole numbers as coordinates.
"""

import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image
from torch import Tensor

from framework.data import Splits
from framework.datasets import images
from framework.errors import DataError, shorten
from framework.geometry import meshes
from framework.geometry.camera import Camera
from framework.geometry.mesh_files import COLOURS
from framework.geometry.ply_writer import write_ply
from framework.storage.arrays import read_npz
from framework.storage.plain_values import plain_numbers, read_json
from framework.storage.reading import open_regular, read_bytes, translate_errors
from framework.storage.text import lines_of

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""Pattern of the names of subjects and views, which become file names."""
PNG_END = b"IEND\xaeB`\x82"
SLACK = 1e-4
"""Largest difference between RRᵀ of a camera's rotation R and the identity, in any entry."""


@dataclass(frozen=True)
class View:
    """One photograph of a subject: the files of its image and mask, and its camera."""

    name: str
    image: Path
    mask: Path
    camera: Camera


@dataclass(frozen=True)
class RegisteredMesh:
    """Mesh that is registered to a subject's scan: vertices in metres, 8-bit sRGB colours, triangles."""

    vertices: Float[Tensor, "vertices 3"]
    colors: UInt8[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]


@dataclass(frozen=True)
class Subject:
    """A subject's registered mesh and views, without the pixels of the images."""

    name: str
    mesh: RegisteredMesh
    views: tuple[View, ...]


@dataclass(frozen=True)
class TexturePlaces:
    """Texture coordinates in texture.png of the triangles of a topology.

    Attributes:
        faces: vertices of each triangle.
        uv: texture coordinates, u to the right and v upwards.
        uv_faces: for each triangle, the rows of `uv` of its three corners.
    """

    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "places 2"]
    uv_faces: Int[np.ndarray, "_faces 3"]


class SubjectFolder(ABC):
    """Base of data sets whose subjects lie in a folder with the layout of `framework.datasets.scan_layout`."""

    @property
    @abstractmethod
    def place(self) -> Path:
        """Return the path of the folder, which need not exist yet.

        Raises:
            DataError: the folder would be generated, but a file from which it is generated is not available.
        """


class Photograph(NamedTuple):
    """8-bit sRGB pixels, valid where the mask is above 0, and the mask: the share of each pixel that is covered."""

    pixels: UInt8[np.ndarray, "height width 3"]
    mask: UInt8[np.ndarray, "height width"]


def read_splits(root: Path) -> dict[str, tuple[str, ...]]:
    """Return the names of each split's subjects.

    Raises:
        DataError: the folder does not exist, or a list is missing, is empty, or names a subject that is listed already.
    """
    if not root.is_dir():
        raise DataError(
            f"data.root = {root}: no such folder; expected a folder that holds subjects, train.txt, validation.txt and "
            "test.txt. Set data.root to such a folder, or to null."
        )
    names_by_split: dict[str, tuple[str, ...]] = {}
    list_of_subject: dict[str, Path] = {}
    for split in Splits._fields:
        file = root / f"{split}.txt"
        with translate_errors(file, "names of subjects, a line each"):
            names = [line.strip() for line in lines_of(read_bytes(file)) if line.strip()]
            if not names:
                raise ValueError("the list is empty; expected one name of a subject in each line")
            for name in names:
                if not NAME.fullmatch(name):
                    raise ValueError(
                        f"{shorten(name)!r} cannot be the name of a folder in {root / 'subjects'}; expected a name "
                        "of letters, digits and ._- that begins with a letter or digit"
                    )
                if name in list_of_subject:
                    raise ValueError(
                        f"subject {name} is already listed in {list_of_subject[name].name}; expected each subject "
                        "once, in one split"
                    )
                list_of_subject[name] = file
        names_by_split[split] = tuple(names)
    return names_by_split


def read_subject(root: Path, name: str, topology: str) -> Subject:
    """Read one subject; pixels are not read, but the size and the end of each photograph and mask are checked.

    Raises:
        DataError: a file is missing or damaged; the message names it.
    """
    folder = root / "subjects" / name
    if not folder.is_dir():
        raise DataError(
            f"{folder}: no such folder; expected the files of the subject {name}. Copy the folder again from its "
            "source, or remove the name from its list."
        )
    mesh = read_registration(folder / f"registration_{topology}.ply")
    views = read_cameras(folder / "cameras.json")
    return Subject(
        name,
        mesh,
        tuple(_checked_view(folder, view, camera) for view, camera in views.items()),
    )


def read_registration(file: Path) -> RegisteredMesh:
    """Read a mesh with one colour per vertex.

    Raises:
        DataError: the file cannot be read, has no faces, or no colours in [0, 1] (0 to 255 for whole numbers).
    """
    if not file.exists() and (files_beside := sorted(file.parent.glob("registration_*.ply"))):
        topologies = ", ".join(other.stem.removeprefix("registration_") for other in files_beside)
        raise DataError(
            f"{file}: no such file, but the folder has the topologies {topologies}. Set data.topology to one of these."
        )
    mesh = meshes.read(file)
    if not len(mesh.faces):
        raise DataError(
            f"{file}: the mesh has no faces; expected the triangles of a registered mesh. Save the mesh with its "
            "triangles."
        )
    return RegisteredMesh(
        torch.from_numpy(mesh.vertices).float(),
        torch.from_numpy(vertex_colors(mesh)),
        torch.from_numpy(mesh.faces),
    )


def vertex_colors(mesh: meshes.Mesh) -> UInt8[np.ndarray, "vertices 3"]:
    """Return the 8-bit colour of each vertex of a mesh.

    Raises:
        DataError: the mesh has no colours.
    """
    if not set(COLOURS) <= set(mesh.columns):
        raise DataError(
            f"{mesh.source}: the vertices have no colours; expected red, green and blue of each vertex. Save the mesh "
            "with vertex colours, for example as PLY."
        )
    return (mesh.attribute(COLOURS) * 255).round().astype(np.uint8)


def read_cameras(file: Path) -> dict[str, Camera]:
    """Return cameras by the names of their views.

    Raises:
        DataError: the file is missing or damaged, a view is named twice, or the numbers of a view are not those of a
            camera.
    """
    cameras: dict[str, Camera] = {}
    document = read_json(file, "cameras")
    with translate_errors(file, "cameras"):
        views = document.get("views")
        if not isinstance(views, list) or not views:
            raise ValueError(
                'the key "views" lists no camera; expected {"views": [...]} with one camera or more'
            )
        for number, view in enumerate(views):
            name = view.get("name") if isinstance(view, dict) else None
            if not isinstance(name, str) or not NAME.fullmatch(name):
                raise ValueError(
                    f"view {number} (from 0) has no name that can be a file name; expected a different name for each "
                    "view"
                )
            if name in cameras:
                raise ValueError(f"view {name} occurs twice; expected a different name for each view")
            cameras[name] = _camera(name, view)
    return cameras


def _camera(name: str, view: Mapping[str, Any]) -> Camera:
    sizes = [view.get(side) for side in ("height", "width")]
    if not all(type(size) is int and 1 <= size <= images.LONGEST_SIDE for size in sizes):
        raise ValueError(
            f"view {name}: height and width are {sizes}; expected whole numbers of pixels from 1 to "
            f"{images.LONGEST_SIDE}"
        )
    numbers = {}
    for key, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,))):
        try:
            numbers[key] = np.array(plain_numbers(view.get(key)), np.float64)
        except (OverflowError, TypeError, ValueError):
            numbers[key] = np.empty(0)
        if numbers[key].shape != shape or not np.isfinite(numbers[key]).all():
            raise ValueError(
                f"view {name}: {key} has the wrong shape or content; expected {'×'.join(map(str, shape))} finite "
                "numbers"
            )
    matrix, rotation, translation = (numbers[key] for key in ("K", "R", "t"))
    deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not deviation < SLACK or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"view {name}: R is not a rotation (RRᵀ differs by {deviation:.2g} from the identity, the determinant is "
            f"{np.linalg.det(rotation):.3g}); expected the rotation from the world to the camera: x right, y down, z "
            "forward"
        )
    if (
        not (matrix[0, 0] > 0 and matrix[1, 1] > 0)
        or abs(matrix[0, 1]) > 0
        or matrix[2].tolist() != [0, 0, 1]
    ):
        raise ValueError(
            f"view {name}: the camera matrix K is {matrix.tolist()}; expected ((fx, 0, cx), (0, fy, cy), (0, 0, 1)) "
            "in pixels, with fx and fy above 0 and without shear"
        )
    height, width = (int(size) for size in sizes if size is not None)
    return Camera(
        torch.from_numpy(rotation).float(),
        torch.from_numpy(translation).float(),
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        height,
        width,
    )


def _checked_view(folder: Path, name: str, camera: Camera) -> View:
    view = View(name, folder / "images" / f"{name}.png", folder / "masks" / f"{name}.png", camera)
    for file in (view.image, view.mask):
        with images.open_image(file) as image:
            _check_size(file, image, camera)
            if tail(file)[-8:] != PNG_END:
                raise ValueError("the file is cut off, or is not a PNG file")
    return view


def tail(file: Path) -> bytes:
    """Return the last 20 bytes of a PNG file: the checksum of its pixels, and the mark of its end."""
    with open_regular(file) as stream:
        stream.seek(max(0, file.stat().st_size - 20))
        return stream.read()


def _check_size(file: Path, image: Image.Image, camera: Camera) -> None:
    if image.size != (camera.width, camera.height):
        raise DataError(
            f"{file}: the image has {image.width} × {image.height} pixels, but its camera has {camera.width} × "
            f"{camera.height}; expected the same size. Correct cameras.json, or scale the image."
        )


def read_photograph(view: View) -> Photograph:
    """Return pixels and mask of a view.

    Raises:
        DataError: a file is damaged, or its size differs from the camera's.
    """
    arrays_read = []
    for file, channels in ((view.image, 3), (view.mask, 1)):
        with images.open_image(file) as image:
            _check_size(file, image, view.camera)
            arrays_read.append(np.array(images.decode(image, channels, upright=False)))
    return Photograph(*arrays_read)


def read_places(root: Path, topology: str) -> TexturePlaces:
    """Return the texture coordinates of the triangles of the topology that is called `topology`.

    Raises:
        DataError: the file is missing or damaged, or its arrays do not fit together.
    """
    file = root / f"topology_{topology}.npz"
    with translate_errors(file, "faces, uv and uv_faces of a topology"):
        arrays = read_npz(read_bytes(file), ("faces", "uv", "uv_faces"))
        places = TexturePlaces(
            arrays["faces"].astype(np.int64),
            arrays["uv"].astype(np.float32),
            arrays["uv_faces"].astype(np.int64),
        )
        fits = places.uv_faces.shape == places.faces.shape == (len(places.faces), 3) and places.uv.shape[
            1:
        ] == (2,)
        fits = fits and np.isfinite(places.uv).all()
        if not fits or places.uv_faces.min() < 0 or places.uv_faces.max() >= len(places.uv):
            raise ValueError(
                f"the arrays have wrong shapes or values: faces {places.faces.shape}, uv_faces "
                f"{places.uv_faces.shape}, uv {places.uv.shape}; expected (faces, 3) for both faces, finite uv "
                "(coordinates, 2), and rows of uv in uv_faces"
            )
    return places


def read_texture(root: Path, name: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return the pixels of a subject's texture.

    Raises:
        DataError: the file is missing or damaged.
    """
    with images.open_image(root / "subjects" / name / "texture.png") as image:
        return np.array(images.decode(image, 3, upright=False))


def write_registration(file: Path, mesh: RegisteredMesh) -> None:
    """Write a registered mesh as binary PLY."""
    write_ply(file, mesh.vertices.numpy(), mesh.faces.numpy(), mesh.colors.numpy())


def write_cameras(file: Path, cameras: Mapping[str, Camera]) -> None:
    """Write cameras with the names of their views as JSON."""
    views = []
    for name, camera in cameras.items():
        (fx, fy), (cx, cy) = (tuple(map(float, pair)) for pair in (camera.focal, camera.principal))
        views.append(
            {
                "name": name,
                "height": camera.height,
                "width": camera.width,
                "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
                "R": camera.rotation.double().tolist(),
                "t": camera.translation.double().tolist(),
            }
        )
    if not all(math.isfinite(number) for view in views for row in view["K"] for number in row):
        raise ValueError(
            "the matrix K of a camera has numbers that are not finite; expected finite numbers. Correct the focal "
            "length or the principal point."
        )
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"views": views}, indent=1) + "\n", encoding="utf-8")


def write_views(folder: Path, cameras: Sequence[Camera], photographs: Sequence[Photograph]) -> None:
    """Write cameras, images and masks of a subject; views are named 000, 001 and so on."""
    names = [f"{view:03}" for view in range(len(cameras))]
    write_cameras(folder / "cameras.json", dict(zip(names, cameras, strict=True)))
    for kind in ("images", "masks"):
        (folder / kind).mkdir()
    for name, photograph in zip(names, photographs, strict=True):
        Image.fromarray(photograph.pixels).save(folder / "images" / f"{name}.png", compress_level=4)
        Image.fromarray(photograph.mask).save(folder / "masks" / f"{name}.png", compress_level=4)


def write_splits(root: Path, names: Mapping[str, Sequence[str]]) -> None:
    """Write the list of subjects of each split."""
    for split, subjects in names.items():
        (root / f"{split}.txt").write_text("".join(f"{name}\n" for name in subjects), encoding="utf-8")
