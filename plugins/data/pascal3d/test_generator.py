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

from framework.configuration import schema
from framework.errors import ConfigError, DataError
from framework.renderer import Renderer, Scene
from framework.storage import generated
from plugins.data.pascal3d import generator
from plugins.data.pascal3d.families import FAMILIES
from plugins.data.pascal3d.layout import CLASSES
from plugins.data.pascal3d.scene import (
    AnnotatedObject,
    Shot,
    View,
    camera_of,
    crop_camera,
    projected_edges,
    render_object,
    shoot,
)
from plugins.data.pascal3d.shapes import Mesh
from plugins.data.pascal3d.viewpoints import LEVELS, QUANTILES, viewpoint


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return schema.build("renderer", schema.resolve("renderer", "rasterizer"))


# ---- families -------------------------------------------------------------------------------------------


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
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.einsum("fi,fi->", normals, corners[:, 0]) > 0  # six times the volume
        lengths = np.linalg.norm(mesh.normals, axis=1)
        assert np.all((lengths < 1e-9) | (abs(lengths - 1) < 1e-9))


def render(renderer: Renderer, mesh: Mesh, azimuth: float, elevation: float, tilt: float) -> np.ndarray:
    """Return an image (96, 96, 4) of the object without shading: its colours and its opacity."""
    view = View(azimuth, elevation, tilt, 3.0, 230.0, (47.5, 47.5))
    camera = camera_of(view)
    layer = render_object(renderer, mesh, mesh.colors, camera, projected_edges(mesh, camera), (96, 96))
    return np.concatenate([layer.color, layer.opacity[..., None]], axis=2)


@pytest.mark.parametrize("category", CLASSES)
def test_objects_have_the_symmetry_of_their_family(category: str, renderer: Renderer) -> None:
    symmetric = {0: (37.0, 90.0, 180.0), 1: (), 2: (180.0,), 4: (90.0, 180.0)}[FAMILIES[category].symmetry]
    for seed in range(4):
        mesh = FAMILIES[category].build(np.random.default_rng(seed)).mesh()
        image = render(renderer, mesh, 25.0, 15.0, 5.0)
        for angle in (37.0, 90.0, 180.0):
            difference = abs(image - render(renderer, mesh, 25.0 + angle, 15.0, 5.0)).mean()
            # a polygon that approximates a circle is not quite symmetric, so that single pixels differ
            assert (difference < 0.002) if angle in symmetric else (difference > 0.004), (seed, angle)


@pytest.mark.parametrize("category", [name for name in CLASSES if name != "aeroplane"])
def test_mirror_image_is_the_image_at_the_mirrored_angles(category: str, renderer: Renderer) -> None:
    """Check the rule that `augment` uses; only the propeller of an aeroplane is not mirror-symmetric."""
    mesh = FAMILIES[category].build(np.random.default_rng(3)).mesh()
    image = render(renderer, mesh, 35.0, 20.0, 12.0)[:, ::-1]
    assert abs(image - render(renderer, mesh, -35.0, 20.0, -12.0)).mean() < 0.002
    assert abs(image - render(renderer, mesh, -35.0, 20.0, 12.0)).mean() > 0.01
    assert abs(image - render(renderer, mesh, -35.0, -20.0, -12.0)).mean() > 0.01


# ---- the convention of angles ----------------------------------------------------------------------------


def project_as_the_toolbox(points: np.ndarray, viewpoint: dict[str, float]) -> np.ndarray:
    """Return the pixels (x, y) of points, counted from 1, computed as `project_3d.m` of PASCAL3D+ 1.1 does."""
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

    class StopRendering(Exception):
        pass

    vertices: list[np.ndarray] = []

    def record(scene: Scene, channels: Collection[str]) -> Mapping[str, torch.Tensor]:
        vertices.append(scene.vertices.double().numpy())
        raise StopRendering

    with pytest.raises(StopRendering):
        shoot(category, np.random.default_rng(seed), record)
    return Mesh(vertices[0], np.empty((0, 3), dtype=np.int64), np.empty((0, 3)), np.empty((0, 3)))


@pytest.mark.parametrize("category", ["car", "aeroplane", "bottle"])
def test_annotated_viewpoint_projects_the_object_onto_its_box(category: str, renderer: Renderer) -> None:
    """Check that the official formula, applied to the annotated fields, gives the position of the object in the image.

    Thin tips that cover less than half a pixel do not count.
    """
    for seed in range(6):
        shot = shoot(category, np.random.default_rng(seed), renderer)
        mesh = first_mesh(category, seed)
        boxes = []
        for annotated in shot.objects:
            fields = generator._viewpoint(annotated._replace(fine=True))
            pixels = project_as_the_toolbox(mesh.vertices, fields)
            height, width, _ = shot.pixels.shape
            low, high = np.maximum(pixels.min(0), 1), np.minimum(pixels.max(0), (width, height))
            boxes.append(abs(np.array([*low, *high]) - [edge + 1 for edge in annotated.box]).max())
        assert min(boxes) < 1.7, (seed, boxes)  # pixels


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
    """Check the axes of objects: the front is -y, up is z, and left is x.

    At azimuth 90° the image shows the left side of the object, which faces left in the image.
    """
    points = {"front": (0, -1, 0), "rear": (0, 1, 0), "left side": (1, 0, 0), "right side": (-1, 0, 0)}
    camera = camera_of(View(azimuth, 0.0, 0.0, 3.0, 100.0, (0.0, 0.0)))
    in_camera = {name: camera.rotation.double() @ torch.tensor(p).double() for name, p in points.items()}
    assert min(in_camera, key=lambda name: float(in_camera[name][2])) == nearest
    assert min(in_camera, key=lambda name: float(in_camera[name][0])) == to_the_left


