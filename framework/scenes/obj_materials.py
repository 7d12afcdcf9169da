"""Reader of colours in Wavefront OBJ files: texture coordinates, and materials of an MTL file beside the OBJ file.

The package trimesh is not used, because it reads 104 of 126 valid test files as another scene or not at all, and 42 of
46 wrong files without an error (version 5.2.0; see docs/reference/files.md).
"""

from dataclasses import dataclass, field
from os import fsdecode
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from framework.errors import DataError, quote
from framework.geometry import mesh_files
from framework.geometry.mesh_files import join_continued_lines, line_numbers, statements
from framework.renderer import Wrap
from framework.scenes.parts import NO_COORDINATES, Part, TextureDecoder, find_beside
from framework.storage.limits import MOST_MATERIALS
from framework.storage.reading import read_bytes, translate_errors

OPTIONS = {"-blendu": 1, "-blendv": 1, "-cc": 1, "-boost": 1, "-imfchan": 1, "-texres": 1}
"""Texture options without effect on texture coordinates or wrap rule, and the number of words after each option."""
NAMES = (b"usemtl", b"mtllib", b"newmtl", b"map_Kd")
"""Statements whose line ends with a name. In a name such as `wall #1` or `#ff0000`, # does not begin a comment."""


@dataclass
class Material:
    """The colour and texture of a surface.

    Attributes:
        color: linear RGB; None if the file gives no colour. The stored numbers are read as linear RGB, which Blender
            writes.
        texture: path of the texture file as it stands in the MTL file.
        library: the MTL file.
        wrap: rule for texture coordinates beyond the texture's edges.
    """

    color: Float[np.ndarray, "3"] | None = None
    texture: str = ""
    library: Path = Path()
    wrap: Wrap = "repeat"


@dataclass
class FaceCorners:
    """Texture coordinates and materials of the faces of an OBJ file.

    Attributes:
        uv: texture coordinates, u to the right, v upwards.
        rows: indices of `uv` for each triangle; -1 for a corner without texture coordinates.
        materials: name of each triangle's material; "" without a material.
        libraries: names of the MTL files.
    """

    uv: Float[np.ndarray, "places 2"]
    rows: Int[np.ndarray, "faces 3"]
    materials: list[str]
    libraries: list[str] = field(default_factory=list)


def split_by_material(
    file: Path, content: bytes, mesh: Part, textures: TextureDecoder, notes: list[str]
) -> list[Part]:
    """Split the mesh of an OBJ file by material, and return one part for each material.

    Args:
        file: path of the OBJ file.
        content: bytes of the OBJ file.
        mesh: mesh of the OBJ file.
        textures: decoder of textures.
        notes: list to which a sentence about each missing file is added.

    Raises:
        DataError: a file that the OBJ file refers to is damaged.
        ValueError: a face refers to texture coordinates that do not exist.
    """
    corners = _read_corners(content)
    materials: dict[str, Material] = {}
    for name in corners.libraries:
        library = find_beside(file.parent, name, "materials are", notes)
        if library is not None:
            materials |= _read_materials(library)
    names = list(dict.fromkeys(corners.materials))
    if len(names) > MOST_MATERIALS:
        raise DataError(
            f"the file has {len(names)} materials, but at most {MOST_MATERIALS} are supported. Merge some materials."
        )
    numbers = {name: number for number, name in enumerate(names)}
    face_materials = np.array([numbers[name] for name in corners.materials], np.int64)
    order = np.argsort(face_materials, kind="stable")
    starts = np.searchsorted(face_materials[order], np.arange(len(names) + 1))
    parts = []
    for number, name in enumerate(names):
        rows = order[starts[number] : starts[number + 1]]
        parts.append(_make_part(mesh, rows, corners, materials.get(name, Material()), textures, notes))
    return parts


