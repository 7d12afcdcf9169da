"""Tests of the command: content of images, cameras compared with formulas, videos, and messages for mistakes."""

import io
import json
import math
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from framework.errors import ConfigError, DataError, UserError
from framework.geometry.camera import look_from
from framework.geometry.srgb import linear_from_bytes
from framework.scenes import pictures, turntable
from framework.scenes.scene_files import read
from plugins.renderer.rasterizer.__main__ import main
from plugins.renderer.rasterizer.renderer import Rasterizer

SIDES = {(1, 0, 0): "#ff0000", (-1, 0, 0): "#00ff00", (0, 1, 0): "#0000ff", (0, -1, 0): "#ffff00",
         (0, 0, 1): "#ff8040", (0, 0, -1): "#305070"}  # fmt: skip
"""Colours of a cube's sides, by the direction that each side faces."""


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a cube of side 2 around (5, 6, 7) whose sides have different colours."""
    mesh = trimesh.creation.box((2, 2, 2))
    mesh.unmerge_vertices()
    colors = np.zeros((len(mesh.vertices), 4), np.uint8)
    for face, normal in zip(mesh.faces, mesh.face_normals, strict=True):
        text = SIDES[tuple(int(part) for part in normal.round())]
        colors[face] = [*bytes.fromhex(text[1:]), 255]
    mesh.visual.vertex_colors = colors
    mesh.apply_translation((5, 6, 7))
    file = tmp_path_factory.mktemp("cube") / "cube.ply"
    mesh.export(file)
    return file


def run_command(file: Path, folder: Path, *options: str, name: str = "one.png") -> Any:
    out = folder / name
    main([str(file), "--out", str(out), "--size", "48x40", *options])
    return np.load(out) if out.suffix == ".npy" else Image.open(io.BytesIO(out.read_bytes()))


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_cube_shows_the_side_that_the_camera_faces(cube: Path, tmp_path: Path, up: str) -> None:
    """Check that azimuth 0 shows the front (z for y up, -y for z up), azimuth 90 its right, elevation 90 the top."""
    front, right, top = ((0, 0, 1), (1, 0, 0), (0, 1, 0)) if up == "y" else ((0, -1, 0), (1, 0, 0), (0, 0, 1))
    opposite = lambda side: tuple(-part for part in side)  # noqa: E731
    views = {(0, 0): front, (90, 0): right, (180, 0): opposite(front), (270, 0): opposite(right), (0, 90): top,
             (0, -90): opposite(top)}  # fmt: skip
    for (azimuth, elevation), side in views.items():
        image = run_command(cube, tmp_path, "--azimuth", f"{azimuth}", "--elevation", f"{elevation}", "--up", up,
                      "--background", "#123456")  # fmt: skip
        pixels = np.asarray(image)
        assert image.mode == "RGB" and image.size == (48, 40)
        assert pixels[20, 24].tolist() == [*bytes.fromhex(SIDES[side][1:])]
        assert pixels[0, 0].tolist() == [0x12, 0x34, 0x56]
        middle = np.argwhere((pixels != [0x12, 0x34, 0x56]).any(2)).mean(0)
        np.testing.assert_allclose(middle, [19.5, 23.5], atol=0.05)


@pytest.mark.parametrize("name", ["one.glb", "one.obj"])
def test_a_texture_is_drawn_upright_and_in_its_colours(tmp_path: Path, name: str) -> None:
    """Check red and green above, blue and white below, seen from the front. The colours are exact at texel centres."""
    four = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    square = trimesh.Trimesh(
        [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    white = trimesh.visual.material.SimpleMaterial(Image.fromarray(four), diffuse=[255] * 4)
    square.visual = trimesh.visual.TextureVisuals(uv, material=white)
    square.export(tmp_path / name)
    out = tmp_path / "seen.png"
    fov = 2 * math.degrees(math.atan(1 / 5))
    view = [
        "--azimuth",
        "0",
        "--elevation",
        "0",
        "--distance",
        "5",
        "--fov",
        f"{fov}",
        "--supersampling",
        "1",
    ]
    # an odd number of pixels per texel
    main([str(tmp_path / name), *view, "--size", "42x42", "--no-shade", "--out", str(out)])
    pixels = np.asarray(Image.open(io.BytesIO(out.read_bytes())), int)
    texel_centres = pixels[[[10, 10], [31, 31]], [[10, 31], [10, 31]]]
    assert np.abs(texel_centres - four).max() <= 1


def test_edges_are_blended_in_linear_rgb_and_alpha_is_coverage(cube: Path, tmp_path: Path) -> None:
    """Compare a transparent image, composited over a background, with an image that is drawn with this background."""
    options = ("--azimuth", "40", "--elevation", "30", "--supersampling", "4")
    clear = np.asarray(run_command(cube, tmp_path, *options, "--background", "transparent"))
    assert clear.shape == (40, 48, 4) and {0, 255} < set(clear[..., 3].ravel().tolist())
    share = torch.from_numpy(clear[..., 3:] / 255)
    for text in ("#000000", "#ffffff", "#40c0f0"):
        behind = linear_from_bytes(torch.tensor([*bytes.fromhex(text[1:])], dtype=torch.uint8))
        light = linear_from_bytes(torch.from_numpy(clear[..., :3].copy())) * share + behind * (1 - share)
        opaque = linear_from_bytes(
            torch.from_numpy(np.array(run_command(cube, tmp_path, *options, "--background", text)))
        )
        assert float((light - opaque).abs().max()) < 0.02


def test_depth_mask_and_face_files_hold_the_channels_of_the_renderer(cube: Path, tmp_path: Path) -> None:
    options = ("--azimuth", "0", "--elevation", "0", "--distance", "4", "--channel")
    exact = run_command(cube, tmp_path, *options, "depth", name="one.npy")
    assert exact.dtype == np.float32 and exact.shape == (40, 48) and abs(exact[20, 24] - 3) < 1e-6
    millimetres = np.asarray(run_command(cube, tmp_path, *options, "depth"))
    np.testing.assert_array_equal(millimetres, np.where(np.isfinite(exact), np.round(1000 * exact), 0))
    mask = np.asarray(run_command(cube, tmp_path, *options, "mask"))
    np.testing.assert_array_equal(mask, np.where(np.isfinite(exact), 255, 0))
    faces = np.asarray(run_command(cube, tmp_path, *options, "face")).astype(int) - 1
    np.testing.assert_array_equal(faces, run_command(cube, tmp_path, *options, "face", name="one.npy"))
    assert faces.min() == -1 and faces.max() < 12
    with pytest.raises(DataError, match=r"has a depth of \d+\.\d+ m, but 16 bits hold .* Write a \.npy"):
        run_command(cube, tmp_path, "--distance", "200", "--channel", "depth", "--fov", "1")


def test_channels_are_encoded_as_documented() -> None:
    directions = torch.tensor([[[0.0, 0, 1], [-1, 0, 0], [0, 0, 0]]])
    assert pictures.normal_image(directions).tolist() == [[[128, 128, 255], [0, 128, 128], [0, 0, 0]]]
    assert pictures.uv_image(torch.tensor([[[0.2, 1.6], [-0.2, 0.0]]])).tolist() == [
        [[51, 153, 0], [204, 0, 0]]
    ]
    assert pictures.barycentric_image(torch.tensor([[[0.2, 0.8, 0.0]]])).tolist() == [[[51, 204, 0]]]
    with pytest.raises(DataError, match="shows face 65535"):
        pictures.face_image(torch.tensor([[65535]], dtype=torch.int32))
    assert set(pictures.INTEGER_IMAGES) | {"color"} >= Rasterizer.channels


def test_a_sphere_of_one_colour_is_lit_from_the_camera(tmp_path: Path) -> None:
    """Check Lambert's law with smooth normals on a sphere, and flat normals at the edges of a cube."""
    trimesh.creation.icosphere(4, 1.0).export(tmp_path / "ball.stl")
    pixels = run_command(
        tmp_path / "ball.stl", tmp_path, "--distance", "50", "--fov", "2.6", "--background", "black"
    )
    shown = linear_from_bytes(torch.from_numpy(np.array(pixels))).numpy()[..., 0] / 0.55
    rows, columns = np.mgrid[:40, :48]
    radius = 20 / math.tan(math.radians(1.3)) / 50
    square = ((rows - 19.5) ** 2 + (columns - 23.5) ** 2) / radius**2
    inside = square < 0.85
    wanted = pictures.AMBIENT + (1 - pictures.AMBIENT) * np.sqrt(np.clip(1 - square, 0, 1))
    assert np.abs(shown - wanted)[inside].max() < 0.03
    flat = np.asarray(run_command(tmp_path / "ball.stl", tmp_path, "--no-shade", "--background", "black"))
    assert len(np.unique(flat[15:25, 20:28])) == 1
    box = trimesh.creation.box((1, 1, 1))
    normals = pictures.corner_normals(box.vertices, box.faces).reshape(12, 3, 3)
    np.testing.assert_allclose(normals, np.repeat(box.face_normals[:, None], 3, 1), atol=1e-9)
    ball = trimesh.creation.icosphere(3, 1.0)
    normals = pictures.corner_normals(ball.vertices, ball.faces)
    assert (np.sum(normals * ball.vertices[ball.faces.ravel()], 1) > 0.9999).all()


