"""Parametric household objects: bottle, chair, diningtable, sofa and tvmonitor; all lengths are in metres."""

import numpy as np
from numpy.random import Generator

from framework.geometry.round_solids import bar, ellipsoid, revolution
from framework.geometry.solids import Solid, block, loft_rectangles
from plugins.data.pascal3d.paint import DARK, METAL, paint, shade, wood
from plugins.data.pascal3d.shapes import Body, Color

BOTTLE_GLASS: tuple[Color, ...] = ((0.1, 0.28, 0.12), (0.35, 0.18, 0.06), (0.55, 0.72, 0.8), (0.2, 0.3, 0.6))


def bottle(random: Generator) -> Body:
    """Return a wine, beer or water bottle: a solid of revolution whose colours are rings about the vertical.

    The polygon that approximates the circle is rotated by a random angle, so that its edges do not show the azimuth.
    """
    body = Body()
    glass = BOTTLE_GLASS[int(random.integers(len(BOTTLE_GLASS)))]
    if random.random() < 0.25:
        glass = paint(random, vivid=True)
    radius, height = random.uniform(0.034, 0.045), random.uniform(0.24, 0.32)
    shoulder, neck = random.uniform(0.5, 0.66) * height, random.uniform(0.72, 0.84) * height
    thin = radius * random.uniform(0.3, 0.42)
    profile = [
        (0.85 * radius, 0.0),
        (radius, 0.02 * height),
        (radius, shoulder),
        (0.93 * radius, 0.8 * shoulder + 0.2 * neck),
        (0.7 * radius + 0.3 * thin, 0.5 * shoulder + 0.5 * neck),
        (1.1 * thin, neck),
        (thin, 0.97 * height),
        (1.15 * thin, 0.975 * height),
        (1.15 * thin, height),
    ]
    body.add(revolution(profile, edges="rims"), glass)

    def band(radius: float, low: float, high: float, color: Color) -> None:
        body.add(revolution([(radius, low), (radius, high)], edges="rims"), color)

    label = paint(random) if random.random() < 0.6 else (0.93, 0.92, 0.86)
    low, high = random.uniform(0.1, 0.18) * height, shoulder - random.uniform(0.04, 0.12) * height
    band(1.015 * radius, low, high, label)
    if random.random() < 0.6:
        start = low + random.uniform(0.3, 0.6) * (high - low)
        stop = start + random.uniform(0.08, 0.25) * (high - low)
        band(1.03 * radius, start, stop, paint(random, vivid=True))
    band(1.3 * thin, 0.955 * height, 1.02 * height, paint(random))  # cap
    return body.rotated_copies(random.uniform(0, 2 * np.pi))


def chair(random: Generator) -> Body:
    """Return a chair with four legs, a seat, and a back of slats, rails or one panel; sometimes with arms."""
    body = Body()
    frame = wood(random) if random.random() < 0.6 else paint(random)
    cloth = frame if random.random() < 0.4 else paint(random)
    width, depth = random.uniform(0.4, 0.5), random.uniform(0.4, 0.48)
    seat, top = random.uniform(0.42, 0.48), random.uniform(0.82, 1.02)
    thick, lean = random.uniform(0.035, 0.05), random.uniform(0.03, 0.1)
    x, front, rear = width / 2 - thick / 2, -depth / 2 + thick / 2, depth / 2 - thick / 2
    body.add(block((width, depth, 0.045), (0, 0, seat)), cloth)
    body.pair(bar((x, front, 0), (x, front, seat), 0.7 * thick, sides=4), frame)
    body.pair(bar((x, rear + 0.03, 0), (x, rear, seat), 0.7 * thick, sides=4), frame)
    body.pair(bar((x, rear, seat), (x, rear + lean, top), 0.65 * thick, sides=4), frame)

    def board(low: float, high: float, half: float, middle: float = 0.0) -> Solid:
        """Return a board of half width `half` about x = `middle`, in the inclined plane of the back."""
        levels = []
        for z in (low, high):
            y = rear + lean * (z - seat) / (top - seat)
            levels.append((half, y - 0.015, y + 0.015, z))
        return loft_rectangles(levels, middle)

    body.add(board(top - 0.08, top, x), frame)
    style = random.random()
    if style < 0.4:
        body.add(board(seat + 0.1, top - 0.04, x), cloth)
    elif style < 0.7:
        for share in np.linspace(-0.7, 0.7, int(random.integers(3, 6))).tolist():
            body.add(board(seat, top - 0.05, 0.018, share * x), frame)
    else:
        for z in (seat + 0.12, top - 0.16):
            body.add(board(z, z + 0.06, x), frame)
    if random.random() < 0.3:
        arm = seat + random.uniform(0.18, 0.24)
        body.pair(bar((x, front + 0.03, seat), (x, front + 0.03, arm), 0.6 * thick, sides=4), frame)
        body.pair(block((0.05, depth, 0.035), (x, 0.01, arm)), frame)
    if random.random() < 0.4:
        body.pair(block((0.02, depth - 0.05, 0.03), (x, 0, 0.2)), frame)
        body.add(block((width - 0.05, 0.02, 0.03), (0, front, 0.25)), frame)
    return body


