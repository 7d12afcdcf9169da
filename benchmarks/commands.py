"""Commands of the framework that a benchmark runs, in the project's folder."""

import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from framework.tracking.signals import SIGNALS, end_with_parent

ROOT = Path(__file__).resolve().parent.parent


def carry_out(command: Sequence[str]) -> None:
    """Run it to its end, however long it takes to stop where it is told to.

    Ctrl-C, SIGTERM and the closing of a terminal are passed on to it, once each: it has a process group of its own,
    since from a terminal it would get them a second time, which hurries it. `subprocess.run` kills what has not ended
    a quarter of a second after Ctrl-C, and on SIGTERM leaves a sweep to itself. Where this process is killed, the
    command gets SIGTERM (Linux).

    Raises:
        SystemExit: it was told to stop; with the exit code that shells give.
        subprocess.CalledProcessError: it failed.
    """
    numbers = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    received: list[int] = []
    early: list[int] = []
    started: list[subprocess.Popen[bytes]] = []

    def passed_on(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if started:
            started[0].send_signal(number)
        else:
            early.append(number)

    before = {number: signal.signal(number, passed_on) for number in numbers}
    try:
        started.append(subprocess.Popen(command, cwd=ROOT, process_group=0, preexec_fn=end_with_parent()))
        for number in early:
            started[0].send_signal(number)
        code = started[0].wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if received:
        raise SystemExit(128 + received[0])
    if code:
        raise subprocess.CalledProcessError(code, command)
