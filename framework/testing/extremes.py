"""Check that a renderer draws extreme scenes correctly, with finite gradients.

Errors are recorded in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

import math
from dataclasses import replace

import torch

from framework.geometry.camera import Camera
from framework.renderer import Renderer, Scene
from framework.testing.finding import Worst
from framework.testing.scenes import SIZE

FOCAL = 40.0
"""Focal length of the camera in most of the scenes, pixels."""


def extremes(renderer: Renderer, worst: Worst) -> None:
    """Check that the depth of extreme scenes is right and that their gradients are finite."""
    if "depth" not in renderer.channels:
        worst.count(False, "the renderer does not draw depth")
        return
    for name, (scene, depth, clear) in scenes().items():
        rendered = renderer(replace(scene, colors=None), ("depth",))["depth"].double()
        right = (rendered / depth - 1).abs() < 1e-3
        right |= rendered.isinf() & depth.isinf()
        worst.count(clear & ~right, f"pixels with a wrong depth: {name}")
        if "color" in renderer.channels:
            check_gradients(renderer, scene, name, worst)


def check_gradients(renderer: Renderer, scene: Scene, name: str, worst: Worst) -> None:
    """Check that the colours of a scene and their gradients in its parameters are finite; `name` names the scene."""
    view = scene.camera
    parts = {
        "vertices": scene.vertices,
        "colors": torch.rand(len(scene.vertices), 3).double(),
        "rotation": view.rotation,
        "translation": view.translation,
        "focal": torch.tensor(view.focal, dtype=torch.float64),
        "principal": torch.tensor(view.principal, dtype=torch.float64),
    }
    parts = {key: part.clone().requires_grad_(key in renderer.differentiable) for key, part in parts.items()}
    lens = {key: parts[key] for key in ("rotation", "translation", "focal", "principal")}
    color = renderer(Scene(parts["vertices"], scene.faces, parts["colors"], replace(view, **lens)))["color"]
    worst.finite(f"color of {name}", color)
    learned = {key: part for key, part in parts.items() if part.requires_grad}
    if color.requires_grad:
        gradients = torch.autograd.grad(color.square().sum(), list(learned.values()), allow_unused=True)
        for key, gradient in zip(learned, gradients, strict=True):
            if gradient is not None:
                worst.finite(f"gradient of {name} in {key}", gradient)


def scenes() -> dict[str, tuple[Scene, torch.Tensor, torch.Tensor]]:
    """Return name → scene, its depth in metres, and a mask of the pixels whose depth is certain.

    The camera looks along z; in most scenes it is at the origin.
    """
    height, width = SIZE
    row, column = torch.meshgrid(
        *[torch.arange(side).double() - (side - 1) / 2 for side in SIZE], indexing="ij"
    )
    everywhere, nothing = torch.ones(SIZE, dtype=torch.bool), torch.full(SIZE, math.inf).double()

    def triangles(corners: list[list[float]], focal: float = FOCAL, away: float = 0.0) -> Scene:
        """Return a scene of triangles, three corners each, that are visible from both sides.

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

    corners_xy = [[-0.5, -0.4], [0.5, -0.4], [0.0, 0.5]]  # x and y of the corners at depth 1
    inside = (row / FOCAL > -0.4) & (2 * (column / FOCAL).abs() < 1 - (row / FOCAL + 0.4) / 0.9)
    sure = ((row / FOCAL + 0.4).abs() * FOCAL > 0.1) & (
        (2 * (column / FOCAL).abs() - 1 + (row / FOCAL + 0.4) / 0.9).abs() * FOCAL > 0.4
    )
    scenes_by_name = {
        "a face seen edge-on": (triangles([[0.0, 0.0, 1.0], [0.0, 1.0, 2.0], [0.0, -1.0, 2.0]]), nothing, everywhere),
        "slivers without area": (triangles([[-1.0, -1.0, 2.0], [0.0, 0.0, 2.0], [1.0, 1.0, 2.0]]), nothing, everywhere),
        "a face with corners 1e30 m away": (
            triangles([[-1e30, -1e30, 2.0], [1e30, -1e30, 2.0], [0.0, 1e30, 2.0]]),
            nothing.new_full(SIZE, 2.0),
            everywhere,
        ),
    }  # fmt: skip
    for focal in (
        1e-3,
        1.0,
        1e3,
        1e6,
    ):  # the image stays the same, since the distance grows with the focal length
        far = focal / FOCAL
        shape = [[x, y, 4 * far] for x, y in ((4 * x, 4 * y) for x, y in corners_xy)]
        scenes_by_name[f"a lens of {focal:g} pixels"] = (
            triangles(shape, focal),
            nothing.where(~inside, 4 * far),
            sure,
        )
    for away in (1e3, 1e6):
        shape = [[4e-2 * x, 4e-2 * y, 4e-2] for x, y in corners_xy]
        scenes_by_name[f"millimetres at {away:g} m"] = (
            triangles(shape, away=away),
            nothing.where(~inside, 4e-2),
            sure,
        )
    shape = [
        [depth * x, depth * y, depth] for depth in torch.linspace(9, 4, 2000).tolist() for x, y in corners_xy
    ]
    scenes_by_name["2,000 faces behind one another"] = (
        triangles(shape),
        nothing.where(~inside, 4.0),
        sure,
    )
    return scenes_by_name
