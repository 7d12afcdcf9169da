import math
import re
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial import Delaunay

from framework.configuration.schema import build, resolve
from framework.geometry.camera import Camera, look_from
from framework.renderer import Scene
from plugins.renderer.rasterizer import raster, shading
from plugins.renderer.rasterizer.renderer import Rasterizer

ALL = ("color", "depth", "face", "mask")
FOCAL = 64.0
hypothesis_settings = settings(deadline=None, max_examples=60, derandomize=True)


def ahead(height, width, near=1e-3):
    """Return a camera at the origin, looking along z; the focal length is a power of two to keep grid points exact."""
    middle = ((width - 1) / 2, (height - 1) / 2)
    return Camera(torch.eye(3), torch.zeros(3), (FOCAL, FOCAL), middle, height, width, near)


def unproject(pixels, depths, camera):
    """Return world points that the camera of `ahead` sees at pixels (column, row) and depths, float64."""
    pixels, depths = np.asarray(pixels, dtype=np.float64), np.asarray(depths, dtype=np.float64)
    sideways = (pixels - np.array(camera.principal)) / FOCAL * depths[..., None]
    return torch.tensor(np.concatenate([sideways, depths[..., None]], -1))


def make_scene(vertices, faces, camera, colors=None):
    faces = torch.as_tensor(np.asarray(faces, dtype=np.int64).reshape(-1, 3))
    return Scene(vertices, faces, colors, camera)


def draw(scene, channels=("depth", "face", "mask"), cull=False):
    return {name: value.numpy() for name, value in Rasterizer(cull=cull)(scene, channels).items()}


def are_equal(first, second):
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


def trace_rays(scene):
    """Return the visible faces by brute force, with rays and planes in space, independent of the kernels.

    A pixel's ray hits a triangle if it is on the same side of all three planes through the camera's centre and an
    edge.

    Returns:
        hits, distances to the nearest edge line (pixels) and depths, each (faces, height, width); barycentric weights
        (faces, height, width, 3).
    """
    camera = scene.camera
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ray = np.stack(
        [(columns - camera.principal[0]) / FOCAL, (rows - camera.principal[1]) / FOCAL, np.ones(rows.shape)],
        -1,
    )
    corners = scene.vertices.double().numpy()[scene.faces.numpy()]
    hits, margins, depths, weights = [], [], [], []
    for a, b, c in corners:
        side = np.stack([np.cross(b, c) @ ray[..., None], np.cross(c, a) @ ray[..., None],
                         np.cross(a, b) @ ray[..., None]], -1)[..., 0, :]  # fmt: skip
        with np.errstate(divide="ignore", invalid="ignore"):
            # the gradient of `side` along the image converts it to a distance in pixels
            slope = np.array([np.hypot(*np.cross(p, q)[:2]) / FOCAL for p, q in ((b, c), (c, a), (a, b))])
            margins.append(np.abs(side / slope).min(-1))
            normal = np.cross(b - a, c - a)
            depths.append((normal @ a) / (ray @ normal))
            weights.append(side / side.sum(-1, keepdims=True))
        hits.append((side > 0).all(-1) | (side < 0).all(-1))
    return np.stack(hits), np.stack(margins), np.stack(depths), np.stack(weights)


@st.composite
def soups(draw, subpixels):
    """Return separate triangles in front of a camera, with corners on a grid of 1 / subpixels pixel."""
    height, width = draw(st.integers(1, 20)), draw(st.integers(1, 20))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    camera = ahead(height, width)
    count = draw(st.integers(1, 8))
    pixels = rng.uniform(-0.7, 1.7, (3 * count, 2)) * [width, height]
    pixels = np.round(pixels * subpixels) / subpixels
    vertices = unproject(pixels, rng.uniform(0.5, 4, 3 * count), camera)
    colors = torch.tensor(rng.uniform(0, 1, (3 * count, 3)))
    return make_scene(vertices, np.arange(3 * count), camera, colors)


@hypothesis_settings
@given(soups(subpixels=256))
def test_every_channel_agrees_with_rays_through_pixel_centres(scene):
    hits, margins, depths, weights = trace_rays(scene)
    got = draw(scene, ALL)
    depths = np.where(hits, depths, np.inf)
    order = np.sort(depths, 0)
    with np.errstate(invalid="ignore"):
        clear = (margins > 1e-6).all(0)
        if len(order) > 1:
            clear &= ~(order[1] - order[0] < 1e-5 * order[0])
    nearest, background = depths.argmin(0), np.isinf(order[0])
    assert np.array_equal(got["mask"][clear], ~background[clear])
    assert np.array_equal(got["face"][clear], np.where(background, -1, nearest)[clear])
    assert np.allclose(got["depth"][clear], order[0][clear], rtol=1e-6, atol=0)
    weight = np.take_along_axis(weights, nearest[None, ..., None], 0)[0]
    colors = (weight[..., None] * scene.colors.numpy()[scene.faces.numpy()[nearest]]).sum(-2)
    colors[background] = 0
    assert np.allclose(got["color"][clear], colors[clear], rtol=0, atol=1e-5)


