import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from framework.bodies.people import load_body
from framework.configuration.schema import build, resolve
from framework.datasets import scan_layout
from framework.errors import ConfigError, DataError
from framework.geometry.camera import Camera
from framework.geometry.srgb import bytes_from_linear, linear_from_bytes, srgb_from_linear
from framework.renderer import Scene, Texture
from framework.storage import cache
from framework.testing.bodies import DOLL
from framework.testing.data_folders import damage
from framework.testing.rows import DAMAGES
from plugins.data.human_scans import photographs, scan_generator, skins
from plugins.data.human_scans.data import Counts, HumanScans, Variation, photograph
from plugins.data.human_scans.dressed import ERROR, FURTHEST, Wardrobe
from plugins.data.human_scans.rows import SMALL

RENDERER = build("renderer", resolve("renderer", {"name": "rasterizer"}))


@pytest.fixture(scope="module")
def wardrobe():
    return Wardrobe(load_body(None)[0], stages=1)


@pytest.fixture(scope="module")
def posed(wardrobe):
    joints = len(wardrobe.body.parents)
    return wardrobe.model(torch.zeros(1, 1), torch.zeros(1, joints, 3))[0].numpy()


@pytest.fixture(scope="module")
def dressed(wardrobe, posed):
    return [wardrobe.dress(posed, None, np.random.default_rng(number)) for number in range(12)]


def test_registrations_are_near_the_body_and_scans_are_not_registrations(wardrobe, posed, dressed):
    bare = wardrobe.sheet.interpolate(posed)
    gaps = []
    for scan, registration in dressed:
        assert np.isfinite(scan.vertices).all() and scan.faces.max() < len(scan.vertices)
        assert (scan.colors >= 0).all() and (scan.colors <= 1).all()
        assert np.linalg.norm(registration.vertices - bare, axis=1).max() < FURTHEST + 5 * ERROR
        gap = np.linalg.norm(registration.vertices - scan.vertices[: len(bare)], axis=1)
        gaps.append((np.median(gap), gap.max()))
    median, largest = np.array(gaps).T
    assert (median < 0.01).all()  # the registration follows the scan
    assert (largest > 0.01).mean() > 0.6  # hair, hems and skirts are only in the scan
    # some people have skirts or long hair, which are not part of the body's mesh
    assert 0.2 < np.mean([len(scan.vertices) > len(bare) for scan, _ in dressed]) < 1


def test_colours_of_a_registration_are_those_of_the_nearest_points_that_a_scanner_sees(dressed):
    for scan, registration in dressed[:3]:
        for vertex in range(0, len(registration.vertices), 4001):
            order = np.linalg.norm(scan.vertices - registration.vertices[vertex], axis=1).argsort()
            colors = bytes_from_linear(torch.from_numpy(scan.colors[order[:1]])).numpy()
            # legs under a skirt are nearer than the skirt, but no scanner sees them
            hidden = len(scan.vertices) > len(registration.vertices)
            assert hidden or np.array_equal(registration.colors[vertex], colors[0])


def test_the_same_seed_dresses_alike_and_others_differ(wardrobe, posed, dressed):
    again, registered = wardrobe.dress(posed, None, np.random.default_rng(3))
    assert np.array_equal(again.vertices, dressed[3][0].vertices)
    assert np.array_equal(registered.colors, dressed[3][1].colors)
    means = [scan.colors.mean(0).round(3).tolist() for scan, _ in dressed]
    assert len({tuple(mean) for mean in means}) == len(means)


def test_blank_parts_of_a_skin_take_the_tone_of_the_face(wardrobe, posed):
    size = 64
    pixels = np.full((size, size, 3), skins.BLANK, np.uint8)
    uv = wardrobe.uv[wardrobe.vertex_of_place.argsort(kind="stable")]
    head = wardrobe.anatomy.head[np.sort(wardrobe.vertex_of_place)] > 0.5
    row, column = ((1 - uv[head, 1]) * size).astype(int), (uv[head, 0] * size).astype(int)
    for step in (-1, 0, 1):
        pixels[(row + step).clip(0, size - 1), column] = pixels[row, (column + step).clip(0, size - 1)] = (
            200,
            120,
            80,
        )
    vertices = wardrobe.sheet
    shown = skins.colors_at(pixels, wardrobe.uv)[wardrobe._place_of]
    filled = skins.fill_blanks(
        shown, wardrobe.anatomy, wardrobe.vertices, wardrobe._neighbours.dot, vertices.interpolate
    )
    grey = float(linear_from_bytes(torch.tensor(skins.BLANK, dtype=torch.uint8)))
    assert (np.abs(shown - grey).max(1) < 0.002).mean() > 0.3
    assert (np.abs(filled - grey).max(1) < 0.002).mean() < 0.01
    tone = linear_from_bytes(torch.tensor([200, 120, 80], dtype=torch.uint8)).numpy()
    np.testing.assert_allclose(np.median(filled[wardrobe.anatomy.along_leg > 0.3], 0), tone, atol=0.01)


