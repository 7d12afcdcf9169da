"""Parses mesh and cloud files into arrays, one function a format; what a file does not hold is never made up.

Every parser takes the bytes of a file and raises a ValueError that says what came and what was wanted; the caller,
`geometry.meshes`, names the file. PLY has a module of its own. Comments are skipped, line ends may be those of any
system, polygons are cut into fans of triangles (right where they are convex).
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from framework.errors import shown
from framework.storage import arrays
from framework.storage.limits import MOST_ANNOUNCED as MOST
from framework.storage.limits import MOST_COLUMNS, MOST_NUMBERS
from framework.storage.reading import require_numbers

XYZ = ("x", "y", "z")
COLOURS = ("red", "green", "blue")
NORMALS = ("normal_x", "normal_y", "normal_z")
OTHER_NAMES = {"r": "red", "g": "green", "b": "blue", "nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
"""What files call the columns that have a name of their own here."""


class Parsed(NamedTuple):
    """What a file holds: `attributes` has one column for each of `columns`, whose values are as the file has them."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    columns: tuple[str, ...] = ()
    attributes: Float[np.ndarray, "vertices columns"] | None = None


def column_names(names: Sequence[str]) -> tuple[str, ...]:
    """The project's names of columns, small letters."""
    small = [name.lower() for name in names]
    return tuple(OTHER_NAMES.get(name, name) for name in small)


def text_lines(content: bytes, comment: bytes = b"#", names: Sequence[bytes] = ()) -> list[bytes]:
    """The lines that are neither blank nor a comment, without their comments.

    Args:
        comment: what begins a comment, anywhere in a line.
        names: first words of lines whose rest is a name, which may hold what begins a comment elsewhere.
    """
    plain = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if comment in plain:
        cut = re.escape(comment) + rb"[^\n]*"
        if names:  # a whole line with a name is found first, and stays
            cut = rb"^([ \t]*(?:" + b"|".join(map(re.escape, names)) + rb")[ \t][^\n]*)|" + cut
        plain = re.sub(cut, rb"\1" if names else b"", plain, flags=re.MULTILINE)
    return [line for line in plain.split(b"\n") if line and not line.isspace()]


def numbers(lines: Sequence[bytes], dtype: type = np.float64) -> NDArray:
    """All numbers of some lines, in a row."""
    text = b" ".join(lines).strip()  # NumPy reads a number out of blanks
    try:
        return np.fromstring(text, dtype=dtype, sep=" ") if text else np.empty(0, dtype)
    except ValueError:
        kind = "a whole number" if dtype is np.int64 else "a number"
        for line in lines:
            for word in line.split():
                try:
                    np.fromstring(word, dtype=dtype, sep=" ")
                except ValueError:
                    raise ValueError(
                        f"wanted {kind}, got {_shown(word)} in the line {_shown(line)}"
                    ) from None
        raise


def rows(lines: Sequence[bytes], what: str, width: int | None = None) -> Float[np.ndarray, "rows width"]:
    """Lines of equally many numbers; `width` None: as many as the first has.

    Raises:
        ValueError: a line has another number of them; names it.
    """
    wanted = len(lines[0].split()) if width is None and lines else width or 0
    values = numbers(lines)
    if len(values) != wanted * len(lines) or any(len(line.split()) != wanted for line in lines):
        line = next(line for line in lines if len(line.split()) != wanted)
        raise ValueError(f"wanted {wanted} numbers for each {what}, got the line {_shown(line)}")
    return values.reshape(len(lines), wanted)


def polygons(lines: Sequence[bytes]) -> Int[np.ndarray, "faces 3"]:
    """Faces written as their number of corners, the corners, and perhaps more (colours), which is left out."""
    if not lines:
        return np.empty((0, 3), np.int64)
    corners = int(numbers(lines[0].split()[:1], np.int64)[0])
    try:
        flat = numbers(lines, np.int64)
    except ValueError:  # colours, or no number at all: line by line below
        flat = np.empty(0, np.int64)
    alike = corners >= 3 and len(flat) == len(lines) * (corners + 1)
    if alike and (flat[:: corners + 1] == corners).all():
        counts = np.full(len(lines), corners)
        return fans(counts, flat.reshape(-1, corners + 1)[:, 1:].ravel())
    counts, found = [], []
    for line in lines:
        words = line.split()
        count = int(numbers(words[:1], np.int64)[0])
        if len(words) <= count:
            raise ValueError(f"wanted {count} corners, got the line {_shown(line)}")
        counts.append(count)
        found += words[1 : count + 1]
    return fans(np.array(counts), numbers(found, np.int64))