@st.composite
def slivers(draw):
    """Return long triangles with widths down to 1/100 of the rounding of corners.

    Some triangles have all corners on a line, except for rounding.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    camera = ahead(20, 20)
    start, end = rng.uniform(-5, 25, (2, 300, 2))
    width = 10.0 ** rng.uniform(-5, 0, (300, 1)) * rng.integers(0, 2, (300, 1))
    between = start + rng.uniform(-0.2, 1.2, (300, 1)) * (end - start) + width * rng.normal(0, 1, (300, 2))
    pixels = np.stack([start, end, between], 1).reshape(-1, 2)
    vertices = unproject(pixels, rng.uniform(0.5, 4, 900), camera)
    colors = torch.tensor(rng.uniform(0, 1, (900, 3)))
    return make_scene(vertices, np.arange(900), camera, colors)


@hypothesis_settings
@given(st.one_of(soups(subpixels=1e6), slivers()))
def test_colour_and_depth_are_interpolated_between_unrounded_corners(scene):
    """Check that the weights give the point of the face at the pixel centre, with its colour and depth.

    For pixels that are covered only because of rounding, they give the nearest point of the face.
    """
    hits, margins, _, _ = trace_rays(scene)
    got = draw(scene, ("face", "barycentric", "color", "depth"))
    row, column = np.nonzero(got["face"] >= 0)
    face = got["face"][row, column]
    weight = got["barycentric"][row, column].astype(float)
    corners = scene.vertices.numpy()[scene.faces.numpy()[face]]
    assert (weight >= 0).all() and np.allclose(weight.sum(1), 1, rtol=0, atol=1e-6)
    place = (weight[:, None] @ corners)[:, 0]
    colors = (weight[:, None] @ scene.colors.numpy()[scene.faces.numpy()[face]])[:, 0]
    assert np.allclose(got["depth"][row, column], place[:, 2], rtol=2e-6, atol=0)
    assert np.allclose(got["color"][row, column], colors, rtol=0, atol=1e-6)
    off = FOCAL * place[:, :2] / place[:, 2:] + scene.camera.principal - np.stack([column, row], 1)
    distance = np.hypot(*off.T)
    assert (distance < math.sqrt(2) / 512 + 2e-5).all()
    assert (distance[hits[face, row, column] & (margins[face, row, column] > 1e-9)] < 2e-5).all()


@hypothesis_settings
@given(soups(subpixels=1e6))
def test_coverage_off_the_grid_is_right_up_to_half_a_subpixel(scene):
    hits, margins, _, _ = trace_rays(scene)
    for index in range(len(scene.faces)):
        alone = draw(replace(scene, faces=scene.faces[index : index + 1]), ("mask",))["mask"]
        # rounding moves a corner by up to 1/512 pixel, and the edge lines at a thin corner by more
        clear = margins[index] > 2 / 256
        wrong = clear & (alone != hits[index])
        assert not wrong.any()


def coverage(vertices, faces, camera):
    """Return how many faces, drawn one by one, cover each pixel; check that the whole mesh covers the same pixels."""
    counts = sum(
        draw(make_scene(vertices, face, camera), ("mask",))["mask"].astype(int) for face in np.asarray(faces)
    )
    assert np.array_equal(draw(make_scene(vertices, faces, camera), ("mask",))["mask"], counts > 0)
    return counts


@hypothesis_settings
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 16, 1000]))
def test_neighbouring_faces_share_no_pixel_and_leave_no_gap(seed, subpixels):
    rng = np.random.default_rng(seed)
    camera = ahead(12, 15)
    # On a coarse grid most edges run through pixel centres; the corners lie outside the image.
    points = np.unique(np.round(rng.uniform(-4, 18, (40, 2)) * subpixels) / subpixels, axis=0)
    points = np.concatenate([points, [[-9, -9], [-9, 30], [30, -9], [30, 30]]])
    faces = Delaunay(points).simplices
    flip = rng.random(len(faces)) < 0.5
    faces[flip] = faces[flip][:, ::-1]
    vertices = unproject(points, rng.uniform(0.5, 4, len(points)), camera)
    assert (coverage(vertices, faces, camera) == 1).all()


@hypothesis_settings
@given(st.integers(0, 2**32 - 1), st.integers(5, 12))
def test_fans_are_watertight_however_far_their_rims_reach(seed, spokes):
    rng = np.random.default_rng(seed)
    camera = ahead(9, 11)
    angles = (np.arange(spokes) + rng.uniform(0, 0.4, spokes)) * 2 * np.pi / spokes
    radii = rng.choice([1e2, 1e4, 131072.0, 3e5, 1e9, 1e30], spokes)
    rim = np.array(camera.principal) + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    hub = rng.integers(0, 9, 2).astype(float)
    vertices = unproject(np.concatenate([[hub], rim]), rng.uniform(0.5, 4, spokes + 1), camera)
    faces = [(0, 1 + i, 1 + (i + 1) % spokes) for i in range(spokes)]
    assert (coverage(vertices, faces, camera) == 1).all()


@hypothesis_settings
@given(st.integers(0, 2**32 - 1))
def test_pixel_centres_on_far_edges_belong_to_one_face(seed):
    rng = np.random.default_rng(seed)
    camera = ahead(9, 11)
    compass = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])
    hub = rng.integers(0, 9, 2)
    rim = hub + compass * 2.0 ** rng.integers(5, 45, (8, 1))  # whole 1/256 pixels that float64 holds exactly
    vertices = unproject(np.concatenate([[hub], rim]), 2.0 ** rng.integers(-2, 3, 9), camera)
    assert (coverage(vertices, [(0, 1 + i, 1 + (i + 1) % 8) for i in range(8)], camera) == 1).all()


def test_an_edge_on_a_pixel_row_or_column_belongs_to_the_triangle_below_or_right_of_it():
    camera = ahead(5, 5)
    vertices = unproject([(1, 1), (3, 1), (3, 3), (1, 3)], np.ones(4), camera)
    mask = draw(make_scene(vertices, [(0, 1, 2), (0, 2, 3)], camera))["mask"]
    assert np.argwhere(mask).tolist() == [[1, 1], [1, 2], [2, 1], [2, 2]]


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_depth_and_colour_are_those_of_a_plane_in_perspective(kind):
    camera = ahead(40, 50)
    corners = np.array([(-20.3, -30.1), (90.7, -25.9), (80.2, 70.4), (-33.3, 61.7)])
    normal, offset = np.array([0.3, 0.8, 1.0]), 2.0
    direction = np.concatenate([(corners - camera.principal) / FOCAL, np.ones((4, 1))], 1)
    world = direction * (offset / (direction @ normal))[:, None]
    slope, base = np.array([[0.05, 0.1, 0.02], [0.04, -0.02, 0.1], [-0.03, 0.03, 0.05]]), 0.4
    scene = make_scene(
        torch.tensor(world, dtype=kind),
        [(0, 1, 2), (0, 2, 3)],
        camera,
        torch.tensor(world @ slope + base).to(kind),
    )
    got = draw(scene, ALL)
    columns, rows = np.meshgrid(np.arange(50), np.arange(40))
    ray = np.stack(
        [(columns - camera.principal[0]) / FOCAL, (rows - camera.principal[1]) / FOCAL, 1 + 0 * rows], -1
    )
    depth = offset / (ray @ normal)
    assert got["mask"].all()
    assert np.ptp(depth) > 1  # so steep that linear interpolation of depth would fail
    assert np.abs(got["depth"] / depth - 1).max() < 1e-6
    assert np.abs(got["color"] - ((ray * depth[..., None]) @ slope + base)).max() < 1e-6


def test_a_triangle_that_reaches_far_out_of_the_image_keeps_its_plane():
    # a floor below the camera: two corners are barely in front of the camera and project 2e7 pixels away
    camera = ahead(30, 40, near=1e-6)
    world = torch.tensor([[-1.0, 0.5, 3e-6], [1.0, 0.5, 3e-6], [0.0, 0.5, 50.0]], dtype=torch.float64)
    got = draw(make_scene(world, [(0, 1, 2)], camera))
    rows = np.arange(30) - camera.principal[1]
    with np.errstate(divide="ignore"):
        depth = np.where(rows > 0, 0.5 * FOCAL / rows, np.inf)
    for column in range(40):
        # at depth z, the floor is 2 (1 - z / 50) metres wide
        expected = np.where(
            np.abs((column - camera.principal[0]) / FOCAL) * depth < 1 - depth / 50, depth, np.inf
        )
        assert np.allclose(got["depth"][:, column], expected, rtol=1e-3)
    assert 0.2 < got["mask"].mean() < 0.5


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_the_lower_index_of_equal_faces_wins_for_any_order_of_corners(order):
    rng = np.random.default_rng(5)
    camera = ahead(40, 40)
    count = 400
    # each triangle has its own pixel, at a depth halfway between two float32 numbers, so that the last bit decides
    pixel = np.stack(np.divmod(np.arange(count), 20), 1) * 2.0
    shapes = np.array(
        [[(-0.5, -0.75), (0.75, -0.5), (-0.25, 0.75)], [(-0.5, -0.75), (0.5, -0.75), (0.25, 0.75)]]
    )
    corners = pixel[:, None] + shapes[np.arange(count) % 2]
    parts = [np.linalg.det(corners[:, [k, (k + 1) % 3]] - pixel[:, None]) for k in (1, 2, 0)]
    weights = np.stack(parts, 1) / np.sum(parts, 0)[:, None]
    halfway = 1 + rng.integers(0, 2**23, count) / 2**23 + 2.0**-24
    inverse = rng.uniform(0.4, 0.7, (count, 3))
    inverse[:, 2] = (1 / halfway - (weights * inverse)[:, :2].sum(1)) / weights[:, 2]
    depths = 1 / inverse
    assert (depths > 0).all()
    once = unproject(corners, depths, camera).reshape(-1, 3)
    again = unproject(corners[:, order], depths[:, order], camera).reshape(-1, 3)
    first = np.arange(3 * count).reshape(-1, 3)
    second = first + 3 * count
    alone = draw(make_scene(once, first, camera))
    assert np.isin(np.arange(count), alone["face"]).all()
    for faces in (np.concatenate([first, second]), np.concatenate([second, first])):
        both = draw(make_scene(torch.cat([once, again]), faces, camera))
        assert np.array_equal(both["face"], alone["face"])
        assert np.allclose(both["depth"], alone["depth"], rtol=2.0**-23, atol=0)


@pytest.mark.parametrize("reach", [40.0, 1e7, 1e25])
def test_ties_and_culling_hold_however_far_a_triangle_reaches(reach):
    camera = ahead(9, 9)
    rng = np.random.default_rng(7)
    vertices = unproject(
        [(-reach, -reach), (-reach, 1.5 * reach), (2 * reach, -reach)], rng.uniform(1, 2, 3), camera
    )
    for front in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        back = front[::-1]
        pair = make_scene(vertices, [back, front], camera)
        assert (draw(pair)["face"] == 0).all()
        assert (draw(pair, cull=True)["face"] == 1).all()
        assert are_equal(draw(pair, ("depth",)), draw(pair, ("depth",), cull=True))


@hypothesis_settings
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**23 - 1), st.sampled_from([1, 1e8]))
def test_the_lower_index_of_overlapping_faces_at_equal_depth_wins(seed, step, reach):
    rng = np.random.default_rng(seed)
    camera = ahead(12, 12)
    depth = 1 + step / 2**23 + 2.0**-24  # halfway between two float32 numbers
    pixels = camera.principal + reach * rng.uniform(-11, 11, (18, 2))
    vertices = unproject(pixels, np.full(18, depth), camera)
    faces = np.arange(18).reshape(-1, 3)
    expected = np.full((12, 12), -1)
    for index in reversed(range(6)):
        expected[draw(make_scene(vertices, faces[index], camera), ("mask",))["mask"]] = index
    got = draw(make_scene(vertices, faces, camera))
    assert np.array_equal(got["face"], expected)


numbers = st.one_of(
    st.floats(-3, 3, width=32),
    st.floats(width=32),
    st.sampled_from([0.0, 1e-3, 1e30, -1e30, 3e38, math.inf, -math.inf, math.nan, 1e-40]),
)


@settings(hypothesis_settings, max_examples=150)
@given(
    arrays.arrays(np.float32, st.tuples(st.integers(3, 9), st.just(3)), elements=numbers),
    st.integers(0, 2**32 - 1),
    st.integers(1, 9),
    st.integers(1, 9),
    st.booleans(),
)
def test_wild_coordinates_affect_only_their_own_faces(world, seed, height, width, cull):
    rng = np.random.default_rng(seed)
    camera = ahead(height, width)
    world[rng.random(len(world)) < 0.6, 2] = 1.5
    world = np.concatenate([world, [[-0.2, -0.2, 2.0], [0.3, -0.2, 2.0], [0.0, 0.3, 2.0]]]).astype(np.float32)
    faces = np.concatenate([rng.integers(0, len(world), (6, 3)), [np.arange(3) + len(world) - 3]])
    allowed = np.isfinite(world).all(1)[faces].all(1)
    allowed &= (world[:, 2] >= np.float32(camera.near))[faces].any(
        1
    )  # faces that the near plane cuts are drawn in part
    allowed &= (np.diff(np.sort(faces, 1), axis=1) > 0).all(1)
    vertices = torch.tensor(world)
    colors = torch.tensor(rng.uniform(0, 1, world.shape), dtype=torch.float32)
    got = draw(make_scene(vertices, faces, camera, colors), ALL, cull)
    allowed_faces = np.flatnonzero(allowed)
    pruned = draw(make_scene(vertices, faces[allowed], camera, colors), ALL, cull)
    pruned["face"] = np.append(allowed_faces, -1)[pruned["face"]]
    assert are_equal(got, pruned)
    assert np.array_equal(got["mask"], np.isfinite(got["depth"]))
    assert np.array_equal(got["mask"], got["face"] >= 0)
    assert (got["depth"][got["mask"]] >= np.float32(camera.near)).all()
    assert (got["color"] >= 0).all() and (got["color"] <= 1).all()
    assert (got["color"][~got["mask"]] == 0).all()


def triangle(camera, z=1.0):
    return make_scene(torch.tensor([[-0.1, -0.1, z], [0.1, -0.1, z], [0.0, 0.1, z]]), [(0, 1, 2)], camera)


@pytest.mark.parametrize(
    ("vertex", "value"),
    [(0, math.nan), (1, math.inf), (2, -math.inf), (0, 3.3e38)],
)
def test_a_triangle_with_a_non_finite_or_too_distant_corner_is_left_out(vertex, value):
    scene = triangle(ahead(9, 9))
    assert draw(scene)["mask"].any()
    scene.vertices[vertex, 2] = value
    got = draw(scene)
    assert not got["mask"].any() and (got["face"] == -1).all() and np.isinf(got["depth"]).all()


@st.composite
def cut_soups(draw):
    """Return triangles with corners that may be nearer than the near plane, or behind the camera.

    Every corner is far from the plane through the camera's centre, so that rounding does not decide the result.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    camera = ahead(draw(st.integers(1, 20)), draw(st.integers(1, 20)), near=0.5)
    count = draw(st.integers(1, 8))
    vertices = rng.uniform(-1, 1, (3 * count, 3)) * [0.3, 0.3, 2] + [0, 0, 0.6]
    colors = torch.tensor(rng.uniform(0, 1, (3 * count, 3)))
    return make_scene(torch.tensor(vertices), np.arange(3 * count), camera, colors)


