"""Measure how far encodings of one shape are apart, with and without `rotation_invariant`.

    python -m benchmarks.clouds.rotation

Writes rotation.md beside this file. Shapes are the generated CAD models of data=modelnet40; half a minute on one core.
"""

import sys

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.pages import machine, write_page
from framework.geometry.meshes import Mesh, sample
from framework.reports.table import markdown
from plugins.data.labelled_clouds.shapes.generator import CLASSES, model
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.encoding import channels, encode, prepared

MODELS = 3
"""Of each class."""
BASIS = 512
LIMIT = 0.05
"""Codes further apart than this, root mean square, count as different."""


def sampled(points: int, draw: int) -> Tensor:
    """A cloud of each shape (shape, points, 3), float32; another `draw` has other points of the same surfaces."""
    clouds = []
    for category in CLASSES:
        for number in range(MODELS):
            solid = model(category, "test", number, 0)
            random = np.random.default_rng([draw, len(clouds)])
            clouds.append(sample(Mesh(category, solid.vertices, solid.faces), points, random).points)
    return torch.from_numpy(np.stack(clouds)).float()


def codes(clouds: Tensor, invariant: bool) -> Tensor:
    made = prepared(basis("ball_uniform", BASIS, 1.0, 13).float())
    return channels(encode(clouds, made, ["distance"], rotation_invariant=invariant)).flatten(1)


def apart(first: Tensor, other: Tensor) -> Tensor:
    """Root mean square differences of rows."""
    return (first - other).square().mean(1).sqrt()


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for invariant in (False, True):
        for points in (2048, 5000):
            clouds = sampled(points, 0)
            turns = Rotation.random(len(clouds), 0)  # pyright: ignore[reportArgumentType]  # SciPy takes a seed
            rotation = torch.from_numpy(turns.as_matrix())
            turned = (clouds.double() @ rotation.mT).float()
            own = codes(clouds, invariant)
            again = apart(own, codes(sampled(points, 1), invariant))
            others = (own[:, None] - own).square().mean(-1).sqrt()
            others.fill_diagonal_(torch.inf)
            rows.append(
                {
                    "invariant": invariant,
                    "points": points,
                    "turned": apart(own, codes(turned, invariant)).max().item(),
                    "share": 100 * (again > LIMIT).double().mean().item(),
                    "again": again.median().item(),
                    "other": others.amin(1).median().item(),
                    "synthetic": True,
                }
            )
    columns = {
        "invariant": "`rotation_invariant`",
        "points": "points",
        "turned": "largest: the same points, turned",
        "again": "median: other points of the same surface",
        "share": f"above {LIMIT:g}, %",
        "other": "median: nearest other shape",
    }
    text = (
        f"# Distances between encodings of one shape\n\n{len(CLASSES) * MODELS} generated shapes (synthetic data), "
        f"{BASIS} basis points, float32; root mean square difference of the distances (eq. 6.4) of two clouds, in "
        "units of the normalised cloud. Axes are not determined where two moments are nearly equal, as of round or "
        f"square things: of those shapes two samples of one surface are more than {LIMIT:g} apart.\n\n"
        f"{markdown(rows, columns)}\n{machine('torch', 'numba')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
