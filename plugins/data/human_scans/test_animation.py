import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from framework.bodies import motion
from framework.configuration.description import Description
from framework.configuration.loading import read_stored, training_data
from framework.configuration.schema import build, resolve
from framework.datasets import scan_layout
from framework.errors import ConfigError, DataError
from framework.geometry.camera import canonical_camera
from framework.geometry.srgb import bytes_from_linear
from framework.renderer import Scene
from framework.target import Target
from framework.testing.bodies import DOLL, colored_mesh
from framework.testing.contract import contract
from framework.testing.scenes import sphere
from plugins.data.human_scans import animate, animation, flow
from plugins.data.human_scans.data import photograph
from plugins.data.human_scans.rows import SMALL
from plugins.data.human_scans.scan_generator import Crowd

RENDERER = build("renderer", resolve("renderer", {"name": "rasterizer"}))
SIZE = (60, 80)


def square(depth, side, turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0)):
    """Return the corners of a square in front of a canonical camera, rotated about its centre."""
    flat = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64) * side / 2
    turned = flat @ torch.from_numpy(Rotation.from_rotvec(turn).as_matrix()).T
    return turned + torch.tensor([*shift, depth], dtype=torch.float64)


FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])


def homography(vertices):
    """Return the homography from points of the square, in [-1, 1]², to pixels (Hartley & Zisserman 2004, eq. 8.3)."""
    focal, (across, down) = SIZE[0], canonical_camera(*SIZE).principal
    lens = torch.tensor([[focal, 0, across], [0, focal, down], [0, 0, 1]], dtype=torch.float64)
    middle = vertices.mean(0)
    return lens @ torch.stack([(vertices[1] - vertices[0]) / 2, (vertices[3] - vertices[0]) / 2, middle], 1)


def test_flow_of_a_plane_is_its_homography_and_what_is_hidden_is_not_seen():
    camera = canonical_camera(*SIZE)
    first, second = square(3.0, 1.6, (0.2, -0.3, 0.1)), square(3.2, 1.6, (-0.1, 0.4, 0.5), (0.2, -0.1))
    hiding = square(1.5, 0.3, shift=(-0.1, 0.1))  # hides a part of the first image, absent in the second
    away = hiding + torch.tensor([9.0, 0, 0])
    faces = torch.cat([FACES, FACES + 4])
    scenes = [Scene(torch.cat(pair), faces, None, camera) for pair in ((first, hiding), (second, away))]
    channels = [RENDERER(scene, flow.CHANNELS) for scene in scenes]
    place, visible = flow.flow(*scenes, *channels)
    row, column = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    wanted = (
        torch.stack([column, row, torch.ones(SIZE)], -1)
        @ (homography(first) @ homography(second).inverse()).T
    )
    wanted = wanted[..., :2] / wanted[..., 2:]
    assert visible.sum() > 500
    assert (place - wanted)[visible].abs().max() < 0.01  # pixels; the rasteriser rounds corners to 1/256
    corners = torch.tensor([[-0.25, -0.05], [0.05, 0.25]]) / 1.5  # of the hiding square
    x, y = (torch.tensor(camera.principal) + SIZE[0] * corners).T
    hidden = (
        (wanted[..., 0] > x[0]) & (wanted[..., 0] < x[1]) & (wanted[..., 1] > y[0]) & (wanted[..., 1] < y[1])
    )
    assert (hidden & (channels[1]["face"] >= 0)).sum() > 50 and not (visible & hidden).any()


def test_a_warped_picture_agrees_where_a_textured_body_turns_and_does_not_where_colours_change():
    ball = sphere(rings=60)
    place = ball.vertices
    colors = 0.5 + 0.4 * torch.stack(
        [(4 * place[:, 0]).sin(), (5 * place[:, 1]).cos(), (4 * place[:, 2]).sin()], 1
    )
    turn = torch.from_numpy(Rotation.from_rotvec([0.05, 0.1, 0.2]).as_matrix()).float()
    before = replace(ball, colors=colors, camera=replace(ball.camera))
    after = replace(before, vertices=place @ turn.T + torch.tensor([0.05, 0.0, 0.02]))
    channels = [RENDERER(scene, ("color", *flow.CHANNELS)) for scene in (before, after)]
    where, visible = flow.flow(before, after, *channels)
    assert visible.float().mean() > 0.2
    off = (flow.warp(channels[0]["color"], where) - channels[1]["color"])[visible].abs()
    still = (channels[0]["color"] - channels[1]["color"])[visible].abs()
    assert off.mean() < 0.004 < 0.05 < still.mean()
    brighter = RENDERER(replace(after, colors=colors + 0.1), ("color",))["color"]
    change = (brighter - flow.warp(channels[0]["color"], where))[visible].mean()
    assert change == pytest.approx(0.1, abs=0.002)


