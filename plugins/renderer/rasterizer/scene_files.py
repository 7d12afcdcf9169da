"""Reader of a user's scene files: surfaces, colours and textures."""

import re
from os import fsdecode
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from framework.errors import DataError, did_you_mean
from framework.geometry import meshes
from framework.geometry.mesh_files import COLOURS
from framework.geometry.srgb import linear_from_bytes
from framework.storage.reading import read_bytes, translate_errors
from plugins.renderer.rasterizer import gltf, obj_materials
from plugins.renderer.rasterizer.parts import Axis, Part, Pictures, Subject, drawn_without, subject

UPWARDS: dict[str, Axis] = {".glb": "y", ".gltf": "y", ".obj": "y", ".off": "z", ".ply": "y", ".stl": "z"}
"""File suffixes that can be read, and the axis that points upwards in most such files."""
PLACES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
"""Names that PLY files use for places in a texture."""


def read(file: Path) -> Subject:
    """Return a file's surfaces in the file's own axes and unit, in linear RGB.

    Raises:
        DataError: there is no such file or format, the file is damaged, has points without faces, or has a texture
            that is too large or that lies in another folder.
    """
    suffix = file.suffix.lower()
    if file.is_dir():
        raise DataError(f"{file} is a folder; wanted a file whose name ends in {', '.join(UPWARDS)}.")
    if suffix not in UPWARDS:
        raise DataError(
            f"{file}: cannot be read; wanted a file whose name ends in {', '.join(UPWARDS)}."
            f"{did_you_mean(suffix, UPWARDS)}"
        )
    if not file.exists():
        near = did_you_mean(file.name, (other.name for other in file.parent.glob("*")))
        raise DataError(f"{file}: no such file; wanted a scene. Mend the path.{near}")
    if suffix in (".glb", ".gltf"):
        return gltf.read(file)
    notes: list[str] = []
    with translate_errors(file, suffix[1:].upper()):
        mesh = meshes.read(file)
        part = Part(mesh.vertices, mesh.faces, _colors(mesh))
        parts = [part]
        if suffix == ".obj":
            parts = obj_materials.parts(file, read_bytes(file), part, Pictures(), notes)
        elif suffix == ".ply":
            parts = [_textured(file, mesh, part, notes)]
        return subject(parts, UPWARDS[suffix], notes)


def _colors(mesh: meshes.Mesh) -> Float[np.ndarray, "vertices 3"] | None:
    """Return the vertices' colours, which files store as sRGB, as linear RGB."""
    if not set(COLOURS) <= set(mesh.columns):
        return None
    stored = np.round(255 * mesh.attribute(COLOURS)).astype(np.uint8)
    return linear_from_bytes(torch.from_numpy(stored)).double().numpy()


def _textured(file: Path, mesh: meshes.Mesh, part: Part, notes: list[str]) -> Part:
    """Return the part with the texture that a PLY file names in a comment, as Blender and MeshLab write it."""
    head = read_bytes(file).split(b"end_header", 1)[0]
    named = re.search(rb"[\r\n]comment TextureFile[ \t]+([^\r\n]+)", head)
    if named is None:
        return part
    name = fsdecode(named[1].strip())
    places = next((pair for pair in PLACES if set(pair) <= set(mesh.columns)), None)
    if places is None:
        notes.append("its texture lies on faces and not on vertices: drawn without; save it as OBJ or GLB.")
        return part
    texture = drawn_without(file.parent, name, "texture is", notes)
    if texture is None:
        return part
    with translate_errors(texture, "a texture"):
        image = Pictures().decode(name, read_bytes(texture), str(texture))
    return Part(part.vertices, part.faces, part.colors, image, mesh.attribute(places))
