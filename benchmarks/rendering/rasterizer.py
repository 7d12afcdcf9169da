"""Milliseconds a frame of the renderer rasterizer, what is saved, threads, growth, and other renderers; written beside
this file: `python -m benchmarks.rendering.rasterizer`."""

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
from benchmarks.timing import first_calls, milliseconds
from framework.configuration.schema import build, resolve
from framework.geometry.camera import look_from
from framework.renderer import Renderer, Scene, join_scenes

HEIGHT, WIDTH = 410, 308
FOCAL = 600  # pixels
DISTANCE = 2.6  # metres
ASKED = (("mask",), ("depth",), ("color",), ("color", "depth"))
LEARNED = ("vertices", "colors")
ALONE = ("view", "box")
"""Savings of images that nothing came before."""
SCENES = 32
ROUNDS = 8
FIRST_CALL = """
import time, torch
from benchmarks.rendering.rasterizer import DISTANCE, figure, scene
from plugins.renderer.rasterizer.renderer import Rasterizer
drawn = scene(*figure(), distance=DISTANCE)
start = time.perf_counter()
Rasterizer()(drawn, ("color", "depth", "face", "mask"))
print(time.perf_counter() - start)
"""


def figure(rings: int = 82, segments: int = 84) -> tuple[np.ndarray, np.ndarray]:
    """A closed body like a standing person 1.7 m tall, z up: rings × segments + 2 vertices.

    The default has 6,890 vertices and 13,776 faces.
    """
    polar = np.pi * np.arange(1, rings + 1) / (rings + 1)
    around = 2 * np.pi * np.arange(segments) / segments
    up = 0.85 * np.cos(polar)
    heights = [-0.85, -0.8, -0.45, 0.0, 0.2, 0.45, 0.55, 0.62, 0.75, 0.85]
    halves = [0.10, 0.16, 0.17, 0.21, 0.18, 0.24, 0.17, 0.08, 0.11, 0.0]  # half the breadth there, metres
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
    here = np.arange(segments)
    following = (here + 1) % segments
    a, b = (start + here).ravel(), (start + following).ravel()
    c, d = a + segments, b + segments
    last = (rings - 1) * segments
    top, bottom = np.full(segments, len(vertices) - 2), np.full(segments, len(vertices) - 1)
    faces = [(a, c, d), (a, d, b), (top, here, following), (bottom, last + following, last + here)]
    return vertices, np.concatenate([np.stack(corners, 1) for corners in faces])


def subdivided(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each face cut into four at the middles of its edges."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2), 1)
    unique, which = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (which.reshape(-1, 3) + len(vertices)).T
    parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.concatenate([vertices, vertices[unique].mean(1)]), np.concatenate(
        [np.stack(corners, 1) for corners in parts]
    )


def scene(vertices: np.ndarray, faces: np.ndarray, distance: float) -> Scene:
    """The body, coloured by position, from `distance` metres; behind the camera where that is negative."""
    camera = look_from(0.4, 0.15, 0.05, distance, 2 * math.atan(HEIGHT / 2 / FOCAL), (HEIGHT, WIDTH))
    low, high = vertices.min(0), vertices.max(0)
    colors = torch.tensor((vertices - low) / (high - low), dtype=torch.float32)
    return Scene(torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces), colors, camera)


def lowest(calls: Sequence[Callable[[], object]]) -> list[float]:
    """Of each call the lowest of `ROUNDS` medians of 40, all in turn: what else the machine does only adds to them, and
    for seconds at a time."""
    found = [math.inf] * len(calls)
    for _ in range(ROUNDS):
        for number, call in enumerate(calls):
            found[number] = min(found[number], milliseconds(call, 40))
    return found


def cells(drawing: Renderer, drawn: Scene) -> list[Callable[[], object]]:
    asked = [partial(drawing, drawn, channels) for channels in ASKED]
    return [*asked, *(partial(both_ways, drawing, drawn, what) for what in LEARNED)]


def both_ways(renderer: Renderer, drawn: Scene, learned: str) -> None:
    """An image, and the slopes of a loss in the vertices or in the colours."""
    part = getattr(drawn, learned).clone().requires_grad_()
    renderer(replace(drawn, **{learned: part}), ("color",))["color"].sum().backward()


def renderer(**config: Any) -> Renderer:
    return build("renderer", resolve("renderer", {"name": "rasterizer", "savings": ALONE, **config}))


def crowd(drawn: Scene) -> Scene:
    """Five bodies behind one another, the farthest first."""
    back = torch.tensor([0.0, 0.0, 1.0]) @ drawn.camera.rotation
    return join_scenes(
        [replace(drawn, vertices=drawn.vertices + 0.5 * step * back) for step in (4, 3, 2, 1, 0)]
    )


