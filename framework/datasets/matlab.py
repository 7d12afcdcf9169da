"""Reads MATLAB 5 files that may be damaged.

SciPy's reader can crash the process on a file with a wrong byte in it (seen with SciPy 1.17). So the file's outline
is checked first: what MATLAB compressed has a checksum, and of what is not compressed every element must be of a
known type and lie within the one that holds it. Complex numbers, which labels do not hold, are refused.
"""

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import scipy.io

from framework.errors import DataError

HEADER_BYTES = 128
UNSIGNED, MATRIX, COMPRESSED = 6, 14, 15
COMPLEX = 0x0800
PLAIN_TYPES = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}
"""Element types of the MAT-File Format, table 1-1: integers, floating point and text."""


def read_variables(file: Path, names: list[str], source: str) -> dict[str, Any]:
    """Read the named variables of a file, structs as `scipy.io.matlab.mat_struct`, squeezed.

    Args:
        source: where the file can be had again, for messages: "the release".

    Raises:
        DataError: there is no such file, or it is damaged or of another version than 5.
    """
    try:
        content = file.read_bytes()
        check(content)
        return scipy.io.loadmat(
            io.BytesIO(content), squeeze_me=True, struct_as_record=False, variable_names=names
        )
    except FileNotFoundError:
        raise DataError(f"{file}: no such file. Restore it from {source}.") from None
    except Exception as error:  # nearly any, where the file is damaged
        raise DataError(
            f"{file}: cannot be read as a MATLAB file ({error}). Restore it from {source}."
        ) from error


def check(content: bytes) -> None:
    """Raise ValueError, or zlib.error, for a file that is damaged or of another version."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:HEADER_BYTES])
    if order is None:
        raise ValueError("no header of a MATLAB 5 file")
    (version,) = struct.unpack_from(f"{order}H", content, 124)
    if version == 0x0200:
        raise ValueError("it is a MATLAB 7.3 file; wanted version 5, which `save` writes with '-v7'")
    if version != 0x0100:
        raise ValueError(f"version {version:#06x} instead of 0x0100")
    position = HEADER_BYTES
    while position < len(content):
        kind, start, end = _element(content, position, len(content), order)
        if kind == COMPRESSED:
            zlib.decompress(content[start:end])  # its checksum speaks for what is inside
            position = end  # compressed elements are not padded
        else:
            _check_element(content, kind, start, end, order)
            position = _padded(end)


def _check_element(content: bytes, kind: int, start: int, end: int, order: str) -> None:
    if kind != MATRIX:
        if kind not in PLAIN_TYPES:
            raise ValueError(f"unknown element type {kind} before byte {start}")
        return
    position = start
    while position < end:
        inner, first, last = _element(content, position, end, order)
        if position == start:
            if inner != UNSIGNED or last - first != 8:
                raise ValueError(f"a matrix without its flags at byte {start}")
            (flags,) = struct.unpack_from(f"{order}I", content, first)
            if flags & COMPLEX:  # SciPy looks for an imaginary part, whether there is one or not
                raise ValueError(f"complex numbers at byte {start}")
        _check_element(content, inner, first, last, order)
        position = _padded(last)


def _element(content: bytes, position: int, limit: int, order: str) -> tuple[int, int, int]:
    """Read the tag of the element at `position`: its type, and the first byte and end of its data, before `limit`."""
    if position + 8 > limit:
        raise ValueError(f"the file ends within an element at byte {position}")
    kind, size = struct.unpack_from(f"{order}II", content, position)
    if kind >> 16:  # four bytes at most, in the second half of the tag
        kind, size, start = kind & 0xFFFF, kind >> 16, position + 4
        if size > 4:
            raise ValueError(f"a small element of {size} bytes at byte {position}")
    else:
        start = position + 8
    if start + size > limit:
        raise ValueError(f"an element of {size} bytes at byte {position} reaches beyond what holds it")
    return kind, start, start + size


def _padded(position: int) -> int:
    return -(-position // 8) * 8
