"""A Parquet table by columns, with cells as texts, so that it is checked and read as the same table in CSV."""

from typing import Any, BinaryIO, NamedTuple

from framework.storage import text
from framework.storage.limits import MOST_NUMBERS, MOST_TABLE_COLUMNS
from framework.storage.reading import most_decompressed, require_numbers

MARK = b"PAR1"
"""First and last bytes of a Parquet file."""
CUT = MARK + b"\x15"
"""First bytes of most Parquet files, with which no text begins; the end of the file may be missing."""
ROWS_AT_ONCE = 2**16
LONGEST_ENTRY, MOST_ENTRIES = 2**26, 2**22
"""Largest number of bytes of a text in the description of the table, and of entries of a list in it."""


class ParquetColumns(NamedTuple):
    """Cells of a Parquet table.

    Attributes:
        names: names of the columns.
        cells: cells of each column, without surrounding blanks; a missing value is "".
        left_out: columns that hold neither numbers nor words, with the reason.
    """

    names: list[str]
    cells: list[list[str]]
    left_out: dict[str, str]


def is_parquet(stream: BinaryIO) -> bool:
    """Return whether a file begins as a Parquet table and is no text; the position in the file is 0 afterwards."""
    first = stream.read(len(CUT))
    size = stream.seek(0, 2)
    stream.seek(max(0, size - len(MARK)))
    last = stream.read(len(MARK))
    stream.seek(0)
    return first == CUT or (first[: len(MARK)] == last == MARK and size > 2 * len(MARK))


def read_parquet(stream: BinaryIO) -> ParquetColumns:
    """Read a Parquet table; dates become texts, and TRUE and FALSE are written as such.

    Args:
        stream: the open file.

    Raises:
        ValueError: the file has too many columns or two of the same name, or decompresses to more cells or letters than
            `require_numbers` and `most_decompressed` allow.
        OSError: the file is damaged.
    """
    from pyarrow import parquet  # loads libraries that other tables do not need

    size = stream.seek(0, 2)
    stream.seek(0)
    # extension types would create objects of other packages; a page with a checksum must fit it
    options: dict[str, Any] = {"arrow_extensions_enabled": False, "page_checksum_verification": True}
    options |= {"thrift_string_size_limit": LONGEST_ENTRY, "thrift_container_size_limit": MOST_ENTRIES}
    opened = parquet.ParquetFile(stream, **options)
    schema, rows = opened.schema_arrow, opened.metadata.num_rows
    if len(schema) > MOST_TABLE_COLUMNS:
        raise ValueError(f"the table has {len(schema)} columns, but at most {MOST_TABLE_COLUMNS} are allowed")
    text.require_distinct(schema.names)
    words = [field.name for field in schema if _is_text(field.type)]
    stream.seek(0)
    # words that repeat are stored once, and are kept so: a long word in many rows would take all memory otherwise
    opened = parquet.ParquetFile(stream, read_dictionary=words, **options)
    most = most_decompressed(size)
    left_out = {
        field.name: "row labels of pandas" if _is_index(field.name) else f"holds values of type {field.type}"
        for field in schema
        if _is_index(field.name) or not _is_plain(field.type)
    }
    names = [field.name for field in schema if field.name not in left_out]
    require_numbers(rows * len(names), MOST_NUMBERS, size)
    letters = 0
    cells: list[list[str]] = [[] for _ in names]
    for batch in opened.iter_batches(ROWS_AT_ONCE, columns=names, use_threads=False):
        for name, column in zip(names, cells, strict=True):
            texts = _texts(batch.column(name))
            letters += sum(map(len, texts))
            if letters > most:
                raise ValueError(f"the file decompresses to more than {most} letters")
            column.extend(texts)
    return ParquetColumns(names, cells, left_out)


def _is_index(name: str) -> bool:
    """Return whether pandas gives this name to row labels that have no name."""
    return name.startswith("__index_level_") and name.endswith("__")


def _is_text(kind: Any) -> bool:
    from pyarrow import types

    return types.is_string(kind) or types.is_large_string(kind)


def _is_plain(kind: Any) -> bool:
    """Return whether a column of an Arrow type holds numbers, words, dates or logical values."""
    from pyarrow import types

    if types.is_dictionary(kind):
        return _is_plain(kind.value_type)
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal)
    others = (_is_text, types.is_null, types.is_date, types.is_timestamp, types.is_time)
    return any(test(kind) for test in (*numbers, *others))


def _texts(array: Any) -> list[str]:
    """Return the cells of a column as texts; equal words of a dictionary are the same object."""
    import pyarrow as pa
    from pyarrow import types

    if types.is_dictionary(array.type):
        words = _texts(array.dictionary)
        return ["" if index is None else words[index] for index in array.indices.to_pylist()]
    if types.is_floating(array.type):  # the shortest text that gives the same float64
        return [
            "" if value is None or value != value else repr(value)
            for value in array.cast(pa.float64()).to_pylist()
        ]
    if types.is_boolean(array.type):
        return ["" if value is None else str(value).upper() for value in array.to_pylist()]
    if types.is_null(array.type):
        return [""] * len(array)
    if not _is_text(array.type):
        array = array.cast(pa.string())
    return ["" if value is None else value.strip() for value in array.to_pylist()]
