"""Checks that a scene can be drawn, and its data as arrays that kernels read."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from framework.errors import did_you_mean
from framework.geometry.camera import Camera
from framework.renderer import Scene, Texture
from plugins.renderer.rasterizer import raster
from plugins.renderer.rasterizer.canvas import Corners, Shelf
from plugins.renderer.rasterizer.drawing import Given, Gradient
from plugins.renderer.rasterizer.textures import FARTHEST_UV, WRAPS, Laid

CHANNELS = ("color", "depth", "face", "mask", "normal", "barycentric", "uv")
PAINTED = ("color", "uv")
"""Channels that read a texture."""
WHOLE = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
"""Number types that indices may have."""


@dataclass(frozen=True)
class Ready:
    """A checked scene that can be drawn.

    Attributes:
        faces: faces of the scene.
        corners: faces of its texture.
        lens: fx, fy, cx, cy, pixels.
        learning: whether a gradient may be asked for.
    """

    scene: Scene
    vertices: Tensor
    colors: Tensor | None
    texture: Texture | None
    faces: Corners
    corners: Corners | None
    lens: np.ndarray
    near: float
    learning: bool

    @property
    def uv_and_images(self) -> tuple[Tensor | None, tuple[Tensor, ...]]:
        """The texture's uv and images; None and an empty tuple without a texture."""
        return (None, ()) if self.texture is None else (self.texture.uv, self.texture.images)

    def given(self, times: int, colored: bool) -> tuple[Given, Tensor]:
        """Return the scene as arrays, with `times` samples per pixel along each axis, and the lens as a tensor.

        The lens may require a gradient.
        """
        camera = self.scene.camera
        numbers = self.lens
        lens = torch.from_numpy(numbers)
        if self.learning and any(isinstance(part, Tensor) for part in (camera.focal, camera.principal)):
            parts = [torch.as_tensor(part, dtype=torch.float64) for part in (camera.focal, camera.principal)]
            lens = torch.cat(parts)
        if times > 1:  # the centre of pixel 0 is the centre of its samples
            shift = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64)
            lens = (lens + 0.5 * shift) * times - 0.5 * shift
            numbers = lens.detach().numpy()
        return Given(
            array(self.vertices),
            array(self.colors) if colored and self.colors is not None else None,
            array(camera.rotation).astype(np.float64),
            array(camera.translation).astype(np.float64),
            numbers,
            self.laid,
        ), lens

    @cached_property
    def laid(self) -> Laid | None:
        """The texture in the form that kernels read; None without a texture."""
        texture, corners = self.texture, self.corners
        if texture is None or corners is None:
            return None
        flat = [array(image).reshape(-1, image.shape[2]) for image in texture.images]
        sides = [image.shape[:2] for image in texture.images]
        starts = np.cumsum([0, *[height * width for height, width in sides]])
        images = np.array([(start, *side) for start, side in zip(starts, sides, strict=False)], np.int64)
        shown = np.zeros(len(corners.array), np.int32)
        if texture.shown is not None:
            shown = array(texture.shown).astype(np.int32)
        texels = flat[0] if len(flat) == 1 else np.concatenate(flat)
        return Laid(
            texels,
            images.reshape(-1, 3),
            array(texture.uv),
            corners.array,
            shown,
            WRAPS[texture.wrap],
            texture.smooth,
        )


def array(tensor: Tensor) -> np.ndarray:
    """Return a tensor as a contiguous NumPy array, without gradient."""
    return tensor.detach().contiguous().numpy()


def ready(scene: Scene, channels: Collection[str], shelf: Shelf, gradient: Gradient) -> Ready:
    """Return the scene, checked for these channels.

    Raises:
        ValueError: the scene cannot be drawn; the message says what came and what was wanted.
    """
    check_channels(channels)
    check_device("vertices", scene.vertices)
    check_device("faces", scene.faces)
    vertices = numbers("vertices", scene.vertices, 3)
    faces = indices("faces", scene.faces, len(vertices), "vertices", shelf)
    check_device("camera.rotation", scene.camera.rotation)
    check_device("camera.translation", scene.camera.translation)
    lens = check_camera(scene.camera)
    camera = scene.camera
    learned = [vertices, camera.rotation, camera.translation, camera.focal, camera.principal]
    colors = texture = corners = None
    check_paint(scene, channels)
    if "color" in channels:
        if scene.colors is not None:
            check_device("colors", scene.colors)
            colors = checked_colors(scene.colors, len(vertices))
        learned.append(colors)
    if scene.texture is not None and not set(PAINTED).isdisjoint(channels):
        if gradient == "soft" and "color" in channels:
            raise ValueError(
                "gradient=soft blends colours per vertex, and the scene has a texture; choose gradient=boundary, or "
                "give colors alone."
            )
        for name, part in laid_parts(scene.texture).items():
            check_device(name, part)
        texture = checked_texture(
            scene.texture, len(faces.array), None if colors is None else colors.shape[1]
        )
        corners = indices("texture.faces", texture.faces, len(texture.uv), "places", shelf)
        learned += [texture.uv, *texture.images]
    learning = torch.is_grad_enabled() and any(
        isinstance(part, Tensor) and part.requires_grad for part in learned
    )
    near = max(float(camera.near), raster.NEAREST)
    return Ready(scene, vertices, colors, texture, faces, corners, lens, near, learning)


