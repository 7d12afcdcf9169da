"""Two interleaved half circles under Gaussian noise: drawing points, and their exact densities and posterior.

The upper half of a unit circle about (0, 0) is class 0, the lower half of one about (1, ½) is class 1. A point lies at
a uniform angle of its class's arc, with normal noise added. Points are in standard units: each coordinate minus its
mean, divided by its standard deviation, where both are those of the distribution and not of a sample. The arcs are
mirror images of each other in the origin, and so are the two densities.
"""

import math

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_expit

CENTRE = np.array([0.5, 0.25])
"""Mean of the distribution and centre of its symmetry, in radii of the arcs."""
NODES = 64
"""Number of nodes of the Gauss-Legendre rule on each piece of an arc."""
DECAY = 40.0
"""Nats below a piece's largest value at which its integral is cut off: e⁻⁴⁰ is below float64's resolution."""


def scale(noise: float) -> np.ndarray:
    """Return the standard deviation of either coordinate over both classes, in radii.

    E x² = ½ + ¼ + σ² about the centre; E y² = E (sin θ - ¼)² + σ² = ½ - 1/π + 1/16 + σ², as E sin θ = 2/π.
    """
    return np.sqrt([0.75 + noise**2, 0.5625 - 1 / math.pi + noise**2])


def draw(size: int, noise: float, *key: int) -> tuple[Float[np.ndarray, "size 2"], Int[np.ndarray, "size"]]:
    """Return points in standard units and their classes in turn; a larger draw begins with the points of a smaller one.

    Args:
        size: number of points.
        noise: standard deviation of the noise, in radii.
        key: numbers that choose the random stream; other numbers give independent points.
    """
    angles, normals = (np.random.default_rng([*key, part]) for part in range(2))
    angle = math.pi * angles.random(size)
    label = np.arange(size) % 2
    sign = np.where(label == 0, 1.0, -1.0)[:, None]  # class 1 is class 0 mirrored in the centre
    arc = sign * (np.stack([np.cos(angle), np.sin(angle)], -1) - CENTRE)
    return (arc + noise * normals.standard_normal((size, 2))) / scale(noise), label


def log_density(points: Float[np.ndarray, "*batch 2"], noise: float) -> Float[np.ndarray, "*batch 2"]:
    """Return log p(x | y) for y = 0 and 1, nats, of points in standard units; finite for every finite float32."""
    distance, around = _seen_from_arcs(points, noise)
    # |x - (cos θ, sin θ)|² = (d - 1)² + 4 d sin²(t/2), where d is x's distance from the circle's centre
    along = -((distance - 1) ** 2) / (2 * noise**2)
    constant = math.log(math.pi) + math.log(2 * math.pi * noise**2)
    return along + around - constant + np.log(scale(noise)).sum()


def log_posterior(points: Float[np.ndarray, "*batch 2"], noise: float) -> Float[np.ndarray, "*batch 2"]:
    """Return log p(y | x) for y = 0 and 1, with equal prior probabilities, of points in standard units."""
    distance, around = _seen_from_arcs(points, noise)
    total = distance.sum(-1)
    # log p(x | 1) - log p(x | 0) without the cancellation of large squares: for p from the centre of symmetry and
    # half the circles' distance c, (d₁² - d₀²) = |p - c|² - |p + c|² = -4 p·c
    apart = -4 * (points * scale(noise)) @ CENTRE / total
    odds = np.diff(around)[..., 0] - apart * (total - 2) / (2 * noise**2)
    return np.stack([log_expit(-odds), log_expit(odds)], -1)


def posterior(points: Float[np.ndarray, "*batch 2"], noise: float) -> Float[np.ndarray, "*batch 2"]:
    """Return p(y | x) for y = 0 and 1, the best possible prediction."""
    return np.exp(log_posterior(points, noise))


def _seen_from_arcs(
    points: Float[np.ndarray, "*batch 2"], noise: float
) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 2"]]:
    """Return, for each class, the distance d from its circle's centre, radii, and log ∫ exp(-2 d sin²(t/2) / σ²) dt.

    Here t is the angle between x and a point of the arc. The integrand falls with |t|, and the arc is divided into two
    pieces of |t|: both start at x's direction if the arc contains it, and otherwise at the arc's ends.
    """
    centred = points * scale(noise)
    seen = np.stack([centred + CENTRE, CENTRE - centred], -2)
    distance = np.hypot(seen[..., 0], seen[..., 1])
    direction = np.arctan2(seen[..., 1], seen[..., 0])
    faced, away = direction >= 0, np.abs(direction)
    pieces = [
        (np.where(faced, 0.0, away), np.where(faced, away, math.pi)),
        (np.where(faced, 0.0, math.pi - away), np.where(faced, math.pi - away, math.pi)),
    ]
    rate = 2 * distance / noise**2
    first, second = (_log_piece(low, high, rate) for low, high in pieces)
    return distance, np.logaddexp(first, second)


def _log_piece(low: np.ndarray, high: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return log ∫ exp(-rate sin²(t/2)) dt from `low` to `high`, 0 ≤ low ≤ high ≤ π, without its negligible part."""
    start = np.sin(low / 2) ** 2
    width = np.minimum(high - low, _reach(low, rate))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    total = np.zeros_like(width)
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        step = node * width
        # sin²(t/2) - sin²(low/2) as a product, which keeps its digits
        total += weight * np.exp(-rate * np.sin(low + step / 2) * np.sin(step / 2))
    with np.errstate(divide="ignore"):  # an empty piece: log 0
        return np.log(width * total) - rate * start


def _reach(low: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the w at which rate (sin²((low + w)/2) - sin²(low/2)) is DECAY; infinite where it never is.

    With u = tan(w/2) and e = DECAY / rate: (cos low - e) u² + u sin low - e = 0, solved without cancellation.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # at the circle's centre the rate is 0
        small = DECAY / rate
        root = np.sqrt(np.sin(low) ** 2 + 4 * small * (np.cos(low) - small))
        return np.where(np.isnan(root), math.inf, 2 * np.arctan(2 * small / (np.sin(low) + root)))
