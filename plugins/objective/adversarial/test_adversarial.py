import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError, NonFiniteLoss
from framework.model import Model, Predictor
from framework.target import Target
from framework.uncertainty import own_batches
from plugins.objective.adversarial.objective import Adversarial

TARGETS = {
    "categorical": Target("class", ("a", "b", "c")),
    "von_mises": Target("angle", ("azimuth", "elevation")),
    "gaussian": Target("real", ("x", "y")),
}


def model(head, shape=(4,), encoder="mlp", **config):
    torch.manual_seed(0)
    config = {"widths": [6], **config} if encoder == "mlp" else config
    first = build("encoder", resolve("encoder", {"name": encoder, **config}), input_shape=shape)
    last = build("density_head", resolve("density_head", head), target=TARGETS[head])
    return Model([first], last)


def labelled(head, count, dtype=torch.float64):
    target = TARGETS[head]
    if target.kind == "class":
        return torch.randint(len(target.names), (count,))
    return torch.randn(count, len(target.names), dtype=dtype)


class Recorded(Predictor):
    """A predictor that records the inputs of each loss; the gradient of the loss in the inputs is `slope`."""

    def __init__(self, slope=1.0):
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))
        self.slope = slope
        self.recorded = []

    def loss(self, inputs, target):
        self.recorded.append(inputs.detach().clone())
        return self.scale * (self.slope * inputs).flatten(1).sum(1)

    def forward(self, inputs):
        raise AssertionError("only the loss may be called")

    training_densities = forward

    def calibrate(self, batches):
        raise AssertionError("only the loss may be called")