def savings(drawn: Scene) -> list[str]:
    """With everything left out that may be, and without one saving at a time."""
    away = replace(drawn, vertices=drawn.vertices + 100)
    many = crowd(drawn)
    found = [
        ("back", "one body, colour", drawn, ("color",), {"cull": True}, {"cull": False}),
        ("view", "out of view, mask", away, ("mask",), {}, {"savings": ("box",)}),
        ("box", "one body, colour", drawn, ("color",), {"cull": True}, {"cull": True, "savings": ("view",)}),
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
            "one body whose colours alone change, colour",
            drawn,
            ("color",),
            {"cull": True, "savings": (*ALONE, "unchanged")},
            {"cull": True},
        ),
    ]
    pairs = [(renderer(**with_it), renderer(**without_it)) for *_, with_it, without_it in found]
    plain = renderer(cull=True)
    calls = [
        partial(one, seen, asked)
        for pair, (_, _, seen, asked, _, _) in zip(pairs, found, strict=True)
        for one in pair
    ]
    calls += [partial(plain, drawn, ("mask",)), partial(plain, drawn, sorted(plain.channels - {"uv"}))]
    times = lowest(calls)
    lines = []
    for number, (name, what, *_) in enumerate(found):
        report = pairs[number][0].report
        assert report is not None
        left = ", ".join(f"{count:,} {reason}" for reason, count in report.left_out.items()) or "none"
        again = f"; again used: {', '.join(sorted(report.reused))}" if report.reused else ""
        first, second = times[2 * number : 2 * number + 2]
        lines.append(f"| {name} | {what} | {second:.2f} | {first:.2f} | {left}{again} |")
    lines.append(f"| channels | one body, mask alone for all but uv | {times[-1]:.2f} | {times[-2]:.2f} | |")
    return lines


def side_by_side(drawn: Scene) -> list[str]:
    """Images a second of wall clock, all kept: one by one, in batches on one thread and on two; the best of 25, in
    turn."""
    scenes = [replace(drawn, vertices=drawn.vertices + 0.001 * number) for number in range(SCENES)]
    plain = renderer(cull=True)

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
    single, one, two = (SCENES / seconds for seconds in best)
    return [
        "| | images a second | ratio |",
        "|---|---|---|",
        f"| {SCENES} one by one | {single:.0f} | 1 |",
        f"| batch of {SCENES}, 1 thread | {one:.0f} | {one / single:.2f} |",
        f"| batch of {SCENES}, 2 threads | {two:.0f} | {two / single:.2f} |",
    ]


def report() -> str:
    torch.set_num_threads(1)
    plain, culling, inside = (
        renderer(**config) for config in ({}, {"cull": True}, {"cull": True, "gradient": "interior"})
    )
    bodies = [figure(), subdivided(*figure())]
    scenes = [scene(*body, distance=DISTANCE) for body in bodies]
    cover = plain(scenes[0], ("mask",))["mask"].float().mean().item()
    kinds: list[tuple[str, Renderer, Scene]] = []
    for (vertices, faces), seen in zip(bodies, scenes, strict=True):
        size = f"{len(vertices):,} / {len(faces):,}"
        kinds += [(f"{size}, in view", plain, seen), (f"{size}, in view, culled", culling, seen)]
        kinds += [(f"{size}, in view, culled, interior", inside, seen)]
        kinds += [(f"{size}, out of view", plain, scene(vertices, faces, distance=-DISTANCE))]
    times = lowest([call for _, drawing, seen in kinds for call in cells(drawing, seen)])
    wide = len(ASKED) + len(LEARNED)
    rows = [
        f"| {name} | {' | '.join(f'{each:.2f}' for each in times[wide * number : wide * (number + 1)])} |"
        for number, (name, _, _) in enumerate(kinds)
    ]
    cold, warm = first_calls(FIRST_CALL, NUMBA_CACHE_DIR="{}")
    ours = " / ".join(
        f"{milliseconds(partial(culling, seen, ('color',)), 100, time.process_time):.2f}" for seen in scenes
    )
    return "\n".join(
        [
            "# rasterizer: milliseconds a frame",
            "",
            f"A synthetic closed body in {HEIGHT} rows × {WIDTH} columns, of which it covers {cover:.0%}; "
            f"one thread; processor time, the lowest of {ROUNDS} medians of 40 calls. Nothing is kept from one "
            "image to the next.",
            "",
            f"| vertices / faces | {' | '.join(' + '.join(asked) for asked in ASKED)} | "
            + " | ".join(f"color, and back to {what}" for what in LEARNED)
            + " |",
            "|---|" + "---|" * (len(ASKED) + len(LEARNED)),
            *rows,
            "",
            f"First call in a process, all channels: {cold:.1f} s where everything is compiled, "
            f"{warm:.2f} s where the compiled code is read from the cache.",
            "",
            "## What is left out",
            "",
            "| saving | scene | without it, ms | with it, ms | faces left out |",
            "|---|---|---|---|---|",
            *savings(scenes[0]),
            "",
            "## Side by side",
            "",
            *side_by_side(scenes[0]),
            "",
            "## Growth",
            "",
            *rasterizer_growth.report(Path(__file__).with_name("rasterizer_growth.png")),
            "",
            "## Others",
            "",
            f"The same two scenes, milliseconds of processor time of all threads, {len(bodies[0][0]):,} / "
            f"{len(bodies[1][0]):,} vertices:",
            "",
            "| in this run | |",
            "|---|---|",
            f"| rasterizer (culled) | {ours} |",
            *rasterizer_peers.rows(scenes),
            "",
            "| measured elsewhere, on two cores of a Sapphire Rapids Xeon | |",
            "|---|---|",
            *(f"| {name} | {told} |" for name, told in rasterizer_peers.ELSEWHERE.items()),
            "",
            f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.rendering.rasterizer`.",
            "",
        ]
    )


if __name__ == "__main__":
    write_page(__file__, report())
