"""The matrix Fisher density p(R) = exp(tr(FᵀR)) / c(F) of rotations (Downs 1972), accurate from F = 0 to 1e12 and more.

With the proper singular value decomposition F = U S Vᵀ (U and V rotations, s₁ ≥ s₂ ≥ |s₃|; Lee 2018, Def. 1) and
the unit quaternion q of the aligned rotation UᵀRV,

    tr(FᵀR) = tr S - λ₁q₁² - λ₂q₂² - λ₃q₃²,   λ₁ = 2(s₂+s₃), λ₂ = 2(s₁+s₃), λ₃ = 2(s₁+s₂),

so that q has a Bingham density (Mardia & Jupp 2000, §13.2.3). The coefficients 0 ≤ λ₁ ≤ λ₂ ≤ λ₃ are called *falls*: λᵢ
says how fast the log-density falls along qᵢ. No function below subtracts large numbers that nearly agree. The density
is its height at the mode, 1/k(λ), times exp(-Σ λᵢqᵢ²), where k(λ) = c(F) exp(-tr S) is the mean of exp(-Σ λᵢqᵢ²) over
uniform q. Densities are with respect to the rotation-invariant measure of total mass 1. All computations are in
float64.
"""

from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import Function

from framework.geometry import quaternions

SAMPLING_ROUNDS = 96
"""Largest number of proposals per sample.

At least 45 % of proposals are accepted (README of the plugin for matrix Fisher densities). After 96 proposals, fewer
than one sample in 10^24 has no accepted proposal.
"""
REACH = 44.0
"""Exponent beyond which terms are neglected, since exp(-44) is less than half the last digit of float64."""
NODES = (64, 48)
PANEL = 4.0
"""Length of the last of the two panels of the quadrature of k(λ), in its variable of integration y (`_quadrature`).

NODES holds the numbers of nodes of the two panels, 112 in all. With these the error of log k is at most 3e-14 for falls
from 0 to 1e30 (README of the plugin for matrix Fisher densities).
"""
LARGE = 25.0
"""Concentration above which the asymptotic series of I₁/I₀ is exact to the last digit."""


