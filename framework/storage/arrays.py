"""Readers for NumPy files that may be damaged.

The readers allocate memory only in proportion to the size of the file, and they never unpickle objects.
"""

import io
import math
import mmap
import os
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from numpy.lib import format as layout
from numpy.typing import NDArray

from framework.errors import shorten
from framework.storage.enclosed import read_stream
from framework.storage.reading import most_decompressed, require_stored

MAGIC = b"\x93NUMPY"
HEADERS = {(1, 0): layout.read_array_header_1_0, (2, 0): layout.read_array_header_2_0}
KINDS = "biufcUS"


def read_npy(content: bytes) -> NDArray:
    """Return the array of numbers or texts in an .npy file.

    Raises:
        ValueError: The bytes are no .npy file, are damaged, or contain Python objects or records.
    """
    stream = io.BytesIO(content)
    shape, order, kind = _read_header(stream, len(content))
    count = math.prod(shape)
    if not count:
        return np.empty(shape, kind)
    return np.frombuffer(content, kind, count, stream.tell()).reshape(shape, order=order).copy(order)


def map_npy(path: Path) -> NDArray:
    """Return the array in an .npy file as a private memory map.

    The pages of the file are read when they are used. Writing to the array does not change the file. The file must not
    be shortened while the array is in use.

    Raises:
        ValueError: The file is no .npy file, is damaged or sparse, or contains Python objects or records.
        DataError: The file is a link or no regular file (`framework.storage.enclosed`).
        OSError: The file cannot be opened.
    """
    with read_stream(path) as stream:
        require_stored(stream.fileno())
        shape, order, kind = _read_header(stream, os.fstat(stream.fileno()).st_size)
        count, start = math.prod(shape), stream.tell()
        if not count:
            return np.empty(shape, kind)
        pages = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_COPY)
    return np.frombuffer(pages, kind, count, start).reshape(shape, order=order)


def _read_header(
    stream: BinaryIO | io.BytesIO, size: int
) -> tuple[tuple[int, ...], Literal["C", "F"], np.dtype]:
    """Return shape, order and type of the array in an .npy file of `size` bytes, and read only the header."""
    version = layout.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(
            f"version {version} of the .npy format is not supported; expected version 1.0 or 2.0"
        )
    shape, by_columns, kind = HEADERS[version](stream)
    if kind.kind not in KINDS or not kind.itemsize or any(side < 0 for side in shape):
        raise ValueError(
            f"got an array of type {shorten(kind)} and shape {shorten(shape)}; expected plain numbers or text, no "
            "objects"
        )
    needed, left = math.prod(shape) * kind.itemsize, size - stream.tell()  # Python integers cannot overflow
    if needed > left:
        raise ValueError(
            f"an array of type {kind} and shape {shape} takes {needed} bytes, but only {left} bytes follow"
        )
    return shape, "F" if by_columns else "C", kind


def to_real(values: object, name: str) -> NDArray:
    """Return an array as float64; complex numbers are accepted if every imaginary part is zero.

    `name` is the name of the array in messages.

    Raises:
        ValueError: A number has an imaginary part, which a cast would drop silently.
    """
    array = np.asarray(values)
    if array.dtype.kind == "c":
        if np.imag(array).any():
            raise ValueError(
                f"{name} contains complex numbers, whose imaginary parts would be lost; expected real numbers. Save "
                "the magnitudes, numpy.abs"
            )
        array = np.real(array)
    return array.astype(np.float64)


def read_npz(content: bytes, names: Collection[str] | None = None) -> dict[str, NDArray]:
    """Return the arrays of an .npz file by name: those in `names`, or all if `names` is None.

    Raises:
        ValueError: The file decompresses to far more bytes than it has, or `read_npy` refuses one of its arrays.
        Exception: `zipfile` raises errors of several classes for a damaged file.
    """
    if content.startswith(MAGIC):
        raise ValueError("the file is a single array; give it the ending .npy")
    with zipfile.ZipFile(io.BytesIO(content)) as packed:
        parts = {part.filename.removesuffix(".npy"): part for part in packed.infolist()}
        chosen = {name: part for name, part in parts.items() if names is None or name in names}
        size = sum(part.file_size for part in chosen.values())
        if size > most_decompressed(len(content)):
            raise ValueError(
                f"the {len(content)} bytes of the file decompress to {size} bytes, but at most "
                f"{most_decompressed(len(content))} bytes are allowed"
            )
        arrays = {}
        for name, part in chosen.items():
            if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(
                    f"the array {shorten(name)} is compressed by the unsupported method {part.compress_type}; save "
                    "the arrays with numpy.savez or numpy.savez_compressed"
                )
            with packed.open(part) as stream:
                # without this size, zipfile would decompress any number of bytes
                content = stream.read(part.file_size)
            try:
                arrays[name] = read_npy(content)
            except ValueError as error:
                raise ValueError(
                    f"the array {shorten(name)} cannot be read as plain numbers: {error}"
                ) from error
        return arrays