@hypothesis_settings
@given(cut_soups())
def test_the_part_of_a_face_in_front_of_the_near_plane_is_drawn(scene):
    """Compare triangles that have corners behind the camera with rays through pixel centres."""
    hits, margins, depths, weights = trace_rays(scene)
    near = scene.camera.near
    got = draw(scene, ALL)
    with np.errstate(invalid="ignore"):
        visible = hits & (depths >= near)
        clear = (margins > 0.02).all(0) & ~(abs(depths - near) < 0.02).any(0)
        depths = np.where(visible, depths, np.inf)
        order = np.sort(depths, 0)
        if len(order) > 1:
            clear &= ~(order[1] - order[0] < 1e-2 * order[0])
    nearest, background = depths.argmin(0), np.isinf(order[0])
    assert np.array_equal(got["mask"][clear], ~background[clear])
    assert np.array_equal(got["face"][clear], np.where(background, -1, nearest)[clear])
    shown = clear & ~background
    # rounding moves corners by 1/512 pixel; a depth d = n·a / r·n changes by d² |(n_x, n_y)| / (f |n·a|) per pixel
    a, b, c = np.moveaxis(scene.vertices.numpy()[scene.faces.numpy()], 1, 0)
    normal = np.cross(b - a, c - a)
    slope = np.hypot(normal[:, 0], normal[:, 1]) / (FOCAL * np.abs((normal * a).sum(-1)))
    allowed = 0.02 * order[0] ** 2 * slope[nearest] + 1e-6 * order[0]
    assert (np.abs(got["depth"][shown] - order[0][shown]) <= allowed[shown]).all()
    weight = np.take_along_axis(weights, nearest[None, ..., None], 0)[0]
    colors = (weight[..., None] * scene.colors.numpy()[scene.faces.numpy()[nearest]]).sum(-2)
    partly = (scene.vertices[:, 2].numpy()[scene.faces.numpy()] < near).any(1)[nearest]
    # weights of cut faces are computed in space, without rounded corners
    assert np.allclose(got["color"][shown & partly], colors[shown & partly], rtol=0, atol=1e-6)