class Linear(Recorded):
    """A softmax of a linear map."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.layer = nn.Linear(4, 3)

    def loss(self, inputs, target):
        return nn.functional.cross_entropy(self.layer(inputs), target, reduction="none")


@pytest.mark.parametrize("batch_norm", [False, True], ids=["side by side", "one after the other"])
def test_members_of_an_ensemble_are_each_moved_along_their_own_gradient(batch_norm):
    """Compare the penalty of each member on its own rows, and its gradient, with those of a model alone."""
    objective = Adversarial(weight=0.7, epsilon=0.3)
    wrapper = resolve("uncertainty", {"name": "ensemble", "members": 3})
    alone = [model("gaussian", batch_norm=batch_norm).double() for _ in range(3)]
    for index, member in enumerate(alone):
        for parameter in member.parameters():
            parameter.data += 0.1 * (index + 1)
    copies = iter(copy.deepcopy(alone))
    whole = build("uncertainty", wrapper, model=lambda: next(copies), target=TARGETS["gaussian"])
    inputs, target = torch.randn(15, 4, dtype=torch.float64), labelled("gaussian", 15)
    with own_batches(whole):
        penalty = objective(whole, {"input": inputs, "target": target})
    penalty.backward()
    wanted = [
        objective(member, {"input": inputs[rows], "target": target[rows]})
        for member, rows in zip(alone, torch.arange(15).chunk(3), strict=True)
    ]
    torch.testing.assert_close(penalty, torch.stack(wanted).mean(), rtol=1e-12, atol=0)
    sum(wanted).backward()
    gradients = [torch.cat([part.grad.flatten() for part in member.parameters()]) for member in alone]
    total = torch.stack(gradients).norm()
    torch.testing.assert_close(
        torch.cat([part.grad.flatten() for part in whole.parameters()]).norm(), total, rtol=1e-9, atol=0
    )


@pytest.mark.parametrize("head", list(TARGETS))
def test_agrees_with_brute_force(head):
    """Compare with central differences, number by number, and the mean of the losses at the moved inputs."""
    predictor = model(head).double()
    inputs, target = torch.randn(5, 4, dtype=torch.float64), labelled(head, 5)

    def loss(moved_inputs):
        with torch.no_grad():
            return predictor.loss(torch.from_numpy(moved_inputs), target).numpy()

    start = inputs.numpy()
    gradient = np.zeros_like(start)
    for column in range(4):
        step = np.zeros(4)
        step[column] = 1e-6
        gradient[:, column] = (loss(start + step) - loss(start - step)) / 2e-6
    assert np.abs(gradient).min() > 1e-7  # so that signs are certain
    wanted = 0.7 * loss(start + 0.05 * np.sign(gradient)).mean()
    objective = build(
        "objective", resolve("objective", {"name": "adversarial", "weight": 0.7, "epsilon": 0.05})
    )
    penalty = objective(predictor, {"input": inputs, "target": target})
    assert penalty.item() == pytest.approx(wanted, rel=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**31), st.sampled_from([1e-4, 0.01, 1.0, 30.0]), st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_convex_loss_rises_by_at_least_its_slope(seed, epsilon, size):
    """Check loss(x') ≥ loss(x) + ε ‖∇‖₁ for -log softmax of a linear map, which is convex."""
    predictor = Linear().double()
    generator = torch.Generator().manual_seed(seed)
    inputs = (size * torch.randn(6, 4, dtype=torch.float64, generator=generator)).requires_grad_()
    target = torch.randint(3, (6,), generator=generator)
    losses = predictor.loss(inputs, target)
    (gradient,) = torch.autograd.grad(losses.sum(), inputs)
    least = (losses + epsilon * gradient.abs().sum(1)).mean().item()
    penalty = Adversarial(epsilon=epsilon)(predictor, {"input": inputs.detach(), "target": target}).item()
    assert penalty >= least - 1e-9 * max(1, abs(least))


def test_bytes_are_read_as_0_to_1_and_stay_there():
    predictor = Recorded()
    pixels = torch.tensor([[[[0, 255], [128, 254]]]], dtype=torch.uint8)
    Adversarial(epsilon=0.1)(predictor, {"input": pixels, "target": torch.zeros(1)})
    first, moved = predictor.recorded
    torch.testing.assert_close(first, pixels / 255)
    torch.testing.assert_close(moved, (pixels / 255 + 0.1).clamp(max=1))
    Adversarial(epsilon=0.1)(Recorded(-1.0), {"input": pixels, "target": torch.zeros(1)})


def test_floats_may_leave_the_range_they_came_in():
    predictor = Recorded(-1.0)
    Adversarial(epsilon=0.1)(predictor, {"input": torch.zeros(1, 1, 2, 2), "target": torch.zeros(1)})
    assert torch.equal(predictor.recorded[1], torch.full((1, 1, 2, 2), -0.1))


def test_where_the_loss_is_flat_nothing_moves():
    predictor = Recorded(torch.tensor([1.0, 0.0, -1.0]))
    Adversarial(epsilon=0.5)(predictor, {"input": torch.zeros(1, 3), "target": torch.zeros(1)})
    assert predictor.recorded[1].tolist() == [[0.5, 0.0, -0.5]]


def test_a_network_with_batch_norm_and_dropout_learns_from_it():
    predictor = model("von_mises", (1, 32, 32), "biternion_vgg", channels=[2] * 6, features=5)
    batch = {
        "input": torch.randint(0, 256, (4, 1, 32, 32), dtype=torch.uint8),
        "target": labelled("von_mises", 4, torch.float32),
    }
    moments = {name: value.clone() for name, value in predictor.named_buffers()}
    Adversarial()(predictor, batch).backward()
    assert all(parameter.grad.isfinite().all() for parameter in predictor.parameters())
    assert predictor.encoders[0].fully_connected.weight.grad.abs().sum() > 0
    for name, value in predictor.named_buffers():
        assert torch.equal(value, moments[name]), name


@pytest.mark.parametrize("kind", [torch.int64, torch.int32, torch.bool])
def test_integers_that_are_not_bytes_are_refused(kind):
    with pytest.raises(DataError, match=r"inputs of type torch\.(int64|int32|bool), which cannot be changed"):
        Adversarial()(Recorded(), {"input": torch.ones(2, 3, dtype=kind), "target": torch.zeros(2)})


class Detached(Recorded):
    def loss(self, inputs, target):
        return super().loss(inputs.detach(), target)


class Untrained(Recorded):
    def loss(self, inputs, target):
        return super().loss(inputs, target).detach()


@pytest.mark.parametrize("kind", [Detached, Untrained])
def test_a_loss_without_a_gradient_in_the_inputs_is_refused(kind):
    with pytest.raises(ConfigError, match="the loss has no gradient in the inputs"):
        Adversarial()(kind(), {"input": torch.zeros(2, 3), "target": torch.zeros(2)})


class Kinked(Recorded):
    """A predictor with the square root of 0, which has no derivative: 0 · ∞."""

    def loss(self, inputs, target):
        return super().loss(inputs, target) + 0 * inputs.abs().sum(1).sqrt()


def test_a_gradient_that_is_not_a_number_names_its_samples():
    inputs = torch.tensor([[1.0, 1.0], [0.0, 0.0], [2.0, 1.0]])
    batch = {"input": inputs, "target": torch.zeros(3), "index": torch.tensor([70, 80, 90])}
    with pytest.raises(NonFiniteLoss, match=r"is NaN for samples \[80\]"):
        Adversarial()(Kinked(), batch)


@pytest.mark.parametrize(
    "config", [{"weight": 0.0}, {"epsilon": -0.1}, {"epsilon": float("inf")}, {"eps": 0.1}]
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"objective\."):
        resolve("objective", {"name": "adversarial", **config})
