"""Count pixels of a surface that no triangle or several triangles cover.

python -m benchmarks.rendering.rasterizer_coverage
"""

import time
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion, binary_fill_holes

from benchmarks.pages import machine, write_page
from benchmarks.rendering.rasterizer import DISTANCE, FOCAL, HEIGHT, WIDTH, figure, scene, subdivide
from framework.geometry.camera import look_from
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_coverage import PixelCounts, sum_counts, views

CAMERAS = 10_000
VIEWS = 40


def count_holes() -> tuple[int, int, int]:
    """Count pixels of a closed body of 27,554 vertices.

    Returns:
        Number of covered pixels, of holes inside of the outline, and of cracks. A crack is a pixel that shows another
        face if faces seen from behind are left out, and that is not next to the outline.
    """
    body = scene(*subdivide(*figure()), distance=DISTANCE)
    random = np.random.default_rng(0)
    all_faces, front_faces = Rasterizer(), Rasterizer(cull=True)
    covered = holes = cracks = 0
    for _ in range(VIEWS):
        azimuth, elevation, tilt = random.uniform([0, -1.5, -3], [6.3, 1.5, 3]).tolist()
        camera = look_from(azimuth, elevation, tilt, float(random.uniform(1.2, 4)), 0.5, (HEIGHT, WIDTH))
        view = replace(body, camera=replace(camera, focal=(float(FOCAL), float(FOCAL))))
        rendered, culled = all_faces(view, ("mask", "face")), front_faces(view, ("face",))
        mask = rendered["mask"].numpy()
        inner = binary_erosion(mask, np.ones((3, 3)))
        covered += int(mask.sum())
        holes += int((binary_fill_holes(mask) & ~mask).sum())
        cracks += int((inner & (rendered["face"] != culled["face"]).numpy()).sum())
    return covered, holes, cracks


def report() -> str:
    """Count, and return the page."""
    start = time.perf_counter()
    counts = list(views(CAMERAS))
    seconds = time.perf_counter() - start
    rows = []
    for name in ("regular", "loose"):
        chosen = [count for count in counts if count[0].startswith(name)]
        total: PixelCounts = sum_counts(chosen)
        cells = (len(chosen), total.inside, total.holes, total.doubled, total.strays, total.other)
        rows.append(f"| {name} | " + " | ".join(f"{cell:,}" for cell in cells) + " |")
    covered, holes, cracks = count_holes()
    return "\n".join(
        [
            "# rasterizer: each pixel of a surface is covered once",
            "",
            "This page checks that the renderer `rasterizer` covers each pixel of a surface exactly once. Pixels that "
            "no triangle covers would appear as holes. Pixels that two triangles cover would be drawn twice.",
            "",
            f"The first test draws a surface, a tessellated plane of 8 × 8 m, with {CAMERAS:,} random cameras. The "
            "cameras have any azimuth, elevation and tilt, distances of 0.05 to 10,000 m, focal lengths of 0.001 to "
            "1,000,000 pixels, and images of 1 to 64 pixels a side. Their principal points may lie outside of the "
            "image, and the near plane may cut the surface. A third of the cameras look straight at the plane, so "
            "that edges run through pixel centres. Each face is drawn alone, and the faces that cover a pixel are "
            "counted. Rays decide which pixels show the plane. Pixels within 1/128 pixel of its border are left out.",
            "",
            "In the table, `regular` is a plane of equal squares that are divided into triangles, and `loose` is a "
            "plane of random triangles. The columns of numbers count cameras and pixels. `pixels on the plane` are "
            "pixels that must be covered exactly once. `differs from the whole mesh` counts the pixels whose "
            "coverage changes if all faces are drawn together.",
            "",
            "| plane | cameras | pixels on the plane | pixels without a face | pixels with several faces | covered "
            "pixels outside of the plane | differs from the whole mesh |",
            "|---|---|---|---|---|---|---|",
            *rows,
            "",
            f"The count took {seconds:.0f} s.",
            "",
            f"The second test of the coverage draws a closed body of 27,554 vertices in {VIEWS} views of {HEIGHT} × "
            f"{WIDTH} pixels. In all views together, the body covers {covered:,} pixels, and {holes} pixels inside it "
            f"are not covered (holes). Then the faces seen from behind are left out, and {cracks} pixels show another "
            "face than before. Such a pixel would be a crack between two faces. Pixels at the outline and their "
            "neighbours are not counted.",
            "",
            f"{machine('numba', 'numpy')} Command: `python -m benchmarks.rendering.rasterizer_coverage`.",
            "",
        ]
    )


if __name__ == "__main__":
    write_page(__file__, report())
