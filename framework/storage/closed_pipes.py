"""Streams whose reader may end first, as in `... | head`: what is written to nobody is dropped."""

import io
import os
import stat
import sys
from contextlib import suppress
from typing import Any, final


@final
class DroppingWriter(io.FileIO):
    """A pipe or socket that is written to as long as somebody reads it.

    Then its descriptor becomes that of the null device, so that child processes lose nothing but their output, too.
    """

    def write(self, data: Any, /) -> int | None:
        """Write, or drop where nobody reads any more."""
        try:
            return super().write(data)
        except (BrokenPipeError, ConnectionResetError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.fileno())
            os.close(null)
            return len(data)


def survive_closed_pipes() -> None:
    """Let this process go on where the reader of its output ends: a training is not over when `head` is."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and _is_pipe(stream):
            with suppress(OSError):
                stream.flush()
            raw = DroppingWriter(stream.fileno(), "wb", closefd=False)
            text = io.TextIOWrapper(
                io.BufferedWriter(raw),
                encoding=stream.encoding,
                errors=stream.errors,
                line_buffering=stream.line_buffering,
                write_through=stream.write_through,
            )
            setattr(sys, name, text)


def _is_pipe(stream: io.TextIOWrapper) -> bool:
    """Return whether a stream leads to another process: files and terminals have no reader that ends."""
    try:
        mode = os.fstat(stream.fileno()).st_mode
    except (OSError, ValueError):
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)
