"""Synthetic photographs of heads: ray-cast ellipsoids in front of clutter, photographed by a poor camera.

The rays are parallel. The camera looks along -z; x points right in the image and y up. In the frame of the head, x
points to its left, y to its crown, and z out of its face. At pan, tilt and roll 0 both frames agree, and the face looks
into the camera. Lengths are in half heights of a head.

`no_type_check` exempts the compiled functions from the type checks that tests switch on.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, no_type_check

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("synthetic_heads", [Path(__file__)]))

VERSION = 1
"""Version of the images, stored with generated data; increase it if the drawn images change."""
Array = NDArray[np.float64]
SAMPLES = 2
"""Number of rays along each side of a pixel."""
CLOTH, SKIN, HAIR = 0, 1, 2
EYE, EYE_HEIGHT, MOUTH_HEIGHT = 0.31, 0.12, -0.52
SKINS = ((0.93, 0.76, 0.66), (0.85, 0.65, 0.52), (0.70, 0.50, 0.38), (0.52, 0.35, 0.26), (0.40, 0.27, 0.20))
HAIRS = ((0.08, 0.07, 0.06), (0.20, 0.13, 0.09), (0.36, 0.24, 0.14), (0.62, 0.47, 0.28), (0.55, 0.54, 0.53))


class Pose(NamedTuple):
    """Pan, tilt and roll in degrees.

    Pan > 0 turns the nose towards the right of the image, tilt > 0 lifts the nose, and roll > 0 leans the crown towards
    the left of the image. A mirror image negates pan and roll.
    """

    pan: float
    tilt: float = 0.0
    roll: float = 0.0


@dataclass(frozen=True)
class Person:
    """Appearance of a person, which is the same in every image of the person.

    Attributes:
        skin, hair, cloth, hat_color: Colours (3,), 0…1.
        axes: Half width, half height and half depth of the skull.
        face_tilt: Angle below the horizontal at which the middle of the opening in the hair lies, radians; the face
            shows through this opening.
        face_reach: Cosine of the angular radius of the opening; -1 for a bald head without a hat.
        long_hair, bun, hat: Whether the person has long hair, a bun or a hat.
        glasses, beard: Darkness of the glasses and of the beard, 0…1; 0: none.
        ears: Relative size of the ears; 0 if hair hides them.
    """

    skin: Array
    hair: Array
    cloth: Array
    hat_color: Array
    axes: Array
    face_tilt: float
    face_reach: float
    long_hair: bool
    bun: bool
    hat: bool
    glasses: float
    beard: float
    ears: float


class Conditions(NamedTuple):
    """Conditions of photographs; values are drawn uniformly from the ranges.

    Attributes:
        pixels: Range of the side of the camera's image, camera pixels; the image is then scaled to the requested side.
        height: Range of the head's height, as a share of the side.
        offset: Largest shift of the head's middle from the middle of the image, as a share of the side.
        blur: Largest standard deviation of the camera's blur, camera pixels.
        noise: Largest standard deviation of the camera's noise; values of pixels are 0…1.
        clutter: Largest number of shapes in the background.
        occluded: Share of images in which a shape hides part of the head.
    """

    pixels: tuple[int, int]
    height: tuple[float, float]
    offset: float
    blur: float
    noise: float
    clutter: int
    occluded: float


def random_person(random: Generator) -> Person:
    """Return a person of random head shape, skin, hair, clothes and accessories."""
    tone = int(random.integers(5))
    long_hair, bald, hat = random.random() < 0.3, random.random() < 0.1, random.random() < 0.15
    covered = long_hair and not bald
    return Person(
        skin=np.clip(np.array(SKINS[tone]) + random.normal(0, 0.03) + random.normal(0, 0.01, 3), 0, 1),
        hair=np.clip(
            np.array(HAIRS[random.integers(1 if tone > 2 else 5)]) + random.normal(0, 0.02, 3), 0.02, 1
        ),
        cloth=_muted_color(random),
        hat_color=_muted_color(random),
        axes=np.array([0.76, 1.0, 0.88]) * random.uniform(0.94, 1.06, 3),
        face_tilt=random.uniform(0.4, 0.7) if covered else random.uniform(0.75, 0.95),
        face_reach=-1.0 if bald and not hat else random.uniform(0.25, 0.4),
        long_hair=covered,
        bun=not bald and random.random() < 0.12,
        hat=hat,
        glasses=random.uniform(0.5, 0.9) if random.random() < 0.25 else 0.0,
        beard=random.uniform(0.3, 0.85) if not covered and random.random() < 0.35 else 0.0,
        ears=0.0 if covered else random.uniform(0.8, 1.2),
    )


def rotation(pose: Pose) -> Array:
    """Return the rotation (3, 3) from the head's frame to the camera's, R_y(pan) R_x(-tilt) R_z(roll)."""
    pan, tilt, roll = (math.radians(angle) for angle in pose)
    about_y = [[math.cos(pan), 0, math.sin(pan)], [0, 1, 0], [-math.sin(pan), 0, math.cos(pan)]]
    about_x = [[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]]
    about_z = [[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]]
    return np.array(about_y) @ np.array(about_x) @ np.array(about_z)


def photograph(
    random: Generator, person: Person, pose: Pose, side: int, conditions: Conditions
) -> NDArray[np.uint8]:
    """Return a photograph (side, side, 3) of a person's head in a pose, under random conditions."""
    pixels = int(random.integers(conditions.pixels[0], conditions.pixels[1] + 1))
    scale = 0.5 * pixels * random.uniform(*conditions.height)  # camera pixels per half height
    middle = 0.5 * pixels + pixels * random.uniform(-1, 1, 2) * conditions.offset
    light = np.array([random.normal(0, 0.7), random.uniform(0.1, 1.2), random.uniform(0.1, 1.0)])
    strength = random.uniform(0.2, 0.6)
    body = Pose(pose.pan + random.normal(0, 25))
    image = background(random, pixels, conditions.clutter)
    layer = render(person, pose, body, pixels, scale, (middle[0], middle[1]), light, strength)
    image = layer[..., :3] + (1 - layer[..., 3:]) * image
    if random.random() < conditions.occluded:
        image = _occlude(random, image, middle, scale)
    image = gaussian_filter(image, (*2 * (random.uniform(0, conditions.blur),), 0))
    image = (image - 0.5) * random.uniform(0.75, 1.15) + 0.5 + random.uniform(-0.1, 0.1)
    image = image + random.normal(0, random.uniform(0, conditions.noise), image.shape)
    photo = Image.fromarray((255 * image.clip(0, 1)).round().astype(np.uint8))
    return np.asarray(photo.resize((side, side), Image.Resampling.BICUBIC))


