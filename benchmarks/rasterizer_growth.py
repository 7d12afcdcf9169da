"""How a picture's time grows with faces and with pixels, for benchmarks/rasterizer.py."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np

from framework.configuration.schema import build, resolve
from framework.geometry.camera import look_from
from framework.renderer import Scene
from framework.testing.scenes import sphere

FACES = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
PIXELS = (100, 200, 400, 800, 1_600, 4_000)
"""Along each side."""


def ball(faces: int, side: int) -> Scene:
    """A closed sphere that fills most of a square picture."""
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


def slope(sizes: list[float], times: list[float]) -> float:
    """Of the line through the upper half of the points, on double logarithmic axes."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(times[half:]), 1)[0])


def report(picture: Path) -> list[str]:
    """Lines of Markdown; draws the picture."""
    from matplotlib.figure import Figure

    renderer = build(
        "renderer", resolve("renderer", {"name": "rasterizer", "cull": True, "savings": ("view", "box")})
    )
    asked = ("mask", "color")
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    lines = []
    for axis, name, sizes, scenes in (
        (axes[0], "faces", [float(count) for count in FACES], [ball(count, 400) for count in FACES]),
        (axes[1], "pixels", [float(side**2) for side in PIXELS], [ball(10_000, side) for side in PIXELS]),
    ):
        if name == "faces":
            sizes = [float(len(scene.faces)) for scene in scenes]
        for channel in asked:
            times = [milliseconds(partial(renderer, scene, (channel,))) for scene in scenes]
            axis.loglog(sizes, times, "o-", label=channel, markersize=4)
            told = ", ".join(f"{size:.3g}: {each:.2f}" for size, each in zip(sizes, times, strict=True))
            lines.append(
                f"- {channel} against {name}, ms: {told}; slope of the upper half {slope(sizes, times):.2f}"
            )
        axis.set_xlabel(f"{name} of a picture" + (" (400 × 400)" if name == "faces" else " (9,800 faces)"))
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("milliseconds, one core")
    axes[0].legend(frameon=False)
    figure.suptitle("Time of a picture of a ball (synthetic)", fontsize="medium")
    figure.savefig(picture, dpi=150)
    return [*lines, "", f"![Milliseconds against faces and pixels]({picture.name})"]