def test_a_face_on_the_near_plane_is_visible():
    assert draw(triangle(ahead(9, 9, near=1.0)))["mask"].any()
    assert not draw(triangle(ahead(9, 9, near=1.0), z=1 - 2**-20))["mask"].any()


@pytest.mark.parametrize("faces", [[(0, 0, 1)], [(0, 1, 0)], [(2, 2, 2)], [(0, 1, 3)]])
def test_a_triangle_without_an_area_is_left_out(faces):
    camera = ahead(9, 9)
    vertices = unproject([(0, 0), (4, 4), (8, 0), (8, 8)], [1.0, 2.0, 3.0, 1.0], camera)
    assert not draw(make_scene(vertices, faces, camera))["mask"].any()
    huge = torch.tensor([[-1e30, -1e30, 1.0], [1e30, 1e30, 1.0]], dtype=torch.float64)
    assert not draw(make_scene(torch.cat([vertices, huge]), [(0, 4, 5), (4, 5, 4)], camera))["mask"].any()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 7), (7, 1), (2, 3)])
def test_the_smallest_images(height, width):
    camera = ahead(height, width)
    reach = unproject([(-40, -40), (80, -40), (-40, 80)], [2.0, 2.0, 2.0], camera)
    got = draw(make_scene(reach, [(0, 1, 2)], camera, torch.full((3, 3), 0.25)), ALL)
    assert got["color"].shape == (height, width, 3) and (got["color"] == 0.25).all()
    assert (got["depth"] == 2).all() and (got["face"] == 0).all() and got["mask"].all()