def check_on_device(scene: Scene, channels: Collection[str], gradient: Gradient) -> Tensor:
    """Check a scene for `reference.picture`, whose tensors lie on one device, and return its lens there.

    Raises:
        ValueError: the scene cannot be drawn; the message says what came and what was wanted.
    """
    check_channels(channels)
    camera, texture = scene.camera, scene.texture
    parts: dict[str, Tensor | None] = {
        "vertices": scene.vertices,
        "faces": scene.faces,
        "colors": scene.colors,
        "camera.rotation": camera.rotation,
        "camera.translation": camera.translation,
    }
    if texture is not None:
        parts |= laid_parts(texture)
    device = scene.vertices.device
    for name, part in parts.items():
        if part is not None and part.device != device:
            raise ValueError(
                f"{name} came on {part.device} and vertices on {device}; wanted one device for both."
            )
    numbers("vertices", scene.vertices, 3)
    check_indices("faces", scene.faces, len(scene.vertices), "vertices")
    check_camera(camera)
    check_paint(scene, channels)
    colors = None
    if "color" in channels and scene.colors is not None:
        colors = checked_colors(scene.colors, len(scene.vertices))
    if texture is not None and not set(PAINTED).isdisjoint(channels):
        checked_texture(texture, len(scene.faces), None if colors is None else colors.shape[1])
        check_indices("texture.faces", texture.faces, len(texture.uv), "places")
    lens = [
        torch.as_tensor(part, dtype=torch.float64, device=device) for part in (camera.focal, camera.principal)
    ]
    learned = [*parts.values(), *lens]
    if (
        gradient != "interior"
        and torch.is_grad_enabled()
        and any(part is not None and part.requires_grad for part in learned)
    ):
        raise ValueError(
            f"gradient={gradient} was asked for on {device}, where only what faces show within has a gradient; choose "
            "gradient=interior, or give tensors on the CPU."
        )
    return torch.cat(lens)


def check_channels(channels: Collection[str]) -> None:
    """Refuse channels that the renderer does not draw."""
    if isinstance(channels, str):
        raise ValueError(
            f"channels came as the string {channels!r}; wanted a collection, e.g. ({channels!r},)."
        )
    for name in channels:
        if name not in CHANNELS:
            raise ValueError(
                f"{name!r} is no channel of rasterizer.{did_you_mean(name, CHANNELS)} "
                f"It draws {', '.join(CHANNELS)}."
            )


def check_paint(scene: Scene, channels: Collection[str]) -> None:
    """Refuse to draw colours of a scene that has none."""
    if "color" in channels and scene.colors is None and scene.texture is None:
        raise ValueError(
            '"color" was asked of a scene without colours; give colors or a texture, or ask other channels.'
        )


def check_device(name: str, tensor: Tensor) -> None:
    """Refuse a tensor that is not on the CPU."""
    if tensor.device.type != "cpu":
        raise ValueError(
            f"{name} came on {tensor.device}; rasterizer draws on the CPU, or a whole scene on cuda: give {name}.cpu()."
        )


def numbers(name: str, tensor: Tensor, columns: int | None) -> Tensor:
    """Return rows of `columns` coordinates, or of any number of colours, in a number type that kernels read."""
    if tensor.ndim != 2 or tensor.shape[1] < 1 or (columns is not None and tensor.shape[1] != columns):
        wanted = "channels, 1 or more" if columns is None else columns
        raise ValueError(f"{name} came with the shape {tuple(tensor.shape)}; wanted ({name}, {wanted}).")
    return floating(name, tensor)


def floating(name: str, tensor: Tensor) -> Tensor:
    """Return a floating-point tensor in a number type that kernels read, float32 or float64."""
    if not tensor.is_floating_point():
        raise ValueError(f"{name} came as {tensor.dtype}; wanted floating point, e.g. torch.float32.")
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()


def checked_colors(colors: Tensor, count: int) -> Tensor:
    """Return colours of `count` vertices, in a number type that kernels read."""
    found = numbers("colors", colors, None)
    if len(found) != count:
        raise ValueError(f"{len(found)} colors came for {count} vertices; wanted one each.")
    return found


def check_corners(name: str, given: Tensor) -> None:
    """Refuse anything but rows of three integers."""
    if given.ndim != 2 or given.shape[1] != 3:
        raise ValueError(f"{name} came with the shape {tuple(given.shape)}; wanted ({name}, 3).")
    if given.dtype not in WHOLE:
        raise ValueError(f"{name} came as {given.dtype}; wanted whole numbers, e.g. torch.int64.")


