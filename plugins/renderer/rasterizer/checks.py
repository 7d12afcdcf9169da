"""Checks that a scene can be drawn, and conversion of its data to the arrays that kernels read.

Every check raises a ValueError that says which input is wrong and what is expected.
"""

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
from plugins.renderer.rasterizer.canvas import Corners, MeshCache
from plugins.renderer.rasterizer.drawing import Gradient, SceneArrays
from plugins.renderer.rasterizer.textures import FARTHEST_UV, WRAPS, TextureArrays

CHANNELS = ("color", "depth", "face", "mask", "normal", "barycentric", "uv")
TEXTURED = ("color", "uv")
"""Channels that read a texture."""
INDEX_TYPES = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
"""Allowed number types of indices."""


@dataclass(frozen=True)
class CheckedScene:
    """A scene after all checks.

    Attributes:
        scene: the scene before the checks.
        vertices, colors, texture: inputs in number types that kernels read; None if they are not drawn.
        faces: faces of the scene.
        corners: indices of the texture coordinates at the corners of each face; None if no texture is drawn.
        lens: fx, fy, cx, cy, pixels.
        near: distance of the near plane, metres.
        needs_gradient: whether an input requires a gradient.
    """

    scene: Scene
    vertices: Tensor
    colors: Tensor | None
    texture: Texture | None
    faces: Corners
    corners: Corners | None
    lens: np.ndarray
    near: float
    needs_gradient: bool

    @property
    def uv_and_images(self) -> tuple[Tensor | None, tuple[Tensor, ...]]:
        """The texture's uv and images; None and an empty tuple without a texture."""
        return (None, ()) if self.texture is None else (self.texture.uv, self.texture.images)

    def to_arrays(self, times: int, colored: bool) -> tuple[SceneArrays, Tensor]:
        """Return the scene as arrays, and the lens as a tensor that may require a gradient.

        Args:
            times: samples per pixel along each axis.
            colored: whether colours are drawn.
        """
        camera = self.scene.camera
        lens_array = self.lens
        lens = torch.from_numpy(lens_array)
        if self.needs_gradient and any(isinstance(part, Tensor) for part in (camera.focal, camera.principal)):
            parts = [torch.as_tensor(part, dtype=torch.float64) for part in (camera.focal, camera.principal)]
            lens = torch.cat(parts)
        if times > 1:  # the centre of pixel 0 is the centre of its samples
            shift = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64)
            lens = (lens + 0.5 * shift) * times - 0.5 * shift
            lens_array = lens.detach().numpy()
        return SceneArrays(
            to_array(self.vertices),
            to_array(self.colors) if colored and self.colors is not None else None,
            to_array(camera.rotation).astype(np.float64),
            to_array(camera.translation).astype(np.float64),
            lens_array,
            self.texture_arrays,
        ), lens

    @cached_property
    def texture_arrays(self) -> TextureArrays | None:
        """The texture in the form that kernels read; None without a texture."""
        texture, corners = self.texture, self.corners
        if texture is None or corners is None:
            return None
        flat = [to_array(image).reshape(-1, image.shape[2]) for image in texture.images]
        sides = [image.shape[:2] for image in texture.images]
        starts = np.cumsum([0, *[height * width for height, width in sides]])
        images = np.array([(start, *side) for start, side in zip(starts, sides, strict=False)], np.int64)
        shown = np.zeros(len(corners.array), np.int32)
        if texture.shown is not None:
            shown = to_array(texture.shown).astype(np.int32)
        texels = flat[0] if len(flat) == 1 else np.concatenate(flat)
        return TextureArrays(
            texels,
            images.reshape(-1, 3),
            to_array(texture.uv),
            corners.array,
            shown,
            WRAPS[texture.wrap],
            texture.smooth,
        )


def to_array(tensor: Tensor) -> np.ndarray:
    """Return a tensor as a contiguous NumPy array, without gradient."""
    return tensor.detach().contiguous().numpy()


def check_scene(
    scene: Scene, channels: Collection[str], mesh_cache: MeshCache, gradient: Gradient
) -> CheckedScene:
    """Check that these channels of a scene can be drawn, and return the checked scene.

    Args:
        scene: the scene.
        channels: names of the channels.
        mesh_cache: cache of face indices.
        gradient: kind of gradient, see `Rasterizer`.

    Raises:
        ValueError: the scene cannot be drawn.
    """
    check_channels(channels)
    check_device("vertices", scene.vertices)
    check_device("faces", scene.faces)
    vertices = check_matrix("vertices", scene.vertices, 3)
    faces = to_corners("faces", scene.faces, len(vertices), "vertices", mesh_cache)
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
            colors = check_colors(scene.colors, len(vertices))
        learned.append(colors)
    if scene.texture is not None and not set(TEXTURED).isdisjoint(channels):
        if gradient == "soft" and "color" in channels:
            raise ValueError(
                "gradient=soft draws only colours of vertices, but the scene has a texture. Choose gradient=boundary, "
                "or remove the texture."
            )
        for name, part in texture_tensors(scene.texture).items():
            check_device(name, part)
        texture = check_texture(scene.texture, len(faces.array), None if colors is None else colors.shape[1])
        corners = to_corners(
            "texture.faces", texture.faces, len(texture.uv), "texture coordinates", mesh_cache
        )
        learned += [texture.uv, *texture.images]
    needs_gradient = torch.is_grad_enabled() and any(
        isinstance(part, Tensor) and part.requires_grad for part in learned
    )
    near = max(float(camera.near), raster.NEAREST)
    return CheckedScene(scene, vertices, colors, texture, faces, corners, lens, near, needs_gradient)


