"""The von Mises density p(φ) = exp(κ cos(φ-μ)) / (2π I0(κ)) (thesis eq. 3.3), accurate from κ = 0 to 1e30.

Nothing here subtracts two large numbers that nearly agree: the density is written as its height at the mean
times exp(-2κ sin²((φ-μ)/2)), and the Bessel functions come from polynomials (coefficients.py) of what stays
smooth from κ = 0 to infinity. Arguments broadcast, are float32 or float64, and κ ≥ 0.

The density's value and slopes come from one pass, also under torch.compile; without a compiler the pass runs in
blocks that fit a processor's cache. Integrals (`kl_divergence`, `cdf`, `half_width`) are sums of positive terms by
Gauss-Legendre quadrature, so that small results keep their digits too.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from plugins.von_mises.coefficients import CHAINS, NODES, TABLES

SAMPLING_ROUNDS = 64
"""At least 65.7 % of proposals are accepted: after 64 rounds fewer than one lane in 10^29 is left."""

BLOCK = 2**16
"""Elements of a pass on a processor without a compiler: its intermediate results stay in the cache."""

ROUNDS = 64
"""Of the inversion in `half_width`: bisection alone narrows [0, π] to its last digit in 53."""

CUT = 40.0
"""Integrals of the density end where it has fallen by exp(-40) from where they begin: a quarter of float64's
last digit, even in the tail."""

_TABLES = {
    (getattr(torch, dtype), name): torch.tensor(rows, dtype=getattr(torch, dtype), device="cpu")
    for dtype, functions in TABLES.items()
    for name, rows in functions.items()
}


def log_prob(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Log-density, nats, with accurate gradients in all three arguments, also the second ones.

    The difference φ-μ is never rounded: angles of up to 4e8 radians are read modulo 2π exactly, beyond that to one
    unit of their rounding.
    """
    dtype = torch.promote_types(torch.promote_types(value.dtype, mean.dtype), concentration.dtype)
    value, mean, concentration = value.to(dtype), mean.to(dtype), concentration.to(dtype)
    if torch.is_grad_enabled() and (value.requires_grad or mean.requires_grad or concentration.requires_grad):
        return _LogProb.apply(value, mean, concentration)[0]
    return _in_blocks(_value, value, mean, concentration)[0]


