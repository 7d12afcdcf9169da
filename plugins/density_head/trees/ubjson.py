"""A strict parser, with bounded memory, of the UBJSON that xgboost writes.

The parser is needed because xgboost 3.2 cannot check a model, and its loader aborts the process for an empty model.
"""

import struct
from typing import Any

import numpy as np

DEEPEST = 16
LENGTH = struct.Struct(">q")
NUMBERS = {
    "i": struct.Struct(">b"),
    "U": struct.Struct(">B"),
    "I": struct.Struct(">h"),
    "l": struct.Struct(">i"),
    "L": LENGTH,
    "d": struct.Struct(">f"),
    "D": struct.Struct(">d"),
}
ARRAYS = {"U": ">u1", "l": ">i4", "L": ">i8", "d": ">f4", "D": ">f8"}
"""NumPy dtypes of typed arrays, by the type marker that precedes their numbers."""
WORDS = {"T": True, "F": False, "Z": None}


def parse(content: bytes) -> Any:
    """Return the object, array or number that the bytes encode; typed arrays become NumPy arrays.

    Raises:
        ValueError: the bytes end too early, continue after the end, repeat a key, or hold something that xgboost does
            not write.
    """
    reader = _Reader(content)
    content_value = reader.value(0)
    if reader.place != len(content):
        raise ValueError(
            f"{len(content) - reader.place} bytes follow after the end of the UBJSON content; expected none"
        )
    return content_value


class _Reader:
    def __init__(self, content: bytes) -> None:
        self.content, self.place = content, 0

    def take(self, size: int) -> bytes:
        if not 0 <= size <= len(self.content) - self.place:
            raise ValueError(
                f"the UBJSON content announces {size} more bytes at byte {self.place}, but ends earlier"
            )
        self.place += size
        return self.content[self.place - size : self.place]

    def marker(self) -> str:
        return self.take(1).decode("latin1")

    def length(self) -> int:
        if self.marker() != "L":
            raise ValueError(
                f"byte {self.place - 1} of the UBJSON content does not begin a length; expected L, the mark of a "
                "64-bit integer"
            )
        return LENGTH.unpack(self.take(8))[0]

    def text(self) -> str:
        return self.take(self.length()).decode("ascii")

    def value(self, depth: int) -> Any:
        if depth > DEEPEST:
            raise ValueError(
                f"the values of the UBJSON content are nested more than {DEEPEST} levels deep, which is not allowed"
            )
        kind = self.marker()
        if kind == "{":
            return self._object(depth)
        if kind == "[":
            return self._array(depth)
        if kind == "S":
            return self.text()
        if kind in NUMBERS:
            return NUMBERS[kind].unpack(self.take(NUMBERS[kind].size))[0]
        if kind in WORDS:
            return WORDS[kind]
        raise ValueError(
            f"byte {self.place - 1} of the UBJSON content does not begin a value of a known type"
        )

    def _object(self, depth: int) -> dict[str, Any]:
        entries: dict[str, Any] = {}
        while self.content[self.place : self.place + 1] != b"}":
            key = self.text()
            if key in entries:
                raise ValueError(
                    f"a key of the UBJSON content is repeated before byte {self.place}; expected different keys in "
                    "an object"
                )
            entries[key] = self.value(depth + 1)
        self.place += 1
        return entries

    def _array(self, depth: int) -> Any:
        marker, kind = self.marker(), ""
        if marker == "$":
            kind, marker = self.marker(), self.marker()
            if kind not in ARRAYS:
                raise ValueError(
                    f"byte {self.place - 2} of the UBJSON content is not a known type of the numbers of an array"
                )
        if marker != "#":
            raise ValueError(
                f"byte {self.place - 1} of the UBJSON content does not begin the length of an array; expected #"
            )
        count = self.length()
        if kind:
            dtype = np.dtype(ARRAYS[kind])
            return np.frombuffer(self.take(count * dtype.itemsize), dtype)
        if not 0 <= count <= len(self.content) - self.place:  # each value takes at least one byte
            raise ValueError(
                f"the UBJSON content announces {count} values at byte {self.place}, but ends earlier"
            )
        return [self.value(depth + 1) for _ in range(count)]
