"""Two interleaved half circles with Gaussian noise: random points, their exact densities and their exact posterior.

Class 0 is the upper half of a unit circle about (0, 0), class 1 the lower half of a unit circle about (1, ½). A point
lies at a uniformly distributed angle of the arc of its class, plus normal noise. Points are in standard units: the mean
of each coordinate is subtracted, and the difference is divided by the coordinate's standard deviation. Mean and
standard deviation belong to the distribution, not to a sample. In these units, reflection through the origin maps the
arc and the density of each class to those of the other class.
"""

import math

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_expit

CENTRE = np.array([0.5, 0.25])
"""Mean of the distribution and centre of its symmetry, in units of the arcs' radius."""
NODES = 64
"""Number of nodes of the Gauss-Legendre rule on each piece of an arc."""
DECAY = 40.0
"""Decrease of an integrand's logarithm, in nats, at which its integral is cut off: e⁻⁴⁰ is below float64 resolution."""


def scale(noise: float) -> np.ndarray:
    """Return the standard deviations of x and of y over both classes, (2,), in units of the arcs' radius.

    With coordinates relative to the centre of symmetry, a uniform angle θ and σ = `noise`, E x² = ½ + ¼ + σ² and
    E y² = E (sin θ - ¼)² + σ² = ½ - 1/π + 1/16 + σ², because E sin θ = 2/π.
    """
    return np.sqrt([0.75 + noise**2, 0.5625 - 1 / math.pi + noise**2])


def draw(size: int, noise: float, *key: int) -> tuple[Float[np.ndarray, "size 2"], Int[np.ndarray, "size"]]:
    """Return random points, scaled to mean 0 and standard deviation 1, and their classes, which alternate.

    The mean and the standard deviation are those of the distribution, not of the returned points. With the same
    key, a larger draw begins with the points of a smaller draw.

    Args:
        size: Number of points.
        noise: Standard deviation of the noise before the scaling, in units of the arcs' radius.
        key: Numbers that choose the random stream; other numbers give independent points.
    """
    angles, normals = (np.random.default_rng([*key, part]) for part in range(2))
    angle = math.pi * angles.random(size)
    label = np.arange(size) % 2
    sign = np.where(label == 0, 1.0, -1.0)[:, None]  # class 1 is class 0 mirrored in the centre
    arc = sign * (np.stack([np.cos(angle), np.sin(angle)], -1) - CENTRE)
    return (arc + noise * normals.standard_normal((size, 2))) / scale(noise), label


def log_density(points: Float[np.ndarray, "*batch 2"], noise: float) -> Float[np.ndarray, "*batch 2"]:
    """Return log p(x | y) for y = 0 and 1, nats; it is finite for every finite float32.

    Args:
        points: Points x, scaled so that the distribution of both classes has mean 0 and standard deviation 1.
        noise: Standard deviation of the noise before the scaling, in units of the arcs' radius.
    """
    distance, log_integral = _polar_terms(points, noise)
    # |x - (cos θ, sin θ)|² = (d - 1)² + 4 d sin²(t/2), where d is x's distance from the circle's centre and t the
    # angle between x and the point of the arc
    radial = -((distance - 1) ** 2) / (2 * noise**2)
    constant = math.log(math.pi) + math.log(2 * math.pi * noise**2)
    return radial + log_integral - constant + np.log(scale(noise)).sum()


def log_posterior(points: Float[np.ndarray, "*batch 2"], noise: float) -> Float[np.ndarray, "*batch 2"]:
    """Return log p(y | x) for the classes y = 0 and 1, which have equal prior probabilities.

    Args:
        points: Points x, scaled so that the distribution of both classes has mean 0 and standard deviation 1.
        noise: Standard deviation of the noise before the scaling, in units of the arcs' radius.
    """
    distance, log_integral = _polar_terms(points, noise)
    total = distance.sum(-1)
    # log p(x | 1) - log p(x | 0) without the cancellation of large squares: if p is the point measured from the centre
    # of symmetry, and the circles' centres are -c and c, then d₁² - d₀² = |p - c|² - |p + c|² = -4 p·c
    difference = -4 * (points * scale(noise)) @ CENTRE / total
    log_odds = np.diff(log_integral)[..., 0] - difference * (total - 2) / (2 * noise**2)
    return np.stack([log_expit(-log_odds), log_expit(log_odds)], -1)


def posterior(points: Float[np.ndarray, "*batch 2"], noise: float) -> Float[np.ndarray, "*batch 2"]:
    """Return p(y | x) for the classes y = 0 and 1; no prediction of y has a better expected log-likelihood.

    Args:
        points: Points x, scaled so that the distribution of both classes has mean 0 and standard deviation 1.
        noise: Standard deviation of the noise before the scaling, in units of the arcs' radius.
    """
    return np.exp(log_posterior(points, noise))


def _polar_terms(
    points: Float[np.ndarray, "*batch 2"], noise: float
) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 2"]]:
    """Return, for each class, the distance d of a point x from the circle's centre, and the logarithm of an integral.

    The integral is ∫ exp(-2 d sin²(t/2) / σ²) dt over the arc of the class, where t is the angle at the circle's centre
    between x and a point of the arc, and σ is `noise`. Lengths are in units of the arcs' radius. The integrand falls
    with |t|. The arc is divided into two pieces on each of which |t| is monotonic. If the arc contains the direction of
    x, both pieces start there, at |t| = 0. Otherwise each piece starts at an end of the arc and ends opposite to x, at
    |t| = π.
    """
    centred = points * scale(noise)
    from_centres = np.stack([centred + CENTRE, CENTRE - centred], -2)
    distance = np.hypot(from_centres[..., 0], from_centres[..., 1])
    direction = np.arctan2(from_centres[..., 1], from_centres[..., 0])
    on_arc, to_end = direction >= 0, np.abs(direction)
    pieces = [
        (np.where(on_arc, 0.0, to_end), np.where(on_arc, to_end, math.pi)),
        (np.where(on_arc, 0.0, math.pi - to_end), np.where(on_arc, math.pi - to_end, math.pi)),
    ]
    rate = 2 * distance / noise**2
    first, second = (_log_piece(low, high, rate) for low, high in pieces)
    return distance, np.logaddexp(first, second)


def _log_piece(low: np.ndarray, high: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return log ∫ exp(-rate sin²(t/2)) dt from `low` to `high`, 0 ≤ low ≤ high ≤ π, without its negligible tail."""
    start = np.sin(low / 2) ** 2
    width = np.minimum(high - low, _decay_width(low, rate))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    total = np.zeros_like(width)
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        step = node * width
        # sin²(t/2) - sin²(low/2) as a product, which keeps its digits
        total += weight * np.exp(-rate * np.sin(low + step / 2) * np.sin(step / 2))
    with np.errstate(divide="ignore"):  # an empty piece: log 0
        return np.log(width * total) - rate * start


def _decay_width(low: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the w at which rate (sin²((low + w)/2) - sin²(low/2)) equals DECAY; infinite if there is no such w.

    With u = tan(w/2) and e = DECAY / rate, the equation is (cos low - e) u² + u sin low - e = 0. It is solved without
    cancellation.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # at the circle's centre the rate is 0
        small = DECAY / rate
        root = np.sqrt(np.sin(low) ** 2 + 4 * small * (np.cos(low) - small))
        return np.where(np.isnan(root), math.inf, 2 * np.arctan(2 * small / (np.sin(low) + root)))
