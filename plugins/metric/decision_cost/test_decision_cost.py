import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from torch.distributions import Categorical, HalfNormal, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError, DataError, UserError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.decision_cost.functional import (
    decide,
    decide_by_draws,
    expected_costs,
    region_probabilities,
    regions,
)
from plugins.metric.decision_cost.metric import DecisionCost
from plugins.metric.decision_cost.rows import ASK

WIDE = torch.float64
THREE = Target("class", ("empty", "far", "near"))
ANGLE = Target("angle", ("azimuth",))
REAL = Target("real", ("height",))


def compute_metric(target, density, value, **config):
    metric = build("metric", resolve("metric", {"name": "decision_cost", **config}), target=target)
    for part in torch.arange(len(value)).split(5):
        metric.update(Prediction(density(part), {"target": value[part]}))
    return {name: number.item() for name, number in metric.compute().items()}


COSTS = st.one_of(st.floats(0, 10), st.sampled_from([0.0, 1e30, 1e-30, -5.0, math.inf]))


@settings(deadline=None, max_examples=80)
@given(st.lists(st.lists(COSTS, min_size=3, max_size=3), min_size=4, max_size=4), st.data())
def test_expected_costs_and_decisions_equal_a_loop(columns, data):
    table = [list(row) for row in zip(*columns, strict=True)]  # 3 truths × 4 actions
    counts = data.draw(st.lists(st.integers(0, 3), min_size=3, max_size=3).filter(any))
    probability = [count / sum(counts) for count in counts]
    wanted = [
        sum(p * table[truth][action] for truth, p in enumerate(probability) if p > 0) for action in range(4)
    ]
    actual = expected_costs(torch.tensor([probability], dtype=WIDE), torch.tensor(table, dtype=WIDE))
    np.testing.assert_allclose(actual[0].numpy(), wanted, rtol=1e-12)
    chosen = decide(actual)[0].item()
    assert actual[0, chosen] == actual[0].min()
    assert not any(actual[0, before] == actual[0, chosen] for before in range(chosen))


def test_the_first_of_equal_actions_is_chosen_and_forbidden_ones_are_avoided():
    assert decide(torch.tensor([[2.0, 1.0, 1.0], [math.inf, 1e30, math.inf], [math.inf] * 3])).tolist() == [
        1,
        1,
        0,
    ]
    assert decide(torch.zeros(2, 3, 4)).shape == (2, 3)
    with pytest.raises(UserError, match="1 of 2 expected costs in this batch are NaN, the first in row 1"):
        decide(torch.tensor([[1.0, 2.0], [math.nan, 0.0]]))


def test_results_for_classes_equal_a_computation_by_hand():
    probability = torch.tensor([[1.0, 0, 0], [0.7, 0.3, 0], [0.1, 0.5, 0.4], [0.3, 0.4, 0.3], [0, 0, 1.0]])
    label = torch.tensor([0, 1, 2, 0, 2])
    # go costs (0, 1e3, inf), slow down (1, 0, 1), stop (5, 1, 0), ask (2, 2, 2)
    actual = compute_metric(THREE, lambda part: Categorical(probs=probability[part].double()), label, **ASK)
    # go; slow down (0.7); slow down (0.5); slow down (0.6); stop. torch replaces p = 0 by 2e-16, so an infinite cost
    # excludes the action
    assert actual["share_go"] == 0.0
    sure = [[1.0, 0, 0], [0.7, 0.3, 0], [0.1, 0.5, 0.4], [0.3, 0.4, 0.3], [0, 0, 1.0]]
    logits = torch.tensor(sure, dtype=WIDE).log()
    actual = compute_metric(
        THREE, lambda part: Categorical(logits=logits[part], validate_args=False), label, **ASK
    )
    assert actual["decision_cost"] == pytest.approx((0 + 0 + 1 + 1 + 0) / 5)
    assert actual["decision_cost_fixed"] == pytest.approx(
        min(4, (1 + 0 + 1 + 1 + 1) / 5, (5 + 1 + 0 + 5 + 0) / 5, 2)
    )
    assert actual["decision_cost_oracle"] == 0.0
    shares = {"share_go": 0.2, "share_slow_down": 0.6, "share_stop": 0.2, "share_ask_a_person": 0.0}
    assert {name: actual[name] for name in shares} == pytest.approx(shares)


def test_the_default_costs_are_the_error_rate_of_the_mode():
    torch.manual_seed(0)
    logits, label = torch.randn(60, 3), torch.randint(3, (60,))
    actual = compute_metric(THREE, lambda part: Categorical(logits=logits[part]), label)
    assert actual["decision_cost"] == pytest.approx((logits.argmax(-1) != label).double().mean().item())
    assert actual["decision_cost_fixed"] == pytest.approx(1 - torch.bincount(label).max().item() / 60)
    assert {name for name in actual if name.startswith("share")} == {"share_empty", "share_far", "share_near"}