def test_elevation_lifts_the_camera_and_tilt_rotates_the_object_counter_clockwise() -> None:
    above = camera_of(View(0.0, 30.0, 0.0, 3.0, 100.0, (0.0, 0.0))).rotation.double()
    assert (above @ torch.tensor([0.0, 0.0, 1.0]).double())[2] < 0  # the top is nearer than the middle
    tilted = camera_of(View(0.0, 0.0, 20.0, 3.0, 100.0, (0.0, 0.0))).rotation.double()
    x, y, _ = tilted @ torch.tensor([0.0, 0.0, 1.0]).double()  # x right, y down
    assert math.degrees(math.atan2(-x, -y)) == pytest.approx(20.0)


def test_a_cropped_camera_shows_the_same_image() -> None:
    """Check that the averages of finer pixels lie at the positions of the pixels of the original camera."""
    camera = camera_of(View(10.0, 20.0, 5.0, 3.0, 80.0, (31.5, 20.25)))
    part = crop_camera(camera, (7, 11), (30, 40), 2)
    assert (part.height, part.width) == (60, 80)
    point = camera.rotation.double() @ torch.tensor([0.1, -0.2, 0.3]).double() + camera.translation.double()
    for axis in (0, 1):
        whole = camera.focal[axis] * point[axis] / point[2] + camera.principal[axis]
        fine = part.focal[axis] * point[axis] / point[2] + part.principal[axis]
        # pixel i consists of the finer pixels 2i and 2i + 1, and its centre lies between their centres
        assert float(fine) == pytest.approx(2 * (float(whole) - (7, 11)[axis]) + 0.5, abs=1e-4)


def test_viewpoints_follow_the_measured_quantiles() -> None:
    random = np.random.default_rng(0)
    for category in CLASSES:
        angles = np.array([viewpoint(category, random) for _ in range(2000)])
        assert np.all((angles[:, 0] >= 0) & (angles[:, 0] < 360))
        assert abs(np.exp(1j * np.deg2rad(angles[:, 0])).mean()) < 0.08
        for column, levels in zip((1, 2), QUANTILES[category], strict=True):
            middle = np.quantile(angles[:, column], LEVELS[3:-3])
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
        synthetic = np.array([viewpoint(category, random)[1:] for _ in range(4000)])
        for column in (0, 1):
            levels = np.arange(-90, 91)  # the lists hold whole degrees
            below = [(np.round(angles[:, column])[:, None] <= levels).mean(0) for angles in (real, synthetic)]
            assert abs(below[0] - below[1]).max() < 0.1, category
            assert abs(real[:, column].mean() - synthetic[:, column].mean()) < 2, category
    assert objects == 2108


# ---- the generator ---------------------------------------------------------------------------------------


def files_of(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()
    }


