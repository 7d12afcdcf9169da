"""Images of the rasteriser, compared with those of an independent renderer that casts rays in float64."""

import importlib.util
import math
from collections.abc import Callable, Collection
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import torch
from torch import Tensor

from framework.configuration.schema import build, resolve
from framework.geometry.camera import Camera, look_from
from framework.renderer import Renderer, Scene, Texture, join_scenes
from framework.testing.extremes import extremes
from framework.testing.finding import run_check
from framework.testing.scenes import sphere
from tests.conftest import STRANGER

SIZE = (120, 160)
WITHIN = 1 / 128  # pixels; the rasteriser moves corners by up to 1/512 pixel along either axis


@pytest.fixture(scope="module")
def stranger() -> ModuleType:
    found = importlib.util.spec_from_file_location(
        "ray_caster", STRANGER / "stranger_package" / "renderer.py"
    )
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def seen(azimuth: float = 0.4, distance: float = 5.0) -> Camera:
    return look_from(azimuth, 0.3, 0.2, distance, 0.8, SIZE)


def papered(scene: Scene, wrap: str, smooth: bool) -> Scene:
    random = np.random.default_rng(1)
    images = tuple(
        torch.tensor(random.uniform(0, 1, (*size, 3)), dtype=torch.float32) for size in ((4, 6), (7, 5))
    )
    uv = 1.3 * scene.vertices[:, :2] + 0.4 * scene.vertices[:, 2:] - 0.3
    shown = torch.arange(len(scene.faces)) % 3 - 1
    return replace(scene, texture=Texture(images, uv, scene.faces, shown, wrap, smooth))  # type: ignore[arg-type]


def crowd(camera: Camera, count: int, wrap: str = "repeat", smooth: bool = True) -> Scene:
    """Return a scene of bodies with and without textures, which overlap and hide each other."""
    random = np.random.default_rng(count)
    subjects = []
    for number in range(count):
        body = sphere(rings=14)
        stretch = torch.tensor(random.uniform(0.4, 1.3, 3)).float()
        place = torch.tensor(random.uniform(-1, 1, 3) * 0.4 * math.log(count)).float()
        body = replace(body, vertices=body.vertices * stretch + place, camera=camera)
        subjects.append(papered(body, wrap, smooth) if number % 2 == 0 else body)
    return join_scenes(subjects)


def soup(camera: Camera, count: int, length: float, width: float, away: tuple[float, float]) -> Scene:
    """Return a scene of random triangles of this length and width before the camera, in camera coordinates."""
    random = np.random.default_rng(count)
    middle = random.uniform([-1, -1, away[0]], [1, 1, away[1]], (count, 3))
    along, across = (random.normal(0, 1, (count, 3)) for _ in range(2))
    along *= length / np.linalg.norm(along, axis=1, keepdims=True)
    across *= width / np.linalg.norm(across, axis=1, keepdims=True)
    corners = np.stack([middle - along, middle + along, middle + across], 1).reshape(-1, 3)
    colors = torch.tensor(random.uniform(0, 1, (3 * count, 3))).float()
    here = replace(camera, rotation=torch.eye(3), translation=torch.zeros(3))
    return Scene(torch.tensor(corners).float(), torch.arange(3 * count).reshape(-1, 3), colors, here)


SCENES: dict[str, Callable[[], Scene]] = {
    "one body": lambda: crowd(seen(), 1),
    "two bodies": lambda: crowd(seen(1.1), 2, "mirror"),
    "three bodies": lambda: crowd(seen(2.5), 3, "clamp"),
    "a dozen bodies": lambda: crowd(seen(3.9, 7.0), 12),
    "nearest texel": lambda: crowd(seen(0.7), 3, "repeat", smooth=False),
    "nearest texel, mirrored": lambda: crowd(seen(0.7), 1, "mirror", smooth=False),
    "a camera within the crowd": lambda: crowd(replace(seen(1.0, 0.2), near=0.05), 5),
    "a soup": lambda: soup(seen(), 200, 0.5, 0.4, (0.8, 4.0)),
    "a soup that the near plane cuts": lambda: soup(replace(seen(), near=0.3), 60, 0.5, 0.4, (-0.5, 2.0)),
}
SLIVERS: dict[str, Callable[[], Scene]] = {
    "slivers": lambda: soup(seen(), 150, 1.0, 0.01, (1.0, 4.0)),
    "slivers that the near plane cuts": lambda: soup(replace(seen(), near=0.3), 150, 1.0, 0.02, (-0.5, 2.0)),
}
"""Scenes in which most pixels lie close to an edge."""


