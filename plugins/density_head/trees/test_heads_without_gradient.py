"""Tests of heads without gradient: normal densities also of an empty batch, state of any shape, refusals."""

import copy

import numpy as np
import pytest
import torch
from scipy import stats

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.distributions.normals import IndependentNormals
from framework.distributions.protocol import mahalanobis, marginal, median, normals, pick
from framework.distributions.tempering import temper
from framework.errors import ConfigError, UserError
from framework.model import Model
from framework.target import Target
from plugins.density_head.trees.heads_without_gradient import (
    load_any_shape,
    single,
    with_gradient_of_0,
)


@pytest.mark.parametrize("shape", [(4, 3), (2, 5, 2), (0, 2), (3,)])
def test_log_prob_and_entropy_are_sums_of_scipys(shape):
    mean, scale, value = torch.randn(3, *shape, dtype=torch.float64).unbind()
    scale = scale.exp()
    density = IndependentNormals(mean, scale)
    arrays = [part.numpy() for part in (value, mean, scale)]
    np.testing.assert_allclose(
        density.log_prob(value).numpy(), stats.norm.logpdf(*arrays).sum(-1), rtol=1e-12
    )
    np.testing.assert_allclose(density.entropy().numpy(), stats.norm.entropy(*arrays[1:]).sum(-1), rtol=1e-12)
    assert density.event_shape == shape[-1:]
    assert torch.equal(median(density, 3), mean)


def test_the_framework_treats_them_as_any_independent_normals():
    mean, scale = torch.randn(4, 3, 2), torch.rand(4, 3, 2) + 0.5
    density = IndependentNormals(mean, scale)
    second = marginal(density, 1)
    assert second.event_shape == (1,)
    assert torch.equal(normals(second).mean, mean[..., 1:].double())
    assert pick(density, torch.tensor([0, 1, 2, 1])).batch_shape == (4,)
    value = torch.randn(4, 3, 2)
    wanted = ((value - mean) / scale).double().square().sum(-1)
    torch.testing.assert_close(mahalanobis(density, value), wanted, rtol=1e-6, atol=1e-6)
    hot = temper(Mixture(torch.zeros(4, 3), density), torch.tensor(4.0))
    torch.testing.assert_close(hot.components.base_dist.scale, 2 * scale)


def test_single_precision_cuts_off_what_exceeds_it():
    largest = torch.finfo(torch.float32).max
    rounded = single(torch.tensor([1e300, -1e300, 0.1], dtype=torch.float64))
    assert rounded.tolist() == [largest, -largest, float(np.float32(0.1))]
    assert single(torch.ones(3, 2).T).is_contiguous()


@pytest.mark.parametrize("shape", [(4,), (4, 3), (4, 7, 3)])
def test_a_gradient_is_0_where_it_is_asked_for(shape):
    raw, numbers = torch.randn(4, 5, requires_grad=True), torch.randn(shape)
    result = with_gradient_of_0(numbers, raw)
    assert torch.equal(result, numbers) and with_gradient_of_0(numbers, raw.detach()) is numbers
    result.sum().backward()
    assert torch.equal(raw.grad, torch.zeros(4, 5))


class Sized(torch.nn.Module):
    """A module with a buffer of any size."""

    def __init__(self, count):
        super().__init__()
        self.register_buffer("numbers", torch.arange(count, dtype=torch.int32))
        self.loaded = []
        load_any_shape(self, lambda head, _: None, lambda head, _: head.loaded.append(head.numbers.tolist()))


def test_a_state_of_another_shape_is_taken_and_then_read():
    holder = torch.nn.Sequential(Sized(0), Sized(2))
    holder.load_state_dict(torch.nn.Sequential(Sized(5), Sized(1)).state_dict())
    assert holder[0].loaded == [[0, 1, 2, 3, 4]] and holder[0].numbers.dtype == torch.int32
    assert holder[1].loaded == [[0]]
    twin = copy.deepcopy(holder)
    twin.load_state_dict(torch.nn.Sequential(Sized(3), Sized(2)).state_dict())
    assert twin[0].numbers.tolist() == [0, 1, 2] and holder[0].numbers.tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(RuntimeError, match="Missing key"):
        holder.load_state_dict({"0.numbers": torch.zeros(1, dtype=torch.int32)})


