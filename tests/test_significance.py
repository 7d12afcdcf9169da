"""Marks of significance in tables, compared with SciPy's tests and with chance."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ttest_ind_from_stats, ttest_rel

from framework.evaluation.pareto import front
from framework.evaluation.significance import (
    SHARE,
    Mean,
    holm,
    least_significant,
    mean,
    paired_difference,
    significantly_best,
)
from framework.sweeps.pages import _differences
from framework.sweeps.results import compare

spreads = st.floats(1e-6, 1e6)
counts = st.integers(2, 200)


@given(spreads, spreads, counts, counts)
def test_the_least_significant_difference_is_that_of_welchs_test(
    first: float, second: float, n: int, m: int
) -> None:
    pair = [
        Mean(0.0, first / math.sqrt(n), n - 1.0, "runs"),
        Mean(0.0, second / math.sqrt(m), m - 1.0, "runs"),
    ]
    least = least_significant(pair)[0, 1]
    found = ttest_ind_from_stats(least, first, n, 0.0, second, m, equal_var=False).pvalue
    assert found == pytest.approx(SHARE, rel=1e-6)


@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
def test_the_scale_does_not_matter(scale: float) -> None:
    pair = [Mean(0.0, scale, 2.0, "runs"), Mean(0.0, 3 * scale, 4.0, "runs")]
    one = [Mean(0.0, 1.0, 2.0, "runs"), Mean(0.0, 3.0, 4.0, "runs")]
    assert least_significant(pair)[0, 1] / scale == pytest.approx(least_significant(one)[0, 1])


@pytest.mark.parametrize("runs", [1, 2, 3, 5, 10])
@pytest.mark.parametrize("methods", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_of_equal_methods_at_most_one_table_in_twenty_has_a_bold_row(runs: int, methods: int) -> None:
    """Count over 10,000 random tables; a single run has the standard error over its test samples."""
    random = np.random.default_rng(0)
    draws = random.normal(size=(10_000, max(runs, 2), methods))
    bold = 0
    for table in draws:
        if runs == 1:
            means = [Mean(value, 1.0, math.inf, "samples") for value in table[0]]
        else:
            errors = table.std(0, ddof=1) / math.sqrt(runs)
            means = [
                Mean(value, error, runs - 1.0, "runs")
                for value, error in zip(table.mean(0), errors, strict=True)
            ]
        bold += int(significantly_best(means, "higher").any())
    assert bold <= 500


@pytest.mark.parametrize("better", ["higher", "lower"])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_real_difference_of_three_standard_errors_is_found(better: str, place: int) -> None:
    """A difference of three standard errors over the test samples of single runs is significant."""
    sign = 1 if better == "higher" else -1
    means = [
        Mean(sign * 3.0 * math.sqrt(2) if row == place else 0.0, 1.0, 199.0, "samples") for row in range(3)
    ]
    assert significantly_best(means, better).tolist() == [row == place for row in range(3)]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "other",
    [
        Mean(5.0, math.nan),
        Mean(math.nan, 0.1),
        Mean(5.0, 0.1, 0.0, "runs"),
        Mean(5.0, 0.1, 40.0, "samples"),  # of a single run: what differs between runs is not in it
    ],
)
def test_beside_a_mean_of_unknown_error_nothing_is_best(other: Mean) -> None:
    means = [Mean(1.0, 0.1, 4.0, "runs"), Mean(2.0, 0.1, 4.0, "runs"), other]
    assert not significantly_best(means, "lower").any()


def test_exact_means_differ_by_any_amount_and_equal_ones_not_at_all() -> None:
    assert significantly_best([Mean(3.0, 0.0), Mean(3.0000001, 0.0)], "lower").tolist() == [True, False]
    assert not significantly_best([Mean(3.0, 0.0), Mean(3.0, 0.0), Mean(4.0, 0.0)], "lower").any()
    assert not significantly_best([Mean(3.0, 0.0)], "lower").any()
    assert significantly_best([], "lower").tolist() == []


def test_what_a_result_says_of_its_error() -> None:
    assert mean({"x": 1.0, "x_sem": 0.5, "x_std": 9.0}, "x", 4) == Mean(1.0, 0.5, math.inf, "samples")
    assert mean({"x": 1.0, "x_sem": 0.5, "test_samples": 30}, "x", None) == Mean(1.0, 0.5, 29.0, "samples")
    assert mean({"x": 1.0, "x_sem": 0.5, "repeats": 6}, "x", 6) == Mean(1.0, 0.5, 5.0, "runs")
    assert mean({"x": 1.0, "x_std": 3.0}, "x", 9) == Mean(1.0, 1.0, 8.0, "runs")
    assert mean({"x": 12}, "x", None) == Mean(12.0, 0.0)
    for unknown in (
        {"x": 1.0, "x_std": 3.0},
        {"x": 1.0},
        {"x": 1.0, "x_std": math.nan},
        {"x": None},
        {"x": True},
    ):
        assert math.isnan(mean(unknown, "x", 1).standard_error)


def _over_runs(numbers: np.ndarray) -> Mean:
    """Return the mean over runs, as a table has it."""
    runs = len(numbers)
    spread = float(numbers.std(ddof=1)) if runs > 1 else math.nan
    return mean({"x": float(numbers.mean()), "x_std": spread}, "x", runs)


@pytest.mark.parametrize("size", [-1e4, -1.0, 1e-6, 1.0, 1e6])
@pytest.mark.parametrize("runs", [1, 2, 3, 5, 10])
@pytest.mark.parametrize("spread", [0.0, 1e-9, 1e-3, 1.0])
@pytest.mark.parametrize("rounding", ["constant", "random", "to float32"])
def test_rounding_is_not_significant(size: float, runs: int, spread: float, rounding: str) -> None:
    random = np.random.default_rng(0)
    first = size * (1 + spread * random.normal(size=runs))
    second = {
        "constant": first * (1 + 1e-7),
        "random": first * (1 + 1e-7 * (5 + random.normal(size=runs))),
        "to float32": first.astype(np.float32).astype(np.float64),
    }[rounding]
    for pair in ((first, second), (second, first)):
        found = paired_difference(*(numbers.tolist() for numbers in pair))
        assert found.probability == 1 or runs == 1
        assert abs(found.value) <= found.rounding
        means = [_over_runs(numbers) for numbers in pair]
        assert not significantly_best(means, "higher").any()
        assert front(means, [1.0, 1.0]) == [runs > 1] * 2


@pytest.mark.parametrize("size", [-1e4, 1e-6, 1.0, 1e6])
@pytest.mark.parametrize("runs", [2, 3, 5, 10])
@pytest.mark.parametrize("relative", [1e-5, 1e-3, 1.0])
def test_a_small_real_difference_of_pairs_is_found(size: float, runs: int, relative: float) -> None:
    """The mean difference is three standard errors; the differences between runs are far larger than it."""
    random = np.random.default_rng(0)
    first = size * (1 + random.normal(size=runs))
    noise = random.normal(size=runs)
    noise = (noise - noise.mean()) / noise.std(ddof=1) * math.sqrt(runs) / 3
    second = first + relative * size * (1 + noise)
    found = paired_difference(first.tolist(), second.tolist())
    assert abs(found.value) / found.standard_error == pytest.approx(3, rel=1e-6)
    assert found.probability == pytest.approx(ttest_rel(first, second).pvalue, rel=1e-6)
    assert (found.probability <= 0.05) == (runs >= 5)


def test_a_difference_from_an_infinite_number_has_no_p_value() -> None:
    for second in ([1.0, math.inf], [math.inf, math.inf], [1.0, math.nan]):
        assert math.isnan(paired_difference([1.0, math.inf], second).probability)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8), st.lists(st.floats(0, 1), max_size=8))
def test_tests_without_p_values_count_as_if_they_were_least_favourable(
    shown: list[float], others: list[float]
) -> None:
    for found, expected in zip(holm(shown, len(others)), holm([*shown, *others]), strict=False):
        assert found >= expected


@pytest.mark.parametrize("rows", [2, 5, 10])
@pytest.mark.parametrize("runs", [3, 10])
def test_of_equal_rows_at_most_one_report_in_twenty_has_a_star(rows: int, runs: int) -> None:
    """Count over random sweeps; the page tests the differences from the row that is best by the same numbers."""
    random = np.random.default_rng(0)
    header = {"data": "moons", "columns": {"nll": "NLL"}, "better": {"nll": "lower"}, "overrides": []}
    starred, sweeps = 0, 500
    for numbers in random.normal(size=(sweeps, rows, runs)):
        compared = compare(
            [
                {**header, "method": f"row {row}", "seed": seed, "nll": float(numbers[row, seed])}
                for row in range(rows)
                for seed in range(runs)
            ]
        )
        assert compared is not None
        starred += " *</td>" in _differences(compared)
    assert starred <= 0.05 * sweeps + 2.5 * math.sqrt(0.05 * 0.95 * sweeps)
