"""Angles: wrapping, mean, and the exact circular median against brute force."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.distributions.circular import angular_distance, circular_mean, circular_median, grid, wrap

angles = st.floats(-1e6, 1e6, allow_nan=False)


def brute_force_median(samples: list[float]) -> float:
    """Return the smallest mean deviation of a sample from all samples, by a double loop."""
    return min(
        math.fsum(abs(math.remainder(a - b, 2 * math.pi)) for b in samples) / len(samples) for a in samples
    )


@settings(deadline=None, max_examples=200)
@given(st.lists(angles, min_size=1, max_size=40))
def test_median_is_the_sample_of_least_mean_deviation(samples: list[float]) -> None:
    found = circular_median(torch.tensor(samples, dtype=torch.float64)).item()
    reached = math.fsum(abs(math.remainder(found - b, 2 * math.pi)) for b in samples) / len(samples)
    assert reached <= brute_force_median(samples) + 1e-9


@pytest.mark.parametrize("spread", [1e-6, 0.5, 3.0])
def test_no_angle_at_all_beats_the_median(spread: float) -> None:
    """Eq. 3.23 searches the best angle and eq. 3.24 the best sample; in this case they are equal."""
    samples = torch.randn(101, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * spread + 3
    found = angular_distance(circular_median(samples), samples).mean()
    everywhere = angular_distance(grid(20001, dtype=torch.float64)[:, None], samples).mean(1).min()
    assert found <= everywhere + 1e-12


def test_median_of_a_batch_is_the_median_of_each() -> None:
    samples = torch.randn(33, 4, 3, generator=torch.Generator().manual_seed(0)) * 2
    together = circular_median(samples)
    for row in range(4):
        for column in range(3):
            assert together[row, column] == circular_median(samples[:, row, column])


def test_median_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one sample"):
        circular_median(torch.zeros(0, 3))


def test_mean_of_359_and_1_degree_is_0() -> None:
    mean = circular_mean(torch.deg2rad(torch.tensor([359.0, 1.0], dtype=torch.float64)))
    assert abs(mean.item()) < 1e-12


@settings(deadline=None, max_examples=300)
@given(st.floats(-1e9, 1e9))
def test_wrapped_angle_is_the_same_angle_in_range(angle: float) -> None:
    wrapped = wrap(torch.tensor(angle, dtype=torch.float64)).item()
    assert -math.pi <= wrapped < math.pi
    assert abs(math.remainder(wrapped - angle, 2 * math.pi)) < 1e-15 * max(1, abs(angle)) * 4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrap_stays_below_pi_at_the_seam(dtype: torch.dtype) -> None:
    near = torch.tensor([-math.pi, math.pi, math.nextafter(-math.pi, -4), 3 * math.pi, -1e-30], dtype=dtype)
    assert bool((wrap(near) < math.pi).all())


def test_the_median_of_what_is_not_finite_is_not_a_number() -> None:
    for bad in (math.nan, math.inf, -math.inf):
        samples = torch.tensor([[0.1, 0.1], [bad, 0.2], [0.3, 0.3]])
        found = circular_median(samples)
        assert found.isnan().tolist() == [True, False] and found[1] == circular_median(samples[:, 1])
