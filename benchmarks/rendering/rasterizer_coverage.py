"""Count pixels of a surface that are covered by no triangle or by several.

python -m benchmarks.rendering.rasterizer_coverage
"""

import time
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion, binary_fill_holes

from benchmarks.pages import machine, write_page
from benchmarks.rendering.rasterizer import DISTANCE, FOCAL, HEIGHT, WIDTH, figure, scene, subdivided
from framework.geometry.camera import look_from
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_coverage import PixelCounts, sum_counts, views

CAMERAS = 10_000
VIEWS = 40


def around() -> tuple[int, int, int]:
    """Of a closed body of 27,554 vertices: pixels covered; holes in its outline; and pixels farther than one from the
    outline that show another face where faces seen from behind are left out, as through a crack."""
    body = scene(*subdivided(*figure()), distance=DISTANCE)
    random = np.random.default_rng(0)
    whole, front = Rasterizer(), Rasterizer(cull=True)
    covered = holes = cracks = 0
    for _ in range(VIEWS):
        azimuth, elevation, tilt = random.uniform([0, -1.5, -3], [6.3, 1.5, 3]).tolist()
        camera = look_from(azimuth, elevation, tilt, float(random.uniform(1.2, 4)), 0.5, (HEIGHT, WIDTH))
        seen = replace(body, camera=replace(camera, focal=(float(FOCAL), float(FOCAL))))
        drawn, culled = whole(seen, ("mask", "face")), front(seen, ("face",))
        mask = drawn["mask"].numpy()
        inner = binary_erosion(mask, np.ones((3, 3)))
        covered += int(mask.sum())
        holes += int((binary_fill_holes(mask) & ~mask).sum())
        cracks += int((inner & (drawn["face"] != culled["face"]).numpy()).sum())
    return covered, holes, cracks


def report() -> str:
    start = time.perf_counter()
    found = list(views(CAMERAS))
    seconds = time.perf_counter() - start
    rows = []
    for name in ("regular", "loose"):
        chosen = [one for one in found if one[0].startswith(name)]
        seen: PixelCounts = sum_counts(chosen)
        cells = (len(chosen), seen.inside, seen.holes, seen.doubled, seen.strays, seen.other)
        rows.append(f"| {name} | " + " | ".join(f"{cell:,}" for cell in cells) + " |")
    covered, holes, cracks = around()
    return "\n".join(
        [
            "# rasterizer: each pixel of a surface is covered once",
            "",
            f"A tessellated plane of 8 × 8 m under {CAMERAS:,} random cameras: any azimuth, elevation and tilt, 0.05 "
            "to 10,000 m away, focal lengths of 0.001 to 1,000,000 pixels, principal points in and out of the image, 1 "
            "to 64 pixels a side, with what the near plane cuts; a third of them square on, with edges through pixel "
            "centres. Faces are drawn one by one and counted; where the plane lies is computed by rays, and pixels "
            "within 1/128 pixel of its border are left out.",
            "",
            "| plane | cameras | pixels on it | covered by none | by more than one | pixels off it that are covered | "
            "other than the whole image |",
            "|---|---|---|---|---|---|---|",
            *rows,
            "",
            f"In {seconds:.0f} s.",
            "",
            f"A closed body of 27,554 vertices, {VIEWS} views of {HEIGHT} × {WIDTH} pixels: {covered:,} pixels "
            f"covered, {holes} holes; {cracks} pixels, farther than one from its outline, that show another face when "
            "faces seen from behind are left out.",
            "",
            f"{machine('numba', 'numpy')} Command: `python -m benchmarks.rendering.rasterizer_coverage`.",
            "",
        ]
    )


if __name__ == "__main__":
    write_page(__file__, report())
