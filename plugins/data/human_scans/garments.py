"""Clothes of generated people: cloth over a body, with thickness, wrinkles, patterns, hems, buttons and prints."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from plugins.data.human_scans.anatomy import Anatomy
from plugins.data.human_scans.fabrics import Pattern, dye, folds, hue, noise, pattern

FAR = 9.0
"""Distance, metres, that stands for deep inside or far outside of a garment."""
EDGE = 0.012
"""Width, metres, over which a hem rises from the skin."""
SEAM = 0.011
"""Width of the stitched border, metres."""


class Garment(NamedTuple):
    """One piece of clothing.

    Attributes:
        inside: signed distance of each vertex from the garment's border, metres; above 0 if the garment covers the
            vertex.
        thickness: distance from the skin (or from the garment under it), metres.
        wrinkles: displacement outwards, metres, with a mean near 0.
        colors: linear RGB of every vertex; it has a meaning only inside the garment.
    """

    inside: Float[np.ndarray, "vertices"]
    thickness: float
    wrinkles: Float[np.ndarray, "vertices"]
    colors: Float[np.ndarray, "vertices 3"]

    def raised(self) -> Float[np.ndarray, "vertices"]:
        """Return the distance of the garment from the surface under it, metres."""
        return _step(self.inside / EDGE) * (self.thickness + self.wrinkles).clip(0.001, None)


@dataclass(frozen=True)
class Skirt:
    """Piece that hangs from the waist and touches no leg; plugins.data.human_scans.hanging makes its mesh.

    Attributes:
        top, length: height of the skirt's upper border in the rest pose, and length of the skirt, metres.
        flare: the radius of the skirt grows by at least flare - 0.08 metres per metre downwards; with a flare below
            0.08 the radius may shrink.
        pleats, depth: number of folds around the body, and about half of a fold's depth at the hem, metres.
        cloth: function from coordinates across and along the cloth to colours.
    """

    top: float
    length: float
    flare: float
    pleats: int
    depth: float
    cloth: Pattern


class Outfit(NamedTuple):
    """Clothes of one person.

    Attributes:
        garments: garments from the innermost outwards, without a skirt.
        skirt: the skirt; None if the person wears none.
    """

    garments: list[Garment]
    skirt: Skirt | None


def outfit(body: Anatomy, random: Generator) -> Outfit:
    """Return the random clothes of one person."""
    below = random.choice(["trousers", "shorts", "skirt", "dress"], p=[0.64, 0.16, 0.12, 0.08])
    skirt = None
    garments = []
    cloth = pattern(random)
    if below in ("trousers", "shorts"):
        garments.append(_trousers(body, random, short=below == "shorts"))
    else:
        garments.append(_leggings(body, random))
        length = random.uniform(0.3, 0.65) if below == "skirt" else random.uniform(0.45, 0.85)
        skirt = Skirt(
            body.waist,
            length,
            random.uniform(0.0, 0.2),
            int(random.integers(7, 22)),
            random.uniform(0.004, 0.02),
            cloth,
        )
    garments.append(_shoes(body, random))
    top = random.choice(["shirt", "shirt", "jumper", "blouse", "vest"])
    if below == "dress":
        garments.append(_top(body, random, str(random.choice(["shirt", "vest"])), cloth, body.waist - 0.02))
    else:
        tucked = skirt is not None or random.random() < 0.3
        hem = body.waist - (0.02 if tucked else random.uniform(0.1, 0.24))
        garments.append(_top(body, random, str(top), pattern(random), hem))
        if random.random() < 0.25:
            garments.append(_jacket(body, random))
    return Outfit(garments, skirt)


def _trousers(body: Anatomy, random: Generator, *, short: bool) -> Garment:
    cuff = random.uniform(0.16, body.knee + 0.04) if short else random.uniform(body.ankle - 0.1, body.ankle)
    inside = np.minimum(
        body.waist + 0.01 - body.place[:, 1], np.where(body.legs > 0.5, cuff - body.along_leg, FAR)
    )
    inside = np.where(body.on_arm, -FAR, inside)
    loose = random.uniform(0.004, 0.022)
    jeans = random.random() < 0.5
    color = (
        hue(random.uniform(205, 230), random.uniform(0.3, 0.75), random.uniform(0.2, 0.65))
        if jeans
        else dye(random)
    )
    across, along = _on_legs(body)
    faded = 0.2 * np.exp(-(((body.along_leg - 0.5 * body.knee) / 0.15) ** 2)) * (body.place[:, 2] > 0.03)
    cloth_colors = color * (1 + (0.5 if jeans else 0.15) * faded[:, None])
    if not jeans and random.random() < 0.35:
        cloth_colors = pattern(random)(across, along)
    outer = (np.abs(body.place[:, 2] - 0.01) < 0.004) & (across > 0.03)
    stitches = np.where(outer, 0.55, 1.0)
    belt = np.abs(body.place[:, 1] - (body.waist - 0.015)) < 0.016
    strap, metal = dye(random) * 0.5, hue(45, 0.4, 0.85)
    cloth_colors = cloth_colors * stitches[:, None]
    cloth_colors = np.where(belt[:, None], strap, cloth_colors)
    buckle = belt & (np.abs(body.place[:, 0]) < 0.02) & (body.place[:, 2] > 0.05)
    cloth_colors = np.where(buckle[:, None], metal, cloth_colors)
    pocket = np.abs(np.abs(body.place[:, 0]) - 0.09 - 0.4 * (body.place[:, 1] - body.hips)) < 0.004
    pocket &= (np.abs(body.place[:, 1] - body.hips - 0.03) < 0.05) & (body.place[:, 2] > 0.04)
    cloth_colors = np.where(pocket[:, None], 0.5 * cloth_colors, cloth_colors)
    bends = (
        0.35
        + _near(along, body.knee, 0.12)
        + 0.8 * _near(along, body.ankle, 0.12)
        + 0.6 * _near(along, 0.0, 0.1)
    )
    wrinkles = (0.25 * loose + 0.0025) * bends * folds(body.place, 0.06, (0.25, 1.0, 0.1), random)
    return Garment(inside, loose, wrinkles, _add_weave(body, cloth_colors, wrinkles, inside, random))


def _leggings(body: Anatomy, random: Generator) -> Garment:
    bare = random.random() < 0.5
    inside = np.where(body.legs > 0.5, body.ankle - body.along_leg, body.waist - body.place[:, 1])
    inside = np.where(body.on_arm | bare, -FAR, inside)
    color = np.broadcast_to(dye(random) * 0.5, (len(inside), 3))
    none = np.zeros(len(inside))
    return Garment(inside, 0.001, none, color)


def _shoes(body: Anatomy, random: Generator) -> Garment:
    height = random.choice([0.0, 0.02, 0.1])
    inside = np.where(body.legs > 0.5, body.along_leg - (body.ankle - height), -FAR)
    floor = body.place[:, 1].min()
    color, sole = dye(random) * 0.8, hue(40, 0.05, random.choice([0.1, 0.9]))
    colors = np.where((body.place[:, 1] < floor + 0.022)[:, None], sole, color)
    if random.random() < 0.5:
        laces = (
            (body.place[:, 2] > 0.06)
            & ((body.place[:, 2] / 0.02) % 1 < 0.4)
            & (body.place[:, 1] > floor + 0.05)
        )
        colors = np.where(laces[:, None], sole, colors)
    return Garment(
        inside, 0.011, np.zeros(len(inside)), _add_weave(body, colors, np.zeros(len(inside)), inside, random)
    )


def _top(body: Anatomy, random: Generator, kind: str, cloth: Pattern, hem: float) -> Garment:
    cuff = {
        "shirt": random.uniform(0.1, 0.8 * body.elbow),
        "jumper": body.wrist - 0.01,
        "blouse": random.choice([body.wrist - 0.015, body.elbow + 0.05]),
        "vest": 0.015,
    }[kind]
    thickness = {"shirt": 0.007, "jumper": 0.014, "blouse": 0.008, "vest": 0.004}[kind] * random.uniform(
        0.6, 1.8
    )
    inside = np.minimum(
        _trunk(body, hem, random.uniform(0.055, 0.1)), np.where(body.on_arm, cuff - body.along_arm, FAR)
    )
    if kind == "vest":
        inside = np.minimum(inside, cuff + 0.02 - np.where(body.along_arm > -0.5, body.along_arm, -FAR))
    across, along = _on_trunk(body)
    colors = cloth(across, along)
    front = body.place[:, 2] > 0.0
    if kind == "blouse" or (kind == "shirt" and random.random() < 0.25):
        colors = _add_buttons(body, colors, front, random)
    elif kind == "shirt" and random.random() < 0.55:
        colors = _add_print(body, colors, front, random)
    collar = np.linalg.norm(body.place - body.neck_place, axis=1)
    ribbed = (collar < 0.12) & (inside < 0.02) & (kind != "blouse")
    colors = np.where(ribbed[:, None], 0.7 * colors, colors)
    arm = np.where(body.on_arm, body.along_arm, 0)
    bends = (
        0.45 + 0.8 * _near(body.place[:, 1], body.waist, 0.08) + body.on_arm * _near(arm, body.elbow, 0.09)
    )
    bends = bends + 0.7 * _near(body.along_arm, 0.03, 0.06)
    wrinkles = (
        (0.3 * thickness + 0.002)
        * bends
        * folds(body.place, random.uniform(0.06, 0.1), (random.uniform(-1, 1), 1.0, 0.3), random)
    )
    if hem < body.waist - 0.05:  # the garment hangs loose below the waist
        thickness = thickness + 0.004
        wrinkles = wrinkles + 0.008 * np.exp(-((body.place[:, 1] - hem) / 0.1).clip(0, None)) * ~body.on_arm
    return Garment(inside, thickness, wrinkles, _add_weave(body, colors, wrinkles, inside, random))


def _jacket(body: Anatomy, random: Generator) -> Garment:
    hem = body.hips - random.uniform(-0.06, 0.25)
    inside = np.minimum(_trunk(body, hem, 0.075), np.where(body.on_arm, body.wrist - body.along_arm, FAR))
    open_by = random.uniform(0.02, 0.07)
    slant = open_by + 0.12 * (body.place[:, 1] - hem).clip(0, None) * random.uniform(0, 0.6)
    opening = np.where(body.place[:, 2] > 0.02, np.abs(body.place[:, 0]) - slant, FAR)
    inside = np.where(body.on_arm, inside, np.minimum(inside, opening))
    colors = (
        pattern(random)(*_on_trunk(body)) if random.random() < 0.3 else np.tile(dye(random), (len(inside), 1))
    )
    pocket = np.abs(body.place[:, 1] - (body.hips + 0.02)) < 0.005
    pocket &= (np.abs(np.abs(body.place[:, 0]) - 0.1) < 0.05) & (body.place[:, 2] > 0)
    colors = np.where(pocket[:, None], 0.4 * colors, colors)
    arm = np.where(body.on_arm, body.along_arm, 0)
    bends = (
        0.5 + 1.2 * body.on_arm * _near(arm, body.elbow, 0.1) + 0.5 * _near(body.place[:, 1], body.waist, 0.1)
    )
    wrinkles = 0.004 * bends * folds(body.place, 0.08, (0.6, 1.0, 0.0), random)
    return Garment(
        inside, random.uniform(0.009, 0.018), wrinkles, _add_weave(body, colors, wrinkles, inside, random)
    )


def _trunk(body: Anatomy, hem: float, opening: float) -> Float[np.ndarray, "vertices"]:
    """Return the signed distance of each vertex from the nearest border of a garment on the trunk, metres.

    The distance is positive inside the garment, which reaches from the height `hem` to an opening around the neck of
    radius `opening`. The garment has no border on the arms.
    """
    down = np.where(body.on_arm, FAR, body.place[:, 1] - hem)
    # the opening is deeper in front
    centre = body.neck_place + np.array([0, 0.015, 0.03])
    away = (body.place - centre) * np.array([0.85, 0.9, 1.0])
    neck = np.where(body.on_arm, FAR, np.linalg.norm(away, axis=1) - opening)
    neck = np.where((body.place[:, 1] > body.neck + 0.06) | (body.head > 0.3), -FAR, neck)
    return np.minimum(down, neck)


def _add_buttons(body: Anatomy, colors: np.ndarray, front: np.ndarray, random: Generator) -> np.ndarray:
    placket = front & (np.abs(body.place[:, 0]) < 0.017) & ~body.on_arm
    colors = np.where((placket & (np.abs(body.place[:, 0]) > 0.014))[:, None], 0.5 * colors, colors)
    spacing = random.uniform(0.07, 0.1)
    height = (body.place[:, 1] / spacing) % 1 - 0.5
    button = placket & (np.hypot(body.place[:, 0], height * spacing) < 0.007)
    return np.where(button[:, None], dye(random), colors)


def _add_print(body: Anatomy, colors: np.ndarray, front: np.ndarray, random: Generator) -> np.ndarray:
    """Return colours with a print on the chest: a disc, a diamond, a star, or lines like words."""
    x, y = body.place[:, 0], body.place[:, 1] - (body.chest - 0.04)
    size, ink, other = random.uniform(0.05, 0.1), dye(random), dye(random)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    kind = random.integers(4)
    if kind == 0:
        shape = radius < size
    elif kind == 1:
        shape = np.abs(x) + np.abs(y) < size
    elif kind == 2:
        shape = radius < size * (0.65 + 0.35 * np.cos(5 * (angle - np.pi / 2)))
    else:
        shape = (np.abs(y) < 0.7 * size) & (np.abs(x) < 1.4 * size) & ((y / 0.03) % 1 < 0.55)
        shape &= np.sin(400 * x + 9 * np.floor(y / 0.03) ** 2) > -0.5
    shape &= front & ~body.on_arm
    inner = shape & (radius < 0.5 * size) & (kind < 3)
    return np.where(inner[:, None], other, np.where(shape[:, None], ink, colors))


def _add_weave(
    body: Anatomy, colors: np.ndarray, wrinkles: np.ndarray, inside: np.ndarray, random: Generator
) -> Float[np.ndarray, "vertices 3"]:
    """Return the colours of a garment with the noise of the weave, darker valleys, and stitches along the border.

    Args:
        body: anatomy of the wearer.
        colors: colours before.
        wrinkles: displacement outwards, metres.
        inside: signed distance from the garment's border, metres.
        random: source of the noise.
    """
    weave = 1 + 0.04 * noise(body.place, 0.008, random) + 0.04 * noise(body.place, 0.05, random)
    depth = 1 + 0.18 * np.tanh(wrinkles / 0.004)
    border = np.where(np.abs(inside - SEAM) < 0.002, 0.75, 1.0)
    return (colors * (weave * depth * border)[:, None]).clip(0.004, 0.95)


def _on_trunk(body: Anatomy) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of each vertex across and along the cloth of an upper garment, metres.

    On the trunk, they run around the trunk and upwards. On an arm, they run around the arm and from the wrist to the
    shoulder.
    """
    x, y, z = body.place.T
    across = 0.22 * np.arctan2(x, np.abs(z) + 0.15)  # nearly x in front and behind, an angle at the sides
    return np.where(body.on_arm, 1.3 * z, across), np.where(body.on_arm, -body.along_arm, y)


def _on_legs(body: Anatomy) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of each vertex across and along the cloth of trousers, metres.

    The coordinate across is 0 in front and behind, and below 0 on the inner side of a leg.
    """
    x, y, z = body.place.T
    legs = body.legs > 0.5
    middle = np.polyval(np.polyfit(y[legs], np.abs(x)[legs], 1), y) if legs.any() else 0.0
    return 0.1 * np.arctan2(np.abs(x) - middle, np.abs(z - 0.01) + 0.06), np.where(
        legs, body.along_leg, body.hips - y
    )


def _near(values: np.ndarray, centre: float, width: float) -> np.ndarray:
    return np.exp(-(((values - centre) / width) ** 2))


def _step(values: np.ndarray) -> np.ndarray:
    """Return a smooth step (Hermite): 0 below 0, 1 above 1."""
    share = values.clip(0, 1)
    return share * share * (3 - 2 * share)
