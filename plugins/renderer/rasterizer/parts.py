"""Parts of a scene as files store them, and functions that join them into one scene."""

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

Axis = Literal["y", "z"]
GREY = 0.55
"""Linear RGB value of a surface whose file gives no colour."""
FARTHEST = 1e30
"""Largest coordinate for which float32 can hold the depth."""
NOWHERE = look_from(0.0, 0.0, 0.0, 1.0, 1.0, (1, 1))
EDGE = 1e-4
"""Largest distance beyond a texture's edge that is taken as rounding, so that no wrap rule is needed there."""


@dataclass(frozen=True)
class Part:
    """Triangles of one material.

    Attributes:
        vertices: in metres, or in the file's unit.
        faces: rows of `vertices`, counter-clockwise seen from outside.
        colors: linear in [0, 1], multiplied with the texture's colours; None where the file gives none.
        image: the texture, linear in [0, 1], rows from top to bottom.
        uv: places in it, u to the right, v upwards.
        corners: rows of `uv` per face; if None, these are the rows of `vertices`.
        wraps: what lies beyond the image's edges along u and v.
        smooth: interpolate between its texels.
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
        scene: in the file's own axes and unit; its camera is meaningless.
        plain: vertices of parts with one colour and no texture, whose shape only shading shows.
        up: the axis that points upwards by the convention of the file's format.
        notes: one sentence about each thing that the file has and the scene lacks.
    """

    scene: Scene
    plain: Bool[Tensor, "vertices"]
    up: Axis
    notes: tuple[str, ...] = ()


def subject(parts: Sequence[Part], up: Axis, notes: Sequence[str] = ()) -> Subject:
    """Join the parts of a file.

    Raises:
        DataError: there are no faces, a coordinate is not finite or too large, or textures continue beyond their edges
            in different ways.
    """
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise DataError("it has no faces, only points or lines; wanted a surface. Make a mesh of them first.")
    for part in parts:
        for what, numbers in (("coordinate", part.vertices), ("place in a texture", part.uv)):
            if numbers is not None and not np.isfinite(numbers).all():
                raise DataError(f"a {what} is not finite; restore the file from its source.")
        if np.abs(part.vertices).max() > FARTHEST:
            raise DataError(f"a coordinate is beyond {FARTHEST:g}; wanted metres. Scale it down.")
    wrap, smooth = _wrap(parts), all(part.smooth for part in parts if part.image is not None)
    scene = join_scenes([_scene(part, wrap, smooth) for part in parts])
    plain = [torch.full((len(part.vertices),), _plain(part)) for part in parts]
    return Subject(scene, torch.cat(plain), up, tuple(dict.fromkeys(notes)))


def _scene(part: Part, wrap: Wrap, smooth: bool) -> Scene:
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
        NOWHERE,
        texture,
    )


def _plain(part: Part) -> bool:
    return part.image is None and (part.colors is None or bool((part.colors == part.colors[0]).all()))


def _wrap(parts: Sequence[Part]) -> Wrap:
    """Return the one rule for what lies beyond the edges of all textures; only parts that reach beyond need it."""
    named: set[Wrap] = set()
    needed: set[Wrap] = set()
    for part in parts:
        if part.uv is None or part.image is None:
            continue
        places = part.uv[np.unique(part.faces if part.corners is None else part.corners)]
        beyond = np.any((places < -EDGE) | (places > 1 + EDGE), axis=0)
        named.update(part.wraps)
        needed.update(wrap for wrap, reaches in zip(part.wraps, beyond, strict=True) if reaches)
    if len(needed) > 1:
        raise DataError(
            f"its textures go on beyond their edges in different ways ({', '.join(sorted(needed))}); wanted one way "
            "in a scene. Change the samplers, or draw the parts apart."
        )
    return next(iter(needed or named)) if len(needed or named) == 1 else "clamp"


class Pictures:
    """Decoder of the textures of one file, each once, with a limit on all of them together."""

    def __init__(self) -> None:
        self._decoded: dict[object, Float[Tensor, "height width 3"]] = {}
        self._texels, self._bytes = 0, 0

    def known(self, key: object) -> Float[Tensor, "height width 3"] | None:
        """Return the texture that was decoded under this key, or None."""
        return self._decoded.get(key)

    def decode(self, key: object, content: bytes, name: str) -> Float[Tensor, "height width 3"]:
        """Return the linear RGB of an image file's content, rows from top to bottom; transparency is ignored.

        Raises:
            DataError: the content is no image, or too large.
        """
        try:
            with images.open_stream(BytesIO(content)) as image:
                self._texels += image.width * image.height
                self._bytes += len(content)
                most = min(MOST_TEXELS, max(FEW_TEXELS, TEXELS_PER_BYTE * self._bytes))
                if self._texels > most:
                    raise DataError(
                        f"it has {image.width} x {image.height} pixels; wanted up to {most} of all textures together. "
                        "Make it smaller."
                    )
                light = np.empty((image.height, image.width, 3), np.float32)
                for top, strip in images.decode_opaque(image):
                    light[top : top + len(strip)] = _light(strip)
        except DataError as error:
            raise DataError(f"the texture {name}: {error}") from error
        except Exception as error:
            raise DataError(
                f"the texture {name} cannot be read as an image ({shorten(error) or type(error).__name__}). Restore it."
            ) from error
        self._decoded[key] = torch.from_numpy(light)
        return self._decoded[key]


def _light(pixels: UInt8[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    return linear_from_bytes(torch.arange(256, dtype=torch.uint8)).numpy()[pixels]


def beside(folder: Path, name: str) -> Path:
    """Return the file that another file in `folder` refers to, if it lies in this folder or below it.

    Raises:
        DataError: the name is an address, or the file lies elsewhere.
    """
    plain = name.replace("\\", "/")
    try:
        found = (folder / plain).resolve()
        found.exists()  # raises if the name is not possible for a file
        inside = ":" not in plain and found.is_relative_to(folder.resolve())
    except (OSError, ValueError):
        inside = False
    if not plain or not inside:
        raise DataError(
            f"it names {quote(name)}; wanted a file in its own folder, since others are not read. Copy it there."
        )
    return folder / plain


def drawn_without(folder: Path, name: str, what: str, notes: list[str]) -> Path | None:
    """Return the file that another file in `folder` refers to; None, with a note, if it is missing or lies elsewhere.

    Programs write folders of their own machine. For such a place elsewhere, the file of the same name in `folder` is
    taken.

    Args:
        folder: folder of the file that refers to it.
        name: the name that it is given there.
        what: what the file holds, with a verb: "texture is".
        notes: receives the notes.

    Raises:
        DataError: a link leads elsewhere.
    """
    plain = name.replace("\\", "/")
    if ":" in plain or plain.startswith("/") or normpath(plain).startswith(".."):
        last = plain.rpartition("/")[2]
        file = beside(folder, last) if last.strip(".") else None
        if file is None or not file.exists():
            notes.append(f"its {what} in another folder, {shorten(name)}, which is not read: drawn without.")
            return None
        notes.append(
            f"its {what} in another folder, {shorten(name)}; {shorten(file.name)} beside it is read."
        )
        return file
    file = beside(folder, name)
    if file.exists():  # anything but a regular file is refused where it is read
        return file
    thing, _, verb = what.rpartition(" ")
    notes.append(f"its {thing} {shorten(name)} {verb} not beside it: drawn without.")
    return None
