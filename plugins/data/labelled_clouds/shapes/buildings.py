"""Random solids of parts of buildings, metres, front towards -y."""

import math

import numpy as np

from framework.geometry.round_solids import ball, cylinder, revolution, rod
from framework.geometry.solids import Number, Solid, box, frustum, join, ribbon, side_prism, tray, with_mirror

Random = np.random.Generator


def curtain(random: Random) -> Solid:
    """Return one or two curtains, pleated, straight or gathered, with or without a rail and a valance."""
    width, height = random.uniform(0.9, 2.4), random.uniform(1.2, 2.5)
    count, deep = int(random.integers(1, 3)), random.uniform(0.02, 0.09)
    wide = width / count * random.uniform(0.5, 1.0)
    pleats, shift = random.uniform(3, 9), random.uniform(0, 2 * math.pi)
    waist = random.choice([1.0, 1.0, random.uniform(0.3, 0.7)])  # gathered by a band
    parts: list[Solid] = []
    for number in range(count):
        side = -1 if number == 0 else 1
        along = np.linspace(0, 1, 40)
        wave = deep * np.sin(2 * math.pi * pleats * along + shift)

        def line(
            share: Number, along: np.ndarray = along, wave: np.ndarray = wave, side: int = side
        ) -> np.ndarray:
            left = -width / 2 if side < 0 else width / 2 - share * wide
            return np.column_stack([left + share * wide * along, wave])

        knot = 0.4 * height if waist < 1 else 0.0
        if knot:
            parts.append(ribbon(line(0.8 * waist + 0.2), line(waist), 0.02, knot))
        parts.append(ribbon(line(waist), line(1.0), 0.02, height - knot).move(0, 0, knot))
    if random.random() < 0.7:  # a rail
        parts.append(rod((-0.55 * width, 0, height), (0.55 * width, 0, height), random.uniform(0.012, 0.03)))
        if random.random() < 0.6:
            parts.append(with_mirror(ball(0.05, (0.55 * width, 0, height), 8), 0))
    if random.random() < 0.3:  # a valance
        drop = random.uniform(0.12, 0.3) * height
        parts.append(box(1.02 * width, 0.06 + 2 * deep, drop, (0, 0, height - drop)))
    return join(parts)


def door(random: Random) -> Solid:
    """Return a door, with or without panels, panes and a frame."""
    width, height, thick = random.uniform(0.7, 1.1), random.uniform(1.9, 2.4), random.uniform(0.035, 0.07)
    wings = 2 if random.random() < 0.25 else 1
    rows, columns = int(random.integers(0, 5)), int(random.integers(1, 3))
    deep, rim = random.uniform(0.008, 0.03), random.uniform(0.06, 0.13)
    glazed = random.random() < 0.25
    parts = []
    if glazed and rows:  # bars around panes that are left out
        for x in np.linspace(-0.5, 0.5, columns + 1) * (width - rim):
            parts.append(box(rim, thick, height, (x, 0, 0)))
        for z in np.linspace(0, 1, rows + 1) * (height - rim):
            parts.append(box(width, thick, rim, (0, 0, z)))
    else:
        parts.append(box(width, thick, height))
        wide, tall = (width - rim) / columns, (height - rim) / max(rows, 1)
        for row in range(rows):
            for column in range(columns):
                x, z = wide * (column + 0.5 - columns / 2), rim / 2 + tall * row + rim / 2
                parts.append(box(wide - rim, thick + 2 * deep, tall - rim, (x, 0, z)))
    if random.random() < 0.8:
        bar, at = random.uniform(0.02, 0.05), 0.5 * height
        knob = ball(0.04, (0.42 * width, 0.06, at), 8) if random.random() < 0.5 else None
        parts.append(with_mirror(knob or box(0.12, 0.03, bar, (0.4 * width, 0.06, at)), 1))
        parts.append(box(0.02, 0.12, 0.02, (0.42 * width, 0, at)))
    leaf = join(parts)
    opening_deg = random.uniform(15, 75) if random.random() < 0.2 else 0.0
    hinged = leaf.move(width / 2, 0, 0).rotate("z", -opening_deg).move(-width / 2, 0, 0)
    if wings == 2:
        hinged = with_mirror(hinged.move(-width / 2, 0, 0), 0)
    parts = [hinged]
    if random.random() < 0.6:  # the frame
        side, deep = random.uniform(0.05, 0.14), random.uniform(0.08, 0.2)
        full_width = wings * width
        parts.append(with_mirror(box(side, deep, height, ((full_width + side) / 2, 0, 0)), 0))
        parts.append(box(full_width + 2 * side, deep, side, (0, 0, height)))
        if random.random() < 0.25:
            parts.append(box(full_width + 2 * side, 0.5 * deep, 0.3, (0, 0, height + side)))
    return join(parts)


