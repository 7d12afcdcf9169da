"""Frozen models give the numbers of their predictors; fully connected networks run without the model."""

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special
from torch import Tensor, nn

import framework
from framework.configuration.assembly import build_predictor
from framework.configuration.loading import PREFIX
from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.density_head import Fitted
from framework.deployment.frozen import freeze_predictor
from framework.deployment.frozen_network import affine_logits, compute_layer, read_network, softmax
from framework.encoder import Encoder
from framework.errors import CheckpointError
from framework.geometry.clouds import pad
from framework.model import FrozenFrontEnd, Model, Predictor
from framework.target import Target
from framework.testing.contract import contract
from framework.training.checkpoint import WholeCheckpoints

SEVEN = Target("class", tuple("abcdefg"))


def mlp(shape, **config):
    return build("encoder", resolve("encoder", {"name": "mlp", **config}), input_shape=shape)


def head(name, target, **config):
    return build("density_head", resolve("density_head", {"name": name, **config}), target=target)


def trained(encoders, made, shape, dtype=torch.float32) -> Model:
    """Return a model as after a training, with random parameters and moments of batch norm."""
    torch.manual_seed(0)
    model = Model(encoders, made, shape).to(dtype).train()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        model.raw(torch.randn(40, *shape, dtype=dtype) * 3 + 1)
    return model.eval()


def same(form, predictor, inputs, limit=1e-6):
    with torch.no_grad():
        density = predictor(inputs)
    wanted = density.log_prob(density.enumerate_support()).exp().T.numpy()
    found = form(inputs)
    assert found.shape == wanted.shape
    np.testing.assert_allclose(found, wanted, rtol=0, atol=limit)
    np.testing.assert_array_equal(form(inputs.numpy()), found)


@pytest.mark.parametrize(
    "shape, widths, dtype",
    [
        ((20,), [16, 24], torch.float32),
        ((20,), [16, 24], torch.float64),
        ((3, 2, 5), [9], torch.float32),
        ((33,), [40, 8, 16], torch.float64),
        ((20,), [], torch.float32),
    ],
)
@pytest.mark.parametrize("batch_norm", [False, True])
def test_probabilities_are_the_predictors(shape, widths, batch_norm, dtype):
    encoder = mlp(shape, widths=widths, batch_norm=batch_norm, dropout=0.5)
    model = trained([encoder], head("categorical", SEVEN), shape, dtype)
    form = freeze_predictor(model, shape)
    assert (
        form.form
        == f"{len(widths) + 1} fully connected layers with batch norm folded, compiled, then softmax"
    )
    limit = 1e-6 if dtype == torch.float32 else 1e-14
    for count in (0, 1, 2, 7):
        for size in (1e-30, 1.0, 30.0):  # at 30 logits reach 60, which float32 rounds to 4e-6
            same(form, model, size * torch.randn(count, *shape, dtype=dtype), limit * max(1.0, size))
    assert form(torch.randn(1, *shape, dtype=dtype)).dtype == np.dtype(str(dtype)[6:])
    assert form(torch.randn(2, *shape, dtype=torch.float64)).dtype == np.dtype(str(dtype)[6:])
    inputs = torch.randn(3, *shape, dtype=dtype)
    unwritable = inputs.numpy().copy()
    unwritable.flags.writeable = False
    np.testing.assert_array_equal(form(unwritable), form(inputs))
    torch.testing.assert_close(form.density(inputs).probs, model(inputs).probs, rtol=0, atol=limit)


def test_two_classes_by_a_logistic_are_folded_too():
    target = Target("class", ("off", "on"))
    model = trained([mlp((6,), widths=[8])], head("bernoulli", target), (6,))
    form = freeze_predictor(model, (6,))
    assert form.form.endswith("softmax")
    same(form, model, torch.randn(5, 6))


def test_affine_logits_are_found_by_asking():
    matrix, constant = affine_logits(head("categorical", SEVEN))
    raw = np.random.default_rng(0).normal(size=(4, 7))
    found = special.softmax(raw @ matrix + constant, -1)
    np.testing.assert_allclose(found, special.softmax(raw, -1), rtol=1e-12)
    matrix, constant = affine_logits(head("bernoulli", Target("class", ("off", "on"))))
    np.testing.assert_allclose(matrix, [[0, 1]])
    mixture = {"components": 2, "component": "categorical"}
    assert affine_logits(head("mixture", SEVEN, **mixture)) is None
    assert affine_logits(head("gaussian", Target("real", ("x",)))) is None


@pytest.mark.parametrize("name", installed("density_head"))
def test_every_head_is_folded_rightly_or_left_to_torch(name):
    for row in contract("density_head", name).rows:
        made = build("density_head", resolve("density_head", {"name": name, **row.config}), target=row.target)
        if isinstance(made, Fitted) or made.direct:
            continue
        logits = affine_logits(made)
        assert (logits is not None) == (name in ("bernoulli", "categorical"))
        if logits is not None:
            matrix, constant = logits
            raw = torch.randn(5, made.size, dtype=torch.float64)
            density = made.double()(raw)
            wanted = density.log_prob(density.enumerate_support()).exp().T
            found = special.softmax(raw.numpy() @ matrix + constant, -1)
            np.testing.assert_allclose(found, wanted.numpy(), rtol=1e-10)


