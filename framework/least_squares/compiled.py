"""One step of many small least-squares problems on one CPU core; compiled functions on NumPy arrays.

framework.least_squares.solver explains the quantities and the rules. The first dimension of arrays is the problem. All
functions share these names:
    at, lower, upper, gradient, scale, move: (problem, p) float64.
    gram, curve: (problem, p, p) float64.
    cost, damping, gain, slope, least: (problem,) float64.
    cut, careful: (problem,) bool.
    streak, quiet, steps, ended: (problem,) int64.
"""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("least_squares", [Path(__file__)]))
EPSILON = float(np.finfo(np.float64).eps)
LEAST_DAMPING, MOST_DAMPING = 1e-30, 1e20
"""Smallest and largest damping."""
SLIGHT = 1e-2
"""Damping, in squares of the smallest pivot of the factor, below which a step is as good as an undamped step.

Such a step gains all that can be gained, and more damping would change nothing.
"""
QUIET = 4
"""Number of successive steps that end a problem if their gain is negligible or less than rounding hides."""
SINGULAR = 1e-7
"""Smallest pivot of a scaled normal matrix whose Cholesky factor still gives a step with two correct digits."""
CLIPS = 3
"""Number of times that a step that leaves the bounds is solved again, with the parameters beyond a bound held there."""
NEAR = 0.1
"""Largest share of the cost that a step saves when the minimum is near."""
GOES_ON, LIMIT, STEP, COST, GRADIENT = 10, 0, 3, 2, 1
"""Mark of a problem that goes on, and some values of framework.least_squares.solution.Status."""


@compiled
@no_type_check
def factored(normal, held, damping, factor):
    """Fill `factor` with the Cholesky factor of the damped matrix of the parameters that are not held.

    It returns the factor's smallest pivot, NaN if there is no factor.
    """
    size = normal.shape[0]
    least = np.inf
    for row in range(size):
        for column in range(row):
            total = 0.0
            if not (held[row] or held[column]):
                total = normal[row, column]
                for inner in range(column):
                    total -= factor[row, inner] * factor[column, inner]
                total /= factor[column, column]
            factor[row, column] = total
        total = 1.0
        if not held[row]:
            total = normal[row, row] + damping
            for inner in range(row):
                total -= factor[row, inner] * factor[row, inner]
            if not total > 0:
                return np.nan
            total = np.sqrt(total)
            least = min(least, total)
        factor[row, row] = total
    return least


@compiled
@no_type_check
def solved(factor, right):
    """Solve L Lᵀ x = right in place."""
    size = factor.shape[0]
    for row in range(size):
        total = right[row]
        for inner in range(row):
            total -= factor[row, inner] * right[inner]
        right[row] = total / factor[row, row]
    for row in range(size - 1, -1, -1):
        total = right[row]
        for inner in range(row + 1, size):
            total -= factor[inner, row] * right[inner]
        right[row] = total / factor[row, row]


@compiled
@no_type_check
def stepped(
    at, lower, upper, cost, gradient, gram, curve, scale, damping, move, gain, slope, least, cut, careful
):
    """Fill the arrays of the damped step within the box.

    `move` is the step. `gain` is the expected decrease of the cost. `slope` is the largest cosine between the residuals
    and a column of the Jacobian. `least` is the square of the factor's smallest pivot. `cut` says whether the box cut
    the step. `careful` says whether the matrix has lost what the Jacobian knows, so that the step must be computed from
    the Jacobian.
    """
    count, size = at.shape
    normal, factor = np.empty((size, size)), np.empty((size, size))
    pull, scaled, known, solution = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    held = np.empty(size, np.bool_)
    for one in range(count):
        careful[one], cut[one] = False, False
        greatest, length = 0.0, np.sqrt(2 * cost[one])
        for i in range(size):
            column = np.sqrt(gram[one, i, i])
            held[i] = (
                (at[one, i] <= lower[one, i] and gradient[one, i] >= 0)
                or (at[one, i] >= upper[one, i] and gradient[one, i] <= 0)
                or column <= EPSILON * scale[one, i]  # the residuals do not depend on it here
            )
            if not held[i]:
                cosine = abs(gradient[one, i] / (column * length))
                if cosine > greatest:
                    greatest = cosine
            scaled[i] = scale[one, i] if scale[one, i] > 0 else 1.0
            pull[i] = gradient[one, i] / scaled[i]
            known[i] = 0.0
        slope[one] = greatest
        for i in range(size):
            for j in range(size):
                normal[i, j] = (gram[one, i, j] + curve[one, i, j]) / (scaled[i] * scaled[j])
        pivot = factored(normal, held, damping[one], factor)
        if not pivot >= SINGULAR:  # the Hessian is not positive definite there
            for i in range(size):
                for j in range(size):
                    normal[i, j] = gram[one, i, j] / (scaled[i] * scaled[j])
            pivot = factored(normal, held, damping[one], factor)
        least[one] = pivot * pivot
        for turn in range(CLIPS + 1):
            if not pivot >= SINGULAR:
                careful[one] = True
                break
            for i in range(size):
                push = pull[i]
                for j in range(size):
                    push += normal[i, j] * known[j]
                solution[i] = 0.0 if held[i] else -push
            solved(factor, solution)
            out = False
            for i in range(size):
                if held[i]:
                    solution[i] = known[i]
                    continue
                below = (lower[one, i] - at[one, i]) * scaled[i]
                above = (upper[one, i] - at[one, i]) * scaled[i]
                if solution[i] < below or solution[i] > above:
                    solution[i] = min(max(solution[i], below), above)
                    if turn < CLIPS:
                        known[i] = solution[i]
                        held[i] = out = True
            if not out:
                break
            cut[one] = True
            pivot = factored(normal, held, damping[one], factor)
        expected, told = 0.0, 0.0
        for i in range(size):
            push = 0.0
            for j in range(size):
                push += normal[i, j] * solution[j]
            expected -= solution[i] * (pull[i] + push / 2)
            told += (
                solution[i] * (damping[one] * solution[i] - pull[i]) / 2
            )  # equals `expected` if the step is exact
            move[one, i] = solution[i] / scaled[i]
        gain[one] = expected
        if not cut[one] and abs(expected - told) > told / 10:
            careful[one] = True


