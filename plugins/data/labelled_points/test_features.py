"""Tests of the features of a point against distances of all pairs of points."""

import numpy as np
import pytest

from framework.errors import DataError
from plugins.data.labelled_points.features import Bases, Features, Scan, draw_bases, local_features, scan_code

RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform([500_000, 4_000_000, 90], [500_020, 4_000_010, 95], (60, 3))
"""Points with coordinates of a map, far from the origin."""
FEATURES = Features(neighbours=4, surrounding_points=6, reach=3.0, basis_points=5)
NO_BASES = Bases(np.empty((0, 3)), np.empty((0, 3)))


def columns(values, features, start):
    """Return the features whose names begin with `start`."""
    return values[:, [name.startswith(start) for name in features.local_names]]


def test_features_equal_those_of_all_pairs_of_points():
    scan = Scan(POINTS, "scan", 4)
    bases = draw_bases(FEATURES, np.array([[-10.0, -5, 0], [10, 5, 5]]), np.random.default_rng(1))
    rows = np.array([3, 59, 0])
    values = local_features(scan, rows, FEATURES, bases)
    np.testing.assert_allclose(values[:, :2], POINTS[rows, :2] - POINTS[:, :2].mean(0), atol=1e-8)
    np.testing.assert_allclose(values[:, 2], POINTS[rows, 2] - POINTS[:, 2].min(), atol=1e-8)
    pairs = np.linalg.norm(POINTS[rows, None] - POINTS, axis=2)
    order = pairs.argsort(1)[:, 1:5]
    offsets = POINTS[order] - POINTS[rows, None]
    np.testing.assert_allclose(
        columns(values, FEATURES, ("x_to", "y_to", "z_to")), offsets.reshape(3, -1), atol=1e-8
    )
    np.testing.assert_allclose(columns(values, FEATURES, "distance"), np.sort(pairs, 1)[:, 1:5], atol=1e-8)
    queries = POINTS[rows, None] + bases.around
    around = np.linalg.norm(queries[:, :, None] - POINTS, axis=3).min(2)
    np.testing.assert_allclose(columns(values, FEATURES, "surrounding"), around.clip(max=3.0), atol=1e-8)
    whole = np.linalg.norm(bases.whole[:, None] - scan.points, axis=2).min(1)
    np.testing.assert_allclose(scan_code(scan, bases), whole, atol=1e-12)


def test_a_point_is_not_its_own_neighbour_where_many_points_are_at_one_place():
    points = np.array([[0.0, 0, 0]] * 5 + [[1.0, 0, 0]])
    features = Features(neighbours=2, surrounding_points=0)
    values = local_features(Scan(points, "scan", 2), np.arange(6), features, NO_BASES)
    np.testing.assert_array_equal(columns(values, features, "distance"), [[0, 0]] * 5 + [[1, 1]])


def test_a_distance_beyond_the_reach_is_the_reach():
    features = Features(neighbours=0, surrounding_points=2, reach=2.0, basis_points=0)
    bases = Bases(np.array([[0.0, 0, 1], [0.0, 0, 2.0]]), np.empty((0, 3)))
    values = local_features(Scan(np.zeros((1, 3)), "scan", 0), np.array([0]), features, bases)
    np.testing.assert_array_equal(values[0, 3:], [1.0, 2.0])


def test_basis_points_are_uniform_in_ball_and_box():
    features = Features(surrounding_points=4096, reach=2.0, basis_points=4096)
    extents = np.array([[-3.0, 0, 0], [5, 1, 8]])
    bases = draw_bases(features, extents, np.random.default_rng(0))
    radius = np.linalg.norm(bases.around, axis=1)
    # (radius / reach)³ is uniform on [0, 1]; the mean of 4096 such numbers has the standard deviation 0.0045
    assert ((radius / 2) ** 3).mean() == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(bases.whole.mean(0), extents.mean(0), atol=0.2)
    assert (bases.whole >= extents[0]).all() and (bases.whole <= extents[1]).all()


def test_a_scan_with_too_few_points_is_refused():
    with pytest.raises(DataError, match=r"the scan has 4 points, but data\.neighbours = 4 needs at least 5"):
        Scan(POINTS[:4], "tile.ply", 4)
