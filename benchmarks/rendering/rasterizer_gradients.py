"""Compare the rasteriser's four gradients with differences of a supersampled image, and time them.

    python -m benchmarks.rendering.rasterizer_gradients

Writes rasterizer_gradients.md and rasterizer_gradients.png beside this file; about two minutes on one core.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pages import machine, write_page
from benchmarks.rendering.rasterizer import DISTANCE, HEIGHT, WIDTH, figure
from benchmarks.rendering.rasterizer import scene as figure_scene
from benchmarks.timing import milliseconds
from framework.configuration.schema import build, resolve
from framework.renderer import Renderer
from framework.reports.tradeoff_picture import error_against_run_time
from plugins.renderer.rasterizer.test_gradient import KINDS, VIEWS, blob, parameters, scene

HERE = Path(__file__)
SIGMAS = (1e-6, 1e-5, 1e-4, 1e-3)
METHODS = {
    "boundary": ({"gradient": "boundary"}, "supersampling", (1, 2, 3, 4, 8)),
    "interior": ({"gradient": "interior"}, "supersampling", (1, 2, 4)),
    "nmr": ({"gradient": "nmr"}, "supersampling", (1, 2, 4)),
    "soft, gamma 1e-4": ({"gradient": "soft", "gamma": 1e-4}, "sigma", SIGMAS),
    "soft, gamma 1e-2": ({"gradient": "soft", "gamma": 1e-2}, "sigma", SIGMAS),
}
STEP = 2e-3  # of the differences, in units of the parameters
BODY = blob()
PARTS = (False, True)
"""The body with colours, and with a texture."""


def renderer(**config: object) -> Renderer:
    return build("renderer", resolve("renderer", {"name": "rasterizer", **config}))


def loss(
    drawing: Renderer, by: dict[str, Tensor], azimuth: float, target: Tensor, textured: bool = False
) -> Tensor:
    return (drawing(scene(by, azimuth, BODY, textured))["color"].double() - target).square().sum()


def targets(finest: Renderer) -> list[list[Tensor]]:
    """Images of another pose, in each view, with colours and with a texture."""
    found = []
    for view, azimuth in enumerate(VIEWS):
        torch.manual_seed(view)
        off = {name: 0.05 * torch.randn_like(value.detach()) for name, value in parameters().items()}
        found.append([finest(scene(off, azimuth, BODY, textured))["color"].double() for textured in PARTS])
    return found


def differences(finest: Renderer, aims: list[list[Tensor]]) -> dict[str, np.ndarray]:
    """Central differences of the finest image's squared error, in every parameter of every view."""
    found: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for azimuth, aim in zip(VIEWS, aims, strict=True):
        for kind, (name, textured) in KINDS.items():
            for index in range(len(parameters()[name])):
                ends = []
                for sign in (1, -1):
                    there = {key: part.detach() for key, part in parameters().items()}
                    there[name][index] += sign * STEP
                    ends.append(loss(finest, there, azimuth, aim[textured], textured).item())
                found[kind].append((ends[0] - ends[1]) / (2 * STEP))
    return {kind: np.array(values) for kind, values in found.items()}


def slopes(drawing: Renderer, aims: list[list[Tensor]]) -> dict[str, np.ndarray]:
    """Of the kinds that the renderer draws: blended images have no textures."""
    parts = PARTS if "texture" in drawing.differentiable else (False,)
    found: dict[str, list[float]] = {}
    for azimuth, aim in zip(VIEWS, aims, strict=True):
        for textured in parts:
            by = parameters()
            loss(drawing, by, azimuth, aim[textured], textured).backward()
            for kind, (name, laid) in KINDS.items():
                slope = by[name].grad
                if laid == textured and slope is not None:
                    found.setdefault(kind, []).extend(slope.tolist())
    return {kind: np.array(values) for kind, values in found.items()}


def fit_step(drawing: Renderer) -> Callable[[], None]:
    """Forward and backward of the figure against itself 3 cm aside, in its vertices."""
    shown = figure_scene(*figure(), distance=DISTANCE)
    aside = replace(shown, vertices=shown.vertices + torch.tensor([0.03, 0.0, 0.02]))
    target = renderer()(aside)["color"]

    def step() -> None:
        vertices = shown.vertices.clone().requires_grad_()
        (drawing(replace(shown, vertices=vertices))["color"] - target).square().sum().backward()

    return step


