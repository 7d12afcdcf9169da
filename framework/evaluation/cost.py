"""The cost of a prediction: run time, FLOPs, parameters and memory on this machine."""

import ctypes
import math
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

REPEATS, SHORT_TEST_REPEATS = 20, 3
"""Number of timed calls of a prediction, in general and in a short test run (`Settings.is_short_test`)."""


@dataclass(frozen=True)
class Cost:
    """Cost of one prediction.

    Attributes:
        milliseconds_per_sample: median wall time of a batch divided by its size.
        latency_milliseconds: median wall time of a batch of one.
        flops_per_sample: floating-point operations of matrix products, convolutions and attention; one multiply-add
            counts as two. Element-wise and special functions, normalisation, pooling, sorting, random numbers, compiled
            graphs, and everything outside torch are not counted. So 0 means that no operation of a counted kind ran,
            not that the prediction took no time. None if `parameters` is None.
        parameters: number of parameters of the predictor, as the caller counted them. None if the predictor
            does not compute with torch (trees); then neither parameters nor FLOPs can be counted.
        peak_memory_mib: largest growth of memory during one call on the batch, MiB; weights and inputs exist before the
            call and are not included. On a CPU it is resident memory, on CUDA allocated memory. NaN if the system does
            not report it (a CPU without Linux's /proc or without glibc).
        batch_size: number of samples in the batch.
        device: the device, e.g. "cpu (AMD EPYC)".
        threads: number of CPU threads that torch used for one operation.
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
    repeats: int = REPEATS,
    budget_seconds: float = 5.0,
) -> Cost:
    """Return the cost of `predict` on a batch of inputs.

    The states of torch's global random generators are restored afterwards.

    Args:
        predict: function to measure, which returns what a user needs, such as the density and the point prediction; it
            is called without gradient.
        inputs: a batch, whose first dimension is the sample, on the device to measure.
        parameters: number of parameters, which is copied into the result; None if `predict` does not compute with
            torch, and FLOPs are not counted then.
        repeats: number of timed calls with the batch, and with a batch of one.
        budget_seconds: if `repeats` calls would take longer than this, fewer calls are timed, but at least three.

    Raises:
        ValueError: the batch is empty, or `repeats` or `budget_seconds` is not positive.
    """
    if inputs.dim() == 0 or len(inputs) == 0:
        raise ValueError(
            f"Got inputs of shape {tuple(inputs.shape)}, but a batch of at least one sample is required to measure "
            "the cost. Give a batch of the data."
        )
    device = inputs.device
    size = len(inputs)
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        half = budget_seconds / 2
        batch_seconds = wall_time(lambda: predict(inputs), device, repeats=repeats, budget_seconds=half)
        single_seconds = wall_time(lambda: predict(inputs[:1]), device, repeats=repeats, budget_seconds=half)
        flops = None if parameters is None else count_flops(lambda: predict(inputs))
        memory = peak_memory(lambda: predict(inputs), device)
    return Cost(
        milliseconds_per_sample=1e3 * batch_seconds / size,
        latency_milliseconds=1e3 * single_seconds,
        flops_per_sample=None if flops is None else round(flops / size),
        parameters=parameters,
        peak_memory_mib=memory / 2**20,
        batch_size=size,
        device=device_name(device),
        threads=torch.get_num_threads(),
    )


def count_flops(call: Callable[[], object]) -> int:
    """Return the number of floating-point operations of `call`, as torch counts them (see `Cost`)."""
    from torch.utils import flop_counter  # only measurements need it

    # torch excludes the counter from compilation, and imports its compiler for that, which takes a second. If nothing
    # has been compiled yet, the counter is marked as excluded already.
    counting = getattr(flop_counter._FlopCounterMode.__torch_dispatch__, "__wrapped__", None)
    if counting is not None and "torch._dynamo" not in sys.modules:
        vars(counting).setdefault("__dynamo_disable", counting)
    counter = flop_counter.FlopCounterMode(display=False)
    with counter:
        call()
    return counter.get_total_flops()


def wall_time(
    call: Callable[[], object], device: torch.device, *, repeats: int = REPEATS, budget_seconds: float = 5.0
) -> float:
    """Return the median wall time of `call` in seconds, after two warm-up calls.

    Up to `repeats` calls are timed. Timing stops earlier when `budget_seconds` are over, but not before the third call.
    The time of a call ends when `device`, on which it computes, has finished.
    """
    if repeats < 1 or not budget_seconds > 0:
        raise ValueError(
            f"Got repeats = {repeats} and budget_seconds = {budget_seconds}, but repeats must be at least 1 and "
            "budget_seconds above 0. Raise them."
        )
    start = time.perf_counter()
    for _ in range(2):
        time_call(call, device)
    times: list[float] = []
    while len(times) < min(3, repeats) or (
        len(times) < repeats and time.perf_counter() - start < budget_seconds
    ):
        times.append(time_call(call, device))
    return statistics.median(times)


def time_call(call: Callable[[], object], device: torch.device) -> float:
    """Return the wall time of one call in seconds, including the time until the device has finished."""
    _finish(device)
    start = time.perf_counter()
    call()
    _finish(device)
    return time.perf_counter() - start


def peak_memory(call: Callable[[], object], device: torch.device) -> float:
    """Return the largest growth of memory during one call, bytes; NaN if it cannot be measured."""
    if device.type == "cuda":
        _finish(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        call()
        _finish(device)
        return float(torch.cuda.max_memory_allocated(device) - before)
    if device.type != "cpu" or not Path("/proc/self/clear_refs").exists():
        return math.nan
    # Return free pages to the system; otherwise the call would reuse them, and resident memory would not grow.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        return math.nan
    trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak of resident memory: proc(5)
    except OSError:  # a container may forbid it
        return math.nan
    before = _resident_peak()
    call()
    return _resident_peak() - before


def device_name(device: torch.device) -> str:
    """Return the kind and model of a device, e.g. "cuda (NVIDIA H200)"."""
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
    """Return the peak of resident memory since its last reset, bytes; NaN if the system does not report it."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return 1024.0 * int(line.split()[1])
    return math.nan


def _finish(device: torch.device) -> None:
    """Wait until a device that works asynchronously has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
