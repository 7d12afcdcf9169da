"""One image of one scene as a differentiable operation on tensors, with compiled forward and backward kernels."""

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
from plugins.renderer.rasterizer.canvas import Box, Canvas, Corners, Lease
from plugins.renderer.rasterizer.clipping import clipped
from plugins.renderer.rasterizer.interior import interior, of_the_world
from plugins.renderer.rasterizer.textures import Laid

Gradient = Literal["boundary", "interior", "nmr", "soft"]
Saving = Literal["view", "box", "hidden", "unchanged"]
NUMBERS = {"normal": 3, "barycentric": 3, "uv": 2}
STEEPEST = 1e37
"""Largest absolute value of a gradient, such that float32 holds it and sums of a few.

Steeper gradients, where faces almost touch the camera, are clamped to this value.
"""


@dataclass(frozen=True)
class View:
    """Settings of an image apart from the inputs that have a gradient; plain numbers.

    Attributes:
        faces: faces of the scene.
        near: distance of the near plane, metres.
        size: (height, width), pixels.
        cull: leave out faces seen from behind.
        channels: channels to draw, in this order.
        gradient: see `Rasterizer`; "soft" draws another image.
        softness: σ and γ of "soft".
        savings: work that may be left out, see `Rasterizer`.
        once: whether a pixel is one sample, and not the mean of several.
    """

    faces: Corners
    near: float
    size: tuple[int, int]
    cull: bool
    channels: tuple[str, ...]
    gradient: Gradient
    softness: tuple[float, float]
    savings: frozenset[Saving]
    once: bool = True

    @property
    def blended(self) -> bool:
        """True if the colour is that of `soft`."""
        return "color" in self.channels and self.gradient == "soft"


@dataclass(frozen=True)
class Given:
    """Inputs of an image that have a gradient, and the whole texture, as arrays.

    Attributes:
        lens: fx, fy, cx, cy, pixels.
        laid: the texture; its texels are those of all images.
    """

    vertices: np.ndarray
    colors: np.ndarray | None
    rotation: np.ndarray
    translation: np.ndarray
    lens: np.ndarray
    laid: Laid | None

    @property
    def paints(self) -> int:
        """Number of channels of a colour."""
        return self.colors.shape[1] if self.colors is not None else cast(Laid, self.laid).texels.shape[1]


@dataclass
class Drawn:
    """An image and the data that its gradient reads.

    Attributes:
        channels: the channels that were asked for.
        box: part of the canvas that may show a face.
        blend: unrounded colours where the gradient is "soft" and something is in view.
    """

    channels: dict[str, Tensor]
    report: Report
    lease: Lease
    box: Box
    blend: soft.Blend | None


def draw(given: Given, view: View, pool: list[Canvas], learning: bool) -> Drawn:
    """Return the channels of a view; `learning` keeps what the gradient needs."""
    lease = Lease(pool)
    canvas, (height, width), faces = lease.canvas, view.size, view.faces.array
    numbers = outputs(given, view)
    counts, box, blend = np.zeros(len(raster.REASONS) + 1, np.int64), (height, 0, width, 0), None
    reused: set[str] = set()
    if out_of_view(given, view):
        counts[raster.OUTSIDE] = len(faces)
    else:
        if placed(given, view, canvas):
            reused.add("places")
        if view.blended and given.colors is not None:
            seen = (canvas.seen, canvas.screen, faces, given.colors, given.lens)
            blend = soft.blend(*seen, view.cull, view.size, *view.softness, counts)
            numbers["color"][:] = blend.color
        exact = set(numbers) - {"color"} if view.blended else set(numbers)
        if learning and "depth" in numbers:
            exact.add("face")  # the gradient of a depth needs the visible faces
        if exact and canvas.has(view.faces, view.cull, view.size):
            reused.add("faces")
            box, counts = canvas.box, canvas.counts
        elif exact:
            counts.fill(0)
            alone = numbers["mask"] if exact == {"mask"} else None
            box = rasterised(given, view, canvas, alone, counts)
        if "box" not in view.savings:
            box = (0, height, 0, width)
        if exact and canvas.has(view.faces, view.cull, view.size):
            fill(given, view, canvas, numbers, box)
    left_out = {name: int(counts[place]) for place, name in raster.REASONS.items() if counts[place]}
    visited = max(box[1] - box[0], 0) * max(box[3] - box[2], 0)
    told = frozenset(reused)
    report = Report(len(faces), int(counts[raster.DRAWN]), left_out, visited, told, frozenset(numbers))
    channels = {name: torch.from_numpy(array) for name, array in numbers.items()}
    return Drawn(channels, report, lease, box, blend)


