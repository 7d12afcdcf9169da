"""Parsers of mesh and cloud files, one function for each format; they return only data that the file holds.

Every parser takes the bytes of a file. If they are wrong, it raises a ValueError that says what it got, in which line,
and what it expected; the caller, `geometry.meshes`, adds the name of the file. PLY has a module of its own. Comments
are skipped, and the line ends of all systems are read. Polygons are cut into fans of triangles, which is correct for
convex polygons.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from framework.errors import shorten
from framework.storage import arrays, text
from framework.storage.limits import MOST_ANNOUNCED as MOST
from framework.storage.limits import MOST_COLUMNS, MOST_NUMBERS
from framework.storage.reading import require_numbers

XYZ = ("x", "y", "z")
COLOURS = ("red", "green", "blue")
NORMALS = ("normal_x", "normal_y", "normal_z")
OTHER_NAMES = {"r": "red", "g": "green", "b": "blue", "nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
"""Other names of columns that files use, and the project's names for these columns."""


PADDING = 8
"""Largest number of blank bytes that may follow the data of a binary file."""


class Parsed(NamedTuple):
    """The content of a mesh or cloud file.

    Attributes:
        vertices: coordinates.
        faces: triangles, as indices of vertices.
        columns: names of the vertices' attributes.
        attributes: one column for each name in `columns`, with values as in the file, except that unsigned integer
            colours are scaled to 0…1; None if there are no attributes.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    columns: tuple[str, ...] = ()
    attributes: Float[np.ndarray, "vertices columns"] | None = None


def column_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return the project's names for columns that a file calls `names`, in lower case."""
    small = [name.lower() for name in names]
    return tuple(OTHER_NAMES.get(name, name) for name in small)


Place = Callable[[int], int]
"""Function from the index of a line in a list of lines to its line number in the file (from 1), for messages."""


def text_lines(content: bytes, comment: bytes | None = b"#", names: Sequence[bytes] = ()) -> list[bytes]:
    """Return the lines of a file that are neither blank nor a comment, without comments at their ends.

    A byte-order mark is removed.

    Args:
        content: bytes of the file.
        comment: sign at which a comment begins, unless it stands within a number such as 1.#INF; None if there are no
            comments.
        names: first words of lines in which the comment sign is an ordinary character, because a name in them may
            contain it.

    Raises:
        ValueError: the text is UTF-16.
    """
    return [line for line in _lines(content, comment, names) if line and not line.isspace()]


def line_numbers(
    content: bytes,
    comment: bytes | None = b"#",
    names: Sequence[bytes] = (),
    key: bytes = b"",
    first: int = 0,
) -> Place:
    """Return a function that gives the number in the file (from 1) of a line that `text_lines` returns.

    Args:
        content: bytes of the file.
        comment: sign at which a comment begins; None if there are no comments.
        names: first words of lines in which a comment sign is an ordinary character.
        key: if not empty, only lines with this first word are counted.
        first: number of counted lines before the line with index 0.
    """

    def place(line: int) -> int:
        line_numbers = [
            number
            for number, words in enumerate(map(bytes.split, _lines(content, comment, names)), 1)
            if words and (not key or words[0] == key)
        ]
        return line_numbers[first + line]

    return place


def _lines(content: bytes, comment: bytes | None, names: Sequence[bytes]) -> list[bytes]:
    content = text.remove_byte_order_mark(content).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    lines = content.split(b"\n")
    if comment is None or comment not in content:
        return lines
    cut = rb"(?:(?<![\d.])%b|%b(?!\w)).*" % (2 * (re.escape(comment),))
    if names:  # a whole line with a name is found first, and stays
        cut = rb"^([ \t]*(?:" + b"|".join(map(re.escape, names)) + rb")[ \t].*)|" + cut
    remove, kept = re.compile(cut).sub, rb"\1" if names else b""
    return [remove(kept, line) if comment in line else line for line in lines]


def numbers(lines: Sequence[bytes], dtype: type = np.float64, place: Place | None = None) -> NDArray:
    """Return all numbers in `lines`, concatenated, as an array of type `dtype`.

    Raises:
        ValueError: a word is not a number; the message names the line if `place` is given.
    """
    joined = b" ".join(lines).strip()  # NumPy reads blanks alone as a number
    try:
        return np.fromstring(joined, dtype=dtype, sep=" ") if joined else np.empty(0, dtype)
    except ValueError:
        values: list[float] = []
        for number, line in enumerate(lines):
            for word in line.split():
                value = None if dtype is np.int64 else text.parse_number(word.decode("utf-8", "replace"))
                if value is None:
                    value = _whole(word) if dtype is np.int64 else None
                if value is None:
                    raise ValueError(_at(number, place) + _no_number(word, dtype, line)) from None
                values.append(value)
        return np.array(values, dtype)