def fans(
    counts: Int[np.ndarray, "polygons"], corners: Int[np.ndarray, "corners"]
) -> Int[np.ndarray, "faces 3"]:
    """Polygons of `counts` corners each, cut into triangles that share the polygon's first corner."""
    if len(counts) and counts.min() < 3:
        number = int(np.flatnonzero(counts < 3)[0])
        raise ValueError(f"face {number} (from 0) has {counts[number]} corners; wanted at least 3")
    if len(counts) and (counts == 3).all():
        return corners.reshape(-1, 3).astype(np.int64)
    parts = counts - 2
    first = np.repeat(np.cumsum(counts) - counts, parts)
    step = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], 1).astype(
        np.int64
    )


def off(content: bytes) -> Parsed:
    """Object File Format, also with `OFF` and the counts on one line or without a blank between them.

    Colours behind the corners of a face, and what follows the announced faces, are no part of the shape.
    """
    lines = text_lines(content)
    if not lines:
        raise ValueError("the file is empty; wanted OFF in its first line")
    keyword, first = lines[0].strip()[:3], lines[0].strip()[3:]  # OFF490 518 0
    if keyword != b"OFF":
        raise ValueError(
            f"wanted OFF in its first line, got {_shown(lines[0])}; save variants with colours or normals as PLY"
        )
    lines = [first, *lines[1:]] if first.strip() else lines[1:]
    counts = numbers(lines[0].split(), np.int64) if lines else np.empty(0, np.int64)
    if len(counts) not in (2, 3) or (counts < 0).any() or (counts > MOST).any():
        shown = _shown(lines[0]) if lines else "nothing"
        raise ValueError(f"wanted the numbers of vertices, faces and edges, got {shown}")
    vertices, faces = int(counts[0]), int(counts[1])
    body = lines[1:]
    if len(body) < vertices + faces:
        raise ValueError(
            f"its header announces {vertices} vertices and {faces} faces, but only {len(body)} lines follow; it is cut "
            "short"
        )
    return Parsed(rows(body[:vertices], "vertex", 3), polygons(body[vertices : vertices + faces]))


def obj(content: bytes) -> Parsed:
    """Wavefront OBJ: vertices (with colours behind the coordinates, where all have them) and faces of all objects."""
    joined = re.sub(rb"\\[ \t]*\r?\n", b" ", content)  # a line that goes on
    points, faces, before = [], [], []
    for line in text_lines(joined):
        key, *rest = line.split(None, 1)
        if key == b"v":
            points += rest or [b""]
        elif key == b"f":
            faces += rest or [b""]
            before.append(len(points))
    values = rows(points, "vertex")
    if values.size and values.shape[1] not in (3, 4, 6, 7):
        raise ValueError(f"wanted 3 coordinates, and perhaps 3 colours, got the line v {_shown(points[0])}")
    words = [[word.partition(b"/")[0] for word in line.split()] for line in faces]
    counts = np.array([len(line) for line in words], np.int64)
    if len(counts) and counts.min() < 3:
        raise ValueError(
            f"wanted a face of at least 3 corners, got the line f {_shown(faces[int(counts.argmin())])}"
        )
    corners = numbers([word for line in words for word in line], np.int64)
    if (corners == 0).any():
        raise ValueError("a face names vertex 0; wanted numbers from 1, or from -1 backwards")
    corners = np.where(corners > 0, corners - 1, corners + np.repeat(np.array(before, np.int64), counts))
    vertices, colours = values[:, :3].reshape(-1, 3), values[:, -3:]
    shape = fans(counts, corners)
    return Parsed(vertices, shape, COLOURS, colours) if values.shape[1] in (6, 7) else Parsed(vertices, shape)


