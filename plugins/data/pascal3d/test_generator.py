"""Tests of the object families, the convention of angles, and the generator."""

import json
import math
import os
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from framework.configuration import schema
from framework.errors import ConfigError, DataError
from framework.renderer import Renderer, Scene
from framework.storage import generated
from plugins.data.pascal3d import generator, shapes
from plugins.data.pascal3d.families import FAMILIES
from plugins.data.pascal3d.layout import CLASSES
from plugins.data.pascal3d.scene import Shot, Thing, View, camera_of, draw, outline, shoot, window
from plugins.data.pascal3d.shapes import Mesh
from plugins.data.pascal3d.viewpoints import LEVELS, QUANTILES, viewpoint


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return schema.build("renderer", schema.resolve("renderer", "rasterizer"))


# ---- shapes and families ---------------------------------------------------------------------------------


def closed(solid: shapes.Solid) -> trimesh.Trimesh:
    """Return the solid as an outward mesh with its shading seams welded."""
    body = shapes.Body()
    body.add(solid, (1.0, 1.0, 1.0))
    faces = body.mesh().faces  # outward
    mesh = trimesh.Trimesh(solid.vertices, faces, process=True, merge_norm=True, merge_tex=True)
    mesh.update_faces(mesh.nondegenerate_faces())  # at the tip of a cone
    return mesh


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
    """Return the object's unlit colours, 96 × 96."""
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
    """Check the rule that `augment` uses; only an aeroplane's propeller is not mirror-symmetric."""
    mesh = FAMILIES[category].build(np.random.default_rng(3)).mesh()
    picture = seen(renderer, mesh, 35.0, 20.0, 12.0)[:, ::-1]
    assert abs(picture - seen(renderer, mesh, -35.0, 20.0, -12.0)).mean() < 0.002
    assert abs(picture - seen(renderer, mesh, -35.0, 20.0, 12.0)).mean() > 0.01
    assert abs(picture - seen(renderer, mesh, -35.0, -20.0, -12.0)).mean() > 0.01


# ---- the convention of angles ----------------------------------------------------------------------------


def projected_as_in_the_toolbox(points: np.ndarray, viewpoint: dict[str, float]) -> np.ndarray:
    """Return pixels counted from 1, by the steps of `project_3d.m` of the PASCAL3D+ toolbox (release 1.1)."""
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


def first_mesh(category: str, seed: int) -> Mesh:
    """Return the first object that `shoot` passes to the renderer."""

    class Kept(Exception):
        pass

    handed: list[np.ndarray] = []

    def keep(scene: Scene, channels: Collection[str]) -> Mapping[str, torch.Tensor]:
        handed.append(scene.vertices.double().numpy())
        raise Kept

    with pytest.raises(Kept):
        shoot(category, np.random.default_rng(seed), keep)
    return Mesh(handed[0], np.empty((0, 3), dtype=np.int64), np.empty((0, 3)), np.empty((0, 3)))


@pytest.mark.parametrize("category", ["car", "aeroplane", "bottle"])
def test_annotated_viewpoint_projects_the_object_onto_its_box(category: str, renderer: Renderer) -> None:
    """Check that the official formula on the official fields gives the place of the object in the image."""
    for seed in range(6):
        shot = shoot(category, np.random.default_rng(seed), renderer)
        mesh = first_mesh(category, seed)
        boxes = []
        for thing in shot.things:
            fields = generator._viewpoint(thing._replace(fine=True))
            pixels = projected_as_in_the_toolbox(mesh.vertices, fields)
            height, width, _ = shot.pixels.shape
            low, high = np.maximum(pixels.min(0), 1), np.minimum(pixels.max(0), (width, height))
            boxes.append(abs(np.array([*low, *high]) - [edge + 1 for edge in thing.box]).max())
        assert min(boxes) < 1.7, (
            seed,
            boxes,
        )  # pixels; thin tips that cover less than half a pixel do not count


@pytest.mark.parametrize(
    ("azimuth", "nearest", "to_the_left"),
    [
        (0.0, "front", "right side"),
        (180.0, "rear", "left side"),
        (90.0, "left side", "front"),
        (270.0, "right side", "rear"),
    ],
)
def test_azimuth_names_the_side_that_is_seen(azimuth: float, nearest: str, to_the_left: str) -> None:
    """Check the axes: the front is -y, up is z, so the object's left is x; at 90° it is seen from its left and faces
    left.
    """
    points = {"front": (0, -1, 0), "rear": (0, 1, 0), "left side": (1, 0, 0), "right side": (-1, 0, 0)}
    camera = camera_of(View(azimuth, 0.0, 0.0, 3.0, 100.0, (0.0, 0.0)))
    seen_at = {name: camera.rotation.double() @ torch.tensor(p).double() for name, p in points.items()}
    assert min(seen_at, key=lambda name: float(seen_at[name][2])) == nearest
    assert min(seen_at, key=lambda name: float(seen_at[name][0])) == to_the_left


