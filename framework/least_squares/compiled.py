"""One step of many small least-squares problems on one CPU core; compiled functions on NumPy arrays.

framework.least_squares.solver explains the method. The first dimension of every array is the problem, and p is the
number of parameters of a problem. J is the Jacobian of the residuals r of a problem. Real arrays are float64.
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
"""Damping that hardly changes a step, so that less is not needed; in units of the Cholesky factor's smallest pivot²."""
QUIET = 4
"""Number of successive steps that end a problem if their gain is negligible or smaller than rounding errors."""
SINGULAR = 1e-7
"""Smallest pivot of a scaled normal matrix whose Cholesky factor still gives a step with two correct digits."""
CLIPS = 3
"""Number of times that a step that leaves the bounds is solved again, with the parameters beyond a bound held there."""
NEAR = 0.1
"""Share of the cost; if an accepted step lowers the cost by at most this share, the minimum counts as near."""
GOES_ON, LIMIT, STEP, COST, GRADIENT = 10, 0, 3, 2, 1
"""Values of `ended` in `judge_steps`: GOES_ON for a problem that has not ended, else a value of `solution.Status`."""


@compiled
@no_type_check
def factorise(normal, fixed, damping, factor):
    """Fill `factor` with the lower Cholesky factor of `normal` + `damping` · identity, and return its smallest pivot.

    The pivots are the diagonal elements of the factor. The function returns NaN if the matrix is not positive definite.

    Args:
        normal: matrix of one problem, (p, p); only the lower triangle is read.
        fixed: true for each parameter whose row and column are replaced by those of the identity matrix, (p,).
        damping: number that is added to the diagonal.
        factor: filled with the factor, (p, p); the upper triangle is not written.
    """
    size = normal.shape[0]
    least = np.inf
    for row in range(size):
        for column in range(row):
            total = 0.0
            if not (fixed[row] or fixed[column]):
                total = normal[row, column]
                for inner in range(column):
                    total -= factor[row, inner] * factor[column, inner]
                total /= factor[column, column]
            factor[row, column] = total
        total = 1.0
        if not fixed[row]:
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
def solve(factor, right):
    """Solve L Lᵀ x = `right`, (p,), where L is the Cholesky factor `factor`, (p, p); x overwrites `right`."""
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
def compute_steps(
    at, lower, upper, cost, gradient, gram, curve, scale, damping, move, gain, slope, least, cut, careful
):
    """Compute the damped step of every problem within its bounds, and fill the arrays that describe the step.

    J is the Jacobian of the residuals r of a problem with p parameters.

    Args:
        at: parameters, (problem, p).
        lower: lower bounds of the parameters, (problem, p).
        upper: upper bounds of the parameters, (problem, p).
        cost: half the sum of squared residuals, (problem,).
        gradient: Jᵀr, (problem, p).
        gram: JᵀJ, (problem, p, p).
        curve: difference between the Hessian of the cost and JᵀJ, 0 far from the minimum, (problem, p, p).
        scale: largest length so far of each column of J, (problem, p).
        damping: damping in units of the square of `scale`, (problem,).
        move: filled with the step, (problem, p).
        gain: filled with the expected decrease of the cost, (problem,).
        slope: filled with the largest cosine of the angle between the residuals and a column of J, (problem,).
        least: filled with the square of the smallest pivot of the Cholesky factor, (problem,).
        cut: filled with true where a bound made the step shorter, (problem,).
        careful: filled with true where the normal matrix has lost digits that J still has, so that the step must be
            computed from J, (problem,).
    """
    count, size = at.shape
    normal, factor = np.empty((size, size)), np.empty((size, size))
    pull, scaled, known, solution = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    fixed = np.empty(size, np.bool_)
    for problem in range(count):
        careful[problem], cut[problem] = False, False
        greatest, length = 0.0, np.sqrt(2 * cost[problem])
        for i in range(size):
            column = np.sqrt(gram[problem, i, i])
            fixed[i] = (
                (at[problem, i] <= lower[problem, i] and gradient[problem, i] >= 0)
                or (at[problem, i] >= upper[problem, i] and gradient[problem, i] <= 0)
                or column <= EPSILON * scale[problem, i]  # the residuals do not depend on it here
            )
            if not fixed[i]:
                cosine = abs(gradient[problem, i] / (column * length))
                if cosine > greatest:
                    greatest = cosine
            scaled[i] = scale[problem, i] if scale[problem, i] > 0 else 1.0
            pull[i] = gradient[problem, i] / scaled[i]
            known[i] = 0.0
        slope[problem] = greatest
        for i in range(size):
            for j in range(size):
                normal[i, j] = (gram[problem, i, j] + curve[problem, i, j]) / (scaled[i] * scaled[j])
        pivot = factorise(normal, fixed, damping[problem], factor)
        if not pivot >= SINGULAR:  # the Hessian is not positive definite there
            for i in range(size):
                for j in range(size):
                    normal[i, j] = gram[problem, i, j] / (scaled[i] * scaled[j])
            pivot = factorise(normal, fixed, damping[problem], factor)
        least[problem] = pivot * pivot
        for turn in range(CLIPS + 1):
            if not pivot >= SINGULAR:
                careful[problem] = True
                break
            for i in range(size):
                push = pull[i]
                for j in range(size):
                    push += normal[i, j] * known[j]
                solution[i] = 0.0 if fixed[i] else -push
            solve(factor, solution)
            out = False
            for i in range(size):
                if fixed[i]:
                    solution[i] = known[i]
                    continue
                below = (lower[problem, i] - at[problem, i]) * scaled[i]
                above = (upper[problem, i] - at[problem, i]) * scaled[i]
                if solution[i] < below or solution[i] > above:
                    solution[i] = min(max(solution[i], below), above)
                    if turn < CLIPS:
                        known[i] = solution[i]
                        fixed[i] = out = True
            if not out:
                break
            cut[problem] = True
            pivot = factorise(normal, fixed, damping[problem], factor)
        expected, exact_gain = 0.0, 0.0
        for i in range(size):
            push = 0.0
            for j in range(size):
                push += normal[i, j] * solution[j]
            expected -= solution[i] * (pull[i] + push / 2)
            exact_gain += (
                solution[i] * (damping[problem] * solution[i] - pull[i]) / 2
            )  # equals `expected` if the step is exact
            move[problem, i] = solution[i] / scaled[i]
        gain[problem] = expected
        if not cut[problem] and abs(expected - exact_gain) > exact_gain / 10:
            careful[problem] = True