def check_on_device(scene: Scene, channels: Collection[str], gradient: Gradient) -> Tensor:
    """Check a scene for `reference.render`, and return its lens (fx, fy, cx, cy) on the device of the vertices.

    Raises:
        ValueError: the scene cannot be drawn, or its tensors are on different devices.
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
        parts |= texture_tensors(texture)
    device = scene.vertices.device
    for name, part in parts.items():
        if part is not None and part.device != device:
            raise ValueError(
                f"{name} is on {part.device}, but vertices are on {device}. Move both to the same device."
            )
    check_matrix("vertices", scene.vertices, 3)
    check_indices("faces", scene.faces, len(scene.vertices), "vertices")
    check_camera(camera)
    check_paint(scene, channels)
    colors = None
    if "color" in channels and scene.colors is not None:
        colors = check_colors(scene.colors, len(scene.vertices))
    if texture is not None and not set(TEXTURED).isdisjoint(channels):
        check_texture(texture, len(scene.faces), None if colors is None else colors.shape[1])
        check_indices("texture.faces", texture.faces, len(texture.uv), "texture coordinates")
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
            f"gradient={gradient} is not available on {device}, where only the interior of faces has a gradient. "
            "Choose "
            "gradient=interior, or move the scene to the CPU."
        )
    return torch.cat(lens)


def check_channels(channels: Collection[str]) -> None:
    """Check that the renderer can draw these channels."""
    if isinstance(channels, str):
        raise ValueError(
            f"channels is the string {channels!r}, but a collection of names is required, e.g. ({channels!r},)."
        )
    for name in channels:
        if name not in CHANNELS:
            raise ValueError(
                f"{name!r} is not a channel of rasterizer.{did_you_mean(name, CHANNELS)} "
                f"The channels of rasterizer are {', '.join(CHANNELS)}."
            )


def check_paint(scene: Scene, channels: Collection[str]) -> None:
    """Check that the scene has colours or a texture if colours are drawn."""
    if "color" in channels and scene.colors is None and scene.texture is None:
        raise ValueError(
            'the channel "color" requires a scene with colours. Give colors or a texture, or choose other channels.'
        )


def check_device(name: str, tensor: Tensor) -> None:
    """Check that a tensor is on the CPU; `name` is its name in the message."""
    if tensor.device.type != "cpu":
        raise ValueError(
            f"{name} is on {tensor.device}, but rasterizer draws on the CPU, or a whole scene on cuda. Give "
            f"{name}.cpu()."
        )


def check_matrix(name: str, tensor: Tensor, columns: int | None) -> Tensor:
    """Return a floating-point matrix in a number type that kernels read, after checking its shape.

    `name` is the name of the matrix in messages. `columns` is the required number of columns; None for any number
    from 1.
    """
    if tensor.ndim != 2 or tensor.shape[1] < 1 or (columns is not None and tensor.shape[1] != columns):
        expected = "1 or more channels" if columns is None else columns
        raise ValueError(f"{name}: got the shape {tuple(tensor.shape)}, expected ({name}, {expected}).")
    return to_float(name, tensor)


def to_float(name: str, tensor: Tensor) -> Tensor:
    """Return a floating-point tensor as float32 or float64, which kernels read; `name` is its name in the message."""
    if not tensor.is_floating_point():
        raise ValueError(f"{name}: got {tensor.dtype}, expected floating point, e.g. torch.float32.")
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()


def check_colors(colors: Tensor, count: int) -> Tensor:
    """Return colours in a number type that kernels read, after checking that their number is `count`."""
    checked = check_matrix("colors", colors, None)
    if len(checked) != count:
        raise ValueError(f"got {len(checked)} colors for {count} vertices, expected one color per vertex.")
    return checked


def check_corners(name: str, face_indices: Tensor) -> None:
    """Check that a tensor holds three integers per face; `name` is its name in messages."""
    if face_indices.ndim != 2 or face_indices.shape[1] != 3:
        raise ValueError(f"{name}: got the shape {tuple(face_indices.shape)}, expected ({name}, 3).")
    if face_indices.dtype not in INDEX_TYPES:
        raise ValueError(f"{name}: got {face_indices.dtype}, expected whole numbers, e.g. torch.int64.")


def check_indices(name: str, face_indices: Tensor, count: int, of: str) -> None:
    """Check that a tensor on any device holds three indices from 0 to `count` - 1 per face.

    `name` is the name of the indices in the message, and `of` names the elements that they refer to, such as
    "vertices".
    """
    check_corners(name, face_indices)
    if face_indices.numel() and not (int(face_indices.min()) >= 0 and int(face_indices.max()) < count):
        raise ValueError(describe_out_of_range(name, face_indices, count, of))


def to_corners(name: str, face_indices: Tensor, count: int, of: str, mesh_cache: MeshCache) -> Corners:
    """Return face indices on the CPU in the form that kernels read, after checking that they lie below `count`.

    `mesh_cache` holds the results for recent meshes. `name` is the name of the indices in messages, and `of` names the
    elements that they refer to, such as "vertices".
    """
    check_corners(name, face_indices)
    readable = face_indices.dtype in (torch.int32, torch.int64)
    corners = mesh_cache.find(to_array(face_indices if readable else face_indices.long()))
    if face_indices.numel() and corners.largest >= count:
        raise ValueError(describe_out_of_range(name, face_indices, count, of))
    return corners


def describe_out_of_range(name: str, face_indices: Tensor, count: int, of: str) -> str:
    """Return the message about `face_indices` that are negative or not below `count`.

    Args:
        name: name of the indices.
        face_indices: the indices.
        count: number of elements that the indices refer to.
        of: name of these elements, such as "vertices".
    """
    return (
        f"{name} refer to the {of} {int(face_indices.min())} to {int(face_indices.max())}, expected 0 to {count - 1}, "
        "since the scene has "
        f"{count} {of}."
    )


def texture_tensors(texture: Texture) -> dict[str, Tensor]:
    """Return the tensors of a texture with the names that messages use for them."""
    parts = {"uv": texture.uv, "texture.faces": texture.faces}
    if texture.shown is not None:
        parts["texture.shown"] = texture.shown
    return parts | {f"image {number} of a texture": image for number, image in enumerate(texture.images)}


def check_texture(texture: Texture, count: int, channels: int | None) -> Texture:
    """Check a texture on any device, and return it in number types that compiled functions read.

    The indices `texture.faces` are not checked here.

    Args:
        texture: the texture.
        count: number of faces of the scene.
        channels: number of channels of the scene's vertex colours; None without vertex colours.
    """
    if not texture.images:
        raise ValueError("got a texture without images, expected at least one image.")
    if texture.wrap not in WRAPS:
        raise ValueError(f"got the wrap rule {texture.wrap!r}, expected one of {', '.join(WRAPS)}.")
    images = []
    expected = channels if channels is not None else (3, *texture.images[0].shape)[-1]
    for image in texture.images:
        if image.ndim != 3 or 0 in image.shape or image.shape[2] != expected:
            raise ValueError(
                f"image of a texture: got the shape {tuple(image.shape)}, expected (height, width, {expected}), like "
                "the "
                "other images and the colors."
            )
        images.append(to_float("image of a texture", image))
    if len({image.dtype for image in images}) > 1:
        images = [image.double() for image in images]
    uv = check_matrix("uv", texture.uv, 2)
    if uv.numel() and not bool((uv.detach().abs() <= FARTHEST_UV).all()):
        raise ValueError(
            f"uv has a number that is not finite or is beyond {FARTHEST_UV:g}; texture coordinates should be near 0 "
            "to 1."
        )
    check_corners("texture.faces", texture.faces)
    shown = texture.shown
    if len(texture.faces) != count or (shown is not None and shown.shape != (count,)):
        raise ValueError(
            f"texture.faces has {len(texture.faces)} faces"
            + ("" if shown is None else f" and texture.shown has the shape {tuple(shown.shape)}")
            + f", but the scene has {count} faces. Give texture.faces, and texture.shown if there is one, a row for "
            "each face of the scene."
        )
    if shown is not None and shown.dtype not in INDEX_TYPES:
        raise ValueError(f"texture.shown: got {shown.dtype}, expected whole numbers, e.g. torch.int64.")
    if shown is not None and count and not (int(shown.min()) >= -1 and int(shown.max()) < len(images)):
        raise ValueError(
            f"texture.shown refers to the images {int(shown.min())} to {int(shown.max())}, expected -1 to "
            f"{len(images) - 1}."
        )
    return Texture(tuple(images), uv, texture.faces, shown, texture.wrap, texture.smooth)


def check_camera(camera: Camera) -> np.ndarray:
    """Check a camera and return its lens, (fx, fy, cx, cy), float64."""
    for name, side in (("height", camera.height), ("width", camera.width)):
        if not 1 <= side <= 2**16:
            raise ValueError(f"camera.{name} is {side}, expected 1 to {2**16} pixels.")
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
            f"got a camera with a number that is not finite, or with a focal or near that is not above 0: {camera}. "
            "Correct these numbers."
        )
    return np.array(lens)
