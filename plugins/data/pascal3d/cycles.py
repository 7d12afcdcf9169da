"""Parametric two-wheelers, bicycle and motorbike; all lengths are in metres."""

from itertools import pairwise

import numpy as np
from numpy.random import Generator

from framework.geometry.round_solids import bar, ellipsoid, torus, wheel
from framework.geometry.solids import bevelled, block, loft, plate
from plugins.data.pascal3d.paint import DARK, GLASS, LAMP, METAL, RUBBER, TAIL_LAMP, paint, shade
from plugins.data.pascal3d.shapes import Body, offset_point


def bicycle(random: Generator) -> Body:
    """Return a bicycle with a diamond or step-through frame, a saddle, a handlebar and cranks."""
    body = Body()
    frame = paint(random, vivid=True)
    size = random.uniform(0.32, 0.36)
    base = random.uniform(0.5, 0.56)
    thick = random.uniform(0.04, 0.055)
    front, rear = np.array([0, -base, size]), np.array([0, base - 0.06, size])
    for hub in (front, rear):
        body.add(torus(hub, size - 0.02, 0.055), RUBBER)
        body.add(torus(hub, size - 0.06, 0.025, around=4), METAL)
        body.add(wheel(hub, 0.04, 0.1, 8), METAL)
        for angle in np.arange(4) * np.pi / 4 + random.uniform(0, 1):
            spoke = np.array([0, np.cos(angle), np.sin(angle)]) * (size - 0.05)
            body.add(bar(hub - spoke, hub + spoke, 0.007, sides=3), METAL)

    crank = np.array([0, 0.08, size - 0.04])
    seat = np.array([0, 0.24, size + random.uniform(0.4, 0.48)])
    head = np.array([0, -base + 0.2, size + random.uniform(0.38, 0.44)])
    crown, joint = offset_point(head, 0, -0.035, -0.12), offset_point(seat, 0, -0.02, -0.1)
    end = crank + 0.35 * (seat - crank) if random.random() < 0.3 else joint
    for ends in ((head, end), (crown, crank), (crank, seat), (offset_point(head, 0, 0.01, 0.04), crown)):
        body.add(bar(*ends, thick / 2), frame)
    for hub, tip, gap in ((rear, crank, 0.05), (rear, joint, 0.05), (front, crown, 0.06)):
        body.pair(bar(offset_point(hub, gap, 0, 0), offset_point(tip, 0.02, 0, 0), thick / 3), frame)
    post = seat + 0.16 * (seat - crank)
    body.add(bar(seat, post, 0.015), METAL)
    body.add(ellipsoid(offset_point(post, 0, 0.03, 0.02), (0.075, 0.14, 0.035), 8, 5), DARK)

    stem = offset_point(head, 0, 0, random.uniform(0.08, 0.14))
    grip = offset_point(
        stem, random.uniform(0.22, 0.28), random.uniform(-0.02, 0.14), random.uniform(0.0, 0.06)
    )
    body.add(bar(head, stem, 0.018), METAL)
    body.pair(bar(stem, grip, 0.017), METAL)
    body.pair(bar(grip, offset_point(grip, 0.02, 0.11, -0.02), 0.024), DARK)
    pedal = offset_point(crank, 0.07, 0.1, -0.13)
    body.add(wheel(crank, 0.09, 0.02, 10), METAL)
    body.pair(bar(offset_point(crank, 0.06, 0, 0), pedal, 0.014), METAL)
    body.pair(block((0.09, 0.08, 0.03), offset_point(pedal, 0.05, 0, 0)), DARK)
    if random.random() < 0.4:
        body.add(block((0.14, 0.06, 0.12), offset_point(stem, 0, -0.1, -0.02)), LAMP)
    if random.random() < 0.35:
        body.add(block((0.16, 0.34, 0.03), offset_point(rear, 0, 0, size + 0.07)), DARK)
        body.add(block((0.06, 0.03, 0.06), offset_point(rear, 0, 0.2, size + 0.03)), TAIL_LAMP)
    return body