# a root, one leg and one arm of the CMU kind with two frames
JOINTS = {
    "Hips": (None, (0, 0, 0)), "LowerBack": ("Hips", (0, 0.1, 0)), "Spine": ("LowerBack", (0, 0.1, 0)),
    "Spine1": ("Spine", (0, 0.1, 0)), "Neck": ("Spine1", (0, 0.1, 0)), "Neck1": ("Neck", (0, 0.1, 0)),
    "Head": ("Neck1", (0, 0.1, 0)),
    **{f"{side}{name}": (above if above == "Spine1" or above == "Hips" else side + above, (x * sign, y, z))
       for side, sign in (("Left", 1), ("Right", -1))
       for name, above, (x, y, z) in (
           ("Shoulder", "Spine1", (0.1, 0, 0)), ("Arm", "Shoulder", (0.1, 0, 0)), ("ForeArm", "Arm", (0.3, 0, 0)),
           ("Hand", "ForeArm", (0.3, 0, 0)), ("UpLeg", "Hips", (0.1, 0, 0)), ("Leg", "UpLeg", (0.1, -0.4, 0)),
           ("Foot", "Leg", (0.1, -0.4, 0)))},
}  # fmt: skip


def bvh(frames):
    """Return the text of a BVH file; each frame gives degrees about z, y and x of some joints."""

    def joint(name, depth):
        word = "ROOT" if not depth else "JOINT"
        lines = [f"{word} {name}", "{", "OFFSET {} {} {}".format(*JOINTS[name][1])]
        lines.append(
            "CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation"
            if not depth
            else "CHANNELS 3 Zrotation Yrotation Xrotation"
        )
        order.append(name)
        below = [other for other, (above, _) in JOINTS.items() if above == name]
        lines += [line for other in below for line in joint(other, depth + 1)]
        return [*lines, *([] if below else ["End Site", "{", "OFFSET 0 0.1 0", "}"]), "}"]

    order: list[str] = []
    lines = ["HIERARCHY", *joint("Hips", 0), "MOTION", f"Frames: {len(frames)}", "Frame Time: 0.05"]
    for turns in frames:
        lines.append(" ".join(["1 2 3", *(" ".join(map(str, turns.get(name, (0, 0, 0)))) for name in order)]))
    return "\n".join(lines)


TURNS = {"Hips": (10, 20, -5), "LeftUpLeg": (0, 0, -40), "LeftLeg": (5, 0, 60), "RightArm": (35, 10, 20),
         "RightForeArm": (0, 50, 0), "Spine": (4, -8, 12), "LeftHand": (0, 0, 30)}  # fmt: skip


def test_frames_last_as_long_as_a_motion_file_says(tmp_path):
    file = tmp_path / "walk.bvh"
    file.write_text(bvh([{}, TURNS]))
    recorded = motion.read(file)
    assert recorded.seconds == 0.05 and recorded.rotations.shape == (2, len(JOINTS), 3, 3)
    for wrong in ("0", "-0.1", "nan", "1e9"):
        file.write_text(bvh([{}]).replace("0.05", wrong))
        with pytest.raises(DataError, match=r"walk\.bvh"):
            motion.read(file)


@pytest.fixture(scope="module")
def data():
    config = {key: value for key, value in SMALL.items() if key != "root"}
    return build("data", resolve("data", {"name": "human_scans", **config, **DOLL}))


@pytest.fixture(scope="module")
def person(data):
    return animate.generated_person(data, "test_0000")


def test_a_generated_person_is_the_data_sets_and_moves(data, person, tmp_path):
    Crowd(data.renderer, data.counts, data.drawing, data.data_seed)._write_person(tmp_path, "test", 0)
    file = tmp_path / "subjects/test_0000" / f"registration_{data.topology}.ply"
    written = scan_layout.read_registration(file)
    assert torch.equal(written.vertices, person.registration.vertices)
    assert torch.equal(written.colors, person.registration.colors)
    # in the original pose the person is unchanged, also after another pose in between
    other = person.at(0.3 * np.ones(person.stood.shape[1:]))
    again = person.at(person.stood[0].double().numpy())
    assert (again.vertices - written.vertices).abs().max() < 1e-4
    np.testing.assert_allclose(again.scan.vertices, person.first().scan.vertices, atol=1e-4)
    np.testing.assert_array_equal(again.scan.colors, person.first().scan.colors)
    assert (other.vertices - written.vertices).norm(dim=1).max() > 0.05
    assert other.vertices[:, 1].min() == pytest.approx(float(written.vertices[:, 1].min()), abs=1e-5)


