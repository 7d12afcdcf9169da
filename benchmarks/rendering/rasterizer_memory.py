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
from benchmarks.rendering.rasterizer import DISTANCE, HEIGHT, WIDTH, figure, scene, subdivided
from framework.renderer import Scene
from plugins.renderer.rasterizer.drawing import Gradient
from plugins.renderer.rasterizer.renderer import Rasterizer

MEBIBYTE = 2**20


def status(name: str) -> int:
    """A number of bytes that Linux tells of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(name)).split()[1])


def both_ways(drawn: Scene, renderer: Rasterizer) -> list[Tensor]:
    """An image and its slopes in vertices and colours: outputs, and copies of inputs."""
    assert drawn.colors is not None
    learned = [drawn.vertices.clone().requires_grad_(), drawn.colors.clone().requires_grad_()]
    color = renderer(replace(drawn, vertices=learned[0], colors=learned[1]))["color"]
    color.sum().backward()
    return [color, *learned, *[part.grad for part in learned if part.grad is not None]]


def measured(gradient: Gradient) -> str:
    """Of a renderer's first image of the body, in a process that has compiled all before: what the process grew by at
    most, and what NumPy and Python had allocated at most, without inputs and outputs, MiB."""
    torch.set_num_threads(1)
    body, small = (scene(*shape, distance=DISTANCE) for shape in (subdivided(*figure()), figure(8, 8)))
    both_ways(replace(small, camera=replace(small.camera, height=8, width=8)), Rasterizer(gradient=gradient))
    renderer = Rasterizer(gradient=gradient)
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here on
    before = status("VmRSS")
    kept = both_ways(body, renderer)
    grown = status("VmHWM") - before
    own = sum(part.nbytes for part in kept)
    del kept, renderer
    tracemalloc.start()
    both_ways(body, Rasterizer(gradient=gradient))
    traced = tracemalloc.get_traced_memory()[1]
    return f"| {gradient} | {(grown - own) / MEBIBYTE:.1f} | {traced / MEBIBYTE:.1f} | {own / MEBIBYTE:.1f} |"


def report() -> str:
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
            "# rasterizer: peak memory, MiB",
            "",
            f"An image (`color`, {HEIGHT} × {WIDTH}) of a body of 27,554 vertices and its slopes in vertices and "
            "colours, the first of a renderer; each in a process of its own that has drawn a small image before.",
            "",
            "| gradient | process grew by, beyond inputs and outputs | allocated by NumPy and Python, outputs too | "
            "inputs and outputs |",
            "|---|---|---|---|",
            *rows,
            "",
            f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.rendering.rasterizer_memory`.",
            "",
        ]
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.stdout.write(measured(sys.argv[1]))  # type: ignore[arg-type]
    else:
        write_page(__file__, report())