def out_of_view(given: Given, view: View) -> bool:
    """Return whether there is nothing to draw; false also where `savings` does not include this test."""
    if len(view.faces.array) == 0:
        return True
    if "view" not in view.savings:
        return False
    height, width = view.size
    margin = soft.reach(view.softness[0], view.size) if view.blended else 0.0
    edges = (view.near, height + 2 * margin, width + 2 * margin)
    pose = (given.rotation, given.translation, given.lens[:2], given.lens[2:] + margin)
    return bool(raster.out_of_view(given.vertices, *pose, *edges))


def placed(given: Given, view: View, canvas: Canvas) -> bool:
    """Put the vertices on the canvas, and return whether they were there already."""
    if "unchanged" not in view.savings:
        canvas.forget()
    pose = np.concatenate([given.rotation.ravel(), given.translation, given.lens, [view.near]])
    if canvas.placed(given.vertices, pose):
        return True
    lens = (given.lens[:2], given.lens[2:])
    place = (given.vertices, given.rotation, given.translation, *lens, view.near)
    canvas.cut = raster.project(*place, canvas.seen, canvas.screen)
    return False


def outputs(given: Given, view: View) -> dict[str, np.ndarray]:
    """Return arrays for the channels, filled with the background."""
    made: dict[str, np.ndarray] = {}
    for name in view.channels:
        if name == "face":
            made[name] = np.full(view.size, -1, np.int32)
        elif name == "depth":
            made[name] = np.full(view.size, np.inf, np.float32)
        elif name == "mask":
            made[name] = np.zeros(view.size, np.bool_)
        else:
            # Fresh zeros cost nothing until they are touched, and pixels that no face covers are never touched.
            made[name] = np.zeros((*view.size, NUMBERS.get(name) or given.paints), np.float32)
    return made


def rasterised(given: Given, view: View, canvas: Canvas, alone: np.ndarray | None, counts: np.ndarray) -> Box:
    """Draw all faces on the canvas, or into a mask alone, and count what happens to them.

    Faces that the near plane cuts are drawn too.
    """
    faces, box = view.faces.array, (view.size[0], 0, view.size[1], 0)
    tiles = None
    if alone is None:
        canvas.cleared(view.size)
        tiles = canvas.empty_tiles() if "hidden" in view.savings else None
    arrays = (canvas.depth, canvas.face, None) if alone is None else (None, None, alone)
    cut = 0
    if canvas.cut:  # faces that the near plane cuts are near and hide later faces, so they are drawn first
        corners, parts, numbers = clipped(canvas.seen, faces, given.lens[:2], given.lens[2:], view.near)
        if len(parts):
            known = tiles or (None, None, None)
            box = raster.rasterise(corners, parts, 0, numbers, view.cull, *view.size, *arrays, *known, counts)
            cut = int(counts[raster.DRAWN])
            counts.fill(0)
    if tiles is not None:
        drawn_in = (canvas.depth, canvas.face, *tiles)
        rest = raster.front_to_back(canvas.screen, faces, view.cull, *view.size, *drawn_in, counts)
    else:
        nothing = (None, None, None)
        rest = raster.rasterise(
            canvas.screen, faces, 0, None, view.cull, *view.size, *arrays, *nothing, counts
        )
    counts[raster.DRAWN] += cut
    counts[raster.BEHIND] -= cut
    box = (min(box[0], rest[0]), max(box[1], rest[1]), min(box[2], rest[2]), max(box[3], rest[3]))
    if alone is None:
        canvas.shows(view.faces, view.cull, box, counts)
    return box