class Frame(NamedTuple):
    """The proper singular value decomposition F = U S Vᵀ of the parameter F of a matrix Fisher density.

    Attributes:
        left, right: (*batch, 3, 3), the rotations U and V.
        falls: (*batch, 3), sums 2(s₂+s₃), 2(s₁+s₃), 2(s₁+s₂) of singular values, λ₁ ≤ λ₂ ≤ λ₃.
    """

    left: Tensor
    right: Tensor
    falls: Tensor

    @property
    def mode(self) -> Float[Tensor, "*batch 4"]:
        """Quaternion of U Vᵀ, the rotation at which the matrix Fisher density is highest."""
        return self.turn(self.falls.new_tensor([1.0, 0, 0, 0]))

    def turn(self, aligned: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
        """Return the quaternion of a rotation R, given the quaternion `aligned` of the aligned rotation UᵀRV."""
        left, right = quaternions.of_matrix(self.left), quaternions.of_matrix(self.right)
        return quaternions.product(quaternions.product(left, aligned), quaternions.inverse(right))

    def aligned(self, turn: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
        """Return the quaternion of the aligned rotation UᵀRV, given the quaternion `turn` of a rotation R."""
        left, right = quaternions.of_matrix(self.left), quaternions.of_matrix(self.right)
        return quaternions.product(quaternions.product(quaternions.inverse(left), turn), right)


def log_prob(turn: Float[Tensor, "... 4"], parameter: Float[Tensor, "... 3 3"]) -> Float[Tensor, "..."]:
    """Return the matrix Fisher log-density of rotations, nats, float64; batch shapes broadcast.

    The first and second derivatives in both arguments are accurate everywhere, also where singular values of F are
    equal or zero: they are moments of the rotation, and are computed without division by a difference of singular
    values. The derivative in `turn` is only valid for changes that keep the quaternion of unit length.

    Args:
        turn: unit quaternions of the rotations.
        parameter: the matrix F of the density exp(tr(FᵀR)) / c(F).
    """
    return _LogProb.apply(turn.double(), parameter.double())


def mean_rotation(parameter: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the mean rotation matrix E R = U diag(d) Vᵀ of the matrix Fisher density with F = `parameter`, float64.

    The result can be differentiated once. E R is the derivative of log c(F) with respect to F, and d is the mean of the
    diagonal of UᵀRV (Lee 2018, Thm. 1).
    """
    return _Mean.apply(parameter.double())


@torch.no_grad()
def entropy(falls: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Return the entropy -E log p = log k(λ) + Σ λᵢ E qᵢ² of a matrix Fisher density with λ = `falls`, nats.

    The density is with respect to the rotation-invariant measure of total mass 1. The entropy of such a density is at
    most 0.
    """
    return log_height(falls).neg() + (falls * second_moments(falls)).sum(-1)


@torch.no_grad()
def align(parameter: Float[Tensor, "*batch 3 3"]) -> Frame:
    """Return the proper singular value decomposition of the parameter F of a matrix Fisher density, float64.

    If singular values are equal, the decomposition is not unique, and any one of them is returned.
    """
    left, singular, right = torch.linalg.svd(parameter.double())
    right = right.mT
    flips = torch.stack([torch.linalg.det(left), torch.linalg.det(right)]).sign()
    first, second, third = singular.unbind(-1)
    third = third * flips.prod(0)
    keep = singular.new_tensor([1.0, 1.0, 0.0])
    left, right = (
        basis * (keep + (1 - keep) * flip[..., None, None])
        for basis, flip in zip((left, right), flips, strict=True)
    )
    falls = 2 * torch.stack([second + third, first + third, first + second], -1)
    return Frame(left, right, falls.clamp(min=0))


@torch.no_grad()
def log_height(falls: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Return the log-density at the mode of a matrix Fisher density, nats, float64.

    It is -log k(λ), where k is the normaliser and λ = `falls` are the rates at which the log-density falls from the
    mode (see the module's docstring).
    """
    return -_quadrature(falls)[2].sum(-1).log()


@torch.no_grad()
def second_moments(falls: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return E qᵢ² = -∂log k/∂λᵢ for i = 1, 2, 3, each to full relative precision.

    q is the quaternion of the aligned rotation UᵀRV under the matrix Fisher density with λ = `falls`. The moments
    give the diagonal d of E UᵀRV, for example d₁ = 1 - 2(E q₂² + E q₃²).
    """
    return _second_moments(*_quadrature(falls))


def _second_moments(outer: "_Circle", inner: "_Circle", mass: Tensor) -> Float[Tensor, "*batch 3"]:
    """Return the moments of `second_moments` from the result of `_quadrature`."""
    mass = mass / mass.sum(-1, keepdim=True)
    first, third = _sine_squared(outer), _sine_squared(inner)
    moments = [outer.square * first, inner.square * (1 - third), inner.square * third]
    return torch.stack([(mass * moment).sum(-1) for moment in moments], -1)


@torch.no_grad()
def fourth_moments(falls: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """Return E qᵢ²qⱼ² for i, j = 0, …, 3, to nearly full relative precision.

    q is the quaternion of the aligned rotation UᵀRV under the matrix Fisher density with λ = `falls`.
    """
    outer, inner, mass = _quadrature(falls)
    mass = mass / mass.sum(-1, keepdim=True)
    blocks = []
    for circle in (outer, inner):
        sine, both, sine_fourth = (
            _sine_squared(circle),
            _sine_cosine_squared(circle),
            _sine_fourth(circle),
        )
        squares = circle.square * (1 - sine), circle.square * sine
        blocks.append((squares, circle.square**2 * (1 - sine - both), circle.square**2 * both, sine_fourth))
    (q0, q1), (q2, q3) = blocks[0][0], blocks[1][0]
    moments = [
        [blocks[0][1], blocks[0][2], q0 * q2, q0 * q3],
        [blocks[0][2], outer.square**2 * blocks[0][3], q1 * q2, q1 * q3],
        [q0 * q2, q1 * q2, blocks[1][1], blocks[1][2]],
        [q0 * q3, q1 * q3, blocks[1][2], inner.square**2 * blocks[1][3]],
    ]
    return torch.stack([torch.stack([(mass * moment).sum(-1) for moment in row], -1) for row in moments], -2)


@torch.no_grad()
def sample(falls: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return one random quaternion q of the aligned rotation UᵀRV for each row of `falls`, which are λ; float64.

    The method is rejection sampling (Kent, Ganeiber & Mardia 2018, §3).
    The proposal is the angular central Gaussian z/|z| with zᵢ ~ N(0, 1/(1 + 2λᵢ/b)); b solves Σᵢ 1/(b + 2λᵢ) = 1,
    with λ₀ = 0 included. Elements without an accepted proposal after SAMPLING_ROUNDS keep their last proposal, so that
    the loop always ends.
    """
    fall = falls.double().reshape(-1, 3)
    fall = torch.cat([torch.zeros_like(fall[:, :1]), fall], -1)
    width = torch.ones_like(fall[:, :1])
    for _ in range(
        40
    ):  # Newton's method from the left on a convex, falling function never steps beyond the root
        parts = 1 / (width + 2 * fall)
        width = width + (parts.sum(-1, keepdim=True) - 1) / parts.square().sum(-1, keepdim=True)
    width = width.clamp(1, 4)
    proposed, rejected = _propose(fall, width)
    lanes = rejected.nonzero().flatten()
    for _ in range(SAMPLING_ROUNDS - 1):
        if lanes.numel() == 0:
            break
        proposed[lanes], rejected = _propose(fall[lanes], width[lanes])
        lanes = lanes[rejected]
    return proposed.reshape(*falls.shape[:-1], 4)


def _propose(fall: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Return one proposal of `sample` per element, and whether it is rejected.

    Args:
        fall: λ₀ = 0, λ₁, λ₂, λ₃ of each element.
        width: b of each element.
    """
    normal = torch.randn_like(fall) / (1 + 2 * fall / width).sqrt()
    turn = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    cost = (fall * turn.square()).sum(-1)
    width = width.squeeze(-1)
    # exp(-u) (1 + 2u/b)² is largest at u = (4-b)/2
    log_ratio = -cost + 2 * torch.log1p(2 * cost / width) + (4 - width) / 2 - 2 * torch.log(4 / width)
    return turn, ~(torch.rand_like(cost).log() < log_ratio)


class _Circle(NamedTuple):
    """Two of the four components of the aligned quaternion, (r cos φ, r sin φ), at each node of the quadrature.

    Given r, the angle 2φ has a von Mises density around 0.

    Attributes:
        square: r² at each node.
        concentration: concentration of 2φ at each node.
        bessel: I₀ₑ of the concentration at each node.
    """

    square: Tensor
    concentration: Tensor
    bessel: Tensor


def _quadrature(falls: Tensor) -> tuple[_Circle, _Circle, Tensor]:
    """Return the circles of (q₀, q₁) and of (q₂, q₃) at the nodes, and terms (*batch, node) whose sum is k(λ).

    For a uniform quaternion, w = q₂² + q₃² is uniform on [0, 1], and the directions of (q₀, q₁) and of (q₂, q₃) are
    uniform (cf. Lee 2018, eq. 12, with other pairs of components). On each circle the density integrates to a Bessel
    function:

        k(λ) = ∫₀¹ exp(-λ₂w) I₀ₑ((λ₃-λ₂)w/2) I₀ₑ(λ₁(1-w)/2) dw,   I₀ₑ(x) = I₀(x) exp(-x).

    With these pairs the integrand decays fastest. It changes over the lengths 1/λ₃ and 1/λ₂, which may differ by many
    orders of magnitude. Both are resolved by the substitution √w = t₀ sinh y, with Gauss-Legendre quadrature in y on
    two panels; the integrand decays in the last panel.
    """
    first, second, third = (falls.double()[..., index, None] for index in range(3))
    end = REACH / second.clamp(min=REACH)
    stretch = (third - second) / 2
    start = (1 + stretch * end).rsqrt()  # t₀ in units of √end
    length = torch.asinh(1 / start)
    border = (length - PANEL).clamp(min=0)
    (early, early_weight), (late, late_weight) = (legendre(count, falls.device) for count in NODES)
    y = torch.cat([border * early, border + (length - border) * late], -1)
    weight = torch.cat([border * early_weight, (length - border) * late_weight], -1)
    root = start * torch.sinh(y)
    w = end * root * root
    slope = 2 * end * root * start * torch.cosh(y)
    outer, inner = _circle(1 - w, first / 2 * (1 - w)), _circle(w, stretch * w)
    return outer, inner, weight * slope * torch.exp(-second * w) * (inner.bessel * outer.bessel)


def _circle(square: Tensor, concentration: Tensor) -> _Circle:
    return _Circle(square, concentration, torch.special.i0e(concentration))


def legendre(count: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the `count` nodes and weights of Gauss-Legendre quadrature on [0, 1], float64, on `device`."""
    nodes, weights = _legendre_numbers(count)
    return torch.tensor(nodes, device=device), torch.tensor(weights, device=device)


@cache
def _legendre_numbers(count: int) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


# For 2φ von Mises about 0 with concentration κ, and A = I₁/I₀ (Mardia & Jupp 2000, §3.5.4):
# E sin²φ = (1-A)/2, E sin²φ cos²φ = A/(4κ), E sin⁴φ = (1-A)/2 - A/(4κ).


def _sine_squared(circle: _Circle) -> Tensor:
    return _with_series("sine_squared", circle, (1 - _ratio(circle)) / 2)


def _sine_cosine_squared(circle: _Circle) -> Tensor:
    concentration = circle.concentration
    straight = _ratio(circle) / concentration.clamp(min=1e-4) / 4
    return torch.where(concentration < 1e-4, 1 / 8 - concentration.square() / 64, straight)


def _sine_fourth(circle: _Circle) -> Tensor:
    close = (1 - _ratio(circle)) / 2 - _sine_cosine_squared(circle)
    return _with_series("sine_fourth", circle, close)


def _ratio(circle: _Circle) -> Tensor:
    """Return A = I₁(κ)/I₀(κ) for each concentration κ."""
    return torch.special.i1e(circle.concentration) / circle.bessel


def _with_series(name: str, circle: _Circle, close: Tensor) -> Tensor:
    """Return `close`, replaced by the asymptotic series where κ is too large to compute 1 - A(κ) by subtraction."""
    far = ~(circle.concentration < LARGE)
    # the series is evaluated only where it applies, which is at a minority of the nodes
    return close.masked_scatter(far, _series(name, circle.concentration[far]))


def _series(name: str, concentration: Tensor) -> Tensor:
    inverse = 1 / concentration.clamp(min=LARGE)
    coefficients = _coefficients()[name]
    total = torch.full_like(inverse, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * inverse + coefficient
    return total


@cache
def _coefficients(terms: int = 20) -> dict[str, list[float]]:
    """Return the coefficients of the asymptotic series in 1/κ of E sin²φ and E sin⁴φ, by name.

    2φ has a von Mises density with the concentration κ around 0. The series follow from the series of A = I₁(κ)/I₀(κ),
    which solves A' = 1 - A² - A/κ (Mardia & Jupp 2000, A.14).
    """
    ratio = [Fraction(1)]
    for order in range(1, terms):
        squares = sum(ratio[index] * ratio[order - index] for index in range(1, order))
        ratio.append(((order - 2) * ratio[order - 1] - squares) / 2)
    sine_squared = [Fraction(0), *(-number / 2 for number in ratio[1:])]
    both = [Fraction(0), *(number / 4 for number in ratio[:-1])]
    fourth = [square - product for square, product in zip(sine_squared, both, strict=True)]
    series = {"sine_squared": sine_squared, "sine_fourth": fourth}
    return {name: [float(number) for number in numbers] for name, numbers in series.items()}


class _LogProb(Function):
    """Autograd function of the log-density.

    Its derivative with respect to F is R - E R. The only term of the log-density that depends on the quaternion is
    -Σ λᵢqᵢ².
    """

    @staticmethod
    def forward(ctx: Any, turn: Tensor, parameter: Tensor) -> Tensor:
        frame = align(parameter)
        outer, inner, mass = _quadrature(frame.falls)
        # the derivative needs moments; they are computed here, from the same quadrature as the normaliser
        moments = _second_moments(outer, inner, mass) if ctx.needs_input_grad[1] else None
        ctx.save_for_backward(turn, parameter, *frame, moments)
        return -mass.sum(-1).log() - (frame.falls * frame.aligned(turn)[..., 1:].square()).sum(-1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        turn, parameter, *parts, moments = ctx.saved_tensors
        frame = Frame(*parts)
        by_turn = by_parameter = None
        if torch.is_grad_enabled():  # for second derivatives, use operations that have derivatives
            if ctx.needs_input_grad[0]:
                by_turn = 2 * (_quadratic_form(parameter) @ turn[..., None]).squeeze(-1)
            if ctx.needs_input_grad[1]:
                identity = torch.eye(3, dtype=turn.dtype, device=turn.device)
                by_parameter = quaternions.matrix_less_identity(turn) + identity - _Mean.apply(parameter)
        else:
            aligned = frame.aligned(turn)
            if ctx.needs_input_grad[0]:
                pull = torch.cat(
                    [torch.zeros_like(aligned[..., :1]), -2 * frame.falls * aligned[..., 1:]], -1
                )
                by_turn = frame.turn(pull)
            if ctx.needs_input_grad[1]:
                # R - E R = U ((Q - I) + (I - D)) Vᵀ; both terms in brackets are computed without cancellation
                difference = quaternions.matrix_less_identity(aligned) + torch.diag_embed(_shrinkage(moments))
                by_parameter = frame.left @ difference @ frame.right.mT
        if by_turn is not None:
            by_turn = (grad[..., None] * by_turn).sum_to_size(turn.shape)
        if by_parameter is not None:
            by_parameter = (grad[..., None, None] * by_parameter).sum_to_size(parameter.shape)
        return by_turn, by_parameter


class _Mean(Function):
    """Autograd function of the mean rotation E R.

    Its derivative with respect to F is the covariance of the elements of R, which is nearly diagonal for the aligned
    rotation UᵀRV.
    """

    @staticmethod
    def forward(ctx: Any, parameter: Tensor) -> Tensor:
        frame = align(parameter)
        ctx.save_for_backward(*frame)
        return frame.left @ torch.diag_embed(1 - _shrinkage(second_moments(frame.falls))) @ frame.right.mT

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "The matrix Fisher density has no third derivative, and its mean rotation no second derivative, but "
                "one of them was requested with create_graph=True. Leave out create_graph in the last derivative."
            )
        frame = Frame(*ctx.saved_tensors)
        aligned = frame.left.mT @ grad @ frame.right
        fourth, second = fourth_moments(frame.falls), second_moments(frame.falls)
        covariance = fourth[..., 1:, 1:] - second[..., :, None] * second[..., None, :]
        # Qᵢᵢ = 1 - 2 Σ_{j≠i} qⱼ²
        off_diagonal = 1 - torch.eye(3, dtype=second.dtype, device=second.device)
        diagonal = (
            4 * off_diagonal @ covariance @ off_diagonal @ aligned.diagonal(dim1=-2, dim2=-1)[..., None]
        )
        # Q₁₂ = 2(q₁q₂ - q₀q₃) and Q₂₁ = 2(q₁q₂ + q₀q₃): odd moments vanish
        straight, crossed = torch.zeros_like(aligned), torch.zeros_like(aligned)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            pair, other = fourth[..., i + 1, j + 1], fourth[..., 0, k + 1]
            straight[..., i, j] = straight[..., j, i] = 4 * (pair + other)
            crossed[..., i, j] = crossed[..., j, i] = 4 * (pair - other)
        moved = straight * aligned + crossed * aligned.mT + torch.diag_embed(diagonal.squeeze(-1))
        return frame.left @ moved @ frame.right.mT


def _shrinkage(moments: Float[Tensor, "*batch 3"]) -> Tensor:
    """Return 1 - dᵢ = 2 Σ_{j≠i} E qⱼ², (*batch, 3), where diag(d) is the mean of the aligned rotation UᵀRV.

    `moments` are E qᵢ² for i = 1, 2, 3 (`second_moments`).
    """
    first, second, third = moments.unbind(-1)
    return 2 * torch.stack([second + third, first + third, first + second], -1)


def _quadratic_form(parameter: Tensor) -> Tensor:
    """Return the matrix K with tr(FᵀR) = qᵀ K q for the quaternion q of R, (*batch, 4, 4); `parameter` is F.

    Source: Mardia & Jupp 2000, §13.2.3.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in parameter.unbind(-2))
    rows = [
        torch.stack([a + e + i, h - f, c - g, d - b], -1),
        torch.stack([h - f, a - e - i, b + d, c + g], -1),
        torch.stack([c - g, b + d, e - a - i, f + h], -1),
        torch.stack([d - b, c + g, f + h, i - a - e], -1),
    ]
    return torch.stack(rows, -2)
