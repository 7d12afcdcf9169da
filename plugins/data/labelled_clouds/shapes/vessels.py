"""Random solids of vessels, plants, cones and sanitary ware, metres, z up."""

import math
from collections.abc import Sequence

import numpy as np

from framework.geometry.round_solids import ball, cylinder, revolution, ring, rod, tube
from framework.geometry.solids import Number, Point, Solid, box, frustum, join, slab, tray, with_mirror
from plugins.data.labelled_clouds.shapes.cabinets import fronts

Random = np.random.Generator


def vessel(outer: Sequence[Point], wall: Number, floor: Number, sides: int = 28) -> Solid:
    """Return a vessel of revolution.

    Args:
        outer: Outer profile (radius, height) from the foot to the rim; the radii of the inner profile are smaller by
            `wall`.
        wall: Thickness of the wall.
        floor: Height of the floor.
        sides: Number of sides of the polygon that approximates a circle.
    """
    inside = [(max(r - wall, 0.0), z) for r, z in reversed(outer) if z > floor]
    return revolution([*outer, *inside, (0.0, floor)], sides)


def smooth_profile(random: Random, controls: Sequence[Point], steps: int = 14) -> list[tuple[float, float]]:
    """Return a smooth profile through the points `controls` (radius, height); between them the radius follows a cosine.

    `steps` is the number of points of the returned profile.
    """
    radii, heights = np.array(controls).T
    at = np.linspace(0, len(controls) - 1, steps)
    left = np.minimum(at.astype(int), len(controls) - 2)
    blend = 0.5 - 0.5 * np.cos(math.pi * (at - left))
    r = radii[left] + blend * (radii[left + 1] - radii[left])
    z = heights[left] + (at - left) * (heights[left + 1] - heights[left])
    return [(float(a), float(b)) for a, b in zip(r, z, strict=True)]


def ear(reach: Number, low: Number, high: Number, out: Number, thick: Number) -> Solid:
    """Return a handle on the side x > 0 of a vessel of radius `reach`, between the heights `low` and `high`.

    `out` is the distance of the handle from the vessel, and `thick` the radius of its tube.
    """
    bend = np.linspace(math.radians(-80), math.radians(80), 9)
    middle, tall = (low + high) / 2, (high - low) / 2
    path = [(0.95 * reach + out * math.cos(b), 0.0, middle + tall * math.sin(b)) for b in bend]
    return tube(path, [thick] * len(path))


def leaves(
    random: Random, count: int, start: Point, spread: Number, tall: Number, long: Number
) -> list[Solid]:
    """Return `count` stems that grow upwards and outwards from the point `start`, each with a leaf at its tip.

    Args:
        random: Source of all random numbers.
        count: Number of stems.
        start: The point (x, y, z) from which the stems grow.
        spread: Largest horizontal distance of a tip from the point.
        tall: Largest height of a tip above the point.
        long: Typical length of a leaf.
    """
    x, y, z = start
    parts = []
    for _ in range(count):
        angle, out = random.uniform(0, 2 * math.pi), spread * math.sqrt(random.uniform(0.05, 1))
        tip = (x + math.cos(angle) * out, y + math.sin(angle) * out, z + tall * random.uniform(0.4, 1))
        size = long * random.uniform(0.6, 1.4)
        leaf = slab([(0, -0.3), (0.5, 0), (0, 0.3), (-0.5, 0)], 0.01).scale(size, size, 1)
        leaf = leaf.rotate("x", random.uniform(-60, 60)).rotate("y", random.uniform(-40, 40))
        parts += [rod((x, y, z), tip, 0.006, sides=5), leaf.rotate("z", math.degrees(angle)).move(*tip)]
    return parts


