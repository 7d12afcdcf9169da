import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special
from scipy.stats import entropy, mannwhitneyu, sem
from sklearn.metrics import average_precision_score, roc_auc_score, roc_curve
from torch.distributions import Categorical, Distribution, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import UserError
from framework.prediction import Prediction
from plugins.metric.out_of_distribution.metric import OutOfDistribution, ranking, uncertainty_score


class Known(Distribution):
    """Density with given entropies."""

    arg_constraints = {}  # noqa: RUF012 - as torch has it

    def __init__(self, entropies):
        self.values = torch.as_tensor(entropies)
        super().__init__(self.values.shape, torch.Size((1,)), validate_args=False)

    def entropy(self):
        return self.values


def compute_metric(outliers, test, **config):
    """Return the results for densities of the outliers and of the test split, each a list of batches."""
    metric = build("metric", resolve("metric", {"name": "out_of_distribution", **config}))
    for density in test:
        metric.update(Prediction(density, {}))
    for density in outliers:
        metric.update(Prediction(density, {}, split="outliers"))
    return {name: value.item() for name, value in metric.compute().items()}


def rank(outliers, test):
    pair = (torch.tensor(numbers, dtype=torch.float64) for numbers in (outliers, test))
    return {name: value.item() for name, value in ranking(*pair).items() if name != "auroc_sem"}


def loops(outliers, test):
    """Return the results by their definitions, one pair and one threshold at a time."""
    wins = [(o > t) + 0.5 * (o == t) for o in outliers for t in test]
    precision, fpr = [], None
    for score in outliers:
        above = sum(o >= score for o in outliers)
        precision.append(above / (above + sum(t >= score for t in test)))
    for threshold in sorted(set(outliers), reverse=True):
        if fpr is None and 100 * sum(o >= threshold for o in outliers) >= 95 * len(outliers):
            fpr = sum(t >= threshold for t in test) / len(test)
    return {"auroc": np.mean(wins), "aupr": np.mean(precision), "fpr95": fpr}


scores = st.sampled_from([0.0, -0.0, 1.0, 2.0, -1e300]) | st.floats(-3, 3)


@settings(deadline=None, max_examples=150)
@given(st.lists(scores, min_size=1, max_size=50), st.lists(scores, min_size=1, max_size=50))
def test_rankings_equal_sklearns(outliers, test):
    actual = rank(outliers, test)
    truth, score = [1] * len(outliers) + [0] * len(test), [*outliers, *test]
    assert actual["auroc"] == pytest.approx(roc_auc_score(truth, score), abs=1e-12)
    assert actual["aupr"] == pytest.approx(average_precision_score(truth, score), abs=1e-12)
    false, true, _ = roc_curve(truth, score, drop_intermediate=False)
    assert actual["fpr95"] == pytest.approx(false[true >= 0.95].min(), abs=1e-12)
    assert actual == pytest.approx(loops(outliers, test), abs=1e-12)


@settings(deadline=None, max_examples=100)
@given(
    st.lists(st.sampled_from([-math.inf, math.inf, 0.0, 1.0]), min_size=1, max_size=45),
    st.lists(st.sampled_from([-math.inf, math.inf, 0.0, 1.0]), min_size=1, max_size=45),
)
def test_infinite_scores_are_ranked_like_others(outliers, test):
    assert rank(outliers, test) == pytest.approx(loops(outliers, test), abs=1e-12)


def test_auroc_equals_scipys_mann_whitney():
    generator = np.random.default_rng(0)
    outliers, test = generator.integers(0, 9, 300) + 1.0, generator.integers(0, 9, 700) * 1.0
    wanted = mannwhitneyu(outliers, test).statistic / (300 * 700)
    assert rank(outliers, test)["auroc"] == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("count", range(1, 121))
def test_fpr95_detects_at_least_95_per_cent_of_the_outliers(count):
    # test samples equal the outliers, so the false positive rate equals the share of detected outliers
    outliers = [float(number) for number in range(count)]
    actual = rank(outliers, outliers)["fpr95"]
    assert actual == pytest.approx(math.ceil(95 * count / 100 - 1e-9) / count, abs=1e-15)


