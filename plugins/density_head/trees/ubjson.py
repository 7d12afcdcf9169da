"""A strict and bounded parser of UBJSON as xgboost writes it.

It is own code: xgboost offers no check of a model, and its loader aborts the process on an empty one (xgboost 3.2).
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
    """Return the object, array or number that all bytes together encode; typed arrays become NumPy arrays.

    Raises:
        ValueError: the bytes are cut short, continue after the end, repeat a key, or hold what xgboost does not write.
    """
    reader = _Reader(content)
    found = reader.value(0)
    if reader.place != len(content):
        raise ValueError(f"{len(content) - reader.place} bytes follow the end")
    return found


class _Reader:
    def __init__(self, content: bytes) -> None:
        self.content, self.place = content, 0

    def taken(self, size: int) -> bytes:
        if not 0 <= size <= len(self.content) - self.place:
            raise ValueError(f"byte {self.place} announces {size} more, and it ends before")
        self.place += size
        return self.content[self.place - size : self.place]

    def marker(self) -> str:
        return self.taken(1).decode("latin1")

    def length(self) -> int:
        if self.marker() != "L":
            raise ValueError(f"byte {self.place - 1} is no length")
        return LENGTH.unpack(self.taken(8))[0]

    def text(self) -> str:
        return self.taken(self.length()).decode("ascii")

    def value(self, depth: int) -> Any:
        if depth > DEEPEST:
            raise ValueError(f"values are more than {DEEPEST} deep in others")
        kind = self.marker()
        if kind == "{":
            return self._object(depth)
        if kind == "[":
            return self._array(depth)
        if kind == "S":
            return self.text()
        if kind in NUMBERS:
            return NUMBERS[kind].unpack(self.taken(NUMBERS[kind].size))[0]
        if kind in WORDS:
            return WORDS[kind]
        raise ValueError(f"byte {self.place - 1} begins no value")

    def _object(self, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while self.content[self.place : self.place + 1] != b"}":
            key = self.text()
            if key in found:
                raise ValueError(f"byte {self.place} says a key twice")
            found[key] = self.value(depth + 1)
        self.place += 1
        return found

    def _array(self, depth: int) -> Any:
        marker, kind = self.marker(), ""
        if marker == "$":
            kind, marker = self.marker(), self.marker()
            if kind not in ARRAYS:
                raise ValueError(f"byte {self.place - 2} is no type of an array")
        if marker != "#":
            raise ValueError(f"byte {self.place - 1} begins no array whose length is said")
        count = self.length()
        if kind:
            dtype = np.dtype(ARRAYS[kind])
            return np.frombuffer(self.taken(count * dtype.itemsize), dtype)
        if not 0 <= count <= len(self.content) - self.place:  # each value takes at least one byte
            raise ValueError(f"byte {self.place} announces {count} values, and it ends before")
        return [self.value(depth + 1) for _ in range(count)]