def fronds(random: Random, count: int, start: Point, reach: Number, tall: Number) -> list[Solid]:
    """Return `count` long leaves, like palm leaves or grass, that rise from the point `start` and bend over.

    `reach` is the largest horizontal extent of the leaves, and `tall` determines their height.
    """
    x, y, z = start
    parts = []
    for _ in range(count):
        angle, far = random.uniform(0, 2 * math.pi), reach * random.uniform(0.5, 1)
        rise, droop = tall * random.uniform(0.6, 1), random.uniform(0.2, 1.1)
        along = np.linspace(0, 1, 6)
        up = rise * (along * 2 - (1 + droop) * along**2)
        path = [(far * s, 0.0, u) for s, u in zip(along, up, strict=True)]
        wide = random.uniform(0.03, 0.07) * (reach + tall) / 2
        blade = tube(path, [wide * share for share in (0.4, 0.9, 1, 0.9, 0.6, 0.15)], sides=4)
        blade = blade.scale(1, 1.6, 1).rotate("z", math.degrees(angle))
        parts.append(blade.move(x, y, z))
    return parts


def pot(random: Random) -> tuple[list[Solid], float, float]:
    """Return the parts of a pot, the height of the earth in it, and the radius of the pot."""
    radius, height = random.uniform(0.1, 0.25), random.uniform(0.15, 0.4)
    if random.random() < 0.2:  # square
        earth = height * random.uniform(0.75, 0.92)
        return (
            [tray(2 * radius, 2 * radius, height, 0.02, earth, foot=random.uniform(0.65, 1))],
            earth,
            radius,
        )
    foot = radius * random.uniform(0.55, 0.95)
    outer = [(foot, 0.0), (radius * random.uniform(0.85, 1.1), 0.6 * height), (radius, height)]
    earth = height * random.uniform(0.65, 0.92)
    parts = [vessel(smooth_profile(random, outer, 10), 0.015, earth)]
    if random.random() < 0.4:
        parts.append(ring(radius, 0.018, (0, 0, height)))
    if random.random() < 0.3:
        parts.append(cylinder(foot * 1.5, 0.02, top=foot * 1.6, sides=24))
    return parts, earth, radius


def flower_pot(random: Random) -> Solid:
    """Return a flower pot, often with a plant in it."""
    parts, earth, radius = pot(random)
    grown = random.random()
    tall = random.uniform(0.08, 0.4)
    if grown < 0.55:
        count = int(random.integers(3, 14))
        parts += leaves(random, count, (0, 0, earth), random.uniform(0.5, 1.5) * radius, tall, 0.1)
    elif grown < 0.75:
        parts += fronds(random, int(random.integers(4, 9)), (0, 0, earth), 1.3 * radius, tall)
    return join(parts)


def plant(random: Random) -> Solid:
    """Return a plant in a pot."""
    parts, earth, radius = pot(random) if random.random() < 0.85 else ([cylinder(0.08, 0.03)], 0.02, 0.15)
    kind = random.integers(4)
    tall, spread = random.uniform(0.25, 0.9), random.uniform(0.8, 2.2) * radius
    top = earth
    if random.random() < 0.4:  # a trunk
        top = earth + random.uniform(0.2, 0.8)
        parts.append(cylinder(random.uniform(0.012, 0.035), top - earth, (0, 0, earth), sides=8))
    if kind == 0:
        parts += leaves(random, int(random.integers(12, 30)), (0, 0, top), spread, tall, 0.14)
    elif kind == 1:
        parts += fronds(random, int(random.integers(7, 16)), (0, 0, top), spread + 0.2, tall)
    elif kind == 2:  # a bush of balls
        for _ in range(int(random.integers(1, 7))):
            x, y = random.uniform(-0.5, 0.5, 2) * spread
            size = random.uniform(0.35, 0.7) * max(spread, 0.12)
            parts.append(ball(size, (x, y, top + random.uniform(0.2, 0.8) * tall), 10))
        parts.append(rod((0, 0, earth), (0, 0, top + 0.5 * tall), 0.015))
    else:  # upright blades
        for _ in range(int(random.integers(5, 12))):
            angle, out = random.uniform(0, 2 * math.pi), random.uniform(0, 0.5) * radius
            x, y, lean = out * math.cos(angle), out * math.sin(angle), random.uniform(1, 2.5)
            high = top + tall * random.uniform(0.5, 1)
            blade = frustum(0.06, 0.012, 0.01, 0.006, high - earth).rotate("z", random.uniform(0, 180))
            parts.append(blade.rotate("x", -4 * lean).rotate("z", math.degrees(angle)).move(x, y, earth))
    return join(parts)


