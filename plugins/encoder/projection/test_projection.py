"""Tests of projected points against a loop over points, exact fractions, and the framework's camera."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.geometry.camera import Camera
from framework.geometry.clouds import pad
from framework.geometry.rotation import viewpoint_rotation
from plugins.encoder.projection.encoder import CameraView, gather_images, project, visible_points_in_torch

LIMITS = (1.0, 5.0)


def build_encoder(shape=(40, 6), columns=(), **config):
    return build(
        "encoder",
        resolve("encoder", {"name": "projection", **config}),
        input_shape=shape,
        input_columns=columns,
    )


def project_every_way(clouds: Tensor, view: CameraView) -> list[Tensor]:
    """Return the images of the compiled single pass, of the compiled index with a gradient, and of torch operations."""
    return [
        project(clouds, view),
        project(clouds.clone().requires_grad_(), view).detach(),
        gather_images(clouds, visible_points_in_torch(clouds, view), view),
    ]


def by_hand(cloud: list[list[float]], view: CameraView, kind: type) -> np.ndarray:
    """Return the image by a loop over points, with the camera of each level: u' = (u + 1/2) / 2^level - 1/2."""
    nearest, farthest = view.limits
    image = np.ones((4 * view.levels, view.height, view.width), kind)
    for level in range(view.levels):
        best: dict[tuple[int, int], np.float32] = {}
        for x, y, z, red, green, blue in cloud:
            if not nearest <= z < farthest or not all(map(math.isfinite, (red, green, blue))):
                continue
            # u + 1/2 = f x/z + (width - 1) / 2 + 1/2
            across, down = view.height * x / z + view.width / 2, view.height * y / z + view.height / 2
            if not (0 <= across < view.width and 0 <= down < view.height):
                continue
            place = math.floor(down / 2**level), math.floor(across / 2**level)
            if place not in best or np.float32(z) < best[place]:
                best[place] = np.float32(z)
                rows, columns = (slice(2**level * start, 2**level * (start + 1)) for start in place)
                shown = (red, green, blue, (z - nearest) / (farthest - nearest))
                for channel, number in enumerate(shown, start=4 * level):
                    image[channel, rows, columns] = kind(number)
    return image


DEPTHS = [2.0] * 24 + [2.0 + 1e-12] * 12 + [1.0, 3.7, 4.999999, 5.0, 0.999999, 0.0, -2.0, 1e-45, 1e30, 3e38]
DEPTHS += [-3e38, math.nan, math.inf, -math.inf]
STRAY = [0.0] * 48 + [math.nan, math.inf, -math.inf, 1e30, -3e38, 1e-40, -1e-12]
PARTS, SCENES = 5, 8
"""Number of bytes that describe a point, and number of scenes in a batch; bytes are drawn faster than numbers."""