def test_a_texture_holds_the_colours_of_its_places(wardrobe, dressed):
    colors = linear_from_bytes(torch.from_numpy(dressed[0][1].colors[wardrobe.vertex_of_place]))
    faces = wardrobe.sheet.corners[-1].uv_faces
    pixels = photographs.texture(RENDERER, wardrobe.uv, faces, colors, 512)
    used = np.unique(faces)
    sampled = skins.colors_at(pixels, wardrobe.uv)[used]
    assert np.quantile(np.abs(sampled - colors.numpy()[used]).max(1), 0.9) < 0.05


@pytest.mark.parametrize("number", range(4))
def test_photographs_show_a_point_where_its_camera_says(number):
    """Compare the centroid of a 12 cm ball's mask with the projection of its centre."""
    random = np.random.default_rng(number)
    people = random.normal(0, 0.4, (500, 3)) * [0.5, 1, 0.5] + random.normal(0, 1, 3)
    camera = photographs.place_cameras(people, 5, (60, 48), random)[number]
    centre = people[0]
    steps = np.linspace(0, np.pi, 40)
    turn, tilt = (grid.ravel() for grid in np.meshgrid(2 * steps, steps))
    ball = (
        np.stack([np.sin(tilt) * np.cos(turn), np.cos(tilt), np.sin(tilt) * np.sin(turn)], 1) * 0.12 + centre
    )
    corner = (40 * np.arange(39)[:, None] + np.arange(39)).ravel()
    faces = np.concatenate([corner[:, None] + half for half in ((0, 1, 40), (1, 41, 40))])
    scene = Scene(torch.from_numpy(ball).float(), torch.from_numpy(faces), torch.ones(len(ball), 3), camera)
    (photograph,) = photographs.take_photographs(RENDERER, scene, [camera])
    cover = photograph.mask.astype(float)
    row, column = (np.average(place, weights=cover) for place in np.indices(cover.shape))
    pixel, depth = camera.project(torch.from_numpy(centre)[None])
    # the outline of a ball is shifted outwards by (radius / depth)² times its distance from the axis
    assert np.abs(np.array([column, row]) - pixel[0].numpy()).max() < 0.05 + 40 * (0.12 / float(depth)) ** 2
    assert (photograph.pixels[photograph.mask > 0] == 255).all() and (
        photograph.pixels[photograph.mask == 0] == 188
    ).all()


@pytest.mark.parametrize("number", range(10))
def test_the_rig_sees_everybody_whole_from_different_places(number):
    random = np.random.default_rng(number)
    people = random.normal(0, 1, (300, 3)) * 10 ** random.uniform(-1, 0.5, 3) + random.normal(0, 3, 3)
    size = (64, 48) if number % 2 else (48, 64)
    cameras = photographs.place_cameras(people, 12, size, random)
    for camera in cameras:
        pixel, depth = camera.project(torch.from_numpy(people))
        assert (depth > 0).all()
        margin = photographs.MARGIN * size[0] - 1
        assert (pixel > margin).all()
        assert (pixel < torch.tensor([size[1] - 1 - margin, size[0] - 1 - margin])).all()
        torch.testing.assert_close(torch.det(camera.rotation), torch.tensor(1.0))
    eyes = torch.stack([-camera.rotation.T @ camera.translation for camera in cameras])
    assert (torch.cdist(eyes, eyes) + torch.eye(12) > 1e-3).all()


def prepared(**config):
    small = {
        **SMALL,
        **DOLL,
        "height": 24,
        "width": 18,
        "texture_side": 0,
        "train": 2,
        "validation": 1,
        "test": 1,
    }
    scans = build("data", resolve("data", {"name": "human_scans", **small, **config}))
    scans.prepare()
    return scans


def test_a_subject_is_a_function_of_seed_split_and_number(tmp_path, monkeypatch):
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    few, more = prepared(), prepared(train=3, test=2)
    assert few.folder != more.folder
    for split in ("train", "validation", "test"):
        first, second = getattr(few.splits(), split), getattr(more.splits(), split)
        for number in range(len(first)):
            assert torch.equal(first[number]["input"], second[number]["input"])
            assert torch.equal(first[number]["target"], second[number]["target"])
    names = scan_layout.read_splits(more.folder)
    assert [len(some) for some in names.values()] == [3, 1, 2]
    lively = prepared(posed=1.0).splits()
    assert torch.equal(lively.train[0]["input"], few.splits().train[0]["input"])
    assert not torch.equal(lively.test[0]["input"], few.splits().test[0]["input"])


