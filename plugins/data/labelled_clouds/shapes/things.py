"""Random solids of vehicles, instruments, devices, lamps and people, metres, front towards -y."""

import math

import numpy as np

from framework.geometry.round_solids import ball, cylinder, revolution, rod, tube
from framework.geometry.solids import Number, Solid, box, frustum, join, prism, side_prism, slab, with_mirror
from plugins.data.labelled_clouds.shapes.vessels import smooth_profile, vessel

Random = np.random.Generator


def airplane(random: Random) -> Solid:
    """Return an aeroplane."""
    length, radius = random.uniform(2.0, 3.6), random.uniform(0.1, 0.28)
    nose = random.uniform(0.08, 0.25)
    profile = [(0.02, 0.0), (0.75 * radius, nose * 0.5 * length), (radius, nose * length)]
    profile += [(radius, 0.65 * length), (0.2 * radius, length)]
    body = revolution(smooth_profile(random, profile, 20), 16).rotate("x", 90).move(0, length / 2, 0)
    body = body.rotate("z", 180)
    span, chord = random.uniform(0.8, 1.9), random.uniform(0.25, 0.7)
    sweep, taper = random.uniform(-0.1, 0.9), random.uniform(0.25, 1.0)
    at = random.uniform(-0.2, 0.15) * length
    z = random.choice([-0.5, 0.0, 0.8]) * radius

    def wing(half: Number, root: Number, back: Number) -> Solid:
        end = root * taper
        outline = [(0.0, -root / 2), (half, back - end / 2), (half, back + end / 2), (0.0, root / 2)]
        return slab(outline, 0.04)

    tail, high = length * 0.44, random.choice([0.0, 0.0, 0.4])
    fin = random.uniform(0.35, 0.55)
    flat = wing(span * random.uniform(0.3, 0.42), chord * 0.6, 0.15)
    parts = [
        body,
        with_mirror(wing(span, chord, sweep).move(0, at, z), 0),
        with_mirror(flat.move(0, tail + (0.1 if high else 0), 0.3 * radius + high), 0),
        wing(fin, chord * 0.7, 0.2).rotate("y", -90).move(0, tail, 0),
    ]
    if random.random() < 0.12:  # a biplane
        upper = wing(span, chord, sweep).move(0, at, z + 0.35)
        strut = rod((0.6 * span, at + 0.6 * sweep, z), (0.6 * span, at + 0.6 * sweep, z + 0.35), 0.02)
        parts += [with_mirror(upper, 0), with_mirror(strut, 0)]
    engines = int(random.choice([0, 1, 1, 2]))
    for number in range(engines):
        x = span * (0.3 + 0.28 * number)
        engine = cylinder(0.07, 0.35, sides=12).rotate("x", 90)
        parts.append(with_mirror(engine.move(x, at + sweep * x / span + 0.05, z - 0.09), 0))
    if random.random() < 0.2:  # a propeller
        for angle in (0, 90):
            blade = box(0.07, 0.03, 0.6, (0, 0, -0.3)).rotate("y", angle + 30)
            parts.append(blade.move(0, -length / 2, 0))
    if random.random() < 0.3:  # wheels
        for x, y in ((0.25, 0.1), (-0.25, 0.1), (0, -0.35 * length)):
            wheel = cylinder(0.08, 0.05, sides=12).rotate("y", 90).move(x - 0.025, y, -radius - 0.2)
            parts += [wheel, rod((x, y, -radius - 0.2), (x, y, 0), 0.015)]
    return join(parts)


