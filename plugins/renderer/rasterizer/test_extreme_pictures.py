"""Tests of images and reports of extreme scenes: they are right, or an error is raised."""

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.renderer import Scene, join_scenes
from plugins.renderer.rasterizer.drawing import Gradient, Saving
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_extreme import (
    EVERY,
    KINDS,
    SCENES,
    ahead,
    crossing,
    find_bad_gradients,
    make_scene,
    random_scene,
    require_gradients,
)

SAVINGS = get_args(Saving)


@pytest.mark.slow
@settings(deadline=None, max_examples=150, derandomize=True)
@given(
    st.integers(0, 2**32 - 1),
    st.booleans(),
    st.sets(st.sampled_from(SAVINGS)),
    st.sets(st.sampled_from(EVERY), min_size=1),
)
def test_each_face_is_counted_once_and_savings_change_no_bit_in_random_scenes(
    seed: int, cull: bool, savings: set[Saving], channels: set[str]
) -> None:
    """Check that a second image, which reuses what has not changed, has the same report."""
    scene = random_scene(seed)
    renderer = Rasterizer(cull=cull, savings=tuple(savings))
    plain = Rasterizer(cull=cull, savings=())(scene, channels)
    for _ in range(2):
        image, report = renderer(scene, channels), renderer.report
        assert report is not None
        assert report.faces == len(scene.faces) == report.drawn_faces + sum(report.left_out.values())
        assert report.drawn_faces >= 0 and all(count > 0 for count in report.left_out.values())
        assert all(torch.equal(image[name], plain[name]) for name in channels)
        if "face" in channels:
            shown = image["face"].unique()
            assert len(shown[shown >= 0]) <= report.drawn_faces


def with_number(scene: Scene, where: str, number: float) -> Scene:
    """Return the scene with a non-finite number in one input; inputs per vertex get it at vertex 0."""
    camera, texture = scene.camera, scene.texture
    assert scene.colors is not None and texture is not None
    first = torch.zeros(len(scene.vertices), dtype=torch.bool)
    first[0] = True
    if where == "vertices":
        return replace(scene, vertices=scene.vertices.where(~first[:, None], number))
    if where == "colors":
        return replace(scene, colors=scene.colors.where(~first[:, None], number))
    if where == "uv":
        return replace(scene, texture=replace(texture, uv=texture.uv.where(~first[:, None], number)))
    if where == "texels":
        image = texture.images[0].clone()
        image[0, 0] = number
        return replace(scene, texture=replace(texture, images=(image,)))
    if where in ("rotation", "translation"):
        return replace(
            scene, camera=replace(camera, **{where: torch.full_like(getattr(camera, where), number)})
        )
    return replace(scene, camera=replace(camera, **{where: number if where == "near" else (number, 1.0)}))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "where", ["vertices", "colors", "uv", "texels", "rotation", "translation", "focal", "principal", "near"]
)
def test_non_finite_numbers_raise_an_error_or_affect_only_their_own_faces(where: str, number: float) -> None:
    first = [[-0.4, -0.3, 1.0], [0.3, -0.35, 1], [0, 0.3, 1]]
    scene = make_scene([*first, *crossing()[:27] + np.array([0, 0, 0.5])], ahead(24, 32, focal=20.0))
    bad = with_number(scene, where, number)
    if where not in ("vertices", "colors", "texels"):
        with pytest.raises(ValueError, match="not finite"):
            Rasterizer()(bad, EVERY)
        return
    plain, channels = Rasterizer()(scene, EVERY), Rasterizer()(bad, EVERY)
    untouched = plain["face"] != 0
    assert untouched.any() and (~untouched).any()
    if where == "vertices":
        rest = Rasterizer()(
            replace(scene, faces=torch.cat([torch.zeros_like(scene.faces[:1]), scene.faces[1:]])), EVERY
        )
        assert all(torch.equal(rest[name], channels[name]) for name in EVERY)
        assert all(channels[name].isfinite().all() for name in ("color", "normal", "barycentric", "uv"))
        return
    assert all(torch.equal(channels[name], plain[name]) for name in EVERY if name != "color")
    if where == "colors":
        assert torch.equal(channels["color"][untouched], plain["color"][untouched])
    else:
        same = (channels["color"] == plain["color"]).all(-1)
        assert same[~plain["mask"]].all() and 0.3 < same.float().mean() < 1
    # the number has no effect out of view
    away = replace(bad, camera=replace(bad.camera, translation=torch.tensor([0.0, 0, -50])))
    assert not Rasterizer()(away)["color"].any()