def test_a_huge_cost_decides_at_any_probability():
    table = [[0.0, 1.0], [1e30, 0.0]]
    logits = torch.tensor([[0.0, -60.0], [0.0, -80.0]], dtype=WIDE)  # 1e30 · e^-60 = 8.8e3, e^-80: 1.8e-5
    actual = expected_costs(logits.softmax(-1), torch.tensor(table, dtype=WIDE))
    np.testing.assert_allclose(actual[:, 0].numpy(), 1e30 * np.exp([-60.0, -80.0]), rtol=1e-10)
    assert decide(actual).tolist() == [1, 0]


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (WIDE, 1e-13)])
def test_masses_of_intervals_equal_scipys(dtype, tolerance):
    torch.manual_seed(1)
    mean = torch.randn(5, 2, 1, dtype=dtype)
    density = Mixture(torch.zeros(5, 2, dtype=dtype), Independent(Normal(mean, torch.ones_like(mean)), 1))
    edges = torch.tensor([-1.0, 0.5, 2.0], dtype=WIDE)
    below = stats.norm.cdf(edges.numpy() - mean.double().numpy()).mean(1)
    wanted = np.diff(np.pad(below, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1))), axis=1)
    actual = region_probabilities(density, edges, 10)
    np.testing.assert_allclose(actual.numpy(), wanted, atol=tolerance)
    assert regions(torch.tensor([-9.0, -1.0, 0.0, 0.5, 9.0]), edges, around=False).tolist() == [0, 1, 1, 2, 3]


@pytest.mark.parametrize("dtype", [torch.float32, WIDE])
def test_masses_of_arcs_equal_the_closed_form(dtype):
    place = torch.linspace(-9, 9, 11, dtype=dtype)[:, None]
    edges = torch.tensor([-45.0, 45.0, 135.0, 225.0], dtype=WIDE).deg2rad()

    def below(x):  # ∫ (1 + cos)/2π
        return (x + np.sin(x)) / (2 * np.pi)

    difference = edges.numpy() - place.double().numpy()
    wanted = below(difference + np.pi / 2) - below(difference)
    actual = region_probabilities(Cardioid(place), edges, 10)
    np.testing.assert_allclose(actual.numpy(), wanted, atol=1e-6 if dtype == torch.float32 else 1e-12)


def test_an_edge_belongs_to_the_region_that_begins_there():
    edges = torch.tensor([-45.0, 45.0, 135.0, 225.0], dtype=WIDE).deg2rad()
    for dtype in (torch.float32, WIDE):
        at = torch.tensor([-45.0, 45.0, 135.0, 225.0, -135.0, 0.0, 359.0, -46.0, 44.9], dtype=WIDE).deg2rad()
        actual = regions(at.to(dtype), edges, around=True).tolist()
        assert actual == [0, 1, 2, 3, 3, 0, 0, 3, 0]
    turned = regions(at + 20 * math.pi, edges, around=True).tolist()
    assert turned == actual


def test_narrow_densities_act_as_points():
    raw = torch.tensor([[1e12, 0.0, 0.0], [-1e12, 0.0, 0.0], [0.0, 1e12, 0.0], [3.0, 0.0, 0.0]], dtype=WIDE)
    edges = torch.tensor([-45.0, 45.0, 135.0, 225.0], dtype=WIDE).deg2rad()
    for config in (
        {"name": "von_mises"},
        {"name": "uniform_floor", "weight": 1e-6, "component": "von_mises"},
    ):
        head = build("density_head", resolve("density_head", config), target=ANGLE).double()
        torch.manual_seed(2)
        actual = region_probabilities(head(raw), edges, 500)
        np.testing.assert_allclose(actual[:3].numpy(), np.eye(4)[[0, 2, 1]], atol=1e-5)
        np.testing.assert_allclose(actual.sum(-1).numpy(), 1, atol=1e-9)


def test_unknown_densities_of_real_numbers_are_estimated_from_draws():
    half = Independent(HalfNormal(torch.ones(3, 1, dtype=WIDE)), 1)
    torch.manual_seed(3)
    actual = region_probabilities(half, torch.tensor([0.5, 1.0], dtype=WIDE), 20_000)
    low, high = stats.halfnorm.cdf([0.5, 1.0])
    np.testing.assert_allclose(actual.numpy(), [[low, high - low, 1 - high]] * 3, atol=4 * 0.5 / 20_000**0.5)


def test_decisions_for_an_angle_cost_what_the_true_angle_says():
    torch.manual_seed(4)
    place = torch.randn(40, 1) * 3
    value = Cardioid(place).sample()
    table = [[0.0, 2.0, 1.0], [3.0, 0.0, 1.0]]
    config = {"costs": table, "actions": ["drive", "brake", "ask"], "edges_deg": [-90.0, 90.0]}
    actual = compute_metric(ANGLE, lambda part: Cardioid(place[part]), value, **config)
    front = 0.5 + np.cos(place.double().numpy()[:, 0]) / np.pi  # mass of the cardioid within 90° of 0
    expected = front[:, None] * table[0] + (1 - front)[:, None] * table[1]
    chosen = expected.argmin(1)
    truth = (np.cos(value.double().numpy()[:, 0]) < 0).astype(int)
    paid = np.array(table)[truth]
    assert actual["decision_cost"] == pytest.approx(paid[np.arange(40), chosen].mean())
    assert actual["decision_cost_fixed"] == pytest.approx(paid.mean(0).min())
    assert actual["decision_cost_oracle"] == pytest.approx(paid.min(1).mean())
    assert actual["share_ask"] == pytest.approx((chosen == 2).mean())
    assert len(set(chosen)) == 3


