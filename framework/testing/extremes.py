"""Extreme scenes for any renderer: the image is right, and no gradient is NaN or infinite."""

import math
from dataclasses import replace

import torch

from framework.geometry.camera import Camera
from framework.renderer import Renderer, Scene
from framework.testing.finding import Worst
from framework.testing.scenes import SIZE

FOCAL = 40.0


def extremes(renderer: Renderer, worst: Worst) -> None:
    """Check extreme scenes for pixels with a wrong depth and for gradients that are not finite."""
    if "depth" not in renderer.channels:
        worst.count(False, "draws no depth")
        return
    for name, (scene, depth, clear) in scenes().items():
        found = renderer(replace(scene, colors=None), ("depth",))["depth"].double()
        right = (found / depth - 1).abs() < 1e-3
        right |= found.isinf() & depth.isinf()
        worst.count(clear & ~right, f"pixels of {name}")
        if "color" in renderer.channels:
            slopes(renderer, scene, name, worst)


def slopes(renderer: Renderer, scene: Scene, name: str, worst: Worst) -> None:
    """Check that the colours of a scene and their gradients in its parameters are finite."""
    seen = scene.camera
    parts = {
        "vertices": scene.vertices,
        "colors": torch.rand(len(scene.vertices), 3).double(),
        "rotation": seen.rotation,
        "translation": seen.translation,
        "focal": torch.tensor(seen.focal, dtype=torch.float64),
        "principal": torch.tensor(seen.principal, dtype=torch.float64),
    }
    parts = {key: part.clone().requires_grad_(key in renderer.differentiable) for key, part in parts.items()}
    lens = {key: parts[key] for key in ("rotation", "translation", "focal", "principal")}
    color = renderer(Scene(parts["vertices"], scene.faces, parts["colors"], replace(seen, **lens)))["color"]
    worst.finite(f"color of {name}", color)
    learned = {key: part for key, part in parts.items() if part.requires_grad}
    if color.requires_grad:
        found = torch.autograd.grad(color.square().sum(), list(learned.values()), allow_unused=True)
        for key, slope in zip(learned, found, strict=True):
            if slope is not None:
                worst.finite(f"slope of {name} in {key}", slope)


def scenes() -> dict[str, tuple[Scene, torch.Tensor, torch.Tensor]]:
    """Return scenes by name, each with its depth in metres and a mask of the pixels in which that is certain.

    The camera is at the origin and looks along z.
    """
    height, width = SIZE
    row, column = torch.meshgrid(
        *[torch.arange(side).double() - (side - 1) / 2 for side in SIZE], indexing="ij"
    )
    everywhere, nothing = torch.ones(SIZE, dtype=torch.bool), torch.full(SIZE, math.inf).double()

    def seen(corners: list[list[float]], focal: float = FOCAL, away: float = 0.0) -> Scene:
        """Return faces of three corners each, visible from both sides.

        Camera and corners are shifted by `away` metres along each axis.
        """
        camera = Camera(torch.eye(3).double(), torch.full((3,), -away).double(), (focal, focal),
                        ((width - 1) / 2, (height - 1) / 2), height, width, focal / 1e6)  # fmt: skip
        faces = torch.arange(len(corners)).reshape(-1, 3)
        return Scene(
            torch.tensor(corners, dtype=torch.float64) + away,
            torch.cat([faces, faces.flip(-1)]),
            None,
            camera,
        )

    triangle = [[-0.5, -0.4], [0.5, -0.4], [0.0, 0.5]]  # corners at depth 1, sideways
    inside = (row / FOCAL > -0.4) & (2 * (column / FOCAL).abs() < 1 - (row / FOCAL + 0.4) / 0.9)
    sure = ((row / FOCAL + 0.4).abs() * FOCAL > 0.1) & (
        (2 * (column / FOCAL).abs() - 1 + (row / FOCAL + 0.4) / 0.9).abs() * FOCAL > 0.4
    )
    found = {
        "a face seen edge-on": (seen([[0.0, 0.0, 1.0], [0.0, 1.0, 2.0], [0.0, -1.0, 2.0]]), nothing, everywhere),
        "slivers without area": (seen([[-1.0, -1.0, 2.0], [0.0, 0.0, 2.0], [1.0, 1.0, 2.0]]), nothing, everywhere),
        "a face with corners 1e30 m away": (
            seen([[-1e30, -1e30, 2.0], [1e30, -1e30, 2.0], [0.0, 1e30, 2.0]]), nothing.new_full(SIZE, 2.0), everywhere,
        ),
    }  # fmt: skip
    for focal in (1e-3, 1.0, 1e3, 1e6):  # same image: the distance grows with the focal length
        far = focal / FOCAL
        shape = [[x, y, 4 * far] for x, y in ((4 * x, 4 * y) for x, y in triangle)]
        found[f"a lens of {focal:g} pixels"] = (seen(shape, focal), nothing.where(~inside, 4 * far), sure)
    for away in (1e3, 1e6):
        shape = [[4e-2 * x, 4e-2 * y, 4e-2] for x, y in triangle]
        found[f"millimetres at {away:g} m"] = (seen(shape, away=away), nothing.where(~inside, 4e-2), sure)
    shape = [
        [depth * x, depth * y, depth] for depth in torch.linspace(9, 4, 2000).tolist() for x, y in triangle
    ]
    found["2,000 faces behind one another"] = (seen(shape), nothing.where(~inside, 4.0), sure)
    return found
