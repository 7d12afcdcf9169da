"""Measure the run time of the renderer rasterizer, and compare it with other renderers.

The page also says how much time each saving of the rasteriser saves, how fast batches are, and how the time grows with
the numbers of faces and pixels.

    python -m benchmarks.rendering.rasterizer

The script writes rasterizer.md, rasterizer_growth.csv and rasterizer_growth.png beside this file.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import machine, write_page
from benchmarks.rendering import rasterizer_growth, rasterizer_peers
from benchmarks.rendering.builders import build_renderer
from benchmarks.timing import first_calls, milliseconds
from framework.geometry.camera import look_from
from framework.renderer import Renderer, Scene, join_scenes

HEIGHT, WIDTH = 410, 308
FOCAL = 600  # pixels
DISTANCE = 2.6  # metres
CHANNELS = (("mask",), ("depth",), ("color",), ("color", "depth"))
LEARNED = ("vertices", "colors")
ALONE = ("view", "box")
"""Default savings that do not depend on the previous image."""
SCENES = 32
ROUNDS = 8
FIRST_CALL = """
import time, torch
from benchmarks.rendering.rasterizer import DISTANCE, figure, scene
from plugins.renderer.rasterizer.renderer import Rasterizer
view = scene(*figure(), distance=DISTANCE)
start = time.perf_counter()
Rasterizer()(view, ("color", "depth", "face", "mask"))
print(time.perf_counter() - start)
"""


def figure(rings: int = 82, segments: int = 84) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed body like a standing person, 1.7 m tall: rings × segments + 2 vertices, and faces.

    The default has 6,890 vertices and 13,776 faces.
    """
    polar = np.pi * np.arange(1, rings + 1) / (rings + 1)
    around = 2 * np.pi * np.arange(segments) / segments
    up = 0.85 * np.cos(polar)
    heights = [-0.85, -0.8, -0.45, 0.0, 0.2, 0.45, 0.55, 0.62, 0.75, 0.85]
    # half the breadth at each height, metres
    halves = [0.10, 0.16, 0.17, 0.21, 0.18, 0.24, 0.17, 0.08, 0.11, 0.0]
    breadth = np.interp(up, heights, halves)
    rings_of = np.stack(
        [
            breadth[:, None] * np.cos(around),
            0.6 * breadth[:, None] * np.sin(around),
            up[:, None] + 0 * around,
        ],
        -1,
    )
    vertices = np.concatenate([rings_of.reshape(-1, 3), [[0, 0, 0.85], [0, 0, -0.85]]])
    start = np.arange(rings - 1)[:, None] * segments
    columns = np.arange(segments)
    following = (columns + 1) % segments
    a, b = (start + columns).ravel(), (start + following).ravel()
    c, d = a + segments, b + segments
    last = (rings - 1) * segments
    top, bottom = np.full(segments, len(vertices) - 2), np.full(segments, len(vertices) - 1)
    faces = [(a, c, d), (a, d, b), (top, columns, following), (bottom, last + following, last + columns)]
    return vertices, np.concatenate([np.stack(corners, 1) for corners in faces])


def subdivide(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide each face into four at the middles of its edges."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2), 1)
    unique, which = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (which.reshape(-1, 3) + len(vertices)).T
    parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.concatenate([vertices, vertices[unique].mean(1)]), np.concatenate(
        [np.stack(corners, 1) for corners in parts]
    )


def scene(vertices: np.ndarray, faces: np.ndarray, distance: float) -> Scene:
    """Return a scene of the body, coloured by position, at a distance (m); a negative one is behind the camera."""
    camera = look_from(0.4, 0.15, 0.05, distance, 2 * math.atan(HEIGHT / 2 / FOCAL), (HEIGHT, WIDTH))
    low, high = vertices.min(0), vertices.max(0)
    colors = torch.tensor((vertices - low) / (high - low), dtype=torch.float32)
    return Scene(torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces), colors, camera)


def lowest(calls: Sequence[Callable[[], object]]) -> list[float]:
    """Return for each call the lowest of `ROUNDS` medians of 40 repetitions, ms. The calls are interleaved.

    Other processes can only make a call slower, and they do so for seconds at a time. The lowest median is therefore
    the least disturbed one.
    """
    times = [math.inf] * len(calls)
    for _ in range(ROUNDS):
        for number, call in enumerate(calls):
            times[number] = min(times[number], milliseconds(call, 40))
    return times


def calls_of_row(drawing: Renderer, scene: Scene) -> list[Callable[[], object]]:
    """Return the calls of one table row: the channels, and the colours with their gradients."""
    calls = [partial(drawing, scene, channels) for channels in CHANNELS]
    return [*calls, *(partial(render_with_gradient, drawing, scene, name) for name in LEARNED)]


def render_with_gradient(renderer: Renderer, scene: Scene, learned: str) -> None:
    """Render an image and the gradient of its sum with respect to the vertices or the colours."""
    part = getattr(scene, learned).clone().requires_grad_()
    renderer(replace(scene, **{learned: part}), ("color",))["color"].sum().backward()