def render(
    person: Person,
    pose: Pose,
    body: Pose,
    pixels: int,
    scale: float,
    middle: tuple[float, float],
    light: Array,
    strength: float,
) -> Array:
    """Return an image (pixels, pixels, 4) of head, neck and shoulders without a background.

    The channels are the colour times the opacity (premultiplied alpha), and the opacity, 0…1.

    Args:
        person: The person.
        pose: Pose of the head.
        body: Pose of the shoulders.
        pixels: Side of the image, pixels.
        scale: Pixels per half height of a head.
        middle: Centre of the head (column, row), pixels from the corner of the image.
        light: Direction towards the lamp, of any length.
        strength: Share of the light that comes from the lamp, 0…1; the rest is ambient light.
    """
    head, torso = rotation(pose), rotation(body)
    parts = _ellipsoids(person, head, torso)
    centers = np.array([center for center, _, _, _ in parts])
    frames = np.array([frame for _, frame, _, _ in parts])
    # along an axis of the camera, the ellipsoid |F (p - c)| = 1 extends as far as the length of that row of F⁻¹
    extents = np.linalg.norm(np.linalg.inv(frames), axis=2)
    colors = np.array([color for _, _, color, _ in parts])
    kinds = np.array([kind for _, _, _, kind in parts])
    opening = np.array([0.0, -math.sin(person.face_tilt), math.cos(person.face_tilt), person.face_reach])
    look = np.array([person.glasses, person.beard, *person.hair])
    image = np.zeros((pixels, pixels, 4))
    lamp = light / np.linalg.norm(light)
    _cast(centers, frames, extents, colors, kinds, head, opening, look, lamp, strength, scale, *middle, image)
    return image


