"""A glTF 2.0 document (Khronos, 2021): its JSON description, and the numbers and files that the description refers to.

The file may be damaged or malicious: all its numbers are checked against bounds, and the size of every array is limited
by the size of the file.
The package trimesh is not used, because it bounds neither memory nor time: for a crafted file of 2 kB it requests
11 GiB (version 5.2.0; see docs/reference/files.md).
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
from framework.scenes.parts import TextureDecoder, resolve_beside
from framework.storage.limits import SCENE_BYTES, UNFOLDED_TIMES
from framework.storage.plain_values import plain_numbers
from framework.storage.reading import read_bytes, translate_errors

NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@dataclass
class Document:
    """The JSON description of a file and the data that it refers to.

    Attributes:
        content: the description.
        folder: folder of the file.
        binary: binary part of a .glb; None for a .gltf.
        size: bytes read so far, of this file and of the files that it refers to.
        buffers: buffers that were read, by number.
        textures: decoder of the textures.
        notes: sentences about elements of the file that are left out.
    """

    content: dict[str, Any]
    folder: Path
    binary: bytes | None
    size: int
    buffers: dict[int, bytes] = field(default_factory=dict)
    textures: TextureDecoder = field(default_factory=TextureDecoder)
    notes: list[str] = field(default_factory=list)

    def item(self, kind: str, number: Any) -> dict[str, Any]:
        """Return the description of item `number` of a kind, such as "meshes".

        Raises:
            ValueError: there is no such item.
        """
        items = self.content.get(kind, [])
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < len(items):
            raise ValueError(
                f"the glTF file refers to entry {quote(number)} of `{kind}`, which has {len(items)} entries "
                "(numbered from 0)"
            )
        return items[number]

    def buffer(self, number: int) -> bytes:
        """Return the bytes of a buffer.

        Raises:
            ValueError: neither this file nor a file beside it holds the buffer.
        """
        if number not in self.buffers:
            described = self.item("buffers", number)
            if "uri" in described:
                self.buffers[number] = self.read_address(described["uri"])
            elif number == 0 and self.binary is not None:
                self.buffers[number] = self.binary
            else:
                extensions = ", ".join(described.get("extensions", {}))
                reason = (
                    f"; they are stored by {shorten(extensions)}, which is not supported. Save the file without this "
                    "extension"
                    if extensions
                    else ""
                )
                raise ValueError(f"the data of buffer {number} are missing in the glTF file{reason}")
        return self.buffers[number]

    def read_address(self, address: str) -> bytes:
        """Return the content of a data: URI, or of a file beside this file."""
        if address.startswith("data:"):
            head, _, body = address.partition(",")
            if not head.endswith(";base64"):
                raise ValueError(
                    f"data within the glTF file are encoded as {quote(head[-20:])}, but only base64 is supported"
                )
            return base64.b64decode(body, validate=True)
        return self.read_file(resolve_beside(self.folder, unquote(address, errors="surrogateescape")))

    def read_file(self, file: Path) -> bytes:
        """Return the content of a file that the glTF file names, and add the number of its bytes to `size`."""
        with translate_errors(file, "a part of a glTF file"):
            data = read_bytes(file)
        self.size += len(data)
        return data

    def buffer_view(self, number: Any) -> tuple[bytes | memoryview, int]:
        """Return the bytes of a buffer view, and the distance between its elements in bytes (0: no gaps)."""
        described = self.item("bufferViews", number)
        buffer = self.buffer(whole_number(described["buffer"]))
        start, length = (
            whole_number(described.get("byteOffset", 0)),
            whole_number(described["byteLength"]),
        )
        if start + length > len(buffer):
            raise ValueError(
                f"a buffer of the glTF file has {len(buffer)} bytes, but {start + length} bytes are required; the "
                "file is cut short"
            )
        return memoryview(buffer)[start : start + length], whole_number(described.get("byteStride", 0))

    def numbers(self, number: Any, width: int, *, shares: bool = False) -> NDArray:
        """Return the numbers of an accessor, (count, width): integers in their stored type, other numbers in float64.

        Args:
            number: number of the accessor.
            width: number of columns.
            shares: divide integers by the largest integer of their type, even if the accessor is not "normalized".
        """
        described = self.item("accessors", number)
        if WIDTHS.get(described["type"]) != width:
            raise ValueError(
                f"accessor {quote(number)} of the glTF file has the type {quote(described['type'])}; expected a type "
                f"with {width} numbers per element"
            )
        count, kind = whole_number(described["count"]), np.dtype(NUMBERS[described["componentType"]])
        self.check_size(count * width * 8)
        values = np.zeros((count, width), kind)
        if "bufferView" in described:
            values = self._elements(described["bufferView"], described, count, width, kind).copy()
        if "sparse" in described:
            sparse = described["sparse"]
            changed, indices = whole_number(sparse["count"]), sparse["indices"]
            order = np.dtype(NUMBERS[indices["componentType"]])
            rows = self._elements(indices["bufferView"], indices, changed, 1, order)[:, 0]
            values[rows] = self._elements(
                sparse["values"]["bufferView"], sparse["values"], changed, width, kind
            )
        if kind.kind == "f":
            return values.astype(np.float64)
        # section 3.11 "Animations", equations of normalized integers
        if shares or described.get("normalized"):
            return np.maximum(values.astype(np.float64) / np.iinfo(kind).max, -1)
        return values

    def _elements(
        self, buffer_view: Any, described: dict[str, Any], count: int, width: int, kind: np.dtype
    ) -> NDArray:
        data, stride = self.buffer_view(buffer_view)
        offset, size = whole_number(described.get("byteOffset", 0)), width * kind.itemsize
        stride = stride or size
        if stride < size or (count and offset + (count - 1) * stride + size > len(data)):
            raise ValueError(
                f"the glTF file declares {count} elements, but only {len(data)} bytes hold them; the file is cut "
                "short"
            )
        return np.ndarray((count, width), kind, data, offset, (stride, kind.itemsize))

    def check_size(self, needed: int) -> None:
        """Check that reading a part takes no more bytes than is plausible for a file of this size.

        Raises:
            ValueError: `needed` bytes are too many.
        """
        if needed > max(SCENE_BYTES, UNFOLDED_TIMES * self.size):
            raise ValueError(
                f"the {self.size} bytes of the glTF file would become {needed} bytes; the file refers to the same "
                "data too often, or is damaged"
            )


def open_document(file: Path) -> Document:
    """Read the document of a .gltf or .glb file."""
    content = read_bytes(file)
    size, binary = len(content), None
    if content[:4] == b"glTF":
        content, binary = _split_chunks(content)
    elif file.suffix.lower() == ".glb":
        raise ValueError("the file does not begin with the four bytes glTF of a .glb file")
    description = json.loads(content)
    if not isinstance(description, dict):
        raise ValueError(
            f"the JSON description of the glTF file is a {type(description).__name__}, but an object ({{...}}) is "
            "required"
        )
    return Document(description, file.parent, binary, size)


def _split_chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """Return the description and the binary part of a .glb file (section 4.4)."""
    version, length = (int.from_bytes(content[offset : offset + 4], "little") for offset in (4, 8))
    if version != 2 or length > len(content):
        raise ValueError(
            f"the header declares version {version} and {length} bytes, and the file has {len(content)} bytes; "
            "version 2 and the complete file are required"
        )
    chunks: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= length:
        size = int.from_bytes(content[offset : offset + 4], "little")
        kind = content[offset + 4 : offset + 8]
        if offset + 8 + size > length:
            raise ValueError(
                f"the .glb file is cut short: a chunk that begins at byte {offset} takes {size} bytes, but only "
                f"{length - offset - 8} bytes follow"
            )
        chunks.setdefault(kind, content[offset + 8 : offset + 8 + size])
        offset += 8 + size
    if b"JSON" not in chunks:
        raise ValueError("the .glb file has no chunk named JSON with its description")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


def to_numbers(value: Any) -> NDArray:
    """Return a number or nested lists of numbers of the description as a float64 array.

    Raises:
        ValueError: something in it is not a number.
    """
    return np.array(plain_numbers(value), np.float64)


def whole_number(value: Any) -> int:
    """Return a value of the description after checking that it is an integer of at least 0."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(
            f"expected a whole number of at least 0 in the description of the glTF file, got {quote(value)}"
        )
    return value
