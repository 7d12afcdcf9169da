"""Time every metric on every kind of density.

    python -m benchmarks.densities.evaluation_time

Writes evaluation_time.md beside this file; some minutes on one core.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch.distributions import Distribution

from benchmarks.pages import machine, write_page
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
    "a normal": (REAL, {"name": "gaussian"}, 1.0),
    "10 normals": (REAL, {"name": "mixture", "components": 10, "component": {"name": "gaussian"}}, 1.0),
    "a von Mises": (ANGLE, {"name": "von_mises"}, 1.0),
    "a narrow von Mises": (ANGLE, {"name": "von_mises"}, 100.0),
    "5 von Mises": (ANGLE, {"name": "mixture"}, 1.0),
    "500 von Mises": (ANGLE, {"name": "mixture", "components": 500}, 1.0),
    "von Mises of 3 angles": (THREE, {"name": "von_mises"}, 1.0),
    "matrix Fisher": (THREE, {"name": "matrix_fisher"}, 1.0),
}
"""Target, head, and size of the raw numbers that it reads."""
METRICS = ("log_likelihood", "crps", "coverage", "pit", "true_posterior")
QUESTIONS: dict[str, Callable[[Distribution], object]] = {
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


def each(call: Callable[[], object]) -> float:
    """Milliseconds a sample: the median of seven calls, of one where it takes half a second."""
    once = milliseconds(call, repeats=1, warm_up=1)
    return (once if once > 500 else milliseconds(call, repeats=7, warm_up=0)) / BATCH


def prediction(name: str) -> Prediction:
    target, head, size = DENSITIES[name]
    torch.manual_seed(0)
    made = build("density_head", resolve("density_head", head), target=target)
    density = made(size * torch.randn(BATCH, made.size))
    batch = {"target": density.sample(), "symmetry": torch.ones(BATCH, dtype=torch.int64)}
    return Prediction(density, batch)


def judged(name: str, metric: str) -> float | None:
    """Milliseconds a sample; None: the metric is not for such targets."""
    found = prediction(name)
    try:
        made = build("metric", resolve("metric", {"name": metric}), target=DENSITIES[name][0])
    except ConfigError:
        return None

    def call() -> None:
        # what a prediction derives is kept: a new one each time
        made.update(Prediction(found.density, found.batch))

    return each(call)


def asked(name: str, question: Callable[[Distribution], object]) -> float | None:
    density = prediction(name).density
    if density.event_shape == () and question is not QUESTIONS["mode"]:
        return None
    return each(lambda: question(density))


def table(columns: dict[str, Callable[[str], float | None]]) -> list[str]:
    lines = [f"| | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name in DENSITIES:
        times = [column(name) for column in columns.values()]
        cells = ["–" if took is None else f"{took:.2g}" if took < 10 else f"{took:.0f}" for took in times]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def masks(name: str) -> str:
    """Of an encoder with dropout: milliseconds a sample, and how many times faster than one mask after the other."""
    shape, encoder = ENCODERS[name]
    inputs = torch.randn(BATCH, *shape)

    def model(samples: int) -> Callable[[], object]:
        parts = {
            "encoder": [resolve("encoder", encoder)],
            "density_head": resolve("density_head", "von_mises"),
            "uncertainty": [resolve("uncertainty", {"name": "mc_dropout", "samples": samples})],
        }
        made = build_predictor(parts, ANGLE, shape, seed=0).eval()
        return lambda: made(inputs)

    once = each(model(1))
    cells = []
    for samples in SAMPLES:
        took = each(model(samples))
        cells.append(f"{took:.2g} ({samples * once / took:.1f})")
    return f"| {name} | {' | '.join(cells)} |"


@torch.no_grad()
def main() -> None:
    torch.set_num_threads(1)
    text = "\n".join(
        [
            "# Run time of metrics, by kind of density",
            "",
            f"Milliseconds per sample in batches of {BATCH}, float32, one thread: the median of seven calls, or one "
            "call "
            "where it takes half a second. Raw parameters are random; targets are drawn from their densities.",
            "",
            "## Metrics",
            "",
            *table({metric: partial(judged, metric=metric) for metric in METRICS}),
            "",
            "## Questions",
            "",
            *table({question: partial(asked, question=call) for question, call in QUESTIONS.items()}),
            "",
            "## Dropout",
            "",
            "Of `mc_dropout` with S masks; in brackets how many times faster than S passes with one.",
            "",
            f"| | {' | '.join(f'S = {samples}' for samples in SAMPLES)} |",
            f"|---|{'---:|' * len(SAMPLES)}",
            *(masks(name) for name in ENCODERS),
            "",
            f"{machine('torch', 'numba')} Command: `python -m benchmarks.densities.evaluation_time`.",
            "",
        ]
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
