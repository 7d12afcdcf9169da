"""Measure the time of an image against its numbers of faces and pixels, for `rasterizer.py`.

    python -m benchmarks.rendering.rasterizer_growth --draw

This command draws rasterizer_growth.png again from rasterizer_growth.csv, which `benchmarks/rendering/rasterizer.py`
writes.
"""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.pages import read_rows
from benchmarks.timing import times_of_calls
from framework.configuration.schema import build, resolve
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.geometry.camera import look_from
from framework.renderer import Scene
from framework.reports.table import Row, write_csv
from framework.testing.scenes import sphere

FACES = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
PIXELS = (100, 200, 400, 800, 1_600, 4_000)
"""Numbers of pixels along each side."""
CHANNELS = {"mask": "silhouette alone (mask)", "color": "colours"}
PANELS = {"faces": "faces of the ball (400 × 400 pixels)", "pixels": "pixels of the image (10,000 faces)"}


def ball(faces: int, side: int) -> Scene:
    """Return a scene of a closed sphere that fills most of a square image."""
    return replace(
        sphere(int(math.sqrt(faces / 4))), camera=look_from(0.3, 0.2, 0.1, 4.0, 0.55, (side, side))
    )


def milliseconds(call: Callable[[], object]) -> float:
    """Return the median processor time of a call, ms, over half a second of calls but at least three."""
    call()
    return median(times_of_calls(call, 0.5, time.thread_time))


def slope(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Return the slope of the line through the upper half of the points, on double logarithmic axes."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(times[half:]), 1)[0])


def report(figure_path: Path) -> list[str]:
    """Measure, write the csv table, draw the figure at the path, and return the lines of the page."""
    renderer = build(
        "renderer", resolve("renderer", {"name": "rasterizer", "cull": True, "savings": ("view", "box")})
    )
    lines, rows = ["| channel | varied number | number: time in ms | slope |", "|---|---|---|---|"], []
    for name, scenes in (
        ("faces", [ball(count, 400) for count in FACES]),
        ("pixels", [ball(10_000, side) for side in PIXELS]),
    ):
        sizes = [len(scene.faces) for scene in scenes] if name == "faces" else [side**2 for side in PIXELS]
        for channel in CHANNELS:
            times = [milliseconds(partial(renderer, scene, (channel,))) for scene in scenes]
            rows += [
                {
                    "channel": channel,
                    "against": name,
                    "size": size,
                    "milliseconds": milliseconds_a_call,
                    "synthetic": True,
                }
                for size, milliseconds_a_call in zip(sizes, times, strict=True)
            ]
            times_text = ", ".join(
                f"{size:.3g}: {milliseconds_a_call:.2f}"
                for size, milliseconds_a_call in zip(sizes, times, strict=True)
            )
            lines.append(f"| {channel} | {name} | {times_text} | {slope(sizes, times):.2f} |")
    write_csv(rows, None, figure_path.with_suffix(".csv"))
    draw_figure(rows, figure_path)
    return [*lines, "", f"![Time of an image against faces and pixels]({figure_path.name})"]


def draw_figure(rows: Sequence[Row], figure_path: Path) -> None:
    """Save the figure of time against faces and pixels."""
    figure = titled_figure((9, 4), "Time of an image of a ball", True)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (against, label) in zip(panels, PANELS.items(), strict=True):
        for (channel, name), colour, marker in zip(CHANNELS.items(), COLOURS, MARKERS, strict=False):
            own = [row for row in rows if (row["channel"], row["against"]) == (channel, against)]
            sizes, times = ([row[key] for row in own] for key in ("size", "milliseconds"))
            axes.loglog(sizes, times, color=colour, marker=marker, markersize=4, label=name)
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("median processor time (ms, one core)")
    panels[0].legend(frameon=False, fontsize=9)
    save_figure(figure, figure_path.with_suffix(""), True)


if __name__ == "__main__":
    if sys.argv[1:] != ["--draw"]:
        sys.exit(
            "This script needs the argument --draw. To measure, run python -m benchmarks.rendering.rasterizer."
        )
    own = Path(__file__).resolve()
    draw_figure(read_rows(own.with_suffix(".csv")), own.with_suffix(".png"))