def _whole(word: bytes) -> int | None:
    try:
        return int(np.fromstring(word, dtype=np.int64, sep=" ")[0])
    except ValueError:
        return None


def _no_number(word: bytes, dtype: type, line: bytes) -> str:
    where = f" in the line {_excerpt(line)}"
    if dtype is np.int64:
        return f"expected a whole number, got {_excerpt(word)}{where}"
    return text.describe_no_number(word[:60].decode("utf-8", "replace"), where)


def _at(number: int, place: Place | None) -> str:
    """Return the line number of the line with the index `number`, as the beginning of a message; '' without `place`."""
    return "" if place is None else f"line {place(number)}: "


def rows(
    lines: Sequence[bytes], row_name: str, width: int | None = None, place: Place | None = None
) -> Float[np.ndarray, "rows width"]:
    """Return the numbers in `lines`, one row for each line, (rows, width).

    Args:
        lines: lines of text.
        row_name: noun for the content of a line, for the message.
        width: how many numbers each line has; None: as many as the first line.
        place: function from the index of a line to its number in the file.

    Raises:
        ValueError: a line has more or fewer numbers, or a word that is not a number; the message names the line.
    """
    columns = len(lines[0].split()) if width is None and lines else width or 0
    values = numbers(lines, place=place)
    if len(values) != columns * len(lines) or any(len(line.split()) != columns for line in lines):
        number, line = next((n, line) for n, line in enumerate(lines) if len(line.split()) != columns)
        raise ValueError(
            f"{_at(number, place)}expected {columns} numbers for each {row_name}, got the line {_excerpt(line)}"
        )
    return values.reshape(len(lines), columns)


def polygons(lines: Sequence[bytes], place: Place | None = None) -> Int[np.ndarray, "faces 3"]:
    """Return the triangles of the faces that `lines` describe.

    Each line describes one face: the number of its corners, then the corners, then any words, which are skipped.
    `place` gives the line's number in the file for error messages.
    """
    if not lines:
        return np.empty((0, 3), np.int64)
    corners = int(numbers(lines[0].split()[:1], np.int64, place)[0])
    try:
        flat = numbers(lines, np.int64)
    except ValueError:  # colours, or no number at all: parsed line by line below
        flat = np.empty(0, np.int64)
    alike = corners >= 3 and len(flat) == len(lines) * (corners + 1)
    if alike and (flat[:: corners + 1] == corners).all():
        counts = np.full(len(lines), corners)
        return fans(counts, flat.reshape(-1, corners + 1)[:, 1:].ravel())
    counts, corner_texts = [], []
    for number, line in enumerate(lines):
        words = line.split()
        where = None if place is None else lambda _, number=number: place(number)
        count = int(numbers(words[:1], np.int64, where)[0])
        if len(words) <= count:
            raise ValueError(f"{_at(number, place)}expected {count} corners, got the line {_excerpt(line)}")
        counts.append(count)
        corner_texts.append(b" ".join(words[1 : count + 1]))
    return fans(np.array(counts), numbers(corner_texts, np.int64, place))


def fans(
    counts: Int[np.ndarray, "polygons"], corners: Int[np.ndarray, "corners"]
) -> Int[np.ndarray, "faces 3"]:
    """Return the triangles of polygons; the triangles of a polygon share its first corner.

    Args:
        counts: number of corners of each polygon.
        corners: vertices of all polygons, one polygon after the other.
    """
    if len(counts) and counts.min() < 3:
        number = int(np.flatnonzero(counts < 3)[0])
        raise ValueError(f"face {number} (from 0) has {counts[number]} corners; expected at least 3")
    if len(counts) and (counts == 3).all():
        return corners.reshape(-1, 3).astype(np.int64)
    parts = counts - 2
    first = np.repeat(np.cumsum(counts) - counts, parts)
    step = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], 1).astype(
        np.int64
    )