def test_the_camera_equals_look_from_and_shows_the_whole_subject() -> None:
    """Check cameras around any centre, and that the sphere just fits into images of any shape."""
    random = np.random.default_rng(0)
    for _ in range(10):
        centre = torch.from_numpy(random.normal(size=3) * 100)
        angles = tuple(random.uniform(-3, 3, 3).tolist())
        size = (int(random.integers(9, 99)), int(random.integers(9, 99)))
        sphere, fov = (
            turntable.BoundingSphere(centre, float(random.uniform(0.01, 100))),
            float(random.uniform(0.2, 2)),
        )
        camera = turntable.look_at(sphere, "z", angles, 7.0, fov, size)
        expected = look_from(*angles, 7.0, fov, size)
        points = torch.from_numpy(random.normal(size=(5, 3)))
        for ours, theirs in zip(camera.project(points + centre), expected.project(points), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
        fitted = turntable.look_at(sphere, "y", angles, None, fov, size)
        rim = torch.nn.functional.normalize(torch.from_numpy(random.normal(size=(5_000, 3))), dim=1)
        places, depths = fitted.project(sphere.radius * rim + centre)
        assert (depths > fitted.near).all()
        far = (places - torch.tensor(fitted.principal)).abs().amax(0)
        share = far / torch.tensor([size[1] / 2, size[0] / 2])
        assert (share <= 1).all() and float(share.max()) > 0.88


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_turntable_is_a_whole_turn_in_equal_steps(up: turntable.Axis) -> None:
    sphere = turntable.BoundingSphere(torch.tensor([3.0, -2.0, 8.0], dtype=torch.float64), 2.0)
    cameras = [
        turntable.look_at(sphere, up, (0.3 + 2 * math.pi * number / 7, 0.4, 0.1), 9.0, 0.7, (40, 48))
        for number in range(7)
    ]
    circle = [*turntable.circle_cameras(cameras[0], sphere.centre, up, 7)]
    assert len(circle) == 7 and circle[0] is cameras[0]
    after = turntable.rotate_camera(circle[-1], sphere.centre, up, 2 * math.pi / 7)
    for ours, theirs in [*zip(circle, cameras, strict=True), (after, cameras[0])]:
        torch.testing.assert_close(ours.rotation, theirs.rotation, rtol=0, atol=1e-12)
        torch.testing.assert_close(ours.translation, theirs.translation, rtol=0, atol=1e-11)


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_a_camera_file_projects_points_by_its_formula(cube: Path, tmp_path: Path, suffix: str) -> None:
    values = {"K": [[60, 0, 20.5], [0, 55, 18], [0, 0, 1]], "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]]}
    values |= {"t": [-5.2, 6.1, 14], "size": [44, 40]}
    file = tmp_path / f"camera.{suffix}"
    file.write_text(json.dumps(values))
    main([str(cube), "--camera", str(file), "--channel", "depth", "--out", str(tmp_path / "one.npy")])
    depth = np.load(tmp_path / "one.npy")
    assert depth.shape == (40, 44)
    # the front side, z = 8, is 6 metres away; it covers the pixel centres between its projected corners
    low, high = 60 * np.array([-1.2, 0.8]) / 6 + 20.5, 55 * np.array([-0.9, 1.1]) / 6 + 18
    inside = np.argwhere(np.abs(depth - 6) < 1e-5)
    assert inside.min(0).tolist() == [math.ceil(high[0]), math.ceil(low[0])]
    assert inside.max(0).tolist() == [math.floor(high[1]), math.floor(low[1])]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"K": [[60, 1, 20], [0, 60, 18], [0, 0, 1]]}, "the camera matrix K is"),
        ({"K": [[-60, 0, 20], [0, 60, 18], [0, 0, 1]]}, "fx and fy above 0"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "determinant of R is -1"),
        ({"R": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}, "the matrix R is not a rotation"),
        ({"R": "x"}, "R is 'x', expected 3 x 3 finite numbers"),
        ({"t": [0, 0, float("nan")]}, "the camera's t is"),
        ({"t": None}, "the camera's t is"),
        ({"size": [640.5, 480]}, "the camera's size is"),
        ({"size": [0, 480]}, "the camera's size is"),
        (
            {"sise": [640, 480]},
            "the entry 'sise' is unknown. The entries of a camera are K, R, t, size. Did you mean 'size'?",
        ),
    ],
)
def test_a_bad_camera_file_raises_a_clear_message(
    tmp_path: Path, change: dict[str, Any], sentence: str
) -> None:
    values = {"K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "t": [0, 0, 1], "size": [4, 4]}
    for file in (tmp_path / "camera.json", tmp_path / "camera.yaml"):
        file.write_text(json.dumps(values))
        assert turntable.read_camera(file).width == 4
        file.write_text(
            json.dumps({**values, **change}).replace("NaN", ".nan" if file.suffix == ".yaml" else "NaN")
        )
        with pytest.raises(DataError) as caught:
            turntable.read_camera(file)
        assert sentence in str(caught.value) and str(file) in str(caught.value)


def test_a_gif_has_all_frames_and_begins_with_the_still_image(cube: Path, tmp_path: Path) -> None:
    film = run_command(cube, tmp_path, "--turntable", "5", "--rate", "20", name="one.gif")
    assert (
        film.n_frames == 5
        and film.size == (48, 40)
        and film.info["duration"] == 50
        and film.info["loop"] == 0
    )
    for number in range(5):
        film.seek(number)
        still = np.asarray(run_command(cube, tmp_path, "--azimuth", f"{30 + 72 * number}"), float)
        assert np.abs(still - np.asarray(film.convert("RGB"))).max() <= 8  # a frame has 256 colours
    stacked = run_command(cube, tmp_path, "--turntable", "5", "--channel", "depth", name="one.npy")
    assert stacked.shape == (5, 40, 48)


def write_ffmpeg(folder: Path, text: str) -> None:
    file = folder / "ffmpeg"
    file.write_text(f"#!{sys.executable}\nimport sys\n{text}\n")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)