def car(random: Random) -> Solid:
    """Return a saloon, estate, van, pick-up or open car; the bonnet points towards -y."""
    length, width = random.uniform(3.2, 5.2), random.uniform(1.5, 2.0)
    wheel, floor = random.uniform(0.28, 0.42), random.uniform(0.18, 0.35)
    waist = floor + random.uniform(0.45, 0.7)
    bow, stern = random.uniform(0.6, 0.95) * waist, random.uniform(0.75, 1.0) * waist
    y = length / 2
    hull = [(-y, floor), (y, floor), (0.97 * y, stern), (0.4 * y, waist), (-0.3 * y, waist), (-0.96 * y, bow)]
    parts = [side_prism(hull, width)]
    kind, roof = random.random(), random.uniform(0.4, 0.65)
    front, back = -0.38 * y, 0.6 * y
    if kind < 0.25:  # an estate
        back = 0.95 * y
    elif kind < 0.4:  # a van
        front, back, roof = -0.75 * y, 0.97 * y, random.uniform(0.7, 1.2)
    elif kind < 0.5:  # a pick-up
        back = 0.2 * y
    if kind < 0.92:
        rake_front, rake_back = random.uniform(0.1, 0.5), random.uniform(0.02, 0.4)
        shrink = random.uniform(0.75, 0.95)
        cabin = frustum(0.94 * width, back - front, shrink * width, back - front, roof)
        vertices = cabin.vertices.copy()
        vertices[4:6, 1] += rake_front
        vertices[6:, 1] -= rake_back
        parts.append(Solid(vertices, cabin.faces).move(0, (front + back) / 2, waist - 0.05))
    else:  # an open car
        pane = box(0.8 * width, 0.03, 0.4).rotate("x", -30)
        parts += [pane.move(0, front, waist - 0.05)]
        parts.append(with_mirror(box(0.35 * width, 0.15, 0.45, (0.22 * width, 0.2 * y, waist - 0.1)), 0))
    for at in (-0.62 * y, 0.6 * y):
        tyre = cylinder(wheel, 0.22, sides=18).rotate("y", 90).move(0, at, wheel)
        parts.append(with_mirror(tyre.move(width / 2 - 0.2, 0, 0), 0))
    if random.random() < 0.5:  # mirrors, bumpers, a spoiler, a rack
        parts.append(with_mirror(box(0.2, 0.1, 0.12, (0.53 * width, front + 0.1, waist)), 0))
    if random.random() < 0.4:
        for end in (-y, y):
            parts.append(box(0.95 * width, 0.15, 0.18, (0, end, floor + 0.05)))
    if random.random() < 0.2:
        parts.append(box(0.9 * width, 0.25, 0.05, (0, 0.92 * y, waist + 0.25)))
        parts.append(with_mirror(box(0.05, 0.1, 0.3, (0.3 * width, 0.92 * y, waist - 0.05)), 0))
    if kind < 0.05 or 0.5 <= kind < 0.62:
        parts.append(box(0.7 * width, 0.5 * (back - front), 0.08, (0, (front + back) / 2, waist + roof)))
    return join(parts)


def guitar(random: Random) -> Solid:
    """Return an acoustic or electric guitar, upright, its strings towards -y; some lie or lean."""
    electric = random.random() < 0.45
    angle = np.linspace(0, 2 * math.pi, 48, endpoint=False)
    long, waist = random.uniform(0.2, 0.27), random.uniform(0.5, 0.85)
    wide = long * random.uniform(0.65, 0.9)
    x, z = np.cos(angle), np.sin(angle)
    upper = random.uniform(0.7, 0.95)
    reach = np.where(z < 0, 1.0, upper) * (1 - (1 - waist) * np.exp(-((z - 0.1) ** 2) / 0.12) * np.abs(x))
    if electric:  # horns beside the neck
        horn = random.uniform(0.15, 0.5)
        for side in (-1, 1):
            place = math.pi / 2 + side * random.uniform(0.5, 0.8)
            reach = reach + horn * random.uniform(0.6, 1) * np.exp(-((angle - place) ** 2) / 0.03)
        reach = reach * (1 - 0.25 * np.exp(-((angle - math.pi / 2) ** 2) / 0.05))
    outline = np.column_stack([wide * reach * x, long * reach * z])
    thick = random.uniform(0.035, 0.06) if electric else random.uniform(0.08, 0.13)
    body = prism(outline, thick).rotate("x", 90).move(0, thick / 2, 0)
    neck, bar = random.uniform(0.4, 0.6), random.uniform(0.045, 0.065)
    top = long * upper * 0.8
    parts = [
        body,
        box(bar, 0.025, neck + 0.1, (0, -thick / 2, top - 0.1)),
        frustum(bar, 0.02, bar * random.uniform(1.2, 1.8), 0.02, 0.16, (0, -thick / 2 + 0.01, top + neck)),
        box(random.uniform(0.08, 0.14), 0.025, 0.025, (0, -thick / 2 - 0.005, -0.5 * long)),
    ]
    for row in range(3):
        for side in (-1, 1):
            start = (0, -thick / 2, top + neck + 0.04 + 0.04 * row)
            parts.append(rod(start, (side * 0.06, start[1], start[2]), 0.007, sides=6))
    if not electric and random.random() < 0.8:
        hole = cylinder(0.05, 0.01, sides=20).rotate("x", 90)
        parts.append(hole.move(0, -thick / 2 + 0.004, 0.15 * long))
    elif electric:
        for at in (0.1, -0.2):
            parts.append(box(0.08, 0.025, 0.03, (0, -thick / 2 - 0.005, at * long)))
    solid = join(parts)
    pose = random.random()
    if pose < 0.2:
        return solid.rotate("x", -90)
    if pose < 0.35:
        return solid.rotate("x", -random.uniform(10, 25))
    return solid.rotate("y", 90) if pose < 0.42 else solid


