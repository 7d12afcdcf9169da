"""Random solids of furniture, metres, front towards -y; some classes have the same basic shape but other parts."""

import numpy as np

from framework.geometry.round_solids import cylinder, ring, rod
from framework.geometry.solids import Solid, box, frustum, join, with_mirror

Random = np.random.Generator


def legs(random: Random, width: float, depth: float, height: float, thick: float) -> Solid:
    """Return four legs of length `height` and thickness `thick` below a top of `width` × `depth`.

    The legs are straight or splayed, and square or round.
    """
    inset = random.uniform(0.5, 1.6) * thick
    x, y = width / 2 - inset, depth / 2 - inset
    splay = random.choice([0.0, 0.0, 0.08, 0.14]) * height
    if random.random() < 0.5:
        leg = rod((x + splay, y + splay, 0), (x, y, height), thick / 2)
    else:
        leg = frustum(thick * random.uniform(0.6, 1), thick, thick, thick, height, (x, y, 0))
    return with_mirror(with_mirror(leg, 0), 1)


def rails(random: Random, width: float, depth: float, height: float, thick: float) -> list[Solid]:
    """Return bars between the legs that `legs` returns for the same arguments; in most cases there are none."""
    if random.random() > 0.35:
        return []
    z, half = height * random.uniform(0.2, 0.45), thick * 0.35
    x, y = width / 2 - thick, depth / 2 - thick
    return [rod((-x, 0, z), (x, 0, z), half), with_mirror(rod((x, -y, z), (x, y, z), half), 0)]


def top(random: Random, width: float, depth: float, height: float, thick: float, bar: float) -> list[Solid]:
    """Return a table top on four legs, sometimes with bars between the legs and an apron.

    Args:
        random: Source of all random numbers.
        width: Width of the top.
        depth: Depth of the top.
        height: Height of the legs.
        thick: Thickness of the top.
        bar: Thickness of the legs.
    """
    parts = [
        box(width, depth, thick, (0, 0, height)),
        legs(random, width, depth, height, bar),
        *rails(random, width, depth, height, bar),
    ]
    if random.random() < 0.5:
        apron = random.uniform(0.06, 0.13)
        parts.append(box(0.88 * width, 0.85 * depth, apron, (0, 0, height - apron)))
    return parts


def table(random: Random) -> Solid:
    """Return a table, round or rectangular."""
    height = random.uniform(0.35, 0.95)
    width, depth = random.uniform(0.6, 2.2), random.uniform(0.5, 1.2)
    thick, bar = random.uniform(0.015, 0.08), random.uniform(0.03, 0.12)
    if random.random() < 0.3:  # round, on a pedestal or on legs
        radius, foot = random.uniform(0.35, 0.8), random.uniform(0.2, 0.4)
        parts = [cylinder(radius, thick, (0, 0, height), sides=32)]
        if random.random() < 0.4:
            parts.append(legs(random, 1.3 * radius, 1.3 * radius, height, bar))
        else:
            parts.append(cylinder(bar / 1.5, height))
            parts.append(cylinder(foot, 0.03, top=foot * random.uniform(0.6, 1), sides=24))
        return join(parts)
    parts = top(random, width, depth, height, thick, bar)
    if random.random() < 0.15:  # a board below
        parts.append(box(0.85 * width, 0.8 * depth, 0.03, (0, 0, random.uniform(0.15, 0.5) * height)))
    if random.random() < 0.12:  # a drawer
        parts.append(box(0.4 * width, 0.7 * depth, 0.12, (0, -0.16 * depth, height - 0.12)))
    return join(parts)


def desk(random: Random) -> Solid:
    """Return a desk, with one chest or two, or with one flat drawer."""
    height, width, depth = random.uniform(0.65, 0.85), random.uniform(0.9, 2.0), random.uniform(0.45, 0.95)
    thick, bar = random.uniform(0.015, 0.06), random.uniform(0.03, 0.08)
    chest = random.uniform(0.28, 0.55)
    side = random.choice([-1, 1])
    x = side * (width - chest) / 2 * 0.96
    low = random.choice([0.0, 0.0, 0.35, 0.7]) * height
    parts = [box(width, depth, thick, (0, 0, height))]
    if random.random() < 0.85:
        parts.append(box(chest, depth * 0.9, height - low, (x, 0, low)))
        rows = int(random.integers(0, 5))
        for number in range(rows):
            z = low + (number + 0.1) / rows * (height - low)
            parts.append(box(chest * 0.85, 0.02, (height - low) * 0.8 / rows, (x, -depth * 0.46, z)))
        if random.random() < 0.35:  # a second chest
            parts.append(box(chest, depth * 0.9, height - low, (-x, 0, low)))
    else:  # one flat drawer
        parts.append(box(0.8 * width, 0.85 * depth, 0.12, (0, 0, height - 0.12)))
        low = height
    if low or random.random() < 0.5:
        parts.append(legs(random, width, depth, height, bar))
    else:
        parts.append(box(bar, depth * 0.9, height, (-side * (width / 2 - bar), 0, 0)))
    if random.random() < 0.4:
        parts.append(
            box(width * 0.95, 0.02, height * random.uniform(0.3, 0.7), (0, depth * 0.4, height * 0.3))
        )
    if random.random() < 0.25:  # shelves above
        tall, deep = random.uniform(0.2, 0.7), random.uniform(0.2, 0.35)
        y = (depth - deep) / 2
        parts.append(with_mirror(box(0.025, deep, tall, (0.48 * width, y, height)), 0))
        parts += [box(0.98 * width, deep, 0.025, (0, y, height + share * tall)) for share in (0.5, 1)]
    return join(parts)


