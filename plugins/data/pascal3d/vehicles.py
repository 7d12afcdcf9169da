"""Parametric vehicles of road and rail: bus, car and train; all lengths are in metres."""

import numpy as np
from numpy.random import Generator

from framework.geometry.round_solids import bar, wheel
from framework.geometry.solids import bevelled, block, loft, loft_rectangles, plate
from plugins.data.pascal3d.paint import DARK, GLASS, LAMP, METAL, RUBBER, TAIL_LAMP, paint, shade
from plugins.data.pascal3d.shapes import Body, offset_point


def bus(random: Generator) -> Body:
    """Return a city bus, coach or double-decker: a long box with bands of windows, a wide windscreen and lamps."""
    body = Body()
    skin, length = paint(random, vivid=True), random.uniform(8, 11)
    width, height, ground = 2.5, random.uniform(2.6, 3.1), 0.4
    second = (0.92, 0.92, 0.9) if random.random() < 0.5 else shade(skin, 0.6)
    two_decks = random.random() < 0.15
    if two_decks:
        length, height = 0.85 * length, 4.0
    front, rear, roof = -length / 2, length / 2, ground + height
    body.add(loft([bevelled(width, ground, roof, y, 0.15) for y in (front, rear)], "sharp"), skin)
    body.add(block((width + 0.04, length * 0.996, 0.35), (0, 0, ground + 0.18)), second)
    for low in (0.2, 0.62) if two_decks else (0.42,):
        z, tall = ground + (low + 0.13) * height, (0.2 if two_decks else 0.32) * height
        count = int(random.integers(5, 8))
        pitch = (length - 1.3) / count
        for index in range(count):
            y = front + 0.9 + (index + 0.5) * pitch
            body.pair(block((0.06, 0.85 * pitch, tall), (width / 2, y, z)), GLASS)
        body.add(block((0.9 * width, 0.06, 1.35 * tall), (0, front, z - 0.1 * tall)), GLASS)
        body.add(block((0.7 * width, 0.06, 0.6 * tall), (0, rear, z + 0.1 * tall)), GLASS)
    sign = (0.95, 0.75, 0.2) if random.random() < 0.6 else DARK
    body.add(block((0.7 * width, 0.08, 0.22), (0, front, roof - 0.22)), sign)
    body.pair(block((0.35, 0.08, 0.22), (0.38 * width, front, ground + 0.5)), LAMP)
    body.pair(block((0.22, 0.08, 0.5), (0.42 * width, rear, ground + 0.7)), TAIL_LAMP)
    body.add(block((0.5 * width, 0.07, 0.3), (0, front, ground + 0.45)), DARK)
    body.add(block((0.65 * width, 0.07, 0.5), (0, rear, ground + 0.75)), shade(skin, 0.45))
    arm = np.array([width / 2 + 0.28, front - 0.25, roof - 0.6])
    body.pair(bar((width / 2, front + 0.1, roof - 0.5), arm, 0.04), DARK)
    body.pair(block((0.12, 0.08, 0.4), offset_point(arm, 0, 0, -0.25)), DARK)  # mirrors
    for y in (front + 1.7, rear - 2.0):
        body.pair(wheel((width / 2 - 0.1, y, 0.5), 0.5, 0.36), RUBBER)
        body.pair(wheel((width / 2 + 0.09, y, 0.5), 0.25, 0.04, 10), METAL)
    if random.random() < 0.5:
        body.add(block((1.4, 1.8, 0.25), (0, random.uniform(-1, 2), roof + 0.1)), second)
    return body


CAR_REAR = {"saloon": (0.2, 0.5), "hatchback": (0.03, 0.42), "estate": (0.01, 0.15), "pickup": (0.43, 0.1)}
"""Kind of car → distance of the lower edge of the rear window from the rear end, in car lengths, and the distance in y
between its lower and upper edge, metres.
"""


