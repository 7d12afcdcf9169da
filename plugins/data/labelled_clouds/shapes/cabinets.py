"""Random solids of cabinets and boxes, metres, front towards -y; the classes differ in their fronts and insides."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from framework.geometry.round_solids import ball, cylinder, rod, tube
from framework.geometry.solids import Number, Point, Solid, box, frustum, join, tray, with_mirror
from plugins.data.labelled_clouds.shapes.furniture import legs

Random = np.random.Generator


def fronts(
    random: Random, width: Number, height: Number, at: Point, rows: int, columns: int, doors: bool = False
) -> list[Solid]:
    """Return the fronts of drawers or doors in `rows` rows and `columns` columns, most of them with handles.

    Together the fronts fill an area of `width` × `height`; `at` is the middle of the lower edge of this area.
    """
    x, y, z = at
    wide, tall = width / columns, height / rows
    thick, gap = random.uniform(0.012, 0.03), random.uniform(0.86, 0.97)
    handle = random.choice(["knob", "bar", "none"], p=[0.4, 0.4, 0.2])
    parts = []
    for row in range(rows):
        for column in range(columns):
            middle = x + wide * (column + 0.5 - columns / 2)
            low = z + tall * (row + (1 - gap) / 2)
            parts.append(box(gap * wide, 2 * thick, gap * tall, (middle, y, low)))
            if handle == "none":
                continue
            if doors:  # at the edge where two doors meet
                middle += (0.38 if column % 2 == 0 else -0.38) * wide
                size = (0.03, 0.16 * tall) if handle == "bar" else (0.035, 0.035)
            else:
                size = (0.4 * wide, 0.02) if handle == "bar" else (0.035, 0.035)
            parts.append(box(size[0], 0.04, size[1], (middle, y - thick - 0.015, low + 0.45 * tall)))
    return parts


def case(width: Number, depth: Number, height: Number, board: Number, z: Number, back: bool) -> list[Solid]:
    """Return the sides, bottom, top and (if `back`) rear of an open cabinet that stands at height `z`.

    `board` is the thickness of the boards.
    """
    parts = [box(board, depth, height, (side * (width - board) / 2, 0, z)) for side in (-1, 1)]
    parts += [box(width, depth, board, (0, 0, level)) for level in (z, z + height - board)]
    if back:
        parts.append(box(width, 0.5 * board, height, (0, depth / 2, z)))
    return parts


def feet(random: Random, width: Number, depth: Number, foot: Number, thick: Number = 0.06) -> list[Solid]:
    """Return legs or a plinth of height `foot` for a cabinet of `width` × `depth`; nothing if `foot` is 0.

    `thick` is the thickness of the legs.
    """
    if not foot:
        return []
    if random.random() < 0.3:
        return [box(0.9 * width, 0.9 * depth, foot)]
    return [legs(random, width, depth, foot, thick)]


def bookshelf(random: Random) -> Solid:
    """Return a bookshelf with shelves and books."""
    width, depth = random.uniform(0.4, 1.8), random.uniform(0.2, 0.45)
    height, board = random.uniform(0.8, 2.2), random.uniform(0.015, 0.045)
    count = int(random.integers(2, 7))
    foot = random.choice([0.0, 0.0, 0.08, 0.15])
    levels = np.linspace(foot, foot + height - board, count + 1)
    parts = [box(width, depth, board, (0, 0, z)) for z in levels[1:-1]]
    parts += [
        *case(width, depth, height, board, foot, bool(random.random() < 0.6)),
        *feet(random, width, depth, foot),
    ]
    uprights = int(random.choice([0, 0, 1, 2]))
    parts += [
        box(board, depth, height, (width * ((n + 1) / (uprights + 1) - 0.5), 0, foot))
        for n in range(uprights)
    ]
    for z in levels[:-1]:  # books
        if random.random() < 0.3:
            wide, tall = random.uniform(0.1, 0.4) * width, random.uniform(0.5, 0.85) * height / count
            parts.append(box(wide, depth * 0.7, tall, (random.uniform(-0.25, 0.25) * width, 0, z + board)))
    if random.random() < 0.25:  # doors below
        parts += fronts(random, width, levels[1] - foot, (0, -depth / 2, foot), 1, 2, doors=True)
    return join(parts)


def dresser(random: Random) -> Solid:
    """Return a dresser with drawers."""
    width, depth, height = random.uniform(0.45, 1.7), random.uniform(0.35, 0.6), random.uniform(0.6, 1.35)
    foot = random.choice([0.0, 0.06, 0.12, 0.25])
    parts = [box(width, depth, height - foot, (0, 0, foot)), *feet(random, width, depth, foot)]
    if random.random() < 0.6:
        over = random.uniform(1.02, 1.08)
        parts.append(box(width * over, depth * over, 0.03, (0, 0, height)))
    rows, columns = int(random.integers(2, 6)), int(random.choice([1, 1, 2, 3]))
    low, front = foot, height - foot
    if random.random() < 0.2:  # doors below
        parts += fronts(random, width, 0.45 * front, (0, -depth / 2, foot), 1, 2, doors=True)
        low, front, rows = foot + 0.45 * front, 0.55 * front, max(1, rows // 2)
    parts += fronts(random, width, front, (0, -depth / 2, low), rows, columns)
    if random.random() < 0.2:  # a mirror
        wide, tall = random.uniform(0.5, 0.9) * width, random.uniform(0.4, 0.9)
        parts.append(box(wide, 0.04, tall, (0, 0.4 * depth, height)))
    return join(parts)


def night_stand(random: Random) -> Solid:
    """Return a night stand."""
    width, depth, height = random.uniform(0.35, 0.7), random.uniform(0.3, 0.55), random.uniform(0.4, 0.8)
    foot = random.choice([0.0, 0.1, 0.25]) * random.uniform(0.8, 1.2)
    board, low = random.uniform(0.015, 0.035), foot
    over = random.uniform(1, 1.1)
    parts = [box(width * over, depth * over, board, (0, 0, height)), *feet(random, width, depth, foot, 0.05)]
    if random.random() < 0.5:  # an open part below
        low = foot + (height - foot) * random.uniform(0.3, 0.65)
        parts += case(width, depth, low - foot, board, foot, bool(random.random() < 0.7))
    parts.append(box(width, depth, height - low, (0, 0, low)))
    rows, doors = int(random.integers(1, 4)), bool(random.random() < 0.15)
    parts += fronts(random, width, height - low, (0, -depth / 2, low), 1 if doors else rows, 1, doors)
    return join(parts)


def tv_stand(random: Random) -> Solid:
    """Return a stand for a television set."""
    width, depth, height = random.uniform(0.8, 2.1), random.uniform(0.35, 0.6), random.uniform(0.35, 0.8)
    board, foot = random.uniform(0.015, 0.045), random.choice([0.0, 0.06, 0.15])
    tall, bays = height - foot, int(random.integers(1, 5))
    parts = [*case(width, depth, tall, board, foot, bool(random.random() < 0.6))]
    parts += feet(random, width, depth, foot)
    wide = width / bays
    for bay in range(bays):
        x = wide * (bay + 0.5 - bays / 2)
        if bay:
            parts.append(box(board, depth, tall, (x - wide / 2, 0, foot)))
        kind = random.choice(["open", "shelf", "shelf", "drawers", "door"])
        if kind == "shelf":
            for z in np.linspace(0, 1, int(random.integers(3, 5)))[1:-1] * tall:
                parts.append(box(wide, depth, board, (x, 0, foot + z)))
        elif kind == "drawers":
            parts += fronts(random, wide, tall, (x, -depth / 2, foot), int(random.integers(1, 4)), 1)
        elif kind == "door":
            parts += fronts(random, wide, tall, (x, -depth / 2, foot), 1, 1, doors=True)
    if random.random() < 0.15:  # a board behind the set
        parts.append(box(width, board, random.uniform(0.4, 0.9), (0, depth / 2, height)))
    return join(parts)


def wardrobe(random: Random) -> Solid:
    """Return a wardrobe with doors, sometimes with drawers below them."""
    width, depth, height = random.uniform(0.6, 2.0), random.uniform(0.4, 0.7), random.uniform(1.2, 2.2)
    foot = random.choice([0.0, 0.08, 0.15])
    tall, closed = height - foot, width
    parts = feet(random, width, depth, foot, 0.07)
    x = 0.0
    if random.random() < 0.2:  # an open side
        closed = random.uniform(0.5, 0.75) * width
        x = (width - closed) / 2
        shelves = box(width - closed, depth, 0.025)
        parts += [shelves.move(-closed / 2, 0, foot + tall * n / 5) for n in range(6)]
        parts.append(box(0.025, depth, tall, (-width / 2, 0, foot)))
        parts.append(box(width - closed, 0.02, tall, (-closed / 2, depth / 2, foot)))
    parts.append(box(closed, depth, tall, (x, 0, foot)))
    if random.random() < 0.5:
        over = random.uniform(1.02, 1.09)
        parts.append(box(width * over, depth * over, 0.07, (0, 0, height)))
    low, rows = foot, int(random.choice([0, 0, 0, 1, 2]))
    if rows:  # drawers below the doors
        low = foot + random.uniform(0.15, 0.35) * tall
        parts += fronts(random, closed, low - foot, (x, -depth / 2, foot), rows, int(random.integers(1, 3)))
    parts += fronts(
        random, closed, tall + foot - low, (x, -depth / 2, low), 1, int(random.integers(1, 5)), doors=True
    )
    return join(parts)


def glass_box(random: Random) -> Solid:
    """Return a show case: panes between bars, on a base, legs or nothing, optionally with shelves or an open top."""
    width, depth, height = random.uniform(0.4, 1.6), random.uniform(0.3, 0.9), random.uniform(0.3, 1.6)
    bar, pane = random.uniform(0.015, 0.05), random.uniform(0.006, 0.015)
    low, stand = 0.0, random.random()
    parts: list[Solid] = []
    if stand < 0.3:
        low = random.uniform(0.1, 0.6) * height
        parts.append(box(width, depth, low))
    elif stand < 0.45:
        low = random.uniform(0.2, 0.7) * height
        parts.append(legs(random, width, depth, low, 1.5 * bar))
    if random.random() < 0.35:
        parts.append(tray(width, depth, height, pane, pane, (0, 0, low)))
    else:
        post = box(bar, bar, height, ((width - bar) / 2, (depth - bar) / 2, low))
        parts.append(with_mirror(with_mirror(post, 0), 1))
        for z in (low, low + height - bar):
            parts.append(with_mirror(box(width, bar, bar, (0, (depth - bar) / 2, z)), 1))
            parts.append(with_mirror(box(bar, depth, bar, ((width - bar) / 2, 0, z)), 0))
        parts.append(with_mirror(box(pane, depth, height, ((width - bar) / 2, 0, low)), 0))
        parts.append(with_mirror(box(width, pane, height, (0, (depth - bar) / 2, low)), 1))
        parts += [box(width, depth, pane, (0, 0, z)) for z in (low, low + height - pane)]
    for z in np.linspace(0, 1, int(random.choice([2, 2, 3, 4, 5])))[1:-1] * height:
        parts.append(box(0.97 * width, 0.97 * depth, pane, (0, 0, low + z)))
    if random.random() < 0.2:  # an exhibit
        parts.append(ball(random.uniform(0.1, 0.25) * min(width, depth, height), (0, 0, low + 0.3 * height)))
    return join(parts)


def radio(random: Random) -> Solid:
    """Return a radio."""
    width, depth, height = random.uniform(0.2, 0.6), random.uniform(0.07, 0.2), random.uniform(0.12, 0.32)
    narrow = random.choice([1.0, 1.0, 0.85])
    parts = [frustum(width, depth, narrow * width, narrow * depth, height)]

    def disc(radius: Number, x: Number, z: Number, thick: Number) -> Solid:
        return cylinder(radius, thick, sides=20).rotate("x", 90).move(x, -0.46 * depth, z)

    speakers, size = int(random.choice([0, 1, 2, 2])), min(0.42 * height, 0.22 * width)
    positions: Sequence[Number] = {0: (), 1: (-0.25 * width,), 2: (-0.3 * width, 0.3 * width)}[speakers]
    parts += [disc(size * random.uniform(0.75, 1), x, 0.45 * height, 0.03) for x in positions]
    for x in np.linspace(-0.12, 0.12, int(random.integers(0, 5))) * width:
        parts.append(disc(0.06 * height, x + (0.2 * width if speakers == 1 else 0), 0.2 * height, 0.045))
    if random.random() < 0.6:  # the scale
        middle = 0.2 * width if speakers == 1 else 0
        parts.append(
            box(random.uniform(0.2, 0.35) * width, 0.03, 0.14 * height, (middle, -depth / 2, 0.65 * height))
        )
    if random.random() < 0.5:  # a handle
        reach, tall = random.uniform(0.25, 0.45) * width, random.uniform(0.15, 0.4) * height
        path = [(-reach, 0, 0.97 * height), (-reach, 0, height + tall), (reach, 0, height + tall)]
        path.append((reach, 0, 0.97 * height))
        parts += [rod(start, end, 0.012) for start, end in pairwise(path)]
    if random.random() < 0.4:  # an antenna
        lean, long = random.uniform(-0.8, 0.8), random.uniform(0.6, 1.6) * height
        start = (0.42 * width, 0.2 * depth, 0.97 * height)
        end = (0.42 * width + long * math.sin(lean), 0.2 * depth, height + long * math.cos(lean))
        parts.append(rod(start, end, 0.006))
    if random.random() < 0.3:
        parts.append(
            with_mirror(
                with_mirror(cylinder(0.018, 0.025, (0.4 * width, 0.35 * depth, -0.025), sides=8), 0),
                1,
            )
        )
    return join(parts)


def xbox(random: Random) -> Solid:
    """Return a game console, lying or upright, with a slot, ribs, knobs, and optionally its controller."""
    width, depth, height = random.uniform(0.26, 0.42), random.uniform(0.2, 0.34), random.uniform(0.05, 0.12)
    narrow = random.uniform(0.85, 1.0)
    lower = random.uniform(0.3, 0.7) * height
    parts = [
        frustum(narrow * width, narrow * depth, width, depth, lower),
        frustum(width, depth, narrow * width, narrow * depth, height - lower, (0, 0, lower)),
        box(random.uniform(0.35, 0.6) * width, 0.02, 0.12 * height, (-0.1 * width, -depth / 2, 0.6 * height)),
    ]
    if random.random() < 0.6:
        knob = cylinder(random.uniform(0.1, 0.22) * height, 0.02, sides=16).rotate("x", 90)
        parts.append(knob.move(0.36 * width, -0.49 * depth, 0.5 * height))
    for x in np.linspace(-0.4, 0.4, int(random.choice([0, 0, 5, 8]))) * width:  # ribs
        parts.append(box(0.03 * width, 0.8 * depth, 0.012, (x, 0, height)))
    if random.random() < 0.4:  # the round badge on top
        parts.append(
            cylinder(random.uniform(0.2, 0.4) * depth, 0.02, (0, 0, 0.95 * height), top=0.1, sides=24)
        )
    if random.random() < 0.3:  # a cross over it
        for angle in (35, -35):
            parts.append(box(1.0 * width, 0.03, 0.015, (0, 0, height)).scale(0.9, 1, 1).rotate("z", angle))
    solid = join(parts)
    if random.random() < 0.35:
        solid = solid.rotate("y", 90).move(0, 0, width / 2)
    if random.random() < 0.2:  # the controller: a bar and two grips
        at = (random.uniform(-0.1, 0.1), -depth / 2 - 0.12)
        grip = tube([(0.05, 0, 0.03), (0.075, -0.03, 0.025), (0.08, -0.07, 0.015)], [0.022, 0.02, 0.014])
        pad = join([box(0.13, 0.06, 0.035, (0, 0, 0.01)), with_mirror(grip, 0)])
        solid = join([solid, pad.move(*at, 0)])
    return solid
