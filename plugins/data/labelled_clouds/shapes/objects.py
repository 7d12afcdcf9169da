"""Vessels, machine parts and other things as random solids, z up."""

import math
from collections.abc import Sequence

import numpy as np

from plugins.data.labelled_clouds.shapes.solids import (
    Number,
    Point,
    Solid,
    ball,
    box,
    cylinder,
    extruded,
    joined,
    mirrored,
    revolved,
    ring,
    rod,
    slab,
    swept,
    tapered,
)

Random = np.random.Generator


def walled(outer: Sequence[Point], wall: Number, floor: Number, sides: int = 28) -> Solid:
    """A vessel: an outer profile (radius, height) from the foot to the rim, and the same inside, above a floor."""
    inside = [(max(r - wall, 0.0), z) for r, z in reversed(outer) if z > floor]
    return revolved([*outer, *inside, (0.0, floor)], sides)


def curve(random: Random, controls: Sequence[Point], steps: int = 14) -> list[tuple[float, float]]:
    """A smooth profile through a few points (radius, height): cosine steps between them."""
    radii, heights = np.array(controls).T
    at = np.linspace(0, len(controls) - 1, steps)
    left = np.minimum(at.astype(int), len(controls) - 2)
    blend = 0.5 - 0.5 * np.cos(math.pi * (at - left))
    r = radii[left] + blend * (radii[left + 1] - radii[left])
    z = heights[left] + (at - left) * (heights[left + 1] - heights[left])
    return [(float(a), float(b)) for a, b in zip(r, z, strict=True)]


def bottle(random: Random) -> Solid:
    radius, height = random.uniform(0.09, 0.2), random.uniform(0.5, 0.8)
    neck = radius * random.uniform(0.25, 0.55)
    shoulder, start = random.uniform(0.5, 0.72) * height, random.uniform(0.72, 0.85) * height
    outer = [(radius, 0.0), (radius * random.uniform(0.85, 1), shoulder * 0.5), (radius, shoulder)]
    outer += [(neck, start), (neck, height)]
    parts = [walled(curve(random, outer, 20), 0.012, 0.02)]
    if random.random() < 0.5:
        parts.append(cylinder(neck * 1.15, height * 0.06, (0, 0, height * 0.96)))
    return joined(parts)


def vase(random: Random) -> Solid:
    height = random.uniform(0.4, 0.8)
    belly, neck = random.uniform(0.1, 0.26), random.uniform(0.05, 0.15)
    foot, rim = random.uniform(0.06, 0.15), neck * random.uniform(0.9, 1.8)
    outer = [(foot, 0.0), (belly, random.uniform(0.25, 0.6) * height), (neck, 0.8 * height), (rim, height)]
    parts = [walled(curve(random, outer, 20), 0.012, 0.02)]
    if random.random() < 0.25:  # handles
        path = [(neck, 0, 0.85 * height), (belly + 0.08, 0, 0.75 * height), (belly, 0, 0.5 * height)]
        parts.append(mirrored(swept(path, [0.015] * 3), 0))
    if random.random() < 0.3:  # flowers
        for _ in range(int(random.integers(2, 6))):
            angle, spread = random.uniform(0, 2 * math.pi), random.uniform(0.05, 0.2)
            tip = (spread * math.cos(angle), spread * math.sin(angle), height * random.uniform(1.2, 1.6))
            parts += [rod((0, 0, 0.3 * height), tip, 0.008), ball(random.uniform(0.02, 0.05), tip, 8)]
    return joined(parts)


def flower_pot(random: Random) -> Solid:
    radius, height = random.uniform(0.12, 0.24), random.uniform(0.15, 0.36)
    foot = radius * random.uniform(0.6, 0.9)
    outer = [(foot, 0.0), (radius * random.uniform(0.85, 1.1), 0.6 * height), (radius, height)]
    earth = height * random.uniform(0.7, 0.9)
    parts = [walled(curve(random, outer, 10), 0.015, earth)]
    if random.random() < 0.5:
        parts.append(ring(radius, 0.018, (0, 0, height)))
    if random.random() < 0.35:
        parts.append(cylinder(foot * 1.5, 0.02, top=foot * 1.6, sides=24))
    for _ in range(int(random.choice([0, 4, 7, 12]))):  # leaves
        angle, spread = random.uniform(0, 2 * math.pi), random.uniform(0.05, 0.3)
        x, y, z = math.cos(angle) * spread, math.sin(angle) * spread, height + random.uniform(0.05, 0.3)
        long = random.uniform(0.05, 0.16)
        leaf = slab([(0, -0.3), (0.5, 0), (0, 0.3), (-0.5, 0)], 0.01).scaled(long, long, 1)
        leaf = leaf.turned("x", random.uniform(-60, 60)).turned("z", math.degrees(angle))
        parts += [rod((0, 0, earth), (x, y, z), 0.006), leaf.moved(x, y, z)]
    return joined(parts)


