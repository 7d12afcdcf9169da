"""Tests of the reader, the generator and the object families."""

import dataclasses
import json
import math
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import torch
import trimesh
from PIL import Image

from framework import images, schema
from framework.errors import ConfigError, DataError
from framework.renderer import Renderer, Scene
from plugins.pascal3d import generator, layout, shapes
from plugins.pascal3d.data import Pascal3D, validation_files
from plugins.pascal3d.families import FAMILIES
from plugins.pascal3d.layout import CLASSES, VOC_LISTS
from plugins.pascal3d.scene import View, box_of, camera_of, draw, outline, shoot, window
from plugins.pascal3d.shapes import Mesh
from plugins.pascal3d.viewpoints import LEVELS, QUANTILES, viewpoint

IMAGES = 80


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return schema.build("renderer", schema.resolve("renderer", "zbuffer"))


@pytest.fixture(scope="session")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def cached(cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache that the tests share, so that each class is drawn once."""
    monkeypatch.setenv("FRAMEWORK_CACHE", str(cache_folder))
    return cache_folder


def prepared(**config: Any) -> Pascal3D:
    data = Pascal3D(**{"images": IMAGES, **config})
    data.prepare()
    return data


# ---- shapes and families ------------------------------------------------------------------------------------


def closed(solid: shapes.Solid) -> trimesh.Trimesh:
    """The solid as an outward mesh with its shading seams welded."""
    body = shapes.Body()
    body.add(solid, (1.0, 1.0, 1.0))
    faces = body.mesh().faces  # outward
    return trimesh.Trimesh(solid.vertices, faces, process=True, merge_norm=True, merge_tex=True)


SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
POLYGON_24 = 24 / 2 * math.sin(2 * math.pi / 24)  # area of the polygon that stands for a unit circle
SOLIDS = {
    "box": (shapes.box((1, 2, 3), (4, 5, 6)), 6.0, (4, 5, 6)),
    "mirrored box": (
        shapes.transformed(shapes.box((1, 2, 3), (4, 5, 6)), scale=(-1, 1, 1)),
        6.0,
        (-4, 5, 6),
    ),
    "lathe": (shapes.lathe([(2, 0), (2, 3)], 24), 12 * POLYGON_24, (0, 0, 1.5)),
    "cone": (shapes.lathe([(3, 0), (0, 3)], 24), 9 * POLYGON_24, (0, 0, 0.75)),
    "rod along x": (shapes.rod((0, 0, 0), (5, 0, 0), 1.0, sides=24), 5 * POLYGON_24, (2.5, 0, 0)),
    "rod askew": (shapes.rod((1, 1, 1), (1, 4, 5), 2.0, sides=24), 20 * POLYGON_24, (1, 2.5, 3)),
    "wheel": (shapes.wheel((1, 2, 3), 1.0, 0.5, 24), 0.5 * POLYGON_24, (1, 2, 3)),
    "side plate": (shapes.side_plate(SQUARE, 3.0, 0.5), 1.0, (3, 1, 0.5)),
    "tapered": (
        shapes.tapered([(1, -1, 1, 0), (0.5, -0.5, 0.5, 3)]),
        3 / 3 * (4 + 1 + math.sqrt(4)),
        (0, 0, 33 / 28),  # h/4 (A + 2√(AB) + 3B) / (A + √(AB) + B)
    ),
    "rounded": (
        shapes.loft([shapes.rounded(4, 0, 2, y, 0.5) for y in (0, 3)]),
        3 * (8 - 4 * 0.5**2 / 2),
        (0, 1.5, 1),
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_is_closed_and_has_its_volume_and_place(name: str) -> None:
    solid, volume, center = SOLIDS[name]
    mesh = closed(solid)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume)
    np.testing.assert_allclose(mesh.center_mass, center, atol=1e-9)


def test_round_solids_approach_their_ideals() -> None:
    torus = closed(shapes.ring((1, 2, 3), 2.0, 1.0, sides=96, around=48))
    ellipsoid = closed(shapes.ellipsoid((1, 2, 3), (1, 2, 3), sides=96, layers=49))
    assert torus.is_watertight
    assert torus.volume == pytest.approx(2 * math.pi**2 * 2 * 0.5**2, rel=0.01)
    assert np.ptp(torus.vertices, axis=0) == pytest.approx([1, 5, 5], rel=0.01)  # it turns about x
    assert ellipsoid.volume == pytest.approx(4 / 3 * math.pi * 6, rel=0.01)


def test_families_are_the_classes_of_the_release() -> None:
    assert tuple(FAMILIES) == CLASSES == tuple(QUANTILES)


@pytest.mark.parametrize("category", CLASSES)
def test_family_is_a_unit_object_with_outward_normals(category: str) -> None:
    for seed in range(8):
        mesh = FAMILIES[category].build(np.random.default_rng(seed)).mesh()
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        assert np.linalg.norm(high - low) == pytest.approx(1)
        np.testing.assert_allclose(low + high, 0, atol=1e-12)
        assert mesh.colors.min() >= 0
        assert mesh.colors.max() <= 1
        corners = mesh.vertices[mesh.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.einsum("fi,fi->", across, corners[:, 0]) > 0  # six times the volume
        lengths = np.linalg.norm(mesh.normals, axis=1)
        assert np.all((lengths < 1e-9) | (abs(lengths - 1) < 1e-9))


def seen(renderer: Renderer, mesh: Mesh, azimuth: float, elevation: float, tilt: float) -> np.ndarray:
    """The object's unlit colours, 96 × 96."""
    view = View(azimuth, elevation, tilt, 3.0, 230.0, (47.5, 47.5))
    camera = camera_of(view)
    layer = draw(renderer, mesh, mesh.colors, camera, outline(mesh, camera), (96, 96))
    return np.concatenate([layer.color, layer.cover[..., None]], axis=2)


@pytest.mark.parametrize("category", CLASSES)
def test_symmetry_is_what_the_family_says(category: str, renderer: Renderer) -> None:
    turns = {0: (37.0, 90.0, 180.0), 1: (), 2: (180.0,), 4: (90.0, 180.0)}[FAMILIES[category].symmetry]
    for seed in range(4):
        mesh = FAMILIES[category].build(np.random.default_rng(seed)).mesh()
        here = seen(renderer, mesh, 25.0, 15.0, 5.0)
        for turn in (37.0, 90.0, 180.0):
            changed = abs(here - seen(renderer, mesh, 25.0 + turn, 15.0, 5.0)).mean()
            # silhouettes of a polygon that stands for a circle differ in single pixels
            assert (changed < 0.002) if turn in turns else (changed > 0.004), (seed, turn, changed)


@pytest.mark.parametrize("category", [name for name in CLASSES if name != "aeroplane"])
def test_mirrored_picture_is_the_picture_at_the_mirrored_angles(category: str, renderer: Renderer) -> None:
    """The rule that `augment` uses; an aeroplane's propeller is the one part that is not mirror-symmetric."""
    mesh = FAMILIES[category].build(np.random.default_rng(3)).mesh()
    picture = seen(renderer, mesh, 35.0, 20.0, 12.0)[:, ::-1]
    assert abs(picture - seen(renderer, mesh, -35.0, 20.0, -12.0)).mean() < 0.002
    assert abs(picture - seen(renderer, mesh, -35.0, 20.0, 12.0)).mean() > 0.01
    assert abs(picture - seen(renderer, mesh, -35.0, -20.0, -12.0)).mean() > 0.01


# ---- the convention of angles ----------------------------------------------------------------------------------


def projected_as_in_the_toolbox(points: np.ndarray, viewpoint: dict[str, float]) -> np.ndarray:
    """Pixels counted from 1, by the steps of `project_3d.m` of the PASCAL3D+ toolbox (release 1.1)."""
    a, e, t = (math.radians(viewpoint[name]) for name in ("azimuth", "elevation", "theta"))
    d, f = viewpoint["distance"], viewpoint["focal"] * viewpoint["viewport"]
    center = np.array([d * math.cos(e) * math.sin(a), -d * math.cos(e) * math.cos(a), d * math.sin(e)])
    a, e = -a, -(math.pi / 2 - e)
    about_z = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, math.cos(e), -math.sin(e)], [0, math.sin(e), math.cos(e)]])
    x, y, z = about_x @ about_z @ (points - center).T
    flat = np.stack([f * x / -z, f * y / -z])
    flat = np.array([[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]]) @ flat
    return np.stack([flat[0] + viewpoint["px"], viewpoint["py"] - flat[1]], axis=1)