def diningtable(random: Generator) -> Body:
    """Return a rectangular table that looks the same after a rotation by 180°: one half is built, copied and rotated.

    A long side faces the front. Plates and chairs, if there are any, are copied and rotated in the same way.
    """
    half = Body()
    color = wood(random)
    legs = color if random.random() < 0.6 else paint(random)
    width, depth = random.uniform(1.5, 2.0), random.uniform(0.8, 1.0)
    height, thick = random.uniform(0.72, 0.78), random.uniform(0.04, 0.07)
    leg = random.uniform(0.06, 0.1)
    inset = leg / 2 + random.uniform(0.02, 0.12)
    x, y = width / 2 - inset, depth / 2 - inset
    under = height - thick
    half.add(block((width / 2, depth, thick), (width / 4, 0, height - thick / 2)), color)
    half.add(block((0.03, 2 * y, 0.09), (x, 0, under - 0.045)), shade(legs, 0.85))
    for side in (-y, y):
        half.add(bar((x, side, 0), (x, side, under), 0.5 * leg, 0.7 * leg, sides=4), legs)
        half.add(block((x, 0.03, 0.09), (x / 2, side, under - 0.045)), shade(legs, 0.85))
    if random.random() < 0.4:  # a runner along the middle
        half.add(
            block((width / 2 + 0.005, 0.35 * depth, 0.008), (width / 4, 0, height + 0.004)), paint(random)
        )
    if random.random() < 0.45:  # plates
        china = shade((0.95, 0.95, 0.93), random.uniform(0.85, 1.0))
        dish = revolution([(0.07, height), (0.13, height + 0.02), (0.12, height + 0.022)], 16, "rims")
        for side in (-0.3 * depth, 0.3 * depth):
            half.add(dish.move(0.3 * width, side), china)
    if random.random() < 0.5:  # chairs along the sides
        paintwork = wood(random) if random.random() < 0.6 else paint(random)
        away = depth / 2 + random.uniform(0.0, 0.25)
        for middle in (-0.24 * width, 0.24 * width) if random.random() < 0.7 else (0.0,):
            half.add(block((0.42, 0.4, 0.04), (middle, away, 0.45)), paintwork)
            half.add(block((0.42, 0.035, 0.36), (middle, away + 0.2, 0.78)), paintwork)
            for side in (middle - 0.18, middle + 0.18):
                foot = away + 0.2
                half.add(bar((side, foot, 0), (side, foot, 0.65), 0.025, sides=4), paintwork)
                half.add(bar((side, foot - 0.37, 0), (side, foot - 0.37, 0.45), 0.025, sides=4), paintwork)
    return half.rotated_copies(0.0, np.pi)


