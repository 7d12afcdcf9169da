"""Tests of features that are computed only once, and of heads that are fitted to all features together."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import Categorical

from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.datasets.fields import Fields
from framework.density_head import DensityHead, Fitted
from framework.encoder import Encoder
from framework.errors import CheckpointError, ConfigError, DataError
from framework.model import FrozenFrontEnd, Model
from framework.modes.combine import _inner_predictor
from framework.target import Target
from framework.training.batches import Batches
from framework.training.cached_features import LARGEST, CachedFeatures, fits
from framework.training.fitting import fit_at_once, fitted_models, mean_loss

CLASSES = Target("class", ("low", "high"))


class Squares(Encoder):
    """Encoder x → (x, x²) that counts its samples."""

    bibtex = ""
    fixed = True
    output_shape = (4,)

    def __init__(self, factor=1.0):
        super().__init__()
        self.register_buffer("factor", torch.tensor(factor))
        self.seen = 0

    def forward(self, inputs):
        self.seen += len(inputs)
        return torch.cat([inputs, self.factor * inputs.square()], 1)


class Points(Data):
    """Data set of two numbers, and a class that tells whether their sum is positive."""

    bibtex = ""
    target = CLASSES
    input_shape = (2,)
    groups = ("points",)
    synthetic = True
    skipped = 0
    varies = False

    def prepare(self):
        pass

    def split(self, count, seed):
        inputs = torch.randn(count, 2, generator=torch.Generator().manual_seed(seed))
        return Fields(input=inputs, target=(inputs.sum(1) > 0).long(), index=torch.arange(count))

    def train(self):
        return self.split(50, 0)

    def validation(self):
        return self.split(20, 1)

    def test(self):
        return self.split(30, 2)

    def read(self, files):
        return self.split(3, 3)

    def augment(self, batch):
        return batch

    def fingerprint(self):
        return {"version": "1"}

    def preview(self, inputs):
        return np.zeros((1, 1, 3), np.uint8)


class Shares(DensityHead, Fitted):
    """Head that predicts the share of each class for any features, and stores the data of its fit."""

    bibtex = ""
    knobs = {}  # noqa: RUF012

    def __init__(self):
        super().__init__()
        self.size = 0
        self.register_buffer("logits", torch.zeros(0))

    def fit(self, features, target, seed):
        self.size, self.seed, self.features = features.shape[1], seed, features
        self.logits = (target.bincount(minlength=2) / len(target)).log()

    def forward(self, raw):
        return Categorical(logits=self.logits.expand(*raw.shape[:-1], 2))

    def loss(self, raw, target):
        return -self(raw).log_prob(target)

    def calibrate(self, raw, target):
        pass


def categorical():
    return build("density_head", resolve("density_head", "categorical"), target=CLASSES)


def batches(data, size=8):
    return Batches(data, batch_size=size, workers=0, seed=0)


def test_features_are_computed_once_and_are_the_same_as_in_each_step():
    data, encoder = Points(), Squares()
    whole = FrozenFrontEnd([encoder], Model([], categorical(), (4,)))
    encoded = CachedFeatures(data, whole.features, batch_size=7, workers=0)
    for name in ("train", "validation", "test"):
        raw, found = getattr(data.splits(), name), getattr(encoded.splits(), name)
        assert getattr(encoded.splits(), name) is found
        every = found.__getitems__(range(len(found)))
        assert every.keys() == raw.fields.keys()
        torch.testing.assert_close(every["input"], Squares()(raw.fields["input"]), rtol=0, atol=0)
        assert torch.equal(every["index"], raw.fields["index"])
    assert encoder.seen == 100
    some = next(iter(batches(data).of(data.test())))
    same = next(iter(batches(encoded).of(encoded.splits().test)))
    assert torch.equal(whole(some["input"]).logits, whole.predictor(same["input"]).logits)
    assert torch.equal(
        whole.loss(some["input"], some["target"]), whole.predictor.loss(same["input"], same["target"])
    )
    assert encoded.augment(same) is same
    assert len(encoded.read([])) == 3
    with pytest.raises(ConfigError, match="cannot be drawn"):
        encoded.preview(same["input"])


def test_features_that_do_not_fit_into_memory_are_not_held():
    assert fits(Points(), Squares())
    assert not fits(Points(), lambda inputs: torch.empty(1, device="meta").expand(len(inputs), LARGEST))


def test_a_head_fitted_at_once_sees_the_whole_training_split_and_members_differ_by_seed():
    data = Points()
    members = build(
        "uncertainty",
        resolve("uncertainty", {"name": "ensemble", "members": 2}),
        model=lambda: Model([Squares()], Shares()),
        target=CLASSES,
    )
    models = fitted_models(members)
    heads = [model.head for model in models]
    assert len({id(head) for head in heads}) == 2
    fit_at_once(members, batches(data), seed=5)
    assert [head.seed for head in heads] == [5, 6]
    assert torch.equal(heads[0].features, Squares()(data.train().fields["input"]))
    share = data.train().fields["target"].double().mean().item()
    probability = members(torch.zeros(3, 2)).log_prob(torch.ones(3, dtype=torch.int64)).exp()
    assert probability[0].item() == pytest.approx(share, rel=1e-6)
    validation = data.validation().fields["target"].double().mean().item()
    wanted = -validation * math.log(share) - (1 - validation) * math.log(1 - share)
    assert mean_loss(models[0], batches(data).val_dataloader()) == pytest.approx(wanted, rel=1e-6)


def test_features_that_are_not_finite_are_named():
    data = Points()
    data.train = lambda: Fields(
        input=torch.tensor([[0.0, 1], [math.inf, 1]]), target=torch.tensor([0, 1]), index=torch.arange(2)
    )
    with pytest.raises(DataError, match=r"1 of 2 training samples .* the first is sample 1\."):
        fit_at_once(Model([Squares()], Shares()), batches(data), 0)


def test_a_head_fitted_at_once_gives_no_gradient_to_what_is_before_it():
    learned = build("encoder", resolve("encoder", "mlp"), input_shape=(2,))
    with pytest.raises(
        ConfigError, match=r"Shares is fitted to all features at once .* Squares and MLP have parameters"
    ):
        Model([Squares(), learned], Shares())


def test_runs_on_other_features_do_not_join():
    first, other = (FrozenFrontEnd([Squares(factor)], Model([], Shares())) for factor in (2.0, 3.0))
    whole = FrozenFrontEnd([Squares()], Model([], Shares()))
    assert _inner_predictor(whole, first, 0) is first.predictor
    assert whole.encoders[0].factor == 2.0
    with pytest.raises(CheckpointError, match=r"Member 1 .* differ in 0\.factor"):
        _inner_predictor(whole, other, 1)
