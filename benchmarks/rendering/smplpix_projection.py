"""Milliseconds of the encoder projection, compiled and in plain torch, against points; written beside this file:
`python -m benchmarks.rendering.smplpix_projection`."""

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
from framework.configuration.schema import build, resolve
from framework.geometry.camera import look_from
from plugins.encoder.projection.encoder import Projection, gather_images, project, visible_points_in_torch

RINGS = ((82, 84), (165, 168), (328, 336), (1000, 1000))
"""Bodies of 6,890, 27,722, 110,210 and 1,000,002 points; the thesis has 6,890 and 27,578."""
TARGETS = (0.4, 1.0)
"""Milliseconds of the first two, one core."""
SPLAT = 5
"""Pixels, as smplpix/quick has it."""
BATCH = 8
ROUNDS = 3


def points(rings: int, segments: int) -> Tensor:
    """(points, 6): a body 1.7 m tall, coloured by place, before the canonical camera."""
    vertices = torch.tensor(figure(rings, segments)[0])
    camera = look_from(0.4, 0.15, 0.05, DISTANCE, 2 * math.atan(HEIGHT / 2 / FOCAL), (HEIGHT, WIDTH))
    low, high = vertices.min(0).values, vertices.max(0).values
    return torch.cat([camera.to_canonical(vertices), (vertices - low) / (high - low)], 1).float()


def made(levels: int = 1, splat: int = 0) -> Projection:
    config = {"name": "projection", "height": HEIGHT, "width": WIDTH, "levels": levels, "splat": splat}
    return build("encoder", resolve("encoder", config), input_shape=(1, 6), input_columns=())


def in_torch(encoder: Projection, clouds: Tensor) -> Tensor:
    return gather_images(clouds, visible_points_in_torch(clouds, encoder.view), encoder.view)


def both_ways(encoder: Projection, clouds: Tensor) -> None:
    project(clouds.clone().requires_grad_(), encoder.view).sum().backward()


def lowest(calls: list[Callable[[], object]]) -> list[float]:
    """Of each call the lowest of `ROUNDS` medians, all in turn: what else the machine does only adds to them."""
    times = [math.inf] * len(calls)
    for _ in range(ROUNDS):
        times = [min(known, milliseconds(call)) for known, call in zip(times, calls, strict=True)]
    return times


def best(call: Callable[[], object], threads: int) -> float:
    """Milliseconds of wall clock, the lowest of half a second of calls."""
    torch.set_num_threads(threads)
    call()
    times: list[float] = []
    while len(times) < 3 or sum(times) < 0.5:
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    torch.set_num_threads(1)
    return 1e3 * min(times)


def report() -> str:
    torch.set_num_threads(1)
    plain, three, splats = made(), made(levels=3), made(splat=SPLAT)
    clouds = [points(*rings)[None] for rings in RINGS]
    rows, threaded, ours = [], [], []
    with torch.no_grad():
        covered = [float((plain(cloud)[0, 3] < 1).float().mean()) for cloud in clouds]
    for cloud, share in zip(clouds, covered, strict=True):
        batch = cloud.expand(BATCH, -1, -1).contiguous()
        for encoder in (plain, three):
            assert torch.equal(encoder(cloud), in_torch(encoder, cloud))
            assert torch.equal(encoder(cloud), project(cloud.clone().requires_grad_(), encoder.view).detach())
        ways = [plain, partial(in_torch, plain)]
        calls = [partial(way, inputs) for inputs in (cloud, batch) for way in ways]
        calls += [partial(three, cloud), partial(both_ways, plain, cloud), partial(splats, cloud)]
        compiled, torch_time, many, many_torch, pyramid, learning, filled = lowest(calls)
        ours.append(compiled)
        rows.append(
            f"| {cloud.shape[1]:,} | {share:.0%} | {compiled:.2f} | {torch_time:.1f} | {torch_time / compiled:.0f} | {many:.2f} | "
            f"{many_torch:.1f} | {many_torch / many:.0f} | {pyramid:.2f} | {learning:.1f} | {filled:.1f} |"
        )
        single, double = (best(partial(project, batch, plain.view), threads) for threads in (1, 2))
        threaded.append(f"| {cloud.shape[1]:,} | {single:.2f} | {double:.2f} | {single / double:.2f} |")
    counts = [float(cloud.shape[1]) for cloud in clouds]
    targets = ", ".join(
        f"{time:.2f} of {limit} ms at {count:,.0f} points"
        for time, limit, count in zip(ours, TARGETS, counts, strict=False)
    )
    return "\n".join(
        [
            "# projection: milliseconds an image",
            "",
            f"Points of a synthetic body in {HEIGHT} rows × {WIDTH} columns, float32; one thread; processor time, the "
            f"lowest of {ROUNDS} medians. The whole encoder is timed, with its check of what comes. In this run all "
            "ways gave the same bits.",
            "",
            f"Against the targets: {targets}.",
            "",
            "| points | pixels hit | compiled | torch | ratio | compiled, batch of 8 | torch, batch of 8 | ratio | "
            f"compiled, 3 levels | with gradient, and back | splats of {SPLAT} pixels |",
            "|---|---|---|---|---|---|---|---|---|---|---|",
            *rows,
            "",
            f"From {counts[2]:,.0f} points on time grows as their number to the power of "
            f"{slope(counts, ours):.2f}; below, the image's own numbers are most of the work.",
            "",
            f"A batch of 8 by the wall clock, the best of half a second, without the check; {os.getloadavg()[0]:.1f} "
            "processes ran on the machine at the time:",
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
