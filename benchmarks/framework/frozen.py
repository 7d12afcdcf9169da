"""Time frozen models against eager ones on one core.

    python -m benchmarks.framework.frozen

The thesis's classifier of basis point sets (512-400-400-40, batch norm, dropout), alone and with its encoder on clouds
of 2048 points: the predictor in torch without gradient, other ways to deploy it, and deployment.frozen, one after the
other in each round of one process. Weights are random: they do not change the cost, but for the zeros that ReLU leaves
(about half, as after training). Run it on one core (`taskset -c 0`). Writes frozen.md beside this
file.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of NumPy's products too

import statistics
import sys
import time
import warnings
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.pages import machine, write_page
from framework.configuration.assembly import build_predictor
from framework.configuration.schema import resolve
from framework.deployment.frozen import freeze_predictor
from framework.model import FrozenFrontEnd, Model, Predictor
from framework.target import Target

ROUNDS = 9
CLASSES = Target("class", tuple(f"class {number}" for number in range(40)))
MLP = {"name": "mlp", "widths": [400, 400], "batch_norm": True, "dropout": 0.5}
BPS = {"name": "bps", "points": 512}
Calls = dict[str, Callable[[], object]]


def predictor(encoders: list[dict], shape: tuple[int, ...]) -> Model | FrozenFrontEnd:
    """Untrained but for the moments of batch norm."""
    config = {
        "encoder": [resolve("encoder", part) for part in encoders],
        "density_head": resolve("density_head", "categorical"),
        "uncertainty": [],
    }
    made = build_predictor(config, CLASSES, shape, seed=0)
    with torch.no_grad():
        made.train()(torch.rand(64, *shape))
    made.eval()
    assert isinstance(made, Model | FrozenFrontEnd)
    return made


def seconds(call: Callable[[], object], repeats: int) -> float:
    """The least processor time of a call."""
    least = float("inf")
    for _ in range(repeats):
        start = time.process_time_ns()
        call()
        least = min(least, time.process_time_ns() - start)
    return least / 1e9


def rows(title: str, calls: Calls, count: int) -> list[str]:
    """Lines of the table; ratios to the first call, of the medians over rounds."""
    repeats = 400 if count == 1 else 12
    taken: dict[str, list[float]] = {name: [] for name in calls}
    with torch.inference_mode():
        for _ in range(ROUNDS):
            for name, call in calls.items():
                call()  # brings its weights back into the caches
                taken[name].append(seconds(call, repeats))
    medians = {name: statistics.median(found) for name, found in taken.items()}
    first = next(iter(medians.values()))
    return [
        f"| {title} | {count} | {name} | {1e3 * median:.4f} | {1e3 * median / count:.4f} | {first / median:.2f} |"
        for name, median in medians.items()
    ]


def classifier(count: int) -> list[str]:
    made = predictor([MLP], (512,))
    form = freeze_predictor(made, (512,))
    assert isinstance(made, Model)
    network = torch.nn.Sequential(made.encoders, made.projection, torch.nn.Softmax(-1)).eval()
    inputs = torch.rand(count, 512)
    array = inputs.numpy()
    check(form(array), made, inputs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.jit is deprecated
        script = torch.jit.optimize_for_inference(torch.jit.freeze(torch.jit.trace(network, inputs)))
    exported = torch.export.export(network, (inputs,)).module()
    calls: Calls = {
        "predictor in torch": lambda: made(inputs).probs,
        "torch.export": lambda: exported(inputs),
        "torch.jit.freeze": lambda: script(inputs),
        "frozen": lambda: form(array),
    }
    return rows("classify", calls, count)


def clouds(count: int) -> list[str]:
    made = predictor([BPS, MLP], (2048, 3))
    assert isinstance(made, FrozenFrontEnd)
    form = freeze_predictor(made)
    inputs = torch.randn(count, 2048, 3)
    inputs = inputs / inputs.norm(dim=-1, keepdim=True)
    check(form(inputs), made, inputs)
    calls: Calls = {
        "predictor in torch": lambda: made(inputs).probs,
        "frozen": lambda: form(inputs),
        "of it the encoder": lambda: made.features(inputs),
    }
    return rows("encode and classify", calls, count)


def check(found: np.ndarray, made: Predictor, inputs: torch.Tensor) -> None:
    """Stop where a frozen probability is not the predictor's."""
    error = np.abs(found - made(inputs).probs.detach().numpy()).max()
    if error > 1e-6:
        raise SystemExit(f"frozen probabilities are off by {error}")


def main() -> None:
    torch.set_num_threads(1)
    start = time.perf_counter()
    freeze_predictor(predictor([MLP], (512,)), (512,))
    freezing = time.perf_counter() - start
    lines = [line for count in (1, 2, 4, 8, 32, 256) for line in classifier(count)]
    lines += [line for count in (1, 256) for line in clouds(count)]
    text = (
        "# Frozen models: eager against deployable, one core\n\n"
        "`python -m benchmarks.framework.frozen`: 512-400-400-40 with batch norm and dropout, 40 classes; clouds of "
        f"2048 points, 512 basis points. Least processor time of a call in each of {ROUNDS} rounds, their median; "
        "ratios to the first line of each block. Frozen probabilities are the predictor's to 1e-6, checked in the "
        "run.\n\n"
        "| what | batch | how | ms / call | ms / sample | times as fast |\n|---|---|---|---|---|---|\n"
        + "\n".join(lines)
        + f"\n\nFreezing takes {freezing:.1f} s: the exporter's import, and compiled functions from their cache.\n\n"
        f"{machine('torch', 'numpy', 'numba')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
