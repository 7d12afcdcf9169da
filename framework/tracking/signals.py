"""Handling of Ctrl-C, SIGTERM, a closed terminal and a dead parent: stop at a safe point with a matching exit code."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

CLOSED = getattr(signal, "SIGHUP", None)
"""Signal for a closed terminal; None on a system without it."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, *([CLOSED] if CLOSED else []))
ENDING = 6.0
"""Seconds in which a process must end by itself after its parent has died or after it can no longer continue."""
_LIBRARY = ctypes.CDLL(None) if sys.platform == "linux" else None  # not loaded between fork and exec
_SET_PARENT_DEATH, _GET_PARENT_DEATH = 1, 2  # constants of prctl.h


def handled_signals() -> tuple[signal.Signals, ...]:
    """Return the signals to handle: SIGINT, SIGTERM and, unless the process ignores it (as under nohup), SIGHUP."""
    return tuple(
        number for number in SIGNALS if number != CLOSED or signal.getsignal(number) is not signal.SIG_IGN
    )


@contextmanager
def collected_signals() -> Iterator[list[int]]:
    """Collect signals inside the `with` block; yield the list to which the number of each received signal is added."""
    received: list[int] = []
    numbers = handled_signals()
    before = [signal.signal(number, lambda number, frame: received.append(number)) for number in numbers]
    try:
        yield received
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


class Stopped(SystemExit):
    """Exception for a run that a signal stops; the process exits with 128 + the signal's number, as in shells."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class Stopper:
    """Handler that raises `Stopped` for SIGINT, SIGTERM and SIGHUP.

    The first signal raises the exception immediately or, if the attribute `wait` is True, only when the code calls
    `stop`. A second signal raises the exception immediately in any case.
    """

    def __init__(self) -> None:
        self.wait = False
        self.received: int | None = None

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Handle the signals inside the block, and restore the earlier handlers after it."""
        before = {number: signal.getsignal(number) for number in SIGNALS}
        self.install()
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def install(self) -> None:
        """Install the handlers, or install them again after other code has replaced them."""
        for number in handled_signals():
            signal.signal(number, self._handle)

    def stop(self) -> NoReturn:
        """Raise `Stopped` for the received signal, or for SIGTERM if only another rank has received a signal."""
        raise Stopped(self.received or signal.SIGTERM)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        first = self.received is None
        self.received = self.received or number
        if not (self.wait and first):
            raise Stopped(number)


def end_with_parent(number: int = signal.SIGTERM) -> Callable[[], None]:
    """Return a function that a new child process must call first, so that it gets a signal when this process dies.

    This works on Linux only; elsewhere the child continues to run. Start the child in the main thread, because the
    signal is sent when the starting thread ends.
    """
    parent = os.getpid()

    def begin() -> None:
        if _LIBRARY is not None:
            _LIBRARY.prctl(_SET_PARENT_DEATH, number)
            if os.getppid() != parent:  # the parent died before the call
                os.kill(os.getpid(), number)

    return begin


def ends_with_parent() -> bool:
    """Return whether this process gets a signal when its parent dies (Linux)."""
    number = ctypes.c_int(0)
    return (
        _LIBRARY is not None
        and _LIBRARY.prctl(_GET_PARENT_DEATH, ctypes.byref(number)) == 0
        and number.value != 0
    )