class Blocks(Encoder):
    """Encoder with layers in another order, in which later layers also read the inputs of earlier layers."""

    bibtex = ""

    def __init__(self, length: int, dropout: float = 0.3) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(length, 12), nn.ReLU(), nn.BatchNorm1d(12), nn.Dropout(dropout))
        self.second = nn.Sequential(nn.Linear(12 + length, 9), nn.BatchNorm1d(9), nn.ReLU())
        self.narrow = nn.Linear(9 + 12 + length, 5)
        self.output_shape = (5,)

    def forward(self, inputs: Tensor) -> Tensor:
        features = torch.cat([inputs, self.first(inputs)], 1)
        return self.narrow(torch.cat([self.second(features), features], -1))


def test_layers_in_another_order_and_side_by_side():
    model = trained([Blocks(10)], head("categorical", SEVEN), (10,))
    form = freeze_predictor(model, (10,))
    assert form.form.startswith("4 fully connected layers")
    for count in (1, 6):
        same(form, model, torch.randn(count, 10))


class Squared(Encoder):
    """Network with an operation that is not a layer."""

    bibtex = ""

    def __init__(self, length: int) -> None:
        super().__init__()
        self.layer = nn.Linear(length, 6)
        self.output_shape = (6,)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.layer(inputs).square() if inputs.sum() > 0 else self.layer(inputs)


class Twice(Squared):
    """Encoder that returns the output of a layer both before and after a ReLU."""

    def __init__(self, length: int) -> None:
        super().__init__(length)
        self.output_shape = (12,)

    def forward(self, inputs: Tensor) -> Tensor:
        found = self.layer(inputs)
        return torch.cat([found, found.relu()], 1)


@pytest.mark.parametrize(
    "kind, form_of_network",
    [
        (Twice, "1 network in ONNX Runtime, then CategoricalHead in torch"),
        (Squared, "Model in torch, without gradient"),  # a branch that depends on values is never traced
    ],
)
def test_what_is_no_chain_of_layers_is_left_to_onnx_runtime_or_torch(kind, form_of_network):
    model = trained([kind(4)], head("categorical", SEVEN), (4,))
    form = freeze_predictor(model, (4,))
    assert form.form == form_of_network
    assert read_network(model, (4,)) is None
    same(form, model, torch.randn(5, 4))
    assert not form.density(torch.randn(5, 4)).logits.requires_grad


@pytest.mark.parametrize("name", ["pointnet", "pointnet2", "deepsets", "dgcnn"])
def test_clouds_of_different_sizes_go_through_torch(name):
    shape = (30, 3)
    encoder = build("encoder", resolve("encoder", name), input_shape=shape)
    model = trained([encoder], head("categorical", SEVEN), shape)
    form = freeze_predictor(model, shape)
    assert "in torch, without gradient" in form.form
    same(form, model, pad([torch.randn(count, 3) for count in (30, 11, 1)]))


