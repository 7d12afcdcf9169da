"""Measure how much the encoding of a shape changes with rotation and sampling, with and without `rotation_invariant`.

    python -m benchmarks.clouds.rotation

Writes rotation.md into the folder of this file. The shapes are the generated CAD models of data=modelnet40. It takes
half a minute on one core.
"""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.pages import machine, publish
from framework.geometry.meshes import Mesh, sample
from framework.reports.table import markdown
from plugins.data.labelled_clouds.shapes.generator import CLASSES, model
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.encoding import channels, encode, prepare_basis

MODELS = 3
"""Number of shapes of each class."""
BASIS = 512
LIMIT = 0.05
"""Root mean square difference above which two encodings count as different."""


def sample_clouds(points: int, seed: int) -> Tensor:
    """Return a cloud of each shape, (shape, points, 3), float32; the seed determines the points of the surfaces."""
    clouds = []
    for category in CLASSES:
        for number in range(MODELS):
            solid = model(category, "test", number, 0)
            random = np.random.default_rng([seed, len(clouds)])
            clouds.append(sample(Mesh(category, solid.vertices, solid.faces), points, random).points)
    return torch.from_numpy(np.stack(clouds)).float()


def encode_distances(clouds: Tensor, invariant: bool) -> Tensor:
    """Return the distances from the basis points to each cloud, (shape, basis points)."""
    basis_points = prepare_basis(basis("ball_uniform", BASIS, 1.0, 13).float())
    return channels(encode(clouds, basis_points, ["distance"], rotation_invariant=invariant)).flatten(1)


def rms_difference(first: Tensor, second: Tensor) -> Tensor:
    """Return the root mean square difference of each row of two encodings, (shape,)."""
    return (first - second).square().mean(1).sqrt()


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for invariant in (False, True):
        for points in (2048, 5000):
            clouds = sample_clouds(points, 0)
            rotations = Rotation.random(len(clouds), 0)  # pyright: ignore[reportArgumentType]  # SciPy takes a seed
            matrices = torch.from_numpy(rotations.as_matrix())
            rotated = (clouds.double() @ matrices.mT).float()
            encodings = encode_distances(clouds, invariant)
            resampled = rms_difference(encodings, encode_distances(sample_clouds(points, 1), invariant))
            between_shapes = (encodings[:, None] - encodings).square().mean(-1).sqrt()
            between_shapes.fill_diagonal_(torch.inf)
            rows.append(
                {
                    "invariant": invariant,
                    "points": points,
                    "rotated": rms_difference(encodings, encode_distances(rotated, invariant)).max().item(),
                    "resampled": resampled.median().item(),
                    "share": 100 * (resampled > LIMIT).double().mean().item(),
                    "other": between_shapes.amin(1).median().item(),
                    "synthetic": True,
                }
            )
    columns = {
        "invariant": "`rotation_invariant`",
        "points": "points",
        "rotated": "same points rotated, largest difference",
        "resampled": "surface resampled, median difference",
        "share": f"surface resampled, difference above {LIMIT:g}, %",
        "other": "nearest other shape, median difference",
    }
    text = (
        "# Differences between encodings of one shape\n\n"
        "This page shows how much the encoding of a shape by basis points changes if the shape is rotated, or if other "
        "points of its surface are sampled. The encoder is measured with and without its option "
        "`rotation_invariant`, which rotates each cloud into the coordinate system of its principal axes before it "
        f"is encoded. The data are {len(CLASSES) * MODELS} "
        f"generated shapes (synthetic data). There are {BASIS} basis points, in float32.\n\n"
        "An encoding holds the distance from each basis point to the nearest point of the cloud (eq. 6.4 of the "
        "thesis). The difference of two encodings is the root mean square difference of these distances, in "
        "units of the normalised cloud. For clouds with the given number of points, the columns of the table "
        "give:\n"
        "- the largest difference, over the shapes, between the encodings of a cloud and of the same points in a "
        "random rotation;\n"
        "- the median difference, over the shapes, between the encodings of two samples of points of the same "
        "surface;\n"
        "- the share of shapes for which the encodings of two samples of the same surface differ by more than "
        f"{LIMIT:g};\n"
        "- for comparison, the median difference between the encodings of a shape and of the shape whose encoding is "
        "most similar.\n\n"
        "With `rotation_invariant`, the principal axes are computed from the second moments of the points. If two "
        "second moments are nearly equal, as for round or square shapes, another sample of the same surface can have "
        f"different axes. Two samples of such a shape then have encodings that differ by more than {LIMIT:g}.\n\n"
        f"{markdown(rows, columns)}\n{machine('torch', 'numba')}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
