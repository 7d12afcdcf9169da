"""Figures of error against run time, with one panel per metric and one colour per method.

Each method is a curve over the values of a knob, or a single result.
"""

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from framework.evaluation.pareto import NOISE, TIME_NOISE, front
from framework.evaluation.significance import mean
from framework.figures.style import COLOURS, GREY, MARKERS, titled_figure
from framework.reports.table import SPREADS, Better, Row

# Offsets of a text from its data point, in typographical points, in order of preference.
SIDES = ((9, 6), (9, -6), (-9, 6), (-9, -6), (0, 13), (0, -13), (12, 15), (12, -15), (-12, 15))

Style = dict[str, Any]
PARETO: Style = {"ls": "", "marker": "o", "mfc": "none", "markersize": 13, "mec": "black"}
"""Style of the rings around the points of the Pareto front."""
FRONT = "front"
"""Matplotlib identifier (gid) of the rings around the points of the Pareto front."""
SHADE = "0.87"
"""Grey level of the area in which errors are not meaningful."""
LEGEND_LINE = 0.21
"""Height of a line of the legend, inches."""
ACROSS = 3
"""Largest number of panels side by side."""


@dataclass(frozen=True)
class Floor:
    """Value `height` below which an error is not meaningful, and its explanation `meaning` for the legend."""

    height: float
    meaning: str


@dataclass(frozen=True)
class _Series:
    """Rows that are drawn in one style: those of a method or, if there are groups, of a method in a group."""

    method: str
    group: str
    rows: list[Row]
    style: Style


