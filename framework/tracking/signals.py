"""Ctrl-C, SIGTERM and a terminal that is closed: stop where it is safe, and say so in the exit code."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

CLOSED = getattr(signal, "SIGHUP", None)
"""That the terminal was closed; None on a system that has none."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, *([CLOSED] if CLOSED else []))


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
