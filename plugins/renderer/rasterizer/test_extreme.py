"""Tests of extreme scenes: images are right or raise an error, and gradients at finite inputs are finite."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from framework.geometry.camera import Camera
from framework.renderer import Scene, Texture
from plugins.renderer.rasterizer.drawing import Gradient, Saving
from plugins.renderer.rasterizer.renderer import Rasterizer

EVERY = ("color", "depth", "face", "mask", "normal", "barycentric", "uv")
KINDS = get_args(Gradient)
SAVINGS = get_args(Saving)
TYPES = (torch.float32, torch.float64)


def ahead(height: int = 9, width: int = 11, near: float = 1e-3, focal: float = 8.0) -> Camera:
    """Return a camera at the origin that looks along z."""
    middle = ((width - 1) / 2, (height - 1) / 2)
    return Camera(torch.eye(3), torch.zeros(3), (focal, focal), middle, height, width, near)


def make_scene(corners: np.ndarray | list, camera: Camera, faces: np.ndarray | list | None = None) -> Scene:
    """Return a scene of vertices (n, 3), with different colours and texture coordinates at all vertices.

    Without `faces`, every three vertices are a face.
    """
    vertices = torch.tensor(np.asarray(corners, dtype=np.float64)).reshape(-1, 3)
    faces = np.arange(len(vertices)) if faces is None else faces
    indices = torch.tensor(np.asarray(faces, dtype=np.int64)).reshape(-1, 3)
    random = np.random.default_rng(len(vertices))
    colors = torch.tensor(random.uniform(0, 1, (len(vertices), 3)))
    uv = torch.tensor(random.uniform(-1, 2, (len(vertices), 2)))
    image = torch.tensor(random.uniform(0, 1, (3, 5, 3)))
    return Scene(vertices, indices, colors, camera, Texture((image,), uv, indices, wrap="mirror"))


WALL = [[-9, -9, 3.0], [9, -9, 3], [0, 12, 3]]
"""A face behind everything, over the whole image."""


def slivers() -> np.ndarray:
    """Return triangles in all directions whose width is 1e-12 to 1e-2 of their length."""
    triangles = []
    for turn, width in enumerate(10.0 ** np.arange(-12, -1)):
        along = np.array([math.cos(turn), math.sin(turn), 0.1])
        across = np.array([-math.sin(turn), math.cos(turn), -0.2])
        middle = np.array([0.1 * turn - 0.5, 0.07 * turn - 0.4, 1.5])
        triangles.append([middle - along, middle + along, middle + along / 3 + width * across])
    return np.array(triangles).reshape(-1, 3)


def crossing() -> np.ndarray:
    """Return 60 random vertices of triangles that intersect one another."""
    random = np.random.default_rng(3)
    return random.uniform(-1, 1, (60, 3)) + np.array([0, 0, 2.0])


SCENES: dict[str, Callable[[], Scene]] = {
    "edge-on": lambda: make_scene(
        [[0, 0, 1.0], [0, 1, 2], [0, -1, 2], [-0.3, 0, 1], [0.3, 0, 2], [0.6, 0, 3], *WALL], ahead()
    ),
    "nearly edge-on": lambda: make_scene(
        [[1e-9, -1, 1.0], [1e-7, 1, 1], [-1e-9, 0, 3], [-1, 1e-3, 1], [1, 1e-3, 1], [0, 2e-3, 5], *WALL], ahead()
    ),
    "degenerate": lambda: make_scene(
        [[0, 0, 1.0], [0.5, 0, 1], [0, 0.5, 1]], ahead(), [[0, 0, 1], [1, 1, 1], [0, 1, 2], [0, 1, 0]]
    ),
    "all in one point": lambda: make_scene(np.tile([0.0, 0, 1], (6, 1)), ahead()),
    "slivers": lambda: make_scene([*slivers(), *WALL], ahead()),
    "slivers alone": lambda: make_scene(slivers(), ahead(40, 50)),
    "intersecting": lambda: make_scene([*crossing(), *WALL], ahead()),
    "coplanar": lambda: make_scene([*WALL, *WALL, *np.array(WALL)[::-1], [-1, -1, 3], [1, -1, 3], [0, 1, 3]], ahead()),
    "a vertex on the camera plane": lambda: make_scene([[0, 0.2, 0.0], [-1, 0.3, 2], [1, 0.3, 2], *WALL], ahead()),
    "a vertex at the eye": lambda: make_scene([[0, 0, 0.0], [-1, 0.3, 2], [1, 0.3, 2], *WALL], ahead()),
    "on the near plane": lambda: make_scene([[-1, 0.2, 0.5], [1, 0.3, 0.5], [0, 0.9, 0.5], *WALL], ahead(near=0.5)),
    "through the eye": lambda: make_scene([[-1, -1, -1.0], [1, 1, 1], [1, 0, 1.5], *WALL], ahead()),
    "behind": lambda: make_scene([[-1, -1, -1.0], [1, 1, -1], [1, 0, -1.5]], ahead()),
    "a face over all": lambda: make_scene(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]]) * 1e30 + [0, 0, 2], ahead()),
    "a face over all, far": lambda: make_scene(
        [[-1e30, -1e30, 1e30], [1e30, -1e30, 1e29], [0, 1e30, 2e30], [0, 0, 1], [1e-20, 0, 1], [0, 1e30, 1]], ahead()
    ),
    "up to where float32 ends": lambda: make_scene(np.array(WALL) * [3e37, 2e37, 1e38], ahead()),
    "nearer than float32 goes": lambda: make_scene(np.array(WALL) * 1e-46, ahead(near=1e-90)),
    "very near": lambda: make_scene(np.array(WALL) * 1e-30, ahead(near=1e-35)),
    "floor from under the feet": lambda: make_scene(
        [[-1.0, 0.5, 3e-9], [1.0, 0.5, 3e-9], [0.0, 0.5, 50.0], *WALL], ahead(near=1e-9)
    ),
    "short lens": lambda: make_scene([*crossing(), *WALL], ahead(focal=1e-3)),
    "long lens": lambda: make_scene([*crossing(), *WALL], ahead(focal=1e6)),
    "far from the origin": lambda: make_scene(
        crossing() + 1e6, replace(ahead(), translation=torch.tensor([-1e6] * 3))
    ),
    "many in one pixel": lambda: make_scene(
        crossing()[np.arange(600) % 60] * 1e-2 + np.array([0, 0, 1]), ahead()
    ),
    "one pixel": lambda: make_scene([*crossing(), *WALL], ahead(1, 1)),
    "one row": lambda: make_scene([*crossing(), *WALL], ahead(1, 30)),
    "tiny": lambda: make_scene(crossing() * 1e-4 + [0, 0, 1.0], ahead()),
    "no faces": lambda: make_scene(WALL, ahead(), []),
}  # fmt: skip


def require_gradients(scene: Scene, kind: torch.dtype, textured: bool) -> tuple[Scene, dict[str, Tensor]]:
    """Return the scene in the given number type, and its tensors that require a gradient."""
    original = scene.camera
    parts: dict[str, Tensor] = {
        "vertices": scene.vertices,
        "rotation": original.rotation,
        "translation": original.translation,
        "focal": torch.as_tensor(original.focal, dtype=torch.float64),
        "principal": torch.as_tensor(original.principal, dtype=torch.float64),
    }
    if scene.colors is not None:
        parts["colors"] = scene.colors
    texture = scene.texture if textured else None
    if texture is not None:
        parts |= {"texture": texture.images[0], "uv": texture.uv}
    parts = {name: part.detach().to(kind).clone().requires_grad_() for name, part in parts.items()}
    camera = replace(
        original, **{name: parts[name] for name in ("rotation", "translation", "focal", "principal")}
    )
    if texture is not None:
        texture = replace(texture, images=(parts["texture"],), uv=parts["uv"])
    return Scene(parts["vertices"], scene.faces, parts.get("colors"), camera, texture), parts


def find_bad_gradients(
    scene: Scene, renderer: Rasterizer, kind: torch.dtype, scale: float = 1.0
) -> list[str]:
    """Return names of parameters whose gradient is not finite, and of channels with wrong infinite or NaN values."""
    differentiable, parts = require_gradients(scene, kind, renderer.gradient != "soft")
    channels = renderer(differentiable, ("color", "depth", "mask", "normal", "barycentric", "uv"))
    bad = [name for name in ("color", "normal", "barycentric", "uv") if not channels[name].isfinite().all()]
    bad += ["depth"] * (not torch.equal(channels["depth"].isfinite(), channels["mask"]))
    weight = torch.linspace(-1, 2, channels["color"].numel()).reshape(channels["color"].shape)
    depth = channels["depth"].masked_select(channels["mask"])
    loss = scale * (
        (channels["color"] * weight).sum() + (depth.clamp(max=1e20).sum() if depth.numel() else 0)
    )
    slopes = torch.autograd.grad(loss, list(parts.values()), allow_unused=True)
    return bad + [
        name
        for name, slope in zip(parts, slopes, strict=True)
        if slope is not None and not slope.isfinite().all()
    ]


@pytest.mark.parametrize(
    "name, gradient",
    [
        pytest.param(name, kind, marks=() if place % 5 == number else pytest.mark.slow)
        for place, name in enumerate(SCENES)
        for number, kind in enumerate(KINDS)
    ],
)
def test_no_gradient_is_NaN_or_infinite(name: str, gradient: Gradient) -> None:
    for kind, supersampling in itertools.product(TYPES, (1, 2)):
        bad = find_bad_gradients(
            SCENES[name](), Rasterizer(gradient=gradient, supersampling=supersampling), kind
        )
        assert not bad, (kind, supersampling)


def random_scene(seed: int) -> Scene:
    """Return a scene with coordinates of any magnitude that float32 holds, mostly in front of a camera with any lens.

    In some scenes, all coordinates lie on a grid with edges through the camera's centre and through pixel centres.
    """
    random = np.random.default_rng(seed)
    count, size = int(random.integers(3, 12)), random.choice([1e-25, 1e-3, 1.0, 1e3, 1e25])
    spread = random.choice([0.0, 1.0, 5.0, 36.0])
    sizes = np.clip(size * 10.0 ** random.uniform(-spread, spread, (count, 3)), 1e-38, 1e37)
    vertices = sizes * random.choice([-1.0, 1.0], (count, 3)) * (random.random((count, 3)) < 0.9)
    before = random.random(count) < random.choice([0.6, 1.0])
    vertices[before, 2] = np.abs(vertices[before, 2])
    if random.random() < 0.5:  # sideways distances of the same magnitude as depths
        vertices[:, :2] *= np.abs(vertices[:, 2:]) / sizes[:, :2]
    if random.random() < 0.3:
        vertices = np.concatenate(
            [random.integers(-4, 5, (count, 2)) / 4, random.choice([-1, 0, 0.25, 1, 1, 2], (count, 1))], 1
        )
    faces = random.integers(0, count, (random.integers(1, 12), 3))
    near, focal = random.choice([1e-37, 1e-20, 1e-3, 1.0]), random.choice([1e-3, 0.3, 8.0, 1e3, 1e6])
    camera = ahead(*(int(side) for side in random.integers(1, 13, 2)), float(near), float(focal))
    away = torch.tensor([0.0, 0, random.choice([0.0, 2.0])])
    return make_scene(vertices, replace(camera, translation=away.float()), faces)


@settings(deadline=None, max_examples=150, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from(KINDS), st.sampled_from([1.0, 1e-30, 1e20]))
def test_random_scenes_have_finite_images_and_gradients(seed: int, gradient: Gradient, scale: float) -> None:
    for kind in TYPES:
        assert not find_bad_gradients(random_scene(seed), Rasterizer(gradient=gradient), kind, scale), kind


@pytest.mark.parametrize(
    "quarter, gradient",
    [
        pytest.param(quarter, kind, marks=() if quarter == number else pytest.mark.slow)
        for quarter in range(4)
        for number, kind in enumerate(KINDS)
    ],
)
def test_a_face_whose_corners_are_1e30_away_fills_the_image(quarter: int, gradient: Gradient) -> None:
    """Check also faces with two corners so far below or right of the image that no integer holds their row."""
    turn = np.linalg.matrix_power(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), quarter)
    corners = np.array([[-1, -1, 0], [1, -1.5, 0], [0, 1, 0]]) * 1e30 @ turn.T + [0, 0, 2]
    for faces in ([0, 1, 2], [0, 2, 1]):
        scene = make_scene(corners, ahead(), faces)
        channels = Rasterizer(gradient=gradient)(replace(scene, texture=None), EVERY)
        assert channels["mask"].all() and (channels["depth"] == 2).all() and (channels["face"] == 0).all()
        for kind in TYPES:
            assert not find_bad_gradients(scene, Rasterizer(gradient=gradient), kind)