def fill(given: Given, view: View, canvas: Canvas, numbers: dict[str, np.ndarray], box: Box) -> None:
    """Fill the channels from the visible faces."""
    top, bottom, left, right = box
    part = (slice(top, bottom), slice(left, right))
    if "face" in numbers:
        numbers["face"][part] = canvas.face[part]
    if "mask" in numbers:
        np.greater_equal(canvas.face[part], 0, out=numbers["mask"][part])
    places = (canvas.seen, canvas.screen)
    faces, visible = view.faces.array, (canvas.face, box)
    color, depth = None if view.blended else numbers.get("color"), numbers.get("depth")
    if color is not None or depth is not None:
        painted = (given.colors, given.laid) if color is not None else (None, None)
        shading.shade(*places, faces, *painted, given.lens, view.near, *visible, color, depth)
    if not {"normal", "barycentric", "uv"}.isdisjoint(numbers):
        asked = [numbers.get(name) for name in ("normal", "barycentric", "uv")]
        shading.inform(*places, given.vertices, faces, given.laid, given.lens, *visible, *asked)


class Picture(torch.autograd.Function):
    """The differentiable channels, in the view's order, of all inputs that have a gradient.

    These are vertices, colours, rotation, translation, lens (fx, fy, cx, cy), uv and images. `made` receives the
    report.
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
        given: Given,
        view: View,
        pool: list[Canvas],
        made: list[Report],
        *images: Tensor,
    ) -> tuple[Tensor, ...]:
        drawn = draw(given, view, pool, learning=True)
        made.append(drawn.report)
        ctx.set_materialize_grads(False)
        ctx.given, ctx.view = given, view
        ctx.drawn = replace(drawn, channels={})  # an image that refers to itself would never be freed
        ctx.color = None
        if view.gradient == "nmr" and "color" in drawn.channels:
            ctx.color = drawn.channels["color"].numpy().copy()
        learned = (vertices, colors, rotation, translation, lens, uv)
        # torch then refuses a gradient of inputs that were changed in place in the meantime
        ctx.save_for_backward(*[part for part in (*learned, *images) if part is not None])
        ctx.types = [None if part is None else part.dtype for part in learned]
        ctx.images = [(image.shape, image.dtype) for image in images]
        ctx.mark_non_differentiable(
            *[part for name, part in drawn.channels.items() if name not in ("color", "depth")]
        )
        return tuple(drawn.channels.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *along: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        slopes = {
            name: slope.contiguous().numpy()
            for name, slope in zip(ctx.view.channels, along, strict=True)
            if slope is not None and name in ("color", "depth")
        }
        asked = ctx.needs_input_grad
        found = backward(ctx.given, ctx.view, ctx.drawn, ctx.color, slopes, asked[:6], any(asked[10:]))
        *first, of_texels = found
        parts = [
            slopes_as(part, kind) if wanted and part is not None else None
            for part, kind, wanted in zip(first, ctx.types, asked, strict=False)
        ]
        return *parts, None, None, None, None, *of_images(of_texels, ctx.images)


def slopes_as(found: np.ndarray, kind: torch.dtype) -> Tensor:
    """Return a gradient as a tensor of the input's number type, clamped to STEEPEST."""
    return torch.from_numpy(found).clamp_(-STEEPEST, STEEPEST).to(kind)


def of_images(
    of_texels: np.ndarray | None, images: Sequence[tuple[torch.Size, torch.dtype]]
) -> list[Tensor | None]:
    """Split the gradient of all texels into one gradient per image."""
    found, start = [], 0
    for shape, kind in images:
        count = shape[0] * shape[1]
        if of_texels is None:
            found.append(None)
        else:
            found.append(slopes_as(of_texels[start : start + count], kind).reshape(shape))
        start += count
    return found


