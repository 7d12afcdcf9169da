"""Residuals of Lorentzian lines for many Z-spectra, summed on one CPU core; compiled functions on NumPy arrays.

Formulas and the order of the parameters are those of spectrum.py. Arrays:
    parameters: (spectrum, p) float64, of either preset.
    rows: (spectrum,) int64, the rows of `measured`.
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
def lines(parameters, measured, offsets, centres, jacobian, residuals):
    """Fill `jacobian` (p, offset) and `residuals` (offset,) of one spectrum, and return how many offsets were measured.

    Both are 0 where nothing was measured.
    """
    pools, size, count = centres.shape[0], parameters.shape[0], offsets.shape[0]
    shift = 2 * pools
    there = 0
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
            there += 1
    return there


@compiled
@no_type_check
def summed(parameters, rows, measured, offsets, centres, cost, gradient, gram, there):
    """Fill the sums over offsets of many spectra, with residuals r and their Jacobian J.

    They are half the sum of squared residuals (spectrum,), Jᵀr (spectrum, p), JᵀJ (spectrum, p, p), and the number of
    measured offsets (spectrum,).
    """
    size = parameters.shape[1]
    jacobian, residuals = np.empty((size, offsets.shape[0])), np.empty(offsets.shape[0])
    for one in range(parameters.shape[0]):
        there[one] = lines(parameters[one], measured[rows[one]], offsets, centres, jacobian, residuals)
        total = 0.0
        for index in range(residuals.shape[0]):
            total += residuals[index] * residuals[index]
        cost[one] = total / 2
        for row in range(size):
            total = 0.0
            for index in range(residuals.shape[0]):
                total += jacobian[row, index] * residuals[index]
            gradient[one, row] = total
            for column in range(row + 1):
                total = 0.0
                for index in range(residuals.shape[0]):
                    total += jacobian[row, index] * jacobian[column, index]
                gram[one, row, column] = gram[one, column, row] = total


@compiled
@no_type_check
def curved(parameters, rows, measured, offsets, centres, curvature):
    """Fill `curvature` with Σ residual ∇²Z (spectrum, p, p)."""
    pools, size, count = centres.shape[0], parameters.shape[1], offsets.shape[0]
    shift = 2 * pools
    jacobian, residuals = np.empty((size, count)), np.empty(count)
    for one in range(parameters.shape[0]):
        lines(parameters[one], measured[rows[one]], offsets, centres, jacobian, residuals)
        curvature[one] = 0.0
        for pool in range(pools):
            amplitude, half = parameters[one, pool], parameters[one, pools + pool] / 2
            centre = parameters[one, shift]
            if size == shift + 1:
                centre += centres[pool]
            elif pool > 0:
                centre += parameters[one, shift + pool]
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
            both = -half * dde2  # amplitude and width
            bent = amplitude * (4 * square * dde3 - dde2) / 2  # width twice
            apart = -2 * square * de2  # amplitude and centre
            wide = amplitude * half * (4 * square * de3 - 2 * de2)  # width and centre
            moved = amplitude * square * (2 * e2 - 8 * dde3)  # centre twice
            width = pools + pool
            curvature[one, pool, width] = curvature[one, width, pool] = both
            curvature[one, width, width] = bent
            # The shift of water moves every centre; the centre of another pool moves that pool only.
            for place in (shift, shift + pool):
                if place < size and (place == shift or size > shift + 1):
                    curvature[one, pool, place] = curvature[one, place, pool] = apart
                    curvature[one, width, place] = curvature[one, place, width] = wide
            curvature[one, shift, shift] += moved
            if size > shift + 1 and pool > 0:
                own = shift + pool
                curvature[one, own, own] = curvature[one, shift, own] = curvature[one, own, shift] = moved