def check_indices(name: str, given: Tensor, count: int, of: str) -> None:
    """Refuse anything but rows of three indices below `count`, on any device."""
    check_corners(name, given)
    if given.numel() and not (int(given.min()) >= 0 and int(given.max()) < count):
        raise ValueError(out_of_range(name, given, count, of))


def indices(name: str, given: Tensor, count: int, of: str, shelf: Shelf) -> Corners:
    """Return checked rows of three indices below `count` on the CPU, in the form that kernels read."""
    check_corners(name, given)
    kept = given.dtype in (torch.int32, torch.int64)
    found = shelf.find(array(given if kept else given.long()))
    if given.numel() and found.largest >= count:
        raise ValueError(out_of_range(name, given, count, of))
    return found


def out_of_range(name: str, given: Tensor, count: int, of: str) -> str:
    """Return the message about indices beyond the scene's vertices or places."""
    return (
        f"{name} name the {of} {int(given.min())} to {int(given.max())}; wanted 0 to {count - 1}, since the scene has "
        f"{count} {of}."
    )


def laid_parts(texture: Texture) -> dict[str, Tensor]:
    """Return the tensors of a texture, by their names in messages."""
    parts = {"uv": texture.uv, "texture.faces": texture.faces}
    if texture.shown is not None:
        parts["texture.shown"] = texture.shown
    return parts | {f"image {number} of a texture": image for number, image in enumerate(texture.images)}


def checked_texture(texture: Texture, count: int, channels: int | None) -> Texture:
    """Return a texture of `count` faces, in number types that kernels read, on any device.

    The indices in `texture.faces` are not yet checked.

    Args:
        texture: the texture.
        count: number of faces of the scene.
        channels: number of channels of the scene's vertex colours; None if it has none.
    """
    if not texture.images:
        raise ValueError("a texture came without images; wanted one or more.")
    if texture.wrap not in WRAPS:
        raise ValueError(f"wrap came as {texture.wrap!r}; wanted one of {', '.join(WRAPS)}.")
    images = []
    wanted = channels if channels is not None else (3, *texture.images[0].shape)[-1]
    for image in texture.images:
        if image.ndim != 3 or 0 in image.shape or image.shape[2] != wanted:
            raise ValueError(
                f"an image of a texture came with the shape {tuple(image.shape)}; wanted (height, width, {wanted}), as "
                "the other images and the colors have them."
            )
        images.append(floating("an image of a texture", image))
    if len({image.dtype for image in images}) > 1:
        images = [image.double() for image in images]
    uv = numbers("uv", texture.uv, 2)
    if uv.numel() and not bool((uv.detach().abs() <= FARTHEST_UV).all()):
        raise ValueError(
            f"uv holds a number that is not finite, or beyond {FARTHEST_UV:g}; wanted places near 0 to 1."
        )
    check_corners("texture.faces", texture.faces)
    shown = texture.shown
    if len(texture.faces) != count or (shown is not None and shown.shape != (count,)):
        raise ValueError(
            f"texture.faces came for {len(texture.faces)} faces"
            + ("" if shown is None else f" and texture.shown with the shape {tuple(shown.shape)}")
            + f"; wanted {count}, since the scene has {count} faces."
        )
    if shown is not None and shown.dtype not in WHOLE:
        raise ValueError(f"texture.shown came as {shown.dtype}; wanted whole numbers, e.g. torch.int64.")
    if shown is not None and count and not (int(shown.min()) >= -1 and int(shown.max()) < len(images)):
        raise ValueError(
            f"texture.shown names the images {int(shown.min())} to {int(shown.max())}; wanted -1 to {len(images) - 1}."
        )
    return Texture(tuple(images), uv, texture.faces, shown, texture.wrap, texture.smooth)


def check_camera(camera: Camera) -> np.ndarray:
    """Check a camera and return its lens, (fx, fy, cx, cy), float64."""
    for name, side in (("height", camera.height), ("width", camera.width)):
        if not 1 <= side <= 2**16:
            raise ValueError(f"camera.{name} = {side}; wanted 1 to {2**16} pixels.")
    camera.check_shapes()
    for name in ("rotation", "translation", "focal", "principal"):
        part = getattr(camera, name)
        if isinstance(part, Tensor) and part.device.type == "meta":
            check_device(f"camera.{name}", part)
    lens = [
        float(number)
        for part in (camera.focal, camera.principal)
        for number in (part.tolist() if isinstance(part, Tensor) else part)
    ]
    everything = (*lens, *camera.rotation.reshape(-1).tolist(), *camera.translation.tolist())
    if not all(map(math.isfinite, everything)) or not 0 < camera.near < math.inf or min(lens[:2]) <= 0:
        raise ValueError(
            f"camera holds a number that is not finite, or a focal or near that is not above 0: {camera}."
        )
    return np.array(lens)