def _ellipsoids(person: Person, head: Array, torso: Array) -> list[tuple[Array, Array, Array, int]]:
    """Return the parts of head, neck and shoulders as ellipsoids.

    Each ellipsoid has a centre (3,), a matrix (3, 3) that maps it to the unit ball, a colour (3,) and a kind (`SKIN`,
    `HAIR` or `CLOTH`).

    Args:
        person: The person.
        head: Rotation (3, 3) from the head's frame to the camera's.
        torso: Rotation (3, 3) from the shoulders' frame to the camera's.
    """
    parts: list[tuple[Array, Array, Array, int]] = []

    def add(
        to_camera: Array, center: tuple[float, ...], axes: Array | tuple[float, ...], color: Array, kind: int
    ) -> None:
        parts.append((to_camera @ np.array(center), to_camera.T / np.array(axes)[:, None], color, kind))

    width, height, depth = person.axes
    upright = np.eye(3)
    add(torso, (0.0, -2.35, -0.1), (1.75, 0.95, 0.75), person.cloth, CLOTH)
    add(upright, (0.0, -1.2, -0.1), (0.40, 0.75, 0.42), person.skin * 0.9, CLOTH)
    add(head, (0.0, 0.0, 0.0), person.axes, person.skin, SKIN)
    add(head, (0.0, -0.55 * height, 0.28 * depth), (0.50, 0.47, 0.52), person.skin, SKIN)  # jaw
    add(head, (0.0, -0.12, 0.93 * depth), (0.11, 0.23, 0.21), person.skin * 1.03, SKIN)  # nose
    for sign in (-1.0, 1.0) if person.ears else ():
        size = person.ears
        add(
            head,
            (sign * 1.02 * width, -0.03, -0.08),
            (0.08, 0.22 * size, 0.14 * size),
            person.skin * 0.92,
            CLOTH,
        )
    if person.face_reach > -1:
        add(
            head,
            (0.0, 0.04, -0.03),
            1.07 * person.axes,
            person.hat_color if person.hat else person.hair,
            HAIR,
        )
    if person.hat:
        add(head, (0.0, 0.42 * height, 0.85 * depth), (0.58, 0.07, 0.55), person.hat_color * 0.8, CLOTH)
    if person.long_hair:
        add(head, (0.0, -0.4, -0.35), (0.88 * width / 0.76, 1.05, 0.62), person.hair, CLOTH)
    if person.bun:
        add(head, (0.0, 0.35, -1.05 * depth), (0.30, 0.30, 0.28), person.hair * 0.9, CLOTH)
    return parts


