import itertools

import numpy as np
import pytest
import torch
from scipy import special, stats
from torch import nn
from torch.nn.modules import dropout
from torch.utils.flop_counter import FlopCounterMode

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.protocol import median
from framework.encoder import Encoder
from framework.errors import ConfigError, UserError
from framework.model import Model, Predictor
from framework.target import Target
from plugins.uncertainty.members import mc_dropout as module
from plugins.uncertainty.members.mc_dropout import MCDropout, layout_of

CLASSES = Target("class", ("a", "b", "c"))
ANGLE = Target("angle", ("azimuth",))
REALS = Target("real", ("x", "y"))
HEADS = {
    "categorical": CLASSES,
    "von_mises": ANGLE,
    "mixture": ANGLE,
    "gaussian": REALS,
    "matrix_fisher": Target("angle", ("azimuth", "elevation", "tilt")),
    "cvae": ANGLE,
}


def test_every_dropout_layer_of_torch_is_known():
    assert {layer.__name__ for layer in module.DROPOUT} == set(dropout.__all__)


def part(group, config, **context):
    return build(group, resolve(group, config), **context)


def model(head="categorical", shape=(4,), encoders=({"name": "mlp", "widths": [16, 16], "dropout": 0.3},)):
    torch.manual_seed(0)
    built = []
    for config in encoders:
        built.append(part("encoder", config, input_shape=shape))
        shape = built[-1].output_shape
    return Model(built, part("density_head", {"name": head}, target=HEADS[head]))


def wrapped(inner, samples=5):
    return part("uncertainty", {"name": "mc_dropout", "samples": samples}, model=lambda: inner).eval()


class Plain(Predictor):
    """A predictor that is not a framework Model."""

    def __init__(self, inner):
        super().__init__()
        self.inner = inner
        self.passes = 0

    def forward(self, inputs):
        self.passes += 1
        return self.inner(inputs)

    def loss(self, inputs, target):
        return self.inner.loss(inputs, target)

    training_densities = forward

    def calibrate(self, batches):
        self.inner.calibrate(batches)


class Branching(Encoder):
    """An encoder that torch.vmap cannot run after dropout, since it reads a number."""

    def __init__(self):
        super().__init__()
        self.dropout = nn.Dropout(0.3)
        self.linear = nn.Linear(4, 16)
        self.output_shape = (16,)

    def forward(self, inputs):
        hidden = self.dropout(inputs)
        return self.linear(-hidden if hidden.abs().max().item() > 1e6 else hidden)


def targets(head, count):
    target = HEADS[head]
    return torch.randint(3, (count,)) if target.kind == "class" else torch.randn(count, len(target.names))


# one sample, and the law of many


@pytest.mark.parametrize("is_model", [True, False])
@pytest.mark.parametrize("head", list(HEADS))
def test_one_sample_is_one_stochastic_pass_to_the_last_bit(head, is_model):
    inner = model(head)
    inner = inner if is_model else Plain(inner)
    inputs, target = torch.randn(7, 4), targets(head, 7)
    with torch.no_grad():
        torch.manual_seed(5)
        density = wrapped(inner, 1)(inputs)
        results = density.log_prob(target), density.sample((3,))
        for layer in inner.modules():
            layer.train(isinstance(layer, nn.Dropout))
        torch.manual_seed(5)
        alone = inner(inputs)
        wanted = alone.log_prob(target), alone.sample((3,))
    assert torch.equal(results[0], wanted[0])
    assert torch.equal(results[1], wanted[1])


