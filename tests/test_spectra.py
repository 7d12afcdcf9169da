"""Z-spectra as sums of Lorentzian lines: derivatives compared with autograd, and fits compared with SciPy."""

import mpmath
import numpy as np
import pytest
import torch
from scipy import optimize

from framework.spectra.fit import fit
from framework.spectra.offsets import OFFSETS
from framework.spectra.spectrum import PRESETS, Misfit, Parameters, spectrum
from plugins.data.cest.volumes import read_volume

PLACES = torch.tensor(OFFSETS, dtype=torch.float64)


@pytest.mark.parametrize("preset", PRESETS)
def test_derivatives_are_autograds(preset):
    wanted = Parameters.of(preset)
    at = torch.tensor([wanted.start, wanted.second_start], dtype=torch.float64) * 1.05
    at[:, 10] = 0.07
    measured = torch.rand(2, len(PLACES), dtype=torch.float64)
    misfit, rows = Misfit(measured, PLACES), torch.arange(2)
    residuals, jacobian = misfit(at, rows)
    torch.testing.assert_close(residuals, spectrum(at, PLACES) - measured, rtol=0, atol=1e-14)
    curved = misfit.curvature(at, rows)
    cost, gradient, gram, there = misfit.normal(at, rows)
    torch.testing.assert_close(cost, residuals.square().sum(-1) / 2, rtol=1e-13, atol=0)
    torch.testing.assert_close(
        gradient, torch.einsum("nrp,nr->np", jacobian, residuals), rtol=1e-11, atol=1e-12
    )
    torch.testing.assert_close(gram, jacobian.mT @ jacobian, rtol=1e-11, atol=1e-12)
    assert there.tolist() == [len(PLACES)] * 2
    for row in range(2):

        def alone(x):
            return spectrum(x[None], PLACES)[0]

        exact = torch.autograd.functional.jacobian(alone, at[row])
        torch.testing.assert_close(jacobian[row], exact, rtol=1e-11, atol=1e-13)
        second = torch.autograd.functional.hessian(lambda x, r=row: alone(x) @ residuals[r], at[row])
        torch.testing.assert_close(curved[row], second, rtol=1e-9, atol=1e-11)
        step = 1e-6 * torch.eye(len(at[row]), dtype=torch.float64)
        slope = (spectrum(at[row] + step, PLACES) - spectrum(at[row] - step, PLACES)).T / 2e-6
        torch.testing.assert_close(jacobian[row], slope, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("preset", PRESETS)
def test_offsets_that_were_not_measured_are_as_if_never_asked_for(preset):
    wanted = Parameters.of(preset)
    at = torch.tensor([wanted.start, wanted.second_start], dtype=torch.float64)
    noise = torch.randn(2, len(PLACES), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    measured, kept = spectrum(1.05 * at, PLACES) + 0.003 * noise, torch.arange(len(PLACES)) % 3 > 0
    holes, rows = measured.where(kept, torch.nan), torch.tensor([1, 0])
    fewer, some = Misfit(measured[:, kept], PLACES[kept]), Misfit(holes, PLACES)
    for one, other in zip(some.normal(at, rows), fewer.normal(at, rows), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-13)
    torch.testing.assert_close(some.curvature(at, rows), fewer.curvature(at, rows), rtol=1e-11, atol=1e-13)
    for one, other in zip(
        fit(holes, PLACES, wanted)[:3], fit(measured[:, kept], PLACES[kept], wanted)[:3], strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("preset", PRESETS)
def test_each_spectrum_is_fitted_as_scipy_fits_it_or_better(preset, brain):
    wanted = Parameters.of(preset)
    measured = torch.from_numpy(read_volume(brain).spectra[::97][:12])
    found = fit(measured, PLACES, wanted)
    misfit, same = Misfit(measured, PLACES), 0
    for row in range(len(measured)):

        def both(x, row=row):
            return misfit(torch.tensor(x)[None], torch.tensor([row]))

        other = optimize.least_squares(
            lambda x: both(x)[0][0].numpy(),
            wanted.start,
            lambda x: both(x)[1][0].numpy(),
            bounds=(wanted.lower, wanted.upper),
            **dict.fromkeys(("ftol", "xtol", "gtol"), 1e-14),
        )
        assert found.cost[row] <= other.cost * (1 + 1e-9)
        if found.cost[row] >= other.cost * (1 - 1e-9):
            same += 1
            np.testing.assert_allclose(found.parameters[row].numpy(), other.x, rtol=1e-5, atol=1e-6)
    assert same >= 6
    sides = torch.tensor(wanted.upper).double() - torch.tensor(wanted.lower).double()
    residuals, jacobian = misfit(found.parameters, torch.arange(len(measured)))
    variance = residuals.square().sum(-1) / (len(PLACES) - len(sides))
    for row in range(len(measured)):
        covariance = exact_covariance(jacobian[row], float(variance[row]), sides)
        deviation = np.sqrt(np.diag(covariance))
        mine = (found.root[row] @ found.root[row].mT).numpy()
        np.testing.assert_allclose(np.sqrt(np.diag(mine)), deviation, rtol=1e-6)
        # as correlations: of numbers that nearly cancel a share of themselves says nothing
        np.testing.assert_allclose(
            mine / np.outer(deviation, deviation),
            covariance / np.outer(deviation, deviation),
            rtol=0,
            atol=1e-6,
        )


def exact_covariance(jacobian, variance, sides):
    """Return (JᵀJ / s² + diag 12 / side²)⁻¹, computed with 60 digits."""
    with mpmath.workdps(60):
        rows = mpmath.matrix(jacobian.tolist())
        normal = rows.T * rows / variance
        for index, side in enumerate(sides.tolist()):
            normal[index, index] += 12 / mpmath.mpf(side) ** 2
        return np.array((normal**-1).tolist(), dtype=float)


def test_what_says_nothing_is_as_wide_as_its_box():
    flat = torch.ones(3, len(PLACES)).double()
    flat[1] = 0.0
    flat[2, 5] = 40.0  # a spike
    found = fit(flat, PLACES, Parameters.of("fifteen"))
    for part in found:
        assert bool(part.isfinite().all())
    deviation = found.root.square().sum(-1).sqrt()
    wanted = Parameters.of("fifteen")
    side = torch.tensor(wanted.upper[5:10]) - torch.tensor(wanted.lower[5:10])
    gone = found.parameters[0, :5] < 1e-9
    assert bool(gone.any())
    torch.testing.assert_close(
        (deviation[0, 5:10] / side.double())[gone], torch.full((int(gone.sum()),), 12**-0.5).double()
    )


def test_truth_is_found_again_without_noise():
    wanted = Parameters.of("fifteen")
    truth = torch.tensor([wanted.start]).double() * torch.tensor([[1.02], [0.97]]).double()
    truth[:, 10] = torch.tensor([0.1, -0.2])
    found = fit(spectrum(truth, PLACES), PLACES, wanted)
    torch.testing.assert_close(found.parameters, truth, rtol=1e-6, atol=1e-7)
