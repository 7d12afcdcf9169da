import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.geometry.clouds import denormalise_clouds, sizes
from framework.geometry.meshes import Mesh, read
from framework.testing.bodies import JOINTS, doll, write_body_file
from plugins.data.registration.result import SCAN, SKIN, distances, figure, render_panels, write_ply
from plugins.data.registration.scanner import KINDS, Scanner, scan, strangers


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return Path(write_body_file(tmp_path_factory.mktemp("body"))["body"])


def data(file, **config):
    sizes = {"train": 12, "validation": 3, "test": 30, "points": 500}
    return build("data", resolve("data", {"name": "registration", "body": str(file), **sizes, **config}))


def prepared(file, **config):
    registration_data = data(file, **config)
    registration_data.prepare()
    return registration_data


def test_people_are_split_and_drawn_by_the_data_seed(file):
    first, second = prepared(file), prepared(file, data_seed=1)
    assert first.fingerprint()["sha256"] != second.fingerprint()["sha256"]
    assert first.target.names[:4] == ("x0", "y0", "z0", "x1")
    assert len(first.target.names) == 3 * 132
    assert first.input_shape == (500, 3)
    assert (first.groups, first.varies, first.columns) == (
        ("whole", "partial", "outliers"),
        False,
        ("x", "y", "z"),
    )
    batch = first.splits().test.__getitems__([3, 0, 29])
    assert {name: batch[name].dtype for name in ("target", "centre", "scale")} == dict.fromkeys(
        ("target", "centre", "scale"), torch.float32
    )
    assert first.splits().train.__getitems__([0])["target"].dtype == torch.float16


def test_points_lie_on_the_body_and_both_in_one_frame(file):
    registration_data = prepared(file, noise=0, partial=0, outliers=0)
    scans = registration_data.splits().test
    batch = scans.__getitems__(range(5))
    place = batch["centre"].double(), batch["scale"].double()
    vertices = denormalise_clouds(batch["target"].double().unflatten(1, (-1, 3)), *place)
    np.testing.assert_allclose(vertices, scans.model(scans.shape[:5], scans.pose[:5]), atol=1e-6)
    points = denormalise_clouds(batch["input"].double(), *place)
    normal, corners = planes(vertices, registration_data.model.faces)
    for cloud, n, c in zip(points, normal, corners, strict=True):
        distances_to_planes = torch.einsum(
            "fk,pfk->pf", n, cloud[:, None] - c[None, :, 0]
        ).abs()  # from every face's plane
        assert distances_to_planes.amin(1).max() < 1e-6


def planes(vertices, faces):
    corners = vertices[:, faces]
    normal = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    return torch.nn.functional.normalize(normal, dim=-1), corners


def test_scans_lack_parts_and_hold_strangers_as_asked(file):
    whole, partial, outliers = (
        prepared(file, noise=0, partial=float(kind == "partial"), outliers=float(kind == "outliers"))
        .splits()
        .test.__getitems__(range(30))
        for kind in KINDS
    )
    assert set(whole["group"].tolist()) == {0}
    assert (sizes(whole["input"]) == 500).all()
    counts = sizes(partial["input"])
    assert set(partial["group"].tolist()) == {1}
    assert 150 < counts.min() < counts.float().mean() < 480
    assert set(outliers["group"].tolist()) == {2}
    assert (sizes(outliers["input"]) == 500).all()


def test_a_scanner_sees_one_side_and_cuts_no_more_than_asked():
    content = doll()
    mesh = Mesh("a doll", content["v_template"], content["f"])
    for seed in range(40):
        points = scan(mesh, "partial", Scanner(points=2_000, noise=0.0, cut=0.1), np.random.default_rng(seed))
        # a tenth at most is removed by a plane or a ball; or the half that faces away
        assert len(points) >= 1_800 or 800 < len(points) < 1_200
    noisy = scan(mesh, "whole", Scanner(points=20_000, noise=0.01), np.random.default_rng(3))
    assert len(noisy) == 20_000
    outside = np.linalg.norm(noisy[:, None] - JOINTS, axis=-1).min(1) > 0.0401
    assert 0.05 < outside.mean() < 0.6


def test_strangers_are_a_patch_of_floor_and_a_few_others():
    vertices = doll()["v_template"]
    points = strangers(vertices, 1_000, np.random.default_rng(0))
    floor = np.abs(points[:, 1] - vertices[:, 1].min()) < 0.02
    assert floor.mean() >= 0.98
    assert np.ptp(points[floor][:, 0]) < 1.7


