"""Readers for files that may be damaged or come from an untrusted source; every failure becomes a one-sentence error.

Only regular files are read. The size to which a file may decompress is limited by its own size (`room`), and the limit
is checked before anything is allocated.
"""

import io
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from framework.errors import DataError, UserError, shorten
from framework.storage import limits

RESTORE = "Restore it from its source."
SMALL, MOST_TIMES = limits.UNFOLDED_BYTES, limits.UNFOLDED_TIMES


@contextmanager
def guarded(
    file: Path, wanted: str, remedy: str = RESTORE, missing: str = "", kind: type[UserError] = DataError
) -> Iterator[None]:
    """Turn every exception that a damaged file causes inside the block into an error of class `kind`.

    A `UserError` keeps its class. Every message names the file.

    Args:
        file: File that is read in the block.
        wanted: Description of the expected content, such as "a MATLAB file".
        remedy: Advice for a damaged file.
        missing: Further text of the message for a missing file.
        kind: Class of the error.
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
        why = shorten(error) or type(error).__name__
        raise kind(f"{file}: cannot be read as {wanted} ({why}). {remedy}") from error


def opened(file: Path) -> "Bounded":
    """Open a regular file for reading; the caller closes it.

    Raises:
        OSError: The file is missing or is no regular file. A pipe could block for ever, and a device may never end.
    """
    stream = Bounded(io.FileIO(file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK)))
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError("no regular file")
    return stream


class Bounded(io.BufferedReader):
    """File whose `read` never asks for more bytes than the file still has.

    Python allocates the requested size before it reads. A chunk of an image or a text of a pickle can announce 4 GB in
    four bytes.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            return super().read()
        return super().read(min(size, max(0, os.fstat(self.fileno()).st_size - self.tell())))


def read_bytes(file: Path) -> bytes:
    """Return the whole content of a file; raises the errors of `opened`."""
    with opened(file) as stream:
        return stream.read()


def room(size: int) -> int:
    """Return the number of bytes to which a compressed file of `size` bytes may decompress."""
    return max(SMALL, MOST_TIMES * size)


def require_numbers(numbers: int, small: int, size: int) -> None:
    """Refuse a file that decompresses to more than `small` numbers and to more numbers than its `size` in bytes.

    A number of one byte takes eight bytes in computations, and a file of zeros decompresses to a thousand times its
    size.

    Raises:
        ValueError: There are more numbers than that; the message states how many.
    """
    if numbers > max(small, size):
        raise ValueError(f"it unfolds to {numbers} numbers; at most {max(small, size)} in {size} bytes")


def inflated(data: bytes, most: int, *, part: bool = False) -> bytes:
    """Return the decompressed bytes of zlib or gzip data.

    Args:
        data: Compressed bytes.
        most: Largest number of decompressed bytes.
        part: Return the first `most` bytes only, and accept more of them and a missing end.

    Raises:
        ValueError: The data are cut short, or decompress to more than `most` bytes.
        zlib.error: The data are damaged.
    """
    unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)  # accept the header of zlib or of gzip
    found = unpacker.decompress(data, most if part else most + 1)
    if not part and (len(found) > most or not unpacker.eof):
        raise ValueError(f"what is compressed is cut short, or unfolds to more than {most} bytes")
    return found