def bottle(random: Random) -> Solid:
    """Return a bottle."""
    radius, height = random.uniform(0.08, 0.22), random.uniform(0.45, 0.85)
    neck = radius * random.uniform(0.22, 0.65)
    shoulder, start = random.uniform(0.4, 0.72) * height, random.uniform(0.72, 0.88) * height
    outer = [(radius, 0.0), (radius * random.uniform(0.75, 1), shoulder * 0.5), (radius, shoulder)]
    outer += [(neck, start), (neck * random.uniform(0.9, 1.15), height)]
    body = vessel(smooth_profile(random, outer, 20), 0.012, 0.02)
    parts = [body.scale(1, random.choice([1.0, 1.0, 1.0, 0.55]), 1)]  # some are flat
    if random.random() < 0.5:
        parts.append(cylinder(neck * 1.15, height * 0.06, (0, 0, height * 0.96)))
    if random.random() < 0.12:
        parts.append(ear(radius, 0.35 * height, 0.65 * height, 0.07, 0.015))
    return join(parts)


def vase(random: Random) -> Solid:
    """Return a vase, sometimes with handles or flowers."""
    height = random.uniform(0.3, 0.85)
    belly, neck = random.uniform(0.08, 0.28), random.uniform(0.04, 0.2)
    foot, rim = random.uniform(0.05, 0.17), neck * random.uniform(0.8, 1.9)
    outer = [(foot, 0.0), (belly, random.uniform(0.2, 0.65) * height), (neck, 0.8 * height), (rim, height)]
    parts = [vessel(smooth_profile(random, outer, 20), 0.012, 0.02)]
    if random.random() < 0.2:  # handles
        path = [(neck, 0, 0.85 * height), (belly + 0.08, 0, 0.75 * height), (belly, 0, 0.5 * height)]
        parts.append(with_mirror(tube(path, [0.015] * 3), 0))
    if random.random() < 0.35:  # flowers
        for _ in range(int(random.integers(2, 8))):
            angle, spread = random.uniform(0, 2 * math.pi), random.uniform(0.05, 0.2)
            tip = (spread * math.cos(angle), spread * math.sin(angle), height * random.uniform(1.2, 1.6))
            parts += [rod((0, 0, 0.3 * height), tip, 0.008), ball(random.uniform(0.02, 0.05), tip, 8)]
    return join(parts)


def bowl(random: Random) -> Solid:
    """Return a bowl, sometimes with a stem or fruit."""
    radius, height = random.uniform(0.18, 0.36), random.uniform(0.08, 0.3)
    foot = radius * random.uniform(0.25, 0.75)
    outer = [(foot, 0.0), (radius * random.uniform(0.7, 1.02), 0.5 * height), (radius, height)]
    parts = [vessel(smooth_profile(random, outer, 14), 0.015, 0.025)]
    if random.random() < 0.35:
        parts.append(ring(foot, 0.012))
    if random.random() < 0.2:  # fruit
        for _ in range(int(random.integers(2, 5))):
            size = radius * random.uniform(0.18, 0.3)
            x, y = random.uniform(-0.4, 0.4, 2) * radius
            parts.append(ball(size, (x, y, 0.5 * height), 10))
    return join(parts)


def cup(random: Random) -> Solid:
    """Return a mug, a cup without a handle, or a goblet."""
    radius, height = random.uniform(0.08, 0.16), random.uniform(0.12, 0.34)
    foot, low = radius * random.uniform(0.5, 1), 0.0
    kind = random.random()
    parts: list[Solid] = []
    if kind < 0.15:  # a stem
        low = random.uniform(0.08, 0.2)
        parts += [cylinder(0.8 * radius, 0.015, top=0.6 * radius, sides=24), cylinder(0.015, low + 0.01)]
        foot = radius * random.uniform(0.2, 0.6)
    outer = [(foot, low), (radius * random.uniform(0.8, 1.1), low + 0.5 * height), (radius, low + height)]
    parts.append(vessel(smooth_profile(random, outer, 12), 0.01, low + 0.015))
    if 0.15 <= kind < 0.8:
        span = random.uniform(0.25, 0.4)
        low_end, high_end = (0.5 - span) * height, (0.5 + span) * height
        parts.append(ear(radius, low_end, high_end, random.uniform(0.04, 0.1), random.uniform(0.008, 0.018)))
    if random.random() < 0.15:
        parts.append(cylinder(radius * 1.8, 0.015, (0, 0, -0.015), top=radius * 1.9))
    return join(parts)


