"""Measure the run time of the encoder projection, compiled and in plain PyTorch, against the number of points.

    python -m benchmarks.rendering.smplpix_projection

The script writes smplpix_projection.md beside this file.
"""

import math
import os
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from benchmarks.pages import machine, write_page
from benchmarks.rendering.rasterizer import DISTANCE, FOCAL, HEIGHT, WIDTH, figure
from benchmarks.rendering.rasterizer_growth import milliseconds, slope
from benchmarks.timing import times_of_calls
from framework.configuration.schema import build, resolve
from framework.geometry.camera import look_from
from plugins.encoder.projection.encoder import Projection, gather_images, project, visible_points_in_torch

RINGS = ((82, 84), (165, 168), (328, 336), (1000, 1000))
"""Sizes of the bodies: 6,890, 27,722, 110,210 and 1,000,002 points; the thesis has 6,890 and 27,578."""
TARGETS = (0.4, 1.0)
"""Largest permitted times of the first two bodies on one core, ms."""
SPLAT = 5
"""Radius of the splats, pixels, as in experiment=smplpix/quick."""
BATCH = 8
ROUNDS = 3


def points(rings: int, segments: int) -> Tensor:
    """Return the points of a body, (points, 6), 1.7 m tall, coloured by position, in camera coordinates."""
    vertices = torch.tensor(figure(rings, segments)[0])
    camera = look_from(0.4, 0.15, 0.05, DISTANCE, 2 * math.atan(HEIGHT / 2 / FOCAL), (HEIGHT, WIDTH))
    low, high = vertices.min(0).values, vertices.max(0).values
    return torch.cat([camera.to_canonical(vertices), (vertices - low) / (high - low)], 1).float()


def build_projection(levels: int = 1, splat: int = 0) -> Projection:
    config = {"name": "projection", "height": HEIGHT, "width": WIDTH, "levels": levels, "splat": splat}
    return build("encoder", resolve("encoder", config), input_shape=(1, 6), input_columns=())


def project_in_torch(encoder: Projection, clouds: Tensor) -> Tensor:
    """Return the image as the implementation in plain PyTorch computes it."""
    return gather_images(clouds, visible_points_in_torch(clouds, encoder.view), encoder.view)


def project_with_gradient(encoder: Projection, clouds: Tensor) -> None:
    """Project, and compute the gradient of the image's sum."""
    project(clouds.clone().requires_grad_(), encoder.view).sum().backward()


def lowest(calls: list[Callable[[], object]]) -> list[float]:
    """Return for each call the lowest of `ROUNDS` medians, ms. The calls are interleaved.

    Other processes can only make a call slower; the lowest median is therefore the least disturbed one.
    """
    times = [math.inf] * len(calls)
    for _ in range(ROUNDS):
        times = [min(known, milliseconds(call)) for known, call in zip(times, calls, strict=True)]
    return times


def shortest_time(call: Callable[[], object], threads: int) -> float:
    """Return the wall time of the shortest call within half a second, ms."""
    torch.set_num_threads(threads)
    call()
    shortest = min(times_of_calls(call, 0.5, time.perf_counter))
    torch.set_num_threads(1)
    return shortest


def report() -> str:
    """Measure, and return the page."""
    torch.set_num_threads(1)
    plain, three, splats = build_projection(), build_projection(levels=3), build_projection(splat=SPLAT)
    clouds = [points(*rings)[None] for rings in RINGS]
    rows, threaded, ours = [], [], []
    with torch.no_grad():
        covered = [float((plain(cloud)[0, 3] < 1).float().mean()) for cloud in clouds]
    for cloud, share in zip(clouds, covered, strict=True):
        batch = cloud.expand(BATCH, -1, -1).contiguous()
        for encoder in (plain, three):
            assert torch.equal(encoder(cloud), project_in_torch(encoder, cloud))
            assert torch.equal(encoder(cloud), project(cloud.clone().requires_grad_(), encoder.view).detach())
        ways = [plain, partial(project_in_torch, plain)]
        calls = [partial(way, inputs) for inputs in (cloud, batch) for way in ways]
        calls += [partial(three, cloud), partial(project_with_gradient, plain, cloud), partial(splats, cloud)]
        compiled, torch_time, many, many_torch, pyramid, learning, filled = lowest(calls)
        ours.append(compiled)
        rows.append(
            f"| {cloud.shape[1]:,} | {share:.0%} | {compiled:.2f} | {torch_time:.1f} | {torch_time / compiled:.0f} | "
            f"{many:.2f} | {many_torch:.1f} | {many_torch / many:.0f} | {pyramid:.2f} | {learning:.1f} | {filled:.1f} |"
        )
        single, double = (shortest_time(partial(project, batch, plain.view), threads) for threads in (1, 2))
        threaded.append(f"| {cloud.shape[1]:,} | {single:.2f} | {double:.2f} | {single / double:.2f} |")
    counts = [float(cloud.shape[1]) for cloud in clouds]
    targets = ", ".join(
        f"{time:.2f} ms at {count:,.0f} points (target: at most {limit} ms)"
        for time, limit, count in zip(ours, TARGETS, counts, strict=False)
    )
    return "\n".join(
        [
            "# projection: run time of an image",
            "",
            "This page measures the run time of the encoder `projection`, which projects a coloured point cloud into "
            "an image. It compares the compiled code with an implementation in plain PyTorch, for four numbers of "
            "points.",
            "",
            f"The projected points belong to a synthetic body, in float32, and the image has {HEIGHT} rows × "
            f"{WIDTH} columns. A time is the processor time of one call on one thread, in ms: the lowest of {ROUNDS} "
            "medians. It includes the check of the encoder's input. All implementations gave bitwise equal images in "
            "this run.",
            "",
            f"The times to project a cloud are compared with the targets of the project: {targets}.",
            "",
            "In the table, `pixels hit` is the share of pixels that show a point. `compiled` and `PyTorch` are the "
            "times of the two implementations, and `ratio` is the time of PyTorch divided by the compiled one. "
            f"`batch of {BATCH}` is the time for {BATCH} point clouds at once. The last three columns are times of "
            "the compiled code: with three levels of resolution, with the gradient, and with splats, which are discs "
            f"around the points with a radius of {SPLAT} pixels.",
            "",
            f"| points | pixels hit | compiled, ms | PyTorch, ms | ratio | compiled, batch of {BATCH}, ms | PyTorch, "
            f"batch of {BATCH}, ms | ratio, batch of {BATCH} | compiled, 3 levels, ms | compiled, with gradient, ms | "
            f"compiled, splats of {SPLAT} pixels, ms |",
            "|---|---|---|---|---|---|---|---|---|---|---|",
            *rows,
            "",
            f"From {counts[2]:,.0f} points on, the time of a projection grows with the number of points to the power "
            f"of {slope(counts, ours):.2f}. With fewer points, most of the time is spent on the image itself.",
            "",
            f"The last table compares one and two threads for the projection of a batch of {BATCH} point clouds. A "
            "time is wall time without the check of the input: the shortest call within half a second. While this "
            f"was measured, {os.getloadavg()[0]:.1f} processes were running on the machine on average. `ratio` is the "
            "time with one thread divided by the time with two.",
            "",
            "| points | 1 thread, ms | 2 threads, ms | ratio |",
            "|---|---|---|---|",
            *threaded,
            "",
            f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_projection`.",
            "",
        ]
    )


if __name__ == "__main__":
    write_page(__file__, report())