def mantel(random: Random) -> Solid:
    """Return a mantelpiece: two jambs, a frieze and a shelf, optionally with hearth, back and overmantel."""
    width, height = random.uniform(1.1, 2.0), random.uniform(0.9, 1.4)
    jamb, deep = random.uniform(0.1, 0.3), random.uniform(0.1, 0.35)
    frieze = random.uniform(0.12, 0.3) * height
    x, z = (width - jamb) / 2, height - frieze
    if random.random() < 0.25:  # columns
        parts = [with_mirror(cylinder(0.45 * jamb, z, (x, 0, 0), sides=14), 0)]
    else:
        parts = [with_mirror(box(jamb, deep, z, (x, 0, 0)), 0)]
    parts.append(box(width, deep, frieze, (0, 0, z)))
    steps, over = int(random.integers(1, 4)), random.uniform(0.05, 0.15)
    for step in range(steps):
        share = over * (step + 1) / steps
        parts.append(box(width + 2 * share, deep + 2 * share, 0.05, (0, 0, height + 0.05 * step)))
    if random.random() < 0.5:  # feet and capitals
        for level in (0, z - 0.08):
            parts.append(with_mirror(box(1.2 * jamb, deep + 0.06, 0.08, (x, 0, level)), 0))
    if random.random() < 0.5:  # panels
        parts.append(with_mirror(box(0.6 * jamb, deep + 0.04, 0.6 * z, (x, 0, 0.2 * z)), 0))
        parts.append(box(0.7 * (width - jamb), deep + 0.04, 0.5 * frieze, (0, 0, z + 0.25 * frieze)))
    if random.random() < 0.4:
        parts.append(box(1.05 * width, random.uniform(0.3, 0.7), 0.05, (0, -0.2, -0.05)))
    if random.random() < 0.4:
        parts.append(box(width - jamb, 0.04, height, (0, deep / 2, 0)))
    if random.random() < 0.3:  # the overmantel
        tall, wide = random.uniform(0.4, 1.1), random.uniform(0.6, 1) * width
        parts.append(box(wide, 0.6 * deep, tall, (0, 0.2 * deep, height + 0.05 * steps)))
    return join(parts)


def stairs(random: Random) -> Solid:
    """Return stairs, solid or with treads on strings, straight, with a landing, or winding; optionally with rails."""
    count, rise = int(random.integers(4, 15)), random.uniform(0.14, 0.2)
    run, width = random.uniform(0.22, 0.34), random.uniform(0.6, 1.5)
    kind, open_ = random.random(), random.random() < 0.4
    parts: list[Solid] = []
    if kind < 0.2:  # winding about a post
        radius, step_deg = random.uniform(0.7, 1.1), random.uniform(20, 32)
        for step in range(count):
            tread = frustum(0.85 * radius, 0.2, 0.85 * radius, 0.2, 0.04)
            vertices = tread.vertices.copy()
            vertices[:, 1] *= 1 + 1.2 * vertices[:, 0] / radius  # wider outside
            tread = Solid(vertices, tread.faces).move(0.5 * radius, 0, rise * (step + 1))
            parts.append(tread.rotate("z", step_deg * step))
        parts.append(cylinder(0.07, rise * (count + 1) + random.uniform(0, 0.9), sides=12))
        return join(parts)
    for step in range(count):
        y, z = run * (step + 0.5), rise * (step + 1)
        if open_:
            parts.append(box(width, 1.1 * run, 0.04, (0, y, z - 0.04)))
        else:
            parts.append(box(width, run, z, (0, y, 0)))
    far, high = run * count, rise * count
    if open_:
        string = [(0.0, 0.0), (0.15, 0.0), (far, high - 0.15), (far, high), (far - 0.1, high)]
        parts.append(with_mirror(side_prism(string, 0.04).move(random.uniform(0.35, 0.5) * width, 0, 0), 0))
    landing = random.uniform(0.6, 1.2) if random.random() < 0.35 else 0.0
    if landing:
        thick = 0.08 if open_ else high
        parts.append(box(width, landing, thick, (0, far + landing / 2, high - thick)))
        if random.random() < 0.4:  # and a second flight, sideways
            for step in range(3):
                z = high + rise * (step + 1)
                tread = box(run, landing, 0.04 if open_ else z)
                parts.append(
                    tread.move(width / 2 + run * (step + 0.5), far + landing / 2, z - 0.04 if open_ else 0)
                )
    if random.random() < 0.45:
        tall, sides = random.uniform(0.7, 1.0), (-1, 1) if random.random() < 0.6 else (1,)
        for side in sides:
            x = side * 0.47 * width
            parts.append(rod((x, run / 2, rise + tall), (x, far - run / 2, high + tall), 0.03))
            for step in range(0, count, int(random.integers(1, 4))):
                y, z = run * (step + 0.5), rise * (step + 1)
                parts.append(rod((x, y, z), (x, y, z + tall), 0.015, sides=6))
    return join(parts)