def motorbike(random: Generator) -> Body:
    """Return a road motorbike with fat tyres, a tank, an exhaust on either side, and a headlamp."""
    body = Body()
    skin = paint(random, vivid=True)
    base, size = random.uniform(0.7, 0.8), random.uniform(0.29, 0.33)
    front, rear = np.array([0, -base, size]), np.array([0, base, size])
    for hub, tyre in ((front, 0.13), (rear, 0.17)):
        body.add(torus(hub, size - tyre / 2, tyre, 18, 6), RUBBER)
        body.add(wheel(hub, 0.6 * size, 0.05, 10), METAL)
        body.add(wheel(hub, 0.2 * size, 0.14, 8), DARK)

    head = np.array([0, -0.44, 0.86])
    stem = offset_point(head, 0, 0.04, random.uniform(0.1, 0.2))
    grip = offset_point(stem, 0.34, random.uniform(0.08, 0.2), 0.02)
    body.pair(bar(offset_point(front, 0.09, 0, 0), offset_point(head, 0.08, 0, 0), 0.032), METAL)
    body.add(bar(head, stem, 0.03), METAL)
    body.pair(bar(stem, grip, 0.022), METAL)
    body.pair(bar(offset_point(grip, -0.12, -0.04, 0), grip, 0.035), DARK)
    body.pair(bar(offset_point(stem, 0.2, 0.02, 0), offset_point(stem, 0.26, 0, 0.2), 0.012), METAL)
    body.pair(block((0.13, 0.03, 0.09), offset_point(stem, 0.28, 0, 0.22)), DARK)  # mirrors
    body.add(ellipsoid(offset_point(head, 0, -0.1, 0.05), (0.12, 0.09, 0.12), 10, 7), DARK)
    body.add(ellipsoid(offset_point(head, 0, -0.14, 0.05), (0.1, 0.07, 0.1), 10, 7), LAMP)

    body.add(ellipsoid((0, -0.14, 0.83), (0.17, 0.32, 0.15)), skin)  # tank
    seat = ((0.2, 0.72, 0.86, 0.1), (0.3, 0.7, 0.8, 0.3), (0.28, 0.74, 0.85, 0.55), (0.16, 0.84, 0.92, 0.85))
    body.add(loft([bevelled(*section, bevel=0.4) for section in seat], "sharp"), DARK)
    body.add(loft([bevelled(0.24, 0.62, 0.73, 0.25), bevelled(0.14, 0.76, 0.85, 0.92)], "sharp"), skin)
    body.add(block((0.14, 0.05, 0.08), (0, 0.94, 0.8)), TAIL_LAMP)
    body.add(block((0.34, 0.42, 0.3), (0, 0.02, 0.42)), METAL)  # engine
    body.add(block((0.26, 0.2, 0.28), (0, -0.1, 0.6)), shade(METAL, 0.7))
    body.pair(wheel((0.16, 0.1, 0.4), 0.12, 0.1, 10), shade(METAL, 0.8))
    for start, end in pairwise([(0, -0.4, 0.8), (0, -0.2, 0.3), (0, 0.4, 0.3), (0, 0.3, 0.72)]):
        body.add(bar(start, end, 0.035), DARK)
    body.pair(bar(offset_point(rear, 0.12, 0, 0), (0.12, 0.2, 0.4), 0.03), METAL)
    body.pair(bar((0.15, -0.2, 0.45), (0.17, 0.1, 0.26), 0.035), METAL)
    body.pair(bar((0.17, 0.1, 0.26), (0.2, 0.85, 0.42), 0.04, 0.06, sides=8), METAL)  # exhaust

    radius = size + 0.04
    arc = [
        offset_point(front, 0, radius * np.cos(angle), radius * np.sin(angle))
        for angle in (0.6, 1.2, 1.9, 2.5)
    ]
    for start, end in pairwise(arc):  # mudguard
        corners = [
            offset_point(point, x, 0, 0)
            for point, x in ((start, 0.07), (start, -0.07), (end, -0.07), (end, 0.07))
        ]
        body.add(plate(corners, (0, 0, 0.03)), skin)
    if random.random() < 0.4:  # fairing and screen
        nose = ((0.16, 0.72, 0.88, -0.72), (0.38, 0.55, 1.0, -0.42), (0.34, 0.45, 0.8, -0.15))
        screen = [(0.14, -0.5, 1.0), (-0.14, -0.5, 1.0), (-0.1, -0.36, 1.2), (0.1, -0.36, 1.2)]
        body.add(loft([bevelled(*section, bevel=0.4) for section in nose], "sharp"), skin)
        body.add(plate(screen, (0, 0.02, 0)), GLASS)
        body.pair(block((0.1, 0.04, 0.08), (0.08, -0.7, 0.82)), LAMP)
    return body
