"""Figures of results: predicted densities on the viewing circle, training curves, error against run time."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import Bbox

from framework.evaluation.work_precision import Point, front
from framework.figures.style import BLUE, COLOURS, GREEN, GREY, MARKERS, RED, titled_figure
from framework.reports.table import SPREADS, Row

# where a word may stand beside its point, in order of preference, typographical points
SIDES = ((9, 6), (9, -6), (-9, 6), (-9, -6), (0, 13), (0, -13), (12, 15), (12, -15), (-12, 15))

Style = dict[str, Any]
PARETO: Style = {"ls": "", "marker": "o", "mfc": "none", "markersize": 13, "mec": "black"}

LARGE_ERROR = math.pi / 6  # radians; a viewpoint further off counts as wrong (Acc_{π/6} of thesis Table 3.3)
RING = 0.5  # thickness of the ring that holds the densities, in radii of the viewing circle


def choose(
    entropy: Float[np.ndarray, "samples"],
    error: Float[np.ndarray, "samples"],
    log_density: Float[np.ndarray, "points samples"],
    count: int = 4,
) -> dict[str, list[int]]:
    """Up to `count` samples for each row of Figure 3.6; the same arguments give the same samples.

    "certain": one peak, entropy at most the median, error at most π/6; "ambiguous": several peaks; "failed":
    as certain, but with a larger error, a confident mistake. Of each kind those of lowest entropy.

    Args:
        entropy: of each density, nats.
        error: absolute angular deviation of each point prediction, radians.
        log_density: on a regular grid over the whole circle.

    Raises:
        ValueError: a number is NaN.
    """
    if any(np.isnan(numbers).any() for numbers in (entropy, error, log_density)):
        raise ValueError("wanted numbers to choose samples by, got NaN among entropies, errors or densities.")
    if len(entropy) == 0:
        return {"certain": [], "ambiguous": [], "failed": []}
    several = peaks(log_density) > 1
    confident = ~several & (entropy <= np.median(entropy))
    right = error <= LARGE_ERROR
    rows = {"certain": confident & right, "ambiguous": several, "failed": confident & ~right}
    order = np.argsort(entropy, kind="stable")
    return {name: order[chosen[order]][:count].tolist() for name, chosen in rows.items()}


def peaks(log_density: Float[np.ndarray, "points samples"]) -> np.ndarray:
    """How many separate arcs of the circle have more than a quarter of the highest density, (samples,)."""
    high = log_density > log_density.max(0) - math.log(4)
    starts = (high & ~np.roll(high, 1, axis=0)).sum(0)
    return np.maximum(starts, 1)  # an arc that is the whole circle starts nowhere


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
    outer: float = 1.5,
    directions: tuple[str, str, str, str] = ("front", "right", "back", "left"),
) -> Figure:
    """Predicted densities on the viewing circle around each image, as in Figures 3.2 and 3.6.

    The circle is the object seen from above, its front (angle 0) at the bottom, angles counter-clockwise. A
    density is a band outside the circle, as thick as the density is high and to one scale in all panels; an
    outer circle cuts it, and is drawn thick where it does.

    Args:
        images: of the samples, as `Data.picture` gives them.
        log_density: nats, at `angles`, a regular grid over the whole circle, radians.
        truths, predictions: radians.
        captions: below each panel.
        modes: for each sample all angles that are as true as its truth (of a symmetric object), radians.
        rows: heading of each row, and how many of the samples stand in it, in their order; may be 0.
        outer: density at the outer circle, per radian; the uniform density is 0.16.
        directions: words for 0°, 90°, 180° and 270°.
    """
    lengths = (log_density.shape[1], sum(rows.values()), len(images), len(captions))
    if len(set(lengths)) != 1:
        raise ValueError(f"wanted as many densities as samples in rows, images and captions, got {lengths}.")
    density = np.exp(np.minimum(log_density.astype(np.float64), 700))  # beyond, float64 overflows
    if np.isnan(density).any():
        raise ValueError("wanted a log-density everywhere, got NaN.")
    across, tall = max(3, *rows.values()), [1.0 if count else 0.25 for count in rows.values()]
    figure = titled_figure((2.5 * across + 0.4, 2.75 * sum(tall) + 1.3), title, synthetic)
    panels = figure.subplots(len(rows), across, squeeze=False, height_ratios=tall)
    sample = 0
    for line, (heading, count) in zip(panels, rows.items(), strict=True):
        for axes in line:
            axes.set(xticks=[], yticks=[], frame_on=False)
        line[0].set_ylabel(heading, fontsize=11, weight="bold")
        if count == 0:
            line[0].text(0.5, 0.5, "no such sample", ha="center", va="center", color=GREY)
        for axes in line[:count]:
            _viewing_circle(axes, images[sample], density[:, sample], angles, outer, directions)
            _marks(axes, truths[sample], predictions[sample], () if modes is None else modes[sample])
            caption = "\n".join(textwrap.fill(part, 36) for part in captions[sample].splitlines())
            axes.set_xlabel(caption, fontsize=8, labelpad=1, parse_math=False)
            sample += 1
    handles = [
        Patch(color=BLUE, alpha=0.6, label="predicted density"),
        Line2D([], [], color="black", linewidth=3, label=f"cut off: above {outer:g} per radian"),
        Line2D([], [], color=GREY, linestyle=":", label="uniform density"),
        Line2D([], [], color=RED, marker="o", markersize=4, label="point prediction"),
        Line2D([], [], color=GREEN, marker="^", linestyle="", label="truth"),
    ]
    if modes is not None:
        handles.append(Line2D([], [], color=GREEN, marker="^", ls="", mfc="none", label="equally true"))
    note = f"The object from above: {directions[0]} (0°) is at the bottom, angles turn counter-clockwise."
    legend = figure.legend(handles=handles, title=note, loc="outside lower center", ncols=3, frameon=False)
    legend.get_title().set_parse_math(False)
    return figure


def training_curve(
    epochs: Sequence[int | float],
    train: Sequence[float],
    validation: Sequence[tuple[int | float, float]],
    *,
    best_epoch: int | float | None,
    title: str,
    synthetic: bool,
    y_label: str = "loss (nats per sample)",
) -> Figure:
    """Training and validation loss over epochs, the epoch of the kept weights marked.

    Args:
        epochs, train: where the training loss was recorded, and it.
        validation: pairs (epoch, value).
        best_epoch: whose weights were kept; None where none were.
    """
    figure = titled_figure((7.0, 4.3), title, synthetic)
    axes = figure.subplots()
    axes.plot(epochs, train, color=BLUE, linewidth=1.2, label="training")
    seen = np.array(validation, dtype=np.float64).reshape(-1, 2)
    axes.plot(*seen.T, color=RED, linewidth=1.5, marker="o", markersize=3.5, label="validation")
    values = [value for value in (*train, *seen[:, 1]) if math.isfinite(value)]
    if values:
        low, middle, high = np.percentile(values, [5, 50, 95])
        usual = max(abs(low), abs(high), 1e-12)
        if (
            max(abs(value - middle) for value in values) > 30 * usual
        ):  # one wild epoch must not flatten all others
            axes.set_yscale("symlog", linthresh=usual)
    if best_epoch is not None:
        axes.axvline(best_epoch, color=GREEN, linestyle="--", label=f"kept weights: epoch {best_epoch:g}")
    axes.set(xlabel="epoch", ylabel=y_label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return figure


def work_precision(
    curves: Mapping[str, Sequence[Point]],
    *,
    title: str,
    synthetic: bool,
    reference_error: float = 0.0,
    x_label: str = "run time (ms per sample)",
    y_label: str = "error of the mean log-likelihood (nats, RMS)",
) -> Figure:
    """The work-precision diagram: error against run time along a knob, both logarithmic, a curve a method.

    The knob's values stand beside the points. Bars are standard errors; rings mark the points that no other
    beats; an error of 0 sits on the lower edge and says so.

    Args:
        curves: the points of each method, in the order in which they are joined.
        reference_error: standard error of what the errors refer to, nats; shaded up to there.
    """
    figure = titled_figure((7.5, 5.0), title, synthetic)
    axes = figure.subplots()
    points = [point for curve in curves.values() for point in curve]
    drawn = [point for point in points if math.isfinite(point.error) and math.isfinite(point.milliseconds)]
    axes.set(xscale="log", yscale="log", xlabel=x_label, ylabel=y_label)
    errors = [point.error for point in drawn]
    tops = errors + np.nan_to_num([point.error_sem for point in drawn])
    extent = [value for value in (*errors, *tops, reference_error) if value > 0] or [1.0]
    bottom = min(extent) / 2
    axes.set_ylim(bottom, max(extent) * 2)
    if reference_error > 0:
        label = f"below {reference_error:.1g} nats the reference itself is uncertain"
        axes.axhspan(bottom, reference_error, color="0.87", zorder=0, label=label)
    notes, lines = [], []
    for index, (name, curve) in enumerate(curves.items()):
        shown = [point for point in curve if point in drawn]
        line = np.array([(point.milliseconds, max(point.error, bottom)) for point in shown]).reshape(-1, 2)
        spread = np.nan_to_num([point.error_sem for point in shown])
        below = np.minimum(spread, 0.999 * line[:, 1])
        style: Style = {"marker": MARKERS[index % len(MARKERS)], "color": _colour(index)[0], "capsize": 2.5}
        style["label"] = f"{name} ({', '.join(dict.fromkeys(point.knob for point in curve))})"
        axes.errorbar(line[:, 0], line[:, 1], [below, spread], clip_on=False, **style)
        texts = [f"{point.value:g}" if point.error > 0 else f"{point.value:g}: error 0" for point in shown]
        notes += [(x, y, text, style["color"]) for (x, y), text in zip(line, texts, strict=True)]
        lines.append(line)
    best = np.array(front(errors, [point.milliseconds for point in drawn]), dtype=bool)
    places = np.array([(point.milliseconds, max(point.error, bottom)) for point in drawn]).reshape(-1, 2)
    axes.plot(*places[best].T, **PARETO, clip_on=False, label="not beaten by another point (Pareto)")
    _finish(axes, len(points) - len(drawn))
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    _annotate(figure, axes, notes, lines)
    return figure


def comparison(
    rows: Sequence[Row],
    error: str,
    time: str,
    *,
    title: str,
    synthetic: bool,
    x_label: str,
    y_label: str,
    method: str = "method",
    group: str | None = None,
    better: Literal["lower", "higher"] = "lower",
) -> Figure:
    """Error against run time of many results: methods as colours, groups (object classes, say) as markers.

    Bars are the "<error>_std" or "<error>_sem" of a row. Rings mark the results that no other of the same
    group beats: errors on different groups do not compare.

    Args:
        rows: as for `framework.reports.table`.
        error, time, method, group: keys; without `group` all rows are one group. Up to 14 methods and 12
            groups look different.
        better: which way `error` is better; its axis is logarithmic for "lower" where all are positive.
    """
    figure = titled_figure((7.5, 5.2), title, synthetic)
    axes = figure.subplots()
    shown = [row for row in rows if math.isfinite(_value(row, error)) and 0 < _value(row, time) < math.inf]
    names = [str(row.get(method)) for row in shown]
    kinds = ["" if group is None else str(row.get(group)) for row in shown]
    colours = {name: _colour(index) for index, name in enumerate(dict.fromkeys(names))}
    markers = {kind: MARKERS[index % len(MARKERS)] for index, kind in enumerate(dict.fromkeys(kinds))}
    places = np.array([(_value(row, time), _value(row, error)) for row in shown]).reshape(-1, 2)
    axes.set(xscale="log", xlabel=x_label, ylabel=y_label)
    if better == "lower" and (places[:, 1] > 0).all():
        axes.set_yscale("log")
    for row, place, name, kind in zip(shown, places, names, kinds, strict=True):
        colour, face = colours[name]
        style: Style = {"marker": markers[kind], "color": colour, "markerfacecolor": face, "markersize": 7}
        axes.errorbar(place[0], place[1], _spread(row, error), capsize=2.5, **style)
    for kind in markers:
        members = places[[other == kind for other in kinds]]
        best = front((members[:, 1] * (1 if better == "lower" else -1)).tolist(), members[:, 0].tolist())
        axes.plot(*members[best].T, **PARETO)
    _finish(axes, len(rows) - len(shown))
    beaten = "not beaten" if group is None else f"not beaten in its {group}"
    handles = [Line2D([], [], **PARETO, label=f"{beaten} (Pareto)")]
    for name, (colour, face) in colours.items():
        handles.append(Line2D([], [], ls="", marker="o", color=colour, mfc=face, label=name))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    if group is not None:
        handles = [Line2D([], [], marker=markers[kind], color=GREY, ls="", label=kind) for kind in markers]
        figure.legend(handles=handles, loc="outside right upper", title=group, fontsize=9, frameon=False)
    return figure


def _viewing_circle(
    axes: Axes, image: np.ndarray, density: np.ndarray, angles: np.ndarray, outer: float, words: Sequence[str]
) -> None:
    height, width = image.shape[:2]
    # corners stay inside the circle, and the sides leave room for the words
    half = min(0.96 / math.hypot(height, width), 0.72 / max(height, width))
    axes.imshow(image, extent=(-half * width, half * width, -half * height, half * height))
    limit = 1 + RING + 0.2
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit))
    around, value = np.append(angles, angles[0]), np.append(density, density[0])
    band = np.append(1 + RING * np.minimum(value / outer, 1), np.ones_like(value))
    axes.fill(*_position(np.append(around, around[::-1]), band), color=BLUE, alpha=0.6, linewidth=0)
    cut = density > outer
    cut |= np.roll(cut, 1) | np.roll(cut, -1)  # so that a single angle is a visible arc
    edge = np.where(np.append(cut, cut[0]), 1 + RING, np.nan)
    axes.plot(*_position(around, edge), color="black", linewidth=3, zorder=4)
    for radius, line in ((1.0, "-"), (1 + RING, "-"), (1 + RING / (2 * math.pi * outer), ":")):
        axes.add_patch(Circle((0, 0), radius, fill=False, color=GREY, linestyle=line, zorder=3))
    for quarter, word in enumerate(words):
        x, y = _position(quarter * math.pi / 2, 0.86)
        style = {"fontsize": 6.5, "color": GREY, "rotation": 90 * (quarter % 2), "parse_math": False}
        axes.text(x, y, word, ha="center", va="center", **style)


def _marks(axes: Axes, truth: float, prediction: float, modes: Sequence[float] | np.ndarray) -> None:
    for angle, face in (*((mode, "none") for mode in modes), (truth, GREEN)):
        inwards = (3, 0, math.degrees(angle))  # a triangle outside the outer circle
        x, y = _position(angle, 1 + RING + 0.1)
        axes.plot(x, y, color=GREEN, marker=inwards, markerfacecolor=face, markersize=8, zorder=5)
    x, y = _position(prediction, np.array([1.0, 1 + RING]))
    axes.plot(x, y, color=RED, linewidth=1.6, marker="o", markevery=[0], markersize=4, zorder=5)


def _position(angle: Any, radius: Any) -> tuple[Any, Any]:
    """Where an angle (radians) is drawn: 0 at the bottom, counter-clockwise."""
    return radius * np.sin(angle), -radius * np.cos(angle)


def _finish(axes: Axes, left_out: int) -> None:
    """Ticks and grid; says how many results could not be drawn."""
    _plain_ticks(axes.xaxis)
    if axes.get_yscale() == "log":
        _plain_ticks(axes.yaxis)
    axes.grid(which="major", alpha=0.35)
    axes.spines[["top", "right"]].set_visible(False)
    if left_out:
        text = f"not drawn for want of a finite error and run time: {left_out}"
        axes.set_title(text, loc="right", fontsize=8, color=GREY)


def _plain_ticks(axis: Axis) -> None:
    """Numbers as people write them, and always some of them, on a logarithmic axis."""
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    steps = (1.0,) if decades > 3 else (1.0, 2.0, 5.0) if decades > 1.2 else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
    axis.set_major_locator(LogLocator(subs=steps) if decades > 0.5 else MaxNLocator(5))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _annotate(figure: Figure, axes: Axes, notes: Sequence[tuple[Any, ...]], lines: Sequence[Any]) -> None:
    """A word beside each point (x, y, text, colour), on the side where nothing is written or drawn yet."""
    figure.draw_without_rendering()  # settles the layout, so that places on the page are known
    pen = 2.0 * figure.dpi / 72
    taken = []
    for line in lines:
        corners = axes.transData.transform(line)
        between = np.linspace(0, 1, 40)[:, None, None]
        dots = corners[:-1] + between * (corners[1:] - corners[:-1])
        taken += [Bbox.from_bounds(x - pen / 2, y - pen / 2, pen, pen) for x, y in dots.reshape(-1, 2)]
        taken += [Bbox.from_bounds(x - 3 * pen, y - 3 * pen, 6 * pen, 6 * pen) for x, y in corners]
    frame, page = axes.bbox, figure.bbox
    for x, y, text, colour in notes:
        trials = []
        for across, up in SIDES:
            side = "left" if across > 0 else "right" if across < 0 else "center"
            note = axes.annotate(text, (x, y), (across, up), textcoords="offset points", ha=side, va="center")
            note.set(fontsize=8, color=colour, annotation_clip=False)
            box = note.get_window_extent()
            outside = box.x0 < frame.x0 or box.y0 < frame.y0 or box.x1 > page.x1 or box.y1 > page.y1
            trials.append((sum(box.overlaps(other) for other in taken) + 1000 * outside, note, box))
        best = min(trials, key=lambda trial: trial[0])
        taken.append(best[2])
        for trial in trials:
            if trial is not best:
                trial[1].remove()


def _value(row: Row, key: str) -> float:
    value = row.get(key)
    return math.nan if value is None else float(value)  # type: ignore[arg-type]


def _spread(row: Row, key: str) -> float | None:
    spreads = (_value(row, key + suffix) for suffix in SPREADS)
    return next((spread for spread in spreads if math.isfinite(spread)), None)


def _colour(index: int) -> tuple[str, str]:
    """Edge and face: the colours first filled, then hollow."""
    colour = COLOURS[index % len(COLOURS)]
    return colour, "none" if index // len(COLOURS) % 2 else colour