def error_against_run_time(
    rows: Sequence[Row],
    labels: Mapping[str, str],
    better: Better,
    *,
    title: str,
    synthetic: bool,
    machine: str,
    time: str = "milliseconds_per_sample",
    group: str | None = None,
    floors: Mapping[str, Floor] | None = None,
    note: str = "",
) -> Figure:
    """Draw the numbers of each result against its run time, in one panel for each key of `labels`.

    The axis of run time is logarithmic, and so is the axis of an error without negative values. Rows of a method that
    have a "knob" are connected in their order, and the knob's "value" is written beside each point. The length of error
    bars is a row's "<key>_std" or "<key>_sem". Rings mark the Pareto front of each group
    (`framework.evaluation.pareto`); errors of different groups are not compared. A panel without standard errors has no
    rings, but a text that says so. On a logarithmic axis an error of 0 is drawn on the lower edge and labelled.

    Args:
        rows: the results, one per row, with the numbers of each by key and its "method".
        labels: label of the axis, by key.
        better: for each key, the direction in which it is better; a key with "lower" is an error.
        title: title of the figure.
        synthetic: whether the data are generated.
        machine: machine and number of threads of the measurement, which is written on every time axis.
        time: key of the run time.
        group: key whose value is a row's group; None: all rows are one group. Up to 14 methods and 12 groups have
            different styles.
        floors: floors by key; the area below a floor is shaded.
        note: text below the figure.
    """
    across = min(ACROSS, len(labels))
    down = -(-len(labels) // across)
    size = (7.5, 5.2) if len(labels) == 1 else (5.4 * across, 4.3 * down + 0.6)
    figure = titled_figure(size, title, synthetic)
    panels = list(figure.subplots(down, across, squeeze=False).flat)
    for axes in panels[len(labels) :]:
        axes.set_visible(False)
    width = int(11 * size[0] / across)  # letters
    x_label = "\n".join(["run time (ms per sample)", *textwrap.wrap(f"on {machine}", width)])
    series = _series([row for row in rows if any(_drawable(row, key, time) for key in labels)], group)
    floors = floors or {}
    texts = []
    for axes, (key, label) in zip(panels, labels.items(), strict=False):
        axes.set(xscale="log", ylabel=label)
        axes.set_xlabel(x_label, parse_math=False)
        texts.append(_panel(axes, series, key, time, lower=better.get(key) == "lower", floor=floors.get(key)))
        left_out = len(rows) - sum(_drawable(row, key, time) for row in rows)
        if left_out:
            text = f"not drawn, without finite error and run time: {left_out}"
            axes.set_title(text, loc="right", fontsize=8, color=GREY)
    _legends(figure, series, group, [floor.meaning for floor in floors.values() if floor.height > 0], note)
    figure.draw_without_rendering()  # computes the layout, which `_annotate` needs
    for axes, (notes, lines) in zip(panels, texts, strict=False):
        _annotate(axes, notes, lines)
    return figure


def _series(rows: Sequence[Row], group: str | None) -> list[_Series]:
    """Return the rows by method and group, with the style of each series."""
    members_of: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        kind = "" if group is None else str(row.get(group))
        members_of.setdefault((str(row.get("method")), kind), []).append(row)
    methods, kinds = (
        (list(dict.fromkeys(names)) for names in zip(*members_of, strict=True)) if members_of else ([], [])
    )
    series = []
    for (method, kind), members in members_of.items():
        position = methods.index(method)
        colour = COLOURS[position % len(COLOURS)]
        style: Style = {
            "color": colour,
            "marker": MARKERS[(position if group is None else kinds.index(kind)) % len(MARKERS)],
            "markerfacecolor": "none"
            if position // len(COLOURS) % 2
            else colour,  # hollow when colours repeat
            "linestyle": "-" if members[0].get("knob") else "",
        }
        series.append(_Series(method, kind, members, style))
    return series


def _panel(
    axes: Axes, series: Sequence[_Series], key: str, time: str, *, lower: bool, floor: Floor | None
) -> tuple[list[tuple[Any, ...]], list[np.ndarray]]:
    """Draw the panel of one metric.

    Returns:
        The texts to write beside points, each as (x, y, text, colour), and the drawn lines, which the texts should not
        cover.
    """
    drawn_rows = [[row for row in entry.rows if _drawable(row, key, time)] for entry in series]
    positions = [
        np.array([(_value(row, time), _value(row, key)) for row in rows]).reshape(-1, 2)
        for rows in drawn_rows
    ]
    spreads = [np.array([_spread(row, key) for row in rows]) for rows in drawn_rows]
    all_points = np.concatenate([np.zeros((0, 2)), *positions])
    errors, bars = all_points[:, 1], np.concatenate([np.zeros(0), *spreads])
    first, last = (all_points[:, 0].min(), all_points[:, 0].max()) if len(all_points) else (1.0, 1.0)
    axes.set_xlim(first / _room(first, last), last * _room(first, last))
    bottom = -math.inf
    if lower and (errors >= 0).all():
        ends = np.concatenate([np.maximum(errors - bars, errors / 2), errors + bars])
        ends = ends[ends > 0] if (ends > 0).any() else np.ones(1)
        low, high = ends.min(), ends.max()
        if floor is not None and floor.height > 0:
            # A reference that is exact to rounding error must not stretch the panel over ten decades.
            low, high = min(low, max(floor.height, low / 100)), max(high, floor.height)
        room = _room(low, high)
        bottom = low / room
        axes.set(yscale="log", ylim=(bottom, high * room))
        if floor is not None and floor.height > bottom:
            axes.axhspan(bottom, floor.height, color=SHADE, zorder=0)
    notes, lines = [], []
    for entry, rows, line, spread in zip(series, drawn_rows, positions, spreads, strict=True):
        zero = line[:, 1] < bottom
        line[:, 1] = np.maximum(line[:, 1], bottom)
        below = np.minimum(spread, line[:, 1] - bottom)
        axes.errorbar(line[:, 0], line[:, 1], [below, spread], capsize=2.5, clip_on=False, **entry.style)
        lines += [line] if entry.style["linestyle"] else []
        ends = np.stack([line[:, 1] - below, line[:, 1] + spread], 1)
        lines += [np.column_stack([[x, x], end]) for x, end in zip(line[:, 0], ends, strict=True)]
        for row, (x, y), is_zero in zip(rows, line, zero, strict=True):
            parts = [f"{_value(row, 'value'):g}"] if row.get("knob") else []
            parts += ["error 0"] if is_zero else []
            notes += [(x, y, ": ".join(parts), entry.style["color"])] if parts else []
    for kind in dict.fromkeys(entry.group for entry in series):
        members = [index for index, entry in enumerate(series) if entry.group == kind]
        points = np.concatenate([positions[index] for index in members])
        means = [
            mean(row, key, row.get("n", row.get("repeats"))) for index in members for row in drawn_rows[index]
        ]
        signed = [
            replace(value, value=height if lower else -height)
            for value, height in zip(means, points[:, 1], strict=True)
        ]
        best = front(signed, points[:, 0].tolist(), TIME_NOISE)
        if any(best):
            axes.plot(*points[best].T, **PARETO, clip_on=False, gid=FRONT)
        elif len(points) > 1:
            axes.set_title("no front: standard errors not known", loc="left", fontsize=8, color=GREY)
    _plain_ticks(axes.xaxis)
    if axes.get_yscale() == "log":
        _plain_ticks(axes.yaxis)
    axes.grid(which="major", alpha=0.35)
    axes.spines[["top", "right"]].set_visible(False)
    return notes, lines


def _legends(
    figure: Figure, series: Sequence[_Series], group: str | None, shaded: Sequence[str], note: str
) -> None:
    """Draw the legends of methods, markers and groups."""
    handles: list[Line2D | Patch] = []
    for entry in {entry.method: entry for entry in reversed(series)}.values():
        knobs = ", ".join(dict.fromkeys(str(row["knob"]) for row in entry.rows if row.get("knob")))
        marker = entry.style["marker"] if group is None else "o"
        label = f"{entry.method} ({knobs})" if knobs else entry.method
        handles.insert(0, Line2D([], [], **{**entry.style, "marker": marker}, label=label))
    if ringed := any(line.get_gid() == FRONT for axes in figure.axes for line in axes.lines):
        beaten = "not beaten beyond noise" + ("" if group is None else f" in its {group}")
        handles.append(Line2D([], [], **PARETO, label=f"{beaten} (Pareto)"))
    handles += [Patch(color=SHADE, label=meaning) for meaning in shaded]
    longest = max((len(str(handle.get_label())) for handle in handles), default=0)
    columns = max(1, int(figure.get_figwidth() / (0.7 + 0.08 * longest)))  # inches
    lines = -(-len(handles) // columns)
    figure.set_figheight(figure.get_figheight() + LEGEND_LINE * max(0, lines - 4))
    style: Style = {"fontsize": 9, "frameon": False}
    legend = figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=columns,
        title="; ".join(filter(None, [NOISE if ringed else "", note])),
        **style,
    )
    legend.get_title().set(fontsize=7, color=GREY, parse_math=False)
    if group is not None:
        kinds = {entry.group: entry.style["marker"] for entry in series}
        handles = [
            Line2D([], [], marker=marker, color=GREY, ls="", label=kind) for kind, marker in kinds.items()
        ]
        figure.legend(handles=handles, loc="outside right center", title=group, **style)


def _room(low: float, high: float) -> float:
    """Return the factor by which a logarithmic axis extends beyond `low` and `high`; 2 if they are equal."""
    return (high / low) ** 0.1 if high > low else 2.0


def _plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, also if it covers less than a power of ten."""
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    steps = (1.0,) if decades > 3 else (1.0, 2.0, 5.0) if decades > 1.2 else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
    axis.set_major_locator(LogLocator(subs=steps) if decades > 0.5 else MaxNLocator(5))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _annotate(axes: Axes, notes: Sequence[tuple[Any, ...]], lines: Sequence[np.ndarray]) -> None:
    """Write each text of `notes` (x, y, text, colour) beside its point, on the side where it covers the least."""
    pen = axes.figure.dpi / 72  # pixels per typographical point
    edges = [np.zeros((0, 4))]  # boxes of the drawn lines: left, bottom, right, top in pixels
    for line in lines:
        corners = axes.transData.transform(line)
        between = np.linspace(0, 1, 200)[:, None, None]
        dots = (corners[:-1] + between * (corners[1:] - corners[:-1])).reshape(-1, 2)
        edges += [np.hstack([dots - pen, dots + pen]), np.hstack([corners - 6 * pen, corners + 6 * pen])]
    occupied, frame = np.concatenate(edges), axes.bbox
    for x, y, text, colour in notes:
        trials = []
        for across, up in SIDES:
            side = "left" if across > 0 else "right" if across < 0 else "center"
            note = axes.annotate(text, (x, y), (across, up), textcoords="offset points", ha=side, va="center")
            note.set(fontsize=8, color=colour, annotation_clip=False)
            box = note.get_window_extent().extents
            overlaps = ((occupied[:, :2] <= box[2:]) & (occupied[:, 2:] >= box[:2])).all(1).sum()
            outside = bool(np.any(box[:2] < frame.min) or np.any(box[2:] > frame.max))
            trials.append((overlaps + 10_000 * outside, note, box))
        best = min(trials, key=lambda trial: trial[0])
        occupied = np.vstack([occupied, best[2]])
        for trial in trials:
            if trial is not best:
                trial[1].remove()


def _drawable(row: Row, key: str, time: str) -> bool:
    """Return whether a row has a finite number `key`, and a finite run time `time` above 0."""
    return math.isfinite(_value(row, key)) and 0 < _value(row, time) < math.inf


def _value(row: Row, key: str) -> float:
    """Return the number of a key; NaN if the row has none."""
    value = row.get(key)
    return math.nan if value is None else float(value)  # type: ignore[arg-type]


def _spread(row: Row, key: str) -> float:
    """Return the half-length of a row's error bar; 0 if it is not known."""
    spreads = (_value(row, key + suffix) for suffix in SPREADS)
    return next((spread for spread in spreads if math.isfinite(spread)), 0.0)
