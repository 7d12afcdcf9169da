"""Figures of predicted densities on a viewing circle around each image: certain, ambiguous and failed predictions."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from framework.figures.style import BLUE, GREEN, GREY, RED
from framework.reports.sample_sheet import sample_sheet

LARGE_ERROR = math.pi / 6  # radians; a larger error counts as wrong (Acc_{π/6} of thesis Table 3.3)
RING = 0.5  # thickness of the ring in which densities are drawn, in radii of the viewing circle
PREDICTED: dict[str, Any] = {"color": RED, "ls": ":", "linewidth": 1.2, "marker": "o", "markersize": 4}
"""Style of a point prediction; it is dotted so that a narrow density below it stays visible."""
DEGREES = ("0°", "90°", "180°", "270°")
"""Labels of the four directions if the data set has no words for them."""


def choose(
    entropy: Float[np.ndarray, "samples"],
    error: Float[np.ndarray, "samples"],
    log_density: Float[np.ndarray, "points samples"],
    count: int = 4,
) -> dict[str, list[int]]:
    """Return the indices of up to `count` samples for each row of the figure (thesis Figure 3.6), by the row's name.

    A density is confident if it has one peak, and an entropy of at most the median entropy of all samples. "certain"
    has samples with a confident density and an error of at most π/6, "failed" has samples with a confident density and
    a larger error, and "ambiguous" has samples whose density has several peaks. Of the samples of a row, those with the
    lowest entropy are shown. The choice is deterministic.

    Args:
        entropy: entropy of each density, nats.
        error: absolute angular deviation of each point prediction, radians.
        log_density: log-density on a regular grid over the whole circle.
        count: largest number of samples per row.

    Raises:
        ValueError: a number is NaN.
    """
    if any(np.isnan(numbers).any() for numbers in (entropy, error, log_density)):
        raise ValueError(
            "Got NaN among the entropies, errors or densities, by which samples are chosen. Pass numbers only."
        )
    if len(entropy) == 0:
        return {"certain": [], "ambiguous": [], "failed": []}
    several = count_peaks(log_density) > 1
    confident = ~several & (entropy <= np.median(entropy))
    right = error <= LARGE_ERROR
    rows = {"certain": confident & right, "ambiguous": several, "failed": confident & ~right}
    order = np.argsort(entropy, kind="stable")
    return {name: order[chosen[order]][:count].tolist() for name, chosen in rows.items()}


def count_peaks(log_density: Float[np.ndarray, "points samples"]) -> np.ndarray:
    """Return the number of separate arcs on which a density exceeds a quarter of its maximum, (samples,)."""
    high = log_density > log_density.max(0) - math.log(4)
    starts = (high & ~np.roll(high, 1, axis=0)).sum(0)
    return np.maximum(starts, 1)  # an arc that covers the whole circle has no start


def outer_density(peak: float) -> float:
    """Return the density that the outer circle represents, per radian.

    It is the first of 1.5, 3, 6, 15, 30, … that is at least `peak`.
    """
    steps = (step * 10.0**power for power in range(308) for step in (1.5, 3.0, 6.0))
    return next(step for step in steps if step >= peak)


def viewing_circles(
    images: Sequence[np.ndarray],
    log_density: Float[np.ndarray, "points samples"],
    angles: Float[np.ndarray, "points"],
    truths: Float[np.ndarray, "samples"],
    predictions: Float[np.ndarray, "samples"],
    captions: Sequence[str],
    modes: Sequence[np.ndarray] | None = None,
    *,
    rows: Mapping[str, int],
    title: str,
    synthetic: bool,
    directions: Sequence[str] = (),
) -> Figure:
    """Draw predicted densities on the viewing circle around each image, as in Figures 3.2 and 3.6 of the thesis.

    Angle 0 is at the bottom, and angles run counter-clockwise. A density is drawn as a band outside the circle, whose
    thickness is proportional to the density. The band stays inside an outer circle; the density that the outer circle
    represents is written beside it.

    Args:
        images: images of the samples, as `Data.preview` gives them.
        log_density: log-density of each sample at `angles`, nats.
        angles: a regular grid over the whole circle, radians.
        truths: true angles, radians; NaN if there is no true direction, which is then not drawn.
        predictions: point predictions, radians.
        captions: text below each panel.
        modes: for each sample, all angles that are equally true because the object is symmetric, radians.
        rows: number of samples in each row, by the row's heading; the samples are ordered by row. A number may be 0.
        title: title of the figure.
        synthetic: whether the data are generated.
        directions: words for the viewing directions 0°, 90°, 180° and 270°; without words the angles are written.
    """
    lengths = (log_density.shape[1], sum(rows.values()), len(images), len(captions))
    if len(set(lengths)) != 1:
        raise ValueError(
            f"Got {lengths[0]} densities, {lengths[2]} images and {lengths[3]} captions, and the numbers in `rows` sum "
            f"to {lengths[1]}. Pass equally many densities, images and captions, and rows whose sum is their number."
        )
    density = np.exp(np.minimum(log_density.astype(np.float64), 700))  # larger exponents overflow float64
    if np.isnan(density).any():
        raise ValueError("Got NaN as a log-density. Pass a number for every sample and angle.")
    size = {"least": 3, "width": 2.5, "heights": (2.75,), "flat": (0.6875,), "margin": 1.5}
    figure, panels = sample_sheet(rows, **size, title=title, synthetic=synthetic)
    for sample, (axes,) in enumerate(panels):
        _viewing_circle(axes, images[sample], density[:, sample], angles, directions)
        _marks(axes, truths[sample], predictions[sample], () if modes is None else modes[sample])
        caption = "\n".join(textwrap.fill(part, 36) for part in captions[sample].splitlines())
        axes.set_xlabel(caption, fontsize=8, labelpad=1, parse_math=False)
    handles = [
        Patch(color=BLUE, alpha=0.6, label="predicted density"),
        Line2D([], [], color=GREY, label="outer circle: the density written there"),
        Line2D([], [], color=GREY, linestyle=":", label="uniform density"),
        Line2D([], [], **PREDICTED, label="point prediction"),
        Line2D([], [], color=GREEN, marker="^", linestyle="", label="truth"),
    ]
    if any(len(mode) > 1 for mode in modes or ()):
        handles.append(Line2D([], [], color=GREEN, marker="^", ls="", mfc="none", label="equally true"))
    note = f"The object from above: {directions[0]} (0°)" if directions else "0°"
    note += " is at the bottom, angles turn counter-clockwise."
    if "failed" in rows:
        note += (
            f"\nFailed: one peak, sharper than half of all, more than {math.degrees(LARGE_ERROR):.0f}° off."
        )
    legend = figure.legend(handles=handles, title=note, loc="outside lower center", ncols=3, frameon=False)
    legend.get_title().set_parse_math(False)
    return figure


def _viewing_circle(
    axes: Axes, image: np.ndarray, density: np.ndarray, angles: np.ndarray, words: Sequence[str]
) -> None:
    """Draw an image and the density around it."""
    height, width = image.shape[:2]
    # The corners of the image stay inside the circle, and its sides leave space for the words.
    half = min(0.96 / math.hypot(height, width), 0.72 / max(height, width))
    axes.imshow(image, extent=(-half * width, half * width, -half * height, half * height))
    limit = 1 + RING + 0.2
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit))
    outer = outer_density(density.max())
    around, value = np.append(angles, angles[0]), np.append(density, density[0])
    band = np.append(1 + RING * value / outer, np.ones_like(value))
    axes.fill(*_position(np.append(around, around[::-1]), band), color=BLUE, alpha=0.6, linewidth=0)
    # A density at a single angle has no area, but a line makes it visible.
    axes.plot(*_position(around, 1 + RING * value / outer), color=BLUE, linewidth=0.6)
    axes.text(limit, 1.3, f"{outer:g} per rad", fontsize=6.5, color=GREY, ha="right", va="bottom")
    for radius, line in ((1.0, "-"), (1 + RING, "-"), (1 + RING / (2 * math.pi * outer), ":")):
        axes.add_patch(Circle((0, 0), radius, fill=False, color=GREY, linestyle=line, zorder=3))
    for quarter, word in enumerate(words or DEGREES):
        x, y = _position(quarter * math.pi / 2, 0.86)
        rotation = 90 * (quarter % 2) if words else 0
        style = {"fontsize": 6.5 if words else 6, "color": GREY, "rotation": rotation, "parse_math": False}
        axes.text(x, y, word, ha="center", va="center", **style)


def _marks(axes: Axes, truth: float, prediction: float, modes: Sequence[float] | np.ndarray) -> None:
    """Mark the true angle, all angles that are equally true (`modes`), and the point prediction."""
    for angle, face in (*((mode, "none") for mode in modes), (truth, GREEN)):
        if math.isnan(angle):
            continue
        triangle = (3, 0, math.degrees(angle))  # points inwards, from outside the outer circle
        x, y = _position(angle, 1 + RING + 0.1)
        axes.plot(x, y, color=GREEN, marker=triangle, markerfacecolor=face, markersize=8, zorder=5)
    x, y = _position(prediction, np.array([1.0, 1 + RING]))
    axes.plot(x, y, **PREDICTED, zorder=5)


def _position(angle: Any, radius: Any) -> tuple[Any, Any]:
    """Return the position (x, y) of an angle in radians on a circle: 0 at the bottom, counter-clockwise."""
    return radius * np.sin(angle), -radius * np.cos(angle)