def test_rankings_of_equal_and_of_separated_scores():
    assert rank([1.0] * 4, [1.0] * 12) == {"auroc": 0.5, "aupr": 0.25, "fpr95": 1.0}
    assert rank([2.0] * 4, [1.0] * 12) == {"auroc": 1.0, "aupr": 1.0, "fpr95": 0.0}
    assert rank([0.0] * 4, [1.0] * 12) == {"auroc": 0.0, "aupr": 0.25, "fpr95": 1.0}
    assert rank([0.0], [0.0]) == {"auroc": 0.5, "aupr": 0.5, "fpr95": 1.0}


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-12)])
@pytest.mark.parametrize("score", ["entropy", "confidence"])
@pytest.mark.parametrize("count", [2, 10])
def test_results_for_classes_equal_scipy_and_sklearn(dtype, tolerance, score, count):
    generator = np.random.default_rng(count)
    outliers, test = 2 * generator.normal(size=(40, count)), 4 * generator.normal(size=(130, count))
    logits = [torch.tensor(values, dtype=dtype) for values in (outliers, test)]
    actual = compute_metric(
        *([Categorical(logits=part) for part in values.split(17)] for values in logits), score=score
    )
    probabilities = [special.softmax(values.double().numpy(), -1) for values in logits]
    nats = [entropy(values, axis=-1) for values in probabilities]
    assert actual["ood_entropy"] == pytest.approx(nats[0].mean(), rel=tolerance)
    assert actual["ood_entropy_sem"] == pytest.approx(sem(nats[0]), rel=10 * tolerance)
    assert actual["entropy_test"] == pytest.approx(nats[1].mean(), rel=tolerance)
    value = np.concatenate(nats if score == "entropy" else [-values.max(-1) for values in probabilities])
    truth = [1] * 40 + [0] * 130
    assert actual["auroc"] == pytest.approx(roc_auc_score(truth, value), abs=1e-12)
    assert actual["aupr"] == pytest.approx(average_precision_score(truth, value), abs=1e-12)
    false, true, _ = roc_curve(truth, value, drop_intermediate=False)
    assert actual["fpr95"] == pytest.approx(false[true >= 0.95].min(), abs=1e-12)


def test_almost_certain_samples_keep_their_order():
    # 1 - p is 1e-22 and 1e-18 here, so p itself rounds to 1 in float64
    test, outliers = torch.tensor([[50.0, 0.0]]), torch.tensor([[42.0, 0.0]])
    actual = compute_metric([Categorical(logits=outliers)], [Categorical(logits=test)], score="confidence")
    assert actual["auroc"] == 1
    torch.testing.assert_close(
        uncertainty_score(Categorical(logits=test)).log(), torch.tensor([-50.0]).double()
    )


def test_equal_certainty_of_different_classes_ties():
    certain = Categorical(logits=torch.tensor([[1e4, -1e4, -1e4], [-1e4, 1e4, -1e4]]))
    assert uncertainty_score(certain).tolist() == [0.0, 0.0]
    actual = compute_metric([certain], [certain])
    assert (actual["auroc"], actual["aupr"], actual["fpr95"], actual["ood_entropy"]) == (0.5, 0.5, 1.0, 0.0)


@pytest.mark.parametrize("score", ["entropy", "confidence"])
def test_real_numbers_are_ranked_by_their_spread(score):
    def density(scale):
        return Independent(Normal(torch.zeros(len(scale), 2), torch.tensor(scale)[:, None].expand(-1, 2)), 1)

    outliers, test = [1.0, 3.0, 5.0], [0.5, 1.0, 2.0, 4.0]
    actual = compute_metric([density(outliers)], [density(test)], score=score)
    assert actual["ood_entropy"] == pytest.approx(
        np.mean([math.log(2 * math.pi * math.e * scale**2) for scale in outliers]), rel=1e-6
    )
    # both the entropy and the log-density at the mode have the order of σ
    wanted = loops(outliers, test)
    assert {name: actual[name] for name in wanted} == pytest.approx(wanted)


