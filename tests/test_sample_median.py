"""Tests of the standard error of a sample median against the bootstrap and against repeated samples."""

import math

import numpy as np
import pytest
import torch

from framework.distributions.sample_median import sample_median


@pytest.mark.parametrize("count", [3, 5, 21, 201])
@pytest.mark.parametrize("offset", [0.0, 1e8])
@pytest.mark.parametrize("ties", [False, True])
def test_the_standard_error_is_that_of_the_bootstrap(count: int, offset: float, ties: bool) -> None:
    random = np.random.default_rng(count)
    values = random.exponential(size=count)
    values = offset + (np.ceil(2 * values) if ties else values)
    median, error = sample_median(torch.from_numpy(values))
    resampled = np.median(random.choice(values, (20_000, count)), 1)
    assert median.item() == np.median(values)
    assert error.item() == pytest.approx(resampled.std(), rel=0.02, abs=1e-12)


@pytest.mark.parametrize("count", [2, 20, 101])
def test_the_standard_error_is_the_spread_over_repeated_samples(count: int) -> None:
    random = np.random.default_rng(0)
    pairs = [sample_median(torch.from_numpy(random.normal(size=count))) for _ in range(2000)]
    medians, errors = np.array([[part.item() for part in pair] for pair in pairs]).T
    # with few values the smooth weights give somewhat too much
    assert math.sqrt((errors**2).mean()) == pytest.approx(medians.std(), rel=0.15)


@pytest.mark.parametrize("values", [[], [math.nan, 1.0], [2.0], [3.0, 3.0, 3.0], [0.0, 1.0, math.inf]])
def test_few_equal_and_undefined_values(values: list[float]) -> None:
    median, error = (part.item() for part in sample_median(torch.tensor(values, dtype=torch.float64)))
    if not values or any(map(math.isnan, values)):
        assert math.isnan(median) and math.isnan(error)
    else:
        assert median == np.median(values)
        assert (error == 0) == (len(set(values)) == 1 and len(values) > 1)
