"""What a prediction costs: run time, FLOPs, parameters and memory, measured on the machine at hand."""

import ctypes
import math
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode


@dataclass(frozen=True)
class Cost:
    """What one prediction costs.

    Attributes:
        milliseconds_per_sample: median wall time of a batch divided by its size.
        latency_milliseconds: median wall time of a batch of one.
        flops_per_sample: floating-point operations of matrix products, convolutions and attention, one
            multiply-add counted as two. Not counted: element-wise and special functions, normalisation,
            pooling, sorting, random numbers, compiled graphs, and what runs outside torch; 0 says that
            nothing of the first kind ran, not that the work was free. None where `parameters` is.
        parameters: numbers the predictor holds, as the caller counted them; None where what it has learned is no
            numbers that torch computes with (trees), so that neither they nor FLOPs can be counted.
        peak_memory_mib: the most memory one call on the batch held beyond what was held before it, MiB:
            neither weights nor inputs are in it. On a CPU the growth of resident memory, on CUDA of
            allocated memory; NaN where the system does not tell (a CPU without Linux's /proc or without
            glibc).
        batch_size: samples in the batch.
        device: what it ran on, e.g. "cpu (AMD EPYC)".
        threads: CPU threads torch used for one operation.
    """

    milliseconds_per_sample: float
    latency_milliseconds: float
    flops_per_sample: int | None
    parameters: int | None
    peak_memory_mib: float
    batch_size: int
    device: str
    threads: int


@torch.no_grad()
def measure(
    predict: Callable[[Tensor], object],
    inputs: Tensor,
    *,
    parameters: int | None,
    repeats: int = 20,
    budget_seconds: float = 5.0,
) -> Cost:
    """The cost of `predict` on a batch of inputs.

    Args:
        predict: what a user waits for, the density and the point prediction, say; without gradient.
        inputs: a batch, first dimension the samples, on the device to measure.
        parameters: to be reported beside; None as of `Cost`.
        repeats: timed calls of the batch, and of the batch of one.
        budget_seconds: where `repeats` calls would take longer than this, fewer are timed; three at least.

    Random numbers drawn by `predict` leave torch's global generators as they were.

    Raises:
        ValueError: an empty batch, or `repeats` or `budget_seconds` not positive.
    """
    if inputs.dim() == 0 or len(inputs) == 0:
        raise ValueError(
            f"wanted a batch of at least one sample to measure, got inputs of shape {tuple(inputs.shape)}."
        )
    device = inputs.device
    size = len(inputs)
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        half = budget_seconds / 2
        batch_seconds = wall_time(lambda: predict(inputs), device, repeats=repeats, budget_seconds=half)
        single_seconds = wall_time(lambda: predict(inputs[:1]), device, repeats=repeats, budget_seconds=half)
        counter = FlopCounterMode(display=False)
        with counter:
            predict(inputs)
        memory = peak_memory(lambda: predict(inputs), device)
    return Cost(
        milliseconds_per_sample=1e3 * batch_seconds / size,
        latency_milliseconds=1e3 * single_seconds,
        flops_per_sample=None if parameters is None else round(counter.get_total_flops() / size),
        parameters=parameters,
        peak_memory_mib=memory / 2**20,
        batch_size=size,
        device=device_name(device),
        threads=torch.get_num_threads(),
    )


def wall_time(
    call: Callable[[], object], device: torch.device, *, repeats: int = 20, budget_seconds: float = 5.0
) -> float:
    """Median wall time of `call` after two calls to warm up, seconds.

    Three calls are timed at least, then no more than fit in `budget_seconds`, and `repeats` at most.
    """
    if repeats < 1 or not budget_seconds > 0:
        raise ValueError(f"wanted repeats >= 1 and budget_seconds > 0, got {repeats} and {budget_seconds}.")
    start = time.perf_counter()
    for _ in range(2):
        seconds(call, device)
    taken: list[float] = []
    while len(taken) < min(3, repeats) or (
        len(taken) < repeats and time.perf_counter() - start < budget_seconds
    ):
        taken.append(seconds(call, device))
    return statistics.median(taken)


def seconds(call: Callable[[], object], device: torch.device) -> float:
    """Wall time of one call, until the device has finished, seconds."""
    _finish(device)
    start = time.perf_counter()
    call()
    _finish(device)
    return time.perf_counter() - start


def peak_memory(call: Callable[[], object], device: torch.device) -> float:
    """The most memory one call holds beyond what is held before it, bytes; NaN where nothing tells."""
    if device.type == "cuda":
        _finish(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        call()
        _finish(device)
        return float(torch.cuda.max_memory_allocated(device) - before)
    if device.type != "cpu" or not Path("/proc/self/clear_refs").exists():
        return math.nan
    # Pages that the allocator kept from earlier calls would be filled again without growth: give them back.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        return math.nan
    trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the resident peak starts anew: proc(5)
    except OSError:  # a container may forbid it
        return math.nan
    before = _resident_peak()
    call()
    return _resident_peak() - before


def device_name(device: torch.device) -> str:
    """Kind and model of a device, e.g. "cuda (NVIDIA H200)"."""
    if device.type == "cuda":
        return f"cuda ({torch.cuda.get_device_name(device)})"
    if device.type != "cpu":
        return device.type
    information = Path("/proc/cpuinfo")
    models = [
        line.partition(":")[2].strip()
        for line in (information.read_text().splitlines() if information.exists() else [])
        if line.startswith("model name")
    ]
    return f"cpu ({models[0] if models else platform.machine()})"


def _resident_peak() -> float:
    """The most memory that was resident since the peak was last reset, bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return 1024.0 * int(line.split()[1])
    return math.nan


def _finish(device: torch.device) -> None:
    """Wait until a device that works asynchronously is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
