"""Standard errors and verdicts of `reproduction/chapter6/modelnet40.py`, compared with counts and simulation."""

import math

import numpy as np
import pytest

from reproduction.chapter6.modelnet40 import (
    CLAIMS,
    ROWS,
    Method,
    claims_table,
    seed_variance,
    verdict,
    weighted_score,
)


def method(*runs):
    right = np.array(runs, float)
    return Method(right, 1 - right)


def test_one_run_each_is_mcnemars_difference():
    """The difference has McNemar's standard error.

    If b of n clouds are right only with the first method and c only with the other, the difference is
    (b - c) / n ± √(b + c - (b - c)² / n) / n.
    """
    random = np.random.default_rng(0)
    first, other = random.random((2, 500)) < [[0.8], [0.7]]
    b, c, n = (first & ~other).sum(), (~first & other).sum(), 500
    value, error = weighted_score({"a": method(first), "b": method(other)}, {"a": 1, "b": -1})
    assert value == pytest.approx((b - c) / n)
    assert error == pytest.approx(math.sqrt((b + c - (b - c) ** 2 / n) / (n * (n - 1))))


@pytest.mark.parametrize("spread", [0.0, 0.03])
def test_errors_are_those_of_new_clouds_and_new_seeds(spread):
    """Standard errors agree with simulations, in which the accuracy depends on the cloud, the seed and chance."""
    random = np.random.default_rng(1)
    values, variances, components = [], [], []
    for _ in range(400):
        ease = random.uniform(0.3, 1, 200)
        runs = {}
        for key, mean in (("a", 0.0), ("b", -0.1)):
            chance = ease + mean + spread * random.standard_normal((3, 1))
            runs[key] = method(*(random.random((3, 200)) < chance))
        value, error = weighted_score(runs, {"a": 1, "b": -1})
        values.append(value)
        variances.append(error**2)
        components.append(seed_variance(runs["a"].accuracy))
    assert np.mean(components) == pytest.approx(spread**2, abs=1e-4)
    # a variance below 0 counts as 0, so that errors are rather too large where seeds do not differ
    assert 0.85 * np.var(values) < np.mean(variances) < 1.5 * np.var(values)


def test_a_row_of_one_seed_takes_the_others_variance():
    random = np.random.default_rng(2)
    several = method(*(random.random((5, 300)) < 0.7 + 0.1 * random.standard_normal((5, 1))))
    single = method(random.random(300) < 0.7)
    alone = weighted_score({"single": single}, {"single": 1})[1]
    both = weighted_score({"single": single, "several": several}, {"single": 1})[1]
    assert both**2 - alone**2 == pytest.approx(seed_variance(several.accuracy))


def test_verdicts_at_two_standard_errors():
    assert [verdict(value, 0.01) for value in (0.021, 0.019, -0.019, -0.021)] == [
        "held", "open", "open", "contradicted"
    ]  # fmt: skip


def test_every_claim_is_of_rows_of_the_tables_and_is_printed():
    named = {key for contrasts in CLAIMS.values() for contrast in contrasts for key in contrast.weights}
    assert {key.split()[0] for key in named} <= set(ROWS)  # "bps_mlp turned" is one of bps_mlp's
    random = np.random.default_rng(3)
    ease = random.random(2000)
    share = dict.fromkeys(named, 0.85) | {
        "occ_mlp_8": 0.6,
        "occ_mlp_32": 0.7,
        "bps_conv3d": 0.8,
        "tdf_mlp_8": 0.6,
    }
    share |= {"tdf_mlp_32": 0.7, "voxnet": 0.7}
    runs = {key: method(ease < share[key]) for key in named}
    text = claims_table(runs)
    assert text.count("\n") == 1 + len(CLAIMS) + sum(map(len, CLAIMS.values()))
    verdicts = [line.rsplit("**", 2)[1] for line in text.splitlines() if "| **" in line]
    verdict_by_claim = dict(zip(CLAIMS, verdicts, strict=True))
    contradicted = [claim for claim, verdict in verdict_by_claim.items() if verdict == "contradicted"]
    assert contradicted == ["3D convolutions are better than the plain network (§6.5.1)"]
    held_claims = {
        claim.partition(" (")[0] for claim, verdict in verdict_by_claim.items() if verdict == "held"
    }
    assert held_claims == {
        "Basis point sets are better than occupancy and truncated distances",
        "A plain network on basis point sets is better than VoxNet on occupancy",
        "A small grid of basis points costs little accuracy",
        "A small grid costs other encodings accuracy",
        # rows that are right of the same clouds are less than two points apart
        "Truncated distances are hardly better than occupancy",
        "Basis points and a plain network are as accurate as PointNet",
        "3D convolutions on vectors are as accurate as PointNet++",
    }
    del runs["voxnet"]
    assert "not run: voxnet | | open" in claims_table(runs)
