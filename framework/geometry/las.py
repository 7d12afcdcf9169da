"""Reader of laser scans in LAS, with laspy (the optional dependency `las`)."""

import io
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from framework.geometry.mesh_files import COLOURS, Parsed, column_names
from framework.storage import text
from framework.storage.limits import MOST_COLUMNS

HEADER, RECORD = 227, 54
"""Size of the smallest header of a file, and of the header of a record that stands before the points, bytes."""
COMPRESSED = 0b1000_0000
"""Bit of the number of the point format that says that the points are compressed."""
COORDINATES = ("X", "Y", "Z")
"""Names of the coordinates as LAS stores them, integers with a scale and an offset."""


def las(content: bytes) -> Parsed:
    """Parse a laser scan in LAS 1.0 to 1.4; every number of its points is an attribute, such as `classification`.

    Colours are scaled from 0…65535 to 0…1.

    Raises:
        ValueError: laspy is not installed; the file is compressed (LAZ), damaged or cut short; two attributes have the
            same name, or there are more than MOST_COLUMNS.
    """
    try:
        import laspy
    except ModuleNotFoundError as error:
        raise ValueError(
            "reading it needs laspy, which is not installed. Run pip install -e '.[las]', or save the scan as PLY"
        ) from error
    _check_header(content)
    with laspy.LasReader(io.BytesIO(content), read_evlrs=False) as reader:
        header = reader.header
        needed = header.offset_to_point_data + header.point_count * header.point_format.size
        if needed > len(content):
            raise ValueError(
                f"its {header.point_count} points end at byte {needed}, but the file has {len(content)} bytes"
            )
        if len([*header.point_format.dimension_names]) > MOST_COLUMNS:
            raise ValueError(f"each point has more than {MOST_COLUMNS} numbers")
        # `read` would also read records behind the points
        points: Any = reader.read_points(header.point_count)
    names, parts = zip(*_columns(points), strict=True)
    text.require_distinct(names)
    coordinates = np.stack([points.x, points.y, points.z], -1)
    return Parsed(coordinates, np.empty((0, 3), np.int64), names, np.stack(parts, -1))


def _check_header(content: bytes) -> None:
    """Refuse a file with compressed points, and one whose records do not fit between its header and its points.

    laspy would read a wrong number of records for hours.
    """
    if len(content) < HEADER or not content.startswith(b"LASF"):
        raise ValueError("expected a file that begins with LASF and a header")
    size, start, records = struct.unpack_from("<HII", content, 94)
    if not HEADER <= size <= size + RECORD * records <= start <= len(content):
        raise ValueError(
            f"its {records} records do not fit between the header of {size} bytes and the points from byte {start} on"
        )
    if content[104] & COMPRESSED:  # lazrs, which reads them, ends the process if such a file is damaged
        raise ValueError("the points are compressed (LAZ); save the scan as LAS, for example with laszip")


def _columns(points: Any) -> Iterator[tuple[str, Float[np.ndarray, "points"]]]:
    """Yield the name and the numbers of each attribute; one of several numbers gives `name_1`, `name_2` and so on."""
    for name in points.point_format.dimension_names:
        if name in COORDINATES:
            continue
        values: NDArray[Any] = np.asarray(points[name], np.float64)
        (short,) = column_names([name])
        if short in COLOURS:
            values = values / np.iinfo(np.uint16).max
        if values.ndim == 1:
            yield short, values
        else:
            yield from ((f"{short}_{number}", part) for number, part in enumerate(values.T, 1))