@compiled
@no_type_check
def _cast(
    centers, frames, extents, colors, kinds, head, opening, look, lamp, strength, scale, column0, row0, image
):
    """Fill `image` with the nearest surface along each ray, with Lambert shading.

    Args:
        centers: Centres of the ellipsoids, (parts, 3).
        frames: Matrices that map the ellipsoids to the unit ball, (parts, 3, 3).
        extents: Half widths of the ellipsoids along the axes of the camera, (parts, 3).
        colors: Colours of the ellipsoids, (parts, 3).
        kinds: Kinds of the ellipsoids, (parts,).
        head: Rotation from the head's frame to the camera's.
        opening: Direction of the opening in the hair (3 numbers), and the cosine of its angular radius.
        look: Darkness of the glasses and of the beard, and the colour of the hair, (5,).
        lamp: Unit vector towards the lamp.
        strength: Share of the light that comes from the lamp, 0…1.
        scale: Pixels per half height of a head.
        column0: Column of the head's centre, pixels.
        row0: Row of the head's centre, pixels.
        image: Filled with colour times opacity, and opacity, (pixels, pixels, 4).
    """
    size = image.shape[0]
    point = np.zeros(3)
    unit = np.zeros(3)
    color = np.zeros(3)
    best_unit = np.zeros(3)
    share = 1.0 / (SAMPLES * SAMPLES)
    for sample in range(size * SAMPLES * size * SAMPLES):
        fine_row, fine_column = sample // (size * SAMPLES), sample % (size * SAMPLES)
        row, column = fine_row // SAMPLES, fine_column // SAMPLES
        x = ((fine_column + 0.5) / SAMPLES - column0) / scale
        y = (row0 - (fine_row + 0.5) / SAMPLES) / scale
        nearest, chosen = -np.inf, -1
        for part in range(centers.shape[0]):
            right, up = x - centers[part, 0], y - centers[part, 1]
            if abs(right) > extents[part, 0] or abs(up) > extents[part, 1]:
                continue
            # |F (p - c)| = 1 with p = (x, y, z) is a quadratic equation in z - c_z; its larger root is nearer
            a = b = c = 0.0
            for axis in range(3):
                across = frames[part, axis, 0] * right + frames[part, axis, 1] * up
                along = frames[part, axis, 2]
                unit[axis] = across
                a += along * along
                b += along * across
                c += across * across
            root = b * b - a * (c - 1.0)
            if root <= 0.0:
                continue
            depth = (np.sqrt(root) - b) / a
            if centers[part, 2] + depth <= nearest:
                continue
            for axis in range(3):
                unit[axis] += frames[part, axis, 2] * depth
            if kinds[part] == HAIR:
                ahead = opening[0] * unit[0] + opening[1] * unit[1] + opening[2] * unit[2]
                if ahead > opening[3]:
                    continue
            nearest, chosen = centers[part, 2] + depth, part
            best_unit[:] = unit
        if chosen < 0:
            continue
        length = facing = 0.0
        for axis in range(3):
            normal = 0.0
            for inner in range(3):
                normal += frames[chosen, inner, axis] * best_unit[inner]
            length += normal * normal
            facing += normal * lamp[axis]
        shade = 1.0 - strength + 1.4 * strength * max(facing / np.sqrt(length), 0.0)
        color[:] = colors[chosen]
        if kinds[chosen] == SKIN:
            for axis in range(3):
                point[axis] = head[0, axis] * x + head[1, axis] * y + head[2, axis] * nearest
            _paint_face(point, look, color)
        for channel in range(3):
            image[row, column, channel] += share * min(color[channel] * shade, 1.0)
        image[row, column, 3] += share


