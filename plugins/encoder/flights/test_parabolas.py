"""Tests of parabolas through the last frames against NumPy's weighted least squares."""

import numpy as np

from plugins.encoder.flights.parabolas_compiled import fit_parabolas


def test_parabolas_are_those_of_weighted_least_squares() -> None:
    """Compare each iteration with NumPy's solver, for frames with noise, gaps, outliers and a bounce."""
    generator = np.random.default_rng(0)
    frames, noise, spans = 20, 0.003, np.array([20, 14, 10, 7])
    times = 0.016 * (np.arange(frames) - frames + 1) + generator.uniform(-1e-3, 1e-3, (30, frames))
    power = np.stack([np.ones_like(times), times, times**2 / 2], -1)
    positions = power @ generator.normal(size=(30, 3, 3)) + noise * generator.normal(size=(30, frames, 3))
    positions[10:, :8, 2] += 3 * (times[10:, :8] - times[10:, 8:9])  # another velocity before the ninth frame
    positions[20:, 3::5] += 0.4
    visible = generator.uniform(size=(30, frames)) > 0.1
    visible[0] = False
    long, short, spread = (np.empty((30, 3, 3)) for _ in range(3))
    span = np.empty(30, np.int64)
    fit_parabolas(times, positions, visible, spans, noise, long, short, spread, span)
    for flight in range(30):
        fits = []
        for last in spans:
            used = visible[flight] & (np.arange(frames) >= frames - last)
            rows, wanted = power[flight, used], positions[flight, used]
            weight, distance = np.ones(len(rows)), np.zeros(len(rows))
            precision, coefficients = np.eye(3), np.zeros((3, 3))
            for iteration in range(8):
                precision = rows.T * weight / noise**2 @ rows + np.diag([0.01, 0.01, 1 / 16])
                coefficients = np.linalg.solve(precision, rows.T * weight / noise**2 @ wanted)
                distance = np.linalg.norm(wanted - rows @ coefficients, axis=1) / noise
                weight = 1 / (1 + (distance / (3 * 3.0 ** max(0, 4 - iteration))) ** 2)
            fits.append((coefficients, np.linalg.inv(precision), (distance > 5).sum() <= 2))
        best = next((number for number, fit in enumerate(fits) if fit[2]), len(spans) - 1)
        assert span[flight] == best
        np.testing.assert_allclose(long[flight], fits[best][0], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(short[flight], fits[-1][0], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(spread[flight], fits[best][1], rtol=1e-6, atol=1e-8)
    assert len(set(span.tolist())) > 1
