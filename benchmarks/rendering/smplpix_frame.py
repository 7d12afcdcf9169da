"""Measure the run time of an image of the renderer smplpix, by the number type of its network.

    python -m benchmarks.rendering.smplpix_frame

The script writes smplpix_frame.md beside this file.
"""

import math
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.pages import machine, publish
from benchmarks.rendering.builders import build_renderer
from benchmarks.rendering.rasterizer import figure
from benchmarks.timing import ROUNDS, time_interleaved
from framework.geometry.camera import look_from
from framework.renderer import Scene
from plugins.renderer.smplpix.renderer import LARGEST_CHANGE, MEAN_CHANGE
from plugins.renderer.smplpix.rows import projection_settings, write_checkpoint

SIZE = (410, 308)
SPLAT = 5
"""Radius of the splats, pixels, as in experiment=smplpix/quick."""
MOST = 18.0
"""Largest permitted time of an image in bfloat16, ms."""


def body() -> Scene:
    """Return a synthetic body, 1.7 m tall, 2.5 m from the camera; it covers a quarter of the image."""
    vertices, faces = (torch.tensor(part) for part in figure()[:2])
    low, high = vertices.min(0).values, vertices.max(0).values
    camera = look_from(0.4, 0.15, 0.05, 2.5, 2 * math.atan(SIZE[0] / 2 / 600), SIZE)
    return Scene(vertices.float(), faces.long(), ((vertices - low) / (high - low)).float(), camera)


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    scene = body()
    with TemporaryDirectory() as folder:
        encoders = [projection_settings(SIZE, splat=SPLAT), {"name": "slim", "residual": True}]
        run = write_checkpoint(Path(folder) / "run.ckpt", encoders, SIZE, len(scene.vertices))
        renderers = {
            f"precision={precision}, crop={crop}": build_renderer(
                "smplpix", checkpoint=run, precision=precision, crop=crop
            )
            for precision in ("auto", "bfloat16", "float32")
            for crop in ("trained", "whole")
        }
    images = {name: renderer(scene)["color"] for name, renderer in renderers.items()}
    times = time_interleaved(
        {name: partial(renderer, scene) for name, renderer in renderers.items()}, seconds=1.0
    )
    exact = times["precision=float32, crop=trained"]
    lines = [
        f"| `{name}` | {rounds.text()} | {rounds.times_faster(exact)} |" for name, rounds in times.items()
    ]
    default = "precision=auto, crop=trained"
    fast = (
        "bfloat16" if torch.equal(images[default], images[default.replace("auto", "bfloat16")]) else "float32"
    )
    median = times[default].median
    text = (
        "# smplpix: run time of an image\n\n"
        "This page measures how long the renderer `smplpix` takes for an image, from a scene to linear RGB, and what "
        "the number type of its network saves. "
        f"The scene is a synthetic body of {len(scene.vertices):,} vertices, and the image has {SIZE[0]} × {SIZE[1]} "
        f"pixels. The vertices are projected with splats of radius {SPLAT} pixels, and `slim` computes the image from "
        "them, as in `experiment=smplpix/quick`. The weights are random, which does not change the run time.\n\n"
        f"A time of an image is the processor time of one thread: the median of {ROUNDS} rounds, with the smallest "
        "and the largest one in brackets. In a round the settings are measured one after the other. `crop=trained` "
        "computes only the box of the body. `speed ratio` is the time of `precision=float32, crop=trained` divided "
        "by the time in the row."
        "\n\n"
        "| settings of the renderer | time, ms | speed ratio |\n|---|---:|---:|\n"
        + "\n".join(lines)
        + "\n\nThe first row of the table is the default setting of the renderer `smplpix`. In this run it computed "
        f"in {fast}. The project requires at most {MOST:g} ms for an image in bfloat16; this is "
        f"{'met' if median <= MOST else '**not met**'}. By default the renderer uses bfloat16 if the processor "
        "computes it faster than float32, and if sRGB colours of a test image then change by at most "
        f"{255 * LARGEST_CHANGE:g}/255, and by at most {255 * MEAN_CHANGE:g}/255 on average. The changes of "
        "trained networks are on the page [smplpix_networks](smplpix_networks.md).\n\n"
        f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_frame`.\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