def tent(random: Random) -> Solid:
    """Return a ridge tent, a dome, a cone on poles, or a roof on posts."""
    kind, width, long = random.random(), random.uniform(1.2, 3.0), random.uniform(1.2, 3.2)
    height = random.uniform(0.45, 0.9) * width
    parts: list[Solid] = []
    if kind < 0.4:  # a ridge along y, cloth with open or closed ends
        wall = random.choice([0.0, 0.0, 0.3]) * height
        thick = 0.03
        for side in (-1, 1):
            run, rise = width / 2, height - wall
            slope = math.hypot(run, rise)
            plate = box(slope, long, thick).rotate("y", side * math.degrees(math.atan2(rise, run)))
            parts.append(plate.move(side * width / 4, 0, wall + rise / 2))
            if wall:
                parts.append(box(thick, long, wall, (side * width / 2, 0, 0)))
        if random.random() < 0.6:  # the back
            gable = side_prism([(-width / 2, wall), (width / 2, wall), (0, height)], thick)
            parts.append(gable.rotate("z", 90).move(0, long / 2, 0))
            if wall:
                parts.append(box(width, thick, wall, (0, long / 2, 0)))
        if random.random() < 0.5:
            parts.append(box(width, long, 0.02))
        if random.random() < 0.5:
            parts += [rod((0, side * long / 2, 0), (0, side * long / 2, height), 0.025) for side in (-1, 1)]
    elif kind < 0.65:  # a dome, with a porch perhaps
        bend = np.linspace(0, math.pi / 2, 9)
        sides = int(random.choice([6, 8, 24]))
        dome = revolution([(math.cos(b), math.sin(b)) for b in bend], sides)
        parts.append(dome.scale(width / 2, long / 2, random.uniform(0.4, 0.7) * width))
        if random.random() < 0.6:
            porch = revolution([(math.cos(b), math.sin(b)) for b in bend], 12)
            parts.append(porch.scale(0.25 * width, 0.3 * long, 0.35 * width).move(0, -0.45 * long, 0))
    elif kind < 0.8:  # a cone on poles
        sides = int(random.choice([8, 12, 24]))
        parts.append(cylinder(width / 2, 1.3 * height, top=0.06, sides=sides))
        for angle in np.arange(5) * 1.26:
            tip = (0.2 * math.cos(angle), 0.2 * math.sin(angle), 1.6 * height)
            parts.append(rod((-0.1 * math.cos(angle), -0.1 * math.sin(angle), 1.1 * height), tip, 0.02))
    else:  # a roof on posts
        post, over = random.uniform(0.6, 1.0) * width, 1.08
        leg = rod((width / 2, long / 2, 0), (width / 2, long / 2, post), 0.03)
        parts.append(with_mirror(with_mirror(leg, 0), 1))
        roof = random.uniform(0.2, 0.5) * width
        ridge = random.choice([0.02, 0.5])
        parts.append(frustum(over * width, over * long, 0.02 * width, ridge * long, roof, (0, 0, post)))
        if random.random() < 0.4:
            parts.append(box(over * width, over * long, 0.2, (0, 0, post - 0.2)))
        if random.random() < 0.35:
            parts.append(with_mirror(box(0.02, long, post, (width / 2, 0, 0)), 0))
    return join(parts)


def range_hood(random: Random) -> Solid:
    """Return a range hood: sloped, boxed, vaulted or of glass, usually with a flue above."""
    width, depth = random.uniform(0.55, 1.1), random.uniform(0.4, 0.65)
    rim, tall = random.uniform(0.03, 0.12), random.uniform(0.15, 0.4)
    flue = random.uniform(0.2, 0.38)
    kind = random.random()
    below = tray(width, depth, rim, 0.02, 0.6 * rim).rotate("x", 180).move(0, 0, rim)
    parts = [below]
    if kind < 0.45:
        back = random.choice([0.0, 0.5]) * (depth - flue)
        slope = frustum(width, depth, flue, flue, tall, (0, 0, rim))
        vertices = slope.vertices.copy()
        vertices[4:, 1] += back
        parts.append(Solid(vertices, slope.faces))
        top, y = rim + tall, back
    elif kind < 0.65:  # vaulted
        bend = np.linspace(0, math.pi, 12)
        arch = [(width / 2 * math.cos(b), tall * math.sin(b)) for b in bend]
        parts.append(side_prism(arch, depth).rotate("z", 90).move(0, 0, rim))
        top, y = rim + 0.8 * tall, 0.0
    elif kind < 0.85:  # a box
        parts.append(box(width, random.uniform(0.5, 1) * depth, 0.6 * tall, (0, 0.0, rim)))
        top, y = rim + 0.6 * tall, 0.0
    else:  # a plate
        parts.append(box(1.2 * width, depth, 0.015, (0, 0, rim)))
        top, y = rim, 0.2 * depth
    if random.random() < 0.85:
        high = random.uniform(0.2, 0.9)
        shape = cylinder(flue / 2, high, sides=20) if random.random() < 0.2 else box(flue, 0.9 * flue, high)
        parts.append(shape.move(0, y, top - 0.02))
    if random.random() < 0.5:  # filters and switches
        parts.append(with_mirror(box(0.3 * width, 0.6 * depth, 0.01, (0.22 * width, 0, 0.3 * rim)), 0))
        parts.append(box(0.3 * width, 0.02, 0.5 * rim, (0, -depth / 2, 0.25 * rim)))
    return join(parts)
