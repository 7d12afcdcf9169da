"""Tests of synthetic heads: direction of the nose, mirror images, ray casting."""

import dataclasses

import numpy as np
import pytest

from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.synthetic_heads import (
    Conditions,
    Person,
    Pose,
    photograph,
    random_person,
    render,
    rotation,
)

SIDE = 60
FROM_CAMERA = np.array([0.0, 0.0, 1.0])
PLAIN = Conditions(
    pixels=(50, 50), height=(0.6, 0.6), offset=0.0, blur=0.0, noise=0.0, clutter=0, occluded=0.0
)


def render_centred(
    person: Person, pose: Pose, light: np.ndarray = FROM_CAMERA, strength: float = 0.4
) -> np.ndarray:
    """Return a sharp image of a person in the middle of the image, whose shoulders face the camera."""
    return render(person, pose, Pose(0.0), SIDE, 20.0, (SIDE / 2, SIDE / 2), light, strength)


def bald(seed: int) -> Person:
    person = random_person(np.random.default_rng(seed))
    return dataclasses.replace(person, face_reach=-1.0, hat=False, bun=False, long_hair=False, ears=1.0)


def short_haired(seed: int) -> Person:
    person = random_person(np.random.default_rng(seed))
    person = dataclasses.replace(person, hat=False, bun=False, long_hair=False)
    return dataclasses.replace(person, face_tilt=0.8, face_reach=0.3, beard=0.0, glasses=0.0, ears=1.0)


def center_of_skin(person: Person, pose: Pose) -> tuple[float, float]:
    """Return the mean column and row of the skin in the upper part of the image, counted from the image's middle."""
    person = dataclasses.replace(person, skin=np.ones(3), hair=np.zeros(3), cloth=np.zeros(3))
    image = render_centred(person, pose, strength=0.0)[: SIDE // 2 + 12, :, 0]
    rows, columns = np.nonzero(image > 0.5)
    return columns.mean() - (SIDE - 1) / 2, rows.mean() - (SIDE - 1) / 2


# ---- the convention of angles ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pose", "nose"),
    [
        (Pose(0), (0, 0, 1)),
        (Pose(90), (1, 0, 0)),
        (Pose(-90), (-1, 0, 0)),
        (Pose(180), (0, 0, -1)),
        (Pose(0, 90), (0, 1, 0)),
        (Pose(90, 90), (0, 1, 0)),
        (Pose(30, 0, 70), (0.5, 0, 0.75**0.5)),
    ],
)
def test_where_the_nose_points(pose: Pose, nose: tuple[float | int, ...]) -> None:
    matrix = rotation(pose)
    np.testing.assert_allclose(matrix @ (0, 0, 1), nose, atol=1e-12)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)