def ball(subdivisions=3, radius=0.5):
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return torch.tensor(np.asarray(mesh.vertices), dtype=torch.float32), torch.tensor(np.asarray(mesh.faces))


def portrait(subdivisions=3, **changes):
    vertices, faces = ball(subdivisions)
    camera = replace(look_from(0.7, 0.3, 0.2, 2.0, 0.6, (60, 50)), **changes)
    return Scene(vertices, faces, (vertices + 0.5).clamp(0, 1), camera)


@pytest.mark.parametrize(
    "requested", [(name,) for name in ALL] + [("depth", "mask"), {"color", "mask"}, ("face",) * 2, ()]
)
@pytest.mark.parametrize("cull", [False, True])
def test_each_channel_is_the_same_alone_and_only_requested_channels_are_drawn(requested, cull):
    together, alone = draw(portrait(), ALL, cull), draw(portrait(), requested, cull)
    assert set(alone) == set(requested)
    assert are_equal(alone, {name: together[name] for name in alone})
    kinds = {"color": np.float32, "depth": np.float32, "face": np.int32, "mask": np.bool_}
    assert all(value.dtype == kinds[name] for name, value in alone.items())


def test_colours_are_computed_only_on_request(monkeypatch):
    shaded = []
    monkeypatch.setattr(shading, "shade", lambda *arguments: shaded.append(arguments[-2:]))
    draw(portrait(), ("depth", "face", "mask"))
    assert [(color is None, depth is None) for color, depth in shaded] == [(True, False)]
    assert draw(replace(portrait(), colors=None), ("mask", "face"))["mask"].any()
    assert len(shaded) == 1


