import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import optimize, stats
from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.target import Target
from plugins.density_head.trees.extra_trees import fitted_width
from plugins.density_head.trees.forest import at_most, frequencies, leaves

FOUR = Target("class", ("a", "b", "c", "d"))
TWO = Target("real", ("x", "y"))
wild = settings(deadline=None, max_examples=40, derandomize=True)


def head(target, **config):
    return build("density_head", resolve("density_head", {"name": "extra_trees", **config}), target=target)


def fitted(target, count=300, size=6, seed=0, **config):
    """Return a head and its training data: features that are informative about the target."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(count, size, generator=generator)
    if target.kind == "class":
        wanted = (features[:, 0] > 0).long() + 2 * (features[:, 1] > 0).long()
    else:
        wanted = features[:, :2] @ torch.tensor([[1.0, 0.5], [-1.0, 2.0]])
        wanted = (wanted + 0.1 * torch.randn(count, 2, generator=generator))[:, : len(target.names)]
    made = head(target, **config)
    made.fit(features, wanted, 5)
    return made, features, wanted


def shares(made, features):
    """Return the forest's shares of classes before smoothing."""
    leaf = leaves(
        features, *(part.numpy() for part in (made.feature, made.threshold, made.branch, made.root))
    )
    return frequencies(leaf, *(part.numpy() for part in (made.start, made.label, made.count)), made.classes)


@pytest.mark.parametrize(
    "config, options",
    [
        ({}, {}),
        ({"leaf": 4}, {"min_samples_leaf": 4}),
        ({"depth": 3}, {"max_depth": 3}),
        ({"features": 0.5}, {"max_features": 0.5}),
    ],
    ids=str,
)
def test_shares_are_scikit_learns_to_the_bit(config, options):
    made, features, wanted = fitted(FOUR, trees=25, **config)
    forest = ExtraTreesClassifier(25, random_state=5, n_jobs=1, **options).fit(features, wanted)
    asked = torch.cat([features, torch.randn(500, 6)]).numpy()
    assert np.array_equal(shares(made, asked), forest.predict_proba(asked))


@wild
@given(
    arrays.arrays(
        np.float32,
        (30, 3),
        elements=st.floats(width=32, allow_nan=False, allow_infinity=False)
        | st.sampled_from([0.0, -0.0, 1.0]),
    )
)
def test_shares_are_scikit_learns_on_wild_features(features):
    made, label = head(FOUR, trees=3), torch.arange(30) % 4
    made.fit(torch.from_numpy(features), label, 1)
    forest = ExtraTreesClassifier(3, random_state=1, n_jobs=1).fit(features, label)
    assert np.array_equal(shares(made, features), forest.predict_proba(features))
    near = np.nextafter(features, np.float32(0))
    assert np.array_equal(shares(made, near), forest.predict_proba(near))


@wild
@given(st.floats(-(2.0**126), 2.0**126), st.floats(-(2.0**126), 2.0**126, width=32))
def test_a_rounded_threshold_sends_every_float32_the_same_way(threshold, number):
    rounded = at_most(np.array([threshold]))[0]
    assert rounded.dtype == np.float32
    for near in (np.float32(number), rounded, np.nextafter(rounded, np.float32(np.inf))):
        assert (near <= rounded) == (np.float64(near) <= threshold)


def test_smoothing_is_laplaces_rule_on_the_votes():
    made, _, _ = fitted(FOUR, trees=25, smoothing=0.7)
    asked = torch.randn(50, 6)
    share = shares(made, asked.numpy())
    wanted = (25 * share + 0.7) / (25 + 0.7 * 4)
    np.testing.assert_allclose(made(asked.double()).probs.numpy(), wanted, rtol=1e-12)
    np.testing.assert_allclose(made(asked).probs.numpy(), wanted, rtol=1e-5)
    assert (share == 0).any()
    assert made(asked).log_prob(torch.arange(4)[:, None]).isfinite().all()
    np.testing.assert_array_equal(
        made(asked).mode.numpy()[share.max(1) > 0.5], share.argmax(1)[share.max(1) > 0.5]
    )


def test_a_class_that_does_not_occur_is_the_least_likely():
    made = head(FOUR, trees=10)
    features, label = torch.randn(60, 3), torch.arange(60) % 2 * 3  # 0 and 3
    made.fit(features, label, 0)
    found = made(features).probs
    assert found.shape == (60, 4)
    assert (found[:, 1:3] > 0).all() and (found[:, 1] == found[:, 2]).all()
    assert torch.equal(found.argmax(1), label)


