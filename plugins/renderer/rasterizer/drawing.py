"""Drawing of one image as a differentiable operation on tensors, with compiled forward and backward kernels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from framework.renderer import Report
from plugins.renderer.rasterizer import nmr, raster, shading, soft
from plugins.renderer.rasterizer.boundary import boundary
from plugins.renderer.rasterizer.canvas import Box, Canvas, CanvasLease, Corners
from plugins.renderer.rasterizer.clipping import clip
from plugins.renderer.rasterizer.interior import interior, transform_to_world
from plugins.renderer.rasterizer.textures import TextureArrays

Gradient = Literal["boundary", "interior", "nmr", "soft"]
Saving = Literal["view", "box", "hidden", "unchanged"]
CHANNEL_SIZES = {"normal": 3, "barycentric": 3, "uv": 2}
STEEPEST = 1e37
"""Largest absolute value of a gradient; float32 can hold sums of a few such values.

Larger gradients, which occur if faces almost touch the camera, are clamped to this value.
"""


@dataclass(frozen=True)
class DrawingSettings:
    """Settings of an image: all inputs that have no gradient.

    Attributes:
        faces: faces of the scene.
        near: distance of the near plane, metres.
        size: (height, width), pixels.
        cull: whether faces seen from behind are left out.
        channels: channels to draw, in this order.
        gradient: kind of gradient, see `Rasterizer`; "soft" also changes the image.
        softness: σ and γ of "soft".
        savings: work that may be left out, see `Rasterizer`.
        single_sample: True if a pixel is one sample, False if it is the mean of several samples.
    """

    faces: Corners
    near: float
    size: tuple[int, int]
    cull: bool
    channels: tuple[str, ...]
    gradient: Gradient
    softness: tuple[float, float]
    savings: frozenset[Saving]
    single_sample: bool = True

    @property
    def uses_soft(self) -> bool:
        """True if the rasteriser with soft edges (module `soft`) draws the colours."""
        return "color" in self.channels and self.gradient == "soft"


@dataclass(frozen=True)
class SceneArrays:
    """Inputs of an image that have a gradient, and the texture, as arrays.

    Attributes:
        vertices: world coordinates, (vertices, 3), metres.
        colors: linear RGB or other channels of each vertex, (vertices, channels); None without vertex colours.
        rotation, translation: (3, 3) and (3,), from world to camera coordinates.
        lens: fx, fy, cx, cy, pixels.
        texture: the texture, with the texels of all its images.
    """

    vertices: np.ndarray
    colors: np.ndarray | None
    rotation: np.ndarray
    translation: np.ndarray
    lens: np.ndarray
    texture: TextureArrays | None

    @property
    def color_channels(self) -> int:
        """Number of colour channels."""
        return (
            self.colors.shape[1]
            if self.colors is not None
            else cast(TextureArrays, self.texture).texels.shape[1]
        )


@dataclass
class RenderedImage:
    """An image and the data that its gradient reads.

    Attributes:
        channels: the requested channels.
        report: counts of drawn and omitted faces.
        lease: the canvas of the image.
        box: part of the canvas that may show a face.
        soft_image: colours before rounding to float32, if the gradient is "soft" and something is in view.
    """

    channels: dict[str, Tensor]
    report: Report
    lease: CanvasLease
    box: Box
    soft_image: soft.SoftImage | None


def draw(scene: SceneArrays, settings: DrawingSettings, pool: list[Canvas], learning: bool) -> RenderedImage:
    """Draw the channels of an image.

    Args:
        scene: inputs of the image.
        settings: settings of the image.
        pool: canvases that are not in use.
        learning: whether to prepare also the data that the gradient needs.
    """
    lease = CanvasLease(pool)
    canvas, (height, width), faces = lease.canvas, settings.size, settings.faces.array
    numbers = allocate_channels(scene, settings)
    counts, box, soft_image = np.zeros(len(raster.REASONS) + 1, np.int64), (height, 0, width, 0), None
    reused: set[str] = set()
    if is_out_of_view(scene, settings):
        counts[raster.OUTSIDE] = len(faces)
    else:
        if place_vertices(scene, settings, canvas):
            reused.add("places")
        if settings.uses_soft and scene.colors is not None:
            surface = (canvas.camera_points, canvas.screen, faces, scene.colors, scene.lens)
            soft_image = soft.render(*surface, settings.cull, settings.size, *settings.softness, counts)
            numbers["color"][:] = soft_image.color
        exact = set(numbers) - {"color"} if settings.uses_soft else set(numbers)
        if learning and "depth" in numbers:
            exact.add("face")  # the gradient of depth needs the visible faces
        if exact and canvas.shows(settings.faces, settings.cull, settings.size):
            reused.add("faces")
            box, counts = canvas.box, canvas.counts
        elif exact:
            counts.fill(0)
            mask_only = numbers["mask"] if exact == {"mask"} else None
            box = rasterise_faces(scene, settings, canvas, mask_only, counts)
        if "box" not in settings.savings:
            box = (0, height, 0, width)
        if exact and canvas.shows(settings.faces, settings.cull, settings.size):
            fill_channels(scene, settings, canvas, numbers, box)
    left_out = {name: int(counts[reason]) for reason, name in raster.REASONS.items() if counts[reason]}
    visited = max(box[1] - box[0], 0) * max(box[3] - box[2], 0)
    reused_names = frozenset(reused)
    report = Report(
        len(faces), int(counts[raster.DRAWN]), left_out, visited, reused_names, frozenset(numbers)
    )
    channels = {name: torch.from_numpy(array) for name, array in numbers.items()}
    return RenderedImage(channels, report, lease, box, soft_image)


def is_out_of_view(scene: SceneArrays, settings: DrawingSettings) -> bool:
    """Return whether all vertices are out of view; always False if `savings` does not include "view"."""
    if len(settings.faces.array) == 0:
        return True
    if "view" not in settings.savings:
        return False
    height, width = settings.size
    margin = soft.blur_margin(settings.softness[0], settings.size) if settings.uses_soft else 0.0
    edges = (settings.near, height + 2 * margin, width + 2 * margin)
    pose = (scene.rotation, scene.translation, scene.lens[:2], scene.lens[2:] + margin)
    return bool(raster.is_out_of_view(scene.vertices, *pose, *edges))


def place_vertices(scene: SceneArrays, settings: DrawingSettings, canvas: Canvas) -> bool:
    """Project the vertices onto the canvas, unless it already holds the same projection.

    Returns:
        Whether the canvas already held the projection.
    """
    if "unchanged" not in settings.savings:
        canvas.forget()
    pose = np.concatenate([scene.rotation.ravel(), scene.translation, scene.lens, [settings.near]])
    if canvas.update_pose(scene.vertices, pose):
        return True
    lens = (scene.lens[:2], scene.lens[2:])
    inputs = (scene.vertices, scene.rotation, scene.translation, *lens, settings.near)
    canvas.cut = raster.project(*inputs, canvas.camera_points, canvas.screen)
    return False


def allocate_channels(scene: SceneArrays, settings: DrawingSettings) -> dict[str, np.ndarray]:
    """Return an array for each channel, filled with the background."""
    arrays: dict[str, np.ndarray] = {}
    for name in settings.channels:
        if name == "face":
            arrays[name] = np.full(settings.size, -1, np.int32)
        elif name == "depth":
            arrays[name] = np.full(settings.size, np.inf, np.float32)
        elif name == "mask":
            arrays[name] = np.zeros(settings.size, np.bool_)
        else:
            # the system provides zeros at first access, and pixels without a face are never accessed
            arrays[name] = np.zeros(
                (*settings.size, CHANNEL_SIZES.get(name) or scene.color_channels), np.float32
            )
    return arrays


def rasterise_faces(
    scene: SceneArrays,
    settings: DrawingSettings,
    canvas: Canvas,
    mask_only: np.ndarray | None,
    counts: np.ndarray,
) -> Box:
    """Draw all faces and return the box of the pixels that may show a face.

    The visible parts of faces that the near plane cuts are also drawn. The faces are drawn on the canvas, or, if
    `mask_only` is given, only into this mask. The number of faces with each outcome is added to `counts`, as in
    `raster.rasterise`.
    """
    faces, box = settings.faces.array, (settings.size[0], 0, settings.size[1], 0)
    tiles = None
    if mask_only is None:
        canvas.clear(settings.size)
        tiles = canvas.empty_tiles() if "hidden" in settings.savings else None
    arrays = (canvas.depth, canvas.face, None) if mask_only is None else (None, None, mask_only)
    cut = 0
    if canvas.cut:  # cut faces are near and hide many others, so they are drawn first
        corners, parts, numbers = clip(
            canvas.camera_points, faces, scene.lens[:2], scene.lens[2:], settings.near
        )
        if len(parts):
            tiles_or_none = tiles or (None, None, None)
            box = raster.rasterise(
                corners, parts, 0, numbers, settings.cull, *settings.size, *arrays, *tiles_or_none, counts
            )
            cut = int(counts[raster.DRAWN])
            counts.fill(0)
    if tiles is not None:
        targets = (canvas.depth, canvas.face, *tiles)
        rest = raster.front_to_back(canvas.screen, faces, settings.cull, *settings.size, *targets, counts)
    else:
        no_tiles = (None, None, None)
        rest = raster.rasterise(
            canvas.screen, faces, 0, None, settings.cull, *settings.size, *arrays, *no_tiles, counts
        )
    counts[raster.DRAWN] += cut
    counts[raster.BEHIND] -= cut
    box = (min(box[0], rest[0]), max(box[1], rest[1]), min(box[2], rest[2]), max(box[3], rest[3]))
    if mask_only is None:
        canvas.record_mesh(settings.faces, settings.cull, box, counts)
    return box


def fill_channels(
    scene: SceneArrays, settings: DrawingSettings, canvas: Canvas, numbers: dict[str, np.ndarray], box: Box
) -> None:
    """Fill the channels in `numbers` from the visible faces; colours are not filled if the gradient is "soft"."""
    top, bottom, left, right = box
    part = (slice(top, bottom), slice(left, right))
    if "face" in numbers:
        numbers["face"][part] = canvas.face[part]
    if "mask" in numbers:
        np.greater_equal(canvas.face[part], 0, out=numbers["mask"][part])
    vertices = (canvas.camera_points, canvas.screen)
    faces, visible = settings.faces.array, (canvas.face, box)
    color, depth = None if settings.uses_soft else numbers.get("color"), numbers.get("depth")
    if color is not None or depth is not None:
        paint = (scene.colors, scene.texture) if color is not None else (None, None)
        shading.shade(*vertices, faces, *paint, scene.lens, settings.near, *visible, color, depth)
    if not {"normal", "barycentric", "uv"}.isdisjoint(numbers):
        channels = [numbers.get(name) for name in ("normal", "barycentric", "uv")]
        shading.fill_surface_channels(
            *vertices, scene.vertices, faces, scene.texture, scene.lens, *visible, *channels
        )


class DrawImage(torch.autograd.Function):
    """Autograd function from the inputs that have a gradient to the channels, in the order of the settings.

    The inputs are vertices, colours, rotation, translation, lens (fx, fy, cx, cy), uv and texture images. The report is
    appended to `reports`.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        vertices: Tensor,
        colors: Tensor | None,
        rotation: Tensor,
        translation: Tensor,
        lens: Tensor,
        uv: Tensor | None,
        scene: SceneArrays,
        settings: DrawingSettings,
        pool: list[Canvas],
        reports: list[Report],
        *images: Tensor,
    ) -> tuple[Tensor, ...]:
        rendered = draw(scene, settings, pool, learning=True)
        reports.append(rendered.report)
        ctx.set_materialize_grads(False)
        ctx.scene, ctx.settings = scene, settings
        ctx.rendered = replace(rendered, channels={})  # an image that refers to itself would never be freed
        ctx.color = None
        if settings.gradient == "nmr" and "color" in rendered.channels:
            ctx.color = rendered.channels["color"].numpy().copy()
        learned = (vertices, colors, rotation, translation, lens, uv)
        # torch then raises an error if inputs were changed in place before the backward pass
        ctx.save_for_backward(*[part for part in (*learned, *images) if part is not None])
        ctx.types = [None if part is None else part.dtype for part in learned]
        ctx.images = [(image.shape, image.dtype) for image in images]
        ctx.mark_non_differentiable(
            *[part for name, part in rendered.channels.items() if name not in ("color", "depth")]
        )
        return tuple(rendered.channels.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_channels: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        image_gradients = {
            name: slope.contiguous().numpy()
            for name, slope in zip(ctx.settings.channels, grad_channels, strict=True)
            if slope is not None and name in ("color", "depth")
        }
        needs_gradient = ctx.needs_input_grad
        gradients = backward(
            ctx.scene,
            ctx.settings,
            ctx.rendered,
            ctx.color,
            image_gradients,
            needs_gradient[:6],
            any(needs_gradient[10:]),
        )
        *first, grad_texels = gradients
        parts = [
            to_gradient_tensor(part, kind) if wanted and part is not None else None
            for part, kind, wanted in zip(first, ctx.types, needs_gradient, strict=False)
        ]
        return *parts, None, None, None, None, *split_by_image(grad_texels, ctx.images)


def to_gradient_tensor(gradient: np.ndarray, kind: torch.dtype) -> Tensor:
    """Return a gradient as a tensor of the given number type, clamped to ±`STEEPEST`."""
    return torch.from_numpy(gradient).clamp_(-STEEPEST, STEEPEST).to(kind)


def split_by_image(
    grad_texels: np.ndarray | None, images: Sequence[tuple[torch.Size, torch.dtype]]
) -> list[Tensor | None]:
    """Split the gradient of all texels into one gradient per image."""
    gradients, start = [], 0
    for shape, kind in images:
        count = shape[0] * shape[1]
        if grad_texels is None:
            gradients.append(None)
        else:
            gradients.append(to_gradient_tensor(grad_texels[start : start + count], kind).reshape(shape))
        start += count
    return gradients


def backward(
    scene: SceneArrays,
    settings: DrawingSettings,
    rendered: RenderedImage,
    color: np.ndarray | None,
    image_gradients: dict[str, np.ndarray],
    needs_gradient: Sequence[bool],
    texels_need_gradient: bool,
) -> tuple[np.ndarray | None, ...]:
    """Return the gradients with respect to vertices, colours, rotation, translation, lens, uv and texels, float64.

    Args:
        scene: inputs of the image.
        settings: settings of the image.
        rendered: the image.
        color: colours of the image; needed only for gradient "nmr".
        image_gradients: gradients of the loss with respect to "color" and "depth".
        needs_gradient: whether vertices, colours, rotation, translation, lens and uv need a gradient. The gradient of
            an input that needs none may be None.
        texels_need_gradient: whether the texels need a gradient.
    """
    canvas, texture, vertices = rendered.lease.canvas, scene.texture, scene.vertices
    moving = any((needs_gradient[0], needs_gradient[2], needs_gradient[3], needs_gradient[4]))
    grad_colors = np.zeros(scene.colors.shape) if needs_gradient[1] and scene.colors is not None else None
    grad_uv = np.zeros(texture.uv.shape) if needs_gradient[5] and texture is not None else None
    grad_texels = np.zeros(texture.texels.shape) if texels_need_gradient and texture is not None else None
    grad_vertices, grad_rotation, grad_translation = np.zeros(vertices.shape), np.zeros((3, 3)), np.zeros(3)
    grad_lens = np.zeros(4) if moving else None
    if rendered.box[0] < rendered.box[1] or rendered.soft_image is not None:
        grad_points = np.zeros(canvas.camera_points.shape) if moving else None
        add_gradients(
            scene,
            settings,
            rendered,
            color,
            image_gradients,
            grad_points,
            grad_lens,
            grad_colors,
            grad_texels,
            grad_uv,
        )
        if grad_points is not None:
            transform_to_world(
                vertices, scene.rotation, grad_points, grad_vertices, grad_rotation, grad_translation
            )
    return grad_vertices, grad_colors, grad_rotation, grad_translation, grad_lens, grad_uv, grad_texels


def add_gradients(
    scene: SceneArrays,
    settings: DrawingSettings,
    rendered: RenderedImage,
    color: np.ndarray | None,
    image_gradients: dict[str, np.ndarray],
    grad_points: np.ndarray | None,
    grad_lens: np.ndarray | None,
    grad_colors: np.ndarray | None,
    grad_texels: np.ndarray | None,
    grad_uv: np.ndarray | None,
) -> None:
    """Add the gradients to the arrays `grad_*`, by the method that `settings.gradient` names.

    `grad_points` is the gradient with respect to the vertices in camera coordinates. The arrays of inputs that need no
    gradient are None. `image_gradients` are the gradients of the loss with respect to "color" and "depth". `color`
    holds the colours of the image, which only the gradient "nmr" needs.
    """
    canvas, lens, colors, texture = rendered.lease.canvas, scene.lens, scene.colors, scene.texture
    grad_image, grad_depth = image_gradients.get("color"), image_gradients.get("depth")
    faces = settings.faces.array
    surface = (
        canvas.camera_points,
        canvas.screen,
        faces,
        colors,
        texture,
        lens,
        canvas.face,
        rendered.box,
        canvas.scratch(len(faces)),
    )
    grad_paint = (grad_colors, grad_texels, grad_uv)
    visible = rendered.box[0] < rendered.box[1]
    if settings.gradient in ("nmr", "soft"):
        if visible and grad_depth is not None:
            interior(*surface, None, grad_depth, grad_points, grad_lens, None, None, None)
        if grad_image is not None and rendered.soft_image is not None and colors is not None:
            sums = (
                np.zeros(shape) if gradient is None else gradient
                for gradient, shape in (
                    (grad_points, canvas.camera_points.shape),
                    (grad_colors, colors.shape),
                    (grad_lens, (4,)),
                )
            )
            soft.add_gradients(
                canvas.camera_points, faces, colors, lens, rendered.soft_image, grad_image, *sums
            )
        elif grad_image is not None and visible and settings.gradient == "nmr":
            # inside of faces, "nmr" has gradients with respect to colours and textures only
            interior(*surface, grad_image, None, None, None, *grad_paint)
            if grad_points is not None and grad_lens is not None and color is not None:
                image = (canvas.face, color, grad_image)
                nmr.add_edge_gradients(
                    canvas.camera_points, canvas.screen, faces, lens, *image, grad_points, grad_lens
                )
    elif visible:
        interior(*surface, grad_image, grad_depth, grad_points, grad_lens, *grad_paint)
        if settings.gradient == "boundary" and grad_image is not None and grad_points is not None:
            edges = (
                canvas.camera_points,
                canvas.screen,
                faces,
                settings.faces.adjacent,
                colors,
                texture,
                lens,
            )
            image = (canvas.face, canvas.depth, rendered.box, settings.single_sample)
            boundary(*edges, *image, grad_image, grad_points, grad_lens)