@pytest.mark.parametrize("angle", np.linspace(0, 6, 7))
def test_culling_of_a_closed_mesh_keeps_the_silhouette_and_nearly_all_pixels(angle):
    # a closed mesh stays closed after rounding: equally many front and back faces cover each pixel
    scene = portrait()
    scene = replace(scene, camera=look_from(angle, angle / 4 - 0.7, angle, 1.5, 0.8, (120, 110)))
    whole, culled = draw(scene, ALL), draw(scene, ALL, cull=True)
    assert 0.2 < whole["mask"].mean() < 0.8
    assert np.array_equal(whole["mask"], culled["mask"])
    assert (whole["face"] != culled["face"]).mean() < 1e-3
    corners = scene.vertices.double().numpy()[scene.faces.numpy()]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    eye = -scene.camera.rotation.double().numpy().T @ scene.camera.translation.double().numpy()
    facing = ((eye - corners[:, 0]) * normals).sum(1)
    visible_faces = np.unique(culled["face"][culled["face"] >= 0])
    assert (facing[visible_faces] > -1e-4 * np.linalg.norm(normals[visible_faces], axis=1)).all()


def test_a_closed_mesh_fills_the_image_of_a_camera_inside():
    scene = portrait(translation=torch.tensor([0.05, -0.03, 0.1]))
    whole = draw(scene, ALL)
    assert whole["mask"].all()
    # The ball's facets lie between its inscribed and circumscribed spheres, seen from 0.12 off the centre.
    assert whole["depth"].min() > 0.25 and whole["depth"].max() < 0.65
    assert not draw(scene, ALL, cull=True)["mask"].any()


AWAY = {"behind": (0, 0, -2), "left": (-3, 0, 2), "right": (3, 0, 2), "above": (0, -3, 2), "below": (0, 3, 2)}