@pytest.mark.parametrize("kind", ["vectorised", "repeated", "repeated predictor", "one by one"])
def test_many_samples_are_the_mean_over_every_mask(kind, monkeypatch):
    """Compare with sixteen masks of four hidden units with dropout probability 0.4, enumerated in NumPy."""
    inner = model(encoders=({"name": "mlp", "widths": [4], "dropout": 0.4},))
    inputs = torch.randn(5, 4)
    state = {name: value.double().numpy() for name, value in inner.state_dict().items()}
    hidden = np.maximum(
        inputs.numpy() @ state["encoders.0.layers.0.weight"].T + state["encoders.0.layers.0.bias"], 0
    )
    wanted = np.zeros((5, 3))
    for mask in itertools.product([0, 1], repeat=4):
        weight = 0.6 ** sum(mask) * 0.4 ** (4 - sum(mask))
        logits = (hidden * mask / 0.6) @ state["projection.weight"].T + state["projection.bias"]
        wanted += weight * special.softmax(logits, -1)
    samples = 4000
    if kind == "repeated":
        monkeypatch.setattr(module, "layout_of", lambda *arguments: module.Layout(False, 4))
    if kind == "one by one":
        monkeypatch.setattr(module, "AT_ONCE", 100)
    mcd = wrapped(inner if "ed" in kind and kind != "repeated predictor" else Plain(inner), samples)
    torch.manual_seed(0)
    with torch.no_grad():
        density = mcd(inputs)
        expected = {"repeated predictor": Reshaped, "one by one": Stacked}.get(kind)
        assert expected is None or isinstance(density.components, expected)
        probabilities = (
            density.components.log_prob(torch.arange(3)[:, None, None]).exp().double()
        )  # (3, 5, S)
        mixed = density.log_prob(torch.arange(3)[:, None]).exp()
    error = probabilities.std(-1).T.numpy() / samples**0.5
    assert (np.abs(mixed.T.numpy() - wanted) < 5 * error + 1e-6).all()
    torch.testing.assert_close(mixed.double(), probabilities.mean(-1), rtol=1e-5, atol=1e-6)  # equal weights


def test_every_sample_of_every_input_has_its_own_mask():
    inner = model("gaussian", encoders=({"name": "mlp", "widths": [64], "dropout": 0.5},))
    density = wrapped(inner, 30)(torch.ones(6, 4)).components
    places = density.location.detach().flatten(0, 1).numpy()
    assert len(np.unique(places, axis=0)) == 6 * 30


# what is active


def vgg():
    config = {"name": "biternion_vgg", "channels": [3] * 6, "features": 12}
    return model("von_mises", (1, 32, 32), (config,))


def test_batch_norm_stays_as_it_was_trained():
    inner = vgg()
    inner(torch.rand(16, 1, 32, 32))
    mcd = wrapped(inner, 4)
    before = {name: value.clone() for name, value in inner.state_dict().items()}
    pixels = torch.randint(0, 256, (3, 1, 32, 32), dtype=torch.uint8)
    with torch.no_grad():
        density = mcd(pixels)
        assert density.log_prob(torch.zeros(3, 1)).isfinite().all()
        assert density.components.log_prob(torch.zeros(3, 1, 1)).std(-1).min() > 0
        assert median(density, 100).shape == (3, 1)
    for name, value in inner.state_dict().items():
        assert torch.equal(value, before[name]), name


@pytest.mark.parametrize(
    "layer, active",
    [
        (nn.Dropout(0.5), True),
        (nn.Dropout(0.5, inplace=True), True),
        (nn.Dropout1d(0.5), True),
        (nn.AlphaDropout(0.5), True),
        (nn.BatchNorm1d(8), False),
        (nn.RReLU(), False),
    ],
)
def test_dropout_layers_are_active_and_no_others(layer, active):
    inner = model(encoders=({"name": "mlp", "widths": [8], "dropout": 1e-9},))
    inner.encoders[0].layers.append(layer)
    inputs = torch.randn(16, 4)
    with torch.no_grad():
        spread = wrapped(inner, 20)(inputs).components.logits.std(1).max().item()
    assert (spread > 0.01) == active
    assert active or spread < 1e-6


