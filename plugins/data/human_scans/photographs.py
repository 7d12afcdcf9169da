"""Photographs of a scan: a rig of cameras around the person, anti-aliased images with masks, and a texture."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.random import Generator
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d

from framework.datasets.scan_layout import Photograph
from framework.geometry.camera import Camera
from framework.geometry.srgb import bytes_from_linear
from framework.renderer import Renderer, Scene

SAMPLES = 4
"""Number of samples of a pixel along each axis."""
AROUND, HEIGHTS = 20, (-8.0, 6.0, 22.0)
"""Camera positions of the rig: AROUND positions around the person at each of the elevations HEIGHTS, degrees."""
TOGETHER = 4
"""Number of photographs that are drawn at once; each takes some 30 MB before pooling."""
FOCAL = 1.25
"""Focal length in heights of the image."""
MARGIN = 0.03
"""Smallest share of the image's height and width that stays free on each side."""


def place_cameras(
    vertices: Float[np.ndarray, "vertices 3"], count: int, size: tuple[int, int], random: Generator
) -> list[Camera]:
    """Return `count` cameras at positions of the rig, in random order, each of which sees the whole person.

    `vertices` are those of the person, metres, and `size` is the (height, width) of the images, pixels. Every position
    is used once before a position is used again. Each camera looks at the middle of the person from the smallest
    distance at which it sees the whole person, or a little farther away. It is rolled by a degree or two, and its
    principal point is a little off the middle of the image.
    """
    places = AROUND * len(HEIGHTS)
    order = np.concatenate([random.permutation(places) for _ in range(-(-count // places))])[:count]
    middle = (vertices.min(0) + vertices.max(0)) / 2
    return [_camera(vertices - middle, middle, divmod(int(place), AROUND), size, random) for place in order]


def _camera(
    around: np.ndarray, middle: np.ndarray, place: tuple[int, int], size: tuple[int, int], random: Generator
) -> Camera:
    height, width = size
    azimuth = 2 * math.pi * (place[1] + random.uniform(-0.2, 0.2)) / AROUND
    elevation = math.radians(HEIGHTS[place[0]] + random.uniform(-3, 3))
    roll = math.radians(random.normal(0, 1))
    back = np.array(
        [
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
            math.cos(elevation) * math.cos(azimuth),
        ]
    )
    right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
    rows = np.stack([right, np.cross(right, back), -back])  # x right, y down, z forward
    turn = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    rotation = turn @ rows
    focal = FOCAL * height
    off = random.uniform(-0.02, 0.02, 2) * height
    x, y, z = (around @ rotation.T).T
    # in view if focal |x| / (z + distance) is within half the width less the margin and the principal point's shift
    free = np.array([width / 2 - np.abs(off[0]), height / 2 - np.abs(off[1])]) - MARGIN * height
    nearest = max((focal * np.abs(x) / free[0] - z).max(), (focal * np.abs(y) / free[1] - z).max())
    distance = nearest * random.uniform(1.0, 1.06)
    return Camera(
        torch.from_numpy(rotation).float(),
        torch.from_numpy(np.array([0, 0, distance]) - rotation @ middle).float(),
        (focal, focal),
        ((width - 1) / 2 + off[0], (height - 1) / 2 + off[1]),
        height,
        width,
    )


def take_photographs(renderer: Renderer, scene: Scene, cameras: Sequence[Camera]) -> list[Photograph]:
    """Return a photograph of the scene, whose colours are red, green and blue, from each camera.

    Each pixel has SAMPLES² samples. Its colour is the mean, in linear RGB, of the samples that lie on the subject.
    """
    larger = [
        Scene(scene.vertices, scene.faces, _with_cover(scene.colors), _finer(camera)) for camera in cameras
    ]
    photographs = []
    for first in range(0, len(larger), TOGETHER):
        photographs += [
            _average_samples(channels["color"])
            for channels in renderer.batch(larger[first : first + TOGETHER])
        ]
    return photographs


def _with_cover(colors: Tensor | None) -> Float[Tensor, "vertices 4"]:
    """Return the colours with a fourth channel of ones, whose render is the share of each pixel that is covered."""
    assert colors is not None
    return torch.cat([colors, torch.ones_like(colors[:, :1])], 1)


def _finer(camera: Camera) -> Camera:
    """Return the camera of the same image with S = SAMPLES times as many rows and columns.

    The centre of pixel p lies at S p + (S - 1) / 2 in the larger image.
    """
    (fx, fy), (cx, cy) = (tuple(map(float, pair)) for pair in (camera.focal, camera.principal))
    shift = (SAMPLES - 1) / 2
    return Camera(
        camera.rotation,
        camera.translation,
        (SAMPLES * fx, SAMPLES * fy),
        (SAMPLES * cx + shift, SAMPLES * cy + shift),
        SAMPLES * camera.height,
        SAMPLES * camera.width,
    )


def _average_samples(rendered: Float[Tensor, "height width 4"]) -> Photograph:
    pooled = avg_pool2d(rendered.movedim(-1, 0)[None], SAMPLES)[0].movedim(0, -1)
    cover = pooled[..., 3]
    light = torch.where(
        cover[..., None] > 0, pooled[..., :3] / cover.clamp(min=1e-6)[..., None], 0.5
    )  # grey background
    return Photograph(bytes_from_linear(light).numpy(), (cover * 255).round().byte().numpy())


def texture(
    renderer: Renderer,
    uv: Float[np.ndarray, "places 2"],
    uv_faces: np.ndarray,
    colors: Float[Tensor, "places 3"],
    side: int,
) -> UInt8[np.ndarray, "side side 3"]:
    """Return a square 8-bit sRGB texture, drawn from colours at texture coordinates.

    A texel that no triangle covers has the colour of the nearest covered texel.

    Args:
        renderer: renderer that draws the triangles.
        uv: texture coordinates, v upwards.
        uv_faces: triangles between the texture coordinates.
        colors: linear RGB at each texture coordinate.
        side: side of the texture, texels.
    """
    place = np.stack([uv[:, 0] * side - 0.5, (1 - uv[:, 1]) * side - 0.5, np.ones(len(uv))], 1)
    camera = Camera(torch.eye(3), torch.zeros(3), (1.0, 1.0), (0.0, 0.0), side, side)
    scene = Scene(torch.from_numpy(place).float(), torch.from_numpy(uv_faces), _with_cover(colors), camera)
    rendered = renderer(scene)["color"]
    outside = (rendered[..., 3] == 0).numpy()
    row, column = np.asarray(distance_transform_edt(outside, return_distances=False, return_indices=True))
    return bytes_from_linear(rendered[..., :3] / rendered[..., 3:].clamp(min=1e-6)).numpy()[row, column]
