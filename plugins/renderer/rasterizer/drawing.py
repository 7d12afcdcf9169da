"""One picture of one scene as a differentiable operation on tensors: compiled kernels forwards and backwards."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from plugins.renderer.rasterizer import gradient, nmr, raster, soft

Gradient = Literal["boundary", "interior", "nmr", "soft"]


@dataclass(frozen=True)
class View:
    """What a picture needs beside what it is differentiated in; plain numbers.

    Attributes:
        faces: (faces, 3) int32 or int64.
        beside: gives `gradient.neighbours` of them, when they are asked for.
        near: metres.
        size: (height, width), pixels.
        cull: leave out faces seen from behind.
        channels: to draw.
        gradient: see `Rasterizer`; "soft" draws another picture.
        softness: σ and γ of "soft".
        once: whether a pixel is one sample, and not the mean of several.
    """

    faces: np.ndarray
    beside: Callable[[], np.ndarray]
    near: float
    size: tuple[int, int]
    cull: bool
    channels: frozenset[str]
    gradient: Gradient
    softness: tuple[float, float]
    once: bool = True


@dataclass
class Drawn:
    """A picture and what its gradient reads; channels that nobody reads are of size 0.

    Attributes:
        blend: what `color` was rounded from where the gradient is "soft" and something is in view.
    """

    seen: np.ndarray
    screen: np.ndarray
    box: tuple[int, int, int, int]
    color: np.ndarray
    depth: np.ndarray
    face: np.ndarray
    mask: np.ndarray
    blend: soft.Blend | None


def draw(
    vertices: np.ndarray,
    colors: np.ndarray | None,
    rotation: np.ndarray,
    translation: np.ndarray,
    lens: np.ndarray,
    view: View,
) -> Drawn:
    """The channels of a view; `lens` holds fx, fy, cx, cy, pixels."""
    height, width = view.size
    focal, principal = lens[:2], lens[2:]
    blended = colors is not None and view.gradient == "soft"
    want_face = "face" in view.channels or ("color" in view.channels and not blended)
    want_depth = want_face or "depth" in view.channels
    depth = np.full(view.size if want_depth else (0, 0), np.inf, np.float32)
    face = np.full(view.size if want_face else (0, 0), -1, np.int32)
    # Fresh zeros cost nothing until they are touched, which pixels that no face covers are not.
    mask = np.zeros(view.size if "mask" in view.channels else (0, 0), np.bool_)
    color = np.zeros((*view.size, colors.shape[1]) if colors is not None else (0, 0, 0), np.float32)
    faces = view.faces
    margin = soft.reach(view.softness[0], view.size) if blended else 0.0
    bounds = (principal + margin, view.near, height + 2 * margin, width + 2 * margin)
    if raster.out_of_view(vertices, rotation, translation, focal, *bounds):
        faces = faces[:0]
    count = len(vertices) if len(faces) else 0
    seen, screen = np.empty((count, 3)), np.empty((count, 3))
    box = (height, 0, width, 0)
    blend = None
    if len(faces):
        hidden = raster.project(vertices, rotation, translation, focal, principal, view.near, seen, screen)
        if blended and colors is not None:
            blend = soft.blend(seen, screen, faces, colors, lens, view.cull, view.size, *view.softness)
            color = blend.color.astype(np.float32)
    if len(faces) and (want_depth or mask.size):
        nothing = np.empty(0, np.int64)
        box = raster.rasterise(screen, faces, nothing, view.cull, height, width, depth, face, mask)
        if hidden:
            corners, parts, numbers = raster.clipped(seen, faces, focal, principal, view.near)
            if len(parts):
                cut = raster.rasterise(corners, parts, numbers, view.cull, height, width, depth, face, mask)
                box = tuple(least(*pair) for least, *pair in zip((min, max, min, max), box, cut, strict=True))
        if colors is not None and not blended:
            raster.shade(seen, screen, faces, colors, focal, principal, face, box, color)
    return Drawn(seen, screen, box, color, depth, face, mask, blend)


class Picture(torch.autograd.Function):
    """(color, depth, face, mask) of vertices, colours, rotation, translation and lens (fx, fy, cx, cy)."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        vertices: Tensor,
        colors: Tensor | None,
        rotation: Tensor,
        translation: Tensor,
        lens: Tensor,
        view: View,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        shown = None if colors is None else colors.detach().contiguous().numpy()
        place = vertices.detach().contiguous().numpy()
        turn, shift, focus = (
            part.detach().double().contiguous().numpy() for part in (rotation, translation, lens)
        )
        if any(ctx.needs_input_grad) and "depth" in view.channels:
            view = replace(view, channels=view.channels | {"face"})  # which a depth's slope is led through
        drawn = draw(place, shown, turn, shift, focus, view)
        ctx.arrays, ctx.drawn, ctx.view = (place, shown, turn, shift, focus), drawn, view
        ctx.types = [
            None if part is None else part.dtype for part in (vertices, colors, rotation, translation, lens)
        ]
        color, depth, face, mask = map(torch.from_numpy, (drawn.color, drawn.depth, drawn.face, drawn.mask))
        ctx.mark_non_differentiable(face, mask)
        return color, depth, face, mask

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, along_color: Tensor, along_depth: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        vertices, colors, rotation, _, lens = ctx.arrays
        drawn: Drawn = ctx.drawn
        slopes = [part.contiguous().numpy() for part in (along_color, along_depth)]
        found = backward(vertices, colors, rotation, lens, drawn, ctx.view, *slopes)
        return *(
            None if part is None or kind is None else torch.from_numpy(part).to(kind)
            for part, kind in zip(found, ctx.types, strict=True)
        ), None


