"""A body's pose from a picture, by descent through the rasteriser's three gradients: 100 starts each.

    OMP_NUM_THREADS=1 python benchmarks/fit_pose.py                 # all three, some 50 minutes
    OMP_NUM_THREADS=1 python benchmarks/fit_pose.py measure soft    # one of them; what is done is kept in outputs/
    python benchmarks/fit_pose.py report                            # the table and the picture of what is there

Writes fit_pose.md and fit_pose.png beside this file.
"""

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks.machine import machine
from framework.configuration.schema import build, resolve
from framework.figures import style
from framework.geometry.rotation import geodesic_distance
from framework.renderer import Renderer
from plugins.data.bodies.body import turns_less_identity
from plugins.data.bodies.descent import Descent
from plugins.data.bodies.pose_images import PoseFromImage

HERE = Path(__file__)
STARTS = 100
KEPT = Path("outputs/benchmarks/fit_pose")
GRADIENTS: dict[str, dict[str, Any]] = {
    "boundary": {"gradient": "boundary", "supersampling": 4},
    "nmr": {"gradient": "nmr", "supersampling": 4},
    "soft": {"gradient": "soft", "supersampling": 2},
}
"""A picture of `soft` is smooth already; with 4 × 4 samples a pixel it takes four times as long."""
OPTIONS: dict[str, Any] = {"steps": 30, "restarts": 2, "enough": 0.003}
"""The head's own."""
SHOWN = "typical", "worst"


def renderer(**config: object) -> Renderer:
    return build("renderer", resolve("renderer", {"name": "rasterizer", **config}))


def data() -> PoseFromImage:
    drawn_by = {"name": "rasterizer", "supersampling": 8}
    found = build("data", resolve("data", {"name": "pose_from_image", "renderer": drawn_by, "test": STARTS}))
    found.prepare()
    return found


def place_errors(found: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Of rows of numbers: degrees and centimetres."""
    turned = [turns_less_identity(rows[..., :3].double()) + torch.eye(3) for rows in (found, wanted)]
    apart = torch.linalg.vector_norm(found[..., 3:6] - wanted[..., 3:6], dim=-1)
    return torch.rad2deg(geodesic_distance(*turned)), 100 * apart


def measure(gradient: str) -> None:
    torch.set_num_threads(1)
    source = data()
    test = source.splits().test
    descent = Descent(
        source.figure,
        renderer(**GRADIENTS[gradient]),
        source.figure.camera(*source.input_shape[1:]),
        **OPTIONS,
    )
    folder = KEPT / gradient
    folder.mkdir(parents=True, exist_ok=True)
    descent(test[0]["input"].movedim(0, -1))  # compiles what has to be
    for number in range(STARTS):
        file = folder / f"{number:03}.npz"
        if file.exists():
            continue
        sample = test[number]
        began = time.process_time()
        fit = descent(sample["input"].movedim(0, -1))
        seconds = time.process_time() - began
        np.savez(
            file,
            numbers=fit.numbers,
            path=fit.path,
            target=sample["target"],
            difference=fit.difference,
            seconds=seconds,
        )
        degrees, centimetres = place_errors(fit.numbers, sample["target"])
        sys.stdout.write(f"{gradient} {number}: {degrees:.2f}°, {centimetres:.2f} cm, {seconds:.1f} s\n")
        sys.stdout.flush()


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        measure(sys.argv[2])