def test_any_cost_function_can_be_evaluated_by_draws():
    # steering by θ costs 1 - cos(θ - φ): of draws from a cardioid about μ, 1 - cos(θ - μ)/2
    density = Cardioid(torch.tensor([[0.1], [1.6], [3.0]], dtype=WIDE))
    steer = {"ahead": 0.0, "left": math.pi / 2, "back": math.pi}
    torch.manual_seed(5)
    chosen, expected = decide_by_draws(
        density, lambda action, target: 1 - torch.cos(target - steer[action]).squeeze(-1), list(steer), 20_000
    )
    wanted = 1 - np.cos(np.array([[0.1], [1.6], [3.0]]) - np.array(list(steer.values()))) / 2
    np.testing.assert_allclose(expected.numpy(), wanted, atol=4 / 20_000**0.5)
    assert chosen.tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match=r"returned the shape \(10, 3, 1\), expected \(10, 3\)"):
        decide_by_draws(density, lambda action, target: target, ["ahead"], 10)
    with pytest.raises(ValueError, match="got 0 actions and 10 samples"):
        decide_by_draws(density, lambda action, target: target, [], 10)


@pytest.mark.parametrize(
    "target, config, message",
    [
        (
            THREE,
            {"costs": [[0.0, 1.0]]},
            r"rows of \[2\] numbers, expected 3 rows \(one for each of empty, far, near\)",
        ),
        (THREE, {"costs": [[0.0], [1.0, 2.0], [1.0]]}, "with one number per action"),
        (THREE, {"costs": [[0.0, 1.0]] * 3}, "expected 2 names, one for each column"),
        (THREE, {"costs": [[0.0, 1.0]] * 3, "actions": ["a b", "a  b"]}, "the names of actions must differ"),
        (THREE, {"costs": [[math.nan] * 3] * 3}, "expected numbers, or .inf for a forbidden action"),
        (THREE, {"costs": [[-math.inf] * 3] * 3}, "expected numbers"),
        (
            THREE,
            {"costs": [[1.0] * 3, [math.inf] * 3, [1.0] * 3]},
            "forbids every action if far is true",
        ),
        (THREE, {"edges": [0.0]}, "targets of kind 'class' need no edges"),
        (THREE, {"number": "x"}, "target is one class"),
        (REAL, {}, r"got decision_cost.edges = None, .* such as \[0.0\]"),
        (REAL, {"edges_deg": [0.0, 90.0]}, "of kind 'real' use edges"),
        (REAL, {"edges": [1.0, 1.0]}, "in ascending order"),
        (REAL, {"edges": [math.nan]}, "expected finite numbers"),
        (ANGLE, {"edges_deg": [0.0]}, "2 or more edges"),
        (ANGLE, {"edges_deg": [0.0, 360.0]}, "within one turn"),
        (Target("real", ("x", "y")), {"edges": [0.0]}, "Set decision_cost.number to one of: x, y"),
        (Target("real", ("width", "y")), {"edges": [0.0], "number": "widht"}, "Did you mean 'width'"),
    ],
)
def test_tables_that_do_not_fit_raise_an_error(target, config, message):
    with pytest.raises(ConfigError, match=message):
        build("metric", resolve("metric", {"name": "decision_cost", **config}), target=target)


def test_nan_and_wrong_labels_raise_a_clear_message():
    with pytest.raises(UserError, match="1 of 1 expected costs"):
        compute_metric(
            ANGLE, lambda part: Cardioid(torch.tensor([[math.nan]])), torch.zeros(1, 1), edges_deg=[0.0, 90.0]
        )
    nothing = Independent(
        Normal(torch.tensor([[math.nan]]), 1.0, validate_args=False), 1, validate_args=False
    )
    with pytest.raises(UserError, match="1 of 1 expected costs"):
        compute_metric(REAL, lambda part: nothing, torch.zeros(1, 1), edges=[0.0])
    with pytest.raises(DataError, match="is 3, but class indices go from 0 to 2"):
        compute_metric(THREE, lambda part: Categorical(logits=torch.zeros(1, 3)), torch.tensor([3]))


def test_actions_are_named_without_samples():
    metric = DecisionCost(REAL, edges=[-1.0, 2.5])
    assert metric.actions == ["below_-1", "-1_to_2.5", "above_2.5"]
    assert DecisionCost(ANGLE, edges_deg=[-90.0, 90.0]).actions == ["-90_to_90_deg", "90_to_-90_deg"]