def key_rows(random: Random, width: Number, depth: Number, at: tuple[Number, Number, Number]) -> list[Solid]:
    """Return rows of keys on an area of `width` × `depth` with its middle at `at`; the front row has a long key."""
    x, y, z = at
    rows, columns = int(random.integers(4, 7)), int(random.integers(9, 16))
    wide, deep = width / columns, depth / rows
    parts = []
    for row in range(rows):
        for column in range(columns):
            if row == 0 and 0.25 < column / columns < 0.7:
                continue
            at = (x + wide * (column + 0.5 - columns / 2), y + deep * (row + 0.5 - rows / 2), z)
            parts.append(frustum(0.85 * wide, 0.85 * deep, 0.65 * wide, 0.65 * deep, 0.012, at))
    parts.append(box(0.42 * width, 0.8 * deep, 0.012, (x - 0.02 * width, y - deep * (rows - 1) / 2, z)))
    return parts


def keyboard(random: Random) -> Solid:
    """Return a computer keyboard."""
    width, depth = random.uniform(0.28, 0.52), random.uniform(0.11, 0.2)
    thick, rise = random.uniform(0.008, 0.025), random.uniform(0, 0.02)
    y = depth / 2
    wedge = [(-y, -0.012), (y, -0.012), (y, thick + rise), (-y, thick)]
    keys = random.uniform(0.6, 1.0)  # share of the width without the number pad
    tilt = math.degrees(math.atan2(rise, depth))
    field = key_rows(random, keys * width * 0.94, 0.8 * depth, (-(1 - keys) / 2 * width, 0, 0))
    if keys < 0.82:
        pad = (1 - keys) * width * 0.88
        field += key_rows(random, pad, 0.8 * depth, (keys / 2 * width, 0, 0))
    parts = [side_prism(wedge, width), join(field).rotate("x", tilt).move(0, 0, thick + rise / 2)]
    if random.random() < 0.3:  # a rest for the wrists
        parts.append(box(width, 0.35 * depth, 0.6 * thick + 0.012, (0, -0.65 * depth, -0.012)))
    if random.random() < 0.3:
        parts.append(with_mirror(box(0.03, 0.01, 0.03, (0.4 * width, 0.4 * depth, -0.035)), 0))
    return join(parts)


def laptop(random: Random) -> Solid:
    """Return an open laptop."""
    width = random.uniform(0.28, 0.42)
    depth, thick = width * random.uniform(0.6, 0.78), random.uniform(0.012, 0.04)
    parts = [box(width, depth, thick)]
    parts += key_rows(random, 0.86 * width, 0.45 * depth, (0, 0.15 * depth, thick))
    if random.random() < 0.7:
        parts.append(box(0.25 * width, 0.2 * depth, 0.004, (0, -0.3 * depth, thick)))
    angle = random.uniform(85, 140) if random.random() < 0.85 else random.uniform(15, 70)
    lid = [box(width, depth, 0.5 * thick + 0.004)]
    rim = 0.06 * depth
    lid.append(with_mirror(box(rim, depth, 0.006, ((width - rim) / 2, 0, -0.006)), 0))
    lid += [box(width, rim, 0.006, (0, side * (depth - rim) / 2, -0.006)) for side in (-1, 1)]
    opened = join(lid).move(0, -depth / 2, 0).rotate("x", -angle)
    parts.append(opened.move(0, depth / 2, thick))
    return join(parts)


