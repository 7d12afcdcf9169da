import numpy as np
import pytest

from framework.bodies.decimation import decimate
from framework.bodies.people import load_body
from framework.bodies.topologies import COUNTS, Corners, edges, sheet, split, topology
from framework.errors import DataError


def ball(stages=3):
    """Return a sphere whose texture has two halves, so that points of the equator have two texture coordinates."""
    points = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
    upper = [(2, 4, 0), (2, 0, 5), (2, 5, 1), (2, 1, 4)]
    faces = np.array([*upper, *((3, c, b) for _, b, c in upper)])
    uv = np.concatenate([points, points])[:, [0, 2]]
    uv_faces = np.concatenate([faces[:4], faces[4:] + 6])
    corners = Corners(faces, uv_faces)
    for _ in range(stages):
        found = split(corners, len(points), len(uv))
        points = np.concatenate([points, points[found.pairs].mean(1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        uv = np.concatenate([uv, uv[found.uv_pairs].mean(1)])
        corners = found.corners
    return points, corners, uv


def assert_closed(vertices, faces, bodies=1):
    """Require that every side occurs once in each direction; return the volume inside."""
    sides = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)
    forwards, backwards = (np.sort(side @ [len(vertices), 1]) for side in (sides, sides[:, ::-1]))
    assert np.array_equal(forwards, backwards) and (np.diff(forwards) > 0).all()
    assert len(np.unique(faces)) - len(sides) // 2 + len(faces) == 2 * bodies
    return np.linalg.det(vertices[faces]).sum() / 6


def pairs_of(corners):
    return np.unique(corners.faces.astype(np.int64) * 10**7 + corners.uv_faces)


@pytest.mark.parametrize("count", [200, 100, 50])
def test_a_decimated_mesh_is_closed_keeps_its_volume_and_its_seams(count):
    points, corners, _ = ball()
    found = decimate(points, *corners, count)
    assert len(found.kept) == count == len(np.unique(found.faces))
    assert np.array_equal(found.kept, np.unique(found.faces))
    volume, whole = assert_closed(points, found.faces), assert_closed(points, corners.faces)
    assert abs(volume / whole - 1) < 12 / count
    # every corner still has a texture coordinate of its vertex, in the chart of its triangle
    assert np.isin(pairs_of(Corners(found.faces, found.uv_faces)), pairs_of(corners)).all()
    again = decimate(points, *corners, count)
    assert all(np.array_equal(one, other) for one, other in zip(found, again, strict=True))


def test_more_than_can_go_is_told():
    points, corners, _ = ball(1)
    with pytest.raises(DataError, match="cannot be reduced to 1 vertices"):
        decimate(points, *corners, 1)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_split_edges_leave_no_gap_and_carry_places_along(share):
    points, corners, uv = ball(2)
    every, _ = edges(corners.faces)
    chosen = np.random.default_rng(0).random(len(every)) < share
    found = split(corners, len(points), len(uv), chosen)
    carried = np.concatenate([points, points[found.pairs].mean(1)])
    places = np.concatenate([uv, uv[found.uv_pairs].mean(1)])
    assert len(found.pairs) == chosen.sum()
    volume, whole = assert_closed(carried, found.corners.faces), assert_closed(points, corners.faces)
    assert volume == pytest.approx(whole)

    def area(at, faces):
        a, b, c = (at[faces[:, corner]] for corner in range(3))
        return np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()

    assert area(places, found.corners.uv_faces) == pytest.approx(area(uv, corners.uv_faces))


@pytest.fixture(scope="module")
def body():
    return load_body(None)[0]


@pytest.fixture(scope="module")
def surface(body):
    return sheet(body)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["7k", "14k", "27k", "110k"])
def test_topologies_of_the_default_body(body, surface, name):
    found = topology(body, surface, name)
    assert len(found.rows) == len(np.unique(found.rows)) == COUNTS.get(name, 13_718)
    fine = surface.interpolate(body.template.astype(np.float64))
    volume = assert_closed(fine[found.rows], found.faces, bodies=4)  # a tongue and two eyes beside the body
    assert volume == pytest.approx(assert_closed(body.template.astype(float), body.faces, bodies=4), rel=3e-3)
    # every corner has a texture coordinate that its vertex has on the finest surface
    pairs = pairs_of(Corners(found.rows[found.faces], found.uv_rows[found.uv_faces]))
    assert np.isin(pairs, pairs_of(surface.corners[-1])).all()
