import math

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.geometry.clouds import normalise_clouds, pad
from plugins.encoder.bps.encoder import SPEED


def clouds_of(*lengths, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    return pad(
        [torch.randn(length, 3, generator=generator, dtype=torch.float64).to(dtype) for length in lengths]
    )


def build_encoder(**config):
    return build(
        "encoder",
        resolve("encoder", {"name": "bps", "points": 9, **config}),
        input_shape=(40, 4),
        input_columns=("x", "y", "z", "echo"),
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lengths", [(30, 30), (30, 12)])
def test_before_training_a_learned_basis_has_the_bits_of_a_fixed_one(lengths, dtype):
    clouds = clouds_of(*lengths, dtype=dtype)
    learned, fixed = build_encoder(learned=True).to(dtype), build_encoder().to(dtype)
    assert not learned.fixed and fixed.fixed
    assert set(learned.state_dict()) == {"basis", "moved"}
    assert torch.equal(learned(clouds), fixed(clouds))
    with torch.no_grad():
        assert torch.equal(learned(clouds), fixed(clouds))


def test_the_gradient_of_a_distance_is_the_direction_from_the_nearest_point():
    """Compare with (b - x) / |b - x|, where x is found by a loop over the points."""
    clouds = clouds_of(30, 12)
    encoder = build_encoder(learned=True).double()
    encoder(clouds).sum().backward()
    local = normalise_clouds(clouds, "unit_ball").clouds
    for number, point in enumerate(encoder.basis.tolist()):
        expected = torch.zeros(3, dtype=torch.float64)
        for cloud, length in zip(local, (30, 12), strict=True):
            closest = min(cloud[:length].tolist(), key=lambda other: math.dist(point, other))
            expected += (torch.tensor(point) - torch.tensor(closest)) / math.dist(point, closest)
        torch.testing.assert_close(encoder.moved.grad[number], SPEED * expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("config", [{}, {"normalise": "robust"}, {"rotation_invariant": True}])
def test_gradients_of_all_features_agree_with_differences(config):
    clouds = clouds_of(20, 15)
    encoder = build_encoder(learned=True, features=["delta", "distance"], **config).double()

    def features(moved):
        return torch.func.functional_call(encoder, {"moved": moved}, (clouds,))

    start = torch.zeros_like(encoder.moved).requires_grad_()
    assert torch.autograd.gradcheck(features, (start,), eps=1e-7, atol=1e-5)


def test_basis_points_move_to_the_points_of_a_cloud_if_the_distances_are_the_loss():
    clouds = clouds_of(30, 30)[:1]
    encoder = build_encoder(learned=True)
    optimizer = torch.optim.Adam(encoder.parameters(), lr=1e-3)
    for _ in range(300):
        optimizer.zero_grad()
        encoder(clouds).square().sum().backward()
        optimizer.step()
    with torch.no_grad():
        assert encoder(clouds).max() < 0.01
    fixed = build_encoder()
    fixed.basis.copy_(encoder.basis_points())
    torch.testing.assert_close(encoder(clouds), fixed(clouds), rtol=0, atol=1e-6)


def test_a_learned_basis_starts_from_the_selected_points():
    clouds = torch.randn(40, 30, 3, generator=torch.Generator().manual_seed(3))
    learned, selected = (build_encoder(basis="selected", learned=part).double() for part in (True, False))
    for encoder in (learned, selected):
        assert encoder.needs_fit
        encoder.fit_inputs([clouds.double()])
    assert not torch.equal(selected.basis, build_encoder(basis="selected").double().basis)
    assert torch.equal(learned.basis_points(), selected.basis_points())
    torch.testing.assert_close(learned(clouds.double()), selected(clouds.double()), rtol=0, atol=1e-12)
    optimizer = torch.optim.Adam(learned.parameters(), lr=1e-3)
    learned(clouds.double()).square().mean().backward()
    optimizer.step()
    away = (learned.basis_points() - selected.basis).abs()
    assert 0 < away.max() <= 0.0101  # ten times the learning rate


def test_settings_that_cannot_be_learned_are_refused():
    with pytest.raises(ConfigError, match="basis=grid is for convolutions"):
        build_encoder(learned=True, basis="grid", points=8)
    with pytest.raises(ConfigError, match=r"features=\['echo'\] are attributes"):
        build_encoder(learned=True, features=["echo"])
