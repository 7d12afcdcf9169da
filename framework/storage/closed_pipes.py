"""Output streams whose reader may end before the program, as in `... | head`; later output is then dropped."""

import io
import os
import stat
import sys
from contextlib import suppress
from typing import Any, final


@final
class DroppingWriter(io.FileIO):
    """Writer to a pipe or socket that drops the output once no process reads it any more.

    When the last reader has ended, the file descriptor of this writer is redirected to the null device. Child processes
    inherit the descriptor, so their output is dropped too, and they do not fail.
    """

    def write(self, data: Any, /) -> int | None:
        """Write the data, or drop them if no process reads the stream any more."""
        try:
            return super().write(data)
        except (BrokenPipeError, ConnectionResetError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.fileno())
            os.close(null)
            return len(data)


def survive_closed_pipes() -> None:
    """Let this process continue after the reader of its output has ended, so that `| head` does not end a training."""
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
    """Return whether a stream is a pipe or socket; files and terminals have no reader that could end."""
    try:
        mode = os.fstat(stream.fileno()).st_mode
    except (OSError, ValueError):
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)