@compiled
@no_type_check
def judge_steps(
    at, cost, gradient, gram, curve, scale, damping, streak, quiet, steps,
    move, gain, slope, least, cut, tried, new_cost, new_gradient, new_gram,
    most, decrease, shortest, ended, near,
):  # fmt: skip
    """Accept or reject the step of every problem, and update the state of the problem accordingly.

    J is the Jacobian of the residuals r of a problem with p parameters.

    Args:
        at: parameters, (problem, p); updated.
        cost: half the sum of squared residuals, (problem,); updated.
        gradient: Jᵀr, (problem, p); updated.
        gram: JᵀJ, (problem, p, p); updated.
        curve: difference between the Hessian of the cost and JᵀJ, (problem, p, p); set to 0 if the step is accepted.
        scale: largest length so far of each column of J, (problem, p); updated.
        damping: damping in units of the square of `scale`, (problem,); updated.
        streak: number of successive steps that lowered the damping, or minus the number of successive rejected steps,
            (problem,); updated.
        quiet: number of successive steps with a gain that is negligible or smaller than rounding errors, (problem,);
            updated.
        steps: number of steps tried, (problem,); updated.
        move: step, (problem, p); `compute_steps` fills `move` and the next four arguments.
        gain: expected decrease of the cost, (problem,).
        slope: largest cosine of the angle between the residuals and a column of J, (problem,).
        least: square of the smallest pivot of the Cholesky factor, (problem,).
        cut: true where a bound made the step shorter, (problem,).
        tried: parameters after the step, (problem, p).
        new_cost: cost at `tried`.
        new_gradient: gradient at `tried`.
        new_gram: JᵀJ at `tried`.
        most: largest number of steps, an argument of `least_squares`.
        decrease: smallest relative decrease of the cost, an argument of `least_squares`.
        shortest: smallest relative step, the argument `step` of `least_squares`.
        ended: filled with GOES_ON, or with the status of a problem that has ended, (problem,).
        near: filled with true where the minimum is near, so that second derivatives are needed, (problem,).
    """
    count, size = at.shape
    for problem in range(count):
        moved, reached, finite = 0.0, 0.0, 0.0
        for i in range(size):
            moved += (scale[problem, i] * move[problem, i]) ** 2
            reached += (scale[problem, i] * at[problem, i]) ** 2
            finite += new_gradient[problem, i] - new_gradient[problem, i]
            for j in range(size):
                finite += new_gram[problem, i, j] - new_gram[problem, i, j]
        short = np.sqrt(moved) <= shortest * np.sqrt(reached)
        stuck = short and cut[problem]  # in a corner of the box, which a more damped step can leave
        gained = cost[problem] - new_cost[problem]  # NaN if the model is not finite there
        ratio = gained / gain[problem]
        negligible = abs(gain[problem]) <= decrease * cost[problem] and not stuck
        good = (ratio > 1e-4 and gain[problem] > 0) or (negligible and gained >= -8 * EPSILON * cost[problem])
        # Rounding of the residuals hides the gain of a weakly determined direction, unless it is damped less.
        rounding = 8 * EPSILON * np.sqrt(2 * cost[problem]) * np.sqrt(reached)
        hidden = abs(gain[problem]) <= rounding and not stuck
        good = good or (hidden and gain[problem] > 0 and gained >= -rounding)
        good = good and finite == 0 and not stuck
        settled = negligible and damping[problem] <= SLIGHT * least[problem]
        quiet[problem] = quiet[problem] + 1 if negligible or hidden else 0
        steps[problem] += 1
        # Successive steps divide damping by 10, 100, 10⁴, ..., or multiply it by 4, 8, 16, ...
        if not good:
            streak[problem] = min(streak[problem], 0) - 1
            damping[problem] = max(damping[problem], SLIGHT * least[problem]) * 2.0 ** (1 - streak[problem])
        elif ratio > 0.5 or negligible or hidden:
            streak[problem] = max(streak[problem], 0) + 1
            damping[problem] *= 0.1 ** (2.0 ** min(streak[problem] - 1, 5))
        else:
            streak[problem] = 0
        damping[problem] = max(damping[problem], LEAST_DAMPING)
        ended[problem] = GOES_ON
        if steps[problem] >= most:
            ended[problem] = LIMIT
        if (short and not stuck) or damping[problem] > MOST_DAMPING:
            ended[problem] = STEP
        if settled or quiet[problem] >= QUIET:
            ended[problem] = COST
        if slope[problem] <= 4 * EPSILON:
            ended[problem] = GRADIENT
        near[problem] = good and gained <= NEAR * cost[problem] and ended[problem] == GOES_ON
        if good:
            cost[problem] = new_cost[problem]
            for i in range(size):
                at[problem, i], gradient[problem, i] = tried[problem, i], new_gradient[problem, i]
                scale[problem, i] = max(scale[problem, i], np.sqrt(new_gram[problem, i, i]))
                for j in range(size):
                    gram[problem, i, j] = new_gram[problem, i, j]
                    curve[problem, i, j] = 0.0