def build_rasterizer(**config: Any) -> Renderer:
    """Return a rasterizer that keeps nothing from one image to the next."""
    return build_renderer("rasterizer", **{"savings": ALONE, **config})


def crowd(scene: Scene) -> Scene:
    """Return a scene of five bodies behind one another, the farthest first."""
    back = torch.tensor([0.0, 0.0, 1.0]) @ scene.camera.rotation
    return join_scenes(
        [replace(scene, vertices=scene.vertices + 0.5 * step * back) for step in (4, 3, 2, 1, 0)]
    )


def savings(body: Scene) -> list[str]:
    """Return the table rows that compare the run time with and without each saving."""
    away = replace(body, vertices=body.vertices + 100)
    many = crowd(body)
    cases = [
        ("back", "one body, colour", body, ("color",), {"cull": True}, {"cull": False}),
        ("view", "out of view, mask", away, ("mask",), {}, {"savings": ("box",)}),
        ("box", "one body, colour", body, ("color",), {"cull": True}, {"cull": True, "savings": ("view",)}),
        (
            "hidden",
            "five bodies behind one another, depth",
            many,
            ("depth",),
            {"cull": True, "savings": (*ALONE, "hidden")},
            {"cull": True},
        ),
        (
            "unchanged",
            "one body, of which only the colours change, colour",
            body,
            ("color",),
            {"cull": True, "savings": (*ALONE, "unchanged")},
            {"cull": True},
        ),
    ]
    pairs = [
        (build_rasterizer(**with_it), build_rasterizer(**without_it)) for *_, with_it, without_it in cases
    ]
    plain = build_rasterizer(cull=True)
    calls = [
        partial(drawing, scene, channels)
        for pair, (_, _, scene, channels, _, _) in zip(pairs, cases, strict=True)
        for drawing in pair
    ]
    calls += [partial(plain, body, ("mask",)), partial(plain, body, sorted(plain.channels - {"uv"}))]
    times = lowest(calls)
    lines = []
    for number, (name, scene_label, *_) in enumerate(cases):
        report = pairs[number][0].report
        assert report is not None
        left_out = ", ".join(f"{count:,} {reason}" for reason, count in report.left_out.items()) or "none"
        reused = f"; reused: {', '.join(sorted(report.reused))}" if report.reused else ""
        first, second = times[2 * number : 2 * number + 2]
        lines.append(f"| {name} | {scene_label} | {second:.2f} | {first:.2f} | {left_out}{reused} |")
    lines.append(
        f"| channels | one body, all channels but uv, or mask alone | {times[-1]:.2f} | {times[-2]:.2f} | |"
    )
    return lines


def batch_table(body: Scene) -> list[str]:
    """Return the table of images per second: one by one, and in batches on one and two threads.

    Each number is the best of 25 repetitions of wall time. The ways are interleaved, and all images of a repetition are
    kept.
    """
    scenes = [replace(body, vertices=body.vertices + 0.001 * number) for number in range(SCENES)]
    plain = build_rasterizer(cull=True)

    def one_by_one() -> list[dict[str, torch.Tensor]]:
        return [plain(scene, ("color",)) for scene in scenes]

    ways = [(one_by_one, 1), *((lambda: plain.batch(scenes, ("color",)), threads) for threads in (1, 2))]
    best = [math.inf] * len(ways)
    for _ in range(25):
        for number, (draw, threads) in enumerate(ways):
            torch.set_num_threads(threads)
            start = time.perf_counter()
            draw()
            best[number] = min(best[number], time.perf_counter() - start)
    torch.set_num_threads(1)
    single, one_thread, two_threads = (SCENES / seconds for seconds in best)
    return [
        "| way | images a second | ratio |",
        "|---|---|---|",
        f"| {SCENES} one by one | {single:.0f} | 1 |",
        f"| batch of {SCENES}, 1 thread | {one_thread:.0f} | {one_thread / single:.2f} |",
        f"| batch of {SCENES}, 2 threads | {two_threads:.0f} | {two_threads / single:.2f} |",
    ]


