"""The von Mises density and its samples on one CPU core; compiled functions on NumPy arrays.

`functions.py` explains the formulas. The arrays of a call are one-dimensional, contiguous, and of one dtype, which is
also the dtype of the computation: float32 or float64 for the density, float64 for samples. The loops have no branches,
so that the compiler computes several elements at once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.extending import intrinsic, overload
from numpy.polynomial import Chebyshev, Polynomial

from framework.storage.kernels import compiler, kernel_cache
from plugins.density_head.von_mises import coefficients

_SOURCES = Path(__file__), Path(coefficients.__file__), coefficients.SOURCE
# The sum of a product and a number may be rounded once only, and the sign of zero may change.
compiled = compiler(kernel_cache("von_mises", _SOURCES), fastmath={"contract", "nsz"})


def _intrinsic(function: Callable[..., Any]) -> Any:
    """Return a function that compiled code can call, for a function that generates the instructions."""
    return intrinsic(no_type_check(function))


@_intrinsic
def multiply_add(typing, first, second, third):
    """Return first · second + third, rounded once.

    Compiled code calls the function without `typing`, which numba adds.
    """

    def generate(context, builder, sig, values):
        return builder.fma(*values)

    return first(first, first, first), generate


def _same_bits(source: Any, kind: Any) -> tuple[Any, Callable[..., Any]]:
    """Return the signature and the code of a function that reads the bits of a number as another type.

    `source` is numba's type of the number, and `kind` the type of the result.
    """

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return builder.bitcast(values[0], context.get_value_type(kind))

    return kind(source), generate


@_intrinsic
def bits_of(typing, number):
    """Return the integer of 32 or 64 bits that has the same bits as a floating-point number.

    Compiled code calls the function without `typing`, which numba adds.
    """
    return _same_bits(number, types.int32 if number == types.float32 else types.int64)


@_intrinsic
def number_of(typing, bits):
    """Return the floating-point number that has the same bits as an integer of 32 or 64 bits.

    Compiled code calls the function without `typing`, which numba adds.
    """
    return _same_bits(bits, types.float32 if bits == types.int32 else types.float64)


@_intrinsic
def use_widest_registers(typing):
    """Let the loops of the calling function use registers of 512 bits where the processor has them.

    The compiler uses 256 bits by default, since older processors lower their frequency otherwise; the loops of this
    file take 25 % longer with 256 bits on a processor of 2023. Compiled code calls the function without `typing`, which
    numba adds.
    """

    def generate(context, builder, sig, values):
        # llvmlite's own `add` knows no attributes with a value
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), generate


@no_type_check
def _polynomial(coefficients_by_bits):
    """Return a compiled function of x: the polynomial with these coefficients of 1, x, x², … .

    The coefficients are given for each number of bits of x. A polynomial with one coefficient is a constant.
    """

    @_intrinsic
    def evaluate(typing, x):
        def generate(context, builder, sig, values):
            kind = context.get_value_type(x)
            *rest, total = (ir.Constant(kind, float(number)) for number in coefficients_by_bits[x.bitwidth])
            for number in reversed(rest):
                total = builder.fma(total, values[0], number)
            return total

        return x(x), generate

    return evaluate


@no_type_check
def _economise(terms: Sequence[float], low: float, high: float, degrees: Mapping[int, int]):
    """Return a compiled polynomial that approximates a power series on [low, high].

    Args:
        terms: coefficients of the power series.
        low: lower end of the interval.
        high: upper end of the interval.
        degrees: degree of the polynomial by the number of bits of its argument. The Chebyshev terms above it are left
            out; their sum is below a quarter of the last digit of the result.
    """
    series = Polynomial(terms).convert(domain=[low, high], kind=Chebyshev)
    return _polynomial(
        {bits: series.truncate(degree + 1).convert(kind=Polynomial).coef for bits, degree in degrees.items()}
    )


@no_type_check
def _constant(of_32: str, of_64: str):
    return _polynomial({32: [float.fromhex(of_32)], 64: [float.fromhex(of_64)]})


_sine_rest = _economise([(-1) ** j / math.factorial(2 * j + 1) for j in range(1, 18)], 0, 2.5, {32: 3, 64: 8})
"""(sin r / r - 1) / r² as a function of r², for |r| up to 1.58."""
_cosine_rest = _economise(
    [-((-1) ** j) / math.factorial(2 * j) for j in range(1, 18)], 0, 2.5, {32: 4, 64: 8}
)
"""(1 - cos r) / r² as a function of r², for |r| up to 1.58."""
_log_rest = _economise([2 / (2 * j + 1) for j in range(1, 26)], 0, 0.0295, {32: 2, 64: 7})
"""(log((1+q)/(1-q)) / q - 2) / q² as a function of q², for (1+q)/(1-q) between 1/√2 and √2."""
_sine_of_turn = _economise(
    [(-1) ** j * math.pi ** (2 * j + 1) / math.factorial(2 * j + 1) for j in range(18)], 0, 1 / 16, {64: 7}
)
"""sin(πy) / y as a function of y², for |y| up to 1/4."""
_cosine_of_turn = _economise(
    [(-1) ** j * math.pi ** (2 * j) / math.factorial(2 * j) for j in range(18)], 0, 1 / 16, {64: 7}
)
"""cos(πy) as a function of y², for |y| up to 1/4."""
_arctangent = _economise([(-1) ** j / (2 * j + 1) for j in range(40)], 0, 0.1716, {64: 11})
"""arctan(z) / z as a function of z², for |z| up to √2 - 1."""
_exponential = _economise([1 / math.factorial(j) for j in range(25)], -0.35, 0.35, {64: 12})
"""exp(r) for |r| up to log(2)/2."""
_pi_high = _constant("0x1.921fb6p+1", "0x1.921fb54442d18p+1")
_pi_middle = _constant("-0x1.777a5cp-24", "0x1.1a62633145c07p-53")
_pi_low = _constant("-0x1.ee59dap-49", "-0x1.f1976b7ed8fbcp-109")
_reach = _polynomial({32: [4e6], 64: [4e8]})
"""Largest difference φ-μ, radians, that is reduced modulo π without an error."""
_root_half = _constant("0x1.6a09e6p-1", "0x1.6a09e667f3bcdp-1")


@no_type_check
def _peak(part) -> Any:
    """Return the polynomial "log_peak" (coefficients.py) at `part` = 2/(κ+2), and its derivative there."""


@overload(_peak, inline="always")
@no_type_check
def _(part):
    dtype = np.float32 if part == types.float32 else np.float64
    integer = np.int32 if part == types.float32 else np.int64
    table = np.ascontiguousarray(coefficients.TABLES[dtype.__name__]["log_peak"], dtype=dtype)
    rows, pieces = table.shape
    last, count, one, two = integer(pieces - 1), dtype(pieces), dtype(1), dtype(2)

    def evaluate(part):
        place = part * count
        # NaN has no piece: it gets any piece, and stays NaN in y
        piece = min(max(integer(place), integer(0)), last)
        y = two * (place - dtype(piece)) - one
        slope = dtype(0)
        total = table[rows - 1, piece]
        for row in range(rows - 2, -1, -1):
            slope = multiply_add(slope, y, total)
            total = multiply_add(total, y, table[row, piece])
        return total, slope * (two * count)

    return evaluate


@no_type_check
def _parts(value, mean, concentration) -> Any:
    """Return the terms of log p, and of its derivatives, for one element.

    Returns:
        The log-density at the mean; sin(φ-μ); 1 - cos(φ-μ); 1 - A(κ); and 1 if other code must compute the element, or
        else 0: φ-μ is beyond the reach of the reduction, or an argument is NaN, or κ < 0.
    """


@overload(_parts, inline="always")
@no_type_check
def _(value, mean, concentration):
    dtype = np.float32 if value == types.float32 else np.float64
    integer = np.int32 if value == types.float32 else np.int64
    zero, quarter, half, one, two = (dtype(number) for number in (0, 0.25, 0.5, 1, 2))
    digits = integer(np.finfo(dtype).nmant)
    inverse_pi, log_2 = dtype(1 / math.pi), dtype(math.log(2))

    def evaluate(value, mean, concentration):
        # φ-μ = high + low exactly (Knuth's two-sum), and = nπ + r with the smallest |r|
        high = value - mean
        back = value - high
        low = (value - (high + back)) + (back - mean)
        turns = np.rint(high * inverse_pi)
        rest = multiply_add(-turns, _pi_high(high), high)
        rest = multiply_add(-turns, _pi_middle(high), rest)
        rest = multiply_add(-turns, _pi_low(high), rest) + low
        square = rest * rest
        sine = multiply_add(rest * square, _sine_rest(square), rest)
        fall = square * _cosine_rest(square)
        halves = half * turns
        odd = halves != np.rint(halves)
        sine = -sine if odd else sine
        fall = two - fall if odd else fall
        # log(κ+2) = exponent · log 2 + log m with m between 1/√2 and √2
        shifted = concentration + two
        least = bits_of(_root_half(shifted))
        bits = bits_of(shifted)
        exponent = integer(integer(bits - least) >> digits)
        m = number_of(integer(bits - integer(exponent << digits)))
        q = (m - one) / (m + one)
        q_square = q * q
        logarithm = multiply_add(
            dtype(exponent), log_2, multiply_add(q * q_square, _log_rest(q_square), two * q)
        )
        part = two / shifted
        total, slope = _peak(part)
        height = multiply_add(half, logarithm, -total)
        deviation = part * multiply_add(part, slope * half, quarter)
        lost = integer(not (abs(high) <= _reach(high))) | integer(not (concentration >= zero))
        return height, sine, fall, deviation, lost

    return evaluate


@compiled
@no_type_check
def log_prob(value, mean, concentration, result):
    """Fill `result` with the log-density, nats.

    Args:
        value: angles φ, radians.
        mean: μ, radians.
        concentration: κ.
        result: filled with log p(φ).

    Returns:
        0 if all elements are valid. Another number if a difference φ-μ is too large for these functions, or a κ is
        negative or NaN; all elements must then be computed by other code.
    """
    use_widest_registers()
    lost = 0
    for i in range(len(result)):
        height, _, fall, _, outside = _parts(value[i], mean[i], concentration[i])
        result[i] = height - concentration[i] * fall
        lost |= outside
    return lost


@compiled
@no_type_check
def log_prob_and_slopes(value, mean, concentration, result, by_mean, by_concentration):
    """Fill `result` with the log-density, nats, and two further arrays with its derivatives.

    Args:
        value: angles φ, radians.
        mean: μ, radians.
        concentration: κ.
        result: filled with log p(φ).
        by_mean: filled with the derivative of log p with respect to μ.
        by_concentration: filled with the derivative of log p with respect to κ.

    Returns:
        0, or another number if other code must compute the elements, as `log_prob`.
    """
    use_widest_registers()
    lost = 0
    for i in range(len(result)):
        height, sine, fall, deviation, outside = _parts(value[i], mean[i], concentration[i])
        result[i] = height - concentration[i] * fall
        by_mean[i] = concentration[i] * sine
        by_concentration[i] = deviation - fall
        lost |= outside
    return lost


@compiled
@no_type_check
def set_up(concentration, scale, floor, lanes):
    """Fill the arrays that `propose` reads.

    ρ is the parameter of the wrapped Cauchy density that `functions.sample` describes.

    Args:
        concentration: κ of each element.
        scale: filled with (1-ρ)/(1+ρ), by which tan(πu/2) is multiplied to give a proposal tan(θ/2).
        floor: filled with κ(1-ρ)²/(2ρ). A proposal is accepted with the probability c exp(1-c), where c is this number
            plus κ(1 - cos θ).
        lanes: filled with 0, 1, 2, …, the index of each element.
    """
    for i in range(len(concentration)):
        kappa = concentration[i]
        double = 2 * kappa
        # above 1e8 the 1 is lost in rounding, and the square may overflow
        small = min(double, 1e8)
        root = np.sqrt(1 + small * small) if double <= 1e8 else double
        tau = 1 + root
        double_root = np.sqrt(2 * tau)
        span = tau + double_root  # 2κ/ρ
        rest = 1 + 1 / (root + double) + double_root  # (1 - ρ) span
        scale[i] = rest / (span + double)
        floor[i] = rest * rest / span / 4
        lanes[i] = i


@compiled
@no_type_check
def propose(concentration, scale, floor, lanes, uniform, accept, proposed, excess, half_tangent):
    """Draw one proposal for each remaining element, and return the number of rejected proposals.

    The remaining elements, as many as `uniform` has numbers, are at the front of `concentration`, `scale`, `floor` and
    `lanes`. Afterwards, the elements with rejected proposals are at the front of these arrays, for the next call.

    Args:
        concentration: κ; overwritten.
        scale: constants from `set_up`; overwritten.
        floor: constants from `set_up`; overwritten.
        lanes: index of each element in `half_tangent`; overwritten.
        uniform: numbers drawn uniformly from [0, 1), from which the proposals are computed.
        accept: numbers drawn uniformly from [0, 1), which decide whether a proposal is accepted.
        proposed: array for intermediate results.
        excess: array for intermediate results.
        half_tangent: tan(θ/2) of the last proposal of each element; the proposals of this call are written into it.
    """
    count = len(uniform)
    for i in range(count):
        # scale · tan(π x) as a quotient of sine and cosine, without an overflow near the poles
        x = uniform[i] - 0.5
        size = abs(x)
        steep = size > 0.25
        y = 0.5 - size if steep else size
        y_square = y * y
        sine, cosine = y * _sine_of_turn(y_square), _cosine_of_turn(y_square)
        upper = scale[i] * (cosine if steep else sine)
        lower = sine if steep else cosine
        proposed[i] = (upper if x >= 0 else -upper) / lower
        upper_square = upper * upper
        cost = floor[i] + concentration[i] * (2 * upper_square / (lower * lower + upper_square))
        # exp(1 - cost)
        exponent = max(1 - cost, -700.0)
        turns = np.rint(exponent * 1.4426950408889634)
        rest = multiply_add(-turns, 0.6931471805599453, exponent)
        rest = multiply_add(-turns, 2.3190468138462996e-17, rest)
        power = number_of((np.int64(turns) + 1023) << 52)
        excess[i] = accept[i] - cost * (_exponential(rest) * power)
    rejected = 0
    for i in range(count):
        half_tangent[lanes[i]] = proposed[i]
        concentration[rejected] = concentration[i]
        scale[rejected] = scale[i]
        floor[rejected] = floor[i]
        lanes[rejected] = lanes[i]
        rejected += not (excess[i] < 0)
    return rejected


@compiled
@no_type_check
def turn(half_tangent, mean, angle):
    """Fill `angle` with mean + 2 arctan(half_tangent), wrapped to [-π, π].

    Angles that lie in [-π, π] without wrapping are not rounded again. `mean` may have another dtype than the other
    arrays.
    """
    beyond = 0
    for i in range(len(angle)):
        size = abs(half_tangent[i])
        steep = size > 1
        short, long = 1.0 if steep else size, size if steep else 1.0
        z = short / (long + np.sqrt(short * short + long * long))  # the tangent of half the angle
        distance = 4 * (z * _arctangent(z * z))
        distance = math.pi - distance if steep else distance
        angle[i] = mean[i] + (distance if half_tangent[i] >= 0 else -distance)
        beyond |= not abs(angle[i]) <= math.pi
    if beyond:
        for i in range(len(angle)):
            if not abs(angle[i]) <= math.pi:
                wrapped = np.fmod(angle[i] + math.pi, 2 * math.pi)
                angle[i] = (wrapped + 2 * math.pi if wrapped < 0 else wrapped) - math.pi
