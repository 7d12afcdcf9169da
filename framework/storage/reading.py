"""Readers for files that may be damaged or come from an untrusted source; every failure becomes a one-sentence error.

Only regular files are read. The size to which a file may decompress is limited by its own size (`most_decompressed`),
and the limit is checked before anything is allocated.
"""

import errno
import io
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from framework.errors import DataError, UserError, shorten
from framework.storage import limits
from framework.storage.enclosed import require_inside_data

RESTORE = "Copy the file again from its source."
AT_ONCE = 2**16
"""Largest number of bytes that `Bounded.read` requests without comparing it with the size of the file."""
SMALL, MOST_TIMES = limits.UNFOLDED_BYTES, limits.UNFOLDED_TIMES


@contextmanager
def translate_errors(
    file: Path, expected: str, remedy: str = RESTORE, missing: str = "", kind: type[UserError] = DataError
) -> Iterator[None]:
    """Convert every exception that a damaged file causes inside the block to an error of class `kind`.

    A `UserError` keeps its class. Every message contains the name of the file.

    Args:
        file: File that is read in the block.
        expected: Description of the expected content, such as "a MATLAB file".
        remedy: Advice for a damaged file.
        missing: End of the message for a missing file, after "no such file; ".
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
            raise kind(
                f"{file}: no such file; {missing or f'expected {expected}. Correct the path.'}"
            ) from None
        if isinstance(error, IsADirectoryError):
            raise kind(
                f"{file}: cannot be read as {expected}, because it is a folder. Name a file."
            ) from None
        why = shorten(error) or type(error).__name__
        raise kind(f"{file}: cannot be read as {expected} ({why}). {remedy}") from error


def open_regular(file: Path) -> "Bounded":
    """Open a regular file for reading; the caller closes it.

    Raises:
        OSError: The file is missing or is not a regular file. Reading a pipe or a device might never end.
        ValueError: The file is sparse, and has far more bytes than are stored.
        DataError: The file is reached by a link that leads out of a data folder.
    """
    require_inside_data(file)
    stream = Bounded(io.FileIO(file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK)))
    try:
        if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
            raise OSError("the path is not a regular file")
        require_stored(stream.fileno())
    except BaseException:
        stream.close()
        raise
    return stream


def require_stored(descriptor: int) -> None:
    """Refuse an open file that is sparse and has far more bytes than are stored.

    An archive of a kilobyte can contain a sparse file of a terabyte, which takes almost no space on the disk. Reading
    it would take a terabyte of memory.

    Raises:
        ValueError: The file has more bytes than `most_decompressed` allows for its stored bytes.
    """
    status = os.fstat(descriptor)
    if status.st_size <= most_decompressed(512 * status.st_blocks):
        return
    stored, end, position = 0, 0, os.lseek(descriptor, 0, os.SEEK_CUR)
    try:
        # `st_blocks` alone is not enough: some network file systems leave it 0, and report a file without holes
        while status.st_size > most_decompressed(stored):
            start = os.lseek(descriptor, end, os.SEEK_DATA)
            end = os.lseek(descriptor, start, os.SEEK_HOLE)
            stored += end - start
    except OSError as error:
        if error.errno != errno.ENXIO:  # not ENXIO (no data follow): the holes are not known
            return
        raise ValueError(
            f"the file is sparse: of its {status.st_size} bytes only {stored} are stored, but at least one in "
            f"{MOST_TIMES} is required. Copy it with `cp --sparse=never` if the zeros are data"
        ) from None
    finally:
        os.lseek(descriptor, position, os.SEEK_SET)


class Bounded(io.BufferedReader):
    """File whose `read` never requests more bytes than the file still has.

    Python allocates the requested size before it reads, and a damaged image or pickle can state a size of 4 GB in four
    bytes.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            return super().read()
        if size <= AT_ONCE:  # Pillow reads a JPEG file without markers byte by byte
            return super().read(size)
        return super().read(min(size, max(0, os.fstat(self.fileno()).st_size - self.tell())))


def read_bytes(file: Path) -> bytes:
    """Return the whole content of a regular file; raises the errors of `open_regular`."""
    with open_regular(file) as stream:
        return stream.read()


def most_decompressed(size: int) -> int:
    """Return the number of bytes to which a compressed file of `size` bytes may decompress."""
    return max(SMALL, MOST_TIMES * size)


def require_numbers(numbers: int, small: int, size: int) -> None:
    """Refuse a file of `size` bytes that decompresses to more than max(`small`, `size`) numbers.

    A number of one byte takes eight bytes in computations, and a file of zeros decompresses to a thousand times its
    size.

    Raises:
        ValueError: The file decompresses to more numbers; the message states how many.
    """
    if numbers > max(small, size):
        raise ValueError(
            f"the file decompresses to {numbers} numbers, but at most {max(small, size)} are allowed for {size} bytes"
        )


def inflate(data: bytes, most: int, *, part: bool = False) -> bytes:
    """Return the decompressed bytes of zlib or gzip data.

    Args:
        data: Compressed bytes.
        most: Largest number of decompressed bytes.
        part: Whether to return the first `most` bytes only, and to accept data that are longer or cut short.

    Raises:
        ValueError: The data are cut short, or decompress to more than `most` bytes.
        zlib.error: The data are damaged.
    """
    unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)  # accept the header of zlib or of gzip
    content = unpacker.decompress(data, most if part else most + 1)
    if not part and (len(content) > most or not unpacker.eof):
        raise ValueError(f"the compressed data are cut short, or decompress to more than {most} bytes")
    return content