def monitor(random: Random) -> Solid:
    """Return a monitor on a stand."""
    width = random.uniform(0.4, 1.2)
    height, thick = width * random.uniform(0.5, 0.85), random.uniform(0.025, 0.09)
    lift = random.uniform(0.04, 0.3)
    frame = random.uniform(0.015, 0.05)
    parts = [
        box(width, thick, height, (0, 0, lift)),
        box(width, 0.03, frame, (0, -thick / 2, lift)),
        box(width, 0.03, frame, (0, -thick / 2, lift + height - frame)),
        with_mirror(box(frame, 0.03, height, ((width - frame) / 2, -thick / 2, lift)), 0),
    ]
    foot = random.random()
    if foot < 0.4:
        parts.append(box(width * random.uniform(0.3, 0.6), random.uniform(0.15, 0.25), 0.02))
    elif foot < 0.75:
        parts.append(cylinder(random.uniform(0.1, 0.18), 0.02, sides=24))
    elif foot < 0.9:  # two feet
        parts.append(with_mirror(box(0.03, 0.25, lift, (0.35 * width, 0, 0)), 0))
    if foot < 0.75:
        parts.append(box(random.uniform(0.04, 0.12), 0.04, lift + 0.1, (0, thick / 2, 0)))
    if random.random() < 0.2:  # a picture tube
        depth = random.uniform(0.2, 0.4)
        back_part = frustum(width * 0.9, height * 0.9, width * 0.5, height * 0.5, depth).rotate("x", -90)
        parts.append(back_part.move(0, thick / 2, lift + height / 2))
    if random.random() < 0.15:  # loudspeakers
        parts.append(with_mirror(box(0.1, 0.1, 0.8 * height, (width / 2 + 0.08, 0, 0)), 0))
    return join(parts)


def piano(random: Random) -> Solid:
    """Return an upright or grand piano, the keys towards -y, sometimes with a stool."""
    width = random.uniform(1.3, 1.6)
    ledge, deep = random.uniform(0.6, 0.75), random.uniform(0.25, 0.4)
    parts: list[Solid] = []
    if random.random() < 0.55:
        height, depth = random.uniform(0.95, 1.4), random.uniform(0.3, 0.5)
        front = -depth / 2
        parts += [
            box(width, depth, height),
            box(0.96 * width, deep, 0.12, (0, front - deep / 2, ledge - 0.1)),
        ]
        arm = box(0.06, deep, random.uniform(0.15, 0.3), (width / 2 - 0.03, front - deep / 2, ledge - 0.1))
        parts.append(with_mirror(arm, 0))
        if random.random() < 0.75:
            leg = cylinder(0.035, ledge, (0.45 * width, front - 0.8 * deep, 0), sides=8)
            parts.append(with_mirror(leg, 0))
        if random.random() < 0.5:
            parts.append(box(1.04 * width, depth + 0.06, 0.04, (0, 0, height)))
    else:
        long, high = random.uniform(1.3, 2.4), random.uniform(0.25, 0.35)
        front = -0.4 * long
        bend = np.linspace(0, 1, 10)
        right = width / 2 - 0.55 * width * (0.5 - 0.5 * np.cos(math.pi * bend)) ** 1.3
        side = [(float(x), float(front + long * b)) for x, b in zip(right, bend, strict=True)]
        outline = [(-width / 2, front), *side, (-width / 2, front + long)]
        flat = np.array(outline)
        middle = np.array([-0.15 * width, front + 0.4 * long])
        parts.append(prism(flat - middle, high).move(middle[0], middle[1], ledge - 0.05))
        parts.append(box(width, deep, 0.14, (0, front - deep / 2, ledge - 0.05)))
        for x, y in ((-0.42 * width, front), (0.42 * width, front), (-0.2 * width, front + 0.85 * long)):
            parts.append(cylinder(0.06, ledge, (x, y, 0), top=0.08, sides=10))
        if random.random() < 0.6:  # the lid, raised
            lid = prism(flat - middle, 0.03).move(middle[0] + width / 2, middle[1], 0)
            lid = lid.rotate("y", -random.uniform(25, 45))
            parts.append(lid.move(-width / 2, 0, ledge + high - 0.05))
    for x in np.linspace(-0.45, 0.45, 17) * width:  # black keys
        parts.append(box(0.02, 0.5 * deep, 0.03, (x, front - 0.4 * deep, ledge + 0.02)))
    if random.random() < 0.5:  # music rest
        rest = box(0.5 * width, 0.03, 0.28).rotate("x", -12)
        parts.append(rest.move(0, front, ledge + random.uniform(0.05, 0.3)))
    if random.random() < 0.6:
        parts += [box(0.03, 0.15, 0.03, (x, front - 0.1, 0.05)) for x in (-0.08, 0, 0.08)]
    if random.random() < 0.35:
        wide, y = random.uniform(0.4, 0.9), front - deep - random.uniform(0.2, 0.4)
        parts.append(box(wide, 0.32, 0.08, (0, y, 0.42)))
        leg = rod((0.42 * wide, 0.12, 0), (0.42 * wide, 0.12, 0.42), 0.025)
        parts.append(with_mirror(with_mirror(leg, 0), 1).move(0, y, 0))
    return join(parts)