def bench(random: Random) -> Solid:
    """Return a bench, sometimes with a back and arms."""
    height, width, depth = random.uniform(0.35, 0.55), random.uniform(0.8, 2.0), random.uniform(0.28, 0.55)
    thick, bar = random.uniform(0.03, 0.07), random.uniform(0.04, 0.09)
    if random.random() < 0.5:
        parts = [box(bar, depth * 0.9, height, (side * width * 0.4, 0, 0)) for side in (-1, 1)]
    else:
        parts = [legs(random, width, depth, height, bar)]
    if random.random() < 0.5:
        parts.append(box(width, depth, thick, (0, 0, height)))
    else:
        count = int(random.integers(3, 6))
        for row in np.linspace(-0.5, 0.5, count) * (depth - depth / count):
            parts.append(box(width, 0.75 * depth / count, thick, (0, row, height)))
    if random.random() < 0.45:
        tall = random.uniform(0.3, 0.5)
        count = int(random.integers(2, 4))
        for number in range(count):
            z = height + tall * (number + 0.6) / count
            parts.append(box(width, 0.03, 0.6 * tall / count, (0, depth * 0.5, z)))
        parts += [box(bar, bar, tall, (side * width * 0.42, depth * 0.52, height)) for side in (-1, 1)]
        if random.random() < 0.4:  # arms
            z = height + 0.5 * tall
            parts.append(with_mirror(box(bar, depth, 0.7 * bar, (0.46 * width, 0, z)), 0))
            parts.append(
                with_mirror(box(0.7 * bar, 0.7 * bar, 0.5 * tall, (0.46 * width, -0.4 * depth, height)), 0)
            )
    return join(parts)


def stool(random: Random) -> Solid:
    """Return a stool, sometimes with a low back."""
    height, size = random.uniform(0.4, 0.8), random.uniform(0.15, 0.24)
    thick, bar = random.uniform(0.02, 0.12), random.uniform(0.02, 0.06)
    if random.random() < 0.6:
        parts = [cylinder(size, thick, (0, 0, height), sides=24)]
        count = int(random.choice([1, 3, 4, 4]))
        if count == 1:
            parts += [cylinder(bar, height), cylinder(size * random.uniform(0.8, 1.2), 0.03, top=size * 0.7)]
        spread = random.uniform(1, 1.5)
        for angle in 2 * np.pi * np.arange(count if count > 1 else 0) / max(count, 1) + 0.3:
            x, y = size * 0.75 * np.cos(angle), size * 0.75 * np.sin(angle)
            parts.append(rod((spread * x, spread * y, 0), (x, y, height), bar / 2))
        if random.random() < 0.5:
            parts.append(
                ring(size * 0.75 * (1 + spread) / 2, bar * 0.35, (0, 0, height * random.uniform(0.2, 0.5)))
            )
        if random.random() < 0.2:  # a low back
            parts.append(box(1.2 * size, 0.03, random.uniform(0.1, 0.3), (0, 0.8 * size, height)))
        return join(parts)
    parts = [box(2 * size, 2 * size * random.uniform(0.6, 1), thick, (0, 0, height))]
    parts += [
        legs(random, 2 * size, 1.7 * size, height, bar),
        *rails(random, 2 * size, 1.7 * size, height, bar),
    ]
    return join(parts)


def back(random: Random, width: float, height: float, tall: float, y: float, bar: float) -> list[Solid]:
    """Return the back of a chair: a board, or upright or horizontal slats.

    Args:
        random: Source of all random numbers.
        width: Width of the back.
        height: Height of the lower edge of the back.
        tall: Distance of the upper edge from the lower edge.
        y: Coordinate y of the back; the front of the chair is towards -y.
        bar: Thickness of the posts of the back.
    """
    lean = random.uniform(0, 12)
    style = random.integers(3)
    if style == 0:
        parts = [box(width, bar * 0.8, tall * random.uniform(0.6, 1))]
    else:
        parts = [box(bar, bar, tall, (side * (width - bar) / 2, 0, 0)) for side in (-1, 1)]
        count = int(random.integers(2, 6))
        if style == 1:
            for number in range(count):
                parts.append(box(width, bar * 0.5, 0.5 * tall / count, (0, 0, tall * (number + 0.5) / count)))
        else:
            parts.append(box(width, bar * 0.8, tall * 0.15, (0, 0, tall * 0.85)))
            for x in np.linspace(-0.35, 0.35, count):
                parts.append(rod((x * width, 0, 0), (x * width, 0, tall * 0.9), bar * 0.25))
    return [join(parts).rotate("x", -lean).move(0, y, height)]


