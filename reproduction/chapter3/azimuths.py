"""Measure whether azimuth densities know their own errors, and compare point predictions (synthetic PASCAL3D+).

    python -m reproduction.thesis_tables 3.3
    python -m reproduction.chapter3.azimuths outputs/thesis_tables/pascal3d outputs/thesis_tables/pascal3d_classes

Of the models of Table 3.3, on the test images of the classes that look different from every side: is a density wide
where it errs (thesis Figures 3.2, 3.6), is it wide for blurred images (§3.1), how often is it sure of the back
instead of the front (Figure 3.6), does a point chosen by decision theory err less than the mode (§3.1, eq. 3.23).
Writes azimuths.md beside this file.
"""

import json
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

from benchmarks.pages import machine, write_page
from benchmarks.sweeps import processor_seconds, record
from framework.configuration.assembly import build_data
from framework.configuration.loading import load_with_description
from framework.distributions.circular import angular_distance, grid
from framework.distributions.protocol import marginal, median
from framework.training.batches import Batches

METHODS = ("fixed_kappa", "von_mises", "mixture", "cvae", "scvae")
POINTS = 720
"""Azimuths at which a density is evaluated: half a degree apart."""
CHUNK = 16
SAMPLES = 1000
"""Draws of which the point prediction is chosen (S of eq. 3.24)."""
TURNED = math.radians(135)
"""An error above this shows the back for the front."""
SURE, NEAR = 0.9, math.radians(45)
"""A density is sure where it gives SURE to NEAR of its point."""


class Seen(NamedTuple):
    """Of every test image: errors of the azimuth in degrees, entropy in nats, mass near the point, its own blur."""

    median_error: np.ndarray
    mode_error: np.ndarray
    entropy: np.ndarray
    near: np.ndarray
    blur: np.ndarray


Question = Callable[[Seen], float]


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Spearman's; NaN where one of them does not vary, as the entropy of a concentration that is the same for all."""
    if np.ptp(one) < 1e-6 or np.ptp(other) < 1e-6:
        return math.nan
    return float(np.corrcoef(rankdata(one), rankdata(other))[0, 1])


def thirds(seen: Seen) -> tuple[float, float]:
    """Mean error of the third with the least entropy and of that with the most; NaN where all have the same."""
    if np.ptp(seen.entropy) < 1e-6:
        return math.nan, math.nan
    order = np.argsort(seen.entropy, kind="stable")
    many = len(order) // 3
    return float(seen.median_error[order[:many]].mean()), float(seen.median_error[order[-many:]].mean())


def sure_of_the_back(seen: Seen) -> float:
    turned = seen.median_error > math.degrees(TURNED)
    return 100 * float((turned & (seen.near > SURE)).mean())


QUESTIONS: dict[str, Question] = {
    "rank correlation of entropy and error": lambda seen: correlation(seen.entropy, seen.median_error),
    "error of the surest third, °": lambda seen: thirds(seen)[0],
    "of the least sure, °": lambda seen: thirds(seen)[1],
    "rank correlation of entropy and blur": lambda seen: correlation(seen.entropy, seen.blur),
    "turned round, %": lambda seen: 100 * float((seen.median_error > math.degrees(TURNED)).mean()),
    "… and sure of it, %": sure_of_the_back,
    "error of the mode above the median's, °": lambda seen: float(
        (seen.mode_error - seen.median_error).mean()
    ),
}


@torch.no_grad()
def seen(densities: Sequence[Distribution], azimuths: Tensor, blur: Tensor) -> Seen:
    """Of densities of the azimuth alone, batch by batch; the true ones and the blur of all images."""
    found = [
        _of_batch(density, angle)
        for density, angle in zip(densities, _split(densities, azimuths), strict=True)
    ]
    median_error, mode_error, entropy, near = (
        torch.cat(column).double().numpy() for column in zip(*found, strict=True)
    )
    return Seen(median_error, mode_error, entropy, near, blur.double().numpy())