def lamp(random: Random) -> Solid:
    """Return a standing, bent, table or hanging lamp."""
    height, shade = random.uniform(0.4, 1.7), random.uniform(0.12, 0.32)
    foot, style = random.uniform(0.08, 0.22), random.random()
    tall, narrow = random.uniform(0.15, 0.38), random.uniform(0.3, 1)
    cone = [(shade, height), (shade * narrow, height + tall)]
    if style < 0.15:  # hanging, of one shade or several
        parts = [cylinder(0.06, 0.03, (0, 0, height + tall + 0.6), sides=12)]
        count = int(random.choice([1, 3, 5, 6]))
        out = 0.0 if count == 1 else random.uniform(0.25, 0.5)
        parts.append(rod((0, 0, height + 0.5 * tall), (0, 0, height + tall + 0.6), 0.012))
        size = 1.0 if count == 1 else 0.4
        for angle in 2 * math.pi * np.arange(count) / count:
            x, y = out * math.cos(angle), out * math.sin(angle)
            if count > 1:
                parts.append(rod((0, 0, height + 0.6 * tall), (x, y, height + 0.4 * tall), 0.012))
            hanging = vessel([(r * size, (z - height) * size) for r, z in cone], 0.008, 0.8 * tall * size, 16)
            parts.append(hanging.move(x, y, height))
        return join(parts)
    base = cylinder(foot, 0.04, top=foot * random.uniform(0.5, 1))
    if style < 0.35:  # bent
        knee, reach = random.uniform(-0.3, 0.1), random.uniform(0.15, 0.5)
        elbow, end = (knee, 0.0, 0.6 * height), (knee + reach, 0.0, height)
        parts = [base, rod((0, 0, 0), elbow, 0.015), rod(elbow, end, 0.015)]
        head = revolution([(shade * 0.7, 0), (0.03, 0.2)]).rotate("y", random.uniform(-40, 20))
        return join([*parts, head.move(end[0], 0, end[2] - 0.1)])
    parts = [base, cylinder(random.uniform(0.01, 0.03), height + 0.5 * tall)]
    if random.random() < 0.2:
        parts.append(ball(shade, (0, 0, height + 0.5 * shade), 14))
    else:
        parts.append(vessel(cone, 0.008, height + 0.8 * tall))
    if style < 0.6:  # a thick body
        belly = random.uniform(0.8, 1.6) * foot
        body = [(foot * 0.6, 0.0), (belly, random.uniform(0.2, 0.5) * height), (0.03, 0.75 * height)]
        parts.append(revolution(smooth_profile(random, body, 12), 20))
    return join(parts)