def test_elevation_lifts_the_camera_and_tilt_turns_the_picture_counter_clockwise() -> None:
    above = camera_of(View(0.0, 30.0, 0.0, 3.0, 100.0, (0.0, 0.0))).rotation.double()
    assert (above @ torch.tensor([0.0, 0.0, 1.0]).double())[2] < 0  # the top is nearer than the middle
    tilted = camera_of(View(0.0, 0.0, 20.0, 3.0, 100.0, (0.0, 0.0))).rotation.double()
    x, y, _ = tilted @ torch.tensor([0.0, 0.0, 1.0]).double()  # x right, y down
    assert math.degrees(math.atan2(-x, -y)) == pytest.approx(20.0)


def test_a_window_shows_the_same_picture() -> None:
    """Check that whole pixels, drawn fine and averaged, lie where the camera sees them."""
    camera = camera_of(View(10.0, 20.0, 5.0, 3.0, 80.0, (31.5, 20.25)))
    part = window(camera, (7, 11), (30, 40), 2)
    assert (part.height, part.width) == (60, 80)
    point = camera.rotation.double() @ torch.tensor([0.1, -0.2, 0.3]).double() + camera.translation.double()
    for axis in (0, 1):
        whole = camera.focal[axis] * point[axis] / point[2] + camera.principal[axis]
        fine = part.focal[axis] * point[axis] / point[2] + part.principal[axis]
        # the fine pixels 2i and 2i + 1 make up pixel i, whose centre lies between theirs
        assert float(fine) == pytest.approx(2 * (float(whole) - (7, 11)[axis]) + 0.5, abs=1e-4)


def test_viewpoints_follow_the_measured_quantiles() -> None:
    random = np.random.default_rng(0)
    for category in CLASSES:
        drawn = np.array([viewpoint(category, random) for _ in range(2000)])
        assert np.all((drawn[:, 0] >= 0) & (drawn[:, 0] < 360))
        assert abs(np.exp(1j * np.deg2rad(drawn[:, 0])).mean()) < 0.08
        for column, levels in zip((1, 2), QUANTILES[category], strict=True):
            middle = np.quantile(drawn[:, column], LEVELS[3:-3])
            np.testing.assert_allclose(middle, levels[3:-3], atol=0.2 * np.ptp(levels) ** 0.5 + 2)


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_viewpoints_are_distributed_as_in_the_real_lists() -> None:
    folder = Path(os.environ["REAL_DATA_ROOT"]) / "viewpoint_lists" / "voc12val_easy_gt_bbox"
    random = np.random.default_rng(1)
    objects = 0
    for category in CLASSES:
        lines = (folder / f"{category}.txt").read_text(encoding="utf-8").splitlines()
        real = (np.array([line.split()[3:5] for line in lines], dtype=float) + 180) % 360 - 180
        objects += len(real)
        drawn = np.array([viewpoint(category, random)[1:] for _ in range(4000)])
        for column in (0, 1):
            levels = np.arange(-90, 91)  # the lists hold whole degrees
            below = [(np.round(angles[:, column])[:, None] <= levels).mean(0) for angles in (real, drawn)]
            assert abs(below[0] - below[1]).max() < 0.1, category
            assert abs(real[:, column].mean() - drawn[:, column].mean()) < 2, category
    assert objects == 2108


# ---- the generator ---------------------------------------------------------------------------------------


def files_of(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()
    }