def test_a_mixture_whose_members_disagree_is_uncertain():
    members = torch.tensor([[[40.0, 0.0], [0.0, 40.0]]])
    outliers = Mixture(torch.zeros(1, 2), Categorical(logits=members))
    test = Mixture(torch.zeros(1, 2), Categorical(logits=members[:, :1].expand(1, 2, 2)))
    for score in ("entropy", "confidence"):
        actual = compute_metric([outliers], [test], score=score)
        assert actual["ood_entropy"] == pytest.approx(math.log(2), rel=1e-6)
        assert actual["auroc"] == 1


def test_outliers_or_test_samples_alone_have_no_ranking():
    nothing, nothing_seen = {"auroc", "auroc_sem", "aupr", "fpr95"}, Known(torch.zeros(0))
    actual = compute_metric([], [Known([1.0, 3.0])])
    assert actual["entropy_test"] == 2 and {key for key in actual if math.isnan(actual[key])} == nothing | {
        "ood_entropy",
        "ood_entropy_sem",
    }
    actual = compute_metric([Known([1.0, 3.0]), nothing_seen], [nothing_seen])
    assert actual["ood_entropy"] == 2 and actual["ood_entropy_sem"] == pytest.approx(1)
    assert {key for key in actual if math.isnan(actual[key])} == nothing | {"entropy_test"}
    assert all(math.isnan(value) for value in compute_metric([nothing_seen], [nothing_seen]).values())
    assert math.isnan(compute_metric([Known([1.0])], [])["ood_entropy_sem"])


def test_infinite_entropies_make_the_mean_infinite_and_rank():
    actual = compute_metric([Known([1.0, math.inf])], [Known([-math.inf, 1.0])])
    assert (actual["ood_entropy"], actual["entropy_test"], actual["auroc"]) == (math.inf, -math.inf, 0.875)


def test_nan_raises_a_message_with_the_split():
    with pytest.raises(
        UserError, match="2 of 3 entropies of outliers in this batch are NaN, the first in row 0"
    ):
        compute_metric([Known([math.nan, 1.0, math.nan])], [])
    with pytest.raises(UserError, match="1 of 1 entropies of the test split"):
        compute_metric([], [Known([math.nan])])
    broken = Independent(
        Normal(torch.tensor([[torch.nan]]), torch.ones(1, 1), validate_args=False), 1, validate_args=False
    )
    with pytest.raises(UserError, match="1 of 1 confidences in outliers"):
        compute_metric([broken], [], score="confidence")


def test_the_metric_reads_the_splits_test_and_outliers():
    assert OutOfDistribution.splits == ("test", "outliers")


def test_the_error_of_auroc_is_that_of_the_definition_and_of_repeated_draws():
    generator = torch.Generator().manual_seed(0)

    def scores(count, shift):
        return (2 * (torch.randn(count, generator=generator) + shift)).round().double()  # with equal scores

    outliers, test = scores(40, 0.8), scores(60, 0.0)
    wins = (outliers[:, None] > test).double() + 0.5 * (outliers[:, None] == test)
    variance = wins.mean(1).var() / 40 + wins.mean(0).var() / 60  # DeLong et al. 1988
    assert ranking(outliers, test)["auroc_sem"].item() == pytest.approx(variance.sqrt().item(), rel=1e-12)
    draws = [ranking(scores(40, 0.8), scores(60, 0.0)) for _ in range(2000)]
    spread = torch.stack([draw["auroc"] for draw in draws]).std()
    assert torch.stack([draw["auroc_sem"] for draw in draws]).mean() == pytest.approx(spread.item(), rel=0.05)


def test_members_that_disagree_are_outliers_by_mutual_information():
    def members(logits):
        mixture = Mixture(
            torch.zeros(logits.shape[:2]).double(), Categorical(logits=logits, validate_args=False)
        )
        mixture.over_models = True
        return mixture

    disagree = members(torch.tensor([[[9.0, 0.0, -9.0], [0.0, 9.0, -9.0]]]).double())
    undecided = members(torch.zeros(1, 2, 3).double())
    results = compute_metric([disagree], [undecided], score="mutual_information")
    assert results["auroc"] == 1 and compute_metric([disagree], [undecided])["auroc"] == 0