def log_prob_and_slopes(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """log p, its derivative in the mean, κ sin(φ-μ), and in κ, 1 - A(κ) - 2 sin²((φ-μ)/2), in one pass.

    For arguments of one number type, without gradient of its own: what `log_prob` computes under gradient. Compiled,
    it is one loop, while a compiler splits the gradient of `log_prob` in two that compute much of the same.
    """
    return _value_and_slopes(value, mean, concentration)


def log_peak(concentration: Tensor) -> Tensor:
    """Log-density at the mean, κ - log(2π I0(κ)), nats."""
    return _LogPeak.apply(concentration)


def mean_resultant(concentration: Tensor) -> Tensor:
    """A(κ) = I1(κ)/I0(κ) = E cos(φ-μ), to full relative precision at both ends."""
    return _Ratio.apply(concentration)


def mean_deviation(concentration: Tensor) -> Tensor:
    """1 - A(κ) = E 2 sin²((φ-μ)/2), to full relative precision at both ends."""
    return _OneMinusRatio.apply(concentration)


def entropy(concentration: Tensor) -> Tensor:
    """κ(1 - A(κ)) - log_peak(κ), nats; its derivative is -κ A'(κ)."""
    return _Entropy.apply(concentration)


def mean_resultant_slope(concentration: Tensor) -> Tensor:
    """A'(κ) = 1 - A² - A/κ (Mardia & Jupp 2000, A.14), the Fisher information of κ."""
    part = 2 / (concentration + 2)
    return _polynomial("ratio_slope", part) * part * part / 2


def kl_divergence(
    first_mean: Tensor, first_concentration: Tensor, second_mean: Tensor, second_concentration: Tensor
) -> Tensor:
    """Kullback-Leibler divergence of the second density from the first, ∫ p₁ log(p₁/p₂), nats.

    A(κ₁) κ₂ (1 - cos(μ₁-μ₂)) + ∫_{κ₁}^{κ₂} (κ₂-x) A'(x) dx, both without a negative part: log I0 has the derivative A,
    so that the integral is log I0(κ₂) - log I0(κ₁) - A(κ₁)(κ₂-κ₁). It is 0 where the densities are equal and keeps
    its digits where they nearly are. Differentiable like `log_prob`.
    """
    turned = -_fall(first_mean, second_mean, mean_resultant(first_concentration) * second_concentration)
    return turned + _Bregman.apply(*torch.broadcast_tensors(first_concentration, second_concentration))


def cdf(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Mass of the arc from mean - π to value, in [0, 1] on that turn; each further turn adds 1, as in SciPy.

    By quadrature in float64: absolute error below 1e-15, relative error of the lower tail below 4e-15 times the
    greater of 1 and its logarithm. Differentiable, once, in all three arguments.
    """
    dtype = torch.promote_types(torch.promote_types(value.dtype, mean.dtype), concentration.dtype)
    wide = (argument.double() for argument in (value, mean, concentration))
    return _Cdf.apply(*torch.broadcast_tensors(*wide)).to(dtype)


@torch.no_grad()
def half_width(mass: Tensor, concentration: Tensor) -> Tensor:
    """Half the width, radians in [0, π], of the shortest arc that holds the mass: it is centred at the mean.

    Newton's method on the mass within or, above one half, on the logarithm of the mass outside, in a bracket that
    bisection narrows where a step leaves it: at most ROUNDS rounds. Without gradient.

    Raises:
        ValueError: a mass outside [0, 1].
    """
    if not bool(((mass >= 0) & (mass <= 1)).all()):
        raise ValueError(
            f"the mass of an arc lies between 0 and 1, got {mass.min().item()} to {mass.max().item()}."
        )
    dtype = torch.promote_types(mass.dtype, concentration.dtype)
    mass, kappa = torch.broadcast_tensors(mass.double(), concentration.double())
    inside = mass <= 0.5
    target = torch.where(inside, mass, 1 - mass) / 2  # of one side
    low, high = torch.zeros_like(mass), torch.full_like(mass, math.pi)
    # the normal density of z = 2√κ sin(θ/2), and the uniform one where that is wider than the circle
    normal = torch.special.ndtri((1 + mass) / 2).clamp(max=38) / (2 * kappa.sqrt())
    width = torch.minimum(2 * torch.asin(normal.clamp(max=1)), math.pi * (1 + 3 * kappa) * mass).nan_to_num()
    done = (mass == 0) | (mass == 1)
    width = torch.where(done, math.pi * mass, width.clamp(max=3.1))
    for _ in range(ROUNDS):
        if bool(done.all()):
            break
        sine, cosine = torch.sin(width / 2), torch.cos(width / 2)
        found, _ = _one_side(sine, cosine, kappa, inside)
        slope = torch.exp(_log_peak(kappa) - 2 * (kappa * sine) * sine)
        too_wide = (found > target) == inside
        low, high = torch.where(too_wide, low, width), torch.where(too_wide, width, high)
        straight = (target - found) / torch.where(inside, slope, -slope)
        following = width + torch.where(inside, straight, found * torch.log(found / target) / slope)
        # near π the mass outside falls like a line, not like an exponential
        following = torch.where((following > low) & (following < high), following, width + straight)
        following = torch.where((following > low) & (following < high), following, (low + high) / 2)
        # so near the step leaves an error of its square
        near = 1e-10 * torch.minimum(width, math.pi - width) + 4e-16 * width
        settled = (straight.abs() <= near) | (high - low <= 4e-16 * high)
        following = torch.where(settled, (width + straight).clamp(0, math.pi), following)
        width = torch.where(done, width, following)
        done = done | settled
    return width.to(dtype)


def interval(mass: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, Tensor]:
    """Both ends, radians, of the shortest arc that holds the mass; the first is not wrapped: it is the lesser."""
    width = half_width(mass, concentration)
    return mean - width, mean + width


def half_angle(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """sin and cos of (φ-μ)/2 up to one common sign, the difference taken without rounding."""
    if _in_single(value, mean):
        return _half_angle_in_single(value, mean)
    sine, cosine, odd = _reduced(value, mean)
    return torch.where(odd > 0, cosine, sine), torch.where(odd > 0, -sine, cosine)


@torch.no_grad()
def concentration_of_moments(resultant: Tensor, deviation: Tensor) -> Tensor:
    """κ with A(κ) = resultant: the maximum-likelihood κ of angles about a known mean (eq. 3.5), float64.

    Args:
        resultant: R, the mean of cos(φ-μ); below 0 it is answered with κ = 0.
        deviation: V = 1 - R, the mean of 2 sin²((φ-μ)/2), given beside it because R carries no digits of a
            large κ and V none of a small one. 0 is answered with infinity.
    """
    resultant, deviation = resultant.double().clamp(min=0), deviation.double()
    spread_out = resultant < 0.5
    # starts within 10 %: the series of the inverse at R = 0 and V = 0 (Mardia & Jupp 2000, 5.3.9-10)
    small = resultant * (2 + resultant**2 + 5 / 6 * resultant**4)
    concentration = torch.where(spread_out, small, 0.5 / deviation + 0.25)
    tiny = torch.finfo(torch.float64).tiny
    for _ in range(8):  # Newton on logarithms, where both branches are nearly straight: 4 steps suffice
        wanted = torch.where(spread_out, resultant, deviation)
        have = torch.where(spread_out, mean_resultant(concentration), mean_deviation(concentration))
        error = torch.log1p((have - wanted) / wanted.clamp(min=tiny))
        slope = concentration * mean_resultant_slope(concentration) / have
        step = error / torch.where(spread_out, slope, -slope)
        # the two ends have no logarithm: they are right already
        step = torch.where((concentration > 0) & concentration.isfinite(), step, 0)
        concentration = concentration * torch.exp(-step)
    return concentration


@torch.no_grad()
def sample(mean: Tensor, concentration: Tensor) -> Tensor:
    """One angle in [-π, π] per element, by rejection (Best & Fisher 1979), float64 inside.

    Best and Fisher propose from a wrapped Cauchy of the same peak; with t = tan(θ/2) its proposal is
    t = (1-ρ)/(1+ρ) tan(πu/2), u uniform on (-1, 1), and 1 - cos θ = 2t²/(1+t²): nothing cancels at any κ.
    Lanes that have not accepted after SAMPLING_ROUNDS keep their last proposal: no input can hang the loop.
    """
    mean, concentration = torch.broadcast_tensors(mean, concentration)
    kappa = concentration.double().flatten()
    block = BLOCK if kappa.device.type == "cpu" else max(1, kappa.numel())
    half_tangent = torch.cat([_half_tangent(part) for part in kappa.split(block)])
    angle = mean.double() + 2 * torch.atan(half_tangent).reshape(mean.shape)
    wrapped = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    # angles that need no wrapping keep their last digits
    return torch.where(angle.abs() <= math.pi, angle, wrapped).to(mean.dtype)


def _half_tangent(kappa: Tensor) -> Tensor:
    """tan(θ/2) of one accepted proposal per lane."""
    root = torch.hypot(torch.ones_like(kappa), 2 * kappa)
    tau = 1 + root
    span = tau + torch.sqrt(2 * tau)  # 2κ/ρ
    gap = (1 + 1 / (root + 2 * kappa) + torch.sqrt(2 * tau)) / span  # 1 - ρ
    scale = gap / (1 + 2 * kappa / span)
    floor = gap * gap * span / 4  # κ(r-1) with r = (1+ρ²)/(2ρ)
    half_tangent, rejected = _propose(kappa, scale, floor)
    lanes = rejected.nonzero().flatten()
    for _ in range(SAMPLING_ROUNDS - 1):
        if lanes.numel() == 0:
            break
        half_tangent[lanes], rejected = _propose(kappa[lanes], scale[lanes], floor[lanes])
        lanes = lanes[rejected]
    return half_tangent


def _propose(kappa: Tensor, scale: Tensor, floor: Tensor) -> tuple[Tensor, Tensor]:
    """tan(θ/2) of one wrapped Cauchy proposal per lane, and whether it is rejected."""
    uniform, accept = torch.rand(2, kappa.numel(), dtype=kappa.dtype, device=kappa.device)
    tangent = scale * torch.tan(math.pi * (uniform - 0.5))
    square = tangent * tangent
    cost = floor + kappa * (2 * square / (1 + square))
    return tangent, ~(accept < cost * torch.exp(1 - cost))


_PI = tuple(
    float.fromhex(part)
    for part in ("0x1.921fb54p+1", "0x1.10b461p-29", "0x1.a62633p-57", "0x1.45c06e0e68948p-85")
)
"""π in three parts of 27 bits, of which a whole number below 2^26 has exact multiples, and a rest."""


def _in_single(value: Tensor, mean: Tensor) -> bool:
    return value.dtype == mean.dtype == torch.float32 and not torch.compiler.is_compiling()


def _half_angle_in_single(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """As `half_angle`, in float32 alone."""
    sine, cosine, small_sine, small_cosine = _parts_in_single(value, mean)
    return sine * small_cosine + cosine * small_sine, cosine * small_cosine - sine * small_sine


def _parts_in_single(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """sin and cos of half of the rounded difference and of what rounding took: fewer operations than `_reduced`.

    float32's sine and cosine read large angles exactly.
    """
    high = value - mean
    with torch.no_grad():
        low = _lost(value, mean, high) / 2
        square = low * low  # below 2^-10 for angles up to 2e6 rad
        small_sine, small_cosine = low - low * square / 6, 1 - square / 2
    half = high / 2
    return torch.sin(half), torch.cos(half), small_sine, small_cosine


def _lost(value: Tensor, mean: Tensor, high: Tensor) -> Tensor:
    """What rounding took from φ-μ: with it `high` is the exact difference (Knuth's two-sum)."""
    back = value - high
    return (value - (high + back)) + (back - mean)


def _reduced(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin and cos of half of what φ-μ is beyond the nearest multiple of π, and that multiple's parity, 0 or 1."""
    if value.dtype == torch.float32 and mean.dtype == torch.float32:
        high = value.double() - mean.double()
        low = None
    else:
        high = value - mean
        with torch.no_grad():
            low = _lost(value, mean, high)
    with torch.no_grad():
        count = torch.round(high * (1 / math.pi))
        odd = 2 * torch.frac(count * 0.5).abs().to(value.dtype)
    rest = high - count * _PI[0] - count * _PI[1] - count * _PI[2]
    rest = (rest.float() if low is None else rest - count * _PI[3] + low) * 0.5
    sine, cosine = _sine_and_cosine(rest)
    return sine, cosine, odd


def _sine_and_cosine(angle: Tensor) -> tuple[Tensor, Tensor]:
    """Of an angle in [-π/4, π/4]."""
    if not torch.compiler.is_compiling():
        return torch.sin(angle), torch.cos(angle)
    # Taylor's series, to 1e-17 and 2e-9: what the compiler calls instead reduces the angle once more
    square = angle * angle
    count = 8 if angle.dtype == torch.float64 else 4
    sine, cosine = torch.zeros_like(square), torch.zeros_like(square)
    for j in range(count, 0, -1):
        sine = (sine + (-1) ** j / math.factorial(2 * j + 1)) * square
        cosine = (cosine + (-1) ** j / math.factorial(2 * j)) * square
    return sine * angle + angle, 1 + cosine


def _in_blocks(function: Callable[..., tuple[Tensor, ...]], *arguments: Tensor) -> tuple[Tensor, ...]:
    """The function, element by element, of arguments of one shape in blocks; of others, and compiled, at once."""
    first = arguments[0]
    if (
        torch.compiler.is_compiling()
        or first.device.type != "cpu"
        or first.numel() <= BLOCK
        or any(argument.shape != first.shape for argument in arguments)
    ):
        return function(*arguments)
    flat = [argument.detach().reshape(-1).split(BLOCK) for argument in arguments]
    results: list[Tensor] = []
    for start, parts in zip(range(0, first.numel(), BLOCK), zip(*flat, strict=True), strict=True):
        made = function(*parts)
        if not results:
            results = [torch.empty(first.numel(), dtype=part.dtype, device=part.device) for part in made]
        for result, part in zip(results, made, strict=True):
            result[start : start + BLOCK] = part
    return tuple(result.view(first.shape) for result in results)


def _place(name: str, v: Tensor) -> tuple[Any, Any, Tensor, Any]:
    """A function's rows of coefficients, v's piece of [0, 1], its place y ∈ [-1, 1] there, and dy/dv.

    Compiled, float32 has few pieces, among whose coefficients comparisons choose; otherwise there is a table.
    """
    if v.dtype == torch.float32 and torch.compiler.is_compiling():
        borders, rows = CHAINS[name]
        beyond = tuple(v >= border for border in borders[1:-1])
        spans = list(pairwise(borders))
        middle = _chosen([(low + high) / 2 for low, high in spans], beyond, v)
        slope = _chosen([2 / (high - low) for low, high in spans], beyond, v)
        return rows, beyond, (v - middle) * slope, slope
    rows = _TABLES[v.dtype, name].to(v.device)
    pieces = rows.shape[1]
    place = v * pieces
    # nan has no piece: it takes one, and stays nan in y
    piece = place.detach().to(torch.int32).clamp_(0, pieces - 1)
    return rows, piece, 2 * (place - piece) - 1, 2 * pieces


def _chosen(values: Sequence[float], beyond: tuple[Tensor, ...], like: Tensor) -> Tensor:
    """The value of the last border that is passed."""
    found = torch.full_like(like, values[0])
    for passed, value in zip(beyond, values[1:], strict=True):
        found = torch.where(passed, value, found)
    return found


def _coefficient(row: Any, piece: Any, like: Tensor) -> Tensor:
    if isinstance(piece, tuple):
        return _chosen(row, piece, like)
    if torch.compiler.is_compiling():
        return row[piece]
    # the same in a quarter of the time where nothing is compiled
    return row.index_select(0, piece.reshape(-1)).view(piece.shape)


def _fused(coefficient: Tensor, total: Tensor, y: Tensor) -> Tensor:
    """coefficient + total y, in the coefficient's own place where nobody else reads it."""
    if torch.compiler.is_compiling() or (torch.is_grad_enabled() and total.requires_grad | y.requires_grad):
        return torch.addcmul(coefficient, total, y)
    return coefficient.addcmul_(total, y)


def _polynomial(name: str, v: Tensor) -> Tensor:
    """One of the smooth functions of v = 2/(κ+2) in fit_coefficients.py."""
    rows, piece, y, _ = _place(name, v)
    total = _coefficient(rows[-1], piece, y)
    for row in range(len(rows) - 2, -1, -1):
        total = _fused(_coefficient(rows[row], piece, y), total, y)
    return total


def _log_peak(concentration: Tensor) -> Tensor:
    return torch.log(concentration + 2) / 2 - _polynomial("log_peak", 2 / (concentration + 2))


def _peak_and_deviation(concentration: Tensor) -> tuple[Tensor, Tensor]:
    """log_peak and its derivative 1 - A = v (1/4 + v G'(v)/2), G the polynomial, in one pass."""
    v = 2 / (concentration + 2)
    rows, piece, y, by_v = _place("log_peak", v)
    total = _coefficient(rows[-1], piece, y)
    slope = torch.zeros_like(total)
    for row in range(len(rows) - 2, -1, -1):
        slope = torch.addcmul(total, slope, y)
        total = _fused(_coefficient(rows[row], piece, y), total, y)
    return torch.log(concentration + 2) / 2 - total, v * (0.25 + v * (slope * (by_v / 2)))


def _one_minus_ratio(concentration: Tensor) -> Tensor:
    return _peak_and_deviation(concentration)[1]


def _value(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor]:
    if _in_single(value, mean):
        sine, cosine, small_sine, small_cosine = _parts_in_single(value, mean)
        square = (sine * small_cosine + cosine * small_sine).square()
    else:
        square, _ = _half_products(value, mean)
    return (_log_peak(concentration) - 2 * concentration * square,)


def _value_and_slopes(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    square, product = _half_products(value, mean)
    height, deviation = _peak_and_deviation(concentration)
    return height - 2 * concentration * square, 2 * concentration * product, deviation - 2 * square


def _half_products(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """sin²((φ-μ)/2) and sin((φ-μ)/2) cos((φ-μ)/2)."""
    if _in_single(value, mean):
        sine, cosine = _half_angle_in_single(value, mean)
        return sine * sine, sine * cosine
    sine, cosine, odd = _reduced(value, mean)
    # by arithmetic: a compiler that splits value and gradient would store a mask, at several times the cost of all else
    square = sine * sine
    return square + odd * (cosine * cosine - square), (1 - 2 * odd) * (sine * cosine)


def _fall(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """-2κ sin²((φ-μ)/2), which is κ(cos(φ-μ) - 1)."""
    sine, _ = half_angle(value, mean)
    return -2 * (concentration * sine) * sine


def _one_side(sine: Tensor, cosine: Tensor, concentration: Tensor, within: Tensor) -> tuple[Tensor, Tensor]:
    """Mass on one side of the mean and its derivative in κ: where `within` between the mean and t, else from t to π.

    t ∈ [0, π] is given by sin(t/2) and cos(t/2). With the density at the arc's start b taken out, what is integrated
    over s is exp(-2κ sin(s/2) sin(b+s/2)): from 1 down to exp(-CUT) at most.
    """
    height, deviation = _peak_and_deviation(concentration)
    reach = CUT / (2 * concentration)
    start_sine, start_cosine = torch.where(within, 0, sine), torch.where(within, 1, cosine)
    # where 2κ sin²(θ/2) has risen by CUT, sin((θ-b)/2) = reach / sin((θ+b)/2), which cancels nowhere
    square = start_sine * start_sine + reach
    end_sine, end_cosine = square.sqrt(), (start_cosine * start_cosine - reach).clamp(min=0).sqrt()
    cut = 2 * torch.asin((reach / (end_sine * start_cosine + end_cosine * start_sine)).clamp(max=1))
    whole = 2 * torch.where(within, torch.atan2(sine, cosine), torch.atan2(cosine, sine))
    width = torch.where(square < 1, torch.minimum(cut, whole), whole)
    full_sine = 2 * start_sine * start_cosine
    full_cosine = (start_cosine - start_sine) * (start_cosine + start_sine)
    total, moment = torch.zeros_like(width), torch.zeros_like(width)
    for place, weight in NODES[40]:
        half = width * (place / 2)
        half_sine = torch.sin(half)
        fall = half_sine * (full_sine * torch.cos(half) + full_cosine * half_sine)
        part = weight * torch.exp(-2 * concentration * fall)
        total += part
        moment += part * fall
    fallen = 2 * start_sine * start_sine
    scale = torch.exp(height - concentration * fallen) * width
    # the derivative of log p in κ is 1 - A - 2 sin²(θ/2)
    return scale * total, scale * ((deviation - fallen) * total - 2 * moment)


def _cdf_and_slopes(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The distribution function and its derivatives in value and in κ."""
    sine, cosine = half_angle(value, mean)
    ahead = sine * cosine >= 0
    sine, cosine = sine.abs(), cosine.abs()
    angle = 2 * torch.atan2(sine, cosine)
    turns = torch.round((value - mean - torch.where(ahead, angle, -angle)) / (2 * math.pi))
    within = (concentration * sine * sine < 0.1) & (sine < cosine)
    mass, slope = _one_side(sine, cosine, concentration, within)
    sign = torch.where(ahead, 1.0, -1.0)
    found = torch.where(within, 0.5 + sign * mass, torch.where(ahead, 1 - mass, mass))
    density = torch.exp(_log_peak(concentration) - 2 * (concentration * sine) * sine)
    return turns + found, density, torch.where(within, sign, -sign) * slope


class _LogProb(Function):
    """Value and slopes come from one pass in `forward`; `backward` multiplies."""

    @staticmethod
    def forward(
        ctx: Any, value: Tensor, mean: Tensor, concentration: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        log_p, by_mean, by_concentration = _in_blocks(_value_and_slopes, value, mean, concentration)
        ctx.save_for_backward(value, mean, concentration, by_mean, by_concentration)
        ctx.mark_non_differentiable(by_mean, by_concentration)
        return log_p, by_mean, by_concentration

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        value, mean, concentration, by_mean, by_concentration = ctx.saved_tensors
        if torch.is_grad_enabled() and not torch.compiler.is_compiling():
            # a second derivative is wanted: the same in operations that have one
            sine, cosine = half_angle(value, mean)
            by_mean = 2 * concentration * sine * cosine
            by_concentration = mean_deviation(concentration) - 2 * sine * sine
        turning = grad * by_mean
        needed = ctx.needs_input_grad
        return (
            (-turning).sum_to_size(value.shape) if needed[0] else None,
            turning.sum_to_size(mean.shape) if needed[1] else None,
            (grad * by_concentration).sum_to_size(concentration.shape) if needed[2] else None,
        )


class _LogPeak(Function):
    """Its derivative is 1 - A(κ)."""

    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        return _log_peak(concentration)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return grad * mean_deviation(concentration)


class _OneMinusRatio(Function):
    """Its derivative is -A'(κ)."""

    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        return _one_minus_ratio(concentration)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return -grad * mean_resultant_slope(concentration)


class _Ratio(Function):
    """A(κ); its derivative is A'(κ)."""

    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        part = 1 / (1 + 2 / concentration)  # κ/(κ+2), without overflow, 0 at κ = 0
        return _polynomial("ratio", 2 / (concentration + 2)) * part

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return grad * mean_resultant_slope(concentration)


class _Entropy(Function):
    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        height, deviation = _peak_and_deviation(concentration)
        # 0 · inf where κ is infinite: κ(1 - A) is 1/2 there
        return torch.where(concentration.isinf(), 0.5, concentration * deviation) - height

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        # -κ A'(κ), the product ordered so that nothing under- or overflows
        part = 2 / (concentration + 2)
        return grad * (-_polynomial("ratio_slope", part) * (concentration * part) * part / 2)


class _Cdf(Function):
    """Of float64 arguments of one shape."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
        found, density, by_concentration = _in_blocks(_cdf_and_slopes, value, mean, concentration)
        ctx.save_for_backward(density, by_concentration)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        density, by_concentration = ctx.saved_tensors
        return grad * density, -grad * density, grad * by_concentration


def _log_quotient(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """log((κ₂+2)/(κ₁+2)), and whether it is so small that integrals from κ₁ to κ₂ are done by quadrature."""
    quotient = torch.log((second + 2) / (first + 2))
    near = quotient.abs() <= 1
    exact = torch.log1p(torch.where(near, (second - first) / (first + 2), 0))
    return torch.where(near, exact, quotient), near


class _Bregman(Function):
    """∫_{κ₁}^{κ₂} (κ₂-x) A'(x) dx: how far log I0 lies at κ₂ above its tangent at κ₁."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        ctx.save_for_backward(first, second)
        log, near = _log_quotient(first, second)
        step = torch.where(near, log, 0)
        v = 2 / (first + 2)
        total = torch.zeros_like(step)
        for place, weight in NODES[14]:  # of log(x+2)
            part = _polynomial("ratio_slope", v * torch.exp(-place * step))
            total += weight * part * torch.expm1((1 - place) * step)
        rise = log / 2 - _polynomial("log_peak", 2 / (second + 2)) + _polynomial("log_peak", v)
        far = (second - first) * _one_minus_ratio(first) - rise
        return torch.where(near, 2 * step * total, far)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        first, second = ctx.saved_tensors
        v = 2 / (first + 2)
        # -(κ₂-κ₁) A'(κ₁), the product ordered so that nothing under- or overflows
        by_first = (first - second) * v * (v * _polynomial("ratio_slope", v) / 2)
        return grad * by_first, grad * _RatioRise.apply(first, second)


class _RatioRise(Function):
    """A(κ₂) - A(κ₁)."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        ctx.save_for_backward(first, second)
        log, near = _log_quotient(first, second)
        step = torch.where(near, log, 0)
        v = 2 / (first + 2)
        total = torch.zeros_like(step)
        for place, weight in NODES[14]:
            here = v * torch.exp(-place * step)
            total += weight * here * _polynomial("ratio_slope", here)
        return torch.where(near, step * total, _one_minus_ratio(first) - _one_minus_ratio(second))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        first, second = ctx.saved_tensors
        return -grad * mean_resultant_slope(first), grad * mean_resultant_slope(second)