def chair(random: Random) -> Solid:
    """Return a chair."""
    if random.random() < 0.2:
        return couch(random, random.uniform(0.45, 0.75))
    height, width, depth = random.uniform(0.35, 0.7), random.uniform(0.36, 0.6), random.uniform(0.36, 0.55)
    thick, bar = random.uniform(0.02, 0.12), random.uniform(0.025, 0.06)
    parts = [box(width, depth, thick, (0, 0, height)), *rails(random, width, depth, height, bar)]
    if random.random() < 0.2:  # an office chair's foot
        parts.append(cylinder(bar / 1.5, height))
        for angle in 2 * np.pi * np.arange(5) / 5:
            parts.append(rod((0, 0, 0.06), (0.28 * np.cos(angle), 0.28 * np.sin(angle), 0.03), 0.02))
    else:
        parts.append(legs(random, width, depth, height, bar))
    parts += back(random, width, height + thick, random.uniform(0.2, 0.7), depth / 2 - bar / 2, bar)
    if random.random() < 0.3:
        z = height + random.uniform(0.18, 0.26)
        for side in (-1, 1):
            x = side * width / 2
            parts += [
                box(bar, depth, bar * 0.6, (x, 0, z)),
                box(bar * 0.7, bar * 0.7, z - height, (x, -depth * 0.4, height)),
            ]
    return join(parts)


def couch(random: Random, width: float) -> Solid:
    """Return a padded seat with arms and a back, with `width` between the arms."""
    height, depth = random.uniform(0.32, 0.46), random.uniform(0.55, 0.85)
    arm, tall = random.uniform(0.08, 0.2), random.uniform(0.3, 0.5)
    foot = random.choice([0.0, 0.05, 0.1, 0.15])
    pad = random.uniform(0.1, 0.22)
    parts = [
        box(width, depth, height - foot, (0, 0, foot)),
        box(width + 2 * arm, pad, height + tall - foot, (0, depth / 2, foot)),
    ]
    arm_height = height + random.uniform(0.1, 0.25) - foot
    for side in (-1, 1):
        x = side * (width + arm) / 2
        parts.append(box(arm, depth, arm_height, (x, 0, foot)))
        if random.random() < 0.4:
            tube = cylinder(arm * 0.6, depth, sides=12).rotate("x", 90)
            parts.append(tube.move(x, depth / 2, foot + arm_height))
    if foot:
        parts.append(legs(random, width + 2 * arm, depth, foot, 0.06))
    seats = max(1, round(width / 0.65))
    if random.random() < 0.7:
        for number in range(seats):
            x = width * ((number + 0.5) / seats - 0.5)
            parts.append(box(width / seats * 0.94, depth * 0.8, 0.1, (x, -depth * 0.06, height)))
    return join(parts)


def sofa(random: Random) -> Solid:
    """Return a sofa, sometimes with a corner."""
    seat = couch(random, random.uniform(0.95, 2.2))
    if random.random() < 0.15:  # a corner sofa
        wing = box(0.7, random.uniform(0.5, 0.9), 0.4, (seat.vertices[:, 0].max() - 0.45, -0.7, 0.02))
        return join([seat, wing])
    return seat


def bed(random: Random) -> Solid:
    """Return a bed, sometimes a bunk bed or a canopy bed."""
    width, length = random.choice([0.9, 1.2, 1.6, 1.8]) * random.uniform(0.95, 1.05), random.uniform(1.9, 2.2)
    height, thick = random.uniform(0.12, 0.45), random.uniform(0.1, 0.3)
    parts = [
        box(width, length, 0.1, (0, 0, height - 0.1)),
        box(width * 0.96, length * 0.97, thick, (0, 0, height)),
        legs(random, width, length, height, random.uniform(0.05, 0.1)),
    ]
    if random.random() < 0.8:
        parts.append(box(width, 0.05, height + random.uniform(0.3, 0.8), (0, length / 2, 0)))
    if random.random() < 0.35:
        parts.append(box(width, 0.05, height + random.uniform(0.1, 0.4), (0, -length / 2, 0)))
    if random.random() < 0.12 and width < 1.3:  # a bunk
        post = box(0.07, 0.07, 1.6, (0.48 * width, 0.49 * length, 0))
        parts += [with_mirror(with_mirror(post, 0), 1), box(width, length, 0.25, (0, 0, 1.1))]
    elif random.random() < 0.12:  # a canopy
        post = box(0.06, 0.06, 2.0, (0.48 * width, 0.49 * length, 0))
        parts.append(with_mirror(with_mirror(post, 0), 1))
        parts.append(with_mirror(box(width, 0.06, 0.06, (0, 0.49 * length, 1.95)), 1))
        parts.append(with_mirror(box(0.06, length, 0.06, (0.48 * width, 0, 1.95)), 0))
    pillows = 1 if width < 1.3 else 2
    for number in range(pillows if random.random() < 0.8 else 0):
        x = width * ((number + 0.5) / pillows - 0.5)
        parts.append(box(0.7 * width / pillows, 0.35, 0.1, (x, length * 0.36, height + thick)))
    return join(parts)
