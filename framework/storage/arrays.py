"""Readers for NumPy files that may be damaged.

They allocate no more memory than the file's own bytes account for, and they never unpickle objects.
"""

import io
import math
import zipfile
from collections.abc import Collection

import numpy as np
from numpy.lib import format as layout
from numpy.typing import NDArray

from framework.errors import shorten
from framework.storage.reading import room

MAGIC = b"\x93NUMPY"
HEADERS = {(1, 0): layout.read_array_header_1_0, (2, 0): layout.read_array_header_2_0}
KINDS = "biufcUS"


def array(content: bytes) -> NDArray:
    """Return the array of numbers or texts that an .npy file stores.

    Raises:
        ValueError: The bytes are no .npy file, or are damaged, or hold Python objects or records.
    """
    stream = io.BytesIO(content)
    version = layout.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"version {version} of the format; wanted an array of numbers")
    shape, by_columns, kind = HEADERS[version](stream)
    if kind.kind not in KINDS or not kind.itemsize or any(side < 0 for side in shape):
        raise ValueError(
            f"an array of {shorten(kind)} {shorten(shape)}; wanted plain numbers or text, no objects"
        )
    count, start = math.prod(shape), stream.tell()  # Python integers cannot overflow
    if count * kind.itemsize > len(content) - start:
        raise ValueError(
            f"an array of {kind} {shape} takes {count * kind.itemsize} bytes, but {len(content) - start} follow"
        )
    if not count:
        return np.empty(shape, kind)
    order = "F" if by_columns else "C"
    return np.frombuffer(content, kind, count, start).reshape(shape, order=order).copy(order)


def real(values: object, what: str) -> NDArray:
    """Return an array as float64; complex numbers are accepted if every imaginary part is zero.

    Raises:
        ValueError: A number has an imaginary part, which a cast would drop silently.
    """
    found = np.asarray(values)
    if found.dtype.kind == "c":
        if np.imag(found).any():
            raise ValueError(
                f"{what} holds complex numbers, of which the imaginary part would be lost; wanted real ones. Save "
                "their magnitudes, numpy.abs"
            )
        found = np.real(found)
    return found.astype(np.float64)


def archive(content: bytes, names: Collection[str] | None = None) -> dict[str, NDArray]:
    """Return the arrays of an .npz file by name: only those in `names`, or all where `names` is None.

    Raises:
        ValueError: The file decompresses to far more bytes than it has, or `array` refuses one of its arrays.
        Exception: `zipfile` raises several kinds for a damaged file.
    """
    if content.startswith(MAGIC):
        raise ValueError("it is a single array; name it .npy")
    with zipfile.ZipFile(io.BytesIO(content)) as packed:
        parts = {part.filename.removesuffix(".npy"): part for part in packed.infolist()}
        chosen = {name: part for name, part in parts.items() if names is None or name in names}
        size = sum(part.file_size for part in chosen.values())
        if size > room(len(content)):
            raise ValueError(f"its {len(content)} bytes unfold to {size}")
        found = {}
        for name, part in chosen.items():
            if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{shorten(name)} is compressed by method {part.compress_type}")
            with packed.open(part) as stream:
                # the size is given because zipfile would otherwise decompress everything, however much it is
                content = stream.read(part.file_size)
            try:
                found[name] = array(content)
            except ValueError as error:
                raise ValueError(f"{shorten(name)} cannot be read as plain numbers: {error}") from error
        return found