def test_the_default_body_is_photographed_with_what_textured_renderers_need(tmp_path, monkeypatch):
    """Check that the photograph can be drawn again from the files, best with the texture, worst with few vertices."""
    root = Path(cache.folder("body")).resolve()
    (tmp_path / "body").symlink_to(root)
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    size = {"height": 128, "width": 96, "views": 1, "train": 1, "validation": 1, "test": 1}
    config = {"name": "human_scans", "renderer": "rasterizer", **size, "texture_side": 512}
    scans = build("data", resolve("data", config))
    scans.prepare()
    smooth = build("renderer", resolve("renderer", {"name": "rasterizer", "supersampling": 4}))
    errors = []
    for topology in ("7k", "27k"):
        subject = scan_layout.read_subject(scans.folder, "test_0000", topology)
        places = scan_layout.read_places(scans.folder, topology)
        mesh, camera = subject.mesh, subject.views[0].camera
        assert np.array_equal(places.faces, mesh.faces)
        texture = linear_from_bytes(torch.from_numpy(scan_layout.read_texture(scans.folder, "test_0000")))
        light, cover = photograph(subject.views[0])
        ones = torch.ones(len(mesh.vertices), 1)
        shares = smooth(Scene(mesh.vertices, mesh.faces, ones, camera))["color"]
        shown = Texture((texture,), torch.from_numpy(places.uv), torch.from_numpy(places.uv_faces))
        for scene in (
            Scene(mesh.vertices, mesh.faces, linear_from_bytes(mesh.colors), camera),
            Scene(mesh.vertices, mesh.faces, None, camera, shown),
        ):
            rendered = srgb_from_linear(smooth(scene)["color"] + 1 - shares)
            errors.append(float((rendered - srgb_from_linear(light))[cover > 0].square().mean()))
    few, few_textured, many, many_textured = errors
    assert 10**-3 < many < few < 10**-1.3
    assert few_textured < few and many_textured < many
    for read, file in (
        (lambda: scan_layout.read_places(scans.folder, "7k"), "topology_7k.npz"),
        (lambda: scan_layout.read_texture(scans.folder, "test_0000"), "subjects/test_0000/texture.png"),
    ):
        for kind in DAMAGES:
            before = (scans.folder / file).read_bytes()
            damage(scans.folder / file, kind)
            with pytest.raises(DataError, match=Path(file).name):
                read()
            if (scans.folder / file).is_dir():
                (scans.folder / file).rmdir()
            (scans.folder / file).write_bytes(before)


def test_a_topology_that_is_not_generated_is_told_before_anything_is_drawn():
    with pytest.raises(ConfigError, match=r"data\.topology = 27k is not one of data\.topologies = \[7k\]"):
        prepared(topology="27k")


def test_a_renderer_that_smooths_edges_itself_draws_nearly_the_same():
    """Check that the colour of a pixel is that of the subject alone, whatever else the pixel shows."""
    corners = torch.tensor([[0.0, 0, 2], [0.3, 0.9, 2], [0.8, 0.1, 2.5]])
    camera = Camera(torch.eye(3), torch.zeros(3), (40.0, 40.0), (2.0, 2.0), 24, 24)
    scene = Scene(corners, torch.tensor([[0, 1, 2]]), torch.tensor([[0.2, 0.5, 0.9]]).expand(3, 3), camera)
    smooth = build("renderer", resolve("renderer", {"name": "rasterizer", "supersampling": 3}))
    first, second = (
        photographs.take_photographs(renderer, scene, [camera])[0] for renderer in (RENDERER, smooth)
    )
    assert np.abs(first.mask.astype(int) - second.mask).max() < 30
    both = (first.mask > 0) & (second.mask > 0)
    assert both.sum() > 50 and np.abs(first.pixels[both].astype(int) - second.pixels[both]).max() <= 1


def test_skins_are_worn_in_one_split_each(tmp_path):
    for number in range(16):
        Image.new("RGB", (8, 8), (number, 0, 0)).save(tmp_path / f"{number:02}.png")
    parts = scan_generator._split_skins(str(tmp_path), True)
    assert [len(some) for some in parts] == [10, 2, 4]
    assert len({file for some in parts for file in some}) == 16
    with pytest.raises(ConfigError, match=r"data\.skins needs a body with texture coordinates"):
        scan_generator._split_skins(str(tmp_path), False)
    for file in sorted(tmp_path.iterdir())[2:]:
        file.unlink()
    with pytest.raises(ConfigError, match="holds 2 skins; expected three"):
        scan_generator._split_skins(str(tmp_path), True)


def test_a_skin_that_is_no_file_gets_a_sentence(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    for file in skins.files(tmp_path):
        for reader in (skins.content, skins.read):
            with pytest.raises(DataError, match=rf"{file.name}: cannot be read"):
                reader(file)


def test_supersampling_keeps_the_camera():
    camera = Camera(torch.eye(3), torch.zeros(3), (50.0, 60.0), (7.0, 9.5), 20, 16)
    finer = photographs._finer(camera)
    points = torch.tensor([[0.1, -0.1, 1.0], [0.0, 0.02, 2.0]])
    pixel, _ = camera.project(points)
    torch.testing.assert_close(finer.project(points)[0], 4 * pixel + 1.5)


def test_photographs_want_a_renderer_that_tells_the_subject_from_the_ground():
    class OnWhite(type(RENDERER)):
        background = 1.0

    class Colourless(type(RENDERER)):
        channels = frozenset({"depth"})

    for renderer in (OnWhite(), Colourless()):
        with pytest.raises(
            ConfigError,
            match=f"{type(renderer).__name__} does not draw the channel `color` with a black background",
        ):
            HumanScans(
                renderer=renderer, counts=Counts(), drawing=scan_generator.Drawing(), variation=Variation()
            )