@pytest.mark.parametrize("target", [TWO, Target("real", ("x",))], ids=["two", "one"])
def test_components_are_normal_about_each_trees_mean(target):
    made, features, wanted = fitted(target, trees=9)
    forest = ExtraTreesRegressor(9, random_state=5, n_jobs=1)
    forest.fit(features, wanted.double() if len(target.names) > 1 else wanted[:, 0].double())
    asked = torch.randn(20, 6)
    means = np.stack([tree.predict(asked.numpy()).reshape(20, -1) for tree in forest.estimators_], 1)
    density = made(asked.double())
    np.testing.assert_array_equal(density.components.mean.numpy(), means)
    value = torch.randn(20, len(target.names), dtype=torch.float64)
    each = stats.norm.pdf(value[:, None].numpy(), means, made.width.numpy()).prod(-1).mean(1)
    np.testing.assert_allclose(density.log_prob(value).numpy(), np.log(each), rtol=1e-10)


def test_widths_before_calibration_are_the_targets_own_spread():
    made, _, wanted = fitted(TWO, trees=3)
    np.testing.assert_allclose(made.width.numpy(), wanted.double().numpy().std(0), rtol=1e-12)


def test_calibrated_widths_are_the_likeliest():
    made, _, _ = fitted(TWO, trees=20)
    _, features, wanted = fitted(TWO, trees=1, seed=9)
    made.calibrate(features, wanted)
    means = made(features.double()).components.mean.numpy()
    residual = wanted.double().numpy()[:, None] - means

    def surprise(logarithms):
        exponents = stats.norm.logpdf(residual, 0, np.exp(logarithms)).sum(-1)
        return -np.logaddexp.reduce(exponents, 1).mean()

    best = optimize.minimize(
        surprise, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12}
    )
    np.testing.assert_allclose(made.width.numpy(), np.exp(best.x), rtol=2e-4)
    assert surprise(np.log(made.width.numpy())) <= best.fun + 1e-8


def test_widths_do_not_fall_below_the_floor():
    assert fitted_width(torch.zeros(5, 3, 2, dtype=torch.float64)).tolist() == pytest.approx([1e-4, 1e-4])
    with pytest.raises(ValueError, match="got none of it"):
        fitted(TWO, trees=2)[0].calibrate(torch.zeros(0, 6), torch.zeros(0, 2))


def test_the_first_trees_are_a_smaller_forest():
    made, _, _ = fitted(FOUR, trees=20)
    small, _, _ = fitted(FOUR, trees=20)
    small.trees = 4
    asked = torch.randn(30, 6)
    made.root = made.root[:4]
    assert torch.equal(small(asked).logits, made(asked).logits)
    small.trees = 1000
    assert torch.equal(small(asked).logits, fitted(FOUR, trees=20)[0](asked).logits)


WITHOUT = """
import sys
sys.modules["sklearn"] = None  # importing it fails
import torch
from framework.target import Target
from plugins.density_head.trees.extra_trees import ExtraTreesHead
head = ExtraTreesHead(Target("class", ("a", "b", "c", "d")))
head.load_state_dict(torch.load(sys.argv[1], weights_only=True))
torch.save(head(torch.load(sys.argv[2], weights_only=True)).logits, sys.argv[3])
"""


def test_a_stored_forest_needs_no_scikit_learn(tmp_path):
    made, features, _ = fitted(FOUR, trees=5)
    names = [str(tmp_path / name) for name in ("state", "features", "logits")]
    torch.save(made.state_dict(), names[0])
    torch.save(features, names[1])
    subprocess.run([sys.executable, "-c", WITHOUT, *names], check=True, timeout=120)
    assert torch.equal(torch.load(names[2], weights_only=True), made(features).logits)


def test_one_sample_and_constant_features():
    made = head(FOUR, trees=3)
    made.fit(torch.zeros(1, 2), torch.tensor([2]), 0)
    assert made(torch.randn(3, 2)).mode.tolist() == [2, 2, 2]
    made.fit(torch.ones(40, 2), torch.arange(40) % 4, 0)
    torch.testing.assert_close(made(torch.randn(3, 2)).probs, torch.full((3, 4), 0.25))


@pytest.mark.parametrize(
    "config", [{"trees": 0}, {"features": 0}, {"features": 1.5}, {"smoothing": 0}, {"tree": 3}]
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"density_head\."):
        resolve("density_head", {"name": "extra_trees", **config})