def off(content: bytes) -> Parsed:
    """Parse the Object File Format; `OFF` and the counts may be on one line, also without a blank between them.

    Colours after the corners of a face, and lines after the announced faces, are skipped.
    """
    lines = text_lines(content)
    if not lines:
        raise ValueError("the file is empty; expected OFF in the first line")
    keyword, first = lines[0].strip()[:3], lines[0].strip()[3:]  # such as OFF490 518 0
    if keyword != b"OFF":
        raise ValueError(
            f"expected OFF in the first line, got {_excerpt(lines[0])}; save variants with colours or normals as PLY"
        )
    lines = [first, *lines[1:]] if first.strip() else lines[1:]
    skipped = 0 if first.strip() else 1
    counts = (
        numbers(lines[:1], np.int64, line_numbers(content, first=skipped)) if lines else np.empty(0, np.int64)
    )
    if len(counts) not in (2, 3) or (counts < 0).any() or (counts > MOST).any():
        shown = _excerpt(lines[0]) if lines else "nothing"
        raise ValueError(f"expected the numbers of vertices, faces and edges, got {shown}")
    vertices, faces = int(counts[0]), int(counts[1])
    body = lines[1:]
    if len(body) < vertices + faces:
        raise ValueError(
            f"the header announces {vertices} vertices and {faces} faces, but only {len(body)} lines follow; the file "
            "is cut short"
        )
    start = 1 + skipped
    return Parsed(
        rows(body[:vertices], "vertex", 3, line_numbers(content, first=start)),
        polygons(body[vertices : vertices + faces], line_numbers(content, first=start + vertices)),
    )


def join_continued_lines(content: bytes) -> bytes:
    """Return the content of an OBJ file in which every line that ends with a backslash is joined with the next line.

    Empty lines are added, so that the line numbers of the other lines stay the same.
    """
    if b"\\" not in content:
        return content
    lines: list[bytes] = []
    begun: list[bytes] = []
    for line in content.split(b"\n"):
        goes_on = re.search(rb"\\[ \t]*\r?\Z", line)
        if goes_on:
            begun.append(line[: goes_on.start()])
        else:
            lines += [b" ".join([*begun, line]), *[b""] * len(begun)]
            begun = []
    return b"\n".join([*lines, b" ".join(begun)] if begun else lines)


def statements(content: bytes, names: Sequence[bytes] = ()) -> Iterator[tuple[bytes, bytes]]:
    """Yield the first word and the rest of each line of an OBJ or MTL file, without comments.

    In lines whose first word is in `names`, the comment sign is an ordinary character.
    """
    for line in text_lines(content, names=names):
        key, *rest = line.split(None, 1)
        yield key, rest[0].rstrip() if rest else b""


def from_zero(
    numbers: Int[np.ndarray, "corners"], before: Sequence[int], counts: Int[np.ndarray, "polygons"]
) -> Int[np.ndarray, "corners"]:
    """Return indices (from 0) of the vertices or other elements to which the faces of an OBJ file refer.

    Args:
        numbers: numbers in the file: from 1 on, or negative, where -1 is the last element above the face. The invalid
            number 0 gives the index -1.
        before: number of elements above each face in the file.
        counts: number of corners of each face.
    """
    return np.where(numbers < 0, numbers + np.repeat(np.array(before, np.int64), counts), numbers - 1)


def obj(content: bytes) -> Parsed:
    """Parse Wavefront OBJ: vertices (with colours after the coordinates, if all have them) and faces of all objects."""
    joined = join_continued_lines(content)
    points, faces, before = [], [], []
    for key, rest in statements(joined):
        if key == b"v":
            points.append(rest)
        elif key == b"f":
            faces.append(rest)
            before.append(len(points))
    values = rows(points, "vertex", place=line_numbers(joined, key=b"v"))
    if values.size and values.shape[1] not in (3, 4, 6, 7):
        raise ValueError(
            f"expected 3 coordinates, and perhaps 3 colours, got the line v {_excerpt(points[0])}"
        )
    words = [[word.partition(b"/")[0] for word in line.split()] for line in faces]
    counts = np.array([len(line) for line in words], np.int64)
    if len(counts) and counts.min() < 3:
        raise ValueError(
            f"expected a face of at least 3 corners, got the line f {_excerpt(faces[int(counts.argmin())])}"
        )
    corners = numbers([b" ".join(line) for line in words], np.int64, line_numbers(joined, key=b"f"))
    if (corners == 0).any():
        raise ValueError("a face names vertex 0; expected numbers from 1, or from -1 backwards")
    corners = from_zero(corners, before, counts)
    vertices, colours = values[:, :3].reshape(-1, 3), values[:, -3:]
    shape = fans(counts, corners)
    return Parsed(vertices, shape, COLOURS, colours) if values.shape[1] in (6, 7) else Parsed(vertices, shape)


