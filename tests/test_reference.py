"""Errors of log-likelihoods relative to a reference, compared with NumPy."""

import math

import numpy as np
import pytest
import torch

from framework.evaluation.reference import BETTER, COLUMNS, Reference, errors, reference_value


def made_up(noise: np.ndarray, truth: np.ndarray):
    """Return an estimator whose log-likelihoods with seed r are the truth plus row r of the noise."""
    return lambda value, seed: torch.from_numpy(truth + noise[seed])


def test_errors_are_numpys() -> None:
    generator = np.random.default_rng(0)
    truth, noise = generator.normal(size=30), generator.normal(0.2, 1, size=(9, 30))
    reference = Reference(99, torch.from_numpy(truth), float(truth.mean()), 0.0, 2)
    found = errors(made_up(noise, truth), 3, range(9), reference)
    offset = noise.mean(1)
    assert found["error_nats"] == pytest.approx(np.sqrt(np.mean(offset**2)))
    assert found["bias_nats"] == pytest.approx(abs(offset.mean()))
    assert found["log_likelihood_nats"] == pytest.approx(truth.mean() + offset.mean())
    assert found["log_likelihood_nats_sem"] == pytest.approx(offset.std(ddof=1) / 3)
    assert found["sample_error_nats"] == pytest.approx(np.sqrt(np.mean(noise**2)))
    assert set(found) == {*COLUMNS, "error_nats_sem", "log_likelihood_nats_sem"} > set(BETTER)


def test_the_error_of_the_error_is_its_scatter_over_repetitions() -> None:
    """Compare the delta method's standard error with the standard deviation over many experiments."""
    generator = np.random.default_rng(1)
    truth = np.zeros(4)
    reference = Reference(99, torch.zeros(4, dtype=torch.float64), 0.0, 0.0, 2)
    found = []
    for _ in range(300):
        noise = np.repeat(generator.normal(0.5, 0.3, size=(20, 1)), 4, axis=1)
        found.append(errors(made_up(noise, truth), 1, range(20), reference))
    scatter = np.std([one["error_nats"] for one in found])
    assert np.mean([one["error_nats_sem"] for one in found]) == pytest.approx(scatter, rel=0.1)


def test_a_knob_that_changes_nothing_has_error_zero() -> None:
    truth = np.arange(5.0)
    steady = made_up(np.zeros((3, 5)), truth)
    reference = reference_value(steady, 10, range(3))
    assert reference.standard_error == pytest.approx(0, abs=1e-14)
    found = errors(steady, 1, range(3), Reference(10, torch.from_numpy(truth), 2.0, 0.0, 3))
    assert [found[key] for key in ("error_nats", "error_nats_sem", "bias_nats", "sample_error_nats")] == [
        0
    ] * 4


def test_an_infinite_log_likelihood_is_an_infinite_error() -> None:
    truth = np.zeros(3)
    noise = np.zeros((2, 3))
    noise[1, 2] = -math.inf
    reference = Reference(10, torch.zeros(3, dtype=torch.float64), 0.0, 0.0, 2)
    assert errors(made_up(noise, truth), 1, range(2), reference)["error_nats"] == math.inf


def test_the_reference_averages_densities_and_its_error_is_the_jackknifes() -> None:
    generator = np.random.default_rng(2)
    noise = generator.normal(size=(7, 11))
    found = reference_value(made_up(noise, np.zeros(11)), 50, range(7))
    density = np.exp(noise)
    assert found.log_probs.numpy() == pytest.approx(np.log(density.mean(0)))
    left_out = np.array([np.log(np.delete(density, r, 0).mean(0)).mean() for r in range(7)])
    by_hand = np.sqrt(6 / 7 * np.sum((left_out - left_out.mean()) ** 2))
    assert found.standard_error == pytest.approx(by_hand)
    assert (found.value, found.repeats) == (50, 7)


@pytest.mark.parametrize("level", [-1e4, 1e4])
def test_the_reference_neither_underflows_nor_overflows(level: float) -> None:
    found = reference_value(made_up(np.zeros((3, 2)), np.full(2, level)), 50, range(3))
    assert found.mean == pytest.approx(level)
    assert found.standard_error == pytest.approx(0, abs=1e-9)
