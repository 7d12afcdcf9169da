"""Measure whether azimuth densities know their own errors, and compare point predictions (synthetic PASCAL3D+).

    python -m reproduction.thesis_tables 3.3
    python -m reproduction.chapter3.azimuths outputs/thesis_tables/pascal3d outputs/thesis_tables/pascal3d_classes

The models of Table 3.3 predict the azimuth for the test images of those classes whose objects look different from every
side. The script measures whether a density is wide where its prediction is wrong (thesis Figures 3.2, 3.6) and for
blurred images (§3.1), how often it confidently takes the back for the front (Figure 3.6), and whether the median has a
smaller error than the mode (§3.1, eq. 3.23). It writes azimuths.md beside this file.
"""

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor
from torch.distributions import Distribution

from benchmarks.pages import machine, publish
from benchmarks.sweeps import processor_seconds, read_runs, record
from framework.configuration.assembly import build_data
from framework.configuration.loading import load_with_description
from framework.distributions.circular import angular_distance, grid
from framework.distributions.protocol import marginal, median
from framework.training.batches import Batches

METHODS = ("fixed_kappa", "von_mises", "mixture", "cvae", "scvae")
POINTS = 720
"""Number of azimuths at which a density is evaluated, half a degree apart."""
CHUNK = 16
SAMPLES = 1000
"""Number of samples from which the median is chosen (S of eq. 3.24)."""
TURNED = math.radians(135)
"""Error in radians above which the back of an object is taken for its front."""
SURE, NEAR = 0.9, math.radians(45)
"""Limits for a density that counts as sure: a probability above SURE within NEAR radians of its median."""


class ImageScores(NamedTuple):
    """Results for each test image: errors of median and mode (degrees), entropy (nats), mass near the median, blur."""

    median_error: np.ndarray
    mode_error: np.ndarray
    entropy: np.ndarray
    near: np.ndarray
    blur: np.ndarray


Statistic = Callable[[ImageScores], float]


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Return Spearman's rank correlation, or NaN if one of the two arrays is constant."""
    if np.ptp(first) < 1e-6 or np.ptp(second) < 1e-6:
        return math.nan
    return float(np.corrcoef(rankdata(first), rankdata(second))[0, 1])


def errors_of_thirds(scores: ImageScores) -> tuple[float, float]:
    """Return the mean errors of the third of the images with the lowest, and of that with the highest entropy.

    Both are NaN if all entropies are equal.
    """
    if np.ptp(scores.entropy) < 1e-6:
        return math.nan, math.nan
    order = np.argsort(scores.entropy, kind="stable")
    count = len(order) // 3
    return float(scores.median_error[order[:count]].mean()), float(scores.median_error[order[-count:]].mean())


def percent_sure_of_the_back(scores: ImageScores) -> float:
    turned = scores.median_error > math.degrees(TURNED)
    return 100 * float((turned & (scores.near > SURE)).mean())


STATISTICS: dict[str, Statistic] = {
    "rank correlation of entropy and error": lambda scores: correlation(scores.entropy, scores.median_error),
    "error of the surest third, °": lambda scores: errors_of_thirds(scores)[0],
    "error of the least sure third, °": lambda scores: errors_of_thirds(scores)[1],
    "rank correlation of entropy and blur": lambda scores: correlation(scores.entropy, scores.blur),
    "error above 135°, %": lambda scores: 100 * float((scores.median_error > math.degrees(TURNED)).mean()),
    "confident error above 135°, %": percent_sure_of_the_back,
    "error of the mode minus error of the median, °": lambda scores: float(
        (scores.mode_error - scores.median_error).mean()
    ),
}


@torch.no_grad()
def score_images(densities: Sequence[Distribution], azimuths: Tensor, blur: Tensor) -> ImageScores:
    """Score densities of the azimuth, one density per batch, with the true azimuths and the blur of all images."""
    columns = [
        _score_batch(density, angle)
        for density, angle in zip(densities, _split_by_batch(densities, azimuths), strict=True)
    ]
    median_error, mode_error, entropy, near = (
        torch.cat(column).double().numpy() for column in zip(*columns, strict=True)
    )
    return ImageScores(median_error, mode_error, entropy, near, blur.double().numpy())


def _split_by_batch(densities: Sequence[Distribution], azimuths: Tensor) -> Sequence[Tensor]:
    return azimuths.split([density.batch_shape[0] for density in densities])


def _score_batch(density: Distribution, azimuth: Tensor) -> tuple[Tensor, ...]:
    grid_angles = grid(POINTS, dtype=torch.float64)
    angles = grid_angles.to(azimuth.dtype)[:, None, None].expand(-1, len(azimuth), 1)
    log_density = torch.cat([density.log_prob(some).double() for some in angles.split(CHUNK)])
    mass = log_density.softmax(0)
    entropy = -(mass * (mass.clamp(min=1e-300).log() - math.log(2 * math.pi / POINTS))).sum(0)
    mode = grid_angles[log_density.argmax(0)]
    point = median(density, SAMPLES).squeeze(-1).double()
    near = (mass * (angular_distance(grid_angles[:, None], point) <= NEAR)).sum(0)
    degrees = 180 / math.pi
    return (
        angular_distance(point, azimuth.double()) * degrees,
        angular_distance(mode, azimuth.double()) * degrees,
        entropy,
        near,
    )