def report() -> str:
    """Measure everything, and return the page."""
    torch.set_num_threads(1)
    plain, culling, inside = (
        build_rasterizer(**config) for config in ({}, {"cull": True}, {"cull": True, "gradient": "interior"})
    )
    bodies = [figure(), subdivide(*figure())]
    scenes = [scene(*body, distance=DISTANCE) for body in bodies]
    cover = plain(scenes[0], ("mask",))["mask"].float().mean().item()
    kinds: list[tuple[str, Renderer, Scene]] = []
    for (vertices, faces), view in zip(bodies, scenes, strict=True):
        size = f"{len(vertices):,} / {len(faces):,}"
        kinds += [(f"{size}, in view", plain, view), (f"{size}, in view, culled", culling, view)]
        kinds += [(f"{size}, in view, culled, interior", inside, view)]
        kinds += [(f"{size}, out of view", plain, scene(vertices, faces, distance=-DISTANCE))]
    times = lowest([call for _, drawing, view in kinds for call in calls_of_row(drawing, view)])
    wide = len(CHANNELS) + len(LEARNED)
    rows = [
        f"| {name} | {' | '.join(f'{time_ms:.2f}' for time_ms in times[wide * number : wide * (number + 1)])} |"
        for number, (name, _, _) in enumerate(kinds)
    ]
    cold, warm = first_calls(FIRST_CALL, NUMBA_CACHE_DIR="{}")
    own_times = " / ".join(
        f"{milliseconds(partial(culling, view, ('color',)), 100, time.process_time):.2f}" for view in scenes
    )
    return "\n".join(
        [
            "# rasterizer: run time of an image",
            "",
            "This page measures the processor time that the renderer `rasterizer` needs for one image. It compares "
            "the times for different channels of the image and different numbers of vertices, without and with "
            "gradients.",
            "",
            f"The rendered image has {HEIGHT} rows × {WIDTH} columns and shows a synthetic closed body, which covers "
            f"{cover:.0%} of the pixels. A time is the lowest of {ROUNDS} medians of 40 calls on one thread. The "
            "renderer keeps nothing from one image to the next.",
            "",
            "The first column of the table holds the number of vertices and faces and the kind of image. `in view`: "
            "the body is in front of the camera. `out of view`: the body is behind the camera. `culled`: faces seen "
            "from behind are left out (`cull=True`). `interior`: the gradient leaves out the movement of edges "
            "(`gradient=interior`). The other columns hold the time in ms to render the named channels. The last two "
            "columns include the gradient of the colours with respect to the vertices or to the vertex colours.",
            "",
            f"| vertices / faces, kind of image | {' | '.join(' + '.join(names) + ', ms' for names in CHANNELS)} | "
            + " | ".join(f"color with gradient of {name}, ms" for name in LEARNED)
            + " |",
            "|---|" + "---|" * wide,
            *rows,
            "",
            f"The first image that a process renders, with the channels color, depth, face and mask, takes {cold:.1f} "
            f"s if the code must be compiled. It takes {warm:.2f} s if the compiled code is read from the cache.",
            "",
            "## Savings",
            "",
            "The renderer `rasterizer` has optimisations, called savings, that skip work without changing the image. "
            "The table shows how much time each of them saves. For each row one saving is switched off and on. "
            "`back` is the culling of faces seen from behind; the other savings are explained at the parameter "
            "`savings` of the class `Rasterizer`. `channels` compares an image of the channel `mask` with an image "
            "of all channels except `uv`. The last column counts the faces that are left out: `flat` faces cover no "
            "area, `back` faces are seen from behind, `outside` faces do not lie in the image, and `hidden` faces "
            "lie behind others. It also names what is reused from the previous image: checked `faces`, or the "
            "`places` of projected vertices.",
            "",
            "| saving | scene | without it, ms | with it, ms | faces left out |",
            "|---|---|---|---|---|",
            *savings(scenes[0]),
            "",
            "## Batches",
            "",
            "The method `Renderer.batch` of the renderer `rasterizer` renders several images at once. The table "
            "holds the number of images per second of wall time for single images and for batches, the best of 25 "
            "repetitions. `ratio` is the number of images per second divided by the number in the first row.",
            "",
            *batch_table(scenes[0]),
            "",
            "## Growth with the number of faces and pixels",
            "",
            "This table shows how the time of an image grows. The time of an image of a synthetic ball is measured "
            "for different numbers of faces and pixels. Each entry of the table is the number of faces or pixels, "
            "followed by the time in ms. `slope` is the slope of the time on double logarithmic axes, over the upper "
            "half of the numbers: 1 means that the time is proportional to the number.",
            "",
            *rasterizer_growth.report(Path(__file__).with_name("rasterizer_growth.png")),
            "",
            "## Other renderers",
            "",
            "This table compares the renderer `rasterizer` with other renderers, which draw the same two scenes of a "
            f"body. It holds milliseconds of processor time of all threads, for {len(bodies[0][0]):,} / "
            f"{len(bodies[1][0]):,} vertices.",
            "",
            "| renderer | processor time, ms |",
            "|---|---|",
            f"| rasterizer (culled) | {own_times} |",
            *rasterizer_peers.rows(scenes),
            "",
            "The following renderers were not run for this page. Their times per image were measured on another "
            "machine, two cores of a Sapphire Rapids Xeon.",
            "",
            "| renderer | processor time, ms |",
            "|---|---|",
            *(f"| {name} | {times_text} |" for name, times_text in rasterizer_peers.ELSEWHERE.items()),
            "",
            f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.rendering.rasterizer`.",
            "",
        ]
    )


if __name__ == "__main__":
    write_page(__file__, report())
