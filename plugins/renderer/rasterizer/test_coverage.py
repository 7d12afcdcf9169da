"""Test that every pixel of a tessellated plane is covered once; the kernel itself counts face by face."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple, no_type_check

import numpy as np
import pytest
import torch
from numba import njit
from scipy.spatial import Delaunay

from framework.geometry.camera import Camera, look_from
from plugins.renderer.rasterizer import raster
from plugins.renderer.rasterizer.clipping import clip

MARGIN = 2 / 256  # pixels; a corner is rounded by up to 1/512 along either axis
FAR = 4.0  # metres, half a side of the plane


@njit(
    error_model="numpy"
)  # not cached on disk, because the cache would not notice a change of a called kernel
@no_type_check
def count_faces(screen, faces, height, width, alone, number):
    """Add the number of faces that cover each pixel to `number`, (height, width).

    Each face is drawn alone into `alone`, which is all false before and after.
    """
    counts = np.zeros(6, np.int64)
    for index in range(faces.shape[0]):
        face = faces[index : index + 1]
        box = raster.rasterise(
            screen, face, 0, None, False, height, width, None, None, alone, None, None, None, counts
        )
        for row in range(box[0], box[1]):
            for column in range(box[2], box[3]):
                number[row, column] += alone[row, column]
                alone[row, column] = False


def count_coverage(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return how many faces, drawn one by one, cover each pixel, and which pixels all faces together cover.

    The kernels are those that `Rasterizer` calls. Each part of a face that the near plane cuts counts as a face.
    """
    rotation, translation = camera.rotation.double().numpy(), camera.translation.double().numpy()
    lens = np.array(camera.focal), np.array(camera.principal)
    size = camera.height, camera.width
    camera_points, screen = np.empty((len(vertices), 3)), np.empty((len(vertices), 5))
    number, alone, mask = np.zeros(size, np.int64), np.zeros(size, np.bool_), np.zeros(size, np.bool_)
    counts = np.zeros(6, np.int64)
    raster.project(vertices, rotation, translation, *lens, camera.near, camera_points, screen)
    corners, parts, numbers = clip(camera_points, faces, *lens, camera.near)
    for places, indices, names in ((screen, faces, None), (corners, parts, numbers)):
        raster.rasterise(places, indices, 0, names, False, *size, None, None, mask, None, None, None, counts)
        count_faces(places, indices, *size, alone, number)
    return number, mask