def test_a_users_scan_is_read_in_metres_without_preparing(file, tmp_path):
    points = np.random.default_rng(0).normal(size=(300, 3)) + np.array([5, 1, -3])
    np.save(tmp_path / "a.npy", points)
    np.save(tmp_path / "b.npy", points[:40])
    batch = data(file).read([tmp_path / "a.npy", tmp_path / "b.npy"]).__getitems__([0, 1])
    assert sizes(batch["input"]).tolist() == [300, 40]
    back = denormalise_clouds(batch["input"].double(), batch["centre"].double(), batch["scale"].double())
    np.testing.assert_allclose(back[1, :40], points[:40], atol=1e-6)


def test_bodies_that_poses_cannot_move_are_refused(file, tmp_path):
    content = doll()
    few = {
        **content,
        "weights": np.ones((132, 3)) / 3,
        "J_regressor": content["J_regressor"][:3],
        "kintree_table": np.array([[-1, 0, 1], [0, 1, 2]]),
    }
    np.savez(tmp_path / "few.npz", **few)
    with pytest.raises(DataError, match="has 3 joints; expected 22 at least"):
        prepared(tmp_path / "few.npz")


@pytest.mark.parametrize(
    "name, key, value",
    [
        *[("registration", "train", 0), ("registration", "noise", -1.0), ("registration", "partial", 1.5)],
        *[("registration", "strangers", 0.4), ("registration", "cut", math.nan), ("faust", "points", 5)],
        *[("faust", "test", []), ("faust", "test", [10]), ("faust", "data_seed", -1)],
    ],
)
def test_a_config_out_of_range_is_refused(name, key, value):
    with pytest.raises(ConfigError, match=r"data\."):
        resolve("data", {"name": name, key: value})


def test_shares_of_kinds_that_add_up_to_more_than_one_are_refused(file):
    with pytest.raises(ConfigError, match=r"data.partial = 0.9 and data.outliers = 0.2 add up to 1.1"):
        data(file, partial=0.9)
    data(file, partial=0.9, outliers=0.1)


def test_a_result_is_one_coloured_ply(tmp_path):
    content = doll()
    cloud = np.random.default_rng(0).normal(size=(50, 3))
    write_ply(tmp_path / "a.ply", content["v_template"], content["f"], cloud)
    mesh = read(tmp_path / "a.ply")
    np.testing.assert_allclose(mesh.vertices, np.concatenate([content["v_template"], cloud]), atol=1e-6)
    assert np.array_equal(mesh.faces, content["f"])
    colours = mesh.attribute(("red", "green", "blue"))
    np.testing.assert_allclose(colours[0], SKIN, atol=1 / 255)
    np.testing.assert_allclose(colours[-1], SCAN, atol=1 / 255)


def test_the_panels_show_the_front_and_the_left_side():
    # a square that faces the front, and to its left a bar that faces left; one point is in front of the square, one
    # behind it
    vertices = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (1, -1, -0.3), (1, 1, -0.3)], float)
    faces = np.array([(0, 1, 2), (0, 2, 3), (1, 4, 5), (1, 5, 2)])
    cloud = np.array([(0.5, 0.5, 1.0), (-0.5, -0.5, -1.0)])
    red = np.array([(1.0, 0.0, 0.0)] * 2)
    images = render_panels(vertices, faces, cloud, red, height=100)
    assert images.shape == (2, 4, 100, 100, 3)
    skin, blue = ((255 * np.array(color)).round() for color in (SKIN, SCAN))
    front, left = images[:, 2].astype(float)
    assert (front == blue).all(-1).sum() == 1  # the point behind the square is hidden
    row, column = np.argwhere((front == blue).all(-1))[0]
    assert row < 50 < column  # up, and to the body's left, which is the viewer's right
    assert np.abs(front[30, 30] - skin).max() <= 1  # a square that faces the viewer is fully lit
    row, column = np.argwhere((left == blue).all(-1))[0]
    assert column < 50  # the front is to the left when a body is seen from its left
    share = (np.abs(left - skin).max(-1) <= 1).mean()
    assert 0.05 < share < 0.15  # the bar alone, 0.3 by 2 of 2.12 by 2.12
    assert (images[0, 0] != 255).any(-1).sum() == 2  # the cloud alone
    assert (images[0, 3] == (255, 0, 0)).all(-1).sum() == 2  # in its own colours
    shown = figure(vertices, faces, cloud, "square")
    shown.draw_without_rendering()
    heads = ["scan", "registered mesh", "both", "distance from the mesh"]
    assert [axes.get_title() for axes in shown.axes[:4]] == heads
    assert shown.get_suptitle() == "square; its points lie 1000.0 mm off on average, 95 % within 1000.0 mm"
    assert shown.axes[4].get_xlim()[0] > shown.axes[4].get_xlim()[1]  # the front is to the left


