"""Measure the peak memory of an image and its gradient.

python -m benchmarks.rendering.rasterizer_memory
"""

import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from benchmarks.commands import ROOT
from benchmarks.pages import machine, write_page
from benchmarks.rendering.rasterizer import DISTANCE, HEIGHT, WIDTH, figure, scene, subdivide
from framework.renderer import Scene
from plugins.renderer.rasterizer.drawing import Gradient
from plugins.renderer.rasterizer.renderer import Rasterizer

MEBIBYTE = 2**20


def read_status(name: str) -> int:
    """Return a number of bytes that Linux reports about this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(name)).split()[1])


def render_with_gradient(scene: Scene, renderer: Rasterizer) -> list[Tensor]:
    """Return an image, copies of vertices and colours, and the gradients of the image's sum with respect to them."""
    assert scene.colors is not None
    learned = [scene.vertices.clone().requires_grad_(), scene.colors.clone().requires_grad_()]
    color = renderer(replace(scene, vertices=learned[0], colors=learned[1]))["color"]
    color.sum().backward()
    return [color, *learned, *[part.grad for part in learned if part.grad is not None]]


def measure(gradient: Gradient) -> str:
    """Return the table row of a gradient: peak memory for a renderer's first image of the body, MiB."""
    torch.set_num_threads(1)
    body, small = (scene(*shape, distance=DISTANCE) for shape in (subdivide(*figure()), figure(8, 8)))
    render_with_gradient(
        replace(small, camera=replace(small.camera, height=8, width=8)), Rasterizer(gradient=gradient)
    )
    renderer = Rasterizer(gradient=gradient)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak memory of the process
    before = read_status("VmRSS")
    tensors = render_with_gradient(body, renderer)
    growth = read_status("VmHWM") - before
    own_bytes = sum(part.nbytes for part in tensors)
    del tensors, renderer
    tracemalloc.start()
    render_with_gradient(body, Rasterizer(gradient=gradient))
    traced = tracemalloc.get_traced_memory()[1]
    cells = (f"{number / MEBIBYTE:.1f}" for number in (growth - own_bytes, traced, own_bytes))
    return f"| {gradient} | {' | '.join(cells)} |"


def report() -> str:
    """Measure each gradient in a process of its own, and return the page."""
    rows = [
        subprocess.run(
            [sys.executable, "-m", "benchmarks.rendering.rasterizer_memory", gradient],
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
        for gradient in get_args(Gradient)
    ]
    return "\n".join(
        [
            "# rasterizer: peak memory",
            "",
            "This page measures the peak memory that the renderer `rasterizer` needs for one image and its gradient.",
            "",
            f"The image whose memory is measured (`color`, {HEIGHT} × {WIDTH} pixels) shows a synthetic body of "
            "27,554 vertices. The gradient is with respect to vertices and vertex colours. The image is the "
            "first one that the renderer draws. Each row is measured in a new process that has drawn a small "
            "image before, so that all code is compiled.",
            "",
            "In the table, `growth of the process` is the increase of the peak memory of the process, without inputs "
            "and outputs. `NumPy and Python` is the peak of the memory that NumPy and Python allocate, including "
            "outputs. `inputs and outputs` is the size of the arrays of inputs and outputs, which the caller holds.",
            "",
            "| gradient | growth of the process, MiB | NumPy and Python, MiB | inputs and outputs, MiB |",
            "|---|---|---|---|",
            *rows,
            "",
            f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.rendering.rasterizer_memory`.",
            "",
        ]
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.stdout.write(measure(sys.argv[1]))  # type: ignore[arg-type]
    else:
        write_page(__file__, report())
