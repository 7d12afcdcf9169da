"""Running commands of the framework from a benchmark script, in the project's folder."""

import argparse
import os
import resource
import signal
import subprocess
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import FrameType

from framework.tracking.signals import SIGNALS, end_with_parent

ROOT = Path(__file__).resolve().parent.parent


def carry_out(command: Sequence[str]) -> None:
    """Run a command to its end and forward every stop signal to it.

    Ctrl-C, SIGTERM and the closing of a terminal are forwarded once each. After a signal, the command may take any
    time to stop. It has a process group of its own, because the terminal would otherwise send it the same signal a
    second time, and a second signal makes a run stop without finishing its work. `subprocess.run` is not suitable: it
    kills the command a quarter of a second after Ctrl-C, and on SIGTERM it leaves a sweep running. If this process is
    killed, the command gets SIGTERM (on Linux only).

    Raises:
        SystemExit: a signal was received; the exit code is that of shells, 128 + the signal's number.
        subprocess.CalledProcessError: the command failed.
    """
    numbers = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    received: list[int] = []
    pending: list[int] = []
    processes: list[subprocess.Popen[bytes]] = []

    def forward(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if processes:
            processes[0].send_signal(number)
        else:
            pending.append(number)

    handlers = {number: signal.signal(number, forward) for number in numbers}
    try:
        processes.append(subprocess.Popen(command, cwd=ROOT, process_group=0, preexec_fn=end_with_parent()))
        for number in pending:
            processes[0].send_signal(number)
        code = processes[0].wait()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if received:
        raise SystemExit(128 + received[0])
    if code:
        raise subprocess.CalledProcessError(code, command)


def timed_command(command: Sequence[str]) -> tuple[float, float]:
    """Run a command (`carry_out`); return its wall time and its processor time with all its processes, seconds."""
    before, start = children_seconds(), time.perf_counter()
    carry_out(command)
    return time.perf_counter() - start, children_seconds() - before


def children_seconds() -> float:
    """Return the processor time of all child processes that have ended, seconds."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def parse_step(description: str | None, steps: Iterable[str], folder_help: str) -> tuple[str, Path]:
    """Return the step of a measurement that the command line names, and its folder; set one thread for all commands."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help=folder_help)
    parser.add_argument("step", choices=tuple(steps))
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    return options.step, options.folder.absolute()
