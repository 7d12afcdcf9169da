"""Measure coverage and size of conformal prediction sets.

    python -m benchmarks.densities.conformal

Every number is a mean over 200 random splits of one pool of 2000 samples. Half of a split is for validation; the
wrapper calibrates the wrapped model on one half of the validation samples and its threshold on the other half. The
models are fixed and badly calibrated on purpose: classifiers of two moons that are overconfident or underconfident, and
von Mises densities with the right direction and a κ that is wrong by a factor. Writes conformal.md into the folder of
this file.
"""

import math
import sys
import time
from collections.abc import Callable, Iterable

import numpy as np
import torch
from sklearn.datasets import make_moons
from torch import Tensor
from torch.distributions import Categorical, Distribution

from benchmarks.pages import machine, publish
from framework.configuration.schema import build, resolve
from framework.data import Batch
from framework.model import Predictor
from framework.target import Target
from plugins.uncertainty.conformal.prediction_set import PredictionSet

SPLITS, POOL = 200, 2000
CLASSES, ANGLE = Target("class", ("upper", "lower")), Target("angle", ("azimuth",))


class Fixed(Predictor):
    """A predictor whose densities are a fixed function of the input."""

    def __init__(self, predict: Callable[[Tensor], Distribution]) -> None:
        super().__init__()
        self.predict = predict

    def forward(self, inputs: Tensor) -> Distribution:
        return self.predict(inputs)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return -self(inputs).log_prob(target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        pass


def moons() -> tuple[Tensor, Tensor]:
    """Return points of two moons, (sample, 2), and their classes, (sample,)."""
    points, label = make_moons(POOL, noise=0.35, random_state=0)
    return torch.from_numpy(points), torch.from_numpy(label)


def classifier(sharpness: float) -> Callable[[Tensor], Distribution]:
    """Return a classifier with a hand-made boundary; with sharpness 1 it is nearly calibrated."""

    def predict(points: Tensor) -> Distribution:
        x, y = points.unbind(-1)
        margin = sharpness * (0.25 + 0.6 * torch.sin(2.2 * x + 0.4) - y)
        return Categorical(logits=torch.stack([-margin, margin], -1).log_softmax(-1), validate_args=False)

    return predict


def concentration(inputs: Tensor) -> Tensor:
    """Return the true κ for each input, (sample, 1)."""
    return 4 + 3 * torch.tanh(inputs[:, 1:])


def circle() -> tuple[Tensor, Tensor]:
    """Return inputs, (sample, 2), and angles with von Mises noise, (sample, 1)."""
    generator = np.random.default_rng(0)
    inputs = torch.from_numpy(generator.uniform(-3, 3, (POOL, 2)))
    noise = generator.vonmises(0, concentration(inputs)[:, 0].numpy())
    return inputs, inputs[:, :1] + torch.from_numpy(noise)[:, None]


def scaled_von_mises(factor: float) -> Callable[[Tensor], Distribution]:
    """Return the von Mises density with the true direction and the true κ times a factor."""
    head = build("density_head", resolve("density_head", "von_mises"), target=ANGLE)
    kind = type(head(torch.zeros(1, head.size)))
    return lambda inputs: kind(inputs[:, :1], factor * concentration(inputs))


def wrap(
    predict: Callable[[Tensor], Distribution], target: Target, score: str, miscoverage: float, tempered: bool
) -> Predictor:
    """Return a fixed predictor in the conformal wrapper, with a temperature wrapper between both if `tempered`."""

    def model() -> Predictor:
        return Fixed(predict)

    def temperature() -> Predictor:
        return build("uncertainty", resolve("uncertainty", "temperature"), model=model, target=target)

    config = resolve("uncertainty", {"name": "conformal", "score": score, "miscoverage": miscoverage})
    return build("uncertainty", config, model=temperature if tempered else model, target=target).eval()


def measure(
    predict: Callable[[Tensor], Distribution],
    inputs: Tensor,
    label: Tensor,
    target: Target,
    score: str,
    miscoverage: float,
    tempered: bool,
) -> tuple[float, float, float, float]:
    """Return coverage of the sets, its standard deviation over splits, their mean size, and uncalibrated coverage."""
    generator = torch.Generator().manual_seed(0)
    covered, sizes = [], []
    for _ in range(SPLITS):
        order = torch.randperm(POOL, generator=generator)
        first, rest = order[: POOL // 2], order[POOL // 2 :]
        wrapper = wrap(predict, target, score, miscoverage, tempered)
        wrapper.calibrate([{"input": inputs[first], "target": label[first], "index": first}])
        sets = wrapper(inputs[rest])
        assert isinstance(sets, PredictionSet)
        covered.append(sets.contains(label[rest]).double().mean())
        if len(sizes) < 10:  # sizes vary little, and the lengths of arcs take longer than the coverage
            sizes.append(sets.size().mean())
    own = PredictionSet(predict(inputs), -torch.tensor(miscoverage).double().log(), "mass")
    cover = torch.stack(covered)
    return (
        cover.mean().item(),
        cover.std().item(),
        torch.stack(sizes).mean().item(),
        own.contains(label).double().mean().item(),
    )


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for name, (inputs, label), target, models in (
        (
            "two moons, labels",
            moons(),
            CLASSES,
            {"overconfident": classifier(6.0), "underconfident": classifier(0.3)},
        ),
        (
            "circle, degrees",
            circle(),
            ANGLE,
            {"κ 8 times too large": scaled_von_mises(8.0), "κ 4 times too small": scaled_von_mises(0.25)},
        ),
    ):
        for calibration, predict in models.items():
            for tempered in (False, True):
                for score in ("density", "mass"):
                    for miscoverage in (0.1,) if tempered else (0.1, 0.05):
                        start = time.perf_counter()
                        cover, spread, size, own = measure(
                            predict, inputs, label, target, score, miscoverage, tempered
                        )
                        size = size if target is CLASSES else math.degrees(size)
                        wrappers = "temperature, conformal" if tempered else "conformal"
                        rows.append(
                            f"| {name} | {calibration} | {wrappers} | {score} | {100 * (1 - miscoverage):g} % | "
                            f"{100 * cover:.2f} % | {100 * spread:.1f} % | {100 * own:.1f} % | {size:.3g} |"
                        )
                        sys.stderr.write(f"{rows[-1]} {time.perf_counter() - start:.1f} s\n")
    text = (
        "# Conformal prediction sets: coverage and size\n\n"
        "This page shows whether conformal prediction sets hold the target with the stated probability, and how large "
        "the sets are, if the wrapped model is badly calibrated. It is written by "
        "`python -m benchmarks.densities.conformal`.\n\n"
        f"The conformal prediction sets are measured on two synthetic data sets of {POOL} samples: two moons with two "
        "classes, and angles on a circle. The models are not trained; they are constructed to be badly calibrated. "
        "The classifiers of the moons are overconfident or underconfident. The von Mises densities of the angles "
        "have the right direction and a wrong κ.\n\n"
        f"Each row of the table is a mean over {SPLITS} random splits of the samples into two halves, for validation "
        "and for the test. Half of the validation samples calibrate the wrapped model; the other half determine the "
        "threshold of the sets. The columns of the table are:\n"
        "- data, unit of size: the data set, and the unit of the last column;\n"
        "- model: how the model is wrong;\n"
        "- wrappers: the conformal wrapper alone, or around a calibrated temperature;\n"
        "- score: the rule that selects the values of a set. With `density`, a set holds all values whose "
        "density is above a threshold. With `mass`, it holds the values of highest density, until their "
        "probabilities add up to a threshold. Each threshold is the same for all inputs;\n"
        "- stated: the stated probability;\n"
        "- coverage: share of test targets that lie in their prediction sets;\n"
        "- SD of coverage: standard deviation of the coverage over the splits. With 500 validation samples and 1000 "
        "test samples, about 1.6 % is expected at a stated probability of 90 %;\n"
        "- coverage without calibration: share of test targets in the sets that the model predicts without a "
        "wrapper. Such a set is the region of highest density to which the model gives the stated probability;\n"
        "- mean size: mean size of the sets, over the first 10 splits.\n\n"
        "| data, unit of size | model | wrappers | score | stated | coverage | SD of coverage | "
        "coverage without calibration | mean size |\n"
        "|---|---|---|---|---:|---:|---:|---:|---:|\n" + "\n".join(rows) + "\n\n"
        f"{machine('torch', 'scikit-learn')}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