@pytest.mark.parametrize("where", AWAY)
def test_a_scene_out_of_view_costs_no_projection_and_gives_the_background(where, monkeypatch):
    scene = portrait(translation=torch.tensor(AWAY[where], dtype=torch.float32))
    monkeypatch.setattr(raster, "project", None)
    got = draw(scene, ALL)
    assert not got["mask"].any() and (got["face"] == -1).all()
    assert np.isinf(got["depth"]).all() and (got["color"] == 0).all()


@hypothesis_settings
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1.0, 1e20]))
def test_the_view_test_of_the_whole_scene_loses_no_face(seed, size):
    rng = np.random.default_rng(seed)
    vertices = torch.tensor(rng.normal(0, size, (12, 3)) + rng.normal(0, 2, 3))
    camera = replace(ahead(8, 8), translation=torch.tensor(rng.normal(0, 2, 3)))
    everything = make_scene(vertices, rng.permuted(np.tile(np.arange(12), (8, 1)), axis=1)[:, :3], camera)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raster, "is_out_of_view", lambda *_: False)
        expected = draw(everything)
    assert are_equal(draw(everything), expected)


def test_empty_scenes_give_the_background():
    camera = ahead(4, 5)
    nothing = Scene(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64), torch.zeros(0, 3), camera)
    for scene in (nothing, replace(triangle(camera), faces=nothing.faces, colors=torch.ones(3, 3))):
        got = draw(scene, ALL)
        assert got["color"].shape == (4, 5, 3) and not got["color"].any() and not got["mask"].any()


def test_calls_are_independent_and_repeat_to_the_bit():
    renderer = Rasterizer()
    scenes = [portrait(), triangle(ahead(9, 9)), portrait(translation=torch.tensor([3.0, 0, 2])), portrait(2)]
    fresh = [draw(scene) for scene in scenes]
    first = renderer(scenes[0], ("depth", "face", "mask"))
    copies = {name: value.clone() for name, value in first.items()}
    for scene, expected in [*zip(scenes, fresh, strict=True)] * 2:
        got = renderer(scene, ("depth", "face", "mask"))
        assert are_equal({name: value.numpy() for name, value in got.items()}, expected)
    # no call changes an earlier result
    assert all(torch.equal(first[name], copies[name]) for name in first)


def test_layouts_and_types_of_the_input_do_not_matter():
    scene = portrait()
    expected = draw(scene, ALL)
    faces = scene.faces.to(torch.int32)
    columns = Scene(
        scene.vertices.T.contiguous().T, faces.T.contiguous().T, scene.colors.double(), scene.camera
    )
    assert are_equal(draw(columns, ALL), expected)
    assert are_equal(
        draw(replace(scene, vertices=scene.vertices.double(), faces=scene.faces.short()), ALL), expected
    )
    learned = replace(scene, vertices=scene.vertices.clone().requires_grad_())
    with torch.no_grad():
        assert are_equal(draw(learned, ALL), expected)
    assert Rasterizer()(learned)["color"].requires_grad


IMPLEMENTATIONS = pytest.mark.parametrize("implementation", [Rasterizer.__call__, Rasterizer.on_device])
"""The two implementations: compiled on the CPU, and plain torch on any device."""


@IMPLEMENTATIONS
@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"vertices": torch.zeros(5, 2)}, "vertices: got the shape (5, 2)"),
        ({"vertices": torch.zeros(642, 4)}, "vertices: got the shape (642, 4)"),
        ({"vertices": torch.zeros(642)}, "vertices: got the shape (642,)"),
        ({"vertices": torch.tensor(0.0)}, "vertices: got the shape ()"),
        ({"vertices": torch.zeros(3, 5, 3)}, "vertices: got the shape (3, 5, 3)"),
        (
            {"vertices": torch.zeros(642, 3, dtype=torch.int64)},
            "vertices: got torch.int64, expected floating",
        ),
        ({"faces": torch.zeros(4, 4, dtype=torch.int64)}, "faces: got the shape (4, 4)"),
        ({"faces": torch.zeros(12, dtype=torch.int64)}, "faces: got the shape (12,)"),
        ({"faces": torch.tensor(1)}, "faces: got the shape ()"),
        ({"faces": torch.zeros(2, 2, 3, dtype=torch.int64)}, "faces: got the shape (2, 2, 3)"),
        ({"faces": torch.zeros(4, 3)}, "faces: got torch.float32, expected whole numbers"),
        ({"faces": torch.zeros(4, 3, dtype=torch.bool)}, "faces: got torch.bool, expected whole numbers"),
        ({"faces": torch.tensor([[0, 1, 642]])}, "0 to 642, expected 0 to 641"),
        ({"faces": torch.tensor([[0, -1, 2]], dtype=torch.int32)}, "-1 to 2, expected 0 to 641"),
        ({"colors": torch.zeros(5, 3)}, "5 colors for 642 vertices"),
        ({"colors": torch.zeros(700, 3)}, "700 colors for 642 vertices"),
        ({"colors": torch.zeros(642)}, "colors: got the shape (642,)"),
        ({"colors": torch.zeros(642, 3, dtype=torch.uint8)}, "colors: got torch.uint8, expected floating"),
        ({"colors": torch.zeros(642, 0)}, "colors: got the shape (642, 0)"),
        ({"colors": None}, '"color" requires a scene with colours'),
    ],
)
def test_inputs_that_do_not_fit_raise_a_clear_message(change, sentence, implementation):
    scene = portrait()
    for name, value in change.items():
        object.__setattr__(scene, name, value)  # bypasses the type checks of the tests
    for channels in (ALL, ("color",), ("depth",), ("normal", "barycentric")):
        if "colors" in change and "color" not in channels:  # colours are not used then
            assert set(implementation(Rasterizer(), scene, channels)) == set(channels)
            continue
        with pytest.raises(ValueError, match=re.escape(sentence)):
            implementation(Rasterizer(), scene, channels)