def test_distances_are_to_the_surface():
    # a square, and a vertex without faces that is close to the points
    vertices = np.array([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (1, 0.9, 0.3)], float)
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    cloud = np.array([(1, 0.9, 0.3), (0.4, 1.5, -0.02), (3, 3, 0), (1, -4, 3)])
    np.testing.assert_allclose(distances(vertices, faces, cloud), [0.3, 0.02, 2**0.5, 5], atol=1e-12)


def write(path, vertices, faces=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh = trimesh.PointCloud(vertices) if faces is None else trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(path)


def command(folder, *arguments):
    """Run `python -m ...` as a user does, and return exit code and output."""
    call = [sys.executable, "-m", *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    return process.returncode, process.stdout + process.stderr


@pytest.mark.slow
def test_a_trained_run_registers_a_users_scan(file, tmp_path):
    small = ["data.train=64", "data.validation=16", "data.test=16", "data.points=200", "trainer.max_epochs=2"]
    code, output = command(
        tmp_path, "framework", "experiment=registration/quick", f"data.body={file}", *small, "batch_size=16",
        "encoder.bps.points=64", "encoder.dense_blocks.width=32", "workers=0", "logger=none", "hydra.run.dir=run",
    )  # fmt: skip
    assert code == 0, output
    results = json.loads((tmp_path / "run" / "results.json").read_text(encoding="utf-8"))
    assert results["synthetic"]
    assert 0 < results["vertex_error_median_cm"] < 100
    points = prepared(file).splits().test.__getitems__([0])
    cloud = denormalise_clouds(points["input"], points["centre"], points["scale"])[0, :400].numpy()
    np.save(tmp_path / "me.npy", cloud)
    code, output = command(
        tmp_path,
        "plugins.data.registration",
        "run",
        "me.npy",
        "--folder",
        "meshes",
        "--path",
        f"data.body={file}",
    )
    assert code == 0, output
    assert output.split() == ["meshes/me_registered.ply", "meshes/me_registered.png"]
    mesh = read(tmp_path / "meshes" / "me_registered.ply")
    assert np.array_equal(mesh.faces, doll()["f"])
    np.testing.assert_allclose(mesh.vertices[6 * 22 :], cloud, atol=1e-5)
    body = mesh.vertices[: 6 * 22]
    assert np.linalg.norm(body.mean(0) - cloud.mean(0)) < 1
    with Image.open(tmp_path / "meshes" / "me_registered.png") as image:
        assert image.size[1] > 100
    code, output = command(
        tmp_path, "plugins.data.registration", "run", "nobody.ply", "--path", f"data.body={file}"
    )
    assert code == 1
    assert "error:" in output and "nobody.ply: no such file" in output and "Traceback" not in output

    # thesis Table 6.4: a model is tested on FAUST's scans; it was trained on the body of FAUST's registrations
    batch = prepared(file, points=200).splits().test.__getitems__(range(6))
    place = batch["centre"], batch["scale"]
    meshes = denormalise_clouds(batch["target"].unflatten(1, (-1, 3)), *place).numpy()
    scans = denormalise_clouds(batch["input"], *place).numpy()
    for row, number in enumerate((0, 70, 80, 81, 90, 91)):
        training = tmp_path / "faust" / "training"
        write(training / "scans" / f"tr_scan_{number:03}.ply", scans[row][np.isfinite(scans[row]).all(1)])
        write(training / "registrations" / f"tr_reg_{number:03}.ply", meshes[row], doll()["f"])
    code, output = command(
        tmp_path, "framework", "mode=test", "checkpoint=run", "data=faust", "data.root=faust", "data.points=200",
        "metric=[vertex_error,correspondence]", "logger=none", "hydra.run.dir=faust_run",
    )  # fmt: skip
    assert code == 0, output
    results = json.loads((tmp_path / "faust_run" / "results.json").read_text(encoding="utf-8"))
    assert not results["synthetic"]
    for key in ("vertex_error_cm", "intra_cm", "inter_cm"):
        assert 0 < results[key] < 200