def stl(content: bytes) -> Parsed:
    """Parse STL, binary or text, with keywords in lower or upper case; every face has three vertices of its own."""
    announced_faces = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    announced_bytes = 84 + 50 * announced_faces
    if 84 <= announced_bytes <= len(content) and has_only_padding(content, announced_bytes):
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
        table = np.frombuffer(content, record, announced_faces, offset=84)
        corners = table["corners"].astype(np.float64).reshape(-1, 3)
    elif text.remove_byte_order_mark(content).lstrip()[:5].lower() == b"solid" and b"\0" not in content:
        corners = _stl_text(content)
    else:
        rest = len(content) - announced_bytes
        fault = (
            "the file is cut short, or is not an STL file"
            if announced_faces < 0 or rest < 0
            else f"{rest} unexpected bytes follow the faces"
        )
        raise ValueError(
            f"the file has {len(content)} bytes and announces {max(announced_faces, 0)} faces, which take "
            f"{max(announced_bytes, 84)} bytes; {fault}"
        )
    return Parsed(corners, np.arange(len(corners)).reshape(-1, 3))


def _stl_text(content: bytes) -> Float[np.ndarray, "corners 3"]:
    lines = [line.split() for line in text_lines(content, b"//")]
    keys = [line[0].lower() for line in lines]
    # also "end solid", "end facet"
    keys = [
        key + line[1].lower() if key == b"end" and len(line) > 1 else key
        for key, line in zip(keys, lines, strict=True)
    ]
    chosen = [number for number, key in enumerate(keys) if key == b"vertex"]
    every = line_numbers(content, b"//")
    corners = rows(
        [b" ".join(lines[number][1:]) for number in chosen], "vertex", 3, lambda line: every(chosen[line])
    )
    opened, ended = keys.count(b"facet"), keys.count(b"endfacet")
    solids, closed = keys.count(b"solid"), keys.count(b"endsolid")
    if opened != ended or len(corners) != 3 * opened or solids != closed:
        raise ValueError(
            f"the file has {opened} facets with {len(corners)} corners, {ended} ends of facets, {solids} solids and "
            f"{closed} ends of solids; expected 3 corners for each facet, and as many ends as beginnings; the file "
            "is cut short"
        )
    return corners


def has_only_padding(content: bytes, end: int) -> bool:
    """Return true if only blank bytes, at most `PADDING`, follow `end` in a binary file; editors may add these."""
    return len(content) - end <= PADDING and not content[end:].strip(b" \t\r\n\x1a")


def xyz(content: bytes) -> Parsed:
    """Parse a text file with one point in each line; blanks, tabs, commas or semicolons separate the numbers.

    The first three numbers are the coordinates, and the further columns are called column_4 and so on. If the first
    line has as many names as there are columns (`x y z red …`, also as a comment), these name the columns, which may
    then be in any order.
    """
    plain = _blank_separated(text.remove_byte_order_mark(content))
    if b"//" in plain:
        plain = re.sub(rb"(?:(?<![\d.])//|//(?!\w))[^\r\n]*", _as_comment, plain)
    head = re.split(rb"[\r\n]", plain.lstrip(), maxsplit=1)[0]
    names = column_names(
        [text.column_name(word.decode("utf-8", "replace")) for word in head.lstrip(b"#/ ").split()]
    )
    lines, first = text_lines(plain), 0
    named = set(XYZ) <= set(names)
    if named and not head.startswith(b"#"):
        lines, first = lines[1:], 1
    values = rows(lines, "point", place=line_numbers(plain, first=first))
    if len(values) and values.shape[1] < 3:
        raise ValueError(f"expected at least 3 numbers for each point, got the line {_excerpt(lines[0])}")
    if named and head.startswith(b"#") and names[:3] != XYZ and len(names) != values.shape[1]:
        named = False  # an ordinary comment that contains these words
    if not named:
        return _table(values, None)
    if len(values) and len(names) != values.shape[1]:
        raise ValueError(
            f"the first line names {len(names)} columns, but each point has {values.shape[1]} numbers; expected a "
            "name for each number"
        )
    text.require_distinct(names)
    more = [name for name in names if name not in XYZ]
    order = [names.index(name) for name in (*XYZ, *more)]
    return _table(
        values if order == [*range(len(order))] or not len(values) else values[:, order], tuple(more)
    )


def _as_comment(match: re.Match[bytes]) -> bytes:
    return b"#" + match[0]


DECIMAL_COMMA = re.compile(rb"\d,\d")
OTHER_SEPARATOR = re.compile(
    rb"[\d.](?:[ \t]++;?+|;)[ \t]*+[-+.\d]"
)  # possessive quantifiers keep it in linear time
QUOTED_COMMA = re.compile(rb"\"[-+]?\d*,\d")
NO_NUMBER = re.compile(rb"[,;][ \t]*[,;]")


