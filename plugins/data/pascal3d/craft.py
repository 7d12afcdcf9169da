"""Parametric aeroplanes and boats; all lengths are in metres."""

import numpy as np
from numpy.random import Generator

from framework.geometry.round_solids import bar, wheel
from framework.geometry.solids import Solid, block, loft, loft_rectangles, plate, side_plate
from plugins.data.pascal3d.paint import DARK, GLASS, METAL, RUBBER, paint, shade
from plugins.data.pascal3d.shapes import Array, Body, offset_point


def aeroplane(random: Generator) -> Body:
    """Return a jet airliner, or a light aircraft with a propeller."""
    body = Body()
    skin = shade((0.9, 0.9, 0.92), random.uniform(0.8, 1.05)) if random.random() < 0.6 else paint(random)
    mark = paint(random)
    jet = random.random() < 0.65
    length = random.uniform(9, 12) if jet else random.uniform(6.5, 8)
    radius = length * (random.uniform(0.055, 0.07) if jet else random.uniform(0.065, 0.08))
    nose, tail = -0.45 * length, 0.55 * length
    body.add(_fuselage(length, nose, radius), skin)
    screen = (1.2 * radius, 0.035 * length, 0.45 * radius)
    body.add(block(screen, (0, nose + 0.085 * length, 0.62 * radius)), GLASS)
    body.pair(block((0.06, 0.5 * length, 0.3 * radius), (radius, -0.02 * length, 0.15 * radius)), mark)

    span = length * random.uniform(0.42, 0.52)
    sweep = length * (random.uniform(0.14, 0.24) if jet else random.uniform(0.0, 0.03))
    chord = length * random.uniform(0.15, 0.2)
    root = length * random.uniform(-0.12, -0.05) if jet else -0.2 * length
    height = -0.5 * radius if jet or random.random() < 0.4 else 1.0 * radius
    lift = span * random.uniform(0.04, 0.12)
    wing = [
        (0.3 * radius, root, height),
        (span, root + sweep, height + lift),
        (span, root + sweep + chord * (0.35 if jet else 0.8), height + lift),
        (0.3 * radius, root + chord * (1.25 if jet else 1.0), height),
    ]
    body.pair(plate(wing, (0, 0, 0.18 * radius)), shade(skin, 0.85))
    reach = span * random.uniform(0.34, 0.42)
    stabiliser = [
        (0, tail - 0.13 * length, 0.5 * radius),
        (reach, tail - 0.13 * length + 0.4 * sweep, 0.6 * radius),
        (reach, tail - 0.05 * length + 0.4 * sweep, 0.6 * radius),
        (0, tail - 0.02 * length, 0.5 * radius),
    ]
    body.pair(plate(stabiliser, (0, 0, 0.12 * radius)), shade(skin, 0.85))
    tip = 0.7 * radius + length * random.uniform(0.13, 0.18)
    fin = [
        (tail - 0.2 * length, 0.6 * radius),
        (tail - 0.01 * length, 0.7 * radius),
        (tail + 0.04 * length, tip),
        (tail - 0.05 * length, tip),
    ]
    body.add(side_plate(fin, 0, 0.18 * radius), mark)

    if jet:
        for share in (0.34,) if random.random() < 0.7 else (0.28, 0.55):  # of the span
            along = root + share * sweep - 0.25 * chord
            engine = np.array([share * span, along, height + share * lift - 0.55 * radius])
            front = offset_point(engine, 0, -0.6 * chord, 0)
            behind = offset_point(engine, 0, 0.35 * chord, 0)
            body.pair(bar(front, behind, 0.42 * radius, 0.3 * radius, sides=10), METAL)
            body.pair(
                bar(
                    offset_point(front, 0, -0.02, 0),
                    offset_point(front, 0, -0.05, 0),
                    0.34 * radius,
                    sides=10,
                ),
                DARK,
            )
    else:
        hub = np.array([0, nose - 0.15, -0.2 * radius])
        body.add(bar(offset_point(hub, 0, -0.15, 0), offset_point(hub, 0, 0.25, 0), 0.05, 0.3 * radius), mark)
        angle = random.uniform(0, np.pi)
        blade = np.array([np.cos(angle), 0, np.sin(angle)]) * length * 0.13
        body.add(bar(hub - blade, hub + blade, 0.07), DARK)
        axle = np.array([0.9, -0.15 * length, -2.0 * radius])
        body.pair(bar((0, -0.15 * length, -0.8 * radius), axle, 0.06), METAL)
        body.pair(wheel(offset_point(axle, 0, 0, -0.1 * radius), 0.3, 0.2, 10), RUBBER)
    return body


def _fuselage(length: float, nose: float, radius: float) -> Solid:
    stations = (0.0, 0.015, 0.05, 0.12, 0.3, 0.62, 0.82, 0.95, 1.0)
    girths = (0.1, 0.45, 0.75, 0.97, 1.0, 1.0, 0.7, 0.3, 0.12)
    rises = (-0.25, -0.2, -0.1, 0.0, 0.0, 0.0, 0.25, 0.6, 0.7)
    angle = 2 * np.pi * np.arange(14) / 14
    circle = np.stack([np.cos(angle), np.zeros(14), np.sin(angle)], axis=1)
    rings = [
        radius * girth * circle + (0, nose + station * length, rise * radius)
        for station, girth, rise in zip(stations, girths, rises, strict=True)
    ]
    return loft(rings, "rims")