@compiled
@no_type_check
def _paint_face(point, look, color):
    """Change the colour of a point of the skin in place if it belongs to a facial feature.

    The features are projected onto the head from the front. `point` is in the head's frame. `look` holds the darkness
    of the glasses and of the beard, and the colour of the hair. `color` is the colour of the point.
    """
    x, y = abs(point[0]), point[1]
    if point[2] < 0.15:
        return
    glasses, beard = look[0], look[1]
    if beard > 0 and y < -0.38 and not (x < 0.2 and abs(y - MOUTH_HEIGHT) < 0.06):
        for channel in range(3):
            color[channel] += beard * (look[2 + channel] - color[channel])
    eye = ((x - EYE) / 0.17) ** 2 + ((y - EYE_HEIGHT) / 0.085) ** 2
    if ((x - EYE) / 0.25) ** 2 + ((y - EYE_HEIGHT - 0.03) / 0.17) ** 2 < 1:
        for channel in range(3):
            color[channel] *= 0.72  # eye socket
    if eye < 1:
        pupil = ((x - EYE) / 0.085) ** 2 + ((y - EYE_HEIGHT) / 0.085) ** 2 < 1
        for channel in range(3):
            color[channel] = 0.07 if pupil else 0.75
    if abs(x - EYE) < 0.2 and abs(y - EYE_HEIGHT - 0.21) < 0.045:
        for channel in range(3):
            color[channel] = 0.75 * look[2 + channel]
    if (x / 0.24) ** 2 + ((y - MOUTH_HEIGHT) / 0.06) ** 2 < 1:
        color[0] *= 0.72
        color[1] *= 0.42
        color[2] *= 0.45
    if glasses > 0 and y > EYE_HEIGHT - 0.2 and y < EYE_HEIGHT + 0.17:
        rim = ((x - EYE) / 0.24) ** 2 + ((y - EYE_HEIGHT) / 0.19) ** 2
        if (rim < 1 and rim > 0.6) or (abs(y - EYE_HEIGHT) < 0.035 and rim > 1):
            for channel in range(3):
                color[channel] *= 1 - glasses
        elif rim < 1:
            for channel in range(3):
                color[channel] *= 1 - 0.3 * glasses


def _muted_color(random: Generator) -> Array:
    """Return a random colour (3,), 0…1, of any brightness and little saturation."""
    return np.clip(random.uniform(0.1, 0.9) + random.normal(0, 0.05, 3), 0, 1)


def background(random: Generator, pixels: int, clutter: int) -> Array:
    """Return an image (pixels, pixels, 3) of smooth noise between two colours, with up to `clutter` random shapes."""
    first = _muted_color(random)
    second = np.clip(first + random.normal(0, 0.2) + random.normal(0, 0.04, 3), 0, 1)
    cells = int(random.integers(2, 7))
    grid = Image.fromarray(random.random((cells, cells), dtype=np.float32))
    share = np.asarray(grid.resize((pixels, pixels), Image.Resampling.BICUBIC), dtype=np.float64)[..., None]
    image = first + share.clip(0, 1) * (second - first)
    for _ in range(int(random.integers(0, clutter + 1))):
        centre, size = random.uniform(0, pixels, 2), random.uniform(0.08, 0.45, 2) * pixels
        mask = _shape(random, pixels, centre, size)
        image = np.where(mask, _muted_color(random), image)
    return image


def _occlude(random: Generator, image: Array, middle: Array, scale: float) -> Array:
    """Return the image with a random shape over part of the head.

    The head is at `middle` (column, row); half its height is `scale` pixels.
    """
    pixels = len(image)
    angle, distance = random.uniform(0, 2 * math.pi), random.uniform(0.8, 1.3)
    centre = middle + distance * scale * np.array([0.8 * math.cos(angle), math.sin(angle)])
    mask = _shape(random, pixels, centre, random.uniform(0.6, 1.1, 2) * scale)
    return np.where(mask, _muted_color(random), image)


def _shape(random: Generator, pixels: int, centre: Array, size: Array) -> NDArray[np.bool_]:
    """Return the mask (pixels, pixels, 1) of an ellipse or a rectangle, rotated at random.

    Its centre is `centre` (column, row), and `size` holds its half lengths, in pixels.
    """
    rows, columns = np.mgrid[:pixels, :pixels] + 0.5
    angle = random.uniform(0, math.pi)
    right, down = columns - centre[0], rows - centre[1]
    along = (right * math.cos(angle) + down * math.sin(angle)) / size[0]
    across = (down * math.cos(angle) - right * math.sin(angle)) / size[1]
    inside = along**2 + across**2 if random.random() < 0.5 else np.maximum(abs(along), abs(across))
    return inside[..., None] < 1
