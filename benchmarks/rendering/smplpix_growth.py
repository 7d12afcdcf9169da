"""Measure the run time of images against the vertices of their mesh: rendered, and drawn by networks.

    python -m benchmarks.rendering.smplpix_growth
    python -m benchmarks.rendering.smplpix_growth --draw

The script writes smplpix_growth.md, .csv and .png beside this file. `--draw` draws the figure again from the csv file.
"""

import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.pages import machine, read_rows, write_page
from benchmarks.rendering.builders import build_encoder
from benchmarks.rendering.rasterizer_growth import milliseconds, slope
from framework.bodies.people import load_body
from framework.bodies.topologies import Name, sheet, topology
from framework.encoder import Encoder
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.reports.table import Row, write_csv
from framework.storage.processor import fast_bfloat16
from plugins.data.human_scans.data import in_front

SIZE = (410, 308)
TOPOLOGIES: tuple[Name, ...] = ("7k", "27k", "110k")
ROUNDS = 3


def person(name: Name) -> Tensor:
    """Return the default body in the rest pose: points (1, points, 6), coloured by position, in camera coordinates."""
    body, _ = load_body(None)
    whole = sheet(body)
    rows = topology(body, whole, name).rows
    vertices = torch.from_numpy(whole.interpolate(body.template.astype(np.float64))[rows]).float()
    low, high = vertices.min(0).values, vertices.max(0).values
    return torch.cat([in_front(vertices, *SIZE).to_canonical(vertices), (vertices - low) / (high - low)], 1)[
        None
    ]


def ways(shape: tuple[int, ...], name: str) -> dict[str, Callable[[Tensor], Tensor]]:
    """Return the functions that draw an image from coloured points, by name of the way."""
    height, width = SIZE
    size = {"height": height, "width": width}
    projection = build_encoder("projection", shape, **size)

    def mesh_encoder(samples: int, **more: object) -> Encoder:
        drawing = {"name": "rasterizer", "supersampling": samples}
        return build_encoder("rasterised", shape, topology=name, renderer=drawing, **size, **more)

    # bfloat16 is left out if the processor emulates it, because it then takes eight times as long
    precisions = ("float32", "bfloat16")[: 1 + fast_bfloat16(torch.device("cpu"))]
    networks = {precision: build_encoder("slim", (4, *SIZE), precision=precision) for precision in precisions}
    best, with_depth = precisions[-1], mesh_encoder(1, depth=True)
    return {
        "rasterised, 1 sample a pixel": mesh_encoder(1),
        "rasterised, 4 × 4 samples": mesh_encoder(4),
        "projection alone": projection,
        **{
            f"SMPLpix (slim, {precision})": lambda points, network=network: network(projection(points))
            for precision, network in networks.items()
        },
        f"slim over the mesh ({best})": lambda points: networks[best](with_depth(points)),
    }


@torch.inference_mode()
def report(figure_path: Path) -> str:
    """Measure, write the csv table, draw the figure at the path, and return the page."""
    torch.set_num_threads(1)
    people = {name: person(name) for name in TOPOLOGIES}
    calls = {name: ways(tuple(points.shape[1:]), name) for name, points in people.items()}
    covered = float((calls["7k"]["rasterised, 1 sample a pixel"](people["7k"]) < 1).any(1).float().mean())
    lowest = {way: [math.inf] * len(TOPOLOGIES) for way in calls["7k"]}
    for _ in range(ROUNDS):
        for way, times in lowest.items():
            for place, name in enumerate(TOPOLOGIES):
                time_of_call = milliseconds(partial(calls[name][way], people[name]))
                times[place] = min(times[place], time_of_call)
    counts = [points.shape[1] for points in people.values()]
    measured = [
        {"way": way, "vertices": count, "milliseconds": time_ms, "synthetic": True}
        for way, times in lowest.items()
        for count, time_ms in zip(counts, times, strict=True)
    ]
    write_csv(measured, None, figure_path.with_suffix(".csv"))
    draw_figure(measured, figure_path)
    rows = [
        f"| {way} | {' | '.join(f'{time_ms:.2f}' for time_ms in times)} | {times[-1] / times[0]:.1f} | "
        f"{slope([float(count) for count in counts], times):.2f} |"
        for way, times in lowest.items()
    ]
    return "\n".join(
        [
            "# Run time of an image against the vertices of its mesh",
            "",
            "This page measures how the run time of an image grows with the number of vertices of its mesh. It "
            "compares a renderer that draws the mesh with neural networks (SMPLpix) that draw the image from "
            "projected vertices. The run time of the networks should depend less on the number of vertices.",
            "",
            f"The rendered images have {SIZE[0]} × {SIZE[1]} pixels and show the default body with synthetic colours, "
            f"which covers {covered:.0%} of the pixels. All numbers except the last two columns are processor times "
            f"in ms on one thread: the lowest of {ROUNDS} medians. The methods are measured in turn. The networks "
            "compute only the pixels in the bounding box of the body. Their weights are random, which does not "
            "change the run time.",
            "",
            "In the table, `rasterised` is the rendering of the mesh. `projection alone` only projects the "
            "vertices into the image. `SMPLpix` is projection followed by the network `slim`. `slim over the "
            "mesh` is the network applied to a rendered image of the mesh with depth. `last / "
            "first` is the time with the most vertices divided by the time with the fewest. `slope` is the "
            "slope of the time between the last two columns of vertices, on double logarithmic axes: 1 means that "
            "the time is proportional to the number of vertices.",
            "",
            f"| way to draw | {' | '.join(f'{count:,} vertices, ms' for count in counts)} | last / first | slope |",
            f"|---|{'---|' * (len(counts) + 2)}",
            *rows,
            "",
            f"![Time of an image against vertices]({figure_path.name})",
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_growth`.",
        ]
    )


def draw_figure(rows: Sequence[Row], figure_path: Path) -> None:
    """Save the figure of time against vertices."""
    figure = titled_figure(
        (8, 4.4), f"Time of an image of {SIZE[0]} × {SIZE[1]} pixels against vertices", True
    )
    axes = figure.subplots()
    for way, colour, marker in zip(
        dict.fromkeys(str(row["way"]) for row in rows), COLOURS, MARKERS, strict=False
    ):
        own = [row for row in rows if row["way"] == way]
        counts, times = ([row[key] for row in own] for key in ("vertices", "milliseconds"))
        style = "--" if way == "projection alone" else "-"
        axes.loglog(counts, times, style, color=colour, marker=marker, markersize=5, label=way)
    ticks = [int(str(count)) for count in dict.fromkeys(row["vertices"] for row in rows)]
    axes.set_xticks(ticks, [f"{count:,}" for count in ticks])
    axes.minorticks_off()
    axes.set_xlabel("vertices")
    axes.set_ylabel("processor time (ms, one core)")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right center", frameon=False, fontsize=9)
    save_figure(figure, figure_path.with_suffix(""), True)


if __name__ == "__main__":
    place = Path(__file__).resolve().with_suffix(".md")
    if sys.argv[1:] == ["--draw"]:
        draw_figure(read_rows(place.with_suffix(".csv")), place.with_suffix(".png"))
    else:
        text = report(place.with_suffix(".png"))
        write_page(__file__, text)
        sys.stdout.write(text + "\n")