def backward(
    vertices: np.ndarray,
    colors: np.ndarray | None,
    rotation: np.ndarray,
    lens: np.ndarray,
    drawn: Drawn,
    view: View,
    along_color: np.ndarray,
    along_depth: np.ndarray,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray, np.ndarray]:
    """Slopes in vertices, colours, rotation, translation and lens, float64."""
    of_vertices = np.zeros((len(vertices), 3))
    of_colors = np.zeros((0, 0) if colors is None else colors.shape)
    of_rotation, of_translation, of_lens = np.zeros((3, 3)), np.zeros(3), np.zeros(4)
    if len(drawn.seen):
        of_seen = np.zeros((len(vertices), 3))
        deep = along_depth if "depth" in view.channels else np.zeros((0, 0), np.float32)
        to_camera(colors, lens, drawn, view, along_color, deep, of_seen, of_colors, of_lens)
        gradient.of_the_world(vertices, rotation, of_seen, of_vertices, of_rotation, of_translation)
    return of_vertices, None if colors is None else of_colors, of_rotation, of_translation, of_lens


def to_camera(
    colors: np.ndarray | None,
    lens: np.ndarray,
    drawn: Drawn,
    view: View,
    along_color: np.ndarray,
    along_depth: np.ndarray,
    of_seen: np.ndarray,
    of_colors: np.ndarray,
    of_lens: np.ndarray,
) -> None:
    """Add the slopes in camera coordinates, colours and lens, by the kind of gradient."""
    no_color, no_depth = np.zeros((0, 0, 0), np.float32), np.zeros((0, 0), np.float32)
    shown = np.zeros((0, 0), np.float32) if colors is None else colors
    visible = drawn.face.size > 0 and drawn.box[0] < drawn.box[1]
    faces = (drawn.seen, view.faces, shown, lens, drawn.face, drawn.box)
    if drawn.blend is not None:
        soft.slopes(
            drawn.seen, view.faces, shown, lens, drawn.blend, along_color, of_seen, of_colors, of_lens
        )
    if colors is None or view.gradient == "soft":
        if visible:
            gradient.interior(*faces, no_color, along_depth, of_seen, of_colors, of_lens)
    elif visible and view.gradient == "nmr":
        # of what faces do within, colours and depths alone
        gradient.interior(
            *faces, along_color, no_depth, np.zeros_like(of_seen), of_colors, np.zeros_like(of_lens)
        )
        gradient.interior(*faces, no_color, along_depth, of_seen, of_colors, of_lens)
        picture = (drawn.face, drawn.color, along_color)
        nmr.sweeps(drawn.seen, drawn.screen, view.faces, lens, *picture, of_seen, of_lens)
    elif visible:
        gradient.interior(*faces, along_color, along_depth, of_seen, of_colors, of_lens)
        if view.gradient == "boundary":
            gradient.boundary(
                drawn.seen,
                drawn.screen,
                view.faces,
                view.beside(),
                colors,
                lens,
                drawn.face,
                drawn.depth,
                drawn.box,
                view.once,
                along_color,
                of_seen,
                of_lens,
            )