def test_ffmpeg_receives_the_frames_of_a_video(
    cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Replace ffmpeg by a program that stores its input, by a program that fails, and by no program."""
    monkeypatch.setenv("PATH", str(tmp_path))
    out = tmp_path / "films" / "one.mp4"
    options = [str(cube), "--turntable", "3", "--size", "48x40", "--out", str(out)]
    with pytest.raises(ConfigError, match=r"an \.mp4 requires the program ffmpeg.*choose a \.gif"):
        main(options)
    write_ffmpeg(tmp_path, "content = sys.stdin.buffer.read()\nopen(sys.argv[-1], 'wb').write(content)")
    main(options)
    frames = np.frombuffer(out.read_bytes(), np.uint8).reshape(3, 40, 48, 3)
    for number in range(3):
        still = np.asarray(run_command(cube, tmp_path, "--azimuth", f"{30 + 120 * number}"), int)
        assert np.abs(still - frames[number]).max() <= 1
    out.unlink()
    write_ffmpeg(tmp_path, "sys.stderr.write('no such codec'); sys.exit(3)")
    with pytest.raises(
        DataError, match=r"ffmpeg failed with exit code 3 and the message: no such codec\. Choose a \.gif"
    ):
        main(options)
    assert list(out.parent.iterdir()) == []
    with pytest.raises(ConfigError, match=r"got 47x40 pixels, but an .mp4 requires an even"):
        main([*options[:3], "--size", "47x40", *options[5:]])


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--fov", "300"], "argument --fov: got '300', expected a number from 0.1 to 170 degrees."),
        (["--azimuth", "nan"], "expected a number from -3600 to 3600 degrees"),
        (["--distance", "-1"], "(metres), or auto"),
        (["--size", "640"], "expected WIDTHxHEIGHT in pixels"),
        (["--size", "0x9"], "expected WIDTHxHEIGHT in pixels"),
        (["--size", "9999x9999"], "samples are possible. Choose a smaller --size or --supersampling"),
        (["--turntable", "2.5"], "got '2.5', expected a whole number from 2 to 3600"),
        (["--supersampling", "0"], "expected a whole number from 1 to 16"),
        (["--channel", "dept"], "expected one of barycentric, color, depth, face, mask, normal, uv."),
        (["--channel", "uv"], "the scene has no texture"),
        (["--channel", "dept"], "Did you mean 'depth'? --help"),
        (["--background", "whit"], "Did you mean 'white'?"),
        (["--azimut", "3"], "Did you mean '--azimuth'?"),
        (["--up", "x"], "invalid choice: 'x'"),
        (["--out", "one.jpeg"], "expected a file name that ends in .png, .gif, .mp4, .npy. Did you mean '.png'?"),
        (["--out", "one.gif"], "requires --turntable with a number of frames"),
        (["--out", "one.png", "--turntable", "9"], "holds a single image. Use .gif, .mp4 or .npy"),
        (["--out", "one.gif", "--turntable", "9", "--channel", "depth"], "an animation cannot hold the numbers of "
            "--channel depth"),
        (["--out", "one.gif", "--turntable", "9", "--background", "transparent"], "only for --channel color and a "
            ".png file"),
        (["--camera", "gone.json", "--fov", "40"], "got both --fov and --camera, whose file determines the whole view"),
        (["--camera", "gone.json"], "gone.json: no such file; expected a camera"),
        (["--camera", "cube.ply"], "Give a file whose name ends in .json or .yaml"),
    ],
)  # fmt: skip
def test_every_mistake_raises_one_line_and_leaves_no_file(
    cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as caught:
        main([str(cube), *options])
    assert sentence in str(caught.value) and "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_the_command_prints_the_path_and_the_report_on_request(
    cube: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    main([str(cube), "--size", "9x9"])
    assert capsys.readouterr() == ("outputs/cube.png\n", "")
    main([str(cube), "--size", "9x9", "--report"])
    report = capsys.readouterr().err
    assert "ms per frame (median of 1)" in report and len(report.splitlines()) <= 2


def test_extreme_subjects_are_drawn_or_raise_a_clear_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check that the image does not depend on the size and position of the subject, up to a limit."""
    ball = trimesh.creation.icosphere(2)
    shown = []
    for scale, move in ((1.0, 0.0), (1e-20, 0.0), (1e29, 0.0), (1e-3, 1e6), (1e40, 0.0)):
        vertices = ball.vertices * scale + move
        lines = [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + [
            f"3 {a} {b} {c}" for a, b, c in ball.faces
        ]
        (tmp_path / "ball.off").write_text("\n".join([f"OFF\n{len(vertices)} {len(ball.faces)} 0", *lines]))
        if scale == 1e40:
            with pytest.raises(
                DataError, match=r"ball\.off: a coordinate of the scene is larger than 1e\+30"
            ):
                run_command(tmp_path / "ball.off", tmp_path)
        else:
            shown.append(np.asarray(run_command(tmp_path / "ball.off", tmp_path), int))
    assert len(np.unique(shown[0])) > 20
    assert all(np.abs(image - shown[0]).max() <= 2 for image in shown)
    assert "no face" not in capsys.readouterr().err
    (tmp_path / "flat.off").write_text("OFF\n3 1 0\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n")
    assert len(np.unique(np.asarray(run_command(tmp_path / "flat.off", tmp_path)))) == 1
    assert "flat.off: no face of the scene is visible in the last image." in capsys.readouterr().err


def test_the_program_ends_with_a_message_and_no_stack_trace(cube: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        main([str(cube), "--size", "9x9", "--out", str(tmp_path / "file" / "inner" / "one.png")])
    command = [sys.executable, "-m", "plugins.renderer.rasterizer", str(cube), "--size", "9x9", "--out"]
    process = subprocess.run([*command, "/proc/none/one.png"], capture_output=True, text=True, timeout=60)
    assert process.returncode == 1 and process.stdout == ""
    assert (
        process.stderr
        == "error: /proc/none cannot be written (No such file or directory). Choose another path.\n"
    )


def test_the_same_mesh_as_obj_and_glb_gives_the_same_image(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.unmerge_vertices()
    uv = np.random.default_rng(2).uniform(0, 1, (len(mesh.vertices), 2))
    texture = np.random.default_rng(3).integers(0, 256, (8, 8, 3)).astype(np.uint8)
    mesh.visual = trimesh.visual.TextureVisuals(uv, image=Image.fromarray(texture))
    shown = []
    for name in ("one.glb", "one.obj"):
        mesh.export(tmp_path / name)
        shown.append(np.asarray(run_command(tmp_path / name, tmp_path, "--shade"), int))
        assert not read(tmp_path / name).notes
    assert np.abs(shown[0] - shown[1]).max() <= 1 and len(np.unique(shown[0])) > 3