@compiled
@no_type_check
def judged(
    at, cost, gradient, gram, curve, scale, damping, streak, quiet, steps,
    move, gain, slope, least, cut, tried, new_cost, new_gradient, new_gram,
    most, decrease, shortest, ended, near,
):  # fmt: skip
    """Accept or reject each step, in place; fill `ended`, and `near` with whether second derivatives are needed."""
    count, size = at.shape
    for one in range(count):
        moved, reached, finite = 0.0, 0.0, 0.0
        for i in range(size):
            moved += (scale[one, i] * move[one, i]) ** 2
            reached += (scale[one, i] * at[one, i]) ** 2
            finite += new_gradient[one, i] - new_gradient[one, i]
            for j in range(size):
                finite += new_gram[one, i, j] - new_gram[one, i, j]
        short = np.sqrt(moved) <= shortest * np.sqrt(reached)
        stuck = short and cut[one]  # in a corner of the box, which a more damped step can leave
        gained = cost[one] - new_cost[one]  # NaN if the model is not finite there
        ratio = gained / gain[one]
        negligible = abs(gain[one]) <= decrease * cost[one] and not stuck
        good = (ratio > 1e-4 and gain[one] > 0) or (negligible and gained >= -8 * EPSILON * cost[one])
        # Rounding of the residuals hides the gain of a weakly determined direction, unless it is damped less.
        rounding = 8 * EPSILON * np.sqrt(2 * cost[one]) * np.sqrt(reached)
        hidden = abs(gain[one]) <= rounding and not stuck
        good = good or (hidden and gain[one] > 0 and gained >= -rounding)
        good = good and finite == 0 and not stuck
        settled = negligible and damping[one] <= SLIGHT * least[one]
        quiet[one] = quiet[one] + 1 if negligible or hidden else 0
        steps[one] += 1
        # Successive steps divide damping by 10, 100, 10⁴, ..., or multiply it by 4, 8, 16, ...
        if not good:
            streak[one] = min(streak[one], 0) - 1
            damping[one] = max(damping[one], SLIGHT * least[one]) * 2.0 ** (1 - streak[one])
        elif ratio > 0.5 or negligible or hidden:
            streak[one] = max(streak[one], 0) + 1
            damping[one] *= 0.1 ** (2.0 ** min(streak[one] - 1, 5))
        else:
            streak[one] = 0
        damping[one] = max(damping[one], LEAST_DAMPING)
        ended[one] = GOES_ON
        if steps[one] >= most:
            ended[one] = LIMIT
        if (short and not stuck) or damping[one] > MOST_DAMPING:
            ended[one] = STEP
        if settled or quiet[one] >= QUIET:
            ended[one] = COST
        if slope[one] <= 4 * EPSILON:
            ended[one] = GRADIENT
        near[one] = good and gained <= NEAR * cost[one] and ended[one] == GOES_ON
        if good:
            cost[one] = new_cost[one]
            for i in range(size):
                at[one, i], gradient[one, i] = tried[one, i], new_gradient[one, i]
                scale[one, i] = max(scale[one, i], np.sqrt(new_gram[one, i, i]))
                for j in range(size):
                    gram[one, i, j] = new_gram[one, i, j]
                    curve[one, i, j] = 0.0


@compiled
@no_type_check
def inverted(gram, inverse, trace):
    """Fill `inverse` with the inverse of each matrix, and `trace` with the trace of the inverse of the scaled matrix.

    The scaled matrix has a diagonal of 1. The trace is NaN if the matrix has no inverse.
    """
    count, size = gram.shape[0], gram.shape[1]
    normal, factor = np.empty((size, size)), np.empty((size, size))
    scaled, column = np.empty(size), np.empty(size)
    held = np.zeros(size, np.bool_)
    for one in range(count):
        for i in range(size):
            scaled[i] = np.sqrt(gram[one, i, i]) if gram[one, i, i] > 0 else 1.0
        for i in range(size):
            for j in range(size):
                normal[i, j] = gram[one, i, j] / (scaled[i] * scaled[j])
        trace[one] = 0.0
        if not factored(normal, held, 0.0, factor) > 0:
            trace[one] = np.nan
            continue
        for i in range(size):
            column[:] = 0.0
            column[i] = 1.0
            solved(factor, column)
            trace[one] += column[i]
            for j in range(size):
                inverse[one, i, j] = column[j] / (scaled[i] * scaled[j])