def blob_step(drawing: Renderer, target: Tensor) -> Callable[[], None]:
    return lambda: loss(drawing, parameters(), VIEWS[0], target).backward()


def measured() -> list[dict[str, Any]]:
    finest = renderer(supersampling=16)
    with torch.no_grad():
        aims = targets(finest)
        wanted = differences(finest, aims)
    rows = []
    for method, (config, knob, values) in METHODS.items():
        for value in values:
            drawing = renderer(**config, **{knob: value})
            found = slopes(drawing, aims)
            row: dict[str, Any] = {"method": method, "knob": knob, "value": value}
            for name in found:
                one, other = found[name], wanted[name]
                row[f"cosine_{name}"] = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
                row[f"length_{name}"] = np.linalg.norm(one) / np.linalg.norm(other)
            off = found["vertices"] - wanted["vertices"]
            row["error"] = np.linalg.norm(off) / np.linalg.norm(wanted["vertices"])
            row["angle"] = np.degrees(np.arccos(float(row["cosine_vertices"])))
            row["milliseconds"] = milliseconds(blob_step(drawing, aims[0][0]), 10)
            row["figure_milliseconds"] = milliseconds(fit_step(drawing), 10)
            rows.append(row)
            sys.stdout.write(
                f"{method}, {knob} {value:g}: {row['angle']:.1f}°, {row['milliseconds']:.1f} ms\n"
            )
    return rows


def table(rows: list[dict[str, Any]]) -> list[str]:
    head = ["gradient", "knob", *KINDS, "ms, 72 × 88", f"ms, {HEIGHT} × {WIDTH}"]
    lines = [f"| {' | '.join(head)} |", "|---|---|" + "---:|" * (len(head) - 2)]
    for row in rows:
        cells = [str(row["method"]), f"{row['knob']} {row['value']:g}"]
        cells += [
            f"{row[f'cosine_{kind}']:.3f}, {row[f'length_{kind}']:.2f}"
            if f"cosine_{kind}" in row
            else "not drawn"
            for kind in KINDS
        ]
        cells += [f"{row['milliseconds']:.1f}", f"{row['figure_milliseconds']:.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    torch.set_num_threads(1)
    rows = measured()
    told = machine("torch", "numba", "numpy")
    text = [
        "# rasterizer: four gradients",
        "",
        "Cosine with, and length over, central differences of an image with 16 × 16 samples a pixel: the squared "
        "error against another pose, over 4 views, in 8 deformations of the vertices, 3 changes of colours, and the "
        "camera's rotation, translation and focal length; and, of the body with a smooth texture instead, in 3 changes "
        "of it and in the deformations. A synthetic body with 3,280 vertices that hides parts of "
        "itself, 72 × 88 pixels. `nmr` is Kato et al.'s approximation (CVPR 2018), `soft` Liu et al.'s blurred image "
        "(ICCV 2019), whose own slope is exact: the table says how far it is from that of the sharp image.",
        "",
        f"Milliseconds: forward and backward of that error; and of a figure with 6,890 vertices in {HEIGHT} × {WIDTH} "
        "pixels, in its vertices. One thread; processor time, median of 10.",
        "",
        *table(rows),
        "",
        "![Error of the gradient against milliseconds](rasterizer_gradients.png)",
        "",
        f"{told} Command: `python -m benchmarks.rendering.rasterizer_gradients`.",
        "",
    ]
    write_page(HERE, text)
    labels = {"angle": "angle to the differences (degrees)", "error": "error over length of the differences"}
    picture = error_against_run_time(
        rows,
        labels,
        dict.fromkeys(labels, "lower"),
        title="Gradients of the rasteriser in 8 deformations, 4 views, 72 × 88 pixels",
        synthetic=True,
        machine=f"{told[:-1]}; one thread, forward and backward",
        time="milliseconds",
        note="Knob: samples a pixel along each axis; sigma of soft.",
    )
    picture.savefig(HERE.with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
