"""Reads files that may be damaged or a stranger's: regular ones, within bounds; what goes wrong is one sentence.

What a file may unfold to is bounded by its size, before anything is allocated: `room`.
"""

import io
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from framework.errors import DataError, UserError, shown
from framework.storage import limits

RESTORE = "Restore it from its source."
SMALL, MOST_TIMES = limits.UNFOLDED_BYTES, limits.UNFOLDED_TIMES


@contextmanager
def guarded(
    file: Path, wanted: str, remedy: str = RESTORE, missing: str = "", kind: type[UserError] = DataError
) -> Iterator[None]:
    """Everything that damage leads a library to becomes an error of one `kind`, a UserError stays; all name the file.

    Args:
        wanted: what the file should be, "a MATLAB file" say.
        remedy: what to do about a damaged file.
        missing: what to say of one that is not there, beside that.
    """
    try:
        yield
    except UserError as error:
        if str(file) in str(error):
            raise
        raise type(error)(f"{file}: {error}") from error
    except Exception as error:
        if isinstance(error, FileNotFoundError) and not file.exists():
            raise kind(f"{file}: no such file; {missing or f'wanted {wanted}. Mend the path.'}") from None
        why = shown(error) or type(error).__name__
        raise kind(f"{file}: cannot be read as {wanted} ({why}). {remedy}") from error


def opened(file: Path) -> "Bounded":
    """A file to read; whoever asks closes it.

    Raises:
        OSError: it is missing, or no regular file: a pipe could block for ever, a device go on without end.
    """
    stream = Bounded(io.FileIO(file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK)))
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError("no regular file")
    return stream


class Bounded(io.BufferedReader):
    """A file of which no more is read than it has: Python allocates what is asked for before it reads.

    A chunk of an image, or a text of a pickle, announces 4 GB in four bytes.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            return super().read()
        return super().read(min(size, max(0, os.fstat(self.fileno()).st_size - self.tell())))


def read_bytes(file: Path) -> bytes:
    """All of a file; errors as `opened`."""
    with opened(file) as stream:
        return stream.read()


def room(size: int) -> int:
    """Bytes that a compressed file of `size` bytes may unfold to."""
    return max(SMALL, MOST_TIMES * size)


def require_numbers(numbers: int, small: int, size: int) -> None:
    """Refuse what unfolds to more than `small` numbers, and to more than the `size` of its file in bytes.

    A number of one byte takes eight when it is computed with, and files of zeros unfold a thousandfold.

    Raises:
        ValueError: says how many.
    """
    if numbers > max(small, size):
        raise ValueError(f"it unfolds to {numbers} numbers; at most {max(small, size)} in {size} bytes")


def inflated(data: bytes, most: int, *, part: bool = False) -> bytes:
    """What zlib or gzip compressed; `part`: the first `most` bytes of it will do.

    Raises:
        ValueError: it is cut short, or more than `most` bytes.
        zlib.error: it is damaged.
    """
    unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)  # either header
    found = unpacker.decompress(data, most if part else most + 1)
    if not part and (len(found) > most or not unpacker.eof):
        raise ValueError(f"what is compressed is cut short, or unfolds to more than {most} bytes")
    return found
