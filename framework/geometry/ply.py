"""Parser of PLY files, text or binary: vertices with all their properties, and faces."""

import re
import struct
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from framework.errors import quote, shorten
from framework.geometry.mesh_files import (
    COLOURS,
    MOST,
    MOST_COLUMNS,
    XYZ,
    Parsed,
    Place,
    column_names,
    fans,
    has_only_padding,
    line_numbers,
    polygons,
    rows,
    text_lines,
)
from framework.storage import text

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}
"""Format characters of the module `struct` for integer types."""
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Property:
    """A property that the header of a PLY file declares for each item of an element: a number, or a list of numbers.

    Attributes:
        name: name of the property.
        kind: NumPy's type of the number, or of the numbers in the list.
        length: NumPy's type of the length that precedes the list; None if the property is a single number.
    """

    name: str
    kind: str
    length: str | None


@dataclass(frozen=True)
class Element:
    """An element that the header of a PLY file declares: a kind of items, such as vertices or faces.

    Attributes:
        name: name of the kind, such as "vertex".
        count: number of items.
        properties: properties of an item, in the order in which they are stored.
    """

    name: str
    count: int
    properties: tuple[Property, ...]


def ply(content: bytes) -> Parsed:
    """Parse PLY 1.0: x, y, z of the vertices, their other properties as attributes, and faces.

    Unsigned integer colours are divided by the largest number of their type, to 0…1.

    Raises:
        ValueError: the file is not PLY, has an unknown type, fewer or more data than the header announces, or faces as
            strips of triangles.
    """
    content = text.remove_byte_order_mark(content)
    # The last line of the header ends as the first does: after \r alone, \n may be the first byte of the data.
    last = rb"\r" if re.match(rb"ply[ \t]*\r(?!\n)", content) else rb"\r?\n"
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*" + last, content)
    if not content.startswith(b"ply") or end is None:
        raise ValueError(
            "the file lacks the word `ply` at its beginning, or the line `end_header` that ends a PLY header"
        )
    order, elements = _header(content[: end.start()])
    names = {element.name for element in elements}
    if "tristrips" in names:
        raise ValueError(
            "the faces are strips of triangles, which are not supported; save separate triangles"
        )
    if "vertex" not in names:
        raise ValueError(
            f"the header lists the elements {shorten(', '.join(sorted(names))) or 'none'}; expected an element named "
            "`vertex`"
        )
    body = content[end.end() :]
    for element in elements:
        text.require_distinct(column_names([entry.name for entry in element.properties]), "property")
    if order == "":
        before = len(re.findall(rb"\r\n|\r|\n", content[: end.end()]))
        vertices, faces = _text(body, elements, line_numbers(body, None), before)
    else:
        vertices, faces = _binary(body, elements, order)
    return _to_parsed(next(element for element in elements if element.name == "vertex"), vertices, faces)


def _header(content: bytes) -> tuple[str, list[Element]]:
    order: str | None = None
    elements: list[Element] = []
    # lines of bytes, since lines of text also end at other characters, such as the last byte of Å
    for line in content.splitlines()[1:]:
        if max(len(elements), len(elements[-1].properties) if elements else 0) > MOST_COLUMNS:
            raise ValueError(
                f"the header has more than {MOST_COLUMNS} elements, or an element with more than {MOST_COLUMNS} "
                "properties"
            )
        words = [word.decode("utf-8", "replace") for word in line.split()]
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                order = FORMATS[words[1]]
            elif words[0] == "element":
                elements.append(Element(words[1], int(words[2]), ()))
                if not 0 <= elements[-1].count <= MOST:
                    raise ValueError
            elif words[0] == "property":
                last = elements[-1]
                if words[1] == "list":
                    parsed_property = Property(words[4], TYPES[words[3]], TYPES[words[2]])
                    if parsed_property.length is None or parsed_property.length.startswith("f"):
                        raise ValueError
                else:
                    parsed_property = Property(words[2], TYPES[words[1]], None)
                elements[-1] = Element(last.name, last.count, (*last.properties, parsed_property))
            else:
                raise ValueError
        except (KeyError, IndexError, ValueError):
            header_line = quote(line.decode("utf-8", "replace").strip())
            raise ValueError(
                f"expected a line of a PLY header (format, element, property, comment or obj_info), got {header_line}"
            ) from None
    if order is None:
        raise ValueError("the header lacks a line that begins with `format`")
    return order, elements


