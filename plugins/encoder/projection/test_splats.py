"""Tests of surfaces between points against loops over pixels, and of all ways against each other, to the bit."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.configuration.schema import build, resolve
from plugins.encoder.projection.splats import closing, in_torch, splatted

LIMITS = (1.0, 5.0)


def by_hand(picture, focal, radius):
    """Return every pixel from the definition."""
    picture = picture.astype(np.float64)
    height, width = picture.shape[1:]
    seen = [(row, column) for row in range(height) for column in range(width) if picture[3, row, column] < 1]
    depth = {place: 1 + 4 * picture[3][place] for place in seen}

    def within(place, other, radius):
        return math.dist(place, other) ** 2 <= radius * (radius + 1) + 1e-9

    every = [(row, column) for row in range(height) for column in range(width)]
    grown = {place for place in every if any(within(place, one, closing(radius)) for one in seen)}
    found = np.ones((5, height, width))
    for place in every:
        about = [one for one in seen if within(place, one, radius)]
        if not about:
            continue
        cones = [(depth[one] * (1 + math.dist(place, one) / focal), math.dist(place, one)) for one in about]
        first, distance = min(cones)
        found[4][place] = distance / (radius + 1)
        if any(within(place, other, closing(radius)) and other not in grown for other in every):
            continue
        sigma = 0.45 + 0.6 * distance
        surface = [one for one in about if depth[one] < first * (1 + 4 / focal)]
        mass = [math.exp(-(math.dist(place, one) ** 2) / (2 * sigma**2)) for one in surface]
        for channel in range(4):
            found[channel][place] = (
                sum(weight * picture[channel][one] for weight, one in zip(mass, surface, strict=True))
                / sum(mass)
                if place in grown
                else 1
            )
    return found


def scene(said, height, width, kind=np.float64):
    """Return points on a near and a far surface, from bytes; a third of the pixels shows one."""
    picture = np.ones((4, height, width), kind)
    for place, byte in enumerate(said[: height * width]):
        if byte % 3 == 0:
            row, column = divmod(place, width)
            depth = (0.25, 0.251, 0.5, 0.0)[byte // 3 % 4]
            picture[:, row, column] = byte / 255, (byte % 16) / 16, 0.5, depth
    return picture


@settings(max_examples=120, deadline=None)
@given(st.binary(min_size=0, max_size=120), st.integers(1, 9), st.integers(1, 9), st.integers(1, 4))
def test_surfaces_are_those_of_the_definition_whatever_the_way(said, height, width, radius):
    for kind, limit in ((np.float64, 1e-12), (np.float32, 1e-6)):
        picture = scene(said, height, width, kind)
        given = torch.from_numpy(picture)[None]
        compiled = splatted(given, LIMITS, 20.0, radius)
        assert torch.equal(in_torch(given, LIMITS, 20.0, radius), compiled)
        np.testing.assert_allclose(compiled[0].numpy(), by_hand(picture, 20.0, radius), rtol=0, atol=limit)


def test_a_dense_surface_is_itself_and_nothing_stays_nothing():
    generator = torch.Generator().manual_seed(0)
    dense = torch.rand(2, 4, 12, 9, generator=generator, dtype=torch.float64)
    dense[:, 3] = 0.5
    found = splatted(dense, LIMITS, 100.0, 5)
    assert (found[:, 4] == 0).all()
    # with a standard deviation of 0.45 pixels, all others together weigh 0.37 of the pixel's own point
    torch.testing.assert_close(found[:, :4], dense, rtol=0, atol=0.37 / 1.37)
    flat = torch.full((1, 4, 12, 9), 0.25)
    torch.testing.assert_close(splatted(flat, LIMITS, 100.0, 5)[:, :4], flat)
    assert (splatted(torch.ones(1, 4, 12, 9), LIMITS, 100.0, 5) == 1).all()
    assert splatted(torch.ones(0, 4, 12, 9), LIMITS, 100.0, 5).shape == (0, 5, 12, 9)


def test_what_a_nearer_surface_hides_does_not_shine_through():
    picture = torch.ones(1, 4, 21, 21)
    picture[:, :, ::2, ::2] = torch.tensor([1.0, 0.0, 0.0, 0.25])[:, None, None]
    picture[:, :, 1::2, 1::2] = torch.tensor([0.0, 1.0, 0.0, 0.75])[:, None, None]  # seen through the holes
    found = splatted(picture, LIMITS, 200.0, 5)[0]
    assert (found[1, 2:-2, 2:-2] == 0).all()
    torch.testing.assert_close(found[0, 2:-2, 2:-2], torch.ones(17, 17))


def test_gradients_in_colours_and_depths():
    picture = torch.from_numpy(scene(bytes(range(0, 240, 4)), 6, 7))[None]
    seen = picture[:, 3] < 1
    picture[:, 3][seen] += 1e-3 * torch.rand(int(seen.sum()), dtype=torch.float64)  # no two equally near

    def surface(numbers):
        return splatted(torch.where(seen[:, None], numbers, 1.0), LIMITS, 20.0, 3)[:, :4]

    assert torch.autograd.gradcheck(surface, picture.requires_grad_())


@pytest.mark.parametrize("levels", [1, 2])
def test_the_encoder_puts_the_surface_before_the_points(levels):
    def encoder(**config):
        part = resolve(
            "encoder", {"name": "projection", "height": 24, "width": 18, "levels": levels, **config}
        )
        return build("encoder", part, input_shape=(40, 6), input_columns=())

    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(3, 40, 6, generator=generator) + torch.tensor([-0.5, -0.5, 2.0, 0, 0, 0])
    made, plain = encoder(splat=4), encoder()
    assert made.output_shape == (5 + 4 * levels, 24, 18)
    assert made.fixed
    found = made(clouds)
    assert torch.equal(found[:, 5:], plain(clouds))
    assert torch.equal(found[:, :5], splatted(plain(clouds)[:, :4], LIMITS, 24.0, 4))
    assert (found[:, :3] < 1).float().mean() > (found[:, 5:8] < 1).float().mean()
