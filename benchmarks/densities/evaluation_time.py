"""Time the metrics, and the methods of a density, on every kind of density.

    python -m benchmarks.densities.evaluation_time

Writes evaluation_time.md into the folder of this file. It takes some minutes on one core.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch.distributions import Distribution

from benchmarks.pages import machine, publish
from benchmarks.timing import milliseconds
from framework.configuration.assembly import build_predictor
from framework.configuration.schema import build, resolve
from framework.distributions.protocol import marginal
from framework.errors import ConfigError
from framework.prediction import Prediction
from framework.target import Target

BATCH = 32
ANGLE, THREE = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation", "tilt"))
REAL, CLASSES = Target("real", ("x",)), Target("class", tuple("abcdefghij"))
DENSITIES: dict[str, tuple[Target, dict[str, Any], float]] = {
    "ten classes": (CLASSES, {"name": "categorical"}, 1.0),
    "normal": (REAL, {"name": "gaussian"}, 1.0),
    "mixture of 10 normals": (
        REAL,
        {"name": "mixture", "components": 10, "component": {"name": "gaussian"}},
        1.0,
    ),
    "von Mises": (ANGLE, {"name": "von_mises"}, 1.0),
    "narrow von Mises": (ANGLE, {"name": "von_mises"}, 100.0),
    "mixture of 5 von Mises": (ANGLE, {"name": "mixture"}, 1.0),
    "mixture of 500 von Mises": (ANGLE, {"name": "mixture", "components": 500}, 1.0),
    "SCVAE of 500 von Mises": (ANGLE, {"name": "scvae"}, 1.0),
    "von Mises of 3 angles": (THREE, {"name": "von_mises"}, 1.0),
    "matrix Fisher of 3 angles": (THREE, {"name": "matrix_fisher"}, 1.0),
}
"""Target, density head and standard deviation of the raw parameters, by name of the density."""
METRICS = ("log_likelihood", "crps", "coverage", "pit", "true_posterior")
METHODS: dict[str, Callable[[Distribution], object]] = {
    "mode": lambda density: density.mode,
    "entropy": lambda density: density.entropy(),
    "1000 samples": lambda density: density.sample(torch.Size((1000,))),
    "marginal at 360 angles": lambda density: marginal(density, 0).log_prob(
        torch.linspace(-3, 3, 360).reshape(360, 1, 1).expand(360, BATCH, 1)
    ),
}
ENCODERS: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
    "mlp of 3 × 512": ((64,), {"name": "mlp", "widths": [512, 512, 512], "dropout": 0.2}),
    "biternion_vgg, 32 × 32 pixels": ((3, 32, 32), {"name": "biternion_vgg"}),
}
SAMPLES = (1, 10, 30, 100)


def milliseconds_per_sample(call: Callable[[], object]) -> float:
    """Return the median of seven calls on a batch, or the time of one call that takes more than half a second."""
    once = milliseconds(call, repeats=1, warm_up=1)
    return (once if once > 500 else milliseconds(call, repeats=7, warm_up=0)) / BATCH


def predict(name: str) -> Prediction:
    """Return a batch of densities with random raw parameters, and targets that are sampled from them."""
    target, head, size = DENSITIES[name]
    torch.manual_seed(0)
    density_head = build("density_head", resolve("density_head", head), target=target)
    density = density_head(size * torch.randn(BATCH, density_head.size))
    batch = {"target": density.sample(), "symmetry": torch.ones(BATCH, dtype=torch.int64)}
    return Prediction(density, batch)


def time_metric(name: str, metric: str) -> float | None:
    """Return milliseconds per sample, or None if the metric does not apply to the kind of target."""
    prediction = predict(name)
    try:
        built = build("metric", resolve("metric", {"name": metric}), target=DENSITIES[name][0])
    except ConfigError:
        return None

    def call() -> None:
        # a prediction stores what is computed from it, so that each call needs a new prediction
        built.update(Prediction(prediction.density, prediction.batch))

    return milliseconds_per_sample(call)


def time_method(name: str, method: Callable[[Distribution], object]) -> float | None:
    """Return milliseconds per sample, or None for classes, of which only the mode is timed."""
    density = predict(name).density
    if density.event_shape == () and method is not METHODS["mode"]:
        return None
    return milliseconds_per_sample(lambda: method(density))


def table(columns: dict[str, Callable[[str], float | None]]) -> list[str]:
    """Return the lines of a table with a row for each density, from the function that measures each column."""
    lines = [f"| density | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name in DENSITIES:
        times = [column(name) for column in columns.values()]
        cells = ["–" if took is None else f"{took:.2g}" if took < 10 else f"{took:.0f}" for took in times]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def time_masks(name: str) -> str:
    """Return the table row of an encoder with MC dropout, with a cell for each number of masks.

    A cell holds milliseconds per sample, and the speed-up over as many predictions with one mask.
    """
    shape, encoder = ENCODERS[name]
    inputs = torch.randn(BATCH, *shape)

    def model(samples: int) -> Callable[[], object]:
        parts = {
            "encoder": [resolve("encoder", encoder)],
            "density_head": resolve("density_head", "von_mises"),
            "uncertainty": [resolve("uncertainty", {"name": "mc_dropout", "samples": samples})],
        }
        predictor = build_predictor(parts, ANGLE, shape, seed=0).eval()
        return lambda: predictor(inputs)

    once = milliseconds_per_sample(model(1))
    cells = []
    for samples in SAMPLES:
        took = milliseconds_per_sample(model(samples))
        cells.append(f"{took:.2g} ({samples * once / took:.1f})")
    return f"| {name} | {' | '.join(cells)} |"


@torch.no_grad()
def main() -> None:
    torch.set_num_threads(1)
    text = "\n".join(
        [
            "# Run time of metrics, by kind of density",
            "",
            "This page shows how long the evaluation of a prediction takes, for each metric and each kind of density. "
            f"All tables give milliseconds per sample, in batches of {BATCH}, in float32 on one thread. A number is "
            "the median of seven calls, or the time of one call if a call takes more than half a second.",
            "",
            "The predicted densities on this page have random raw parameters, and the targets are sampled from the "
            "densities. For the narrow von Mises density, the raw parameters are 100 times as large as for the "
            "others.",
            "",
            "## Metrics",
            "",
            "Each column is a metric of `plugins/metric`. A dash means that the metric does not apply to this kind of "
            "target.",
            "",
            *table({metric: partial(time_metric, metric=metric) for metric in METRICS}),
            "",
            "## Methods of a density",
            "",
            "The table gives the time of methods of a density that metrics and figures call. The last column is the "
            "marginal density of the first number of the target, evaluated at 360 angles. A dash means that the "
            "method was not measured.",
            "",
            *table({name: partial(time_method, method=method) for name, method in METHODS.items()}),
            "",
            "## Dropout at test time",
            "",
            "The wrapper `mc_dropout` returns a mixture of the densities under S random dropout masks. The table "
            "gives the time of one prediction with S masks. The number in brackets says how many times faster it is "
            "than S predictions with one mask each.",
            "",
            f"| network | {' | '.join(f'S = {samples}' for samples in SAMPLES)} |",
            f"|---|{'---:|' * len(SAMPLES)}",
            *(time_masks(name) for name in ENCODERS),
            "",
            f"{machine('torch', 'numba')} Command: `python -m benchmarks.densities.evaluation_time`.",
            "",
        ]
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