def test_a_face_seen_edge_on_is_invisible_and_nearly_edge_on_faces_leave_no_hole() -> None:
    vertices = [[0, -1, 1.0], [0, 1, 1], [0, 0, 3], [-1, 0, 1], [1, 0, 1], [0, 0, 4]]
    assert not Rasterizer()(make_scene(vertices, ahead()), ("mask",))["mask"].any()
    for lift in 10.0 ** np.arange(-12, 0):
        roof = make_scene([[-9, -9, 3.0], [9, -9, 3], [9, lift, 3], [-9, lift, 3], [9, 9, 3], [-9, 9, 3], [0, lift, 1]],
                      ahead(), [[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5], [3, 6, 2], [2, 6, 3]])  # fmt: skip
        channels = Rasterizer()(roof, ("mask", "face"))
        assert channels["mask"].all()


def test_intersecting_planes_show_the_nearer_one() -> None:
    camera = ahead(40, 50, focal=32.0)
    corners = [
        [-9, -9, 5.0],
        [9, -9, 5],
        [9, 9, 1],
        [-9, 9, 1],
        [-9, -9, 1],
        [9, -9, 1],
        [9, 9, 5],
        [-9, 9, 5],
    ]
    scene = make_scene(corners, camera, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    channels = Rasterizer()(scene, ("depth", "face"))
    down = (torch.arange(40).double() - camera.principal[1]) / 32.0
    depths = torch.stack([3 / (1 + 2 / 9 * down), 3 / (1 - 2 / 9 * down)])
    assert torch.allclose(channels["depth"].double(), depths.amin(0)[:, None].expand(40, 50), rtol=1e-3)
    assert torch.equal(channels["face"] // 2, depths.argmin(0)[:, None].expand(40, 50).int())


@pytest.mark.parametrize("depth", [0.0, -1e-300, 1e-300, 1e-3, -1.0])
def test_a_vertex_on_the_plane_of_the_camera_hides_no_part_of_its_face(depth: float) -> None:
    """Check the depth along each ray of a floor that begins beside, before or behind the camera."""
    camera = ahead(30, 40, focal=16.0)
    scene = make_scene(
        [[-50, 1, depth], [50, 1, depth], [50, 1, 50], [-50, 1, 50]], camera, [[0, 1, 2], [0, 2, 3]]
    )
    channels = Rasterizer()(scene, ("depth",))["depth"].double()
    down = (torch.arange(30).double() - camera.principal[1]) / 16.0
    true = (1 / down).where((down > 0) & (1 / down < 50), math.inf)[:, None].expand(30, 40)
    assert torch.allclose(channels, true, rtol=1e-3)


@pytest.mark.slow
def test_the_nearest_of_a_million_faces_in_one_pixel_is_visible() -> None:
    random = np.random.default_rng(0)
    depth = random.permutation(np.linspace(1, 2, 1_000_000))
    shape = np.array([[-0.02, -0.02], [0.02, -0.02], [0, 0.03]])  # a third of a pixel
    corners = np.concatenate(
        [shape * depth[:, None, None], np.broadcast_to(depth[:, None, None], (len(depth), 3, 1))], 2
    )
    scene = make_scene(corners, ahead())
    for savings in (("box",), SAVINGS):
        renderer = Rasterizer(savings=savings)
        channels = renderer(scene, ("face", "depth"))
        assert channels["face"][4, 5] == depth.argmin() and channels["depth"][4, 5] == 1
        assert (channels["face"] >= 0).sum() == 1 and renderer.report is not None
        assert renderer.report.drawn_faces + renderer.report.left_out.get("hidden", 0) == len(depth)


@pytest.mark.parametrize("gradient", KINDS)
def test_gradients_of_a_hundred_thousand_faces_in_one_pixel_are_finite(gradient: Gradient) -> None:
    shape = np.array([[-0.04, -0.04, 0], [0.04, -0.04, 0], [0, 0.06, 0]])
    corners = shape + np.array([0, 0, 1]) * np.linspace(2, 1, 100_000)[:, None, None]
    assert not find_bad_gradients(
        make_scene(corners, ahead(1, 1)), Rasterizer(gradient=gradient), torch.float32
    )


def test_an_image_does_not_depend_on_the_unit_of_length_or_the_focal_length() -> None:
    """Check focal lengths from 0.001 to 1,000,000 pixels, with all depths scaled by the same factor."""
    pixels = crossing()
    pictures = []
    for power in range(-10, 21):
        focal = 2.0**power
        camera = ahead(20, 24, near=focal * 2.0**-10, focal=focal)
        corners = np.concatenate([8 * pixels[:, :2] * pixels[:, 2:], focal * pixels[:, 2:]], 1)
        channels = Rasterizer()(make_scene(corners, camera), ("face", "mask", "color", "depth"))
        channels["depth"] /= focal
        pictures.append(channels)
    assert pictures[0]["mask"].float().mean() > 0.2
    for channels in pictures[1:]:
        assert all(torch.equal(channels[name], pictures[0][name]) for name in channels)


def test_millimetres_are_resolved_a_million_metres_from_the_origin() -> None:
    """Check vertices and camera in float64; float32 would only resolve 6 cm at this distance."""
    far = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    turn = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )[0]
    turn = turn * turn.det()
    shape = crossing() * 1e-3 + np.array([0, 0, 0.05])
    camera = replace(
        ahead(40, 50, focal=900.0), rotation=torch.eye(3).double(), translation=torch.zeros(3).double()
    )
    near = make_scene(shape, camera)
    distant = replace(
        near,
        vertices=near.vertices @ turn + far,
        camera=replace(camera, rotation=turn, translation=-turn @ far),
    )
    near_image, distant_image = (Rasterizer()(scene, EVERY) for scene in (near, distant))
    assert near_image["mask"].float().mean() > 0.2
    assert (
        near_image["face"] != distant_image["face"]
    ).float().mean() < 2e-3  # because of corners halfway between two grid points
    same = (near_image["face"] == distant_image["face"]) & near_image["mask"]
    assert (near_image["depth"] - distant_image["depth"])[same].abs().max() < 1e-6


def test_the_largest_images() -> None:
    """Draw 4096 × 4096 pixels, with one face over the whole image and one in a corner."""
    camera = ahead(4096, 4096, focal=2048.0)
    corners = [[-3, -3, 1.0], [9, -3, 1], [-3, 9, 1], [0.9, 0.9, 0.9], [0.9, 0.8, 0.9], [0.8, 0.9, 0.9]]
    scene = replace(make_scene(corners, camera), texture=None)
    channels = Rasterizer()(scene, ("color", "face"))
    assert (channels["face"] >= 0).all() and channels["color"].shape == (4096, 4096, 3)
    assert (
        abs(int(channels["face"].sum()) - (0.1 / 0.9 * 2048) ** 2 / 2) < 300
    )  # area of the small face in pixels
    assert channels["color"].isfinite().all() and channels["color"].min() > 0


@pytest.mark.parametrize("gradient", KINDS)
def test_empty_scenes_give_the_background_and_no_gradient(gradient: Gradient) -> None:
    for name in ("no faces", "behind", "degenerate", "all in one point"):
        scene = SCENES[name]()
        if name == "degenerate":
            scene = make_scene(scene.vertices.numpy(), ahead(), [[0, 0, 1], [1, 1, 1]])
        differentiable, parts = require_gradients(scene, torch.float32, gradient != "soft")
        channels = Rasterizer(gradient=gradient)(
            differentiable, EVERY if gradient != "soft" else ("color", "depth", "face", "mask")
        )
        assert (
            not channels["mask"].any() and (channels["face"] == -1).all() and (channels["color"] == 0).all()
        )
        slopes = torch.autograd.grad(channels["color"].sum(), list(parts.values()), allow_unused=True)
        assert all(slope is None or (slope == 0).all() for slope in slopes)
    empty = Scene(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64), torch.zeros(0, 3), ahead(1, 1))
    assert (Rasterizer(gradient=gradient)(empty)["color"] == 0).all()
    assert (Rasterizer(gradient=gradient)(join_scenes([empty, empty]), ("face",))["face"] == -1).all()


