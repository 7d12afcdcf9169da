"""Ctrl-C, SIGTERM, a closed terminal, a parent that dies: stop where it is safe, and say so in the exit code."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

CLOSED = getattr(signal, "SIGHUP", None)
"""That the terminal was closed; None on a system that has none."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, *([CLOSED] if CLOSED else []))
ENDING = 6.0
"""Seconds that a process has to end by itself once its parent has died, or once it can no longer go on."""
_LIBRARY = ctypes.CDLL(None) if sys.platform == "linux" else None  # not loaded between fork and exec
_SET_PARENT_DEATH, _GET_PARENT_DEATH = 1, 2  # of prctl.h


def handled() -> tuple[signal.Signals, ...]:
    """All of them, but for the closing of a terminal where that is ignored, as under nohup."""
    return tuple(one for one in SIGNALS if one != CLOSED or signal.getsignal(one) is not signal.SIG_IGN)


class Stopped(SystemExit):
    """The run was told to stop; exits with 128 + the signal's number, as shells do."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class Stopper:
    """Turns SIGINT, SIGTERM and SIGHUP into `Stopped`: at once, or, while `wait` is set, where the code calls `stop`.

    A second signal never waits.
    """

    def __init__(self) -> None:
        self.wait = False
        self.received: int | None = None

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Handle the signals inside the block; the handlers before are restored after it."""
        before = {number: signal.getsignal(number) for number in SIGNALS}
        self.install()
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def install(self) -> None:
        """Handle the signals, whoever has handled them since."""
        for number in handled():
            signal.signal(number, self._handle)

    def stop(self) -> NoReturn:
        """Stop now for the signal received, by this process or by another rank of it."""
        raise Stopped(self.received or signal.SIGTERM)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        first = self.received is None
        self.received = self.received or number
        if not (self.wait and first):
            raise Stopped(number)


def ending_with_parent(number: int = signal.SIGTERM) -> Callable[[], None]:
    """Return what a new child of this process calls before anything else, to get a signal when this one dies.

    Linux; elsewhere the child runs on. Start the child in the main thread: the signal comes when that thread ends.
    """
    parent = os.getpid()

    def begin() -> None:
        if _LIBRARY is not None:
            _LIBRARY.prctl(_SET_PARENT_DEATH, number)
            if os.getppid() != parent:  # it died before that could be asked for
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