def test_generation_is_the_same_to_the_byte_for_any_number_of_threads_or_processes(
    tmp_path: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    roots = []
    for painters in (1, 3):
        monkeypatch.setattr(generated, "PAINTERS", painters)
        roots.append(generator.generate_class(tmp_path / str(painters), "boat", 24, 5, renderer))
    monkeypatch.setattr(generated, "WORTH_A_PROCESS", 1)
    monkeypatch.setattr(generated, "_may_fork", lambda: True)
    roots.append(generator.generate_class(tmp_path / "processes", "boat", 24, 5, renderer))
    first, second, third = map(files_of, roots)
    assert len(first) == 2 * 24 + 5
    assert first == second == third
    other = files_of(generator.generate_class(tmp_path / "other", "boat", 24, 6, renderer))
    assert first.keys() == other.keys()
    assert sum(first[name] == other[name] for name in first if name.endswith((".jpg", ".JPEG"))) == 0


def test_a_larger_set_begins_with_the_smaller_one(tmp_path: Path, renderer: Renderer) -> None:
    small = files_of(generator.generate_class(tmp_path, "chair", 20, 0, renderer))
    large = files_of(generator.generate_class(tmp_path, "chair", 40, 0, renderer))
    voc_images = [Path(name).stem for name in large if Path(name).suffix == ".jpg"]
    assert len(set(voc_images)) == len(voc_images) == 16
    stems = {Path(name).stem: content for name, content in large.items() if "Images/" in name}
    for name, content in small.items():
        if "Images/" in name:
            assert stems[Path(name).stem] == content


def test_interrupted_generation_leaves_nothing_and_is_repeated(
    tmp_path: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt_some(category: str, random: np.random.Generator, renderer: Any) -> Any:
        if random.random() < 0.2:
            raise KeyboardInterrupt
        return shoot(category, random, renderer)

    with monkeypatch.context() as patch:
        patch.setattr(generator, "shoot", interrupt_some)
        with pytest.raises(KeyboardInterrupt):
            generator.generate_class(tmp_path, "sofa", 30, 0, renderer)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [".sofa.lock"]
    part = next(tmp_path.iterdir()) / ".sofa.part"  # a folder that a killed process would leave
    (part / "Images").mkdir(parents=True)
    (part / "Images" / "half").write_bytes(b"")
    root = generator.generate_class(tmp_path, "sofa", 30, 0, renderer)
    assert not part.exists()
    assert not any(name.endswith("half") for name in files_of(root))


def test_the_mark_describes_the_generated_set_and_must_not_change(tmp_path: Path, renderer: Renderer) -> None:
    root = generator.generate_class(tmp_path, "bottle", 20, 3, renderer)
    mark = generated.read_mark(root)
    assert mark is not None
    assert mark["seed"] == 3
    assert mark["generator_version"] == generator.VERSION
    assert mark["symmetry"] == {"bottle": 0}
    (root / generated.MARK).write_text(json.dumps({**mark, "seed": 4}), encoding="utf-8")
    with pytest.raises(DataError, match=r"so this file was changed\. Delete"):
        generator.generate_class(tmp_path, "bottle", 20, 3, renderer)


def test_the_message_about_a_cache_that_cannot_be_written_names_a_remedy(
    tmp_path: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "file"))
    with pytest.raises(DataError, match="Set FRAMEWORK_CACHE to another folder"):
        schema.build("data", schema.resolve("data", "pascal3d")).prepare()
    with pytest.raises(DataError, match=r"cannot be written to .* set FRAMEWORK_CACHE"):
        generator.generate_class(tmp_path / "file", "car", 20, 0, renderer)


def test_renderer_that_draws_no_mask_is_refused(tmp_path: Path) -> None:
    class Colors(Renderer):
        channels = frozenset({"color"})

        def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, torch.Tensor]:
            raise AssertionError("this renderer is refused before it is called")

    with pytest.raises(ConfigError, match="Colors draws no mask, but color and mask are required"):
        generator.generate_class(tmp_path, "car", 20, 0, Colors())


def test_images_hold_objects_of_every_kind_that_the_protocol_leaves_out(renderer: Renderer) -> None:
    objects = [
        (annotated, shot)
        for number in range(150)
        for shot in [shoot("chair", np.random.default_rng([1, number]), renderer)]
        for annotated in shot.objects
    ]
    for flag in ("truncated", "occluded", "difficult"):
        assert 0.005 < np.mean([getattr(annotated, flag) for annotated, _ in objects]) < 0.25, flag
    assert 0.9 < np.mean([annotated.fine for annotated, _ in objects]) < 1
    assert len(objects) > 160  # some images hold two objects
    assert 0.1 < np.mean([shot.blur > 0 for _, shot in objects]) < 0.4
    for annotated, shot in objects:
        left, top, right, bottom = annotated.box
        assert 0 <= left <= right < shot.pixels.shape[1]
        assert 0 <= top <= bottom < shot.pixels.shape[0]
        assert annotated.symmetry == FAMILIES[annotated.category].symmetry


def test_annotations_written_by_threads_equal_those_written_one_after_the_other(
    tmp_path: Path,
) -> None:
    """Check with threads that switch every microsecond, because SciPy's writers share a variable."""
    pixels = np.zeros((8, 9, 3), np.uint8)
    view = View(10.0, 20.0, 0.0, 3.0, 100.0, (4.0, 4.0))
    objects = [
        AnnotatedObject(name, view, (1, 2, 3, 4), False, False, False, True, 0)
        for name in ("car", "aeroplane", "tv")
    ]
    for folder in ("alone", "together"):
        for kind in ("Annotations", "Images"):
            (tmp_path / folder / kind / "car_pascal").mkdir(parents=True)

    def save(folder: str, number: int) -> None:
        shot = Shot(pixels, objects[: 1 + number % 3], 0.0)
        generator._save(tmp_path / folder, "car_pascal", f"{number:03d}", shot)

    for number in range(240):
        save("alone", number)
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        generated.draw_all(240, lambda number: save("together", number), "annotations")
    finally:
        sys.setswitchinterval(before)
    alone, together = (
        sorted((tmp_path / folder / "Annotations").rglob("*.mat")) for folder in ("alone", "together")
    )
    assert len(alone) == 240
    assert [file.read_bytes() for file in alone] == [file.read_bytes() for file in together]