def stl(content: bytes) -> Parsed:
    """STL, binary or text; every face has corners of its own."""
    promised = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    if len(content) == 84 + 50 * promised:
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
        corners = np.frombuffer(content, record, offset=84)["corners"].astype(np.float64).reshape(-1, 3)
    elif content.lstrip()[:5].lower() == b"solid" and b"\0" not in content:
        lines = [line.split() for line in text_lines(content, b"//")]
        corners = rows([b" ".join(line[1:]) for line in lines if line[0] == b"vertex"], "vertex", 3)
        opened = sum(line[0] == b"facet" for line in lines)
        ended = sum(line[0] == b"endfacet" for line in lines)
        solids = [line[0] for line in lines if line[0] in (b"solid", b"endsolid")]
        if opened != ended or len(corners) != 3 * opened or solids.count(b"endsolid") * 2 != len(solids):
            raise ValueError(
                f"{opened} facets are opened, {ended} ended, with {len(corners)} corners; wanted 3 a facet and an "
                "endsolid; it is cut short"
            )
    else:
        raise ValueError(
            f"it has {len(content)} bytes and announces {max(promised, 0)} faces, which take "
            f"{84 + 50 * max(promised, 0)}; it is cut short, or no STL"
        )
    return Parsed(corners, np.arange(len(corners)).reshape(-1, 3))


def xyz(content: bytes) -> Parsed:
    """A point in each line, numbers separated by blanks, tabs, commas or semicolons; the first three are coordinates.

    A first line of as many names (`x y z red …`, also as a comment) names the columns; else they are column_4 and on.
    """
    plain = re.sub(rb"[,;\t]", b" ", content)
    head = re.split(rb"[\r\n]", plain.lstrip(), maxsplit=1)[0].lstrip(b"#/ ")
    first = [word.decode("utf-8", "replace") for word in head.split()]  # text has blanks that bytes have not
    named = bool(first) and column_names(first)[:3] == XYZ
    lines = text_lines(re.sub(rb"//[^\n]*", b"", plain))
    if named and lines and lines[0].split()[0].lower() == b"x":
        lines = lines[1:]
    values = rows(lines, "point")
    if len(values) and values.shape[1] < 3:
        raise ValueError(f"wanted at least 3 numbers for each point, got the line {_shown(lines[0])}")
    if named and len(values) and len(first) != values.shape[1]:
        raise ValueError(
            f"its first line names {len(first)} columns, but each point has {values.shape[1]} numbers"
        )
    return _table(values, column_names(first)[3:] if named else None)


def npy(content: bytes) -> Parsed:
    """A NumPy array of (points, 3 or more) numbers."""
    return _table(_points(arrays.array(content)), None)


def npz(content: bytes) -> Parsed:
    """A NumPy archive: `points`, or the only array; `normals`, `colors` and other columns by their names; `faces`."""
    held = arrays.archive(content)
    require_numbers(sum(array.size for array in held.values()), MOST_NUMBERS, len(content))
    key = "points" if "points" in held or len(held) != 1 else next(iter(held))
    if key not in held:
        raise ValueError(f"wanted an array named points, got {shown(', '.join(held)) or 'nothing'}")
    points = _points(held.pop(key))
    faces = held.pop("faces", np.empty((0, 3), np.int64))
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(f"wanted faces of shape (faces, 3), got {faces.dtype} {faces.shape}")
    table = _table(points, None)
    columns, parts = list(table.columns), [] if table.attributes is None else [table.attributes]
    groups = {"normals": NORMALS, "colors": COLOURS, "colours": COLOURS}
    for name, values in held.items():
        names = groups.get(name, (name,))
        if values.dtype.kind not in "biuf" or values.shape not in {(len(points), len(names)), (len(points),)}:
            continue  # of the file, not of its points
        full = np.iinfo(values.dtype).max if names == COLOURS and values.dtype.kind == "u" else 1
        parts.append(values.reshape(len(points), -1).astype(np.float64) / full)
        columns += column_names(names)
    attributes = np.concatenate(parts, 1) if parts else None
    return Parsed(table.vertices, faces.astype(np.int64), tuple(columns), attributes)


def _points(array: NDArray) -> Float[np.ndarray, "points columns"]:
    if array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"wanted numbers of shape (points, 3 or more), got {array.dtype} {array.shape}")
    return array.astype(np.float64)


def _table(values: NDArray, names: tuple[str, ...] | None) -> Parsed:
    if values.shape[1] > MOST_COLUMNS:
        raise ValueError(f"each point has {values.shape[1]} numbers; wanted at most {MOST_COLUMNS}")
    more = max(values.shape[1] - 3, 0)
    columns = names or tuple(f"column_{number}" for number in range(4, 4 + more))
    vertices = values[:, :3].reshape(-1, 3)
    return Parsed(vertices, np.empty((0, 3), np.int64), columns, values[:, 3:] if more else None)


def _shown(text: bytes) -> str:
    """The beginning of a word or line, for a message."""
    plain = text[:60].decode("utf-8", "replace").strip()
    return repr(plain + ("…" if len(text) > 60 else ""))