def ends(corners: Tensor, near: float) -> Tensor:
    """Return the visible edges of faces, (faces, 3, 3), in camera coordinates, as segments, (number, 2, 3).

    These are the parts of the edges at `near` or beyond, and the cuts of the near plane through faces.
    """
    edges = torch.stack([corners, corners.roll(-1, 1)], 2)  # (faces, 3, 2, 3)
    depth = edges[..., 2]
    share = ((near - depth[..., 0]) / (depth[..., 1] - depth[..., 0]))[..., None]
    cut = edges[..., 0, :] + share * (edges[..., 1, :] - edges[..., 0, :])
    crossed = (depth >= near).sum(-1) == 1
    shown = torch.where((depth >= near)[..., None], edges, cut[..., None, :])[(depth >= near).any(-1)]
    of_faces = crossed.sum(-1) == 2
    return torch.cat([shown, cut[of_faces][crossed[of_faces]].reshape(-1, 2, 3)])


def to_the_nearest_edge(corners: Tensor, camera: Camera, pixels: Tensor) -> Tensor:
    """Return the distance of each pixel, (pixels, 2), from the nearest projected edge of a face, in pixels."""
    focal, principal = (torch.tensor(part).double() for part in (camera.focal, camera.principal))
    found = ends(corners, camera.near)
    place = focal * found[..., :2] / found[..., 2:] + principal
    start, along = place[:, 0], place[:, 1] - place[:, 0]
    way = pixels[:, None] - start
    part = (way * along).sum(-1) / along.square().sum(-1).clamp(min=1e-30)
    return (way - part.clamp(0, 1)[..., None] * along).norm(dim=-1).amin(1)


def apart(corners: Tensor, faces: tuple[Tensor, Tensor], camera: Camera, pixels: Tensor) -> Tensor:
    """Return by how many pixels two faces would have to be shifted to have equal depth at the pixel; inf without two
    faces."""
    focal, principal = (torch.tensor(part).double() for part in (camera.focal, camera.principal))
    ray = torch.cat([(pixels - principal) / focal, torch.ones(len(pixels), 1).double()], -1)
    inverse, slope = [], []
    for face in faces:  # 1 / depth = r·n / a·n
        a, b, c = corners[face.clamp(min=0)].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        normal = normal / (a * normal).sum(-1, keepdim=True)
        inverse.append((ray * normal).sum(-1))
        slope.append((normal[:, :2] / focal).norm(dim=-1))
    off = ((inverse[0] - inverse[1]).abs() - 2.0**-22 * inverse[0]).clamp(min=0) / (slope[0] + slope[1])
    return off.where((faces[0] >= 0) & (faces[1] >= 0), torch.inf)


def shown_around(renderer: Renderer, scene: Scene, row: int, column: int) -> Tensor:
    """Return the colours at WITHIN from a pixel's centre in 16 directions, and at the centre: (17, channels)."""
    camera = scene.camera
    x, y = (float(part) - at for part, at in zip(camera.principal, (column, row), strict=True))
    found = []
    for step in range(17):
        angle, far = step * math.tau / 16, WITHIN * (step < 16)
        principal = (x - far * math.cos(angle), y - far * math.sin(angle))
        there = replace(scene, camera=replace(camera, height=1, width=1, principal=principal))
        found.append(renderer(there, ("color",))["color"][0, 0])
    return torch.stack(found)


