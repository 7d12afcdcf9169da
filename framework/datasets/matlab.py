"""Reader for MATLAB 5 files that may be damaged: numbers, text, cells and structs.

SciPy's reader is not used, because a file with one wrong byte can crash the process (observed with SciPy 1.17). Before
memory is allocated, every element must lie within its parent element and hold as much data as its dimensions state.
The source of the format is MathWorks, "MAT-File Format" (R2023b).
"""

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from framework.errors import DataError
from framework.storage.limits import DEEPEST_ARRAYS as DEEPEST
from framework.storage.limits import MOST_ARRAYS
from framework.storage.reading import RESTORE, inflate, most_decompressed, read_bytes, translate_errors

HEADER_BYTES = 128
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy types of numeric elements, by element type (table 1-1 of the format)."""
LETTERS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
"""Encodings of text elements, by element type (table 1-1)."""
UNSIGNED, MATRIX, COMPRESSED = 6, 14, 15
"""Numbers of element types in the format (table 1-1)."""
CELL, STRUCT, CHAR, NUMERIC, OPAQUE = 1, 2, 4, range(6, 16), 17
"""Numbers of array classes in the format (table 1-3)."""
COMPLEX = 0x0800
"""Flag bit of an array of complex numbers."""
NAME_WITHIN = 512
"""Number of bytes at the beginning of a variable that suffice for its flags, at most 32 dimensions and its name."""


def read_variables(file: Path, names: Sequence[str] | None = None, remedy: str = RESTORE) -> dict[str, Any]:
    """Read the named variables of a file, or all if `names` is None.

    `parse_variables` describes the returned values.

    Args:
        file: path of the file.
        names: names of the variables.
        remedy: advice in the message about a damaged file.

    Raises:
        DataError: the file does not exist, is damaged, or is of version 7.3.
    """
    with translate_errors(file, "a MATLAB file", remedy):
        content = read_bytes(file)
        if content[124:HEADER_BYTES] in (b"\x00\x02IM", b"\x02\x00MI"):
            raise DataError(f"{file}: got a MATLAB 7.3 file, but version 5 is required. Save it with '-v7'.")
        return parse_variables(content, names)


def parse_variables(content: bytes, names: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the named variables in the bytes of a file, or all if `names` is None.

    Dimensions of length 1 are removed, and a single value is returned without an array. Numbers keep their stored type,
    a struct becomes a dict, and text becomes a string. Sparse matrices, objects and functions, which label files do not
    use, become None.

    Raises:
        ValueError, zlib.error: the file is damaged, or one of the variables holds complex numbers.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:HEADER_BYTES])
    if order is None:
        raise ValueError("the file does not begin with the header of a MATLAB 5 file")
    (version,) = struct.unpack_from(f"{order}H", content, 124)
    if version != 0x0100:
        raise ValueError(
            f"the header states format version {version:#06x}, but 0x0100 (MATLAB 5) is required"
        )
    reader, result = _Reader(order), {}
    position, remaining = HEADER_BYTES, most_decompressed(len(content))
    while position < len(content):
        kind, start, position = reader.element(content, position, len(content))
        packed = content[start:position]
        element = (
            inflate(packed, NAME_WITHIN, part=True) if kind == COMPRESSED else content[start - 8 : position]
        )
        name = reader.head(element, 8, len(element)).name
        if name and (names is None or name in names):
            if kind == COMPRESSED:
                element = inflate(packed, remaining)
                remaining -= len(element)
            kind, start, end = reader.element(element, 0, len(element))
            if kind != MATRIX:
                raise ValueError(
                    f"a variable is stored as data of type {kind}, but type {MATRIX} (an array) is required"
                )
            result[name] = reader.array(element, start, end, 0)
    return result


class _Head(NamedTuple):
    """Header of an array: class, whether its numbers are complex, dimensions, name, and position of its data."""

    kind: int
    complex: bool
    shape: tuple[int, ...]
    name: str
    position: int


class _Reader:
    """Parser of the elements of one file with byte order "<" or ">"."""

    def __init__(self, order: str) -> None:
        self.order = order
        self.arrays = 0

    def element(self, content: bytes, position: int, limit: int) -> tuple[int, int, int]:
        """Read the tag at `position`; return the element's type, and the positions where its data begin and end.

        Data that end after `limit` raise a ValueError.
        """
        if position + 8 > limit:
            raise ValueError(
                f"the file is cut short: it ends within the data element that begins at byte {position}"
            )
        kind, size = struct.unpack_from(f"{self.order}II", content, position)
        start = position + 8
        if kind >> 16:  # small element: at most four bytes of data, in the second half of the tag
            kind, size, start = kind & 0xFFFF, kind >> 16, position + 4
            if size > 4:
                raise ValueError(
                    f"a small data element at byte {position} has {size} bytes, but at most 4 are allowed"
                )
        if start + size > limit:
            raise ValueError(
                f"a data element of {size} bytes at byte {position} extends beyond the end of the file, or of the "
                "array that contains it"
            )
        return kind, start, start + size

    def head(self, content: bytes, start: int, end: int) -> _Head:
        """Read flags, dimensions and name of the array that begins at `start`."""
        kind, first, last = self.element(content, start, end)
        if kind != UNSIGNED or last - first != 8:
            raise ValueError(f"the array at byte {start} does not begin with 8 bytes of flags")
        (flags,) = struct.unpack_from(f"{self.order}I", content, first)
        if flags & 0xFF == OPAQUE:
            return _Head(OPAQUE, False, (), "", end)
        sides, position = self.numbers(content, last, end)
        _, first, last = self.element(content, position, end)
        shape = tuple(map(int, sides))
        if not 2 <= len(shape) <= 32 or min(shape) < 0:
            raise ValueError(
                f"an array has the dimensions {shape}; expected 2 to 32 dimensions, none of them negative"
            )
        name = content[first:last].decode("latin-1")
        return _Head(flags & 0xFF, bool(flags & COMPLEX), shape, name, _align(last))

    def numbers(self, content: bytes, position: int, limit: int) -> tuple[np.ndarray, int]:
        """Return the numbers of the element at `position`, and the position of the next element."""
        kind, start, end = self.element(content, position, limit)
        if kind not in NUMBERS:
            raise ValueError(f"the data element at byte {position} has type {kind}, but numbers are required")
        return np.frombuffer(content[start:end], self.order + NUMBERS[kind]), _align(end)

    def array(self, content: bytes, start: int, end: int, depth: int) -> Any:
        """Return the array between the bytes `start` and `end`, including all arrays inside it.

        `depth` is the number of arrays around this array.
        """
        if start == end:
            return np.empty(0)
        head = self.head(content, start, end)
        if head.complex:
            raise ValueError(
                f"the array at byte {start} holds complex numbers, but only real numbers are supported"
            )
        count, position = math.prod(head.shape), head.position
        if head.kind in NUMERIC:
            values, _ = self.numbers(content, position, end)
            values = values.astype(values.dtype.newbyteorder("=")).reshape(head.shape, order="F")
        elif head.kind == CHAR:
            return self.text(content, position, end, head.shape)
        elif head.kind in (CELL, STRUCT):
            fields = [""]
            if head.kind == STRUCT:
                fields, position = self.fields(content, position, end)
            self.arrays += count * max(len(fields), 1)
            if depth == DEEPEST or self.arrays > MOST_ARRAYS:
                raise ValueError(
                    f"the file has more than {MOST_ARRAYS} arrays, or arrays nested deeper than {DEEPEST} levels, "
                    "which is not allowed"
                )
            values = np.empty(count, object)
            for number in range(count):
                entry = {}
                for field in fields:
                    kind, first, last = self.element(content, position, end)
                    if kind != MATRIX:
                        raise ValueError(
                            f"the data element at byte {position} has type {kind}, but an array is required"
                        )
                    entry[field] = self.array(content, first, last, depth + 1)
                    position = _align(last)
                values[number] = entry if head.kind == STRUCT else entry[""]
            values = values.reshape(head.shape, order="F")
        else:
            return None
        if not count:
            return np.empty(0, values.dtype)
        return values.item() if count == 1 else values.squeeze()

    def text(self, content: bytes, position: int, limit: int, shape: tuple[int, ...]) -> str | np.ndarray:
        """Return a character array as a string, or as an array of strings if it has several rows."""
        kind, start, end = self.element(content, position, limit)
        if kind not in LETTERS or len(shape) != 2:
            raise ValueError(
                f"the text at byte {position} has type {kind} and shape {shape}; expected characters in two "
                "dimensions"
            )
        wide = {"<": "-le", ">": "-be"}[self.order] if LETTERS[kind] in ("utf-16", "utf-32") else ""
        letters = content[start:end].decode(LETTERS[kind] + wide)
        rows, columns = shape
        if rows < 2 or not columns:
            return letters.rstrip("\0")
        if len(letters) != rows * columns:
            raise ValueError(
                f"a text of shape {shape} has {len(letters)} characters; expected {rows * columns}"
            )
        return np.array([letters[row::rows] for row in range(rows)])

    def fields(self, content: bytes, position: int, limit: int) -> tuple[list[str], int]:
        """Return the field names of a struct, without the padding to equal lengths, and the position of its values."""
        lengths, position = self.numbers(content, position, limit)
        _, start, end = self.element(content, position, limit)
        length = int(lengths[0]) if len(lengths) == 1 else 0
        if length < 1 or (end - start) % length:
            raise ValueError(
                f"the field names at byte {start} have different lengths; expected one length that divides their "
                f"{end - start} bytes"
            )
        names = content[start:end].decode("latin-1")
        parts = [names[first : first + length] for first in range(0, len(names), length)]
        return [part.partition("\0")[0] for part in parts], _align(end)


def _align(position: int) -> int:
    """Return the next position that is a multiple of 8."""
    return -(-position // 8) * 8
