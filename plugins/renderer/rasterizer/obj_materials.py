"""Reader of colours in Wavefront OBJ files: places in textures, and materials of an MTL file beside the OBJ file."""

from dataclasses import dataclass, field
from os import fsdecode
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from framework.errors import DataError, quote
from framework.geometry import mesh_files
from framework.geometry.mesh_files import join_continued_lines, line_numbers, text_lines
from framework.renderer import Wrap
from framework.storage.limits import MOST_MATERIALS
from framework.storage.reading import read_bytes, translate_errors
from plugins.renderer.rasterizer.parts import Part, Pictures, drawn_without

OPTIONS = {"-blendu": 1, "-blendv": 1, "-cc": 1, "-boost": 1, "-imfchan": 1, "-texres": 1}
"""Texture options that do not change place or repetition, and the number of words that follow each."""
NAMES = (b"usemtl", b"mtllib", b"newmtl", b"map_Kd")
"""Statements that end in a name, to the end of the line: in `wall #1` or `#ff0000` the # begins no comment."""


@dataclass
class Material:
    """The colour and texture of a surface.

    Attributes:
        color: linear RGB; None where the file gives none. The numbers are read as linear, as Blender writes them.
        texture: the texture file's name as the MTL file gives it.
        library: the MTL file.
        wrap: what lies beyond the texture's edges.
    """

    color: Float[np.ndarray, "3"] | None = None
    texture: str = ""
    library: Path = Path()
    wrap: Wrap = "repeat"


@dataclass
class Corners:
    """Texture places and materials of the faces of an OBJ file.

    Attributes:
        uv: places in textures, u to the right, v upwards.
        rows: rows of `uv` for each triangle; -1 where a corner has none.
        materials: name of each triangle's material, "" for none.
        libraries: files with materials.
    """

    uv: Float[np.ndarray, "places 2"]
    rows: Int[np.ndarray, "faces 3"]
    materials: list[str]
    libraries: list[str] = field(default_factory=list)


def parts(file: Path, content: bytes, mesh: Part, pictures: Pictures, notes: list[str]) -> list[Part]:
    """Return the mesh of an OBJ file, split by its materials.

    Args:
        file: path of the OBJ file.
        content: its bytes.
        mesh: its mesh.
        pictures: decoder of textures.
        notes: receives a sentence about each file that is missing, or lies elsewhere.

    Raises:
        DataError: a file that the OBJ file refers to is damaged.
        ValueError: a face refers to a texture place that does not exist.
    """
    corners = _corners(content)
    known: dict[str, Material] = {}
    for name in corners.libraries:
        library = drawn_without(file.parent, name, "materials are", notes)
        if library is not None:
            known |= _materials(library)
    names = list(dict.fromkeys(corners.materials))
    if len(names) > MOST_MATERIALS:
        raise DataError(f"it has {len(names)} materials; wanted at most {MOST_MATERIALS}.")
    number = {name: place for place, name in enumerate(names)}
    of_faces = np.array([number[name] for name in corners.materials], np.int64)
    order = np.argsort(of_faces, kind="stable")
    edges = np.searchsorted(of_faces[order], np.arange(len(names) + 1))
    found = []
    for place, name in enumerate(names):
        rows = order[edges[place] : edges[place + 1]]
        found.append(_part(mesh, rows, corners, known.get(name, Material()), pictures, notes))
    return found


def _part(
    mesh: Part,
    rows: Int[np.ndarray, "chosen"],
    corners: Corners,
    material: Material,
    pictures: Pictures,
    notes: list[str],
) -> Part:
    used, faces = np.unique(mesh.faces[rows], return_inverse=True)
    vertices, faces = mesh.vertices[used], faces.reshape(-1, 3)
    colors = None if mesh.colors is None else mesh.colors[used]
    if material.color is not None:
        colors = np.tile(material.color, (len(used), 1)) * (1 if colors is None else colors)
    places = corners.rows[rows]
    texture = _texture_of(material, notes)
    if texture is None:
        return Part(vertices, faces, colors)
    if (places < 0).any():
        notes.append("a part with a texture says no places in it, and is drawn without.")
        return Part(vertices, faces, colors)
    image = pictures.known(texture)
    if image is None:
        with translate_errors(texture, "a texture"):
            content = read_bytes(texture)
        image = pictures.decode(texture, content, str(texture))
    own, places = np.unique(places, return_inverse=True)
    wraps = material.wrap, material.wrap
    return Part(vertices, faces, colors, image, corners.uv[own], places.reshape(-1, 3), wraps)


