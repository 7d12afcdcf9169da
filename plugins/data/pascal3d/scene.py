"""Generator of one labelled image: objects from random viewpoints in front of a backdrop, blur and noise."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image, ImageFilter
from torch import Tensor

from framework.geometry.camera import Camera, look_from
from framework.renderer import Scene
from plugins.data.pascal3d.backdrop import FloatImage, background, blob, texture
from plugins.data.pascal3d.families import FAMILIES
from plugins.data.pascal3d.shapes import Mesh
from plugins.data.pascal3d.viewpoints import viewpoint

SUPERSAMPLING = 2
Edges = tuple[float, float, float, float]
"""Left, top, right and bottom edge, pixels."""
RenderFunction = Callable[[Scene, Collection[str]], Mapping[str, Tensor]]
"""Type of `framework.renderer.Renderer.__call__`."""


class View(NamedTuple):
    """Viewpoint of a camera.

    Attributes:
        azimuth, elevation, tilt: Angles, degrees.
        distance: Distance of the camera from the object's centre, in diagonals of the object.
        focal: Focal length, pixels.
        principal: Principal point (x, y), pixels from the centre of the first pixel.
    """

    azimuth: float
    elevation: float
    tilt: float
    distance: float
    focal: float
    principal: tuple[float, float]


class AnnotatedObject(NamedTuple):
    """Annotation of an object in an image.

    Attributes:
        category: Name of the class.
        view: Viewpoint.
        box: First column, first row, last column and last row of the object, counted from 0.
        truncated, occluded, difficult: Flags of the annotation.
        fine: False if only a coarse label is given.
        symmetry: n if the object looks the same after a rotation by 360°/n about the vertical; 0 if it looks the same
            after any such rotation.
    """

    category: str
    view: View
    box: tuple[int, int, int, int]
    truncated: bool
    occluded: bool
    difficult: bool
    fine: bool
    symmetry: int


class Layer(NamedTuple):
    """Rendered object, as an image with premultiplied alpha.

    Attributes:
        color: Colour times opacity, (height, width, 3), 0…1.
        opacity: Opacity, (height, width), 0…1.
    """

    color: FloatImage
    opacity: NDArray[np.float32]


def camera_of(view: View) -> Camera:
    """Return the camera of a view, with an image of one pixel; `crop_camera` returns a camera with a larger image."""
    angles = (math.radians(angle) for angle in (view.azimuth, view.elevation, view.tilt))
    camera = look_from(*angles, distance=view.distance, field_of_view=1.0, size=(1, 1))
    return dataclasses.replace(camera, focal=(view.focal, view.focal), principal=view.principal)


def crop_camera(camera: Camera, corner: tuple[int, int], size: tuple[int, int], scale: int) -> Camera:
    """Return the camera of a part of the image, in which each pixel is divided into `scale` × `scale` pixels.

    The part begins at `corner` (x, y) and has `size` (height, width) pixels of the original image.
    """
    middle = (scale - 1) / 2  # index of the centre of a pixel among the finer pixels
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    return dataclasses.replace(
        camera,
        focal=(scale * fx, scale * fy),
        principal=(scale * (cx - corner[0]) + middle, scale * (cy - corner[1]) + middle),
        height=scale * size[0],
        width=scale * size[1],
    )


def projected_edges(mesh: Mesh, camera: Camera) -> Edges:
    """Return the left, top, right and bottom edge of the box around the projected vertices, pixels."""
    inside = camera.rotation.double().numpy() @ mesh.vertices.T + camera.translation.double().numpy()[:, None]
    column = camera.focal[0] * inside[0] / inside[2] + camera.principal[0]
    row = camera.focal[1] * inside[1] / inside[2] + camera.principal[1]
    return float(column.min()), float(row.min()), float(column.max()), float(row.max())


def shade_vertices(mesh: Mesh, random: Generator) -> NDArray[np.float64]:
    """Return the vertex colours (vertices, 3) under sky light and one lamp at a random position."""
    azimuth, height = random.uniform(0, 2 * np.pi), random.uniform(0.2, 1.4)
    lamp = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    ambient = random.uniform(0.4, 0.7)
    sky = ambient * (0.75 + 0.25 * mesh.normals[:, 2])
    direct = (1.3 - ambient) * np.clip(mesh.normals @ lamp, 0, None)
    return np.clip(mesh.colors * (sky + direct)[:, None], 0, 1)


def render_object(
    renderer: RenderFunction,
    mesh: Mesh,
    colors: NDArray[np.float64],
    camera: Camera,
    edges: Edges,
    size: tuple[int, int],
) -> Layer:
    """Return an image of `size` (height, width) that shows only the object.

    Only the part within `edges`, the result of `projected_edges`, is rendered.
    """
    height, width = size
    left, top, right, bottom = edges
    x0, x1 = max(0, math.floor(left)), min(width, math.ceil(right) + 1)
    y0, y1 = max(0, math.floor(top)), min(height, math.ceil(bottom) + 1)
    planes = np.zeros((3, height, width), np.float32)
    layer = Layer(np.moveaxis(planes, 0, 2), np.zeros((height, width), np.float32))
    if x0 >= x1 or y0 >= y1:
        return layer
    scene = Scene(
        vertices=torch.from_numpy(mesh.vertices).float(),
        faces=torch.from_numpy(mesh.faces),
        colors=torch.from_numpy(colors).float(),
        camera=crop_camera(camera, (x0, y0), (y1 - y0, x1 - x0), SUPERSAMPLING),
    )
    channels = renderer(scene, ("color", "mask"))
    planes[:, y0:y1, x0:x1] = _average_blocks(channels["color"].movedim(2, 0).contiguous().cpu().numpy())
    layer.opacity[y0:y1, x0:x1] = _average_blocks(channels["mask"].cpu().numpy().astype(np.float32))
    return layer


def _average_blocks(fine: FloatImage) -> FloatImage:
    """Return the mean of every block of SUPERSAMPLING × SUPERSAMPLING pixels of an image (…, height, width)."""
    step = range(SUPERSAMPLING)
    total = sum(fine[..., row::SUPERSAMPLING, column::SUPERSAMPLING] for row in step for column in step)
    return np.asarray(total / np.float32(SUPERSAMPLING**2))


class Shot(NamedTuple):
    """Finished image with its annotations.

    Attributes:
        pixels: The image, (height, width, 3).
        objects: Annotations of its objects.
        blur: Standard deviation of the Gaussian that blurred the image, pixels.
    """

    pixels: NDArray[np.uint8]
    objects: list[AnnotatedObject]
    blur: float


def shoot(category: str, random: Generator, renderer: RenderFunction) -> Shot:
    """Return an image of an object of `category`, sometimes with a second object, or with a shape in front of it."""
    size = height, width = int(random.integers(96, 129)), int(random.integers(112, 145))
    main = _place(category, random, renderer, size, aside=random.random() < 0.1)
    pieces = [main]
    if random.random() < 0.15:
        other = category if random.random() < 0.3 else str(random.choice(list(FAMILIES)))
        pieces.insert(int(random.random() < 0.25), _place(other, random, renderer, size, aside=True))

    view = main.view
    # distance of the horizon from the principal point, pixels
    drop = -view.focal * math.tan(math.radians(view.elevation))
    tilt = math.radians(view.tilt)
    horizon = (view.principal[0] + drop * math.sin(tilt), view.principal[1] + drop * math.cos(tilt))
    pixels = background(random, height, width, horizon, tilt)
    hidden: list[NDArray[np.float32]] = []
    for piece in pieces:  # from far to near
        pixels = pixels * (1 - piece.layer.opacity[..., None]) + piece.layer.color
        hidden = [np.maximum(mask, piece.layer.opacity) for mask in hidden]
        hidden.append(np.zeros_like(piece.layer.opacity))
    if random.random() < 0.1:
        left, top, right, bottom = box_of(main.layer)
        center = (random.uniform(left, right), random.uniform(top, bottom))
        mask = blob(random, height, width, center, float(max(right - left, bottom - top)))
        pixels += mask[..., None] * (texture(random, height, width) - pixels)
        hidden = [np.maximum(other, mask) for other in hidden]

    blur = random.uniform(0.5, 3.5) if random.random() < 0.25 else 0.0
    objects = [_annotate(piece, mask, random) for piece, mask in zip(pieces, hidden, strict=True)]
    return Shot(_expose(pixels, blur, random), objects, blur)


class _Piece(NamedTuple):
    """Rendered object of an image.

    Attributes:
        category: Name of the class.
        view: Viewpoint.
        layer: Render of the object.
        inside: Share of the object's bounding box that lies in the image.
    """

    category: str
    view: View
    layer: Layer
    inside: float


def _place(
    category: str, random: Generator, renderer: RenderFunction, size: tuple[int, int], *, aside: bool
) -> _Piece:
    """Return a new object of `category`, rendered at a random position.

    If `aside` is true, the object may extend beyond the image; otherwise the whole object lies in the image.
    """
    mesh = FAMILIES[category].build(random).mesh()
    view = View(*viewpoint(category, random), float(random.uniform(2.2, 6.0)), 1.0, (0.0, 0.0))
    camera = camera_of(view)
    left, top, right, bottom = projected_edges(mesh, camera)
    extent = np.array([right - left, bottom - top])
    longest = random.uniform(56, 100) if random.random() < 0.9 else random.uniform(28, 56)
    room = np.array([size[1], size[0]], dtype=np.float64)
    focal = float(min(longest / extent.max(), ((room - 6) / extent).min()))
    span = focal * extent
    low, high = (
        span / 2 + 2,
        room - 3 - span / 2,
    )  # between these limits of the middle the whole object is visible
    if aside:
        low, high = low - 0.4 * span, high + 0.4 * span
    middle = random.uniform(low, high)
    x, y = (middle - focal * np.array([left + right, top + bottom]) / 2).tolist()
    camera = dataclasses.replace(camera, focal=(focal, focal), principal=(x, y))
    (left, top), (right, bottom) = (middle - span / 2).tolist(), (middle + span / 2).tolist()
    colors = shade_vertices(mesh, random)
    layer = render_object(renderer, mesh, colors, camera, (left, top, right, bottom), size)
    if aside and layer.opacity.max() < 0.5:  # hardly any part of the object lies in the image
        return _place(category, random, renderer, size, aside=False)
    cut = np.minimum(middle + span / 2, room - 0.5) - np.maximum(middle - span / 2, -0.5)
    return _Piece(category, view._replace(focal=focal, principal=(x, y)), layer, float((cut / span).prod()))


def box_of(layer: Layer) -> tuple[int, int, int, int]:
    """Return first column, first row, last column and last row of the pixels that the object clearly covers."""
    covered = layer.opacity >= 0.5 * layer.opacity.max()
    columns, rows = np.flatnonzero(covered.any(0)), np.flatnonzero(covered.any(1))
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])


def _annotate(piece: _Piece, hidden: NDArray[np.float32], random: Generator) -> AnnotatedObject:
    """Return the annotation of an object; `hidden` (height, width) is the opacity of everything in front of it."""
    opacity = piece.layer.opacity
    share = float((opacity * hidden).sum() / opacity.sum())
    left, top, right, bottom = box_of(piece.layer)
    return AnnotatedObject(
        category=piece.category,
        view=piece.view,
        box=(left, top, right, bottom),
        truncated=piece.inside < 0.95,
        occluded=share > 0.1,
        difficult=share > 0.6 or max(right - left, bottom - top) < 36,
        fine=random.random() >= 0.02,
        symmetry=FAMILIES[piece.category].symmetry,
    )


def _expose(pixels: FloatImage, blur: float, random: Generator) -> NDArray[np.uint8]:
    """Return the image with random brightness, blur and sensor noise."""
    gain, offset = random.uniform(0.8, 1.2), random.uniform(-0.05, 0.05)
    image = Image.fromarray((255 * np.clip(gain * pixels + offset, 0, 1)).astype(np.uint8))
    if blur:
        image = image.filter(ImageFilter.GaussianBlur(blur))
    strength = int(random.integers(0, 15))
    noise = random.integers(-strength, strength, pixels.shape, dtype=np.int8, endpoint=True)
    return np.clip(np.asarray(image, dtype=np.int16) + noise, 0, 255).astype(np.uint8)
