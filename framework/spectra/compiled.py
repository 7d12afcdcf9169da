"""Residuals of Lorentzian lines for many Z-spectra, summed on one CPU core; compiled functions on NumPy arrays.

spectrum.py describes the formulas and the order of the parameters. All functions share the names of these arrays:
    parameters: (spectrum, p) float64, of the preset "ten" or "fifteen".
    rows: (spectrum,) int64, row of each spectrum in `measured`.
    measured: (row, offset) float64, NaN where nothing was measured.
    offsets: (offset,) float64, ppm.
    centres: (pool,) float64, ppm from water.
"""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

# Sums may be reordered, so that several numbers are added at once.
compiled = compiler(kernel_cache("spectra", [Path(__file__)]), fastmath={"reassoc", "contract", "arcp"})


@compiled
@no_type_check
def evaluate_lines(parameters, measured, offsets, centres, jacobian, residuals):
    """Compute the residuals Z - measured of one spectrum and their Jacobian; return the number of measured offsets.

    Residuals and Jacobian are 0 at offsets where nothing was measured.

    Args:
        parameters: parameters of the spectrum, (p,).
        measured: measured Z, (offset,), NaN where nothing was measured.
        offsets: offsets, (offset,), ppm.
        centres: centres of the pools, (pool,), ppm from water. With the preset "fifteen", only their number is used,
            because `parameters` holds the centres.
        jacobian: filled with the derivatives of the residuals, (p, offset).
        residuals: filled with the residuals, (offset,).
    """
    pools, size, count = centres.shape[0], parameters.shape[0], offsets.shape[0]
    shift = 2 * pools
    measured_count = 0
    residuals[:] = 1.0
    jacobian[shift] = 0.0
    for pool in range(pools):
        amplitude, half = parameters[pool], parameters[pools + pool] / 2
        centre = parameters[shift]
        if size == shift + 1:
            centre += centres[pool]
        elif pool > 0:
            centre += parameters[shift + pool]
        square = half * half
        for index in range(count):
            distance = offsets[index] - centre
            inverse = 1 / (square + distance * distance)
            line = -square * inverse
            weight = amplitude * half * inverse * inverse * distance
            jacobian[pool, index] = line
            residuals[index] += amplitude * line
            jacobian[pools + pool, index] = -weight * distance
            jacobian[shift, index] += -2 * half * weight
            if size > shift + 1 and pool > 0:
                jacobian[shift + pool, index] = -2 * half * weight
    for index in range(count):
        if np.isnan(measured[index]):
            residuals[index] = 0.0
            jacobian[:, index] = 0.0
        else:
            residuals[index] -= measured[index]
            measured_count += 1
    return measured_count


@compiled
@no_type_check
def compute_sums(parameters, rows, measured, offsets, centres, cost, gradient, gram, measured_counts):
    """Fill arrays with sums over the offsets of each spectrum, for the residuals r and their Jacobian J.

    Args:
        parameters: parameters of the spectra, (spectrum, p).
        rows: row of each spectrum in `measured`, (spectrum,).
        measured: measured Z, (row, offset), NaN where nothing was measured.
        offsets: offsets, (offset,), ppm.
        centres: centres of the pools, (pool,), ppm from water.
        cost: filled with half the sum of squared residuals, (spectrum,).
        gradient: filled with Jᵀr, (spectrum, p).
        gram: filled with JᵀJ, (spectrum, p, p).
        measured_counts: filled with the number of measured offsets, (spectrum,).
    """
    size = parameters.shape[1]
    jacobian, residuals = np.empty((size, offsets.shape[0])), np.empty(offsets.shape[0])
    for spectrum in range(parameters.shape[0]):
        measured_counts[spectrum] = evaluate_lines(
            parameters[spectrum], measured[rows[spectrum]], offsets, centres, jacobian, residuals
        )
        total = 0.0
        for index in range(residuals.shape[0]):
            total += residuals[index] * residuals[index]
        cost[spectrum] = total / 2
        for row in range(size):
            total = 0.0
            for index in range(residuals.shape[0]):
                total += jacobian[row, index] * residuals[index]
            gradient[spectrum, row] = total
            for column in range(row + 1):
                total = 0.0
                for index in range(residuals.shape[0]):
                    total += jacobian[row, index] * jacobian[column, index]
                gram[spectrum, row, column] = gram[spectrum, column, row] = total


@compiled
@no_type_check
def compute_curvature(parameters, rows, measured, offsets, centres, curvature):
    """Fill `curvature`, (spectrum, p, p), with the sum over the offsets of the residual times ∇²Z.

    ∇²Z is the matrix of second derivatives of Z by the parameters. The other arguments are those of `compute_sums`.
    """
    pools, size, count = centres.shape[0], parameters.shape[1], offsets.shape[0]
    shift = 2 * pools
    jacobian, residuals = np.empty((size, count)), np.empty(count)
    for spectrum in range(parameters.shape[0]):
        evaluate_lines(parameters[spectrum], measured[rows[spectrum]], offsets, centres, jacobian, residuals)
        curvature[spectrum] = 0.0
        for pool in range(pools):
            amplitude, half = parameters[spectrum, pool], parameters[spectrum, pools + pool] / 2
            centre = parameters[spectrum, shift]
            if size == shift + 1:
                centre += centres[pool]
            elif pool > 0:
                centre += parameters[spectrum, shift + pool]
            square = half * half
            # Sums of the residuals times powers of the distance d and of e = 1 / (h² + d²).
            e2 = de2 = dde2 = de3 = dde3 = 0.0
            for index in range(count):
                distance = offsets[index] - centre
                inverse = 1 / (square + distance * distance)
                second = residuals[index] * inverse * inverse
                third = second * inverse
                e2 += second
                de2 += second * distance
                dde2 += second * distance * distance
                de3 += third * distance
                dde3 += third * distance * distance
            amplitude_width = -half * dde2  # amplitude and width
            width_width = amplitude * (4 * square * dde3 - dde2) / 2  # width twice
            amplitude_centre = -2 * square * de2  # amplitude and centre
            width_centre = amplitude * half * (4 * square * de3 - 2 * de2)  # width and centre
            centre_centre = amplitude * square * (2 * e2 - 8 * dde3)  # centre twice
            width = pools + pool
            curvature[spectrum, pool, width] = curvature[spectrum, width, pool] = amplitude_width
            curvature[spectrum, width, width] = width_width
            # The shift of water moves every centre; the centre of another pool moves that pool only.
            for place in (shift, shift + pool):
                if place < size and (place == shift or size > shift + 1):
                    curvature[spectrum, pool, place] = curvature[spectrum, place, pool] = amplitude_centre
                    curvature[spectrum, width, place] = curvature[spectrum, place, width] = width_centre
            curvature[spectrum, shift, shift] += centre_centre
            if size > shift + 1 and pool > 0:
                own = shift + pool
                curvature[spectrum, own, own] = curvature[spectrum, shift, own] = curvature[
                    spectrum, own, shift
                ] = centre_centre