@pytest.mark.parametrize("scale", ["predicted", "fixed"])
def test_densities_over_reals_come_from_the_head(scale):
    made = head("gaussian", Target("real", ("x", "y")), scale=scale)
    model = trained([mlp((6,), widths=[16])], made, (6,))
    form = freeze_predictor(model, (6,))
    assert form.form.endswith("GaussianHead in torch")
    inputs, value = torch.randn(4, 6), torch.randn(4, 2)
    np.testing.assert_allclose(form(inputs), model(inputs).mode.detach().numpy(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(
        form.density(inputs).log_prob(value), model(inputs).log_prob(value), rtol=1e-5, atol=1e-5
    )


def test_images_of_bytes_go_through_torch():
    model = trained([mlp((1, 4, 4), widths=[8])], head("categorical", SEVEN), (1, 4, 4))
    form = freeze_predictor(model, (1, 4, 4))
    same(form, model, torch.randint(0, 256, (3, 1, 4, 4), dtype=torch.uint8))


class Lengths(Encoder):
    """Encoder without parameters for point sets: mean distances of the points from fixed positions."""

    bibtex = ""
    fixed = True

    def __init__(self, count: int) -> None:
        super().__init__()
        self.register_buffer("places", torch.linspace(-1, 1, count).unsqueeze(1).expand(count, 3).clone())
        self.output_shape = (count,)

    def forward(self, inputs: Tensor) -> Tensor:
        return torch.stack([torch.cdist(self.places, cloud).mean(1) for cloud in inputs])


@pytest.mark.parametrize("given", [None, (30, 3)])
def test_fixed_encoders_in_front_are_kept(given):
    inner = trained([mlp((12,), widths=[16], batch_norm=True)], head("categorical", SEVEN), (12,))
    predictor = FrozenFrontEnd([Lengths(12)], inner).eval()
    form = freeze_predictor(predictor, given)
    assert form.form.endswith("then softmax")
    for points in (30, 8):
        same(form, predictor, torch.randn(3, points, 3))


def test_wrappers_are_run_as_they_are():
    def one() -> Predictor:
        return Model([mlp((6,), widths=[8])], head("categorical", SEVEN), (6,))

    torch.manual_seed(0)
    resolved = resolve("uncertainty", {"name": "ensemble", "members": 3})
    predictor = build("uncertainty", resolved, model=one, target=SEVEN).eval()
    form = freeze_predictor(predictor, (6,))
    assert form.form == "1 network in ONNX Runtime, then Ensemble in torch"
    for count in (1, 4):
        same(form, predictor, torch.randn(count, 6))
    form.inner.members = predictor.members = 2
    same(pickle.loads(pickle.dumps(form)), predictor, torch.randn(4, 6))


def test_heads_fitted_at_once_are_run_as_they_are():
    made = head("extra_trees", SEVEN, trees=5)
    made.fit(torch.randn(70, 6), torch.arange(70) % 7, 0)
    predictor = FrozenFrontEnd([Lengths(6)], Model([], made, (6,))).eval()
    same(freeze_predictor(predictor), predictor, torch.randn(4, 9, 3))


def test_training_on_does_not_change_what_was_frozen():
    model = trained([mlp((6,), widths=[8])], head("categorical", SEVEN), (6,))
    form, inputs = freeze_predictor(model, (6,)), torch.randn(3, 6)
    before = form(inputs)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(2)
    np.testing.assert_array_equal(form(inputs), before)
    assert all(parameter.requires_grad for parameter in model.parameters())


def test_without_a_shape_the_first_call_tells():
    model = trained([mlp((6,), widths=[8])], head("categorical", SEVEN), (6,))
    form = freeze_predictor(model)
    assert form.form == "not known before the first call"
    same(form, model, torch.randn(3, 6))
    assert form.form.endswith("softmax")
    with pytest.raises(ValueError, match=r"Got inputs of shape \(3, 7\), but shape \(batch, 6\)"):
        form(torch.randn(3, 7))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("count", [1, 4])
def test_inputs_that_are_not_finite_are_refused_with_their_row(bad, count):
    model = trained([mlp((6,), widths=[8])], head("categorical", SEVEN), (6,))
    inputs = torch.randn(count, 6)
    inputs[-1, 2] = bad
    for predict in (freeze_predictor(model, (6,)), model):
        with pytest.raises(ValueError, match=f"raw parameters are not finite in batch row {count - 1}"):
            predict(inputs)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(
    st.integers(0, 40),
    st.integers(1, 20),
    st.floats(0, 1),
    st.booleans(),
    st.sampled_from([np.float32, np.float64]),
    st.integers(0, 2**31),
)
def test_a_layer_is_a_product_whatever_is_zero(length, width, share, rectified, dtype, seed):
    generator = np.random.default_rng(seed)
    numbers = generator.normal(size=length) * (generator.random(length) < share)
    weight, bias = generator.normal(size=(length, width)), generator.normal(size=width)
    found = np.full(width, np.nan, dtype)
    compute_layer(numbers.astype(dtype), weight.astype(dtype), bias.astype(dtype), rectified, found)
    wanted = numbers.astype(dtype).astype(float) @ weight.astype(dtype) + bias.astype(dtype)
    wanted = np.maximum(wanted, 0) if rectified else wanted
    np.testing.assert_allclose(found, wanted, rtol=0, atol=100 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_softmax_of_extreme_logits(dtype):
    logits = np.array([[0.0, 0], [1e4, -1e4], [-1e30, -1e30], [88.7, 0], [1e-30, 0]], dtype)
    wanted = special.softmax(logits.astype(np.float64), -1)
    found = logits.copy()
    softmax(found)
    np.testing.assert_allclose(found, wanted, rtol=10 * np.finfo(dtype).eps, atol=np.finfo(dtype).tiny)
    for bad in (np.nan, np.inf, -np.inf):
        rows = np.array([[1, bad, 2], [1, 2, 3]], dtype)
        softmax(rows)
        assert np.isnan(rows[0]).all() and np.isfinite(rows[1]).all()


def test_a_run_folder_is_frozen(tmp_path):
    config = {
        "data": {"name": "moons"},
        "encoder": [resolve("encoder", {"name": "mlp", "widths": [8]})],
        "density_head": resolve("density_head", "categorical"),
        "uncertainty": [],
    }
    predictor = build_predictor(config, SEVEN, (6,), seed=0).eval()
    described = {
        "format": 1,
        "config": config,
        "target": {"kind": "class", "names": list(SEVEN.names)},
        "input_shape": [6],
    }
    state = {f"{PREFIX}{key}": value for key, value in predictor.state_dict().items()}
    path = tmp_path / "checkpoints" / "model.ckpt"
    WholeCheckpoints().save_checkpoint({"framework": described, "state_dict": state}, path)
    form = framework.freeze(tmp_path)
    assert form.form.endswith("softmax")
    same(form, predictor, torch.randn(3, 6))
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="contains no checkpoint"):
        framework.freeze(tmp_path / "empty")
