"""Tests of the solids: volume, area and centre compared with formulas, and whether the surface is closed."""

import math

import numpy as np
import pytest

from framework.geometry import round_solids, solids
from framework.geometry.meshes import Mesh, normals
from framework.geometry.solids import Solid

ANGLE = np.arange(400) * math.pi / 200
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE)], 1)
LINE = np.array([(0.0, 0.0), (1.0, 0.0), (3.0, 0.0)])
RECTANGLE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
POLYGON = 12 * math.sin(math.pi / 12)  # area of the 24-sided polygon that approximates a unit circle
SOLIDS = {
    "box": (solids.box(2.0, 3.0, 4.0, (5, 5, 5)), 24, 52, (5, 5, 7)),
    "frustum": (solids.frustum(2.0, 2.0, 1.0, 1.0, 3.0), 7, 5 + 6 * math.hypot(3, 0.5), None),
    "cylinder": (round_solids.cylinder(0.5, 2.0, sides=400), math.pi / 2, 2.5 * math.pi, (0, 0, 1)),
    "cone": (
        round_solids.cylinder(1.0, 2.0, top=0.0, sides=400),
        2 * math.pi / 3,
        math.pi * (1 + math.sqrt(5)),
        (0, 0, 0.5),
    ),
    "ball": (round_solids.ball(1.0, (1, 2, 3), 400), 4 * math.pi / 3, 4 * math.pi, (1, 2, 3)),
    "rod": (round_solids.rod((1, 1, 1), (3, 3, 2), 0.1, 400), 3 * math.pi * 0.01, None, (2, 2, 1.5)),
    "slab": (solids.slab([(0, 0), (2, 0), (0, 2)], 0.5), 1, None, (2 / 3, 2 / 3, 0)),
    "side view": (
        solids.side_prism([(0, 0), (4, 0), (4, 1), (0, 3)], 0.5), 4, 16 + 0.5 * (8 + math.sqrt(20)), None,
    ),
    "tray": (solids.tray(4.0, 3.0, 2.0, 0.5, 0.5), 15, 67, None),
    "ribbon": (solids.ribbon(LINE, LINE, 0.5, 2.0), 3, 17, (1.5, 0, 1)),
    "disc": (solids.prism(CIRCLE, 0.5), 0.5 * math.pi, 3 * math.pi, (0, 0, 0.25)),
    "block": (solids.block((1, 2, 3), (4, 5, 6)), 6, 22, (4, 5, 6)),
    "mirrored block": (solids.block((1, 2, 3), (4, 5, 6)).scale(-1, 1, 1), -6, 22, (-4, 5, 6)),
    "revolution": (round_solids.revolution([(2, 0), (2, 3)], 24, "rims"), 12 * POLYGON, None, (0, 0, 1.5)),
    "tip": (round_solids.revolution([(3, 0), (0, 3)], 24, "rims"), 9 * POLYGON, None, (0, 0, 0.75)),
    "bar along x": (round_solids.bar((0, 0, 0), (5, 0, 0), 1.0, sides=24), 5 * POLYGON, None, (2.5, 0, 0)),
    "bar askew": (round_solids.bar((1, 1, 1), (1, 4, 5), 2.0, sides=24), 20 * POLYGON, None, (1, 2.5, 3)),
    "wheel": (round_solids.wheel((1, 2, 3), 1.0, 0.5, 24), 0.5 * POLYGON, None, (1, 2, 3)),
    "side plate": (solids.side_plate(RECTANGLE, 3.0, 0.5), 1, 2 * 2 + 6 * 0.5, (3, 1, 0.5)),
    "rectangles": (
        solids.loft_rectangles([(1, -1, 1, 0), (0.5, -0.5, 0.5, 3)]),
        4 + 1 + math.sqrt(4),
        None,
        (0, 0, 33 / 28),  # h/4 (A + 2√(AB) + 3B) / (A + √(AB) + B)
    ),
    "bevelled": (
        solids.loft([solids.bevelled(4, 0, 2, y, 0.5) for y in (0, 3)], "sharp"),
        -3 * (8 - 4 * 0.5**2 / 2),
        None,
        (0, 1.5, 1),
    ),
    # the cross-section of the tube is an octagon, with the area and circumference of an octagon in a circle
    "ring": (
        round_solids.ring(1.0, 0.25, sides=400),
        2 * math.pi * 0.25**2 * 4 * math.sin(math.pi / 4),
        2 * math.pi * 16 * 0.25 * math.sin(math.pi / 8),
        (0, 0, 0),
    ),
    "torus": (
        round_solids.torus((1, 2, 3), 2.0, 1.0, sides=400, around=200), -(math.pi**2), 4 * math.pi**2, (1, 2, 3),
    ),
    "ellipsoid": (round_solids.ellipsoid((1, 2, 3), (1, 2, 3), 400, 201), 8 * math.pi, None, (1, 2, 3)),
}  # fmt: skip


def measures(solid: Solid) -> tuple[float, float, np.ndarray]:
    """Return volume (negative if the faces run clockwise seen from outside), area and centre of mass."""
    corners = solid.vertices[solid.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    cones = (corners.mean(1) * area).sum(1) / 3  # volumes between the origin and each triangle
    center = (cones[:, None] * corners.sum(1) / 4).sum(0) / cones.sum()
    return float(cones.sum()), float(np.linalg.norm(area, axis=1).sum()), center


ROUND = {"cylinder", "cone", "ball", "rod", "disc", "ring", "torus", "ellipsoid"}
"""Solids that approximate the one whose formula is given; the formulas of all others are exact."""


@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_is_closed_and_has_its_volume_area_and_center(name):
    solid, volume, area, center = SOLIDS[name]
    tolerance = 5e-4 if name in ROUND else 1e-12
    assert solid.faces.dtype == np.int64
    measured_volume, measured_area, measured_center = measures(solid)
    assert measured_volume == pytest.approx(volume, rel=tolerance)
    if area is not None:
        assert measured_area == pytest.approx(area, rel=tolerance)
    if center is not None:
        np.testing.assert_allclose(measured_center, center, atol=1e-9)
    solid = solids.drop_degenerate(solid)
    corners = np.unique(np.round(solid.vertices, 9) + 0.0, axis=0, return_inverse=True)[1].reshape(-1)
    faces = corners[solid.faces]
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    count = len(solid.vertices)
    # the faces pass every edge equally often in both directions: there is no hole, and no face is inside out
    np.testing.assert_array_equal(np.sort(start * count + end), np.sort(end * count + start))


def test_mirror_images_and_rotations_keep_normals_outwards():
    cone = round_solids.cylinder(0.3, 1.0, top=0.1).move(1.0)
    whole = solids.with_mirror(cone.rotate("x", 30.0).rotate("y", 40.0).rotate("z", 50.0), 0)
    assert measures(whole)[0] == pytest.approx(2 * measures(cone)[0])
    assert np.isfinite(normals(Mesh("both", whole.vertices, whole.faces))).all()
