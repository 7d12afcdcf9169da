"""Textures of the subjects in a folder of `human_scans`, for the meshes of these subjects."""

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

KEPT = 16
"""Number of textures that stay in memory: they take 67 MB if they have 512 × 512 texels."""


class Textures:
    """Textures that are looked up by the colours of the registered vertices, which identify a subject.

    A texture is therefore never drawn on another subject, even if the lists have another order or the folder is another
    one. An unknown subject is refused.

    Args:
        root: the folder, in the layout of scan_layout.
        topology: topology of the registered meshes.
        faces: their triangles.
        longest: largest number of texels along a side; larger textures are averaged in linear RGB.

    Raises:
        DataError: the folder, the texture coordinates of the topology or a subject's texture is missing or damaged, or
            two subjects with different textures have the same colours.
    """

    def __init__(self, root: Path, topology: str, faces: Int[Tensor, "faces 3"], longest: int) -> None:
        if not root.is_dir():
            raise DataError(
                f"{root}: no such folder; expected the folder of the subjects, which holds the textures. Copy it again "
                "from its source (people are generated again by mode=test with this checkpoint), or use vertex "
                "colours: smplpix/rasterised."
            )
        places = scan_layout.read_places(root, topology)
        if places.faces.shape != tuple(faces.shape) or (places.faces != faces.numpy()).any():
            raise DataError(
                f"{root / f'topology_{topology}.npz'}: the {len(places.faces)} faces in this file are not the "
                f"{len(faces)} faces of the registered meshes; expected the faces of registration_{topology}.ply in "
                "the same order. Write the file again."
            )
        self.root, self.longest = root, longest
        self.uv, self.uv_faces = torch.from_numpy(places.uv), torch.from_numpy(places.uv_faces)
        self.files: dict[bytes, Path] = {}
        for name in (name for some in scan_layout.read_splits(root).values() for name in some):
            folder = root / "subjects" / name
            file = folder / "texture.png"
            if not file.is_file():
                raise DataError(
                    f"{file}: no such file; expected the texture of this subject. Add the file (for generated people: "
                    "set data.texture_side above 0), or use vertex colours: smplpix/rasterised."
                )
            registration = scan_layout.read_registration(folder / f"registration_{topology}.ply")
            self.vertices = len(registration.vertices)
            other = self.files.setdefault(_known_by(registration.colors), file)
            if other != file and read_bytes(other) != read_bytes(file):
                raise DataError(
                    f"{file.parent} and {other.parent} have the same vertex colours, by which textures are found, but "
                    "different textures. Give each subject the colours of its own scan."
                )

    def of(self, colors: Float[Tensor, "points 3"], row: int) -> Texture:
        """Return the texture of the mesh with these vertex colours.

        Args:
            colors: sRGB numbers in [0, 1].
            row: row of the batch, for the message.

        Raises:
            DataError: no subject has these colours.
        """
        numbers = (colors[: self.vertices].float() * 255).round().clamp(0, 255)
        file = self.files.get(_known_by(numbers.to(torch.uint8)))
        if file is None:
            raise DataError(
                f"Row {row} of the batch has the vertex colours of no subject in {self.root}; expected the colours of "
                "a subject, because other meshes have no texture. Use registrations of that folder, or use vertex "
                "colours: smplpix/rasterised."
            )
        return Texture((_light(file, self.longest),), self.uv, self.uv_faces)


def _known_by(colors: UInt8[Tensor, "vertices 3"]) -> bytes:
    return hashlib.sha256(colors.numpy().tobytes()).digest()


@lru_cache(maxsize=KEPT)
def _light(file: Path, longest: int) -> Float[Tensor, "height width 4"]:
    """Return a texture in linear RGB with a channel of ones, which renders as the share of a pixel that is covered."""
    pixels = scan_layout.read_texture(file.parents[2], file.parent.name)
    light = linear_from_bytes(torch.from_numpy(pixels))
    times = -(-max(light.shape[:2]) // longest)
    if times > 1:
        size = (-(-light.shape[0] // times), -(-light.shape[1] // times))
        light = adaptive_avg_pool2d(light.movedim(-1, 0), size).movedim(0, -1)
    return torch.cat([light, torch.ones_like(light[..., :1])], -1).contiguous()
