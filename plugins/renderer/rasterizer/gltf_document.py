"""A glTF 2.0 document (Khronos, 2021): its description, and the numbers and files that it refers to.

The file may be damaged or malicious: all numbers in it are checked against bounds, and no array is made larger than
the file's size allows.
"""

import base64
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from framework.errors import quote, shorten
from framework.storage.limits import SCENE_BYTES, UNFOLDED_TIMES
from framework.storage.plain_values import plain_numbers
from framework.storage.reading import read_bytes, translate_errors
from plugins.renderer.rasterizer.parts import Pictures, beside

NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@dataclass
class Document:
    """A file's description and the data that it refers to."""

    content: dict[str, Any]
    folder: Path
    binary: bytes | None
    size: int
    buffers: dict[int, bytes] = field(default_factory=dict)
    pictures: Pictures = field(default_factory=Pictures)
    notes: list[str] = field(default_factory=list)

    def item(self, kind: str, number: Any) -> dict[str, Any]:
        """Return item `number` of a kind of items, such as "meshes".

        Raises:
            ValueError: there is no such item.
        """
        items = self.content.get(kind, [])
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < len(items):
            raise ValueError(f"it names number {quote(number)} of its {kind}, of which it has {len(items)}")
        return items[number]

    def buffer(self, number: int) -> bytes:
        """Return the bytes of a buffer.

        Raises:
            ValueError: the file and the files beside it do not hold the buffer.
        """
        if number not in self.buffers:
            described = self.item("buffers", number)
            if "uri" in described:
                self.buffers[number] = self.referred(described["uri"])
            elif number == 0 and self.binary is not None:
                self.buffers[number] = self.binary
            else:
                extensions = ", ".join(described.get("extensions", {}))
                why = (
                    f", but stored by {shorten(extensions)}, which is not understood; save it without"
                    if extensions
                    else ""
                )
                raise ValueError(f"its buffer {number} is nowhere{why}")
        return self.buffers[number]

    def referred(self, address: str) -> bytes:
        """Return the content of a data: address, or of a file beside this file."""
        if address.startswith("data:"):
            head, _, body = address.partition(",")
            if not head.endswith(";base64"):
                raise ValueError(f"it holds data as {quote(head[-20:])}; wanted base64")
            return base64.b64decode(body, validate=True)
        return self.of_file(beside(self.folder, unquote(address, errors="surrogateescape")))

    def of_file(self, file: Path) -> bytes:
        """Return the content of a file beside this file."""
        with translate_errors(file, "a part of a glTF file"):
            found = read_bytes(file)
        self.size += len(found)
        return found

    def view(self, number: Any) -> tuple[bytes | memoryview, int]:
        """Return the bytes of a buffer view, and the distance of its elements in bytes (0: close together)."""
        described = self.item("bufferViews", number)
        buffer = self.buffer(whole(described["buffer"]))
        first, length = whole(described.get("byteOffset", 0)), whole(described["byteLength"])
        if first + length > len(buffer):
            raise ValueError(
                f"its buffer has {len(buffer)} bytes, of which {first + length} are asked; it is cut short"
            )
        return memoryview(buffer)[first : first + length], whole(described.get("byteStride", 0))

    def numbers(self, number: Any, width: int, *, shares: bool = False) -> NDArray:
        """Return the numbers of an accessor, (count, width): integers as they are, or float64.

        Args:
            number: number of the accessor.
            width: number of columns.
            shares: read integers as shares of the largest one, whether the accessor says so or not.
        """
        described = self.item("accessors", number)
        if WIDTHS.get(described["type"]) != width:
            raise ValueError(f"wanted {width} numbers each, got {quote(described['type'])}")
        count, kind = whole(described["count"]), np.dtype(NUMBERS[described["componentType"]])
        self.bounded(count * width * 8)
        found = np.zeros((count, width), kind)
        if "bufferView" in described:
            found = self._elements(described["bufferView"], described, count, width, kind).copy()
        if "sparse" in described:
            sparse = described["sparse"]
            changed, places = whole(sparse["count"]), sparse["indices"]
            order = np.dtype(NUMBERS[places["componentType"]])
            rows = self._elements(places["bufferView"], places, changed, 1, order)[:, 0]
            found[rows] = self._elements(
                sparse["values"]["bufferView"], sparse["values"], changed, width, kind
            )
        if kind.kind == "f":
            return found.astype(np.float64)
        if shares or described.get(
            "normalized"
        ):  # section 3.11 "Animations", equations of normalized integers
            return np.maximum(found.astype(np.float64) / np.iinfo(kind).max, -1)
        return found

    def _elements(
        self, view: Any, described: dict[str, Any], count: int, width: int, kind: np.dtype
    ) -> NDArray:
        content, apart = self.view(view)
        first, size = whole(described.get("byteOffset", 0)), width * kind.itemsize
        apart = apart or size
        if apart < size or (count and first + (count - 1) * apart + size > len(content)):
            raise ValueError(
                f"{count} elements were announced, but there are {len(content)} bytes; it is cut short"
            )
        return np.ndarray((count, width), kind, content, first, (apart, kind.itemsize))

    def bounded(self, needed: int) -> None:
        """Refuse to use more bytes than a file of this size may become.

        Raises:
            ValueError: `needed` bytes are too many.
        """
        if needed > max(SCENE_BYTES, UNFOLDED_TIMES * self.size):
            raise ValueError(f"{self.size} bytes would become {needed}; it repeats itself, or is damaged")


def opened(file: Path) -> Document:
    """Return the document that a .gltf or .glb file holds."""
    content = read_bytes(file)
    size, binary = len(content), None
    if content[:4] == b"glTF":
        first, binary = _chunks(content)
        content = first
    elif file.suffix.lower() == ".glb":
        raise ValueError("wanted glTF in its first bytes")
    described = json.loads(content)
    if not isinstance(described, dict):
        raise ValueError(f"it holds {type(described).__name__}")
    return Document(described, file.parent, binary, size)


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """Return the description and the binary part of a .glb (section 4.4)."""
    version, length = (int.from_bytes(content[place : place + 4], "little") for place in (4, 8))
    if version != 2 or length > len(content):
        raise ValueError(
            f"its header announces version {version} and {length} bytes, but it has {len(content)}; wanted version 2, "
            "whole"
        )
    found: dict[bytes, bytes] = {}
    place = 12
    while place + 8 <= length:
        size = int.from_bytes(content[place : place + 4], "little")
        kind = content[place + 4 : place + 8]
        if place + 8 + size > length:
            raise ValueError("a part of it goes on beyond its end")
        found.setdefault(kind, content[place + 8 : place + 8 + size])
        place += 8 + size
    if b"JSON" not in found:
        raise ValueError("it has no description")
    return found[b"JSON"], found.get(b"BIN\0")


def numbers(value: Any) -> NDArray:
    """Return a value of the description, where numbers are wanted, as float64.

    Raises:
        ValueError: something in it is not a number.
    """
    return np.array(plain_numbers(value), np.float64)


def whole(value: Any) -> int:
    """Return a value of the description if it is an integer from 0."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"wanted a whole number from 0, got {quote(value)}")
    return value