@pytest.mark.parametrize("layer", [nn.Dropout2d(0.5), nn.Dropout3d(0.5)])
def test_whole_channels_are_dropped_where_the_network_does(layer):
    class Channels(Encoder):
        def __init__(self):
            super().__init__()
            self.layer = layer
            self.output_shape = (8 * 4,)

        def forward(self, inputs):
            size = (2, 2) if isinstance(layer, nn.Dropout2d) else (2, 2, 1)
            return self.layer(inputs.unflatten(1, (8, *size))).flatten(1)

    inner = model("gaussian")
    inner = Model([Channels()], inner.head)
    outputs = []
    inner.encoders[0].register_forward_hook(lambda _, arguments, output: outputs.append(output))
    with torch.no_grad(), torch.random.fork_rng():
        wrapped(inner, 3)(torch.ones(5, 32))
        features = torch.vmap(lambda _: inner.encoders[0](torch.ones(5, 32)), randomness="different")
        inner.encoders[0].layer.train()
        numbers = features(torch.empty(40)).unflatten(-1, (8, 4))
    assert outputs
    assert ((numbers == 0).all(-1) | (numbers == 2).all(-1)).all()
    assert 0.3 < (numbers == 0).double().mean() < 0.7


@pytest.mark.parametrize("fails", [False, True])
def test_modes_are_as_before_also_after_an_error(fails):
    inner = model(encoders=({"name": "mlp", "widths": [16, 16], "dropout": 0.3},))
    mcd = wrapped(inner)
    inner.encoders[0].layers[2].train()  # one that a user keeps active
    before = [layer.training for layer in mcd.modules()]
    if fails:
        with pytest.raises(RuntimeError):
            mcd(torch.randn(3, 5))
    else:
        mcd(torch.randn(3, 4))
    assert [layer.training for layer in mcd.modules()] == before
    assert sum(before) == 1


# training and calibration pass through


def test_training_is_that_of_the_model():
    inner = model("mixture")
    mcd = wrapped(inner).train()
    inputs, target = torch.randn(6, 4), torch.randn(6, 1)
    for ask in (
        lambda predictor: predictor.loss(inputs, target),
        lambda predictor: predictor.training_densities(inputs).log_prob(target),
        lambda predictor: predictor(inputs).log_prob(target),
    ):
        results = []
        for predictor in (mcd, inner):
            torch.manual_seed(1)
            results.append(ask(predictor))
        assert torch.equal(*results)
    mcd.eval()
    assert torch.equal(mcd.loss(inputs, target), inner.eval().loss(inputs, target))


def test_the_model_calibrates_without_dropout():
    configs = []
    for wrap in (False, True):
        inner = model("gaussian")
        inner.head = part("density_head", {"name": "gaussian", "scale": "fixed"}, target=REALS)
        inner.projection = nn.Linear(16, 2)
        torch.manual_seed(2)
        nn.init.normal_(inner.projection.weight)
        batches = [{"input": torch.randn(20, 4), "target": torch.randn(20, 2)} for _ in range(3)]
        (wrapped(inner) if wrap else inner.eval()).calibrate(batches)
        configs.append(inner.head.scale.clone())
    assert torch.equal(*configs)


# how samples are computed


def test_what_comes_before_the_first_dropout_is_computed_once():
    inner = vgg()
    passes = []
    inner.encoders[0].convolutions.register_forward_hook(
        lambda _, arguments, output: passes.append(len(arguments[0]))
    )
    mcd = wrapped(inner, 30)
    images = torch.rand(4, 1, 32, 32)
    mcd(images)
    assert passes == [1, 4]  # the trial, and the batch
    flops = {}
    for samples in (1, 30):
        mcd.samples = samples
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            mcd(images)
        flops[samples] = counter.get_total_flops()
    assert flops[1] < flops[30] < 1.2 * flops[1]


def test_a_network_that_cannot_be_vectorised_is_run_on_copies():
    torch.manual_seed(0)
    inner = Model([Branching()], part("density_head", {"name": "categorical"}, target=CLASSES))
    mcd = wrapped(inner, 6)
    with torch.no_grad():
        density = mcd(torch.randn(3, 4))
    assert mcd.layout == module.Layout(False, 4)
    assert density.components.batch_shape == (3, 6)
    assert density.components.logits.std(1).min() > 0


