"""Compare the rasteriser's four gradients with differences of a supersampled image, and measure their run time.

    python -m benchmarks.rendering.rasterizer_gradients

The script writes rasterizer_gradients.md and rasterizer_gradients.png beside this file and takes about two minutes on
one core.
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
from benchmarks.rendering.builders import build_renderer
from benchmarks.rendering.rasterizer import DISTANCE, HEIGHT, WIDTH, figure
from benchmarks.rendering.rasterizer import scene as figure_scene
from benchmarks.timing import milliseconds
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
STEP = 2e-3
"""Step of the central differences, in units of the parameters."""
BODY = blob()
TEXTURED = (False, True)
"""Values of the option that gives the body a texture instead of colours."""


def loss(
    drawing: Renderer, by: dict[str, Tensor], azimuth: float, target: Tensor, textured: bool = False
) -> Tensor:
    """Return the squared difference of a rendered image from the target."""
    return (drawing(scene(by, azimuth, BODY, textured))["color"].double() - target).square().sum()


def targets(finest: Renderer) -> list[list[Tensor]]:
    """Return images of another pose for each view, with colours and with a texture."""
    images = []
    for view, azimuth in enumerate(VIEWS):
        torch.manual_seed(view)
        off = {name: 0.05 * torch.randn_like(value.detach()) for name, value in parameters().items()}
        images.append(
            [finest(scene(off, azimuth, BODY, textured))["color"].double() for textured in TEXTURED]
        )
    return images


def differences(finest: Renderer, aims: list[list[Tensor]]) -> dict[str, np.ndarray]:
    """Return central differences of the finest image's loss by kind of parameter, for every parameter and view."""
    values_by_kind: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for azimuth, aim in zip(VIEWS, aims, strict=True):
        for kind, (name, textured) in KINDS.items():
            for index in range(len(parameters()[name])):
                ends = []
                for sign in (1, -1):
                    changed = {key: part.detach() for key, part in parameters().items()}
                    changed[name][index] += sign * STEP
                    ends.append(loss(finest, changed, azimuth, aim[textured], textured).item())
                values_by_kind[kind].append((ends[0] - ends[1]) / (2 * STEP))
    return {kind: np.array(values) for kind, values in values_by_kind.items()}


def compute_gradients(drawing: Renderer, aims: list[list[Tensor]]) -> dict[str, np.ndarray]:
    """Return the renderer's gradients of the loss by kind of parameter; kinds that it does not draw are left out."""
    parts = TEXTURED if "texture" in drawing.differentiable else (False,)
    gradients: dict[str, list[float]] = {}
    for azimuth, aim in zip(VIEWS, aims, strict=True):
        for textured in parts:
            by = parameters()
            loss(drawing, by, azimuth, aim[textured], textured).backward()
            for kind, (name, kind_textured) in KINDS.items():
                slope = by[name].grad
                if kind_textured == textured and slope is not None:
                    gradients.setdefault(kind, []).extend(slope.tolist())
    return {kind: np.array(values) for kind, values in gradients.items()}


def fit_step(drawing: Renderer) -> Callable[[], None]:
    """Return a call that renders a body and the gradient of its vertices, for a target 3 cm beside it."""
    shown = figure_scene(*figure(), distance=DISTANCE)
    aside = replace(shown, vertices=shown.vertices + torch.tensor([0.03, 0.0, 0.02]))
    target = build_renderer("rasterizer")(aside)["color"]

    def step() -> None:
        vertices = shown.vertices.clone().requires_grad_()
        (drawing(replace(shown, vertices=vertices))["color"] - target).square().sum().backward()

    return step


def blob_step(drawing: Renderer, target: Tensor) -> Callable[[], None]:
    """Return a call that computes the loss of the first view and its gradient."""
    return lambda: loss(drawing, parameters(), VIEWS[0], target).backward()