def test_annotated_viewpoint_projects_the_object_onto_its_box(renderer: Renderer) -> None:
    """The official fields, read with the official formula, say where the object is in the picture."""
    category = "car"
    for seed in range(6):
        shot = shoot(category, np.random.default_rng(seed), renderer)
        thing = next(thing for thing in shot.things if thing.category == category)
        fields = generator._viewpoint(dataclasses_replace(thing, fine=True))
        mesh = drawn_mesh(category, seed, renderer)
        pixels = projected_as_in_the_toolbox(mesh.vertices, fields)
        height, width, _ = shot.pixels.shape
        low = np.maximum(pixels.min(0), 1)
        high = np.minimum(pixels.max(0), (width, height))
        left, top, right, bottom = (edge + 1 for edge in thing.box)
        np.testing.assert_allclose([*low, *high], [left, top, right, bottom], atol=1.6)


def dataclasses_replace(thing: Any, **changes: Any) -> Any:
    return thing._replace(**changes)


def drawn_mesh(category: str, seed: int, renderer: Renderer) -> Mesh:
    """The first object that `shoot` builds from this seed."""
    built: list[Mesh] = []
    original = FAMILIES[category]

    class Kept(Exception):
        pass

    def stop(scene: Scene, channels: Any = ()) -> dict[str, torch.Tensor]:
        built.append(Mesh(scene.vertices.double().numpy(), *[np.empty(0)] * 3))
        raise Kept

    assert original is FAMILIES[category]
    with pytest.raises(Kept):
        shoot(category, np.random.default_rng(seed), stop)
    return built[0]
