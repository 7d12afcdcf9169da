"""Time of an image against its faces and pixels, for `rasterizer.py`.

    python -m benchmarks.rendering.rasterizer_growth --draw

draws rasterizer_growth.png again from rasterizer_growth.csv, which `benchmarks/rendering/rasterizer.py` writes.
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
from framework.configuration.schema import build, resolve
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.geometry.camera import look_from
from framework.renderer import Scene
from framework.reports.table import Row, write_csv
from framework.testing.scenes import sphere

FACES = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
PIXELS = (100, 200, 400, 800, 1_600, 4_000)
"""Along each side."""
CHANNELS = {"mask": "silhouette alone (mask)", "color": "colours"}
PANELS = {"faces": "faces of the ball (400 × 400 pixels)", "pixels": "pixels of the image (10,000 faces)"}


def ball(faces: int, side: int) -> Scene:
    """A closed sphere that fills most of a square image."""
    return replace(
        sphere(int(math.sqrt(faces / 4))), camera=look_from(0.3, 0.2, 0.1, 4.0, 0.55, (side, side))
    )


def milliseconds(call: Callable[[], object]) -> float:
    """Median processor time of the calling thread: of calls for half a second, three at least."""
    call()
    times: list[float] = []
    while len(times) < 3 or sum(times) < 0.5:
        start = time.thread_time()
        call()
        times.append(time.thread_time() - start)
    return 1e3 * median(times)


def slope(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Of the line through the upper half of the points, on double logarithmic axes."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(times[half:]), 1)[0])


def report(picture: Path) -> list[str]:
    """Lines of Markdown; writes the table and draws the figure beside."""
    renderer = build(
        "renderer", resolve("renderer", {"name": "rasterizer", "cull": True, "savings": ("view", "box")})
    )
    lines, rows = [], []
    for name, scenes in (
        ("faces", [ball(count, 400) for count in FACES]),
        ("pixels", [ball(10_000, side) for side in PIXELS]),
    ):
        sizes = [len(scene.faces) for scene in scenes] if name == "faces" else [side**2 for side in PIXELS]
        for channel in CHANNELS:
            times = [milliseconds(partial(renderer, scene, (channel,))) for scene in scenes]
            rows += [
                {"channel": channel, "against": name, "size": size, "milliseconds": each, "synthetic": True}
                for size, each in zip(sizes, times, strict=True)
            ]
            told = ", ".join(f"{size:.3g}: {each:.2f}" for size, each in zip(sizes, times, strict=True))
            lines.append(
                f"- {channel} against {name}, ms: {told}; slope of the upper half {slope(sizes, times):.2f}"
            )
    write_csv(rows, None, picture.with_suffix(".csv"))
    drawn(rows, picture)
    return [*lines, "", f"![Milliseconds against faces and pixels]({picture.name})"]


def drawn(rows: Sequence[Row], picture: Path) -> None:
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
    save_figure(figure, picture.with_suffix(""), True)


if __name__ == "__main__":
    if sys.argv[1:] != ["--draw"]:
        sys.exit("Wanted --draw; benchmarks/rendering/rasterizer.py measures.")
    own = Path(__file__).resolve()
    drawn(read_rows(own.with_suffix(".csv")), own.with_suffix(".png"))