def _texture_of(material: Material, notes: list[str]) -> Path | None:
    if not material.texture:
        return None
    with translate_errors(material.library, "an MTL file"):
        return drawn_without(material.library.parent, material.texture, "texture is", notes)


def _corners(content: bytes) -> Corners:
    points, words, counts, before, materials, libraries = [], [], [], [], [], []
    material = ""
    content = join_continued_lines(content)
    for line in text_lines(content, names=NAMES):
        key, said = _statement(line)
        rest = said.split()
        if key == b"vt":
            points.append(b" ".join([*rest, b"0"][:2]))  # v is 0 where only u is given
        elif key == b"f":
            words += [word.partition(b"/")[2].partition(b"/")[0] or b"0" for word in rest]
            counts.append(len(rest))
            before.append(len(points))
            materials.append(material)
        elif key == b"usemtl":
            material = fsdecode(said)
        elif key == b"mtllib":
            libraries.append(fsdecode(said))
    uv = mesh_files.rows(points, "place in a texture", 2, line_numbers(content, names=NAMES, key=b"vt"))
    places = mesh_files.numbers(words, np.int64)
    sizes = np.array(counts, np.int64)
    places = np.where(places < 0, places + np.repeat(np.array(before, np.int64), sizes), places - 1)
    if places.size and not (places.min() >= -1 and places.max() < len(uv)):
        raise ValueError(
            f"a face names place {places.max() + 1} in a texture, but there are only 1 to {len(uv)}"
        )
    triangles = mesh_files.fans(sizes, places)
    repeated = np.repeat(np.arange(len(sizes)), sizes - 2)
    return Corners(
        uv, triangles, [materials[face] for face in repeated.tolist()], list(dict.fromkeys(libraries))
    )


def _statement(line: bytes) -> tuple[bytes, bytes]:
    """Return the first word of a line and the rest, which may be a name with blanks."""
    key, *rest = line.split(None, 1)
    return key, rest[0].strip() if rest else b""


def _materials(library: Path) -> dict[str, Material]:
    """Return the colours (Kd) and textures (map_Kd) of an MTL file, by name."""
    found: dict[str, Material] = {}
    with translate_errors(library, "an MTL file"):
        current = Material()
        content = read_bytes(library)
        for number, line in enumerate(text_lines(content, names=NAMES)):
            key, said = _statement(line)
            if key == b"newmtl":
                current = found.setdefault(fsdecode(said), Material())
            elif key == b"Kd":
                color = mesh_files.rows(
                    [said], "colour Kd", 3, line_numbers(content, names=NAMES, first=number)
                )[0]
                if not np.isfinite(color).all():
                    raise ValueError(
                        f"its colour Kd is {color.tolist()}; wanted three finite numbers from 0 to 1"
                    )
                current.color = color
            elif key == b"map_Kd":
                _texture(current, fsdecode(said).split(" "), library)
    return found


def _texture(material: Material, words: list[str], library: Path) -> None:
    while words and words[0].startswith("-"):
        if words[0] == "-clamp" and len(words) > 1:
            material.wrap = "clamp" if words[1] == "on" else "repeat"
            words = words[2:]
        elif words[0] in OPTIONS:
            words = words[1 + OPTIONS[words[0]] :]
        else:
            raise ValueError(
                f"its texture has the option {quote(words[0])}, which is not understood; save it without"
            )
    if words:
        material.texture, material.library = " ".join(words).strip(), library
