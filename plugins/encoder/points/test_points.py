import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.geometry.clouds import normalise_clouds
from framework.testing.cloud_encoders import batch_of

DTYPES = [torch.float32, torch.float64]


def build_encoder(shape=(40, 3), **config):
    return build("encoder", resolve("encoder", {"name": "points", **config}), input_shape=shape)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("choice", ["random", "farthest"])
@pytest.mark.parametrize("normalise", ["unit_ball", "robust", "none"])
def test_points_are_those_of_the_normalised_cloud_with_their_attributes(normalise, choice, dtype):
    lengths, count = [40, 3, 16], 16
    clouds = batch_of(lengths, 5, dtype)
    features = build_encoder((40, 5), points=count, choice=choice, normalise=normalise)(clouds)
    assert features.dtype == dtype
    local = normalise_clouds(clouds, normalise).clouds
    for number, length in enumerate(lengths):
        rows = [local[number, :length].tolist().index(row) for row in features[number].tolist()]
        if length >= count:
            assert len(set(rows)) == count  # none twice
        else:
            assert rows == rows[:length] * (count // length) + rows[: count % length]
            assert sorted(rows[:length]) == list(range(length))  # all of them, in turn


def test_random_points_follow_from_the_seed_and_the_size_alone():
    clouds = batch_of([40, 40, 7])
    torch.manual_seed(1)
    first = build_encoder(points=8)(clouds)
    torch.manual_seed(2)
    assert torch.equal(build_encoder(points=8)(clouds), first)
    assert torch.equal(build_encoder(points=8)(clouds[1:2])[0], first[1])
    assert not torch.equal(build_encoder(points=8, seed=14)(clouds), first)
    assert torch.equal(build_encoder(points=8)(clouds.flip(0)).flip(0), first)


def test_the_gradient_reaches_the_points_that_were_taken():
    clouds = batch_of([9, 9], 4).requires_grad_()
    assert torch.autograd.gradcheck(
        build_encoder((9, 4), points=4, choice="farthest"), (clouds,), eps=1e-6, atol=1e-6
    )


def test_the_features_are_fixed_and_nothing_is_learned():
    for choice in ("random", "farthest"):
        encoder = build_encoder((40, 4), points=8, choice=choice)
        assert encoder.fixed
        assert not encoder.state_dict()
        assert encoder(torch.zeros(0, 40, 4)).shape == encoder(torch.zeros(0, 0, 4)).shape == (0, 8, 4)


@pytest.mark.parametrize("config", [{"points": 0}, {"choice": "first"}, {"seed": -1}, {"normalise": "ball"}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        build_encoder(**config)