def test_tensors_on_another_device_raise_an_error():
    with pytest.raises(ValueError, match="vertices is on meta, but rasterizer draws on the CPU"):
        Rasterizer()(replace(portrait(), vertices=torch.zeros(642, 3, device="meta")), ALL)


@IMPLEMENTATIONS
def test_wrong_indices_raise_an_error_even_out_of_view(implementation):
    scene = portrait(translation=torch.tensor([0.0, 0, -5]))
    with pytest.raises(ValueError, match="expected 0 to 641"):
        implementation(Rasterizer(), replace(scene, faces=scene.faces + 1), ("mask",))


LENSES = {
    "a number": 8.0,
    "one": (8.0,),
    "three": (8.0, 8.0, 8.0),
    "none": (),
    "two pairs": ((8.0, 8.0),) * 2,
}
LENSES |= {f"a tensor of {shape}": torch.full(shape, 8.0) for shape in ((), (0,), (1,), (3,), (1, 2), (2, 1))}


@IMPLEMENTATIONS
@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("name", ["focal", "principal"])
@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_that_is_not_two_numbers_raises_an_error(lens, name, learned, implementation):
    scene = portrait()
    if learned:
        scene = replace(scene, vertices=scene.vertices.clone().requires_grad_())
    object.__setattr__(scene.camera, name, LENSES[lens])  # bypasses the type checks of the tests
    with pytest.raises(ValueError, match=rf"camera\.{name} has .*; expected the shape \(2,\)"):
        implementation(Rasterizer(gradient="interior", supersampling=2), scene, ("color", "mask"))


@IMPLEMENTATIONS
@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"height": 0}, "camera.height is 0, expected 1 to"),
        ({"width": 2**20}, "camera.width is 1048576, expected 1 to"),
        ({"near": 0.0}, "near that is not above 0"),
        ({"focal": (1.0, math.nan)}, "not finite"),
        ({"translation": torch.tensor([0.0, math.inf, 0.0])}, "not finite"),
        ({"rotation": torch.eye(3, device="meta")}, "camera.rotation is on meta"),
        ({"focal": torch.ones(2, device="meta")}, "camera.focal is on meta"),
        ({"rotation": torch.eye(4)}, "camera.rotation has the shape (4, 4); expected the shape (3, 3)"),
        (
            {"translation": torch.ones(1)},
            "camera.translation has the shape (1,); expected the shape (3,)",
        ),
    ],
)
def test_an_impossible_camera_raises_an_error(change, sentence, implementation):
    scene = portrait()
    for name, value in change.items():
        object.__setattr__(scene.camera, name, value)  # bypasses the type checks of the tests
    with pytest.raises(ValueError, match=re.escape(sentence)):
        implementation(Rasterizer(), scene, ("color",))


@pytest.mark.parametrize(
    ("channels", "sentence"),
    [
        (("depht",), "Did you mean 'depth'?"),
        (("mask", "normals"), "'normals' is not a channel"),
        ("mask", "a collection of names is required"),
    ],
)
def test_unknown_channels_raise_an_error(channels, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        Rasterizer()(portrait(), channels)


def test_the_renderer_is_built_by_both_names():
    for name in ("rasterizer", "zbuffer"):  # old checkpoints contain the earlier name zbuffer
        renderer = build("renderer", resolve("renderer", {"name": name, "cull": True}))
        assert isinstance(renderer, Rasterizer) and renderer.cull
    assert renderer.channels > set(ALL)
