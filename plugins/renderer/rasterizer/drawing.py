"""One picture of one scene as a differentiable operation on tensors: compiled kernels forwards and backwards."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from plugins.renderer.rasterizer import gradient, raster

Gradient = Literal["boundary", "interior"]


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
        gradient: of what edges hand over, too, or of the inside of faces alone.
    """

    faces: np.ndarray
    beside: Callable[[], np.ndarray]
    near: float
    size: tuple[int, int]
    cull: bool
    channels: frozenset[str]
    gradient: Gradient


@dataclass
class Drawn:
    """A picture and what its gradient reads; channels that nobody reads are of size 0."""

    seen: np.ndarray
    screen: np.ndarray
    box: tuple[int, int, int, int]
    color: np.ndarray
    depth: np.ndarray
    face: np.ndarray
    mask: np.ndarray


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
    want_face = not {"color", "face"}.isdisjoint(view.channels)
    want_depth = want_face or "depth" in view.channels
    depth = np.full(view.size if want_depth else (0, 0), np.inf, np.float32)
    face = np.full(view.size if want_face else (0, 0), -1, np.int32)
    # Fresh zeros cost nothing until they are touched, which pixels that no face covers are not.
    mask = np.zeros(view.size if "mask" in view.channels else (0, 0), np.bool_)
    color = np.zeros((*view.size, colors.shape[1]) if colors is not None else (0, 0, 0), np.float32)
    faces = view.faces
    if raster.out_of_view(vertices, rotation, translation, focal, principal, view.near, height, width):
        faces = faces[:0]
    count = len(vertices) if len(faces) else 0
    seen, screen = np.empty((count, 3)), np.empty((count, 3))
    box = (height, 0, width, 0)
    if len(faces):
        hidden = raster.project(vertices, rotation, translation, focal, principal, view.near, seen, screen)
        nothing = np.empty(0, np.int64)
        box = raster.rasterise(screen, faces, nothing, view.cull, height, width, depth, face, mask)
        if hidden:
            corners, parts, numbers = raster.clipped(seen, faces, focal, principal, view.near)
            if len(parts):
                cut = raster.rasterise(corners, parts, numbers, view.cull, height, width, depth, face, mask)
                box = tuple(least(*pair) for least, *pair in zip((min, max, min, max), box, cut, strict=True))
        if colors is not None:
            raster.shade(seen, screen, faces, colors, focal, principal, face, box, color)
    return Drawn(seen, screen, box, color, depth, face, mask)


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
    if drawn.box[0] < drawn.box[1] and drawn.face.size:
        of_seen = np.zeros((len(vertices), 3))
        shown = np.zeros((0, 0), np.float32) if colors is None else colors
        along_color = along_color if colors is not None else np.zeros((0, 0, 0), np.float32)
        deep = along_depth if "depth" in view.channels else np.zeros((0, 0), np.float32)
        picture = (drawn.seen, view.faces, shown, lens, drawn.face, drawn.box)
        gradient.interior(*picture, along_color, deep, of_seen, of_colors, of_lens)
        if view.gradient == "boundary" and colors is not None:
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
                along_color,
                of_seen,
                of_lens,
            )
        gradient.of_the_world(vertices, rotation, of_seen, of_vertices, of_rotation, of_translation)
    return of_vertices, None if colors is None else of_colors, of_rotation, of_translation, of_lens