@compiled
@no_type_check
def invert(gram, inverse, trace):
    """Fill `inverse` with the inverse of each matrix in `gram`, and `trace` with the trace of a scaled inverse.

    For the trace, rows and columns of the matrix are first scaled so that its diagonal is 1. The trace is NaN if the
    matrix has no inverse; the matrix in `inverse` is then not written.

    Args:
        gram: JᵀJ for the Jacobian J of each problem, (problem, p, p).
        inverse: filled with the inverses, (problem, p, p).
        trace: filled with the traces, (problem,).
    """
    count, size = gram.shape[0], gram.shape[1]
    normal, factor = np.empty((size, size)), np.empty((size, size))
    scaled, column = np.empty(size), np.empty(size)
    fixed = np.zeros(size, np.bool_)
    for problem in range(count):
        for i in range(size):
            scaled[i] = np.sqrt(gram[problem, i, i]) if gram[problem, i, i] > 0 else 1.0
        for i in range(size):
            for j in range(size):
                normal[i, j] = gram[problem, i, j] / (scaled[i] * scaled[j])
        trace[problem] = 0.0
        if not factorise(normal, fixed, 0.0, factor) > 0:
            trace[problem] = np.nan
            continue
        for i in range(size):
            column[:] = 0.0
            column[i] = 1.0
            solve(factor, column)
            trace[problem] += column[i]
            for j in range(size):
                inverse[problem, i, j] = column[j] / (scaled[i] * scaled[j])