def _make_part(
    mesh: Part,
    rows: Int[np.ndarray, "chosen"],
    corners: FaceCorners,
    material: Material,
    textures: TextureDecoder,
    notes: list[str],
) -> Part:
    used, faces = np.unique(mesh.faces[rows], return_inverse=True)
    vertices, faces = mesh.vertices[used], faces.reshape(-1, 3)
    colors = None if mesh.colors is None else mesh.colors[used]
    if material.color is not None:
        colors = np.tile(material.color, (len(used), 1)) * (1 if colors is None else colors)
    uv_rows = corners.rows[rows]
    texture = _find_texture(material, notes)
    if texture is not None and (uv_rows < 0).any():
        notes.append(NO_COORDINATES)
        texture = None
    if texture is None:
        return Part(vertices, faces, colors)
    image = textures.read(texture)
    own, uv_rows = np.unique(uv_rows, return_inverse=True)
    wraps = material.wrap, material.wrap
    return Part(vertices, faces, colors, image, corners.uv[own], uv_rows.reshape(-1, 3), wraps)


def _find_texture(material: Material, notes: list[str]) -> Path | None:
    if not material.texture:
        return None
    with translate_errors(material.library, "an MTL file"):
        return find_beside(material.library.parent, material.texture, "texture is", notes)


def _read_corners(content: bytes) -> FaceCorners:
    points, words, counts, uv_counts, materials, libraries = [], [], [], [], [], []
    material = ""
    content = join_continued_lines(content)
    for key, rest in statements(content, NAMES):
        if key == b"vt":
            points.append(b" ".join([*rest.split(), b"0"][:2]))  # v is 0 if only u is given
        elif key == b"f":
            corners = rest.split()
            words += [(corner + b"//").split(b"/", 2)[1] or b"0" for corner in corners]
            counts.append(len(corners))
            uv_counts.append(len(points))
            materials.append(material)
        elif key == b"usemtl":
            material = fsdecode(rest)
        elif key == b"mtllib":
            libraries.append(fsdecode(rest))
    uv = mesh_files.rows(points, "texture coordinate", 2, line_numbers(content, names=NAMES, key=b"vt"))
    sizes = np.array(counts, np.int64)
    uv_rows = mesh_files.from_zero(mesh_files.numbers(words, np.int64), uv_counts, sizes)
    if uv_rows.size and not (uv_rows.min() >= -1 and uv_rows.max() < len(uv)):
        raise ValueError(
            f"a face of the OBJ file refers to texture coordinate {uv_rows.max() + 1}, but the texture coordinates "
            f"are numbered 1 to {len(uv)}"
        )
    triangles = mesh_files.fans(sizes, uv_rows)
    repeated = np.repeat(np.arange(len(sizes)), sizes - 2)
    return FaceCorners(
        uv, triangles, [materials[face] for face in repeated.tolist()], list(dict.fromkeys(libraries))
    )


def _read_materials(library: Path) -> dict[str, Material]:
    """Return the materials of an MTL file by name: colours (Kd) and textures (map_Kd)."""
    materials: dict[str, Material] = {}
    with translate_errors(library, "an MTL file"):
        current = Material()
        content = read_bytes(library)
        for number, (key, value) in enumerate(statements(content, NAMES)):
            if key == b"newmtl":
                current = materials.setdefault(fsdecode(value), Material())
            elif key == b"Kd":
                color = mesh_files.rows(
                    [value], "colour Kd", 3, line_numbers(content, names=NAMES, first=number)
                )[0]
                if not np.isfinite(color).all():
                    raise ValueError(
                        f"the colour Kd of a material is {color.tolist()}; expected three finite numbers from 0 to 1"
                    )
                current.color = color
            elif key == b"map_Kd":
                _set_texture(current, fsdecode(value).split(" "), library)
    return materials


def _set_texture(material: Material, words: list[str], library: Path) -> None:
    while words and words[0].startswith("-"):
        if words[0] == "-clamp" and len(words) > 1:
            material.wrap = "clamp" if words[1] == "on" else "repeat"
            words = words[2:]
        elif words[0] in OPTIONS:
            words = words[1 + OPTIONS[words[0]] :]
        else:
            raise ValueError(
                f"a texture of the material file has the option {quote(words[0])}, which is not supported. Save the "
                "file without this option"
            )
    if words:
        material.texture, material.library = " ".join(words).strip(), library
