"""Tests of surfaces between points against loops over pixels; all implementations must agree to the bit."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.configuration.schema import build, resolve
from plugins.encoder.projection.splats import closing_radius, compute_surface, compute_surface_in_torch

LIMITS = (1.0, 5.0)


def by_hand(image, focal, radius):
    """Return the image of the surface, computed pixel by pixel from the definition."""
    image = image.astype(np.float64)
    height, width = image.shape[1:]
    shown = [(row, column) for row in range(height) for column in range(width) if image[3, row, column] < 1]
    depth = {place: 1 + 4 * image[3][place] for place in shown}

    def within(place, other, radius):
        return math.dist(place, other) ** 2 <= radius * (radius + 1) + 1e-9

    every = [(row, column) for row in range(height) for column in range(width)]
    grown = {place for place in every if any(within(place, pixel, closing_radius(radius)) for pixel in shown)}
    surface_image = np.ones((5, height, width))
    for place in every:
        about = [pixel for pixel in shown if within(place, pixel, radius)]
        if not about:
            continue
        cones = [
            (depth[pixel] * (1 + math.dist(place, pixel) / focal), math.dist(place, pixel)) for pixel in about
        ]
        first, distance = min(cones)
        surface_image[4][place] = distance / (radius + 1)
        if any(within(place, other, closing_radius(radius)) and other not in grown for other in every):
            continue
        sigma = 0.45 + 0.6 * distance
        surface = [pixel for pixel in about if depth[pixel] < first * (1 + 4 / focal)]
        mass = [math.exp(-(math.dist(place, pixel) ** 2) / (2 * sigma**2)) for pixel in surface]
        for channel in range(4):
            surface_image[channel][place] = (
                sum(weight * image[channel][pixel] for weight, pixel in zip(mass, surface, strict=True))
                / sum(mass)
                if place in grown
                else 1
            )
    return surface_image


def scene(numbers, height, width, kind=np.float64):
    """Return an image of points on a near and a far surface, from bytes; a third of the pixels shows a point."""
    image = np.ones((4, height, width), kind)
    for place, byte in enumerate(numbers[: height * width]):
        if byte % 3 == 0:
            row, column = divmod(place, width)
            depth = (0.25, 0.251, 0.5, 0.0)[byte // 3 % 4]
            image[:, row, column] = byte / 255, (byte % 16) / 16, 0.5, depth
    return image


@settings(max_examples=120, deadline=None)
@given(st.binary(min_size=0, max_size=120), st.integers(1, 9), st.integers(1, 9), st.integers(1, 4))
def test_surfaces_are_those_of_the_definition_whatever_the_way(numbers, height, width, radius):
    for kind, limit in ((np.float64, 1e-12), (np.float32, 1e-6)):
        image = scene(numbers, height, width, kind)
        images = torch.from_numpy(image)[None]
        compiled = compute_surface(images, LIMITS, 20.0, radius)
        assert torch.equal(compute_surface_in_torch(images, LIMITS, 20.0, radius), compiled)
        np.testing.assert_allclose(compiled[0].numpy(), by_hand(image, 20.0, radius), rtol=0, atol=limit)


def test_a_dense_surface_is_itself_and_nothing_stays_nothing():
    generator = torch.Generator().manual_seed(0)
    dense = torch.rand(2, 4, 12, 9, generator=generator, dtype=torch.float64)
    dense[:, 3] = 0.5
    surface = compute_surface(dense, LIMITS, 100.0, 5)
    assert (surface[:, 4] == 0).all()
    # with a standard deviation of 0.45 pixels, all others together weigh 0.37 of the pixel's own point
    torch.testing.assert_close(surface[:, :4], dense, rtol=0, atol=0.37 / 1.37)
    flat = torch.full((1, 4, 12, 9), 0.25)
    torch.testing.assert_close(compute_surface(flat, LIMITS, 100.0, 5)[:, :4], flat)
    assert (compute_surface(torch.ones(1, 4, 12, 9), LIMITS, 100.0, 5) == 1).all()
    assert compute_surface(torch.ones(0, 4, 12, 9), LIMITS, 100.0, 5).shape == (0, 5, 12, 9)


def test_what_a_nearer_surface_hides_does_not_shine_through():
    image = torch.ones(1, 4, 21, 21)
    image[:, :, ::2, ::2] = torch.tensor([1.0, 0.0, 0.0, 0.25])[:, None, None]
    image[:, :, 1::2, 1::2] = torch.tensor([0.0, 1.0, 0.0, 0.75])[:, None, None]  # seen through the holes
    surface = compute_surface(image, LIMITS, 200.0, 5)[0]
    assert (surface[1, 2:-2, 2:-2] == 0).all()
    torch.testing.assert_close(surface[0, 2:-2, 2:-2], torch.ones(17, 17))


def test_gradients_in_colours_and_depths():
    image = torch.from_numpy(scene(bytes(range(0, 240, 4)), 6, 7))[None]
    shown = image[:, 3] < 1
    image[:, 3][shown] += 1e-3 * torch.rand(int(shown.sum()), dtype=torch.float64)  # no two equally near

    def surface(numbers):
        return compute_surface(torch.where(shown[:, None], numbers, 1.0), LIMITS, 20.0, 3)[:, :4]

    assert torch.autograd.gradcheck(surface, image.requires_grad_())


@pytest.mark.parametrize("levels", [1, 2])
def test_the_encoder_puts_the_surface_before_the_points(levels):
    def build_encoder(**config):
        part = resolve(
            "encoder", {"name": "projection", "height": 24, "width": 18, "levels": levels, **config}
        )
        return build("encoder", part, input_shape=(40, 6), input_columns=())

    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(3, 40, 6, generator=generator) + torch.tensor([-0.5, -0.5, 2.0, 0, 0, 0])
    encoder, plain = build_encoder(splat=4), build_encoder()
    assert encoder.output_shape == (5 + 4 * levels, 24, 18)
    assert encoder.fixed
    features = encoder(clouds)
    assert torch.equal(features[:, 5:], plain(clouds))
    assert torch.equal(features[:, :5], compute_surface(plain(clouds)[:, :4], LIMITS, 24.0, 4))
    assert (features[:, :3] < 1).float().mean() > (features[:, 5:8] < 1).float().mean()
