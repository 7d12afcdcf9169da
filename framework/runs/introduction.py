"""First lines of a command's output: its inputs, its target, the samples left out, and the number of threads."""

import os
from collections.abc import Mapping, Sequence, Sized
from typing import NamedTuple

import torch
from rich.console import Console

from framework.configuration.description import Description
from framework.data import Data, Splits
from framework.errors import shorten
from framework.target import Target

MOST = 12
"""Largest number of names that a line lists."""
BUSY = 1.0
"""Smallest load of the machine at which the output states the load (`Cores.load`)."""


def introduce(data: Data, console: Console) -> None:
    """Print the inputs, the target, the numbers of samples and the remarks of prepared data."""
    print_lines(lines(data), console)


def introduce_threads(chosen: int | None, console: Console) -> None:
    """Print the number of threads that compute, and the reason for the number.

    Args:
        chosen: Value of the setting `threads`.
        console: Console to print on.
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    cores = Cores(allowed, os.cpu_count() or allowed, load)
    print_lines([threads_line(torch.get_num_threads(), chosen, cores, os.environ)], console)


def introduce_model(description: Description, method: str, data: Data | None, console: Console) -> None:
    """Print what a stored model predicts, and on which data it is used.

    Args:
        description: Description of the model.
        method: Name of the model in tables.
        data: Prepared data; None if only files of the user are read.
        console: Console to print on.
    """
    trained_on = shorten(description.config["data"]["name"]) + " (synthetic)" * description.synthetic
    heading = [
        f"model: {shorten(method)}, trained on {trained_on}",
        f"predicts {describe_target(description.target)}",
    ]
    print_lines([*heading, *([] if data is None else _samples(data)), *description.remarks], console)


def lines(data: Data) -> list[str]:
    """Return the first lines of a run's output: inputs, target, numbers of samples, and remarks on the data."""
    read = (
        _list_names(data.columns)
        if data.columns
        else f"inputs of shape {'×'.join(map(str, data.input_shape))}"
    )
    return [f"reads {read}", f"predicts {describe_target(data.target)}", *_samples(data)]


class Cores(NamedTuple):
    """Processor cores of a machine.

    Attributes:
        allowed: Number of cores that this process may use.
        all: Number of cores of the machine.
        load: Average number of processes that ran or waited for a core during the last minute.
    """

    allowed: int
    all: int
    load: float


def threads_line(threads: int, chosen: int | None, cores: Cores, environment: Mapping[str, str]) -> str:
    """Return a line with the number of threads that compute, and the reason for the number.

    Args:
        threads: Number of threads that PyTorch uses.
        chosen: Value of the setting `threads`.
        cores: Processor cores of this machine.
        environment: Environment variables of this process.
    """
    cores_text = "1 core" if cores.allowed == 1 else f"{cores.allowed} cores"
    limited = f" that this process may use of the machine's {cores.all}" * (cores.allowed < cores.all)
    names = [name for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS") if environment.get(name)]
    if chosen is not None:
        reason = f"as threads={chosen} says"
    elif names:
        reason = f"as {names[0]}={shorten(environment[names[0]], 20)} says, which a sweep sets for each of its jobs"
    else:
        reason = "one for each core; threads=1 sets another number"
    busy = f"; the machine's load was {cores.load:.1f} in the last minute" * (cores.load >= BUSY)
    return f"threads: {threads} on {cores_text}{limited}, {reason}{busy}"


def describe_target(target: Target) -> str:
    """Return a description of a target in words."""
    if target.kind == "class":
        return f"one of {len(target.names)} classes: {_list_names(target.names)}"
    if target.kind == "image":
        return f"images of {'×'.join(map(str, target.size))} pixels"
    return f"{'angles' if target.kind == 'angle' else 'numbers'}: {_list_names(target.names)}"


def _samples(data: Data) -> list[str]:
    """Return a line with the number of samples of each split, and the lines of `Data.remarks`."""
    sizes = [
        f"{name} {len(part)}"
        for name, part in zip(Splits._fields, data.splits(), strict=True)
        if isinstance(part, Sized)
    ]
    skipped = f", {data.skipped} left out" if data.skipped else ""
    return [f"samples: {', '.join(sizes)}{skipped}", *(shorten(remark, 1000) for remark in data.remarks)]


def print_lines(texts: Sequence[str], console: Console) -> None:
    """Print texts, one line each, without wrapping and without markup."""
    for line in texts:
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def _list_names(names: Sequence[str]) -> str:
    rest = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return shorten(", ".join(names[:MOST]), 400) + rest