def intersect_plane(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each pixel's ray hits the plane, and how far the pixel is from the plane's border, pixels.

    The plane is the square |x|, |y| <= FAR of z = 0 beyond the near plane. The computation uses rays in world
    coordinates.
    """
    back_to_world = np.linalg.inv(camera.rotation.double().numpy())
    eye = -back_to_world @ camera.translation.double().numpy()
    rows, columns = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
    right, down = (
        (columns - camera.principal[0]) / camera.focal[0],
        (rows - camera.principal[1]) / camera.focal[1],
    )
    ray = np.stack([right, down, np.ones(rows.shape)], -1) @ back_to_world.T
    steps = back_to_world[:, :2] / camera.focal  # change of the ray per pixel to the right, and downwards
    # The depth of the plane along the ray is d = -eye_z / ray_z, at the point eye + d ray. Each limit, multiplied by
    # |eye_z| / d, is linear in the pixel position; divided by its slope, it is a distance in pixels.
    away = abs(eye[2])
    inverse, inverse_step = -np.sign(eye[2]) * ray[..., 2], -np.sign(eye[2]) * steps[2]
    limits = [(inverse, inverse_step), (away - camera.near * inverse, -camera.near * inverse_step)]
    for axis in range(2):
        for sign in (1, -1):
            off = FAR + sign * eye[axis]
            limits.append(
                (off * inverse + sign * away * ray[..., axis], off * inverse_step + sign * away * steps[axis])
            )
    inside = np.all([value >= 0 for value, _ in limits], 0)
    distance = np.min([np.abs(value) / max(np.hypot(*slope), 1e-300) for value, slope in limits], 0)
    return inside, distance


def random_plane(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a Delaunay triangulation of the square with random points.

    All vertices have z = 0, and the corners of a face have any order.
    """
    inner, along = random.uniform(-FAR, FAR, (40, 2)), random.uniform(-FAR, FAR, (4, 5))
    ends = np.full((4, 5), FAR) * np.array([[1], [-1], [1], [-1]])
    sides = np.concatenate([np.stack([ends[:2], along[:2]], -1), np.stack([along[2:], ends[2:]], -1)])
    corners = FAR * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    points = np.concatenate([inner, sides.reshape(-1, 2), corners])
    return np.pad(points, ((0, 0), (0, 1))), Delaunay(points).simplices


def regular_plane() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of 8 × 8 squares, which are divided along alternating diagonals."""
    row, column = np.meshgrid(np.arange(8), np.arange(8), indexing="ij")
    a, b, c, d = (9 * (row + down) + column + right for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)))
    odd = (row + column) % 2 == 1
    first_half = np.where(odd[..., None], np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    other = np.where(odd[..., None], np.stack([b, d, c], -1), np.stack([a, d, c], -1))
    points = np.stack(np.meshgrid(*[np.linspace(-FAR, FAR, 9)] * 2, indexing="xy"), -1).reshape(-1, 2)
    return np.pad(points, ((0, 0), (0, 1))), np.concatenate([first_half.reshape(-1, 3), other.reshape(-1, 3)])


def random_camera(random: np.random.Generator) -> Camera:
    """Return a camera above or below the plane, near or far, with any lens and principal point."""
    height, width = (int(side) for side in random.integers(1, 65, 2))
    distance = float(10.0 ** random.uniform(math.log10(0.05), 4))
    pose = random.uniform([-7, -1.57, -7], [7, 1.57, 7])
    if random.random() < 0.2:  # look along the plane
        pose[1] = random.choice([-1, 1]) * 10.0 ** random.uniform(-6, -1)
    camera = look_from(*pose.tolist(), distance, 1.0, (height, width))
    focal = 10.0 ** random.uniform(-3, 6)
    if random.random() < 0.7:  # choose the plane about as large as the image
        focal = 10.0 ** random.uniform(-1, 1.5) * height * distance / FAR
    focal = np.clip(focal * random.uniform(0.7, 1.4, 2), 1e-3, 1e6).tolist()
    principal = [width, height] * random.normal(0.5, random.choice([0, 0.5, 5]), 2)
    shift = torch.tensor([*random.normal(0, random.choice([0, 0.5, 3]), 2), 0.0])
    return replace(
        camera,
        translation=(camera.translation + shift).float(),
        focal=(focal[0], focal[1]),
        principal=(float(principal[0]), float(principal[1])),
        near=float(random.choice([1e-3, 1e-6, distance])),
    )


def aligned_camera(random: np.random.Generator) -> Camera:
    """Return a camera with exact numbers for which edges of the regular plane run through pixel centres."""
    height, width = (int(side) for side in random.integers(1, 65, 2))
    depth, pixels = 2.0 ** random.integers(-4, 14), 2.0 ** random.integers(0, 6)  # metres; pixels per metre
    turn = np.linalg.matrix_power([[0, -1, 0], [1, 0, 0], [0, 0, 1]], int(random.integers(4))) @ np.diag(
        [1, -1, -1]
    )
    shift = [*(random.integers(-8, 9, 2) / 4), depth]
    principal = [float(place) for place in random.integers(0, [width, height])]
    focal = float(depth * pixels)
    return Camera(
        torch.tensor(turn).double(),
        torch.tensor(shift, dtype=torch.float64),
        (focal, focal),
        (principal[0], principal[1]),
        height,
        width,
    )


class PixelCounts(NamedTuple):
    """Pixel counts of one view.

    Attributes:
        inside: number of pixels that must show the plane.
        holes: number of these pixels that no face covers.
        doubled: number of these pixels that more than one face covers.
        strays: number of covered pixels outside of the plane.
        other: number of pixels whose coverage differs between drawing all faces at once and one by one.
    """

    inside: int
    holes: int
    doubled: int
    strays: int
    other: int


def count_pixels(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> PixelCounts:
    number, mask = count_coverage(vertices, faces, camera)
    inside, distance = intersect_plane(camera)
    clear = distance > MARGIN
    must, never = inside & clear, ~inside & clear
    wrong = must, must & (number == 0), must & (number > 1), never & (number > 0), mask != (number > 0)
    return PixelCounts(*(int(pixels.sum()) for pixels in wrong))


def views(number: int, seed: int = 0) -> Iterator[tuple[str, PixelCounts]]:
    """Yield the pixel counts of `number` cameras, a third of them aligned, with the name of the plane in view."""
    random = np.random.default_rng(seed)
    planes = {"regular": regular_plane()} | {f"loose {index}": random_plane(random) for index in range(5)}
    names = list(planes)
    for index in range(number):
        name = names[0] if index % 2 else names[1 + index // 2 % 5]
        camera = aligned_camera(random) if index % 6 < 2 else random_camera(random)
        yield name, count_pixels(*planes[name], camera)


def sum_counts(counts: Iterable[tuple[str, PixelCounts]]) -> PixelCounts:
    return PixelCounts(*np.sum([camera_points for _, camera_points in counts], 0).tolist())


@pytest.mark.slow
def test_every_pixel_of_a_tessellated_plane_is_covered_once_whatever_the_camera() -> None:
    """Check 2,000 cameras; benchmarks/rendering/rasterizer_coverage.py has 10,000."""
    camera_points = sum_counts(views(2000))
    assert camera_points.inside > 600_000
    assert (camera_points.holes, camera_points.doubled, camera_points.strays, camera_points.other) == (
        0,
        0,
        0,
        0,
    )
