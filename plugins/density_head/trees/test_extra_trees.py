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
from plugins.density_head.trees.extra_trees import fit_width
from plugins.density_head.trees.forest import at_most, frequencies, leaves

FOUR = Target("class", ("a", "b", "c", "d"))
TWO = Target("real", ("x", "y"))
wild = settings(deadline=None, max_examples=40, derandomize=True)


def build_head(target, **config):
    return build("density_head", resolve("density_head", {"name": "extra_trees", **config}), target=target)


def fit_head(target, count=300, size=6, seed=0, **config):
    """Return a head and its training data: features that are informative about the target."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(count, size, generator=generator)
    if target.kind == "class":
        wanted = (features[:, 0] > 0).long() + 2 * (features[:, 1] > 0).long()
    else:
        wanted = features[:, :2] @ torch.tensor([[1.0, 0.5], [-1.0, 2.0]])
        wanted = (wanted + 0.1 * torch.randn(count, 2, generator=generator))[:, : len(target.names)]
    head = build_head(target, **config)
    head.fit(features, wanted, 5)
    return head, features, wanted


def shares(head, features):
    """Return the forest's shares of classes before smoothing."""
    leaf = leaves(
        features, *(part.numpy() for part in (head.feature, head.threshold, head.branch, head.root))
    )
    return frequencies(leaf, *(part.numpy() for part in (head.start, head.label, head.count)), head.classes)


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
    head, features, wanted = fit_head(FOUR, trees=25, **config)
    forest = ExtraTreesClassifier(25, random_state=5, n_jobs=1, **options).fit(features, wanted)
    queries = torch.cat([features, torch.randn(500, 6)]).numpy()
    assert np.array_equal(shares(head, queries), forest.predict_proba(queries))


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
    head, label = build_head(FOUR, trees=3), torch.arange(30) % 4
    head.fit(torch.from_numpy(features), label, 1)
    forest = ExtraTreesClassifier(3, random_state=1, n_jobs=1).fit(features, label)
    assert np.array_equal(shares(head, features), forest.predict_proba(features))
    near = np.nextafter(features, np.float32(0))
    assert np.array_equal(shares(head, near), forest.predict_proba(near))


@wild
@given(st.floats(-(2.0**126), 2.0**126), st.floats(-(2.0**126), 2.0**126, width=32))
def test_a_rounded_threshold_sends_every_float32_the_same_way(threshold, number):
    rounded = at_most(np.array([threshold]))[0]
    assert rounded.dtype == np.float32
    for near in (np.float32(number), rounded, np.nextafter(rounded, np.float32(np.inf))):
        assert (near <= rounded) == (np.float64(near) <= threshold)


def test_smoothing_is_laplaces_rule_on_the_votes():
    head, _, _ = fit_head(FOUR, trees=25, smoothing=0.7)
    queries = torch.randn(50, 6)
    share = shares(head, queries.numpy())
    wanted = (25 * share + 0.7) / (25 + 0.7 * 4)
    np.testing.assert_allclose(head(queries.double()).probs.numpy(), wanted, rtol=1e-12)
    np.testing.assert_allclose(head(queries).probs.numpy(), wanted, rtol=1e-5)
    assert (share == 0).any()
    assert head(queries).log_prob(torch.arange(4)[:, None]).isfinite().all()
    np.testing.assert_array_equal(
        head(queries).mode.numpy()[share.max(1) > 0.5], share.argmax(1)[share.max(1) > 0.5]
    )


def test_a_class_that_does_not_occur_is_the_least_likely():
    head = build_head(FOUR, trees=10)
    features, label = torch.randn(60, 3), torch.arange(60) % 2 * 3  # 0 and 3
    head.fit(features, label, 0)
    probabilities = head(features).probs
    assert probabilities.shape == (60, 4)
    assert (probabilities[:, 1:3] > 0).all() and (probabilities[:, 1] == probabilities[:, 2]).all()
    assert torch.equal(probabilities.argmax(1), label)