def score_run(run: Path, loaders: dict[str, Batches]) -> ImageScores | None:
    """Return the results of a trained model on the test images of its class.

    The result is None if the objects of the class look the same from several sides. `loaders` holds the data of the
    classes that were loaded before; a missing class is added.
    """
    model, description = load_with_description(run)
    category = str(description.config["data"]["category"])
    if category not in loaders:
        data = build_data(description.config)
        data.prepare()
        loaders[category] = Batches(data, batch_size=64, workers=0, seed=0)
    batches = list(loaders[category].test_dataloader())
    if any((batch["symmetry"] != 1).any() for batch in batches):
        return None
    torch.manual_seed(0)
    with torch.inference_mode():
        densities = [marginal(model(batch["input"]), 0) for batch in batches]
        azimuths, blur = (torch.cat([batch[key] for batch in batches]) for key in ("target", "blur"))
        return score_images(densities, azimuths[:, 0], blur)


def main() -> None:
    torch.set_num_threads(1)
    loaders: dict[str, Batches] = {}
    values_by_method: dict[str, dict[str, list[list[float]]]] = {method: {} for method in METHODS}
    minutes: dict[str, dict[str, list[float]]] = {method: {} for method in METHODS}
    runs = 0
    for folder, row in read_runs(*sorted(map(Path, sys.argv[1:]))):
        minutes[row["method"]].setdefault(row["data"], []).append(processor_seconds(record(folder)) / 60)
        scores = score_run(folder, loaders)
        if scores is not None:
            values = [question(scores) for question in STATISTICS.values()]
            values_by_method[row["method"]].setdefault(row["data"], []).append(values)
            runs += 1
    classes = sorted(
        name.removeprefix("pascal3d ")
        for name in set.intersection(
            *(set(values_by_class) for values_by_class in values_by_method.values() if values_by_class)
        )
    )
    lines = [
        f"| method | classes | {' | '.join(STATISTICS)} | processor minutes per run |",
        "|---|---:|" + "---:|" * (len(STATISTICS) + 1),
    ]
    for method, values_by_class in values_by_method.items():
        if values_by_class:
            lines.append(
                f"| {method} | {len(values_by_class)} | {cells(values_by_class)} | "
                f"{mean_over_classes(minutes[method])} |"
            )
    text = (
        "# Do azimuth densities know their own errors? (synthetic data)\n\n"
        "This page measures whether predicted densities of the azimuth, the horizontal viewpoint angle, are wide where "
        "the prediction is wrong. The page [pascal3d.md](pascal3d.md) describes the models. Here they predict the "
        "azimuth for the test images of those classes whose objects look different from every side. A quarter of these "
        "images is blurred.\n\n"
        "A number in the table is the mean over classes of objects, and ± is its standard error over classes. The "
        "value of a class is the mean over its seeds. A dash means that the method has the same concentration, "
        "and therefore the same entropy, for all images. The column **classes** is the number of classes over "
        f"which a row is averaged. All methods were trained on these classes: {', '.join(classes) or 'none'}. The "
        "terms in the table mean:\n"
        "- **Methods** are described on the page [pascal3d.md](pascal3d.md).\n"
        "- The **error** is the angle between the true azimuth and the predicted one. The predicted azimuth is the "
        f"median: of {SAMPLES} samples of the density, the sample with the smallest mean deviation from the others "
        "(eq. 3.24).\n"
        "- The **rank correlation** (Spearman) is computed over the test images, between the entropy of the density "
        "and the error or the strength of the blur.\n"
        "- The **surest third** is the third of the test images whose densities have the lowest entropy. The "
        "**least sure third** is the third with the highest entropy.\n"
        "- **Error above 135°** is the share of images with such an error: the model confuses front and back. "
        "**Confident error above "
        "135°** is the share in which, in addition, nine tenths of the probability lie within 45° of the wrong "
        "median.\n"
        "- **Error of the mode minus error of the median** shows what the median gains over the most likely "
        "angle.\n"
        "- **Processor minutes per run** are a mean over all classes of Table 3.3.\n\n"
        + "\n".join(lines)
        + "\n\n"
        f"The table summarises {runs} runs. {machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


def cells(values_by_class: dict[str, list[list[float]]]) -> str:
    columns = np.array([np.mean(values, axis=0) for values in values_by_class.values()]).T
    return " | ".join(with_error(column) for column in columns)


def mean_over_classes(values_by_class: dict[str, list[float]]) -> str:
    return with_error(np.array([np.mean(values) for values in values_by_class.values()]))


def with_error(values: np.ndarray) -> str:
    if np.isnan(values).any():
        return "–"
    if len(values) == 1:
        return f"{values[0]:.2f}"
    return f"{values.mean():.2f} ± {values.std(ddof=1) / len(values) ** 0.5:.2f}"


if __name__ == "__main__":
    main()