def car(random: Generator) -> Body:
    """Return a saloon, hatchback, estate or pickup."""
    body = Body()
    skin = paint(random)
    length, width = random.uniform(3.9, 4.8), random.uniform(1.7, 1.85)
    ground, belt = 0.3, random.uniform(0.9, 1.05)
    roof = belt + random.uniform(0.45, 0.65)
    front, rear = -length / 2, length / 2
    kind = list(CAR_REAR)[int(random.choice(4, p=(0.4, 0.25, 0.2, 0.15)))]
    hood, trunk = belt - random.uniform(0.05, 0.15), belt - 0.03 * (kind == "saloon")
    lower = [
        bevelled(0.88 * width, ground + 0.08, hood - 0.22, front, 0.4),
        bevelled(0.98 * width, ground, hood - 0.08, front + 0.2, 0.3),
        bevelled(width, ground - 0.03, hood + 0.02, front + 0.28 * length, 0.25),
        bevelled(width, ground - 0.05, belt, 0.0, 0.2),
        bevelled(width, ground - 0.02, trunk, rear - 0.5, 0.25),
        bevelled(0.97 * width, ground + 0.02, trunk - 0.04, rear - 0.12, 0.3),
        bevelled(0.9 * width, ground + 0.1, trunk - 0.15, rear, 0.4),
    ]
    body.add(loft(lower, "sharp"), skin)

    start, rake = front + random.uniform(0.25, 0.3) * length, random.uniform(0.45, 0.7)
    room, slope = CAR_REAR[kind]
    end = rear - room * length

    def level(share: float, grow: float = 0.0) -> tuple[float, float, float, float]:
        """Return the rectangle of the cabin at a share of its height: half width, front y, rear y, z.

        The rectangle is enlarged by `grow` on each side.
        """
        half, z = (0.47 - 0.09 * share) * width + grow, belt - 0.03 + share * (roof - belt + 0.03)
        return half, start + share * rake - grow, end - share * slope + grow, z

    def pillar(low: float, high: float, along: float, grow: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the foot and the tip of a post at the side of the cabin.

        Args:
            low: Height of the foot, as a share of the cabin's height.
            high: Height of the tip, as a share of the cabin's height.
            along: Position of the post, as a share of the cabin's length from the front.
            grow: Distance by which the post lies outside of the cabin.
        """
        (x, near, far, z), (top_x, top_near, top_far, top_z) = level(low, grow), level(high, grow)
        foot, tip = near + along * (far - near), top_near + along * (top_far - top_near)
        return np.array([x, foot, z]), np.array([top_x, tip, top_z])

    body.add(loft_rectangles([level(0.0), level(1.0)]), skin)
    body.add(loft_rectangles([level(0.16, 0.012), level(0.86, 0.012)]), GLASS)
    for along in (0.52,) if kind == "pickup" else (0.42, 0.72):
        foot, tip = pillar(0.1, 0.9, along, 0.02)
        outline = [
            offset_point(point, 0, y, 0)
            for point, y in ((foot, -0.06), (foot, 0.06), (tip, 0.06), (tip, -0.06))
        ]
        body.pair(plate(outline, (0.03, 0, 0)), skin)
    for along in (0.0, 1.0):
        body.pair(bar(*pillar(0.0, 1.0, along, 0.015), 0.055, sides=4), skin)
    if kind == "pickup":
        middle, space = (rear + end) / 2, rear - end
        body.add(block((0.8 * width, space - 0.25, 0.06), (0, middle, belt - 0.01)), DARK)
        body.pair(block((0.07, space - 0.1, 0.16), (0.46 * width, middle, belt + 0.05)), skin)

    radius = random.uniform(0.31, 0.36)
    for y in (front + 0.19 * length, rear - 0.2 * length):
        body.pair(wheel((0.47 * width, y, radius), 1.22 * radius, 0.1, 14), DARK)
        body.pair(wheel((0.47 * width, y, radius), radius, 0.2), RUBBER)
        body.pair(wheel((0.47 * width + 0.1, y, radius), 0.6 * radius, 0.03, 10), METAL)
    lamp = (random.uniform(0.24, 0.34), 0.16, 0.15)
    body.pair(block(lamp, (0.33 * width, front + 0.05, hood - 0.27)), LAMP)
    body.add(block((0.34 * width, 0.1, 0.14), (0, front + 0.02, hood - 0.29)), DARK)  # grille
    body.add(block((0.92 * width, 0.14, 0.13), (0, front, ground + 0.17)), shade(skin, 0.45))
    body.add(block((0.92 * width, 0.14, 0.13), (0, rear, ground + 0.17)), shade(skin, 0.45))
    body.pair(block((0.2, 0.12, 0.17), (0.36 * width, rear - 0.03, trunk - 0.26)), TAIL_LAMP)
    body.add(block((0.42, 0.04, 0.12), (0, rear + 0.02, trunk - 0.36)), (0.9, 0.9, 0.85))  # number plate
    body.pair(block((0.14, 0.09, 0.12), (0.54 * width, start + 0.35, belt + 0.07)), skin)  # mirrors
    return body


def train(random: Generator) -> Body:
    """Return a locomotive, streamlined or flat-nosed, with a carriage behind it, on a piece of track."""
    body = Body()
    skin, second = paint(random, vivid=True), paint(random)
    width, height, ground = 2.8, 3.4, 0.9
    length, roof = random.uniform(10, 13), ground + height
    front = -0.55 * length
    streamlined = random.random() < 0.6
    nose = random.uniform(1.2, 3.5) if streamlined else 0.25
    along = np.array([0.0, 0.3, 0.65, 1.0])  # shares of the nose's length
    share = np.array([0.5, 0.78, 0.93, 1.0]) if streamlined else np.array([0.93, 0.97, 0.99, 1.0])
    rings = [
        bevelled(width * size, ground, ground + height * size, front + nose * position, 0.3)
        for size, position in zip(share, along, strict=True)
    ]
    rear = front + length
    body.add(loft([*rings, bevelled(width, ground, roof, rear, 0.3)], "sharp"), skin)
    coach = rear + 0.5
    tail = coach + random.uniform(5, 9)
    body.add(loft([bevelled(width, ground, roof, y, 0.3) for y in (coach, tail)], "sharp"), shade(skin, 0.9))
    body.add(block((0.7 * width, 0.6, 0.7 * height), (0, rear + 0.25, ground + 0.45 * height)), DARK)
    for start, stop in ((front + nose + 0.3, rear), (coach, tail)):
        body.add(block((width + 0.05, stop - start, 0.45), (0, (start + stop) / 2, ground + 0.3)), second)
        count = int((stop - start - 1) / 1.5)
        for index in range(count):
            y = start + 1.1 + (index + 0.5) * (stop - start - 1.4) / count
            body.pair(block((0.06, 0.9, 0.75), (width / 2, y, ground + 0.66 * height)), GLASS)

    # the windscreen: on the slope of a streamlined nose, upright on a flat one
    low, high = (0.45, 0.75) if streamlined else (0.0, 0.0)
    small, large = (float(np.interp(position, along, share)) for position in (low, high))
    wide = 0.8 * width * small
    z_low = ground + height * small * (0.92 if streamlined else 0.58)
    z_high = ground + height * large * (1.0 if streamlined else 0.9)
    y_low, y_high = front + nose * low, front + nose * high
    screen = [(0.5 * wide, y_low, z_low), (-0.5 * wide, y_low, z_low)]
    screen += [(-0.4 * wide, y_high, z_high), (0.4 * wide, y_high, z_high)]
    body.add(plate(screen, (0, -0.2, 0.2 if streamlined else 0.0)), GLASS)
    first = width * share[0]
    body.pair(block((0.4, 0.12, 0.3), (0.33 * first, front, ground + 0.25 * height * share[0])), LAMP)
    body.add(block((0.9 * first, 0.16, 0.35), (0, front - 0.02, ground + 0.08 * height)), (0.9, 0.75, 0.1))
    body.pair(block((0.35, 0.1, 0.35), (0.35 * width, tail, ground + 0.3 * height)), TAIL_LAMP)
    body.add(block((0.9, 0.1, 0.62 * height), (0, tail, ground + 0.4 * height)), DARK)  # the gangway door

    under = front + nose
    body.add(block((0.7 * width, tail - under, 0.4), (0, (tail + under) / 2, ground - 0.1)), DARK)
    for y in (under + 0.7, under + 2.1, rear - 2.1, rear - 0.7, coach + 0.9, tail - 0.9):
        body.pair(wheel((0.7, y, 0.45), 0.45, 0.2, 12), RUBBER)
    if random.random() < 0.5:  # pantograph
        y = random.uniform(0.2, 0.6) * rear
        body.pair(bar((0.4, y, roof), (0.3, y + 0.9, roof + 0.6), 0.06), DARK)
        body.pair(bar((0.3, y + 0.9, roof + 0.6), (0.3, y + 0.1, roof + 1.2), 0.06), DARK)
        body.add(bar((-0.9, y + 0.1, roof + 1.2), (0.9, y + 0.1, roof + 1.2), 0.06), DARK)
    body.pair(block((0.15, tail - front + 1.5, 0.12), (0.72, (front + tail) / 2, -0.06)), METAL)
    for y in np.arange(front - 0.5, tail + 0.6, 1.5):
        body.add(block((2.6, 0.4, 0.1), (0, y, -0.15)), (0.35, 0.26, 0.2))
    return body
