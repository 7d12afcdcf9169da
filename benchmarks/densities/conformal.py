"""Measure coverage and size of conformal prediction sets.

    python -m benchmarks.densities.conformal

Every figure is a mean over 200 random splits of one pool of 2000 samples, half of it for validation, from which the
wrapper leaves half to what it wraps. The models are fixed and badly calibrated on purpose: a classifier of two moons
that is much too sure, and a von Mises density of the right direction whose κ is wrong by a factor. Writes conformal.md
beside this file.
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

from benchmarks.pages import machine, write_page
from framework.configuration.schema import build, resolve
from framework.data import Batch
from framework.model import Predictor
from framework.target import Target
from plugins.uncertainty.conformal.prediction_set import PredictionSet

SPLITS, POOL = 200, 2000
CLASSES, ANGLE = Target("class", ("upper", "lower")), Target("angle", ("azimuth",))


class Fixed(Predictor):
    """Densities as a function of the input, nothing to train."""

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
    points, label = make_moons(POOL, noise=0.35, random_state=0)
    return torch.from_numpy(points), torch.from_numpy(label)


def classifier(sharpness: float) -> Callable[[Tensor], Distribution]:
    """A hand-made boundary; sharpness 1 is about calibrated."""

    def predict(points: Tensor) -> Distribution:
        x, y = points.unbind(-1)
        margin = sharpness * (0.25 + 0.6 * torch.sin(2.2 * x + 0.4) - y)
        return Categorical(logits=torch.stack([-margin, margin], -1).log_softmax(-1), validate_args=False)

    return predict


def concentration(inputs: Tensor) -> Tensor:
    return 4 + 3 * torch.tanh(inputs[:, 1:])


def circle() -> tuple[Tensor, Tensor]:
    generator = np.random.default_rng(0)
    inputs = torch.from_numpy(generator.uniform(-3, 3, (POOL, 2)))
    noise = generator.vonmises(0, concentration(inputs)[:, 0].numpy())
    return inputs, inputs[:, :1] + torch.from_numpy(noise)[:, None]


def direction(factor: float) -> Callable[[Tensor], Distribution]:
    """The right direction with κ times a factor."""
    head = build("density_head", resolve("density_head", "von_mises"), target=ANGLE)
    kind = type(head(torch.zeros(1, head.size)))
    return lambda inputs: kind(inputs[:, :1], factor * concentration(inputs))


def wrapped(
    predict: Callable[[Tensor], Distribution], target: Target, score: str, miscoverage: float, warm: bool
) -> Predictor:
    def model() -> Predictor:
        return Fixed(predict)

    def temperature() -> Predictor:
        return build("uncertainty", resolve("uncertainty", "temperature"), model=model, target=target)

    config = resolve("uncertainty", {"name": "conformal", "score": score, "miscoverage": miscoverage})
    return build("uncertainty", config, model=temperature if warm else model, target=target).eval()


def measured(
    predict: Callable[[Tensor], Distribution],
    inputs: Tensor,
    label: Tensor,
    target: Target,
    score: str,
    miscoverage: float,
    warm: bool,
) -> tuple[float, float, float, float]:
    """Coverage, its standard deviation over splits, size, and the coverage of the model's own region of that mass."""
    generator = torch.Generator().manual_seed(0)
    covered, sizes = [], []
    for _ in range(SPLITS):
        order = torch.randperm(POOL, generator=generator)
        first, rest = order[: POOL // 2], order[POOL // 2 :]
        wrapper = wrapped(predict, target, score, miscoverage, warm)
        wrapper.calibrate([{"input": inputs[first], "target": label[first], "index": first}])
        sets = wrapper(inputs[rest])
        assert isinstance(sets, PredictionSet)
        covered.append(sets.contains(label[rest]).double().mean())
        if len(sizes) < 10:  # sizes vary little, and arcs cost more than coverage
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
            "moons, labels",
            moons(),
            CLASSES,
            {"too sure": classifier(6.0), "not sure enough": classifier(0.3)},
        ),
        ("circle, degrees", circle(), ANGLE, {"κ × 8": direction(8.0), "κ / 4": direction(0.25)}),
    ):
        for told, predict in models.items():
            for warm in (False, True):
                for score in ("density", "mass"):
                    for miscoverage in (0.1,) if warm else (0.1, 0.05):
                        start = time.perf_counter()
                        cover, spread, size, own = measured(
                            predict, inputs, label, target, score, miscoverage, warm
                        )
                        size = size if target is CLASSES else math.degrees(size)
                        wrappers = "temperature, conformal" if warm else "conformal"
                        rows.append(
                            f"| {name} | {told} | {wrappers} | {score} | {100 * (1 - miscoverage):g} % | "
                            f"{100 * cover:.2f} % | {100 * spread:.1f} % | {100 * own:.1f} % | {size:.3g} |"
                        )
                        sys.stderr.write(f"{rows[-1]} {time.perf_counter() - start:.1f} s\n")
    text = (
        "# Conformal prediction sets: coverage and size\n\n"
        f"`python -m benchmarks.densities.conformal`: means over {SPLITS} random splits of {POOL} samples (half "
        "validation, of which the wrapper's own half gives the threshold); fixed models, badly calibrated on "
        "purpose; size over the first 10 splits. `spread` is the standard deviation over splits, about 1.6 % where "
        "500 scores and 1000 targets are drawn at 90 %. `model's own` is the coverage of the model's region of that "
        "mass without any calibration. Synthetic data.\n\n"
        "| data, unit of size | model | wrappers | score | promised | covered | spread | model's own | mean size |\n"
        "|---|---|---|---|---:|---:|---:|---:|---:|\n" + "\n".join(rows) + "\n\n"
        f"{machine('torch', 'scikit-learn')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
