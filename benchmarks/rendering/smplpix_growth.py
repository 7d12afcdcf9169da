"""Time images against the vertices of their mesh: rasterised, and drawn by networks from projected vertices.

    python -m benchmarks.rendering.smplpix_growth
    python -m benchmarks.rendering.smplpix_growth --draw

Writes smplpix_growth.md, .csv and .png beside this file; `--draw` draws the figure again from the table.
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
from benchmarks.rendering.rasterizer_growth import milliseconds, slope
from framework.bodies.people import load_body
from framework.bodies.topologies import Name, sheet, topology
from framework.configuration.schema import build, resolve
from framework.encoder import Encoder
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.reports.table import Row, write_csv
from plugins.data.human_scans.data import in_front
from plugins.encoder.unets.canvas import fast_bfloat16

SIZE = (410, 308)
TOPOLOGIES: tuple[Name, ...] = ("7k", "27k", "110k")
ROUNDS = 3


def person(name: Name) -> Tensor:
    """(points, 6): the default body at rest in a topology, coloured by place, before the canonical camera."""
    body, _ = load_body(None)
    whole = sheet(body)
    rows = topology(body, whole, name).rows
    vertices = torch.from_numpy(whole.interpolate(body.template.astype(np.float64))[rows]).float()
    low, high = vertices.min(0).values, vertices.max(0).values
    return torch.cat([in_front(vertices, *SIZE).to_canonical(vertices), (vertices - low) / (high - low)], 1)[
        None
    ]


def encoder(name: str, shape: tuple[int, ...], **config: object) -> Encoder:
    torch.manual_seed(0)
    return build(
        "encoder", resolve("encoder", {"name": name, **config}), input_shape=shape, input_columns=()
    ).eval()


def ways(shape: tuple[int, ...], name: str) -> dict[str, Callable[[Tensor], Tensor]]:
    """An image from coloured points, by how it is drawn."""
    height, width = SIZE
    size = {"height": height, "width": width}
    projection = encoder("projection", shape, **size)

    def meshed(samples: int, **more: object) -> Encoder:
        drawing = {"name": "rasterizer", "supersampling": samples}
        return encoder("rasterised", shape, topology=name, renderer=drawing, **size, **more)

    # emulated, bfloat16 takes eight times as long: no way that anybody would go
    precisions = ("float32", "bfloat16")[: 1 + fast_bfloat16(torch.device("cpu"))]
    networks = {precision: encoder("slim", (4, *SIZE), precision=precision) for precision in precisions}
    best, with_depth = precisions[-1], meshed(1, depth=True)
    return {
        "rasterised, 1 sample a pixel": meshed(1),
        "rasterised, 4 × 4 samples": meshed(4),
        "projection alone": projection,
        **{
            f"SMPLpix (slim, {precision})": lambda points, network=network: network(projection(points))
            for precision, network in networks.items()
        },
        f"slim over the mesh ({best})": lambda points: networks[best](with_depth(points)),
    }


@torch.inference_mode()
def report(picture: Path) -> str:
    torch.set_num_threads(1)
    people = {name: person(name) for name in TOPOLOGIES}
    calls = {name: ways(tuple(points.shape[1:]), name) for name, points in people.items()}
    covered = float((calls["7k"]["rasterised, 1 sample a pixel"](people["7k"]) < 1).any(1).float().mean())
    found = {way: [math.inf] * len(TOPOLOGIES) for way in calls["7k"]}
    for _ in range(ROUNDS):
        for way, times in found.items():
            for place, name in enumerate(TOPOLOGIES):
                took = milliseconds(partial(calls[name][way], people[name]))
                times[place] = min(times[place], took)
    counts = [points.shape[1] for points in people.values()]
    measured = [
        {"way": way, "vertices": count, "milliseconds": each, "synthetic": True}
        for way, times in found.items()
        for count, each in zip(counts, times, strict=True)
    ]
    write_csv(measured, None, picture.with_suffix(".csv"))
    drawn(measured, picture)
    rows = [
        f"| {way} | {' | '.join(f'{each:.2f}' for each in times)} | {times[-1] / times[0]:.1f} | "
        f"{slope([float(count) for count in counts], times):.2f} |"
        for way, times in found.items()
    ]
    return "\n".join(
        [
            "# Run time of an image against the vertices of its mesh",
            "",
            f"The default body (synthetic colours), {SIZE[0]} × {SIZE[1]} pixels, of which it covers {covered:.0%}; "
            f"one thread; processor time, the lowest of {ROUNDS} medians, all in turn, ms. Networks compute the "
            "subject's box alone; their weights are drawn, which changes no time. Slope: on double logarithmic axes, "
            "over the last two.",
            "",
            f"| vertices | {' | '.join(f'{count:,}' for count in counts)} | last over first | slope |",
            f"|---|{'---|' * (len(counts) + 2)}",
            *rows,
            "",
            f"![Milliseconds against vertices]({picture.name})",
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_growth`.",
        ]
    )


def drawn(rows: Sequence[Row], picture: Path) -> None:
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
    save_figure(figure, picture.with_suffix(""), True)


if __name__ == "__main__":
    place = Path(__file__).resolve().with_suffix(".md")
    if sys.argv[1:] == ["--draw"]:
        drawn(read_rows(place.with_suffix(".csv")), place.with_suffix(".png"))
    else:
        text = report(place.with_suffix(".png"))
        write_page(__file__, text)
        sys.stdout.write(text + "\n")