@pytest.mark.parametrize("target", [TWO, Target("real", ("x",))], ids=["two", "one"])
def test_components_are_normal_about_each_trees_mean(target):
    head, features, wanted = fit_head(target, trees=9)
    forest = ExtraTreesRegressor(9, random_state=5, n_jobs=1)
    forest.fit(features, wanted.double() if len(target.names) > 1 else wanted[:, 0].double())
    queries = torch.randn(20, 6)
    means = np.stack([tree.predict(queries.numpy()).reshape(20, -1) for tree in forest.estimators_], 1)
    density = head(queries.double())
    np.testing.assert_array_equal(density.components.mean.numpy(), means)
    value = torch.randn(20, len(target.names), dtype=torch.float64)
    density_of_mixture = stats.norm.pdf(value[:, None].numpy(), means, head.width.numpy()).prod(-1).mean(1)
    np.testing.assert_allclose(density.log_prob(value).numpy(), np.log(density_of_mixture), rtol=1e-10)


def test_widths_before_calibration_are_the_targets_own_spread():
    head, _, wanted = fit_head(TWO, trees=3)
    np.testing.assert_allclose(head.width.numpy(), wanted.double().numpy().std(0), rtol=1e-12)


def test_calibrated_widths_are_the_likeliest():
    head, _, _ = fit_head(TWO, trees=20)
    _, features, wanted = fit_head(TWO, trees=1, seed=9)
    head.calibrate(features, wanted)
    means = head(features.double()).components.mean.numpy()
    residual = wanted.double().numpy()[:, None] - means

    def surprise(logarithms):
        exponents = stats.norm.logpdf(residual, 0, np.exp(logarithms)).sum(-1)
        return -np.logaddexp.reduce(exponents, 1).mean()

    best = optimize.minimize(
        surprise, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12}
    )
    np.testing.assert_allclose(head.width.numpy(), np.exp(best.x), rtol=2e-4)
    assert surprise(np.log(head.width.numpy())) <= best.fun + 1e-8


def test_widths_do_not_fall_below_the_floor():
    assert fit_width(torch.zeros(5, 3, 2, dtype=torch.float64)).tolist() == pytest.approx([1e-4, 1e-4])
    with pytest.raises(ValueError, match="this split is empty"):
        fit_head(TWO, trees=2)[0].calibrate(torch.zeros(0, 6), torch.zeros(0, 2))


def test_the_first_trees_are_a_smaller_forest():
    head, _, _ = fit_head(FOUR, trees=20)
    small, _, _ = fit_head(FOUR, trees=20)
    small.trees = 4
    queries = torch.randn(30, 6)
    head.root = head.root[:4]
    assert torch.equal(small(queries).logits, head(queries).logits)
    small.trees = 1000
    assert torch.equal(small(queries).logits, fit_head(FOUR, trees=20)[0](queries).logits)


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
    head, features, _ = fit_head(FOUR, trees=5)
    names = [str(tmp_path / name) for name in ("state", "features", "logits")]
    torch.save(head.state_dict(), names[0])
    torch.save(features, names[1])
    subprocess.run([sys.executable, "-c", WITHOUT, *names], check=True, timeout=120)
    assert torch.equal(torch.load(names[2], weights_only=True), head(features).logits)


def test_one_sample_and_constant_features():
    head = build_head(FOUR, trees=3)
    head.fit(torch.zeros(1, 2), torch.tensor([2]), 0)
    assert head(torch.randn(3, 2)).mode.tolist() == [2, 2, 2]
    head.fit(torch.ones(40, 2), torch.arange(40) % 4, 0)
    torch.testing.assert_close(head(torch.randn(3, 2)).probs, torch.full((3, 4), 0.25))


@pytest.mark.parametrize(
    "config", [{"trees": 0}, {"features": 0}, {"features": 1.5}, {"smoothing": 0}, {"tree": 3}]
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"density_head\."):
        resolve("density_head", {"name": "extra_trees", **config})
