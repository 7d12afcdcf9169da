"""Densities with another batch_shape, compared with the same densities one by one."""

import math

import pytest
import torch
from torch.distributions import Categorical, Independent, Normal

from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture
from framework.distributions.protocol import marginal, median, pick
from framework.testing.metrics import Cardioid


def density(kind, *batch):
    torch.manual_seed(len(batch))
    if kind == "class":
        return Categorical(logits=torch.randn(*batch, 3), validate_args=False)
    if kind == "angle":
        return Cardioid(torch.randn(*batch, 2))
    return Independent(Normal(torch.randn(*batch, 2), 1 + torch.rand(*batch, 2)), 1, validate_args=False)


def values(kind, *shape):
    return torch.randint(3, shape) if kind == "class" else torch.randn(*shape, 2)


KINDS = pytest.mark.parametrize("kind", ["class", "angle", "real"])


@KINDS
def test_stacked_is_its_densities_side_by_side(kind):
    parts = [density(kind, 5), density(kind, 5), density(kind, 5)]
    whole = Stacked(parts)
    event = tuple(parts[0].event_shape)
    assert (tuple(whole.batch_shape), tuple(whole.event_shape)) == ((5, 3), event)
    value = values(kind, 7, 5, 3)
    found = whole.log_prob(value)
    for index, part in enumerate(parts):
        assert torch.equal(found[..., index], part.log_prob(value.select(2, index)))
        assert torch.equal(whole.entropy()[:, index], part.entropy())
        assert torch.equal(whole.mode.select(1, index), part.mode)
    one = values(kind, 7, 5, 1)
    assert torch.equal(whole.log_prob(one)[..., 2], parts[2].log_prob(one.select(2, 0)))
    assert whole.sample((4,)).shape == (4, 5, 3, *event)


@KINDS
def test_reshaped_is_the_density_in_another_order_of_places(kind):
    flat = density(kind, 15)
    folded = Reshaped(flat, (5, 3))
    event = tuple(flat.event_shape)
    value = values(kind, 7, 5, 3)
    assert torch.equal(folded.log_prob(value), flat.log_prob(value.reshape(7, 15, *event)).reshape(7, 5, 3))
    shared = values(kind, 5, 1)  # one value for all of the last dimension
    spread = shared.expand(5, 3, *event)
    assert torch.equal(folded.log_prob(shared), folded.log_prob(spread))
    assert torch.equal(folded.mode, flat.mode.reshape(5, 3, *event))
    assert torch.equal(folded.entropy(), flat.entropy().reshape(5, 3))
    torch.manual_seed(1)
    drawn = folded.sample((4,))
    torch.manual_seed(1)
    assert torch.equal(drawn, flat.sample((4,)).reshape(4, 5, 3, *event))


@KINDS
@pytest.mark.parametrize("make", ["stacked", "reshaped"])
def test_a_mixture_of_them_samples_what_it_says(kind, make):
    """Compare frequencies and means of samples with the values from log_prob and the parts."""
    if make == "stacked":
        parts = [density(kind, 2), density(kind, 2)]
        components = Stacked(parts)
    else:
        components = Reshaped(density(kind, 4), (2, 2))
    weights = torch.tensor([[0.0, 1.0], [2.0, 0.0]])
    mixture = Mixture(weights, components)
    torch.manual_seed(3)
    drawn, count = mixture.sample((40_000,)), 40_000
    if kind == "class":
        for label in range(3):
            share = (drawn == label).double().mean(0)
            wanted = mixture.log_prob(torch.full((2,), label)).exp().double()
            assert (share - wanted).abs().max() < 5 * math.sqrt(0.25 / count)
    else:
        pieces = components.sample((count,))  # of every component
        share = torch.softmax(weights, -1)[None, ..., None]
        for moment in (torch.sin, torch.cos):
            wanted = (moment(pieces) * share).sum(2).mean(0)
            assert (moment(drawn).mean(0) - wanted).abs().max() < 7 / math.sqrt(count)


def test_picking_a_reshaped_density_draws_only_what_was_picked():
    flat = Independent(Normal(torch.arange(6.0)[:, None], 1e-6 * torch.ones(6, 1)), 1, validate_args=False)
    index = torch.tensor([[0, 2], [1, 1], [2, 0]])  # three draws of two places, each of three components
    picked = pick(Reshaped(flat, (2, 3)), index)
    assert picked.batch_shape == (3, 2)
    wanted = torch.tensor([[0.0, 5.0], [1.0, 4.0], [2.0, 3.0]])
    assert torch.allclose(picked.sample()[..., 0], wanted, atol=1e-4)


def test_marginals_are_those_of_the_parts():
    parts = [density("angle", 4), density("angle", 4)]
    value = torch.randn(4, 2, 1)
    found = marginal(Stacked(parts), 1).log_prob(value)
    wanted = torch.stack([marginal(part, 1).log_prob(value[:, i]) for i, part in enumerate(parts)], -1)
    assert torch.equal(found, wanted)
    flat = density("angle", 8)
    folded = marginal(Reshaped(flat, (4, 2)), 0)
    assert torch.equal(folded.log_prob(value), marginal(flat, 0).log_prob(value.reshape(8, 1)).reshape(4, 2))
    torch.testing.assert_close(median(Reshaped(flat, (4, 2)), 5), flat.location.reshape(4, 2, 2))
    torch.testing.assert_close(median(Stacked(parts), 5)[:, 1], parts[1].location)


def test_classes_are_enumerated():
    parts = [density("class", 2, 4), density("class", 2, 4)]
    for whole in (Stacked(parts), Reshaped(density("class", 16), (2, 4, 2))):
        assert whole.enumerate_support().shape == (3, 2, 4, 2)
        assert whole.enumerate_support(expand=False).shape == (3, 1, 1, 1)
        mixture = Mixture(torch.zeros(2, 4, 2), whole)
        assert torch.allclose(mixture.log_prob(mixture.enumerate_support()).exp().sum(0), torch.ones(2, 4))


def test_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="expected equal shapes"):
        Stacked([density("real", 3), density("real", 4)])
    with pytest.raises(ValueError, match="the same number of densities"):
        Reshaped(density("real", 6), (4, 2))