def _text(body: bytes, elements: list[Element], place: Place, before: int) -> tuple[NDArray, NDArray]:
    """Return properties of the vertices, one column each, and triangles, from a text body with one line for each item.

    Args:
        body: bytes after the header.
        elements: elements that the header announces.
        place: function from the index of a line among the lines of the body that are not blank, to its number in the
            body.
        before: number of lines of the header.
    """
    lines = text_lines(body, None)
    announced_lines = sum(element.count for element in elements if element.properties)
    if len(lines) != announced_lines:
        raise ValueError(
            f"the header announces {announced_lines} lines of data, but {len(lines)} lines follow"
        )
    vertices, faces = np.empty((0, 3)), np.empty((0, 3), np.int64)
    for element in elements:
        first = announced_lines - len(lines)
        own, lines = lines[: element.count], lines[element.count :]

        def where(line: int, first: int = first) -> int:
            return before + place(first + line)

        if element.name == "vertex":
            _refuse_lists(element)
            vertices = rows(own, "vertex", len(element.properties), where) if own else vertices
        elif element.name == "face" and own:
            if not _corners(element) == element.properties[0]:
                raise ValueError(
                    "the list of corners is not the first property of the faces, as it must be in a text file; save "
                    "the mesh as binary PLY"
                )
            faces = polygons(own, where)
    return vertices, faces


def _binary(body: bytes, elements: list[Element], order: str) -> tuple[NDArray, NDArray]:
    vertices, faces = np.empty((0, 3)), np.empty((0, 3), np.int64)
    start = 0
    for element in elements:
        if element.name == "vertex":
            _refuse_lists(element)
            kind = np.dtype([(f"{i}", order + entry.kind) for i, entry in enumerate(element.properties)])
            _require(body, start + element.count * kind.itemsize)
            table = np.frombuffer(body, kind, element.count, start)
            columns = [table[name].astype(np.float64) for name in table.dtype.names or ()]
            vertices = np.stack(columns, 1) if columns else vertices
            start += element.count * kind.itemsize
        else:
            triangles, start = _lists(body, start, element, order)
            faces = triangles if element.name == "face" else faces
    if start > len(body) or not has_only_padding(body, start):
        raise ValueError(
            f"{len(body) - start} bytes follow after the data that the header announces; expected the end of the file"
        )
    return vertices, faces


def _lists(body: bytes, start: int, element: Element, order: str) -> tuple[Int[np.ndarray, "faces 3"], int]:
    """Return the triangles of an element in a binary body, and the position at which its data end.

    An element other than faces is skipped, and has no triangles.

    Args:
        body: bytes after the header.
        start: position at which the element's data begin.
        element: an element whose properties may be lists.
        order: NumPy's sign of the byte order.
    """
    empty = np.empty((0, 3), np.int64)
    if element.count == 0 or not element.properties:
        return empty, start
    corner_list = _corners(element) if element.name == "face" else None
    kind = _first_record(
        body, start, element, order
    )  # assumes that all items are like the first, as they nearly always are
    if start + element.count * kind.itemsize <= len(body):
        table = np.frombuffer(body, kind, element.count, start)
        lengths = [name for name in table.dtype.names or () if name.startswith("length")]
        if all((table[name] == table[name][0]).all() for name in lengths):
            end = start + element.count * kind.itemsize
            if corner_list is None:
                return empty, end
            corners = table[f"value{element.properties.index(corner_list)}"]
            return fans(np.full(len(corners), corners.shape[1]), corners.astype(np.int64).ravel()), end
    least = sum(int((entry.length or entry.kind)[1]) for entry in element.properties)
    _require(body, start + element.count * least)
    counts, places = _locate_lists(body, start, element, corner_list, order)
    end = int(places[-1])
    if corner_list is None:
        return empty, end
    kind = np.dtype(order + corner_list.kind)
    first = np.repeat(places[:-1] - kind.itemsize * (np.cumsum(counts) - counts), counts)
    byte = (first + kind.itemsize * np.arange(len(first)))[:, None] + np.arange(kind.itemsize)
    corners = np.frombuffer(body, np.uint8)[byte].view(kind)[:, 0]
    return fans(counts, corners.astype(np.int64)), end


