"""Compare training steps of networks for point sets that use every point, or only the points that attain a maximum.

    python -m benchmarks.clouds.set_steps

Both methods use the same weights and clouds, in interleaved rounds; the times are processor times of one thread. Each
network is trained for some steps before, because other points attain the maxima of an untrained network. Writes
set_steps.md into the folder of this file and takes three minutes.
"""

import copy
import math
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import statistics
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from benchmarks.clouds.shapes import shapes
from benchmarks.pages import machine, publish
from framework.encoder import Encoder
from plugins.encoder.point_sets import pooled
from plugins.encoder.point_sets.deepsets import DeepSets
from plugins.encoder.point_sets.point_sets import FIRST_1024_POINTS, Reading
from plugins.encoder.point_sets.pointnet import PointNet

HERE = Path(__file__).resolve()
BATCH, POINTS, TRAINED, ROUNDS = 16, 2048, 60, 7
NETWORKS: dict[str, Callable[[], Encoder]] = {
    "PointNet (vanilla), 1024 points": lambda: PointNet(
        (POINTS, 3), variant="vanilla", reading=FIRST_1024_POINTS, dropout=0.0
    ),
    "PointNet, 1024 points": lambda: PointNet((POINTS, 3), reading=FIRST_1024_POINTS, dropout=0.0),
    "DeepSets, 2048 points": lambda: DeepSets((POINTS, 3), dropout=0.0),
    "DeepSets (micro), 100 points": lambda: DeepSets((POINTS, 3), reading=Reading(points=100), dropout=0.0),
}


def cross_entropy_loss(network: nn.Module, last: nn.Module, clouds: Tensor, labels: Tensor) -> Tensor:
    """Return the cross entropy of the classes that the last layer predicts."""
    return cross_entropy(last(network(clouds)), labels)


class Step(NamedTuple):
    """Milliseconds of a training step, megabytes that it stores for the backward pass, and its gradient."""

    milliseconds: float
    megabytes: float
    gradient: list[Tensor]


def measure_step(loss: Callable[[], Tensor], parameters: list[nn.Parameter]) -> Step:
    """Measure one training step."""
    bytes_by_address = dict[int, int]()

    def record_storage(tensor: Tensor) -> Tensor:
        bytes_by_address[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    start = time.process_time()
    gradient = torch.autograd.grad(loss(), parameters)
    seconds = time.process_time() - start
    with torch.autograd.graph.saved_tensors_hooks(record_storage, lambda tensor: tensor):
        graph = loss()  # noqa: F841 - a reference, so that no memory is freed before it is counted
    own = {parameter.untyped_storage().data_ptr() for parameter in parameters}
    size = sum(size for address, size in bytes_by_address.items() if address not in own)
    return Step(seconds * 1e3, size / 1e6, list(gradient))


def every_point(network: nn.Module) -> AbstractContextManager[object]:
    """Return a context in which every point passes every layer of the network."""
    if isinstance(network, DeepSets):
        return mock.patch.object(
            network, "_attaining", lambda values, counts: (torch.arange(len(values)), counts)
        )
    return mock.patch.object(pooled, "POINTS", math.inf)


def gradient_in_float64(network: Encoder, last: nn.Module, clouds: Tensor, labels: Tensor) -> list[Tensor]:
    """Return the gradient of each parameter in float64, computed through every point."""
    network, last = copy.deepcopy(network).double(), copy.deepcopy(last).double()
    with every_point(network):
        loss = cross_entropy_loss(network, last, clouds.double(), labels)
    return list(torch.autograd.grad(loss, [*network.parameters(), *last.parameters()]))


def largest_relative_error(gradients: list[Tensor], exact: list[Tensor]) -> float:
    """Return the largest relative error over the parameters; a gradient that is only rounding error is left out."""
    least = 1e-6 * max(float(true.norm()) for true in exact)
    return max(
        float((gradient - true).norm() / true.norm())
        for gradient, true in zip(gradients, exact, strict=True)
        if float(true.norm()) > least
    )


def table_row(name: str, network: Encoder, clouds: Tensor, labels: Tensor) -> list[str]:
    """Measure a network and return the cells of its row."""
    last = nn.Linear(network.output_shape[0], int(labels.max()) + 1)
    parameters = [*network.parameters(), *last.parameters()]
    optimizer = torch.optim.Adam(parameters, 1e-3)
    order = torch.Generator().manual_seed(0)
    for _ in range(TRAINED):
        index = torch.randperm(len(clouds), generator=order)[:BATCH]
        optimizer.zero_grad()
        cross_entropy_loss(network, last, clouds[index], labels[index]).backward()
        optimizer.step()
    steps: dict[bool, list[Step]] = {False: [], True: []}
    exact: list[list[Tensor]] = []
    for number in range(ROUNDS):
        index = torch.arange(number * BATCH, (number + 1) * BATCH) % len(clouds)
        loss = partial(cross_entropy_loss, network, last, clouds[index], labels[index])
        for every in steps:
            with every_point(network) if every else nullcontext():
                steps[every].append(measure_step(loss, parameters))
        exact.append(gradient_in_float64(network, last, clouds[index], labels[index]))
    methods = (steps[False], steps[True])
    errors = [
        max(
            largest_relative_error(step.gradient, gradient)
            for step, gradient in zip(method, exact, strict=True)
        )
        for method in methods
    ]
    times = [[step.milliseconds for step in method] for method in methods]
    ratio = statistics.median(b / a for a, b in zip(*times, strict=True))
    memory = [statistics.median(step.megabytes for step in method) for method in methods]
    return [
        name,
        *(f"{statistics.median(rounds):.0f}" for rounds in times),
        f"{ratio:.1f}",
        *(f"{size:.0f}" for size in memory),
        *(f"{error:.1g}" for error in errors),
    ]


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    clouds, synthetic = shapes(POINTS, 4)
    labels = torch.arange(40).repeat_interleave(4)
    assert synthetic and len(clouds) == len(labels)
    order = torch.randperm(len(clouds))
    rows = [table_row(name, make(), clouds[order].float(), labels[order]) for name, make in NETWORKS.items()]
    heads = (
        "network",
        *("attaining points, ms", "every point, ms", "time ratio"),
        *("attaining points, MB", "every point, MB"),
        *("attaining points, gradient error", "every point, gradient error"),
    )
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, ["---"] + ["---:"] * (len(heads) - 1), *rows)]
    text = f"""# A training step of networks for point sets

This page shows how much time and memory a training step of a network for point sets saves if only some points have a
gradient. These networks compute the maximum of each channel over the points of a cloud, and only the points that attain
a maximum influence the result. The column names say for which points the last layers compute a gradient: only for these
"attaining points", or for "every point". The page is written by `python -m benchmarks.clouds.set_steps`.

A training step is the forward and the backward pass of {BATCH} clouds (synthetic CAD models) in float32 on one
thread. The step is measured after {TRAINED} steps of training. Steps with "every point" and with the "attaining
points" run in each of {ROUNDS} interleaved rounds. The columns are:
- ms: processor time of a training step, median over the rounds;
- time ratio: processor time of a step in which every point has a gradient, divided by the time of a step in which
  only the points that attain a maximum have one, median over the rounds;
- MB: memory that autograd stores until the backward pass, without the parameters, median over the rounds;
- gradient error: largest relative error of the gradient with respect to a parameter of the network, over all rounds.
  The reference is the gradient in float64 through every point. Parameters whose gradient consists only of rounding
  errors are left out.

{chr(10).join(lines)}

{machine("torch")}
"""
    publish(HERE, text)


if __name__ == "__main__":
    main()
