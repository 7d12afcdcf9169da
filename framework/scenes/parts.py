"""Parts of a scene in the form in which files store them, and functions that join parts into one scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from os.path import normpath
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from framework.datasets import images
from framework.errors import DataError, quote, shorten
from framework.geometry.camera import look_from
from framework.geometry.srgb import linear_from_bytes
from framework.renderer import Scene, Texture, Wrap, join_scenes
from framework.storage.limits import FEW_TEXELS, MOST_TEXELS, TEXELS_PER_BYTE
from framework.storage.reading import read_bytes, translate_errors

Axis = Literal["y", "z"]
GREY = 0.55
"""Linear RGB value of a surface without a colour in its file."""
FARTHEST = 1e30
"""Largest coordinate for which float32 can hold the depth."""
PLACEHOLDER_CAMERA = look_from(0.0, 0.0, 0.0, 1.0, 1.0, (1, 1))
NO_COORDINATES = "a part with a texture has no texture coordinates, so the texture is left out."
"""Note about a texture that cannot be placed."""
EDGE = 1e-4
"""Largest distance of uv beyond a texture's edge that counts as rounding error and needs no wrap rule."""


@dataclass(frozen=True)
class Part:
    """Triangles of one material.

    Attributes:
        vertices: positions, in metres or in the file's unit.
        faces: indices of `vertices`, counter-clockwise when seen from outside.
        colors: linear RGB in [0, 1], multiplied by the texture's colours; None if the file gives no colours.
        image: the texture, linear RGB in [0, 1], rows from top to bottom; None without a texture.
        uv: texture coordinates, u to the right, v upwards; None if the file gives none.
        corners: indices of `uv` for each face; None if they equal `faces`.
        wraps: rules for texture coordinates beyond the image's edges, along u and along v.
        smooth: whether to interpolate between texels.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    colors: Float[np.ndarray, "vertices 3"] | None = None
    image: Float[Tensor, "height width 3"] | None = None
    uv: Float[np.ndarray, "places 2"] | None = None
    corners: Int[np.ndarray, "faces 3"] | None = None
    wraps: tuple[Wrap, Wrap] = ("repeat", "repeat")
    smooth: bool = True


@dataclass(frozen=True)
class Subject:
    """The content of a scene file.

    Attributes:
        scene: all surfaces, in the file's own axes and unit; the camera is a placeholder.
        plain: True for vertices of parts with a single colour and no texture; only shading makes their shape visible.
        up: the axis that points upwards by the convention of the file's format.
        notes: one sentence about each element of the file that the scene leaves out.
    """

    scene: Scene
    plain: Bool[Tensor, "vertices"]
    up: Axis
    notes: tuple[str, ...] = ()


def join_parts(parts: Sequence[Part], up: Axis, notes: Sequence[str] = ()) -> Subject:
    """Join the parts of a file into one scene.

    Args:
        parts: surfaces of the file; parts without faces are ignored.
        up: the axis that points upwards.
        notes: sentences about elements of the file that are left out; repeated sentences are kept once.

    Raises:
        DataError: there are no faces, a coordinate is not finite or too large, or two textures need different wrap
            rules.
    """
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise DataError(
            "the file has no faces, only points or lines, but a surface is required. Create a mesh from the points "
            "first."
        )
    for part in parts:
        for quantity, numbers in (("coordinate", part.vertices), ("texture coordinate", part.uv)):
            if numbers is not None and not np.isfinite(numbers).all():
                raise DataError(
                    f"a {quantity} of the scene is not finite; expected finite numbers. Copy the file again from its "
                    "source."
                )
        if np.abs(part.vertices).max() > FARTHEST:
            raise DataError(
                f"a coordinate of the scene is larger than {FARTHEST:g}; expected coordinates in metres. Scale the "
                "scene down."
            )
    wrap, smooth = _find_wrap(parts), all(part.smooth for part in parts if part.image is not None)
    scene = join_scenes([_part_to_scene(part, wrap, smooth) for part in parts])
    plain = [torch.full((len(part.vertices),), _has_one_color(part)) for part in parts]
    return Subject(scene, torch.cat(plain), up, tuple(dict.fromkeys(notes)))


def _part_to_scene(part: Part, wrap: Wrap, smooth: bool) -> Scene:
    light = 1.0 if part.image is not None else GREY
    colors = np.full_like(part.vertices, light) if part.colors is None else part.colors.clip(0, 1)
    texture = None
    if part.image is not None and part.uv is not None:
        corners = part.faces if part.corners is None else part.corners
        texture = Texture(
            (part.image,),
            torch.tensor(part.uv).float(),
            torch.tensor(corners.copy()),
            wrap=wrap,
            smooth=smooth,
        )
    return Scene(
        torch.tensor(part.vertices),
        torch.tensor(part.faces.copy()),  # torch accepts no view with negative strides
        torch.tensor(colors).float(),
        PLACEHOLDER_CAMERA,
        texture,
    )


def _has_one_color(part: Part) -> bool:
    return part.image is None and (part.colors is None or bool((part.colors == part.colors[0]).all()))


def _find_wrap(parts: Sequence[Part]) -> Wrap:
    """Return a wrap rule that suits all textures; the rule matters only for uv beyond the edges of a texture.

    Raises:
        DataError: two textures need different rules.
    """
    stated: set[Wrap] = set()
    needed: set[Wrap] = set()
    for part in parts:
        if part.uv is None or part.image is None:
            continue
        used_uv = part.uv[np.unique(part.faces if part.corners is None else part.corners)]
        beyond = np.any((used_uv < -EDGE) | (used_uv > 1 + EDGE), axis=0)
        stated.update(part.wraps)
        needed.update(wrap for wrap, reaches in zip(part.wraps, beyond, strict=True) if reaches)
    if len(needed) > 1:
        raise DataError(
            f"the textures of the scene continue beyond their edges in different ways ({', '.join(sorted(needed))}), "
            "but a scene has only one way for all. Set the same wrap mode in all samplers, or draw the parts "
            "separately."
        )
    return next(iter(needed or stated)) if len(needed or stated) == 1 else "clamp"


class TextureDecoder:
    """Decoder of the textures of one file; each texture is decoded once, and their total size is limited."""

    def __init__(self) -> None:
        self._decoded: dict[object, Float[Tensor, "height width 3"]] = {}
        self._texels, self._bytes = 0, 0

    def find(self, key: object) -> Float[Tensor, "height width 3"] | None:
        """Return the texture that was decoded under this key; None if there is no such texture."""
        return self._decoded.get(key)

    def read(self, file: Path) -> Float[Tensor, "height width 3"]:
        """Return the texture in an image file, which is read and decoded (`decode`) at the first call only.

        Raises:
            DataError: the file cannot be read, is not an image, or the image is too large.
        """
        if file not in self._decoded:
            with translate_errors(file, "a texture"):
                content = read_bytes(file)
            self.decode(file, content, str(file))
        return self._decoded[file]

    def decode(self, key: object, content: bytes, name: str) -> Float[Tensor, "height width 3"]:
        """Decode an image file to linear RGB, rows from top to bottom; transparency is ignored.

        Args:
            key: identifier under which `find` returns the texture.
            content: bytes of the image file.
            name: name of the texture for messages.

        Raises:
            DataError: the content is not an image, or the image is too large.
        """
        try:
            with images.open_stream(BytesIO(content)) as image:
                self._texels += image.width * image.height
                self._bytes += len(content)
                most = min(MOST_TEXELS, max(FEW_TEXELS, TEXELS_PER_BYTE * self._bytes))
                if self._texels > most:
                    raise DataError(
                        f"the image has {image.width} x {image.height} pixels, but all textures together may have at "
                        f"most {most}. Make the image smaller."
                    )
                light = np.empty((image.height, image.width, 3), np.float32)
                for top, strip in images.decode_opaque(image):
                    light[top : top + len(strip)] = _to_linear(strip)
        except DataError as error:
            raise DataError(f"the texture {name}: {error}") from error
        except Exception as error:
            raise DataError(
                f"the texture {name} cannot be read as an image ({shorten(error) or type(error).__name__}). Copy "
                "the texture again from its source."
            ) from error
        self._decoded[key] = torch.from_numpy(light)
        return self._decoded[key]


def _to_linear(pixels: UInt8[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    return linear_from_bytes(torch.arange(256, dtype=torch.uint8)).numpy()[pixels]


def resolve_beside(folder: Path, name: str) -> Path:
    """Return the path of a file that another file in `folder` refers to, if this path lies in or below `folder`.

    Raises:
        DataError: the name is an address, or the path lies outside of the folder.
    """
    plain = name.replace("\\", "/")
    try:
        resolved = (folder / plain).resolve()
        resolved.exists()  # raises if the name is not possible for a file
        inside = ":" not in plain and resolved.is_relative_to(folder.resolve())
    except (OSError, ValueError):
        inside = False
    if not plain or not inside:
        raise DataError(
            f"the file refers to {quote(name)}, but only files in the same folder are read. Copy that file into the "
            "folder."
        )
    return folder / plain


def find_beside(folder: Path, name: str, content: str, notes: list[str]) -> Path | None:
    """Find a file that another file in `folder` refers to; return None and add a note if there is no such file.

    Programs often write a path that exists only on the machine on which they ran. If the path lies outside of `folder`,
    the file of the same name in `folder` is used.

    Args:
        folder: folder of the referring file.
        name: path as it stands in the referring file.
        content: content of the file and a verb for messages, such as "texture is".
        notes: list to which the note is added.

    Raises:
        DataError: the file is a link to a file outside of the folder.
    """
    plain = name.replace("\\", "/")
    if ":" in plain or plain.startswith("/") or normpath(plain).startswith(".."):
        base_name = plain.rpartition("/")[2]
        file = resolve_beside(folder, base_name) if base_name.strip(".") else None
        if file is None or not file.exists():
            notes.append(
                f"the {content} in another folder, {shorten(name)}, which is not read; the scene is drawn without "
                "this file."
            )
            return None
        notes.append(
            f"the {content} in another folder, {shorten(name)}; {shorten(file.name)} in the scene's folder is read "
            "instead."
        )
        return file
    file = resolve_beside(folder, name)
    if file.exists():  # anything but a regular file is refused where it is read
        return file
    noun, _, verb = content.rpartition(" ")
    notes.append(
        f"the {noun} {shorten(name)} {verb} missing in the scene's folder; the scene is drawn without this file."
    )
    return None
