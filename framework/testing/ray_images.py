"""Reference images of a few triangles, and test scenes; the ray of every pixel is intersected with every face."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from framework.geometry.camera import Camera, look_from
from framework.renderer import Scene
from framework.testing.finding import SEED

CLEAR = (0.05, 0.15, 0.3, 0.45, 0.6)
"""Distances from a pixel's centre, pixels; a pixel is compared only if the same face is visible at all of them.

The small distances are for triangles thinner than half a pixel.
"""
AROUND = ((1, 0), (-1, 0), (0, 1), (0, -1), (0.7, 0.7), (0.7, -0.7), (-0.7, 0.7), (-0.7, -0.7))
"""Directions from a pixel's centre, (row, column), in which the visible face is determined."""


@dataclass(frozen=True)
class RayImage:
    """Image of a scene, with one entry for each pixel.

    Attributes:
        face: Index of the visible face, (height, width) int64; -1 where no face is visible.
        depth: Depth, (height, width), metres; infinite where no face is visible.
        color: Colour, (height, width, channels); 0 where no face is visible.
        weights: Weight of each vertex's colour in the pixel, (height, width, vertices).
        clear: True if the same face is visible around the pixel's centre, (height, width).
    """

    face: Tensor
    depth: Tensor
    color: Tensor
    weights: Tensor
    clear: Tensor


def cast_image(scene: Scene) -> RayImage:
    """Return the image of a scene in float64, by intersecting rays with faces (Möller & Trumbore 1997).

    Colours are interpolated between the corners with perspective.
    """
    assert scene.colors is not None
    face, depth, weights = _nearest_faces(scene, 0.0, 0.0)
    shares = weights.new_zeros(*face.shape, len(scene.vertices))
    if len(scene.faces):
        shares.scatter_add_(-1, scene.faces.long()[face.clamp(min=0)], weights)
    clear = torch.ones_like(face, dtype=torch.bool)
    for distance in CLEAR:
        for row, column in AROUND:
            around, _, _ = _nearest_faces(scene, distance * row, distance * column)
            clear &= around == face
    return RayImage(face, depth, shares @ scene.colors.double(), shares, clear)


def _nearest_faces(scene: Scene, down: float, across: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return index, depth and corner weights of the nearest face at every pixel.

    The rays pass the image `down` and `across` pixels from the centres of the pixels.
    """
    camera = scene.camera
    row, column = torch.meshgrid(
        torch.arange(camera.height).double() + down,
        torch.arange(camera.width).double() + across,
        indexing="ij",
    )
    focal, principal = (torch.as_tensor(part).double() for part in (camera.focal, camera.principal))
    ray = torch.cat(
        [(torch.stack([column, row], -1) - principal) / focal, torch.ones_like(row)[..., None]], -1
    )
    if not len(scene.faces):
        nothing = torch.full(row.shape, math.inf, dtype=torch.float64)
        return torch.full(row.shape, -1), nothing, torch.zeros_like(ray)
    vertices = scene.vertices.double() @ camera.rotation.double().T + camera.translation.double()
    corners = vertices[scene.faces.long()]
    # with corners (A, B, C) the weights of a ray r are r·(B×C), r·(C×A), r·(A×B), up to division by their sum
    sides = torch.stack(
        [torch.linalg.cross(corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]) for k in range(3)], 1
    )
    parts = torch.einsum("hwi,fki->hwfk", ray, sides)
    total = parts.sum(-1)
    depth = (corners[:, 0] * sides[:, 0]).sum(-1) / total
    hit = ((parts >= 0).all(-1) | (parts <= 0).all(-1)) & (depth >= camera.near) & depth.isfinite()
    nearest, face = depth.where(hit, math.inf).min(-1)
    weights = (parts / total[..., None]).gather(2, face[..., None, None].expand(*face.shape, 1, 3))[:, :, 0]
    none = nearest.isinf()
    return face.where(~none, -1), nearest, weights.where(~none[..., None], 0.0)


def camera(size: tuple[int, int]) -> Camera:
    """Return a camera with oblong pixels and an off-centre principal point, which reveal that two axes are swapped."""
    plain = look_from(-0.5, 0.3, 0.4, distance=4.0, field_of_view=0.8, size=size)
    (across, down), (column, row) = plain.focal, plain.principal
    return replace(
        plain, focal=(1.2 * across, 0.9 * down), principal=(column + 0.11 * size[1], row - 0.07 * size[0])
    )


def crossing(size: tuple[int, int] = (45, 141), count: int = 40, channels: int = 3) -> Scene:
    """Return a scene of large triangles that face the camera and intersect, and of some triangles that are not visible.

    The invisible triangles are behind the camera, outside the image or without area. The vertices are in random order,
    and one of them belongs to no face.

    Args:
        size: Height and width of the image, pixels.
        count: Number of triangles.
        channels: Number of colour channels.
    """
    generator = torch.Generator().manual_seed(SEED)
    view = camera(size)
    depth = 3 + 3 * torch.rand(count, 1, 1, generator=generator, dtype=torch.float64)
    depth = depth * (0.6 + 0.8 * torch.rand(count, 3, 1, generator=generator, dtype=torch.float64))
    sides = torch.tensor([view.width, view.height]).double()
    middle = torch.rand(count, 1, 2, generator=generator, dtype=torch.float64) * sides
    around = torch.randn(count, 3, 2, generator=generator, dtype=torch.float64) * (0.4 * min(size) + 6)
    depth[1:count:5] *= -1
    middle[2:count:5] += 1e4
    around[3:count:5] = 0
    return _scene_of(view, middle + around, depth, channels, generator)


def floor(size: tuple[int, int] = (40, 53)) -> Scene:
    """Return a scene of two triangles that extend from near to far.

    Interpolation between their corners in the image differs much from interpolation in space.
    """
    generator = torch.Generator().manual_seed(SEED)
    pixels = torch.tensor([[[-9, 44.0], [62, 47], [36, 5]], [[-9, 44], [36, 5], [4, 3]]]).double()
    depth = torch.tensor([[[1.1], [1.4], [30.0]], [[1.1], [30.0], [17.0]]]).double()
    return _scene_of(camera(size), pixels, depth, 3, generator)


def _scene_of(
    view: Camera, pixels: Tensor, depth: Tensor, channels: int, generator: torch.Generator
) -> Scene:
    """Return a scene of triangles whose corners project to pixels (face, 3, 2) at depths (face, 3, 1)."""
    focal, principal = (torch.as_tensor(part).double() for part in (view.focal, view.principal))
    corners = torch.cat([(pixels - principal) / focal, torch.ones_like(depth)], -1) * depth
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = (across * corners[:, 0]).sum(-1) > 0
    corners[away] = corners[away].flip(1)
    world = ((corners - view.translation.double()) @ view.rotation.double()).reshape(-1, 3)
    order = torch.randperm(len(world) + 1, generator=generator)
    vertices = torch.zeros(len(order), 3)
    vertices[order[:-1]] = world.float()
    colors = 0.1 + 0.8 * torch.rand(len(order), channels, generator=generator)
    return Scene(vertices, order[:-1].reshape(-1, 3), colors, view)
