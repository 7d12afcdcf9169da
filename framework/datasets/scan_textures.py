"""Textures of scanned people, for their registered meshes (`framework.datasets.scan_layout`)."""

import hashlib
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from framework.datasets import scan_layout
from framework.errors import DataError
from framework.geometry.srgb import linear_from_bytes
from framework.renderer import Texture
from framework.storage.reading import read_bytes

TEXELS = 4
"""Largest number of texels along a side of a texture for each pixel of the image's longer side.

Finer textures are averaged. In images of the default body, some 6 × 6 texels then lie in a pixel. A renderer that takes
4 × 4 samples per pixel, and interpolates between texels, therefore skips no texel.
"""
CACHED = 16
"""Number of textures that stay in memory: together 67 MB for textures of 512 × 512 texels."""


class Textures:
    """Textures of subjects, looked up by the colours of the registered vertices, which identify a subject.

    A texture is therefore never drawn on another subject, even if a folder or its lists of subjects are exchanged.

    Args:
        root: folder of the subjects, in the layout of `framework.datasets.scan_layout`.
        topology: topology of the registered meshes.
        faces: triangles of the registered meshes.
        longest: largest number of texels along a side; larger textures are averaged in linear RGB.

    Raises:
        DataError: the folder, the texture coordinates of the topology or a subject's texture is missing or damaged, or
            two subjects with different textures have the same vertex colours.
    """

    def __init__(self, root: Path, topology: str, faces: Int[Tensor, "faces 3"], longest: int) -> None:
        if not root.is_dir():
            raise DataError(
                f"{root}: no such folder; expected the folder of the subjects, which holds the textures. Copy the "
                "folder again from its source (mode=test with this checkpoint writes generated people again), or use "
                "vertex colours: experiment=smplpix/rasterised."
            )
        uv_map = scan_layout.read_places(root, topology)
        if uv_map.faces.shape != tuple(faces.shape) or (uv_map.faces != faces.numpy()).any():
            raise DataError(
                f"{root / f'topology_{topology}.npz'}: the {len(uv_map.faces)} faces in this file are not the "
                f"{len(faces)} faces of the registered meshes; expected the faces of registration_{topology}.ply in "
                "the same order. Write the .npz file again."
            )
        self.root, self.longest = root, longest
        self.uv, self.uv_faces = torch.from_numpy(uv_map.uv), torch.from_numpy(uv_map.uv_faces)
        self.files: dict[bytes, Path] = {}
        for name in (name for some in scan_layout.read_splits(root).values() for name in some):
            folder = root / "subjects" / name
            file = folder / "texture.png"
            if not file.is_file():
                raise DataError(
                    f"{file}: no such file; expected the texture of this subject. Add the file (for generated people: "
                    "set data.texture_side above 0), or use vertex colours: experiment=smplpix/rasterised."
                )
            registered = scan_layout.read_registration(folder / f"registration_{topology}.ply")
            self.vertices = len(registered.vertices)
            other = self.files.setdefault(_digest(registered.colors), file)
            if other != file and read_bytes(other) != read_bytes(file):
                raise DataError(
                    f"{file.parent} and {other.parent} have the same vertex colours, which identify a subject, but "
                    "different textures. Give each subject the vertex colours of the subject's own scan."
                )

    def look_up(self, colors: Float[Tensor, "points 3"], row: int) -> Texture:
        """Return the texture of the subject with these vertex colours.

        Args:
            colors: sRGB numbers in [0, 1].
            row: row of the batch, for the message.

        Raises:
            DataError: no subject has these vertex colours.
        """
        numbers = (colors[: self.vertices].float() * 255).round().clamp(0, 255)
        file = self.files.get(_digest(numbers.to(torch.uint8)))
        if file is None:
            raise DataError(
                f"Row {row} of the batch has the vertex colours of no subject in {self.root}; expected the colours of "
                "a subject, because other meshes have no texture. Use registrations of that folder, or use vertex "
                "colours: experiment=smplpix/rasterised."
            )
        return Texture((_linear_texture(file, self.longest),), self.uv, self.uv_faces)


def _digest(colors: UInt8[Tensor, "vertices 3"]) -> bytes:
    """Return the hash of vertex colours that identifies a subject."""
    return hashlib.sha256(colors.numpy().tobytes()).digest()


@lru_cache(maxsize=CACHED)
def _linear_texture(file: Path, longest: int) -> Float[Tensor, "height width 4"]:
    """Return a texture in linear RGB with a channel of ones, which renders as the covered share of each pixel."""
    pixels = scan_layout.read_texture(file.parents[2], file.parent.name)
    linear = linear_from_bytes(torch.from_numpy(pixels))
    factor = -(-max(linear.shape[:2]) // longest)
    if factor > 1:
        size = (-(-linear.shape[0] // factor), -(-linear.shape[1] // factor))
        linear = adaptive_avg_pool2d(linear.movedim(-1, 0), size).movedim(0, -1)
    return torch.cat([linear, torch.ones_like(linear[..., :1])], -1).contiguous()