def backward(
    given: Given,
    view: View,
    drawn: Drawn,
    color: np.ndarray | None,
    slopes: dict[str, np.ndarray],
    asked: Sequence[bool],
    of_images: bool,
) -> tuple[np.ndarray | None, ...]:
    """Return gradients in vertices, colours, rotation, translation, lens, uv and texels, float64.

    A gradient that was not asked for is None, or is returned where it was computed anyway. `color` is the image, for
    the kinds of gradient that read it.
    """
    canvas, laid, vertices = drawn.lease.canvas, given.laid, given.vertices
    moving = any((asked[0], asked[2], asked[3], asked[4]))
    of_colors = np.zeros(given.colors.shape) if asked[1] and given.colors is not None else None
    of_uv = np.zeros(laid.uv.shape) if asked[5] and laid is not None else None
    of_texels = np.zeros(laid.texels.shape) if of_images and laid is not None else None
    of_vertices, of_rotation, of_translation = np.zeros(vertices.shape), np.zeros((3, 3)), np.zeros(3)
    of_lens = np.zeros(4) if moving else None
    if drawn.box[0] < drawn.box[1] or drawn.blend is not None:
        of_seen = np.zeros(canvas.seen.shape) if moving else None
        to_camera(given, view, drawn, color, slopes, of_seen, of_lens, of_colors, of_texels, of_uv)
        if of_seen is not None:
            of_the_world(vertices, given.rotation, of_seen, of_vertices, of_rotation, of_translation)
    return of_vertices, of_colors, of_rotation, of_translation, of_lens, of_uv, of_texels


def to_camera(
    given: Given,
    view: View,
    drawn: Drawn,
    color: np.ndarray | None,
    slopes: dict[str, np.ndarray],
    of_seen: np.ndarray | None,
    of_lens: np.ndarray | None,
    of_colors: np.ndarray | None,
    of_texels: np.ndarray | None,
    of_uv: np.ndarray | None,
) -> None:
    """Add the gradients in camera coordinates, lens, colours and texture, by the kind of gradient."""
    canvas, lens, colors, laid = drawn.lease.canvas, given.lens, given.colors, given.laid
    along_color, along_depth = slopes.get("color"), slopes.get("depth")
    faces = view.faces.array
    surface = (
        canvas.seen,
        canvas.screen,
        faces,
        colors,
        laid,
        lens,
        canvas.face,
        drawn.box,
        canvas.scratch(len(faces)),
    )
    of_paint = (of_colors, of_texels, of_uv)
    visible = drawn.box[0] < drawn.box[1]
    if view.gradient in ("nmr", "soft"):
        if visible and along_depth is not None:
            interior(*surface, None, along_depth, of_seen, of_lens, None, None, None)
        if along_color is not None and drawn.blend is not None and colors is not None:
            sums = (
                np.zeros(shape) if of is None else of
                for of, shape in ((of_seen, canvas.seen.shape), (of_colors, colors.shape), (of_lens, (4,)))
            )
            soft.slopes(canvas.seen, faces, colors, lens, drawn.blend, along_color, *sums)
        elif along_color is not None and visible and view.gradient == "nmr":
            # inside of faces, "nmr" has gradients in colours and textures only
            interior(*surface, along_color, None, None, None, *of_paint)
            if of_seen is not None and of_lens is not None and color is not None:
                picture = (canvas.face, color, along_color)
                nmr.sweeps(canvas.seen, canvas.screen, faces, lens, *picture, of_seen, of_lens)
    elif visible:
        interior(*surface, along_color, along_depth, of_seen, of_lens, *of_paint)
        if view.gradient == "boundary" and along_color is not None and of_seen is not None:
            edges = (canvas.seen, canvas.screen, faces, view.faces.beside, colors, laid, lens)
            picture = (canvas.face, canvas.depth, drawn.box, view.once)
            boundary(*edges, *picture, along_color, of_seen, of_lens)