def tap(random: Random, at: Point, size: Number) -> list[Solid]:
    """Return a water tap that opens towards -y, sometimes with two knobs."""
    x, y, z = at
    reach, tall = size * random.uniform(0.6, 1.0), size * random.uniform(0.5, 1.2)
    bend = np.linspace(0, math.pi, 7)
    arch = [(x, y - reach / 2 * (1 - math.cos(b)), z + tall + 0.3 * reach * math.sin(b)) for b in bend]
    parts = [tube(arch, [0.08 * size] * len(arch)), cylinder(0.08 * size, tall, (x, y, z), sides=8)]
    if random.random() < 0.5:
        for side in (-1, 1):
            parts.append(cylinder(0.12 * size, 0.3 * size, (x + side * 0.6 * size, y, z), sides=10))
    return parts


def bathtub(random: Random) -> Solid:
    """Return a bathtub."""
    width, depth, height = random.uniform(1.3, 2.0), random.uniform(0.65, 1.0), random.uniform(0.4, 0.7)
    kind, wall = random.random(), random.uniform(0.03, 0.1)
    if kind < 0.4:
        foot = random.uniform(0.75, 1)
        parts = [tray(width, depth, height, wall, random.uniform(0.05, 0.2), foot=foot)]
    elif kind < 0.6:  # an oval basin in a block
        rim = vessel(smooth_profile(random, [(0.3, 0), (0.42, 0.5), (0.46, 1)], 9), 0.02, 0.12)
        parts = [
            tray(width, depth, height, 0.04, 0.02),
            rim.scale(width, depth, height),
            with_mirror(tray(0.1 * width, depth, height, 0.02, 0.9 * height, (0.45 * width, 0, 0)), 0),
        ]
    else:  # standing free
        rim = [(random.uniform(0.3, 0.42), 0), (0.45, 0.5), (0.5, 1)]
        tub = vessel(smooth_profile(random, rim, 10), 0.03, 0.1)
        parts = [tub.scale(width, depth, height)]
        if random.random() < 0.4:
            foot = ball(0.06, (0.28 * width, 0.25 * depth, -0.02), 8)
            parts.append(with_mirror(with_mirror(foot, 0), 1))
        if random.random() < 0.3:  # one end rises
            vertices = parts[0].vertices.copy()
            vertices[:, 2] *= 1 + 0.5 * np.clip(vertices[:, 0] / width, 0, None)
            parts[0] = Solid(vertices, parts[0].faces)
    if random.random() < 0.5:
        side = join(tap(random, (0, 0, 0), 0.2)).rotate("z", -90)
        parts.append(side.move(-0.46 * width, 0, height))
    return join(parts)