def test_finding_out_how_leaves_the_noise_alone():
    inner = model()
    torch.manual_seed(3)
    wanted = torch.rand(1)
    torch.manual_seed(3)
    assert layout_of(inner, torch.randn(2, 4, generator=torch.Generator())).widest == 16
    assert torch.equal(torch.rand(1), wanted)
    mcd, inputs = wrapped(inner), torch.randn(3, 4)
    results = []
    for _ in range(2):  # the first call tries, the second does not
        torch.manual_seed(4)
        results.append(mcd(inputs).log_prob(torch.zeros(3, dtype=torch.int64)))
    assert torch.equal(*results)


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(module, "AT_ONCE", 4 * 64 * 3)  # three samples of four inputs
    inner = model(encoders=({"name": "mlp", "widths": [64], "dropout": 0.3},))
    inner.eval().encoders[0].layers[2].train()
    rows = []
    inner.projection.register_forward_hook(lambda *arguments: rows.append(arguments[1][0].shape))
    density = wrapped(inner, 7)(torch.randn(4, 4))
    assert density.components.batch_shape == (4, 7)
    assert len(rows) == 1 + 3  # the trial, then 3 + 3 + 1 samples
    assert len(density.components.logits.detach().flatten(0, 1).unique(dim=0)) == 28


@pytest.mark.parametrize("is_model", [True, False])
@pytest.mark.parametrize("samples", [1, 4])
def test_an_empty_batch(samples, is_model):
    inner = model()
    density = wrapped(inner if is_model else Plain(inner), samples)(torch.randn(0, 4))
    assert density.batch_shape == (0,)
    assert density.log_prob(torch.zeros(0, dtype=torch.int64)).shape == (0,)


def test_the_knob_may_be_turned_after_training():
    mcd = wrapped(model(), 3)
    for samples in mcd.knobs["samples"]:
        mcd.samples = samples
        assert mcd(torch.randn(2, 4)).components.batch_shape == (2, samples)
    mcd.samples = 0
    with pytest.raises(ConfigError, match="samples is 0, expected 1 or more"):
        mcd(torch.randn(2, 4))


@pytest.mark.parametrize("count", [0, 1, 2, 6])
@pytest.mark.parametrize("samples", [1, 5])
def test_dropout_may_be_set_to_0_after_the_model_was_built(samples, count):
    """The wrapper `folds` sets the probability of all dropout layers of a group of models."""
    inner = model()
    predictor = wrapped(inner, samples)
    for layer in inner.modules():
        if isinstance(layer, nn.Dropout):
            layer.p = 0.0
    inputs = torch.randn(count, 4)
    density, alone = predictor(inputs), inner.eval()(inputs)
    assert density.batch_shape == (count,)
    labels = torch.zeros(count, dtype=torch.int64)
    torch.testing.assert_close(density.log_prob(labels), alone.log_prob(labels))


def test_more_samples_vary_less():
    mcd, inputs = wrapped(model()), torch.randn(1, 4)
    spread = []
    for samples in (1, 10, 100):
        mcd.samples = samples
        torch.manual_seed(0)
        with torch.no_grad():
            label = torch.zeros(1, dtype=torch.int64)
            spread.append(np.std([mcd(inputs).log_prob(label).exp().item() for _ in range(200)]))
    slope = stats.linregress(np.log([1, 10, 100]), np.log(spread)).slope
    assert slope == pytest.approx(-0.5, abs=0.1)


# refused


@pytest.mark.parametrize("dropout", [0.0, None])
def test_a_model_without_dropout_is_refused(dropout):
    inner = model(encoders=({"name": "mlp", "widths": [4], "dropout": dropout or 0.0},))
    if dropout is None:
        inner.encoders[0].layers = inner.encoders[0].layers[:2]
    with pytest.raises(
        ConfigError, match=r"every sample would be the same\. Give the encoder dropout, e\.g\."
    ):
        MCDropout(lambda: inner)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_named_and_not_averaged_in(bad):
    mcd = wrapped(model(), 4)
    inputs = torch.randn(3, 4)
    inputs[1, 2] = bad
    with pytest.raises(
        UserError, match="not finite under 4 dropout masks; the first is mask 0 of the input in batch row 1"
    ):
        mcd(inputs)


@pytest.mark.parametrize("config", [{"samples": 0}, {"samples": 1.5}, {"sample": 3}])
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"uncertainty\."):
        resolve("uncertainty", {"name": "mc_dropout", **config})