def _split(densities: Sequence[Distribution], azimuths: Tensor) -> Sequence[Tensor]:
    return azimuths.split([density.batch_shape[0] for density in densities])


def _of_batch(density: Distribution, azimuth: Tensor) -> tuple[Tensor, ...]:
    places = grid(POINTS, dtype=torch.float64)
    angles = places.to(azimuth.dtype)[:, None, None].expand(-1, len(azimuth), 1)
    log_density = torch.cat([density.log_prob(some).double() for some in angles.split(CHUNK)])
    mass = log_density.softmax(0)
    entropy = -(mass * (mass.clamp(min=1e-300).log() - math.log(2 * math.pi / POINTS))).sum(0)
    mode = places[log_density.argmax(0)]
    point = median(density, SAMPLES).squeeze(-1).double()
    near = (mass * (angular_distance(places[:, None], point) <= NEAR)).sum(0)
    degrees = 180 / math.pi
    return (
        angular_distance(point, azimuth.double()) * degrees,
        angular_distance(mode, azimuth.double()) * degrees,
        entropy,
        near,
    )


def of_run(run: Path, loaders: dict[str, Batches]) -> Seen | None:
    """What one trained model sees of its class's test images; None of a class that looks alike from several sides."""
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
        return seen(densities, azimuths[:, 0], blur)


def main() -> None:
    torch.set_num_threads(1)
    loaders: dict[str, Batches] = {}
    found: dict[str, dict[str, list[list[float]]]] = {method: {} for method in METHODS}
    minutes: dict[str, dict[str, list[float]]] = {method: {} for method in METHODS}
    runs = 0
    for path in sorted(path for folder in sys.argv[1:] for path in Path(folder).glob("*/results.json")):
        row = json.loads(path.read_text(encoding="utf-8"))
        minutes[row["method"]].setdefault(row["data"], []).append(processor_seconds(record(path.parent)) / 60)
        answers = of_run(path.parent, loaders)
        if answers is not None:
            values = [question(answers) for question in QUESTIONS.values()]
            found[row["method"]].setdefault(row["data"], []).append(values)
            runs += 1
    classes = sorted(
        name.removeprefix("pascal3d ")
        for name in set.intersection(*(set(each) for each in found.values() if each))
    )
    lines = [
        f"| method | classes | {' | '.join(QUESTIONS)} | processor minutes a run, all classes |",
        "|---|---:|" + "---:|" * (len(QUESTIONS) + 1),
    ]
    for method, each in found.items():
        if each:
            lines.append(f"| {method} | {len(each)} | {cells(each)} | {mean_of(minutes[method])} |")
    text = (
        "# Do azimuth densities know their own errors? (synthetic data)\n\n"
        "The models of [pascal3d.md](pascal3d.md) predict the test images of the classes without symmetry; a quarter "
        "of the images is blurred. Numbers are means over classes, each the mean of its seeds, ± the standard error "
        f"over classes; classes with every method: {', '.join(classes) or 'none'}. The median is the draw of "
        f"{SAMPLES} with "
        'the least expected deviation (eq. 3.24). "Turned round" is an error above 135°; "sure of it" means that nine '
        "tenths of the probability lie within 45° of the point.\n\n" + "\n".join(lines) + "\n\n"
        f"{runs} runs. {machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


def cells(each: dict[str, list[list[float]]]) -> str:
    columns = np.array([np.mean(values, axis=0) for values in each.values()]).T
    return " | ".join(with_error(column) for column in columns)


def mean_of(each: dict[str, list[float]]) -> str:
    return with_error(np.array([np.mean(values) for values in each.values()]))


def with_error(values: np.ndarray) -> str:
    if np.isnan(values).any():
        return "–"
    if len(values) == 1:
        return f"{values[0]:.2f}"
    return f"{values.mean():.2f} ± {values.std(ddof=1) / len(values) ** 0.5:.2f}"


if __name__ == "__main__":
    main()