def boat(random: Generator) -> Body:
    """Return a sailing boat, a motor boat with a cabin, or an open rowing boat, with the bow in front."""
    body = Body()
    hull = paint(random) if random.random() < 0.6 else (0.92, 0.92, 0.9)
    deck = (0.75, 0.6, 0.42) if random.random() < 0.5 else (0.85, 0.85, 0.82)
    length, kind = random.uniform(5, 7), random.random()
    beam = length * random.uniform(0.26, 0.34)
    depth = length * random.uniform(0.12, 0.16)
    along = np.array([-0.5, -0.44, -0.3, -0.1, 0.15, 0.5]) * length
    half = np.array([0.02, 0.28, 0.68, 0.97, 1.0, random.uniform(0.65, 0.9)]) * beam / 2
    rim = np.array([1.35, 1.27, 1.15, 1.03, 0.98, 1.0]) * depth
    body.add(_hull(along, half, rim, np.zeros(6)), hull)
    body.add(_hull(0.97 * along, 0.9 * half, rim + 0.03, rim - 0.05), deck)
    body.add(_hull(1.005 * along, 1.02 * half, 0.35 * rim, np.full(6, -0.03)), shade(paint(random), 0.6))

    if kind < 0.45:  # sailing boat
        mast, high = -0.08 * length, length * random.uniform(0.95, 1.2)
        sail = (0.95, 0.94, 0.9) if random.random() < 0.7 else paint(random, vivid=True)
        boom = depth + 0.12 * high
        main = [(mast + 0.1, boom), (mast + 0.44 * length, boom), (mast + 0.1, depth + 0.97 * high)]
        bow = (-0.49 * length, 1.45 * depth)
        jib = [(mast - 0.08, depth + 0.85 * high), bow, (mast - 0.08, 1.5 * depth)]
        body.add(bar((0, mast, depth), (0, mast, depth + high), 0.06, sides=8), METAL)
        body.add(bar((0, mast, boom), (0, mast + 0.46 * length, boom), 0.05), METAL)
        body.add(side_plate(main, 0, 0.05), sail)
        body.add(side_plate(jib, 0, 0.05), shade(sail, 0.93))
        body.add(block((0.4 * beam, 0.28 * length, 0.5 * depth), (0, 0.02 * length, 1.25 * depth)), deck)
    elif kind < 0.85:  # motor boat
        front, behind = -0.16 * length, random.uniform(0.1, 0.25) * length
        floor, high = 0.95 * depth, depth * random.uniform(1.3, 1.9)
        roof = floor + high

        def level(share: float, grow: float = 0.0) -> tuple[float, float, float, float]:
            """Return the outline of the cabin at a share of its height, enlarged by `grow`."""
            wide = (0.33 - 0.03 * share) * beam + grow
            return wide, front + 0.1 * share * length - grow, behind + grow, floor + share * high

        body.add(loft_rectangles([level(0.0), level(1.0)]), (0.93, 0.93, 0.92))
        body.add(loft_rectangles([level(0.45, 0.02), level(0.79, 0.02)]), GLASS)
        size = (0.66 * beam, behind - front - 0.06 * length, 0.1)
        body.add(block(size, (0, (front + behind) / 2 + 0.06 * length, roof)), hull)
        body.add(bar((0, behind - 0.2, roof), (0, behind - 0.1, roof + 0.7 * high), 0.04), METAL)
        body.add(block((0.3, 0.35, 0.5), (0, 0.53 * length, 0.85 * depth)), DARK)  # outboard motor
        for share in (-0.42, -0.32, -0.22):  # railing
            foot = np.array([0.85 * np.interp(share * length, along, half), share * length, depth])
            body.pair(bar(foot, offset_point(foot, 0, 0, 0.9 * depth), 0.035), METAL)
    else:  # rowing boat
        for share in (-0.2, 0.05, 0.3):
            wide = 1.8 * float(np.interp(share * length, along, half))
            body.add(block((wide, 0.3, 0.08), (0, share * length, 1.06 * depth)), shade(deck, 0.6))
        blade = (1.25 * beam, 0.25 * length, 0.3 * depth)
        body.pair(bar((0.25 * beam, 0.02 * length, 1.5 * depth), blade, 0.05), shade(deck, 0.8))
        body.pair(block((0.5, 0.25, 0.06), blade), shade(deck, 0.8))
    return body


def _hull(along: Array, half: Array, rim: Array, keel: Array) -> Solid:
    """Return the hull of a boat from bow to stern.

    Args:
        along: Positions (y) along the boat.
        half: Half width at each position.
        rim: Height of the rim at each position.
        keel: Height of the keel at each position.
    """
    rings = []
    for y, wide, high, low in zip(along, half, rim, keel, strict=True):
        side = [(1.0, high), (0.92, 0.45 * high + 0.55 * max(low, 0.0)), (0.5, low)]
        outline = side + [(-x, z) for x, z in reversed(side)]
        rings.append([(wide * x, y, z) for x, z in outline])
    return loft(rings, "sharp")
