"""Scenes with which renderers are checked."""

import math
from dataclasses import replace

import torch

from framework.geometry.camera import Camera, look_from
from framework.renderer import Scene
from framework.testing.finding import SEED

SIZE = (48, 64)
"""Height and width of the images, pixels."""


def sphere(rings: int = 24, radius: float = 1.0) -> Scene:
    """Return a sphere about the origin, coloured by position, with a camera at a distance of four metres.

    Args:
        rings: Number of rings of faces from pole to pole.
        radius: Radius, metres.
    """
    theta = torch.linspace(0, math.pi, rings + 1, dtype=torch.float64)
    phi = torch.arange(2 * rings, dtype=torch.float64) * (math.pi / rings)
    grid = torch.stack(
        [
            torch.outer(theta.sin(), phi.cos()),
            torch.outer(theta.sin(), phi.sin()),
            theta.cos()[:, None].expand(-1, 2 * rings),
        ],
        -1,
    )
    row, column = torch.meshgrid(torch.arange(rings), torch.arange(2 * rings), indexing="ij")
    a, b = row * 2 * rings + column, row * 2 * rings + (column + 1) % (2 * rings)
    faces = torch.cat(
        [torch.stack([a, a + 2 * rings, b], -1), torch.stack([b, a + 2 * rings, b + 2 * rings], -1)]
    )
    vertices = (radius * grid.reshape(-1, 3)).float()
    return Scene(vertices, faces.reshape(-1, 3), (vertices / radius + 1) / 2, camera())


def camera() -> Camera:
    """Return the camera of the scenes in this module, four metres from the origin."""
    return look_from(0.3, 0.2, 0.1, distance=4.0, field_of_view=0.7, size=SIZE)


def square(distance: float, side: float = 10.0) -> Scene:
    """Return a square of two triangles that faces the camera.

    Args:
        distance: Distance from the camera, metres.
        side: Length of a side, metres.
    """
    view = camera()
    corners = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]).double() * side / 2
    corners[:, 2] = distance
    world = (corners - view.translation.double()) @ view.rotation.double()
    faces = torch.tensor([[0, 2, 1], [0, 3, 2]])
    return Scene(world.float(), faces, torch.rand(4, 3, generator=torch.Generator().manual_seed(SEED)), view)


def empty(scene: Scene) -> Scene:
    """Return a copy of the scene without faces."""
    return replace(scene, faces=scene.faces[:0])