def test_pictures_show_a_mesh_on_white_and_the_data_sets_photograph(data, person, tmp_path):
    Crowd(data.renderer, data.counts, data.drawing, data.data_seed)._write_person(tmp_path, "test", 0)
    view = scan_layout.read_subject(tmp_path, "test_0000", data.topology).views[1]
    written = bytes_from_linear(photograph(view)[0]).numpy()
    shot = animation.photograph(data.renderer, person.first().scan, view.camera)
    assert (
        np.abs(shot.astype(int) - written).max() <= 1
    )  # the file's colours are rounded before compositing on white
    scene = animation.actor(person.registration).scene(person.first(), view.camera)
    image = animation.on_white(RENDERER, scene)
    channels = RENDERER(scene, ("mask", "color"))
    assert (image[~channels["mask"]] == 255).all()
    assert torch.equal(
        torch.from_numpy(image)[channels["mask"]], bytes_from_linear(channels["color"])[channels["mask"]]
    )


@pytest.mark.parametrize("walks", [False, True])
def test_a_run_and_a_motion_become_pictures_side_by_side(data, tmp_path, walks, capsys, monkeypatch):
    run = contract("renderer", "smplpix").rows[0].config["checkpoint"]
    description, _ = read_stored(run)
    height, width = training_data(description, "human_scans").size
    # data of a doll, because the run's own data needs the default body
    monkeypatch.setattr(animate, "training_data", lambda description, name: data)
    (tmp_path / "walk.bvh").write_text(bvh([{}, TURNS, {}]))
    arguments = [run, "--frames", "3", "--out", str(tmp_path / "new/film.gif")]
    animate.main([*arguments, *(["test_0001", "--motion", str(tmp_path / "walk.bvh")] if walks else [])])
    assert "film.gif" in capsys.readouterr().out
    with Image.open(tmp_path / "new/film.gif") as film:
        assert film.n_frames == 3 and film.size == (3 * width, height + 2 * animation.CAPTION)
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(1)
        second = np.asarray(film.convert("RGB")).astype(int)
    assert np.abs(first - second).max() > 50  # the person moves


def test_cameras_see_all_of_somebody_from_everywhere(person):
    moments = [person.first(), person.at(0.2 * np.ones(person.stood.shape[1:]))]
    every = torch.cat([moment.vertices for moment in moments])
    fullest = 0.0
    for camera in animation.orbit(moments, [0.0, 0.5, 1.6, 3.0, -2.0], SIZE):
        assert torch.linalg.det(camera.rotation).item() == pytest.approx(1, abs=1e-5)
        place, depth = camera.project(every)
        share = (place - torch.tensor(camera.principal)).abs() * 2 / torch.tensor(SIZE[::-1])
        assert (depth > 0).all() and share.max() < animation.FREE + 1e-4
        fullest = max(fullest, share.max().item())
    assert fullest == pytest.approx(animation.FREE, abs=1e-3)  # and no smaller than necessary


def frames(count):
    pixels = np.random.default_rng(0).integers(0, 256, (count, 40, 32, 3), np.uint8)
    pixels[:, :20] = 255
    pictures = [{"mesh": image, "photograph": 255 - image} for image in pixels]
    return [animation.side_by_side(copy.copy(image), synthetic=True) for image in pictures]


@pytest.mark.parametrize("kind", [".gif", ".webp"])
def test_pictures_become_a_film_on_white(kind, tmp_path):
    sheets = frames(5)
    animate.write(tmp_path / f"film{kind}", sheets)
    with Image.open(tmp_path / f"film{kind}") as film:
        # the note that the images are synthetic stands below their names
        assert film.n_frames == 5 and film.size == (64, 40 + 2 * animation.CAPTION)
        film.seek(3)
        assert np.asarray(film.convert("RGB"))[:12, :32].min() >= (
            255 if kind == ".gif" else 250
        )  # the background


def test_a_note_about_wide_images_stands_beside_their_names():
    image = np.zeros((40, 200, 3), np.uint8)
    for synthetic in (True, False):
        sheet = animation.side_by_side({"mesh": image, "photograph": image}, synthetic)
        assert sheet.size == (400, 40 + animation.CAPTION)


def test_a_film_needs_its_program_and_people_who_are_there(data, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DataError, match="ffmpeg"):
        animate.write(tmp_path / "film.mp4", frames(2))
    other = Description({"data": {"name": "moons"}}, Target("class", ("a",)), (2,), (), True, path="a.ckpt")
    with pytest.raises(ConfigError, match=r"a\.ckpt was trained on data 'moons'"):
        training_data(other, "human_scans")
    with pytest.raises(DataError, match="Did you mean 'test_000"):
        animate.cast(data, "test_000", None, 2)
    mesh = tmp_path / "own.ply"
    scan_layout.write_registration(mesh, colored_mesh(0))
    shown, moments = animate.cast(data, str(mesh), None, 2)
    assert len(moments) == 2 and len(shown.colors) == 40
    with pytest.raises(ConfigError, match="its body model is unknown"):
        animate.cast(data, str(mesh), tmp_path / "walk.bvh", 2)
    (tmp_path / "walk.bvh").write_text(bvh([{}, TURNS]))
    with pytest.raises(ConfigError, match="Lower --frames"):
        animate.cast(data, None, tmp_path / "walk.bvh", 50)