def bowl(random: Random) -> Solid:
    radius, height = random.uniform(0.2, 0.35), random.uniform(0.1, 0.28)
    foot = radius * random.uniform(0.3, 0.65)
    outer = [(foot, 0.0), (radius * random.uniform(0.75, 0.97), 0.5 * height), (radius, height)]
    parts = [walled(curve(random, outer, 14), 0.015, 0.025)]
    if random.random() < 0.35:
        parts.append(ring(foot, 0.012))
    if random.random() < 0.2:  # fruit
        for _ in range(int(random.integers(2, 5))):
            size = radius * random.uniform(0.18, 0.3)
            x, y = random.uniform(-0.4, 0.4, 2) * radius
            parts.append(ball(size, (x, y, 0.5 * height), 10))
    return joined(parts)


def mug(random: Random) -> Solid:
    radius, height = random.uniform(0.09, 0.14), random.uniform(0.16, 0.32)
    foot = radius * random.uniform(0.65, 1)
    outer = [(foot, 0.0), (radius * random.uniform(0.9, 1.08), 0.5 * height), (radius, height)]
    bend = np.linspace(math.radians(-80), math.radians(80), 9)
    out, tall = random.uniform(0.05, 0.1), random.uniform(0.25, 0.38) * height
    path = [(radius * 0.95 + out * math.cos(b), 0.0, 0.5 * height + tall * math.sin(b)) for b in bend]
    handle = swept(path, [random.uniform(0.01, 0.018)] * len(path))
    parts = [walled(curve(random, outer, 12), 0.01, 0.015), handle]
    if random.random() < 0.15:
        parts.append(cylinder(radius * 1.8, 0.015, (0, 0, -0.015), top=radius * 1.9))
    return joined(parts)


def lamp(random: Random) -> Solid:
    height, shade = random.uniform(0.5, 1.7), random.uniform(0.15, 0.3)
    foot = random.uniform(0.1, 0.2)
    tall = random.uniform(0.2, 0.35)
    cone = [(shade, height), (shade * random.uniform(0.4, 1), height + tall)]
    parts = [
        cylinder(foot, 0.04, top=foot * random.uniform(0.5, 1)),
        cylinder(random.uniform(0.01, 0.03), height + 0.5 * tall),
        walled(cone, 0.008, height + 0.8 * tall),
    ]
    style = random.random()
    if style < 0.25:  # an arm
        reach = random.uniform(0.2, 0.45)
        arm = rod((0, 0, height), (reach, 0, height + 0.15), 0.015)
        parts = [*parts[:1], cylinder(0.018, height), arm]
        parts.append(revolved([(shade * 0.7, 0), (0.03, 0.2)]).moved(reach, 0, height))
    elif style < 0.5:  # a thick body
        belly = curve(random, [(foot * 0.6, 0.0), (foot, 0.25 * height), (0.03, 0.7 * height)], 12)
        parts.append(revolved(belly, 20))
    return joined(parts)


def monitor(random: Random) -> Solid:
    width = random.uniform(0.45, 1.1)
    height, thick = width * random.uniform(0.52, 0.8), random.uniform(0.03, 0.08)
    lift = random.uniform(0.06, 0.25)
    frame = 0.03
    parts = [
        box(width, thick, height, (0, 0, lift)),
        box(width, 0.03, frame, (0, -thick / 2, lift)),
        box(width, 0.03, frame, (0, -thick / 2, lift + height - frame)),
        box(random.uniform(0.04, 0.12), 0.04, lift + 0.1, (0, thick / 2, 0)),
    ]
    parts += [box(frame, 0.03, height, (side * (width - frame) / 2, -thick / 2, lift)) for side in (-1, 1)]
    if random.random() < 0.5:
        parts.append(box(width * random.uniform(0.3, 0.6), random.uniform(0.15, 0.25), 0.02))
    else:
        parts.append(cylinder(random.uniform(0.1, 0.18), 0.02, sides=24))
    if random.random() < 0.2:  # a tube
        depth = random.uniform(0.2, 0.4)
        tube = tapered(width * 0.9, height * 0.9, width * 0.5, height * 0.5, depth).turned("x", -90)
        parts.append(tube.moved(0, thick / 2, lift + height / 2))
    return joined(parts)


def ladder(random: Random) -> Solid:
    height, width = random.uniform(1.4, 3.0), random.uniform(0.35, 0.55)
    bar = random.uniform(0.03, 0.06)
    narrow = random.choice([1.0, 1.0, 0.75])
    count = int(random.integers(4, 11))
    parts = [
        rod((side * width / 2, 0, 0), (side * width / 2 * narrow, 0, height), bar / 2) for side in (-1, 1)
    ]
    for z in np.linspace(0.08, 0.94, count) * height:
        half = width / 2 * (1 + (narrow - 1) * z / height)
        if random.random() < 0.98:
            parts.append(rod((-half, 0, z), (half, 0, z), bar * 0.35))
    front = joined(parts)
    if random.random() < 0.4:  # a stepladder
        lean = random.uniform(10, 18)
        feet = [
            rod((side * width / 2, 0, 0), (side * width / 2 * narrow, 0, height), bar / 2.5)
            for side in (-1, 1)
        ]
        front = front.turned("x", -lean).moved(0, -height * math.sin(math.radians(lean)), 0)
        rear = joined(feet).turned("x", lean).moved(0, height * math.sin(math.radians(lean)), 0)
        lid = box(width * narrow * 1.1, 0.18, 0.04, (0, 0, height * math.cos(math.radians(lean))))
        return joined([front, rear, lid])
    return front.turned("x", -random.uniform(0, 25))