def compared(scene: Scene, caster: Renderer) -> tuple[int, list[str]]:
    """Return the number of pixels that differ by more than 1/255, and those not explained by edges, ties or steep
    colours."""
    channels = ("color", "face", "normal")
    found = build("renderer", resolve("renderer", {"name": "rasterizer"}))(scene, channels)
    wanted = caster(scene, channels)
    same = found["face"] == wanted["face"]
    assert (found["normal"] - wanted["normal"])[same].abs().max() < 1e-6
    different = (found["color"] - wanted["color"]).abs().amax(-1) > 1 / 255
    rows, columns = different.nonzero(as_tuple=True)
    camera = scene.camera
    corners = (scene.vertices.double() @ camera.rotation.double().T + camera.translation.double())[
        scene.faces
    ]
    pixels = torch.stack([columns, rows], -1).double()
    faces = (found["face"][different].long(), wanted["face"][different].long())
    alone = to_the_nearest_edge(corners, camera, pixels) > WITHIN
    alone &= (faces[0] == faces[1]) | (apart(corners, faces, camera, pixels) > WITHIN)
    unexplained = []
    for row, column in zip(rows[alone].tolist(), columns[alone].tolist(), strict=True):
        near = shown_around(caster, scene, row, column)
        got = found["color"][row, column]
        if not ((got >= near.amin(0) - 1 / 255) & (got <= near.amax(0) + 1 / 255)).all():
            unexplained.append(
                f"row {row}, column {column}: {got.tolist()}, wanted {wanted['color'][row, column]}"
            )
    return int(different.sum()), unexplained


def test_pictures_are_those_of_rays_but_for_edges(stranger: ModuleType) -> None:
    """Rasterised and ray-cast images agree to 1/255 on 99.99 % of the pixels.

    Each other pixel lies within 1/128 pixel of an edge, of an intersection of two surfaces, or of a place on the same
    surface that has the rasterised colour.
    """
    caster = stranger.RayCaster()
    different = 0
    for name, make in SCENES.items():
        number, unexplained = compared(make(), caster)
        assert not unexplained, (name, unexplained)
        different += number
    assert different <= 1e-4 * len(SCENES) * math.prod(SIZE)


@pytest.mark.parametrize("name", SLIVERS)
def test_of_slivers_too_only_edges_differ(name: str, stranger: ModuleType) -> None:
    number, unexplained = compared(SLIVERS[name](), stranger.RayCaster())
    assert not unexplained and number < 0.01 * math.prod(SIZE)


class Faulty(Renderer):
    """Rasteriser whose inputs and outputs are changed by two functions."""

    bibtex = ""
    channels = frozenset(("color", "depth"))
    differentiable = frozenset(("vertices", "colors"))

    def __init__(self, before: Callable[[Tensor], Tensor], after: Callable[[Tensor], Tensor]) -> None:
        self.before, self.after = before, after
        self.inner = build("renderer", resolve("renderer", {"name": "rasterizer"}))

    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        drawn = self.inner(replace(scene, vertices=self.before(scene.vertices)), channels)
        return {name: self.after(picture) if name == "color" else picture for name, picture in drawn.items()}


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        (lambda vertices: vertices, lambda color: color, None),
        (lambda vertices: vertices.float(), lambda color: color, "millimetres at"),
        pytest.param(
            lambda vertices: vertices.where(vertices.abs() < 1e20, math.nan),
            lambda color: color,
            "1e30 m away",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda vertices: vertices,
            lambda color: color.square().sqrt(),
            "gradient of",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda vertices: vertices,
            lambda color: color / color.sum(),
            "color of",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_contract_finds_what_extreme_scenes_break(
    before: Callable[[Tensor], Tensor], after: Callable[[Tensor], Tensor], told: str | None
) -> None:
    finding = run_check("extreme scenes", 0.0, lambda worst: extremes(Faulty(before, after), worst))
    assert finding.holds == (told is None), finding
    assert told is None or told in finding.worst