def _locate_lists(
    body: bytes, start: int, element: Element, target_list: Property | None, order: str
) -> tuple[Int[np.ndarray, "items"], Int[np.ndarray, "places"]]:
    """Return the lengths and the positions of the lists that the items of an element store for one property.

    The positions have one further entry: the position at which the data of the element end.

    Args:
        body: bytes after the header.
        start: position at which the element's data begin.
        element: the element.
        target_list: the property that is the list; None if only the end is wanted.
        order: NumPy's sign of the byte order.
    """
    counts, places = np.zeros(element.count, np.int64), np.zeros(element.count + 1, np.int64)
    lengths = [
        struct.Struct((order or "=") + CODES[entry.length]) if entry.length else None
        for entry in element.properties
    ]
    entries = [
        (entry is target_list, int(entry.kind[1]), length)
        for entry, length in zip(element.properties, lengths, strict=True)
    ]
    for item in range(element.count):
        for chosen, width, length in entries:
            count = 1
            if length:
                if start + length.size > len(body):
                    _require(body, start + length.size)
                (count,) = length.unpack_from(body, start)
                start += length.size
                if count < 0:
                    raise ValueError(
                        f"a list of the element {shorten(element.name)} has {count} values; expected 0 or more"
                    )
            if chosen:
                counts[item], places[item] = count, start
            start += count * width
    _require(body, start)
    places[-1] = start
    return counts, places


def _first_record(body: bytes, start: int, element: Element, order: str) -> np.dtype:
    """Return the NumPy record type of an element's first item; its lists have the lengths stored in this item."""
    fields = []
    for number, entry in enumerate(element.properties):
        if entry.length is None:
            fields.append((f"value{number}", order + entry.kind, (1,)))
        else:
            length = int(_values(body, start, 1, order + entry.length)[0])
            fields.append((f"length{number}", order + entry.length))
            fields.append((f"value{number}", order + entry.kind, (max(length, 0),)))
        start += np.dtype(fields[-1:]).itemsize + (int(entry.length[1]) if entry.length else 0)
    return np.dtype(fields)


def _values(body: bytes, start: int, count: int, kind: str) -> NDArray:
    _require(body, start + count * int(kind[-1]))
    return np.frombuffer(body, kind, count, start)


def _require(body: bytes, end: int) -> None:
    if len(body) < end:
        raise ValueError(
            f"the header announces at least {end} bytes of data, but {len(body)} follow; the file is cut short"
        )


def _corners(element: Element) -> Property:
    for entry in element.properties:
        if entry.name in CORNERS and entry.length is not None:
            return entry
    raise ValueError(f"the faces have no list of their corners; expected a list named {' or '.join(CORNERS)}")


def _refuse_lists(element: Element) -> None:
    lists = [entry.name for entry in element.properties if entry.length is not None]
    if lists:
        raise ValueError(f"the vertices have lists ({shorten(', '.join(lists))}); expected single numbers")


def _to_parsed(vertex: Element, values: NDArray, faces: NDArray) -> Parsed:
    names = column_names([entry.name for entry in vertex.properties])
    missing = [name for name in XYZ if name not in names]
    if missing:
        raise ValueError(
            f"the vertices have no properties {', '.join(missing)}, only {shorten(', '.join(names)) or 'none'}; "
            "expected x, y and z"
        )
    if not len(values):
        values = np.empty((0, len(names)))
    for number, entry in enumerate(vertex.properties):
        if names[number] in (*COLOURS, "alpha") and entry.kind.startswith("u"):
            values[:, number] /= np.iinfo(entry.kind).max
    more = [number for number, name in enumerate(names) if name not in XYZ]
    return Parsed(
        np.ascontiguousarray(values[:, [names.index(name) for name in XYZ]]),
        faces,
        tuple(names[number] for number in more),
        values[:, more] if more else None,
    )