def sofa(random: Generator) -> Body:
    """Return a sofa with two or three seat cushions between arms, back cushions, and short feet."""
    body = Body()
    cloth = paint(random) if random.random() < 0.7 else (0.45, 0.3, 0.2)
    seats = int(random.integers(2, 4))
    width, depth = 0.62 * seats + random.uniform(0.3, 0.5), random.uniform(0.8, 0.95)
    seat, top, arm = random.uniform(0.38, 0.44), random.uniform(0.75, 0.95), random.uniform(0.55, 0.65)
    arm_wide, foot = random.uniform(0.14, 0.24), random.uniform(0.06, 0.14)
    front, rear, inner = -depth / 2, depth / 2, width - 2 * arm_wide
    base = seat - 0.14
    x = width / 2 - arm_wide / 2
    body.add(block((width, depth, base - foot), (0, 0, (base + foot) / 2)), shade(cloth, 0.8))
    body.add(block((width, 0.2, top - foot), (0, rear - 0.1, (top + foot) / 2)), shade(cloth, 0.85))
    body.pair(block((arm_wide, depth, arm - foot), (x, 0, (arm + foot) / 2)), shade(cloth, 0.9))
    if random.random() < 0.5:  # rolled arms
        body.pair(bar((x, front - 0.01, arm), (x, rear - 0.05, arm), 0.62 * arm_wide, sides=12), cloth)
    wide = inner / seats
    for index in range(seats):
        middle = -inner / 2 + (index + 0.5) * wide
        body.add(block((0.96 * wide, depth - 0.2, 0.15), (middle, -0.12, seat - 0.06)), shade(cloth, 1.15))
        levels = [
            (0.47 * wide, rear - 0.36, rear - 0.18, seat),
            (0.47 * wide, rear - 0.29, rear - 0.11, top + 0.04),
        ]
        body.add(loft_rectangles(levels, middle), shade(cloth, 1.15))
    if random.random() < 0.5:
        pillow = ellipsoid((inner / 2 - 0.2, rear - 0.42, seat + 0.2), (0.2, 0.09, 0.19), 10, 7)
        body.pair(pillow, paint(random, vivid=True))
    stand = DARK if random.random() < 0.5 else wood(random)
    for y in (front + 0.08, rear - 0.08):
        body.pair(bar((x, y, 0), (x, y, foot), 0.03), stand)
    return body


def tvmonitor(random: Generator) -> Body:
    """Return a flat screen on a foot, or an old set with a deep back; the screen faces the front and is on or off."""
    body = Body()
    case = DARK if random.random() < 0.6 else ((0.8, 0.79, 0.74) if random.random() < 0.6 else METAL)
    width = random.uniform(0.5, 1.0)
    old = random.random() < 0.35
    height = width * (random.uniform(0.72, 0.8) if old else random.uniform(0.56, 0.7))
    edge = width * random.uniform(0.035, 0.07)
    low = 0.03 if old else width * random.uniform(0.12, 0.22)
    middle, thick = low + height / 2, (0.18 if old else 0.07) * width
    body.add(block((width, thick, height), (0, 0, middle)), case)

    sky, land = shade(paint(random, vivid=True), 1.2), paint(random)
    on = random.random() < 0.65
    if not on:
        land, sky = (0.1, 0.11, 0.13), (0.16, 0.17, 0.2)
    face, wide, bottom, tall = -thick / 2, width - 2 * edge, low + edge, height - 2 * edge
    split = random.uniform(0.3, 0.7) * tall
    body.add(block((wide, 0.02, split), (0, face, bottom + split / 2)), land)
    body.add(block((wide, 0.02, tall - split), (0, face, bottom + (tall + split) / 2)), sky)
    body.add(block((0.03, 0.03, 0.015), (0, face - 0.005, low + edge / 2)), (0.2, 0.9, 0.3) if on else METAL)
    if old:
        deep = width * random.uniform(0.5, 0.7)
        half, high = 0.46 * width, 0.46 * height
        tube = [
            (half, -high, high, 0.0),
            (0.82 * half, -0.82 * high, 0.82 * high, 0.45),
            (0.49 * half, -0.49 * high, 0.49 * high, 1.0),
        ]
        lying = loft_rectangles(tube)  # the stack runs backwards: (x, y, z) becomes (x, z, y)
        back = Solid(lying.vertices[:, [0, 2, 1]] * (1, deep, 1) + (0, thick / 2, middle), lying.faces)
        body.add(back, shade(case, 0.85))
        body.add(block((0.6 * width, 0.5 * deep, 0.04), (0, 0.3 * deep, 0.02)), shade(case, 0.6))
    else:
        back = (0, 0.055 * width, middle - 0.05 * height)
        body.add(block((0.5 * width, 0.06 * width, 0.5 * height), back), shade(case, 0.8))
        neck = (0, 0.03 * width, (low + 0.1) / 2)
        body.add(block((0.1 * width, 0.05 * width, low + 0.1), neck), shade(case, 0.9))
        foot = revolution([(0.2 * width, 0.0), (0.2 * width, 0.012), (0.07 * width, 0.03)], 18, "rims")
        body.add(foot.scale(1.2, 0.8, 1.0).move(0, 0.03 * width), case)
    return body