def sink(random: Random) -> Solid:
    """Return a sink, sometimes on a column or a cabinet, or with a draining board."""
    width, depth = random.uniform(0.4, 0.9), random.uniform(0.35, 0.6)
    kind, height = random.random(), random.uniform(0.12, 0.25)
    low = 0.0
    parts: list[Solid] = []
    if kind < 0.3:  # on a column
        low = random.uniform(0.5, 0.75)
        profile = [(0.13, 0), (random.uniform(0.07, 0.1), 0.5 * low), (0.14, low + 0.05)]
        parts.append(revolution(smooth_profile(random, profile, 8), 16))
    elif kind < 0.5:  # on a cabinet
        low = random.uniform(0.5, 0.75)
        parts.append(box(0.95 * width, 0.9 * depth, low))
        parts += fronts(
            random, 0.95 * width, low, (0, -0.45 * depth, 0), 1, int(random.integers(1, 3)), doors=True
        )
    bowls = 2 if kind > 0.8 else 1
    if bowls == 2 or random.random() < 0.5:
        wall = random.uniform(0.02, 0.08)
        for number in range(bowls):
            x = width * ((number + 0.5) - bowls / 2)
            parts.append(tray(width, depth, height, wall, 0.02, (x, 0, low), random.uniform(0.75, 1)))
    else:
        rim = [(random.uniform(0.2, 0.35), 0), (0.46, 0.5), (0.5, 1)]
        parts.append(
            vessel(smooth_profile(random, rim, 8), 0.04, 0.1).scale(width, depth, height).move(0, 0, low)
        )
        if random.random() < 0.5:
            parts.append(box(width, 0.12, 0.6 * height, (0, 0.5 * depth, low + 0.4 * height)))
    if random.random() < 0.3:  # a draining board
        parts.append(box(width, depth, 0.03, (bowls * width / 2 + width / 2, 0, low + height - 0.03)))
    if random.random() < 0.85:
        parts += tap(random, (0, 0.42 * depth, low + height - 0.02), random.uniform(0.15, 0.28))
    return join(parts)


def toilet(random: Random) -> Solid:
    """Return a toilet, with or without a lid."""
    high, long = random.uniform(0.35, 0.45), random.uniform(1.15, 1.5)
    foot = random.uniform(0.1, 0.15)
    profile = [(foot, 0), (random.uniform(0.08, 0.12), 0.4 * high), (0.19, high)]
    if random.random() < 0.15:  # on the wall
        profile = [(0.06, 0.4 * high), (0.17, 0.7 * high), (0.19, high)]
    parts = [vessel(smooth_profile(random, profile, 10), 0.03, 0.6 * high).scale(1, long, 1)]
    parts.append(ring(0.17, 0.025, (0, 0, high + 0.01)).scale(1, long, 1))
    behind = 0.19 * long
    lid = random.random()
    if lid < 0.5:  # closed
        parts.append(cylinder(0.19, 0.025, (0, 0, high + 0.02), sides=24).scale(1, long, 1))
    elif lid < 0.85:  # open, leaning on the tank
        plate = cylinder(0.18, 0.02, sides=24).scale(1, long, 1).move(0, -0.18 * long, 0)
        parts.append(plate.rotate("x", -random.uniform(95, 110)).move(0, behind - 0.03, high + 0.03))
    deep, wide = random.uniform(0.14, 0.22), random.uniform(0.34, 0.48)
    if random.random() < 0.85:
        start = random.choice([high - 0.03, 0.0])
        tall = random.uniform(0.3, 0.42)
        parts.append(box(wide, deep, high + tall - start, (0, behind + deep / 2, start)))
        parts.append(box(1.06 * wide, 1.08 * deep, 0.03, (0, behind + deep / 2, high + tall)))
    parts.append(box(0.2, 0.16, high, (0, behind - 0.02, 0)))
    return join(parts)


def cone(random: Random) -> Solid:
    """Return a traffic cone, a plain cone, or sometimes a cone that stands on its tip."""
    radius, height = random.uniform(0.12, 0.35), random.uniform(0.3, 0.9)
    tip = radius * random.choice([0.0, random.uniform(0.05, 0.35)])
    sides = int(random.choice([32, 32, 8, 6]))
    parts = [cylinder(radius, height, top=tip, sides=sides)]
    if random.random() < 0.6:
        wide = radius * random.uniform(1.05, 1.6)
        base = box(2 * wide, 2 * wide, 0.04, (0, 0, -0.03)) if random.random() < 0.7 else cylinder(wide, 0.03)
        parts.append(base)
    for z in np.linspace(0.3, 0.75, int(random.choice([0, 0, 1, 2]))):
        lower = radius + (tip - radius) * z + 0.008
        upper = radius + (tip - radius) * (z + 0.1) + 0.008
        parts.append(cylinder(lower, 0.1 * height, (0, 0, z * height), top=upper, sides=32))
    if random.random() < 0.15:
        scoop = ball(0.95 * radius, (0, 0, height), 14)
        return join([cylinder(tip, height, top=radius, sides=sides), scoop])
    return join(parts)