@pytest.mark.parametrize("gradient", KINDS)
def test_gradients_do_not_depend_on_the_focal_length(gradient: Gradient) -> None:
    """Check that gradients do not change by a bit if depths grow with the focal length.

    With `boundary`, this holds for focal lengths from 512 pixels, at which all surfaces of this scene count as
    separate.
    """
    first: dict[str, torch.Tensor] = {}
    for power in range(9 if gradient == "boundary" else -10, 21):
        focal = 2.0**power
        corners = np.concatenate([8 * crossing()[:, :2] * crossing()[:, 2:], focal * crossing()[:, 2:]], 1)
        camera = ahead(20, 24, near=focal * 2.0**-10, focal=focal)
        scene, parts = require_gradients(make_scene(corners, camera), torch.float64, gradient != "soft")
        color = Rasterizer(gradient=gradient)(scene)["color"]
        weight = torch.linspace(-1, 2, color.numel()).reshape(color.shape)
        names = [name for name in parts if name != "rotation"]  # because it mixes axes with different units
        channels = torch.autograd.grad((color * weight).sum(), [parts[name] for name in names])
        slopes = dict(zip(names, channels, strict=True))
        slopes["focal"] = slopes["focal"] * focal
        for name in ("vertices", "translation"):
            slopes[name] = slopes[name] * torch.tensor([1, 1, focal])
        first = first or slopes
        assert all(torch.equal(slopes[name], first[name]) for name in names)
        assert slopes["vertices"].abs().max() > 0.01