def measure() -> list[dict[str, Any]]:
    """Return the errors and run times of all gradients, one row for each value of a knob."""
    finest = build_renderer("rasterizer", supersampling=16)
    with torch.no_grad():
        aims = targets(finest)
        references = differences(finest, aims)
    rows = []
    for method, (config, knob, values) in METHODS.items():
        for value in values:
            drawing = build_renderer("rasterizer", **config, **{knob: value})
            gradients = compute_gradients(drawing, aims)
            row: dict[str, Any] = {"method": method, "knob": knob, "value": value}
            for name in gradients:
                gradient, reference = gradients[name], references[name]
                row[f"cosine_{name}"] = (
                    gradient @ reference / (np.linalg.norm(gradient) * np.linalg.norm(reference))
                )
                row[f"length_{name}"] = np.linalg.norm(gradient) / np.linalg.norm(reference)
            error = gradients["vertices"] - references["vertices"]
            row["error"] = np.linalg.norm(error) / np.linalg.norm(references["vertices"])
            row["angle"] = np.degrees(np.arccos(float(row["cosine_vertices"])))
            row["milliseconds"] = milliseconds(blob_step(drawing, aims[0][0]), 10)
            row["figure_milliseconds"] = milliseconds(fit_step(drawing), 10)
            rows.append(row)
            sys.stdout.write(
                f"{method}, {knob} {value:g}: {row['angle']:.1f}°, {row['milliseconds']:.1f} ms\n"
            )
    return rows


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines of the table."""
    head = ["gradient", "knob", *KINDS, "time, ms, 72 × 88", f"time, ms, {HEIGHT} × {WIDTH}"]
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
    rows = measure()
    where = machine("torch", "numba", "numpy")
    text = [
        "# rasterizer: accuracy and run time of four gradients",
        "",
        "The renderer `rasterizer` has four methods to compute the gradient of an image with respect to the scene: "
        "`boundary`, `interior`, `nmr` and `soft`. This page compares the gradient of each method with a reference, "
        "and measures its run time. It shows how exact the gradients are when a scene is fitted to an image.",
        "",
        "The rendered scene is a synthetic body with 3,280 vertices that hides parts of itself, in images of 72 × 88 "
        "pixels. The loss is the squared difference of the colours from an image of another pose. The reference is "
        "the gradient of this loss from central differences of an image with 16 × 16 samples a pixel. All four "
        "methods are measured in 4 views.",
        "",
        "The methods are named in the first column of the table. `boundary` is the gradient with the movement of "
        "edges (Li et al., SIGGRAPH Asia 2018), and `interior` is the same gradient without it. `nmr` is the "
        "approximation of Kato et al. (CVPR 2018). `soft` is the gradient of the blurred image of Liu et al. (ICCV "
        "2019). It is exact for the blurred image; the table shows how far it is from the gradient of the sharp "
        "image. `knob` is the setting that trades error for run time: the samples a pixel along each axis, or the "
        "width of the blur.",
        "",
        "The columns `vertices` to `vertices, textured` hold two numbers for each group of parameters: the cosine of "
        "the angle between the gradient and the reference (central differences), and the length of the gradient "
        "divided by the length of the reference. Both numbers are 1 for an exact gradient. `vertices` are 8 "
        "deformations "
        "of the body, `colors` are 3 changes of its colours, and `rotation`, `translation` and `focal` are "
        "parameters of the camera. For `texture` and `vertices, textured` the body has a smooth texture instead of "
        "colours: 3 changes of the texture, and the 8 deformations. `soft` draws no textures.",
        "",
        "The last two columns of the table hold the time of forward and backward rendering in ms. The first of "
        "them is for the loss and the body of this benchmark. The second is for a body with 6,890 vertices in "
        f"{HEIGHT} × {WIDTH} pixels, with the gradient with respect to its vertices. "
        "The time is the median processor time of 10 calls on one thread.",
        "",
        *table(rows),
        "",
        "![Error of the gradient against run time](rasterizer_gradients.png)",
        "",
        f"{where} Command: `python -m benchmarks.rendering.rasterizer_gradients`.",
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
        machine=f"{where[:-1]}; one thread, forward and backward",
        time="milliseconds",
        note="Knob: samples a pixel along each axis; sigma of soft.",
    )
    picture.savefig(HERE.with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