NAMES = ("extra_trees", "xgboost")
FOUR, TWO = Target("class", ("a", "b", "c", "d")), Target("real", ("x", "y"))
STORED = {
    "extra_trees": {
        **dict.fromkeys(("feature", "branch", "root", "start", "label", "count"), torch.int32),
        "threshold": torch.float32,
        "mean": torch.float64,
        "width": torch.float64,
        "read": torch.int64,
    },
    "xgboost": {"model": torch.uint8, "width": torch.float64, "read": torch.int64},
}
"""Names and dtypes of the stored arrays of each head: old checkpoints must always load."""


def build_head(name, target):
    few = {"extra_trees": {"trees": 6}, "xgboost": {"rounds": 8}}[name]
    return build("density_head", resolve("density_head", {"name": name, **few}), target=target)


def fit_head(name, target):
    """Return a head and its training data: features that are informative about the target."""
    features = torch.randn(300, 5, generator=torch.Generator().manual_seed(0))
    wanted = features[:, :2] @ torch.tensor([[1.0, 0.5], [-1.0, 2.0]])
    if target.kind == "class":
        wanted = (features[:, 0] > 0).long() + 2 * (features[:, 1] > 0).long()
    head = build_head(name, target)
    head.fit(features, wanted, 5)
    return head, features, wanted


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("target", [FOUR, TWO], ids=["classes", "reals"])
def test_its_state_is_plain_tensors_that_another_head_takes(name, target):
    head, features, wanted = fit_head(name, target)
    head.calibrate(features, wanted)
    assert {key: tensor.dtype for key, tensor in head.state_dict().items()} == STORED[name]
    other = Model([], build_head(name, target), (5,))
    model = Model([], head, (5,))
    other.load_state_dict(model.state_dict())
    assert other.head.size == 5
    inputs = torch.randn(40, 5)
    assert torch.equal(other(inputs).log_prob(wanted[:40]), model(inputs).log_prob(wanted[:40]))


def test_a_forest_written_by_hand_is_read():
    """Check one tree: class 3 if the first of two features is at most 1/2, else one sample each of classes 0 and 1."""
    numbers = {"feature": [0, -1, -1], "branch": [[1, 2], [0, 0], [1, 1]], "root": [0]}
    numbers |= {"start": [0, 1, 3], "label": [3, 0, 1], "count": [9, 1, 1], "threshold": [0.5, 0.0, 0.0]}
    state = {key: torch.tensor(value, dtype=STORED["extra_trees"][key]) for key, value in numbers.items()}
    state |= {"mean": torch.zeros(0, 0).double(), "width": torch.zeros(0).double(), "read": torch.tensor(2)}
    head = build_head("extra_trees", FOUR)
    head.load_state_dict(state)
    probabilities = head(torch.tensor([[0.5, 7.0], [0.6, -7.0]], dtype=torch.float64)).probs
    # Laplace's rule on one vote: (f + 1) / (1 + 4)
    torch.testing.assert_close(probabilities, torch.tensor([[1, 1, 1, 2], [1.5, 1.5, 1, 1]]).double() / 5)


@pytest.mark.parametrize("name", NAMES)
def test_features_beyond_float32_and_of_any_batch_shape(name):
    head, features, _ = fit_head(name, FOUR)
    queries = features[:6].double()
    queries[0], queries[1] = 1e300, -1e300
    logits = head(queries.reshape(2, 3, 5)).logits
    assert logits.shape == (2, 3, 4) and logits.isfinite().all()
    largest = torch.finfo(torch.float32).max
    assert torch.equal(logits.reshape(6, 4), head(queries.clamp(-largest, largest)).logits)
    assert head(queries[:0]).logits.shape == (0, 4)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_refused_before_the_fit_and_for_angles(name):
    with pytest.raises(UserError, match=f"{name} is not fitted yet"):
        build_head(name, FOUR)(torch.zeros(1, 0))
    with pytest.raises(ConfigError, match="kind 'class' or 'real'"):
        build_head(name, Target("angle", ("azimuth",)))