def _blank_separated(content: bytes) -> bytes:
    """Return the content of a cloud's text file after replacing other separators between numbers by blanks.

    Raises:
        ValueError: a comma is the decimal sign, or a number is missing between two separators; the message names the
            line.
    """
    if b'"' in content:
        _refuse(content, lambda line: QUOTED_COMMA.search(line) is not None, COMMAS)
        content = content.replace(b'"', b"")
    if b"," not in content and b";" not in content:
        return content
    other = next((sign for sign in (b" ", b"\t", b";") if sign in content), None)
    if other and DECIMAL_COMMA.search(content) and OTHER_SEPARATOR.search(content):
        _refuse(
            content, lambda line: bool(DECIMAL_COMMA.search(line) and OTHER_SEPARATOR.search(line)), COMMAS
        )
    if NO_NUMBER.search(content) if other else b",," in content:
        _refuse(
            content,
            lambda line: NO_NUMBER.search(line) is not None,
            "a number is missing between two separators",
        )
    return content.translate(BLANKS)


BLANKS = bytes.maketrans(b",;\t", b"   ")
COMMAS = "commas stand for decimal points, or separate beside another separator; write decimals with a point"


def _refuse(content: bytes, wrong: Callable[[bytes], bool], why: str) -> None:
    """Raise a ValueError for the first line, without its comment, for which `wrong` returns true.

    Args:
        content: bytes of the file.
        wrong: function that returns true for a line to be refused.
        why: reason, for the message.
    """
    for number, line in enumerate(_lines(content, b"#", ()), 1):
        if not re.match(rb"\s*//", line) and wrong(line):
            raise ValueError(f"line {number}: {why}, got {_excerpt(line)}")


def npy(content: bytes) -> Parsed:
    """Parse a NumPy array of numbers, (points, 3 or more)."""
    return _table(_points(arrays.read_npy(content)), None)


def npz(content: bytes) -> Parsed:
    """Parse a NumPy archive with points, and perhaps attributes and faces.

    The points are the array `points`, or the only array. `normals`, `colors` and every other array with one number for
    each point are attributes. `faces` are triangles.
    """
    stored_arrays = arrays.read_npz(content)
    require_numbers(sum(array.size for array in stored_arrays.values()), MOST_NUMBERS, len(content))
    key = "points" if "points" in stored_arrays or len(stored_arrays) != 1 else next(iter(stored_arrays))
    if key not in stored_arrays:
        raise ValueError(
            f"expected an array named points, got {shorten(', '.join(stored_arrays)) or 'nothing'}"
        )
    points = _points(stored_arrays.pop(key))
    faces = stored_arrays.pop("faces", np.empty((0, 3), np.int64))
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(f"expected faces of shape (faces, 3), got {faces.dtype} {faces.shape}")
    table = _table(points, None)
    columns, parts = list(table.columns), [] if table.attributes is None else [table.attributes]
    groups = {"normals": NORMALS, "colors": COLOURS, "colours": COLOURS}
    for name, values in stored_arrays.items():
        names = groups.get(name, (name,))
        shapes = [(len(points), len(names))] + [(len(points),)] * (len(names) == 1)
        if values.dtype.kind not in "biuf" or values.shape not in shapes:
            continue  # an array that has no row for each point
        full = np.iinfo(values.dtype).max if names == COLOURS and values.dtype.kind == "u" else 1
        parts.append(values.reshape(len(points), len(names)).astype(np.float64) / full)
        columns += column_names(names)
    attributes = np.concatenate(parts, 1) if parts else None
    return Parsed(table.vertices, faces.astype(np.int64), tuple(columns), attributes)


def _points(array: NDArray) -> Float[np.ndarray, "points columns"]:
    if array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"expected numbers of shape (points, 3 or more), got {array.dtype} {array.shape}")
    return array.astype(np.float64)


def _table(values: NDArray, names: tuple[str, ...] | None) -> Parsed:
    if values.shape[1] > MOST_COLUMNS:
        raise ValueError(f"each point has {values.shape[1]} numbers; expected at most {MOST_COLUMNS}")
    more = max(values.shape[1] - 3, 0)
    columns = names or tuple(f"column_{number}" for number in range(4, 4 + more))
    vertices = values[:, :3].reshape(-1, 3)
    return Parsed(vertices, np.empty((0, 3), np.int64), columns, values[:, 3:] if more else None)


def _excerpt(text: bytes) -> str:
    """Return at most 60 bytes from the beginning of a word or line, as quoted text for a message."""
    plain = text[:60].decode("utf-8", "replace").strip()
    return repr(plain + ("…" if len(text) > 60 else ""))