def cloud_of(bytes_of_points: bytes, height: int, width: int, kind: type) -> np.ndarray:
    """Return points decoded from bytes: behind the camera, too far, on edges of pixels, equally far or not finite."""
    cloud = np.ones((len(bytes_of_points) // PARTS, 6))
    for point in range(len(cloud)):
        across, down, depth, stray, no_color = bytes_of_points[PARTS * point : PARTS * (point + 1)]
        z = DEPTHS[depth % len(DEPTHS)]
        # in half pixels, from before the image's edge to beyond it: on pixel centres and between them
        cloud[point, 0] = (across % (2 * width + 2) - 1 - width) / 2 * z / height + STRAY[stray % len(STRAY)]
        cloud[point, 1] = (down % (2 * height + 2) - 1 - height) / 2 * z / height
        cloud[point, 2:] = z, (point + 1) / 13, point / 7, 0.25
        cloud[point, 3 + no_color % 3] += STRAY[no_color % len(STRAY)]
    with np.errstate(over="ignore"):
        return cloud.astype(kind)


@settings(max_examples=2000 // SCENES, deadline=None)
@given(
    st.lists(st.binary(max_size=20 * PARTS), min_size=SCENES, max_size=SCENES),
    st.integers(1, 5),
    st.integers(1, 5),
    st.integers(1, 3),
    st.sampled_from([np.float32, np.float64]),
)
def test_projections_are_those_of_a_loop_over_points(bytes_of_points, height, width, levels, kind):
    clouds = [cloud_of(points, height, width, kind) for points in bytes_of_points]
    view = CameraView(height, width, LIMITS, levels)
    wanted = np.stack([by_hand(cloud.tolist(), view, kind) for cloud in clouds])
    for images in project_every_way(pad([torch.from_numpy(cloud) for cloud in clouds]), view):
        np.testing.assert_array_equal(images.numpy(), wanted)


@pytest.mark.parametrize("size", [(33, 21), (8, 12), (1, 1)])
def test_float32_points_are_seen_where_exact_fractions_say(size):
    """Check points on edges of pixels, and the neighbouring float32 numbers on either side."""
    (height, width), count = size, 400
    generator = torch.Generator().manual_seed(0)
    depth = 1 + 4 * torch.rand(count, generator=generator)
    halves = torch.randint(-2, 2 * width + 3, (count,), generator=generator)
    across = ((halves.double() / 2 - width / 2) * depth.double() / height).float()
    aside = torch.randint(-1, 2, (count,), generator=generator)
    aside[across == 0] = 0  # half an image away, float64 cannot tell the neighbours of 0 from 0
    across = torch.where(aside == 0, across, across.nextafter(aside * math.inf))
    rest = torch.tensor([0.25, 0.5, 0.75]).expand(count, 3)
    clouds = torch.cat([torch.stack([across, torch.zeros(count), depth], 1), rest], 1)[:, None]
    wanted = torch.ones(count, height, width)
    for image, x, z in zip(wanted, across.tolist(), depth.tolist(), strict=True):
        column = math.floor(Fraction(x) * height / Fraction(z) + Fraction(width, 2))
        if 0 <= column < width:
            image[height // 2, column] = 0.25
    for images in project_every_way(clouds, CameraView(height, width, LIMITS)):
        assert torch.equal(images[:, 0], wanted)


@pytest.mark.parametrize("same", [False, True])
def test_of_thousands_in_one_pixel_the_nearest_is_seen_and_of_equally_near_ones_the_first(same):
    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(2, 20_000, 6, generator=generator)
    clouds[..., :2] *= 1e-3
    clouds[..., 2] = 2.0 if same else (1.5 + clouds[..., 2]).mul(100).round() / 100
    view = CameraView(5, 5, LIMITS, levels=2)
    for images in project_every_way(clouds, view):
        for image, cloud in zip(images, clouds, strict=True):
            first = int(cloud[:, 2].min(0).values.eq(cloud[:, 2]).nonzero()[0])
            assert torch.equal(image[:3, 2, 2], cloud[first, 3:])
            assert torch.equal(image[4:7, 2:4, 2:4], cloud[first, 3:, None, None].expand(3, 2, 2))
            assert (image[:4] < 1).any(0).sum() == 1


def test_a_camera_sees_points_where_the_encoder_shows_its_canonical_points():
    generator = torch.Generator().manual_seed(0)

    def some(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    compared = 0
    for _ in range(40):
        height, width = (int(side) for side in 5 + 60 * some(2))
        focal, principal = height * (0.5 + some(2)), torch.tensor([width, height]) * some(2)
        rotation = viewpoint_rotation(some(3) - 0.5)
        camera = Camera(rotation, torch.tensor([0.0, 0, 3]), focal, principal, height, width)
        world, color = 2 * some(30, 3) - 1, some(30, 3)
        pixels, depth = camera.project(world)
        clear = ((pixels - pixels.floor() - 0.5).abs() > 1e-6).all(
            1
        )  # away from edges, where rounding may decide
        world, color, pixels, depth = world[clear], color[clear], pixels[clear].round().long(), depth[clear]
        image = build_encoder((30, 6), height=height, width=width)(
            torch.cat([camera.to_canonical(world), color], 1)[None]
        )[0]
        wanted = torch.ones(4, height, width, dtype=torch.float64)
        for number in depth.argsort(descending=True).tolist():
            column, row = pixels[number].tolist()
            if 1 <= depth[number] < 5 and 0 <= column < width and 0 <= row < height:
                wanted[:, row, column] = torch.cat([color[number], (depth[number, None] - 1) / 4])
                compared += 1
        torch.testing.assert_close(image, wanted, rtol=1e-12, atol=0)
    assert compared > 300


@pytest.mark.parametrize("levels", [1, 3])
def test_the_gradient_is_that_of_colours_and_depths_of_what_is_seen(levels):
    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(2, 60, 7, generator=generator, dtype=torch.float64)
    clouds[..., :2] -= 0.5
    clouds[..., 2] = 0.5 + 5 * clouds[..., 2]
    clouds[1, 40:] = math.nan
    clouds.requires_grad_()
    view = CameraView(9, 7, LIMITS, levels)
    image = project(clouds, view)
    weights = torch.rand(image.shape, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * image).sum(), clouds)
    wanted = torch.zeros_like(clouds)
    for level in range(levels):
        index = visible_points_in_torch(clouds, CameraView(9, 7, LIMITS, levels))[level]
        for cloud, row, column in np.ndindex(2, 9, 7):
            point = index[cloud, row >> level, column >> level]
            if point >= 0:
                along = weights[cloud, 4 * level : 4 * level + 4, row, column]
                wanted[cloud, point, 3:6] += along[:3]
                wanted[cloud, point, 2] += along[3] / 4
    torch.testing.assert_close(gradient, wanted, rtol=1e-12, atol=0)
    assert not gradient[..., :2].any() and not gradient[1, 40:].any() and gradient[..., 2:6].any()


def test_clouds_of_a_batch_are_those_alone_on_any_number_of_threads():
    generator = torch.Generator().manual_seed(0)
    clouds = [torch.randn(count, 6, generator=generator) + 2 for count in (300, 1, 0, 77, 200, 9, 300)]
    batch, before = pad(clouds), torch.get_num_threads()
    for levels in (1, 2):
        view = CameraView(40, 31, (0.5, 4.0), levels)
        wanted = torch.cat([project(cloud[None], view) for cloud in clouds])
        assert (wanted < 1).any()
        try:
            for threads in (1, 2, 3):
                torch.set_num_threads(threads)
                assert all(torch.equal(images, wanted) for images in project_every_way(batch, view))
        finally:
            torch.set_num_threads(before)
        assert torch.equal(project(batch.mT.contiguous().mT, view), wanted)  # strides


def test_what_cannot_be_projected_is_refused_and_nothing_in_view_is_the_background():
    with pytest.raises(ConfigError, match=r"shape \(40, 5\), but it reads clouds.*x, y, z, red, green, blue"):
        build_encoder((40, 5))
    with pytest.raises(ConfigError, match="columns x, y, z, normal_x"):
        build_encoder((40, 6), ("x", "y", "z", "normal_x", "normal_y", "normal_z"))
    with pytest.raises(ConfigError, match="nearest=3 and farthest=3, but nearest must be smaller"):
        build_encoder(nearest=3.0, farthest=3.0)
    for config in ({"height": 0}, {"width": 0}, {"nearest": 0.0}, {"farthest": math.inf}, {"levels": 0}):
        with pytest.raises(ConfigError, match=r"encoder\."):
            build_encoder(**config)
    encoder = build_encoder(height=4, width=6)
    with pytest.raises(DataError, match=r"\(1, 2, 5\), but .*red, green, blue"):
        encoder(torch.zeros(1, 2, 5))
    with pytest.raises(DataError, match=r"Cloud 0 .*column 4 of point 1"):
        encoder(torch.tensor([[[0.0, 0, 2, 0, 0, 0], [0, 0, 2, 0, math.inf, 0]]]))
    behind = torch.tensor([[[0.0, 0, -2, 0, 0, 0], [0, 0, 0, 0, 0, 0], [9, 0, 2, 0, 0, 0]]])
    for images in (encoder(behind), *project_every_way(behind[:, :0], encoder.view)):
        assert torch.equal(images, torch.ones(1, 4, 4, 6))
    assert encoder.fixed and not encoder.state_dict() and encoder(behind[:0]).shape == (0, 4, 4, 6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_gpu_shows_the_same_bits(dtype):
    generator = torch.Generator().manual_seed(0)
    clouds = torch.randn(3, 100_000, 6, generator=generator, dtype=dtype) + 2
    clouds[1, 5000:] = math.nan
    view = CameraView(410, 308, LIMITS, 4)
    assert torch.equal(project(clouds.cuda(), view).cpu(), project(clouds, view))