def gear(random: Random) -> Solid:
    teeth, radius = int(random.integers(8, 25)), 0.5
    tooth, thick = random.uniform(0.06, 0.13), random.uniform(0.08, 0.3)
    width = random.uniform(0.35, 0.6)
    angle, reach = [], []
    for number in range(teeth):
        for share, level in (
            (0, 0),
            (0.5 - width / 2, 0),
            (0.5 - width / 4, 1),
            (0.5 + width / 4, 1),
            (0.5 + width / 2, 0),
        ):
            angle.append(2 * math.pi * (number + share) / teeth)
            reach.append(radius + tooth * level)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    bore = random.uniform(0.06, 0.25)
    body = extruded(direction * np.array(reach)[:, None], thick, direction * bore)
    parts = [body]
    if random.random() < 0.5:
        hub = random.uniform(bore + 0.05, 0.4)
        tall = thick + random.uniform(0.05, 0.25)
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        parts.append(extruded(circle * hub, tall, circle * bore))
    solid = joined(parts)
    return solid.turned("x", 90).moved(0, 0, radius) if random.random() < 0.2 else solid


def bolt(random: Random) -> Solid:
    radius, length = random.uniform(0.08, 0.16), random.uniform(0.4, 1.1)
    wide, thick = radius * random.uniform(1.5, 2.2), random.uniform(0.08, 0.2)
    head = random.integers(3)
    if head == 0:
        parts = [cylinder(wide, thick, sides=6)]
    elif head == 1:
        parts = [cylinder(wide, thick, top=wide * 0.8, sides=24)]
    else:
        parts = [revolved([(wide * math.cos(b), thick * math.sin(b)) for b in np.linspace(0, 1.5, 6)])]
    steps = int(random.integers(6, 14))
    depth = radius * random.uniform(0.05, 0.15)
    bare = random.uniform(0, 0.5) * length
    thread = [(radius * 0.7, -length), (radius, -length + 0.03)]
    for z in np.linspace(-length + 0.05, -bare, steps):
        thread += [(radius, float(z)), (radius - depth, float(z) + 0.5 * (length - bare) / steps)]
    parts.append(revolved([*thread, (radius, 0.0)], 18))
    if random.random() < 0.3:  # a nut
        parts.append(cylinder(wide, thick, (0, 0, -length * random.uniform(0.5, 0.95)), sides=6))
    if random.random() < 0.2:
        parts.append(cylinder(wide * 1.25, 0.03, (0, 0, -0.03), sides=24))
    solid = joined(parts).turned("x", 180)
    return solid.turned("y", 90) if random.random() < 0.2 else solid


def airplane(random: Random) -> Solid:
    length, radius = random.uniform(2.2, 3.4), random.uniform(0.13, 0.24)
    nose = random.uniform(0.1, 0.2)
    profile = [(0.02, 0.0), (0.75 * radius, nose * 0.5 * length), (radius, nose * length)]
    profile += [(radius, 0.65 * length), (0.2 * radius, length)]
    body = revolved(curve(random, profile, 20), 16).turned("x", 90).moved(0, length / 2, 0)
    body = body.turned("z", 180)
    span, chord = random.uniform(1.0, 1.7), random.uniform(0.3, 0.6)
    sweep, taper = random.uniform(-0.05, 0.8), random.uniform(0.3, 0.8)
    at = random.uniform(-0.15, 0.15) * length
    z = random.choice([-0.5, 0.0, 0.8]) * radius

    def wing(half: float, root: float, back: float) -> Solid:
        end = root * taper
        outline = [(0.0, -root / 2), (half, back - end / 2), (half, back + end / 2), (0.0, root / 2)]
        return slab(outline, 0.04)

    tail = length * 0.44
    parts = [
        body,
        mirrored(wing(span, chord, sweep).moved(0, at, z), 0),
        mirrored(wing(span * random.uniform(0.3, 0.42), chord * 0.6, 0.15).moved(0, tail, 0.3 * radius), 0),
        wing(random.uniform(0.35, 0.55), chord * 0.7, 0.2).turned("y", -90).moved(0, tail, 0),
    ]
    engines = int(random.choice([0, 1, 1, 2]))
    for number in range(engines):
        x = span * (0.3 + 0.28 * number)
        engine = (
            cylinder(0.07, 0.35, sides=12).turned("x", 90).moved(x, at + sweep * x / span + 0.05, z - 0.09)
        )
        parts.append(mirrored(engine, 0))
    return joined(parts)