def person(random: Random) -> Solid:
    """Return a standing, walking or seated person with arms down, raised or spread, sometimes with a skirt or a hat."""
    hip, stout = random.uniform(0.8, 1.0), random.uniform(0.8, 1.4)
    chest, shoulder = hip + random.uniform(0.48, 0.6), random.uniform(0.17, 0.24) * stout**0.5
    seated = random.random() < 0.12
    stride, foot_offset = random.uniform(0, 0.35), random.uniform(0.07, 0.2)
    parts = [
        frustum(1.5 * shoulder, 0.2 * stout, 2 * shoulder, 0.24 * stout, chest - hip, (0, 0, hip)),
        ball(0.11, (0, -0.02, chest + 0.2), 10).scale(0.85, 1, 1),
        cylinder(0.055, 0.14, (0, 0, chest - 0.02), sides=8),
    ]
    thigh, shin = 0.085 * stout, 0.05 * stout
    for side in (-1, 1):
        x, y = side * foot_offset, side * stride
        top = (side * 0.1, 0.0, hip + 0.03)
        knee = (x, -0.42, hip) if seated else ((x + top[0]) / 2, y / 2 - 0.4 * abs(y) * 0.2, 0.5 * hip)
        ankle = (x, -0.42, 0.45 * hip) if seated else (x, y, 0.06)
        parts.append(tube([top, knee], [thigh, 0.75 * thigh]))
        parts.append(tube([knee, ankle], [0.75 * thigh, shin]))
        parts.append(box(0.1, 0.26, 0.08, (ankle[0], ankle[1] - 0.07, ankle[2] - 0.06)))
    pose, swing = random.random(), random.uniform(-0.3, 0.3)
    for side in (-1, 1):
        joint = (side * shoulder, 0.0, chest - 0.05)
        if pose < 0.55:  # both arms hang down
            elbow = (joint[0] + side * random.uniform(0.02, 0.15), side * swing / 2, chest - 0.32)
            hand = (elbow[0] + side * random.uniform(-0.12, 0.05), side * swing - 0.1, chest - 0.58)
        elif pose < 0.8:  # both arms are spread
            lift = random.uniform(-0.15, 0.05)
            elbow = (joint[0] + side * 0.27, 0.0, joint[2] + lift)
            hand = (elbow[0] + side * 0.26, -0.03, elbow[2] + lift)
        else:  # the forearms point forwards or upwards
            elbow = (joint[0] + side * 0.12, -0.15 * random.random(), chest - 0.27)
            hand = (elbow[0], elbow[1] - 0.2, elbow[2] + random.uniform(-0.05, 0.4))
        arm = 0.05 * stout**0.5
        parts += [tube([joint, elbow], [arm, 0.85 * arm]), tube([elbow, hand], [0.85 * arm, 0.6 * arm])]
        parts.append(ball(0.05, hand, 8))
    clothing = random.random()
    if clothing < 0.2 and not seated:  # a skirt or a coat
        wide = random.uniform(1.3, 2.4) * shoulder
        low = random.uniform(0.15, 0.6) * hip
        parts.append(cylinder(wide, hip + 0.1 - low, (0, 0, low), top=0.8 * shoulder).scale(1, 0.8, 1))
    if random.random() < 0.2:  # a hat
        parts.append(cylinder(random.uniform(0.12, 0.25), 0.02, (0, 0, chest + 0.27), sides=16))
        parts.append(cylinder(0.1, random.uniform(0.06, 0.18), (0, 0, chest + 0.27), sides=12))
    if random.random() < 0.15:
        parts.append(box(0.3, 0.15, 0.4, (0, 0.2, hip + 0.08)))
    if seated:
        parts.append(box(0.5, 0.45, 0.05, (0, -0.1, hip - 0.12)))
    elif random.random() < 0.15:
        parts.append(cylinder(random.uniform(0.3, 0.45), 0.05, sides=20))
    return join(parts)
