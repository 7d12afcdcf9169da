import numpy as np
import pytest
import torch
import xgboost
from scipy import special, stats

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.target import Target

FOUR = Target("class", ("a", "b", "c", "d"))
TWO = Target("real", ("x", "y"))


def build_head(target, **config):
    return build("density_head", resolve("density_head", {"name": "xgboost", **config}), target=target)


def fit_head(target, seed=0, **config):
    """Return a head and its training data: features that are informative about the target."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(300, 5, generator=generator)
    if target.kind == "class":
        wanted = (features[:, 0] > 0).long() + 2 * (features[:, 1] > 0).long()
    else:
        wanted = features[:, :2] @ torch.tensor([[1.0, 0.5], [-1.0, 2.0]])
        wanted = (wanted + 0.1 * torch.randn(300, 2, generator=generator))[:, : len(target.names)]
    head = build_head(target, **{"rounds": 8, **config})
    head.fit(features, wanted, 5)
    return head, features, wanted


OPTIONS = {"tree_method": "hist", "nthread": 1, "seed": 5, "max_depth": 3, "learning_rate": 0.2}


def test_class_probabilities_are_the_librarys():
    head, features, label = fit_head(FOUR, depth=3, rate=0.2)
    options = {**OPTIONS, "objective": "multi:softprob", "num_class": 4}
    booster = xgboost.train(options, xgboost.DMatrix(features.numpy(), label.numpy()), 8)
    queries = torch.randn(100, 5)
    for rounds in (1, 3, 8, 100):
        head.rounds = rounds
        wanted = booster.predict(xgboost.DMatrix(queries.numpy()), iteration_range=(0, min(rounds, 8)))
        np.testing.assert_allclose(head(queries).probs.numpy(), wanted, rtol=2e-6)
        sums = booster.predict(
            xgboost.DMatrix(queries.numpy()), iteration_range=(0, min(rounds, 8)), output_margin=True
        )
        exact = special.log_softmax(sums.astype(np.float64), -1)
        np.testing.assert_allclose(head(queries.double()).logits.numpy(), exact, rtol=1e-12)


@pytest.mark.parametrize("target", [TWO, Target("real", ("x",))], ids=["two", "one"])
def test_reals_are_normal_about_the_librarys_prediction(target):
    head, features, wanted = fit_head(target, depth=3, rate=0.2)
    numbers = len(target.names)
    booster = xgboost.train(
        {**OPTIONS, "objective": "reg:squarederror"}, xgboost.DMatrix(features.numpy(), wanted.numpy()), 8
    )
    _, queries, value = fit_head(target, seed=3)
    mean = booster.predict(xgboost.DMatrix(queries.numpy())).reshape(-1, numbers).astype(np.float64)
    inside = booster.predict(xgboost.DMatrix(features.numpy())).reshape(-1, numbers)
    spread = np.sqrt(np.square(wanted.double().numpy() - inside).mean(0))
    np.testing.assert_allclose(head.width.numpy(), spread, rtol=1e-9)
    head.calibrate(queries, value)
    spread = np.sqrt(np.square(value.double().numpy() - mean).mean(0))
    np.testing.assert_allclose(head.width.numpy(), spread, rtol=1e-9)
    expected = stats.norm.logpdf(value.double().numpy(), mean, spread).sum(-1)
    np.testing.assert_allclose(head(queries.double()).log_prob(value.double()).numpy(), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="this split is empty"):
        head.calibrate(queries[:0], value[:0])


def test_the_seed_decides_what_is_drawn():
    queries = torch.randn(30, 5)
    first, again = (fit_head(FOUR, samples=0.5, features=0.5)[0](queries).logits for _ in range(2))
    assert torch.equal(first, again)
    other, features, label = fit_head(FOUR, samples=0.5, features=0.5)
    other.fit(features, label, 6)
    assert not torch.equal(other(queries).logits, first)


def test_a_class_that_does_not_occur_keeps_a_probability():
    head = build_head(FOUR, rounds=3)
    features, label = torch.randn(60, 3), torch.arange(60) % 2 * 3  # 0 and 3
    head.fit(features, label, 0)
    assert head(features).probs.shape == (60, 4)
    assert (head(features).probs > 0).all()


def test_a_single_class_is_refused():
    with pytest.raises(ConfigError, match="has one, only"):
        build_head(Target("class", ("only",)))


@pytest.mark.parametrize(
    "config", [{"rounds": 0}, {"rate": 0}, {"samples": 1.5}, {"weight": -1}, {"round": 3}]
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"density_head\."):
        resolve("density_head", {"name": "xgboost", **config})