def test_positive_roll_leans_the_crown_to_the_left_of_the_image() -> None:
    crown = rotation(Pose(0, 0, 20)) @ (0, 1, 0)
    assert crown[0] == pytest.approx(-np.sin(np.deg2rad(20)))
    left, right = render_centred(bald(0), Pose(0, 0, 25)), render_centred(bald(0), Pose(0, 0, -25))
    for image, sign in ((left, -1), (right, 1)):
        rows, columns = np.nonzero(image[: SIDE // 2 - 14, :, 3] > 0.5)  # the top of the head
        assert len(rows) > 20
        assert sign * (columns.mean() - (SIDE - 1) / 2) > 2


def test_the_face_moves_with_pan_and_tilt() -> None:
    for seed in range(4):
        person = short_haired(seed)
        columns = [center_of_skin(person, Pose(pan))[0] for pan in (-80, -50, -25, 0, 25, 50, 80)]
        assert columns == sorted(columns)
        assert abs(columns[3]) < 0.3
        assert columns[0] < -3
        assert columns[-1] > 3
        rows = [center_of_skin(person, Pose(0, tilt))[1] for tilt in (30, 0, -30)]
        assert rows == sorted(rows)  # looking up lifts the face; rows run downwards
        assert rows[2] - rows[0] > 3


@pytest.mark.parametrize("pose", [Pose(0), Pose(35, 10, 12), Pose(-120, -20, 5), Pose(170, 0, -8)])
def test_mirror_image_is_the_image_at_the_mirrored_angles(pose: Pose) -> None:
    """Check the rule by which augmentation changes the angles of mirrored images."""
    light = np.array([0.4, 0.6, 0.5])
    mirrored = Pose(-pose.pan, pose.tilt, -pose.roll)
    for seed in range(6):
        person = random_person(np.random.default_rng(seed))
        image = render_centred(person, pose, light)
        at_mirrored_angles = render_centred(person, mirrored, light * (-1, 1, 1))
        np.testing.assert_allclose(image[:, ::-1], at_mirrored_angles, atol=1e-9)
        if pose.pan:
            assert abs(image[:, ::-1] - image).mean() > 0.002


def test_the_back_of_a_head_changes_less_with_pan_than_the_face() -> None:
    """Check a rotation by 60°; because of this, the pan of a head seen from behind is more uncertain."""
    for seed in range(6):
        person = short_haired(seed)
        front = abs(render_centred(person, Pose(-30)) - render_centred(person, Pose(30)))[..., :3].mean()
        back = abs(render_centred(person, Pose(150)) - render_centred(person, Pose(-150)))[..., :3].mean()
        assert back < 0.65 * front


# ---- rendering -------------------------------------------------------------------------------------------


def test_silhouette_is_the_union_of_the_projected_ellipsoids() -> None:
    """Check that an ellipsoid c + M u, |u| = 1, projects to the ellipse (x - c)ᵀ B⁻¹ (x - c) = 1.

    B is the upper left 2 × 2 block of M Mᵀ.
    """
    pose, body = Pose(25, -15, 10), Pose(-40)
    person, scale, middle = bald(1), 17.0, (31.3, 26.9)
    image = render(person, pose, body, SIDE, scale, middle, FROM_CAMERA, 0.3)
    samples = SIDE * synthetic_heads.SAMPLES
    positions = (np.arange(samples) + 0.5) / synthetic_heads.SAMPLES
    x, y = (positions[None, :] - middle[0]) / scale, (middle[1] - positions[:, None]) / scale
    covered = np.zeros((samples, samples), bool)
    for center, frame, _, _ in synthetic_heads._ellipsoids(person, rotation(pose), rotation(body)):
        shape = np.linalg.inv(frame)
        inverse = np.linalg.inv((shape @ shape.T)[:2, :2])
        right, up = x - center[0], y - center[1]
        covered |= inverse[0, 0] * right**2 + 2 * inverse[0, 1] * right * up + inverse[1, 1] * up**2 < 1
    step = synthetic_heads.SAMPLES
    expected = covered.reshape(SIDE, step, SIDE, step).mean((1, 3))
    np.testing.assert_allclose(image[..., 3], expected, atol=1e-9)
    assert 0.2 < expected.mean() < 0.6


def test_ball_has_lambert_shading() -> None:
    """Check a bald head that is a unit ball of one colour, whose normal at a point is the point itself."""
    person = dataclasses.replace(bald(2), axes=np.ones(3), skin=np.full(3, 0.5), beard=0.0, glasses=0.0)
    light = np.array([1.0, 2.0, 2.0]) / 3
    image = render(person, Pose(180), Pose(0), SIDE, 20.0, (SIDE / 2, SIDE / 2), light, 0.4)
    row, column = 20, 36  # right of the middle and above it; the back of the head shows neither nose nor eye
    offsets = (np.array([0.25, 0.75]) - 0.5) if synthetic_heads.SAMPLES == 2 else np.zeros(1)
    shades = []
    for down in offsets:
        for right in offsets:
            x, y = (column + 0.5 + right - SIDE / 2) / 20, (SIDE / 2 - row - 0.5 - down) / 20
            normal = np.array([x, y, np.sqrt(1 - x * x - y * y)])
            shades.append(0.5 * (0.6 + 1.4 * 0.4 * max(normal @ light, 0)))
    np.testing.assert_allclose(image[row, column, :3], np.mean(shades), atol=1e-9)


def test_the_seed_determines_a_person() -> None:
    first, again, other = (random_person(np.random.default_rng(seed)) for seed in (3, 3, 4))
    for field in dataclasses.fields(Person):
        assert np.array_equal(getattr(first, field.name), getattr(again, field.name))
    assert not np.array_equal(first.skin, other.skin)
    crowd = [random_person(np.random.default_rng(seed)) for seed in range(400)]
    for flag in ("long_hair", "bun", "hat", "glasses", "beard", "ears"):
        assert 0.05 < np.mean([bool(getattr(person, flag)) for person in crowd]) < 0.95, flag
    assert 0.02 < np.mean([person.face_reach == -1 for person in crowd]) < 0.2
    for person in crowd:
        for color in (person.skin, person.hair, person.cloth, person.hat_color):
            assert color.shape == (3,)
            assert np.all((color >= 0) & (color <= 1))


def test_the_random_stream_determines_the_photograph() -> None:
    person = random_person(np.random.default_rng(0))
    poor = PLAIN._replace(pixels=(12, 30), blur=1.0, noise=0.05, clutter=6, occluded=0.5)
    photos = [photograph(np.random.default_rng(seed), person, Pose(20), 50, poor) for seed in (5, 5, 6)]
    assert photos[0].shape == (50, 50, 3)
    assert photos[0].dtype == np.uint8
    assert np.array_equal(photos[0], photos[1])
    assert not np.array_equal(photos[0], photos[2])


def test_conditions_make_photographs_worse() -> None:
    """Check that few pixels and blur reduce detail, and that noise adds to it, compared with a clear photograph."""

    def detail(conditions: Conditions) -> float:
        changes = []
        for seed in range(30):
            person = random_person(np.random.default_rng(seed))
            photo = photograph(np.random.default_rng(seed), person, Pose(0), 50, conditions).astype(float)
            changes.append(abs(np.diff(photo, axis=1))[:, 10:40].mean())
        return float(np.mean(changes))

    clear = detail(PLAIN)
    assert detail(PLAIN._replace(pixels=(10, 10))) < 0.8 * clear
    assert detail(PLAIN._replace(blur=3.0)) < 0.8 * clear
    assert detail(PLAIN._replace(noise=0.2)) > 1.2 * clear


def test_a_shape_hides_part_of_an_occluded_head() -> None:
    changed = []
    for seed in range(120):
        person = random_person(np.random.default_rng(seed))
        clear, hidden = (
            photograph(np.random.default_rng(seed), person, Pose(0), 50, PLAIN._replace(occluded=share))
            for share in (0.0, 1.0)
        )
        changed.append((abs(clear.astype(int) - hidden)[5:45, 10:40].max(2) > 60).mean())
    assert np.mean(np.array(changed) > 0.03) > 0.5
    assert np.median(changed) < 0.6  # the shape does not hide the personle head