def test_generation_is_the_same_to_the_byte_whatever_the_threads(
    tmp_path: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    roots = []
    for painters in (1, 3):
        monkeypatch.setattr(generated, "PAINTERS", painters)
        roots.append(generator.generated(tmp_path / str(painters), "boat", 24, 5, renderer))
    first, second = map(files_of, roots)
    assert len(first) == 2 * 24 + 5
    assert first == second
    other = files_of(generator.generated(tmp_path / "other", "boat", 24, 6, renderer))
    assert first.keys() == other.keys()
    assert sum(first[name] == other[name] for name in first if name.endswith((".jpg", ".JPEG"))) == 0


def test_a_larger_set_begins_with_the_smaller_one(tmp_path: Path, renderer: Renderer) -> None:
    small = files_of(generator.generated(tmp_path, "chair", 20, 0, renderer))
    large = files_of(generator.generated(tmp_path, "chair", 40, 0, renderer))
    pictures = [Path(name).stem for name in large if Path(name).suffix == ".jpg"]
    assert len(set(pictures)) == len(pictures) == 16
    stems = {Path(name).stem: content for name, content in large.items() if "Images/" in name}
    for name, content in small.items():
        if "Images/" in name:
            assert stems[Path(name).stem] == content


def test_interrupted_generation_leaves_nothing_and_is_done_again(
    tmp_path: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(category: str, random: np.random.Generator, draw: Any) -> Any:
        if random.random() < 0.2:
            raise KeyboardInterrupt
        return shoot(category, random, draw)

    with monkeypatch.context() as patch:
        patch.setattr(generator, "shoot", interrupted)
        with pytest.raises(KeyboardInterrupt):
            generator.generated(tmp_path, "sofa", 30, 0, renderer)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [".sofa.lock"]
    part = next(tmp_path.iterdir()) / ".sofa.part"  # what a killed process would leave
    (part / "Images").mkdir(parents=True)
    (part / "Images" / "half").write_bytes(b"")
    root = generator.generated(tmp_path, "sofa", 30, 0, renderer)
    assert not part.exists()
    assert not any(name.endswith("half") for name in files_of(root))


def test_mark_says_what_was_generated_and_a_changed_one_is_refused(
    tmp_path: Path, renderer: Renderer
) -> None:
    root = generator.generated(tmp_path, "bottle", 20, 3, renderer)
    mark = generated.read_mark(root)
    assert mark is not None
    assert mark["seed"] == 3
    assert mark["generator_version"] == generator.VERSION
    assert mark["symmetry"] == {"bottle": 0}
    (root / generated.MARK).write_text(json.dumps({**mark, "seed": 4}), encoding="utf-8")
    with pytest.raises(DataError, match=r"it was changed\. Delete"):
        generator.generated(tmp_path, "bottle", 20, 3, renderer)


def test_cache_that_cannot_be_written_is_said(
    tmp_path: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "file"))
    with pytest.raises(DataError, match="Set FRAMEWORK_CACHE to another folder"):
        schema.build("data", schema.resolve("data", "pascal3d")).prepare()
    with pytest.raises(DataError, match=r"cannot be written to .* set FRAMEWORK_CACHE"):
        generator.generated(tmp_path / "file", "car", 20, 0, renderer)


def test_renderer_that_draws_no_mask_is_refused(tmp_path: Path) -> None:
    class Colors(Renderer):
        channels = frozenset({"color"})

        def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, torch.Tensor]:
            raise AssertionError("never asked")

    with pytest.raises(ConfigError, match="Colors draws no mask; wanted color and mask"):
        generator.generated(tmp_path, "car", 20, 0, Colors())


def test_pictures_hold_what_the_protocol_leaves_out(renderer: Renderer) -> None:
    things = [
        (thing, shot)
        for number in range(150)
        for shot in [shoot("chair", np.random.default_rng([1, number]), renderer)]
        for thing in shot.things
    ]
    for flag in ("truncated", "occluded", "difficult"):
        assert 0.005 < np.mean([getattr(thing, flag) for thing, _ in things]) < 0.25, flag
    assert 0.9 < np.mean([thing.fine for thing, _ in things]) < 1
    assert len(things) > 160  # some pictures hold two objects
    assert 0.1 < np.mean([shot.blur > 0 for _, shot in things]) < 0.4
    for thing, shot in things:
        left, top, right, bottom = thing.box
        assert 0 <= left <= right < shot.pixels.shape[1]
        assert 0 <= top <= bottom < shot.pixels.shape[0]
        assert thing.symmetry == FAMILIES[thing.category].symmetry


def test_annotations_written_at_once_are_those_written_one_after_the_other(
    tmp_path: Path,
) -> None:
    """Check with threads that switch every microsecond, because SciPy's writers share a tag."""
    pixels = np.zeros((8, 9, 3), np.uint8)
    view = View(10.0, 20.0, 0.0, 3.0, 100.0, (4.0, 4.0))
    things = [
        Thing(name, view, (1, 2, 3, 4), False, False, False, True, 0) for name in ("car", "aeroplane", "tv")
    ]
    for when in ("alone", "together"):
        for kind in ("Annotations", "Images"):
            (tmp_path / when / kind / "car_pascal").mkdir(parents=True)

    def save(when: str, number: int) -> None:
        shot = Shot(pixels, things[: 1 + number % 3], 0.0)
        generator._save(tmp_path / when, "car_pascal", f"{number:03d}", shot)

    for number in range(240):
        save("alone", number)
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        generated.draw_all(240, lambda number: save("together", number), "annotations")
    finally:
        sys.setswitchinterval(before)
    alone, together = (
        sorted((tmp_path / when / "Annotations").rglob("*.mat")) for when in ("alone", "together")
    )
    assert len(alone) == 240
    assert [file.read_bytes() for file in alone] == [file.read_bytes() for file in together]
