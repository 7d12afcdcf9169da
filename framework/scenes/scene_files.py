"""Reader of scene files: surfaces, colours and textures.

docs/reference/files.md says why the package trimesh is not used to read scene files.
"""

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
from framework.scenes import gltf, obj_materials
from framework.scenes.parts import Axis, Part, Subject, TextureDecoder, find_beside, join_parts
from framework.storage.reading import read_bytes, translate_errors

UPWARDS: dict[str, Axis] = {".glb": "y", ".gltf": "y", ".obj": "y", ".off": "z", ".ply": "y", ".stl": "z"}
"""File suffixes that can be read, and the axis that points upwards in most such files."""
UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
"""Column names of texture coordinates in PLY files."""


def read(file: Path) -> Subject:
    """Read the surfaces of a scene file, in the file's own axes and unit, with colours in linear RGB.

    Raises:
        DataError: the file is missing or damaged, its format is unknown, it has points without faces, or it has a
            texture that is too large.
    """
    suffix = file.suffix.lower()
    if file.is_dir():
        raise DataError(f"{file} is a folder. Give a file whose name ends in {', '.join(UPWARDS)}.")
    if suffix not in UPWARDS:
        raise DataError(
            f"{file}: this format cannot be read. Give a file whose name ends in {', '.join(UPWARDS)}."
            f"{did_you_mean(suffix, UPWARDS)}"
        )
    if not file.exists():
        suggestion = did_you_mean(file.name, (other.name for other in file.parent.glob("*")))
        raise DataError(f"{file}: the file does not exist. Correct the path of the scene file.{suggestion}")
    if suffix in (".glb", ".gltf"):
        return gltf.read(file)
    notes: list[str] = []
    with translate_errors(file, suffix[1:].upper()):
        mesh = meshes.read(file)
        part = Part(mesh.vertices, mesh.faces, _vertex_colors(mesh))
        parts = [part]
        if suffix == ".obj":
            parts = obj_materials.split_by_material(file, read_bytes(file), part, TextureDecoder(), notes)
        elif suffix == ".ply":
            parts = [_add_texture(file, mesh, part, notes)]
        return join_parts(parts, UPWARDS[suffix], notes)


def _vertex_colors(mesh: meshes.Mesh) -> Float[np.ndarray, "vertices 3"] | None:
    """Return the colours of vertices, which files store as sRGB, as linear RGB; None without colours."""
    if not set(COLOURS) <= set(mesh.columns):
        return None
    stored = np.round(255 * mesh.attribute(COLOURS)).astype(np.uint8)
    return linear_from_bytes(torch.from_numpy(stored)).double().numpy()


def _add_texture(file: Path, mesh: meshes.Mesh, part: Part, notes: list[str]) -> Part:
    """Return the part with the texture that a PLY file names in a comment (written so by Blender and MeshLab)."""
    head = read_bytes(file).split(b"end_header", 1)[0]
    named = re.search(rb"[\r\n]comment TextureFile[ \t]+([^\r\n]+)", head)
    if named is None:
        return part
    name = fsdecode(named[1].strip())
    uv_names = next((pair for pair in UV_NAMES if set(pair) <= set(mesh.columns)), None)
    if uv_names is None:
        notes.append(
            "the texture coordinates belong to faces and not to vertices, so the texture is left out. Save the scene "
            "as OBJ or GLB."
        )
        return part
    texture = find_beside(file.parent, name, "texture is", notes)
    if texture is None:
        return part
    image = TextureDecoder().read(texture)
    return Part(part.vertices, part.faces, part.colors, image, mesh.attribute(uv_names))
