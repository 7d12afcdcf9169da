"""Time a training step of networks for sets, with the points that attain a maximum and with every point.

    python -m benchmarks.clouds.set_steps

Both ways on the same weights and clouds, in turns; processor time of one thread. Before that a network trains for some
steps, since untrained ones have other maxima. Writes set_steps.md beside this file; three minutes.
"""

import copy
import math
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import statistics
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from benchmarks.clouds.shapes import shapes
from benchmarks.pages import machine, write_page
from framework.encoder import Encoder
from plugins.encoder.point_sets import pooled
from plugins.encoder.point_sets.deepsets import DeepSets
from plugins.encoder.point_sets.pointnet import PointNet

HERE = Path(__file__).resolve()
BATCH, POINTS, TRAINED, ROUNDS = 16, 2048, 60, 7
NETWORKS: dict[str, Callable[[], Encoder]] = {
    "PointNet (vanilla), 1024 points": lambda: PointNet(
        (POINTS, 3), variant="vanilla", points=1024, dropout=0.0
    ),
    "PointNet, 1024 points": lambda: PointNet((POINTS, 3), points=1024, dropout=0.0),
    "DeepSets, 2048 points": lambda: DeepSets((POINTS, 3), dropout=0.0),
    "DeepSets (micro), 100 points": lambda: DeepSets((POINTS, 3), points=100, dropout=0.0),
}


def classified(network: nn.Module, last: nn.Module, clouds: Tensor, labels: Tensor) -> Tensor:
    return cross_entropy(last(network(clouds)), labels)


def measured(loss: Callable[[], Tensor], parameters: list[nn.Parameter]) -> tuple[float, float, list[Tensor]]:
    """Milliseconds of a step, MB that it holds for the gradient, and the gradient."""
    held = dict[int, int]()

    def hold(tensor: Tensor) -> Tensor:
        held[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    began = time.process_time()
    gradient = torch.autograd.grad(loss(), parameters)
    taken = time.process_time() - began
    with torch.autograd.graph.saved_tensors_hooks(hold, lambda tensor: tensor):
        kept = loss()  # noqa: F841 - so that nothing is freed before it is counted
    own = {parameter.untyped_storage().data_ptr() for parameter in parameters}
    return taken * 1e3, sum(size for place, size in held.items() if place not in own) / 1e6, list(gradient)


def every_point(network: nn.Module) -> AbstractContextManager[object]:
    """In which no layer chooses points."""
    if isinstance(network, DeepSets):
        return mock.patch.object(
            network, "_attaining", lambda values, counts: (torch.arange(len(values)), counts)
        )
    return mock.patch.object(pooled, "POINTS", math.inf)


def in_float64(network: Encoder, last: nn.Module, clouds: Tensor, labels: Tensor) -> list[Tensor]:
    """The gradient through every point."""
    network, last = copy.deepcopy(network).double(), copy.deepcopy(last).double()
    with every_point(network):
        loss = classified(network, last, clouds.double(), labels)
    return list(torch.autograd.grad(loss, [*network.parameters(), *last.parameters()]))


def apart(gradient: list[Tensor], exact: list[Tensor]) -> float:
    """The largest relative error of a parameter's, of those whose gradient is not rounding alone."""
    least = 1e-6 * max(float(true.norm()) for true in exact)
    pairs = [(one, true) for one, true in zip(gradient, exact, strict=True) if float(true.norm()) > least]
    return max(float((one - true).norm() / true.norm()) for one, true in pairs)


def row(name: str, network: Encoder, clouds: Tensor, labels: Tensor) -> list[str]:
    last = nn.Linear(network.output_shape[0], int(labels.max()) + 1)
    parameters = [*network.parameters(), *last.parameters()]
    optimizer = torch.optim.Adam(parameters, 1e-3)
    order = torch.Generator().manual_seed(0)
    for _ in range(TRAINED):
        index = torch.randperm(len(clouds), generator=order)[:BATCH]
        optimizer.zero_grad()
        classified(network, last, clouds[index], labels[index]).backward()
        optimizer.step()
    found: dict[bool, list[tuple[float, float, list[Tensor]]]] = {False: [], True: []}
    exact: list[list[Tensor]] = []
    for number in range(ROUNDS):
        index = torch.arange(number * BATCH, (number + 1) * BATCH) % len(clouds)
        loss = partial(classified, network, last, clouds[index], labels[index])
        for every in found:
            with every_point(network) if every else nullcontext():
                found[every].append(measured(loss, parameters))
        exact.append(in_float64(network, last, clouds[index], labels[index]))
    few, all_of_them = found[False], found[True]
    off = [
        max(apart(one[2], true) for one, true in zip(way, exact, strict=True)) for way in (few, all_of_them)
    ]
    times = [[one[0] for one in way] for way in (few, all_of_them)]
    ratio = statistics.median(b / a for a, b in zip(*times, strict=True))
    held = [statistics.median(one[1] for one in way) for way in (few, all_of_them)]
    cells = [f"{statistics.median(way):.0f}" for way in times]
    return [name, *cells, f"{ratio:.1f}", *(f"{size:.0f}" for size in held), *(f"{one:.1g}" for one in off)]


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    clouds, synthetic = shapes(POINTS, 4)
    labels = torch.arange(40).repeat_interleave(4)
    assert synthetic and len(clouds) == len(labels)
    mixed = torch.randperm(len(clouds))
    rows = [row(name, make(), clouds[mixed].float(), labels[mixed]) for name, make in NETWORKS.items()]
    heads = (
        "network",
        *("ms, attaining points", "ms, every point", "ratio"),
        *("MB held, attaining points", "every point"),
        *("gradient off, attaining points", "every point"),
    )
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, ["---"] + ["---:"] * (len(heads) - 1), *rows)]
    text = f"""# A training step of networks for sets

Command: `python -m benchmarks.clouds.set_steps`. Forward and backward of {BATCH} clouds (synthetic CAD models),
float32, one thread, processor time, after {TRAINED} steps of training; medians of {ROUNDS} rounds, both ways in
each. Held: what autograd keeps until the backward pass, without the parameters. Off: the largest relative error of a
parameter's gradient, of all rounds, against float64 through every point; of parameters whose gradient is not
rounding alone.

{chr(10).join(lines)}

{machine("torch")}
"""
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
