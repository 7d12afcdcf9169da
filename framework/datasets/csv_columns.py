"""A CSV table of numbers and words, by columns; error messages name the line and the column.

`framework.storage.text` decides which words are numbers. `Writing` is the part of the config that describes the
notation of a user's table. A column that holds words, row numbers or nothing is left out and reported
(`ColumnChoice.left_out`). A column whose cells would be numbers in another notation is refused, and the message names
the setting that reads it.
"""

import csv
import gzip
import io
import itertools
import math
import re
import shlex
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from framework.datasets.parquet_columns import is_parquet, read_parquet
from framework.errors import DataError, did_you_mean, quote, shorten
from framework.storage import text
from framework.storage.limits import MOST_NUMBERS
from framework.storage.limits import MOST_TABLE_COLUMNS as MOST_COLUMNS
from framework.storage.path_marks import Words
from framework.storage.reading import (
    Bounded,
    most_decompressed,
    open_regular,
    read_bytes,
    require_numbers,
    translate_errors,
)

MISSING = frozenset(
    {"", "na", "n/a", "#n/a", "#na", "<na>", "nan", "-nan", "nan(ind)", "-nan(ind)", "null", "none", "nil", "nat", "?"}
    | {".", "-", "--", "\N{EN DASH}", "\N{EM DASH}", "1.#ind", "-1.#ind", "1.#qnan", "-1.#qnan"}
    | {"#div/0!", "#value!", "#num!", "#ref!", "#name?", "#null!"}
)  # fmt: skip
"""Words, in small letters, that pandas, R and spreadsheets write into a cell without a number or label."""
BOOLEANS = {"true": 1.0, "false": 0.0}
"""Numbers as which the words TRUE and FALSE (in small letters) are read."""
DATE = re.compile(r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}([T ].*)?|\d{1,2}[-/.]\d{1,2}[-/.](\d{4}|\d\d)([T ].*)?")
"""Calendar date, perhaps with a time of day, in the usual orders of year, month and day."""
ENOUGH_ROWS = 20
"""Largest number of rows of a table that is not searched for columns of row numbers or of angles in radians."""
INDEX = re.compile(
    r"unnamed: \d+(_level_\d+)?|index|level_\d+|row|rows?[ _.]?(number|name|id|index)s?|rownum|id|idx", re.I
)
"""Names that pandas, R and databases give to a column that numbers the rows."""
ALWAYS_INDEX = re.compile(r"unnamed: \d+(_level_\d+)?|row[ _.]?ids?|rownum|id|idx", re.I)
"""Names among these that nobody gives to a measurement, so that their numbers may occur twice."""
NUMBER_OF_THING = re.compile(
    r"(?i:[_ .-](id|nr|no|num|number|key)\.?|^nr\.?|nummer)$|(?<=[a-z])(I[dD]|N[rRo]|Num|Number|Key)$"
)
"""Names of columns that often hold the number of a thing: customer_id, PassengerId, Order No., Nr, Kundennummer."""
GZIP = b"\x1f\x8b"
"""First bytes of a file that is compressed with gzip."""
CELLS_AT_ONCE = 2**9
"""Number of cells that are sorted into columns at once, which is several times as fast as one by one."""
MOST_LOOKED_AT = 2000
"""Largest number of cells, evenly spaced in a column of words, that are checked for numbers in another notation."""
FIRST_LINES = 40
"""Number of lines in which the separator of a table is looked for."""
MOST_LISTED = 12
"""Largest number of columns that a sentence lists."""
Separator = Literal["comma", "semicolon", "tab", "bar", "space", ",", ";", "\t", "|", " "]
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "bar": "|", "space": " "}
GROUPED_BY_POINTS = text.GROUPED["point"]
GROUPING = {
    "comma": ",",
    "point": ".",
    "space": text.BLANKS,
    "apostrophe": "'\N{RIGHT SINGLE QUOTATION MARK}",
}


@dataclass(frozen=True, kw_only=True)
class Writing:
    """Settings for the notation of a user's table.

    Attributes:
        separator: the sign between cells; None: the comma, semicolon, tab or bar that separates the names in the first
            line.
        decimal: the decimal sign.
        thousands: the sign between groups of three digits, as in 1,234,567; None: no sign.
        units: units that may stand beside the numbers of a column ("%", "$", "kg"). They are removed: 5% becomes 5.
        encoding: the encoding of the letters. Excel writes windows-1252 in Western European languages, unless "CSV
            UTF-8" is chosen. A file with the byte-order mark of UTF-8 is always read as UTF-8.
    """

    separator: Separator | None = None
    decimal: Literal["point", "comma", ".", ","] = "point"
    thousands: Literal["comma", "point", "space", "apostrophe"] | None = None
    units: list[Words] | None = None
    encoding: Literal["utf-8", "windows-1252"] = "utf-8"

    def __post_init__(self) -> None:
        if self.thousands and GROUPING[self.thousands] == self.sign:
            raise DataError(
                f"data.decimal and data.thousands are both {self.thousands}, but the two signs must differ. Change "
                "one of them."
            )

    @property
    def delimiter(self) -> str | None:
        """Sign between cells; None if the first line decides it."""
        return None if self.separator is None else SEPARATORS.get(self.separator, self.separator)

    @property
    def sign(self) -> str:
        """Decimal sign as a character."""
        return GROUPING.get(self.decimal, self.decimal)

    @property
    def missing(self) -> frozenset[str]:
        """Words, in small letters, that mark a cell without a value."""
        return MISSING

    @cached_property
    def plain(self) -> bool:
        """True if numbers have a decimal point, no separator of thousands and no unit."""
        return self.sign == "." and self.thousands is None and not self.units

    def standard(self, cell: str) -> str:
        """Return the number in a cell as a text that `float` reads; for other cells, a text that `float` refuses."""
        return self._plain_notation(self.split_unit(cell)[0])

    def split_unit(self, cell: str) -> tuple[str, str]:
        """Return a cell without its unit, and the unit; the unit is "" if the cell has none."""
        cell = text.trim(cell).translate(text.MINUS)
        for unit in sorted(self.units or (), key=len, reverse=True):
            sign = cell[:1] if cell[:1] in ("+", "-") else ""
            if cell[len(sign) :].startswith(unit):
                return sign + cell[len(sign) + len(unit) :].strip(), unit
            if cell.endswith(unit):
                return cell.removesuffix(unit).strip(), unit
        return cell, ""

    def _plain_notation(self, cell: str) -> str:
        """Return the number in a cell, rewritten with a decimal point and without signs between groups of digits.

        A cell with digits that does not fit the notation gets a leading "_", so that it is not read as a number.
        """
        if self.sign == "." and self.thousands is None:
            return cell
        between, sign = (
            f"[{re.escape(GROUPING[self.thousands])}]" if self.thousands else "",
            re.escape(self.sign),
        )
        whole_pattern = rf"\d{{1,3}}(?:{between}\d{{3}})+|\d+" if between else r"\d+"
        parts = re.fullmatch(rf"([+-]?)({whole_pattern})?(?:{sign}(\d*))?((?:[eEdD][+-]?\d+)?)", cell)
        if parts is None:
            return f"_{cell}" if any(letter.isdigit() for letter in cell) else cell
        digits = re.sub(between, "", parts[2] or "") if between else parts[2] or ""
        return f"{parts[1]}{digits}.{parts[3] or ''}{parts[4]}"


@dataclass(frozen=True, kw_only=True)
class LabelledWriting(Writing):
    """Settings for the notation of a table with labels and missing numbers.

    Attributes:
        missing_words: words that mark a cell without a value, in addition to empty cells; None: the words in MISSING.
            With [] only empty cells are missing, for tables where "none" or "NA" is a label.
    """

    missing_words: list[Words] | None = None

    @cached_property
    def missing(self) -> frozenset[str]:
        """Words, in small letters, that mark a cell without a value."""
        return MISSING if self.missing_words is None else frozenset(["", *map(str.lower, self.missing_words)])


PLAIN = Writing()


@dataclass(frozen=True)
class Columns:
    """Cells of a table by column.

    Attributes:
        file: the file of the table.
        cells: cells by column name, without surrounding blanks.
        lines: for each row, the number of the line on which it ends.
        writing: notation of the table; None: the table has decimal points and no units, and no setting changes this.
        left_out: columns without a name that were left out, with the reason.
    """

    file: Path
    cells: dict[str, list[str]]
    lines: list[int]
    writing: Writing | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def notation(self) -> Writing:
        """Notation of the table; `PLAIN` if the table has no settings."""
        return self.writing or PLAIN

    def notation_of(self, name: str) -> Writing:
        """Return the notation of one column.

        In a table with decimal commas, a column may have decimal points. This is assumed if the column contains no
        comma, and contains points of which at least one cannot separate groups of three digits.
        """
        notation = self.notation
        if notation.sign != ",":
            return notation
        cells = [cell.lstrip("+-") for cell in self.cells[name]]
        points = [cell for cell in cells if "." in cell]
        if not points or any("," in cell for cell in cells):
            return notation
        grouped = all(re.fullmatch(GROUPED_BY_POINTS, cell) for cell in points)
        return notation if grouped else replace(notation, decimal="point", thousands=None)


class ColumnChoice(NamedTuple):
    """The columns of a table that are read as numbers.

    Attributes:
        names: names of the chosen columns.
        left_out: reason why each other column is left out, by name.
        odd: for each chosen column that may not be meant as numbers, a remark, by name.
    """

    names: tuple[str, ...]
    left_out: dict[str, str]
    odd: dict[str, str]


def describe_choice(chosen: ColumnChoice) -> tuple[str, ...]:
    """Return remarks for the first lines of a run: columns left out, and columns that may not be meant as numbers."""
    left_out = [f"{quote(name)} ({why})" for name, why in chosen.left_out.items()]
    listed = (
        [*left_out[:MOST_LISTED], f"and {len(left_out) - MOST_LISTED} more"]
        if len(left_out) > MOST_LISTED
        else left_out
    )
    remarks = (f"left out: {', '.join(listed)}",) if listed else ()
    return (*remarks, *(f"{quote(name)} {why}" for name, why in chosen.odd.items()))


@contextmanager
def _open_table(file: Path, missing: str) -> Iterator[Bounded]:
    """Open the file of a table; the block raises a DataError for each error that the file causes.

    Args:
        file: path of the table.
        missing: end of the message about a file that does not exist.
    """
    with (
        translate_errors(
            file,
            "a table",
            "Save it as UTF-8 text with one row on each line, which Excel calls CSV UTF-8.",
            missing,
        ),
        open_regular(file) as stream,
    ):
        yield stream


@contextmanager
def _csv_rows(file: Path, stream: Bounded, writing: Writing | None = None) -> Iterator[Any]:
    """Yield an iterator over the rows of a CSV file, each a list of cells; the file may be compressed with gzip.

    Args:
        file: path of the table.
        stream: the open file, with or without a byte-order mark.
        writing: notation of the table; None: UTF-8, and the first line decides the separator.

    Raises:
        DataError: the text has another encoding.
    """
    source: io.BufferedReader | io.BytesIO = stream
    first = stream.peek(text.LOOKED_AT)
    if first.startswith(GZIP):
        source = io.BytesIO(_unpack(stream.read()))
        first = source.getvalue()[: text.LOOKED_AT]
    text.remove_byte_order_mark(first)
    other = writing is not None and writing.encoding == "windows-1252" and not first.startswith(BOM_UTF8)
    encoding = "cp1252" if other else "utf-8-sig"
    with io.TextIOWrapper(source, encoding=encoding, newline="") as lines:
        try:
            yield _rows(lines, writing or PLAIN)
        except UnicodeDecodeError:
            content = source.getvalue() if isinstance(source, io.BytesIO) else read_bytes(file)
            place = text.place_of_other_encoding(content, encoding)
            raise DataError(f"{file}: {place}, {_advise_encoding(other, writing is not None)}") from None


def _unpack(content: bytes) -> bytes:
    """Return the decompressed bytes of gzip data, which may have several parts.

    Raises:
        ValueError: the data decompress to more bytes or cells than `most_decompressed` and `require_numbers` allow.
        OSError, EOFError: the data are damaged or cut short.
    """
    most = most_decompressed(len(content))
    with gzip.GzipFile(fileobj=io.BytesIO(content)) as unpacker:
        unpacked = unpacker.read(most + 1)
    if len(unpacked) > most:
        raise ValueError(f"the file decompresses to more than {most} bytes")
    cells = unpacked.count(b"\n") + max(unpacked.count(sign.encode()) for sign in SEPARATORS.values())
    require_numbers(cells, MOST_NUMBERS, len(content))
    return unpacked


def _advise_encoding(other: bool, can_set: bool) -> str:
    """Return the end of a message about a byte that is not in the encoding of a table.

    Args:
        other: whether the table was read as Windows-1252.
        can_set: whether the data set has the setting of the encoding.
    """
    if other:
        return "which is not in Windows-1252. Save the table as UTF-8, and remove data.encoding."
    setting = (
        ", or set data.encoding=windows-1252 if a program of a Western European Windows wrote it"
        if can_set
        else ""
    )
    return f"which is not UTF-8. Save the table as UTF-8, which Excel calls CSV UTF-8{setting}."


def _rows(lines: io.TextIOWrapper, writing: Writing) -> Any:
    start = list(itertools.islice(lines, FIRST_LINES))
    # Excel states the separator in a line of its own
    stated = re.fullmatch(r"sep=(.)\s*", start[0]) if start else None
    sign = stated[1] if stated else writing.delimiter or _separator(start)
    rest = itertools.chain(start, lines)
    if sign == " ":
        return csv.reader(rest, strict=True, delimiter=" ", skipinitialspace=True)
    return csv.reader(rest, strict=True, delimiter=sign)


def _separator(start: Sequence[str]) -> str:
    """Return the sign that separates the names of a table; a comma if there is only one name.

    If the line of names contains commas and another sign, the other sign separates the names under two conditions: the
    next row contains this sign as often as the names do; and the next row contains another number of commas than the
    names, or a blank follows each comma of the names, as in "height, cm".

    Args:
        start: the first lines of the table.

    Raises:
        ValueError: the names are in quotation marks, with blanks between them.
    """
    first = _first_record(start)
    second = _first_record([line for line in start[len(first) :] if line.strip()])
    header, row = "".join(first), "".join(second)
    if re.fullmatch(r'"[^"]*"(?:[ ]+"[^"]*")+\s*', header):
        raise ValueError(
            "blanks separate the cells; set data.separator=space if the data set has that setting, or save the file "
            "with commas"
        )
    header, row = (re.sub(r'"[^"]*"', "", record) for record in (header, row))
    counts = {sign: header.count(sign) for sign in ",;\t|"}
    likely = max(";\t|", key=counts.__getitem__)
    if not counts[likely]:
        return ","
    as_many = row.count(likely) == counts[likely]
    in_names = row.count(",") != counts[","] or header.count(", ") == counts[","]
    return likely if not counts[","] or (as_many and in_names) else ","


def _first_record(lines: Sequence[str]) -> Sequence[str]:
    """Return the first line, and the following lines if a quoted cell goes on in them.

    A quotation mark that none of the lines closes stands for itself.
    """
    marks = 0
    for number, line in enumerate(lines, 1):
        marks += line.count('"')
        if marks % 2 == 0:
            return lines[:number]
    return lines[:1]


def read_columns(
    file: Path, writing: Writing | None = None, missing: str = "a CSV table is expected. Correct the path."
) -> Columns:
    """Read a table with column names: a CSV file, also one compressed with gzip, or a Parquet file.

    Blank lines are left out. A column without a name is left out if it holds row numbers or nothing. In a Parquet file,
    a line is a row, counted from 1.

    Args:
        file: path of the table.
        writing: notation of the table; None: decimal points and no units.
        missing: end of the message about a file that does not exist.

    Raises:
        DataError: the file is missing, unreadable or empty; a column name is missing or occurs twice; there is no row;
            a row has more or fewer cells than there are names; or a setting of the notation does not apply to a Parquet
            file.
    """
    with _open_table(file, missing) as stream:
        if is_parquet(stream):
            _refuse_notation(writing)
            names, columns, left_out = read_parquet(stream)
            if not names:
                raise ValueError("it has no column of numbers, words or dates")
            header = [text.column_name(name) for name in names]
            text.require_distinct(header)
            lines = [*range(1, len(columns[0]) + 1)]
        else:
            header, columns, lines = _read_csv(file, stream, writing)
            left_out = {}
    if not lines:
        raise DataError(
            f"{file} has no row below its first line, but one row per sample is expected. Add the rows."
        )
    return _select_named(file, header, columns, lines, writing, left_out)


def _refuse_notation(writing: Writing | None) -> None:
    """Raise a DataError if a setting for the notation of texts is not at its default."""
    default = Writing()
    for name in ("separator", "decimal", "thousands", "encoding"):
        if writing is not None and getattr(writing, name) != getattr(default, name):
            raise DataError(
                f"data.{name} is set, but the table is a Parquet file, whose numbers are stored as such. Remove "
                f"data.{name}, or save the table as CSV."
            )


def _read_csv(
    file: Path, stream: Bounded, writing: Writing | None
) -> tuple[list[str], list[list[str]], list[int]]:
    """Return the names of the columns of a CSV file, the cells of each column, and the line of each row."""
    with _csv_rows(file, stream, writing) as reader:
        names = next(reader, [])
        if re.fullmatch(r"sep=.?", "".join(names).strip()) and len(names) < 3:
            names = next(reader, [])
        if len(names) > MOST_COLUMNS:
            raise DataError(
                f"{file} has {len(names)} columns, but at most {MOST_COLUMNS} are allowed. Leave some columns out."
            )
        header = [text.column_name(cell) for cell in names]
        _check_header(file, header)
        columns: list[list[str]] = [[] for _ in header]  # a list for each row would take most of the memory
        lines: list[int] = []
        filled = _filled_rows(reader, file, header, writing)
        while numbered := list(itertools.islice(filled, max(1, CELLS_AT_ONCE // len(header)))):
            numbers_of_lines, rows = zip(*numbered, strict=True)
            lines.extend(numbers_of_lines)
            for column, cells in zip(columns, zip(*rows, strict=True), strict=True):
                column.extend(map(str.strip, cells))
    if lines:
        _check_blanks(file, header, columns)
    return header, columns, lines


def _filled_rows(
    reader: Any, file: Path, header: Sequence[str], writing: Writing | None
) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are not blank, each after the number of the line on which it ends.

    Raises:
        DataError: a row has more or fewer cells than there are names in `header`.
    """
    for cells in reader:
        # A spreadsheet writes an empty row as `,,,`. In a table of one column an empty cell is a missing number.
        if not cells or (len(cells) > 1 and not any(map(str.strip, cells))):
            continue
        if len(cells) != len(header):
            raise DataError(
                f"{file} line {reader.line_num}: the line has {len(cells)} cells, but the first line names "
                f"{len(header)} columns. Correct that line.{_why_other_width(header, cells, writing)}"
            )
        yield reader.line_num, cells


def _why_other_width(header: Sequence[str], cells: Sequence[str], writing: Writing | None) -> str:
    """Return a possible reason why a row has another number of cells than the first line; "" if none is known."""
    if len(cells) > len(header) and sum(cell.strip().isdigit() for cell in cells) > len(header) // 2 + 1:
        return " If commas separate the cells, put numbers with a decimal comma in quotation marks."
    if len(header) == 1 and len(cells) > 1:
        return " If other lines, such as a title, stand above the names of the columns, remove these lines."
    return (
        " Or name the first column too: the rows may begin with row numbers that the first line does not name."
        if len(cells) == len(header) + 1
        else ""
    )


def _select_named(
    file: Path,
    header: Sequence[str],
    columns: list[list[str]],
    lines: list[int],
    writing: Writing | None,
    unread: Mapping[str, str],
) -> Columns:
    """Return the columns that have names; a column without a name must hold row numbers or nothing.

    `unread` holds columns of other kinds that were not read, with the reason.
    """
    left_out = dict(unread)
    for position, (name, cells) in enumerate(zip(header, columns, strict=True), 1):
        if name:
            continue
        if any(cells) and not _is_distinct_whole(cells):
            raise DataError(
                f"{file}: column {position} has no name, but holds {quote(next(filter(None, cells)))}, which is not a "
                "row number. Name the column in the first line, or remove it."
            )
        left_out[f"column {position}, without a name"] = "row numbers" if any(cells) else "empty"
    named = {name: cells for name, cells in zip(header, columns, strict=True) if name}
    return Columns(file, named, lines, writing, left_out)


def require(columns: Columns, names: Sequence[str], setting: str) -> None:
    """Raise an error if a name is not a column of the table.

    Args:
        columns: the table.
        names: the names to check.
        setting: the setting that names them, for example "data.columns".

    Raises:
        DataError: a name is not a column; the message suggests the most similar column name.
    """
    for name in names:
        if name not in columns.cells:
            raise DataError(
                f"{setting} names the column {name!r}, which {columns.file} does not "
                f"have.{did_you_mean(name, columns.cells)} Its columns: {shorten(', '.join(columns.cells))}."
            )


def tables(
    files: Sequence[Path],
    names: Sequence[str],
    setting: str,
    writing: Writing | None = None,
    arrange: Callable[[Columns], Columns] = lambda columns: columns,
    missing: str | None = "",
) -> Iterator[tuple[Columns, Float[np.ndarray, "rows names"]]]:
    """Read a user's files one by one; yield each table, and the named columns as an array of numbers.

    Args:
        files: the tables.
        names: names of the columns, in order.
        setting: the setting that names the columns.
        writing: notation of the tables. If it is given, TRUE and FALSE are read as 1 and 0.
        arrange: function that changes each table after it is read.
        missing: treatment of missing numbers, as in `numbers`.

    Raises:
        DataError: there is no file, a file is not a readable table, a name is not a column of a table, or a named
            column holds a word, or no finite number in a row.
    """
    if not files:
        raise DataError(
            f"No file was given, but at least one CSV table with the columns {', '.join(names)} is required. Give "
            "such a file."
        )
    for file in files:
        columns = arrange(read_columns(Path(file), writing))
        require(columns, names, setting)
        values = [numbers(columns, name, missing=missing, booleans=writing is not None) for name in names]
        yield columns, np.stack(values, -1)


def numeric_columns(columns: Columns, but: Collection[str], setting: str) -> ColumnChoice:
    """Choose the columns that hold numbers, or TRUE and FALSE, in a table whose columns the user did not name.

    Args:
        columns: the table.
        but: columns that are used for something else and are skipped.
        setting: the setting that names columns, for example "data.columns".

    Raises:
        DataError: most cells of a column are numbers, but some of them in another notation; the message names the
            setting that reads these.
    """
    names: list[str] = []
    left_out, odd = dict(columns.left_out), {}
    # a row that was copied keeps its number
    originals = [*dict.fromkeys(zip(*columns.cells.values(), strict=True))]
    distinct_rows = dict(zip(columns.cells, zip(*originals, strict=True), strict=True)) or columns.cells
    for name in columns.cells:
        if name in but:
            continue
        cells = distinct_rows[name]
        is_row_count = _is_row_count(cells)
        if INDEX.fullmatch(name) and _is_distinct_whole(cells):
            left_out[name] = f"row numbers; name it in {setting} to read it"
        elif ALWAYS_INDEX.fullmatch(name) and _is_whole(cells):
            left_out[name] = f"row numbers, some of them repeated; name it in {setting} to read it"
        elif mostly_numbers(columns, name) or is_boolean(columns, name):
            names.append(name)
            if is_boolean(columns, name):
                odd[name] = "holds TRUE and FALSE, read as 1 and 0"
            elif is_row_count:
                odd[name] = f"counts the rows from {cells[0]} to {cells[-1]}; set {setting} to leave it out"
            elif NUMBER_OF_THING.search(name) and len(cells) > ENOUGH_ROWS and _is_distinct_whole(cells):
                odd[name] = (
                    f"has another whole number in each row; if it only names the rows, set {setting} to leave it out"
                )
        else:
            left_out[name] = _why_no_numbers(columns, name, setting)
    return ColumnChoice(tuple(names), left_out, odd)


def _is_row_count(cells: Sequence[str]) -> bool:
    """Return whether a column of more than ENOUGH_ROWS cells counts the rows, from any whole number."""
    if len(cells) <= ENOUGH_ROWS or not re.fullmatch("[0-9]{1,18}", cells[0]):
        return False
    start = int(cells[0])
    return all(cell == str(number) for number, cell in enumerate(cells, start))


def _is_distinct_whole(cells: Sequence[str]) -> bool:
    """Return whether all cells are whole numbers and no number occurs twice."""
    return _is_whole(cells) and len({text.parse_number(cell) for cell in cells}) == len(cells)


def _is_whole(cells: Sequence[str]) -> bool:
    """Return whether all cells are whole numbers."""
    values = (text.parse_number(cell) for cell in cells)
    return all(value is not None and math.isfinite(value) and value.is_integer() for value in values)


def _why_no_numbers(columns: Columns, name: str, setting: str) -> str:
    """Return the reason why a column holds no numbers.

    Raises:
        DataError: more than half of its cells are numbers, or would be numbers in another notation.
    """
    notation = columns.notation_of(name)
    filled = [
        (cell, line)
        for cell, line in zip(columns.cells[name], columns.lines, strict=True)
        if cell.lower() not in notation.missing
    ]
    if not filled:
        return "empty"
    filled = filled[:: -(-len(filled) // MOST_LOOKED_AT)]
    plain = sum(number(cell, notation) is not None for cell, _ in filled)
    words = [
        (cell, line, _other_reading(cell, notation))
        for cell, line in filled
        if number(cell, notation) is None
    ]
    units = Counter(mend.unit for _, _, mend in words if mend is not None and mend.unit)
    unit = max(units, key=units.__getitem__, default="")
    readable = [
        (cell, line, mend) for cell, line, mend in words if mend is not None and mend.unit in ("", unit)
    ]
    if readable and 2 * (plain + len(readable)) > len(filled):
        # Prefer a cell with one reading: 1,5 has one, 1,234 has two.
        clear = (entry for entry in readable if len(entry[2].settings) == 1)
        cell, line, mend = next(clear, readable[0])
        raise DataError(
            f"{columns.file} line {line}, column {quote(name)}: {quote(cell)} is a number {mend.form}. "
            f"{remedy(mend, columns.writing)} Or list the columns to read in {setting}, and leave this column out."
        )
    if all(DATE.fullmatch(cell) for cell, _, _ in words):
        return "dates; write numbers, such as days since the first date, to read it"
    return f"words; {plain / len(filled):.0%} of the cells are numbers" if plain else "words"


def describe_words(columns: Columns, name: str) -> str:
    """Return what a column without numbers holds, "words such as 'x'" or "dates such as 'x'"; "" if it holds numbers.

    A column also holds numbers if its cells would be numbers in another notation.
    """
    notation = columns.notation_of(name)
    cell = next((cell for cell in columns.cells[name] if cell.lower() not in notation.missing), "")
    if not cell or mostly_numbers(columns, name) or _other_reading(cell, notation) is not None:
        return ""
    return f"{'dates' if DATE.fullmatch(cell) else 'words'} such as {quote(cell)}"


def _other_reading(cell: str, writing: Writing) -> text.Suggestion | None:
    """Return the settings that read a cell as a number in another notation than the table's; None for other cells."""
    if not writing.plain and text.parse_number(cell) is not None:
        digits = cell.lstrip("+-")
        grouped = writing.sign == "," and re.fullmatch(GROUPED_BY_POINTS, digits)
        settings = ({"thousands": "point"},) if grouped else ()
        number = cell.replace(".", "") if grouped else f"{cell} in the notation of the other columns"
        return text.Suggestion("with a point, which is not a decimal sign in this table", number, settings)
    return text.suggest_number(cell)


def remedy(mend: text.Suggestion, writing: Writing | None) -> str:
    """Return advice on a cell that holds a number in a notation other than that of its table.

    The advice names the settings that read the cell as a number, or the number to write into the cell.

    Args:
        mend: the number in the cell, and the settings that read it.
        writing: notation of the table; None if no setting can change it.
    """
    if writing is None or not mend.settings:
        return f"Write {mend.number}."
    ways = [
        " ".join(shlex.quote(f"data.{key}={value}") for key, value in options.items())
        for options in mend.settings
    ]
    if len(ways) == 1:
        return f"Set {ways[0]} to read the cell as {mend.number}, or write {mend.number}."
    pairs = zip(ways, mend.number.split(" or "), strict=False)
    return f"Set {', or '.join(f'{way} to read the cell as {number}' for way, number in pairs)}."


def is_boolean(columns: Columns, name: str) -> bool:
    """Return whether every filled cell of a column is TRUE or FALSE, in large or small letters."""
    cells, missing = columns.cells[name], columns.notation.missing
    first = next((cell for cell in cells if cell.lower() not in missing), "")
    return first.lower() in BOOLEANS and {cell.lower() for cell in cells} - missing <= BOOLEANS.keys()


def mostly_numbers(columns: Columns, name: str) -> bool:
    """Return whether more than half of a column's filled cells are numbers; False if no cell is filled."""
    notation = columns.notation_of(name)
    if _all_finite(columns.cells[name], notation) is not None:
        return True
    filled = [cell for cell in columns.cells[name] if cell.lower() not in notation.missing]
    return 2 * sum(_parse_number(cell, notation) is not None for cell in filled) > len(filled)


def number(cell: str, writing: Writing = PLAIN) -> float | None:
    """Return the number in a cell, which may be infinite; NaN if the cell is missing; None if it is a word."""
    if cell.lower() in writing.missing:
        return math.nan
    return _parse_number(cell, writing)


def _parse_number(cell: str, writing: Writing) -> float | None:
    """Return the number in a cell that is not missing; None if it is a word."""
    value = text.parse_number(cell if writing.plain else writing.standard(cell))
    return None if value is not None and math.isnan(value) else value


def numbers(
    columns: Columns, name: str, *, missing: str | None, booleans: bool = False
) -> Float[np.ndarray, "rows"]:
    """Return a column as float64, NaN where the number is missing.

    Args:
        columns: the table.
        name: name of the column.
        missing: None allows missing numbers. With a text, a missing number is an error, and the text is added to the
            message as a way out, such as "set data.missing to ..."; "" adds nothing.
        booleans: read TRUE and FALSE as 1 and 0 if all cells are TRUE or FALSE.

    Raises:
        DataError: a cell is a word, is infinite, or is missing although `missing` is a text; or only some numbers have
            a unit. The message names the first such cell.
    """
    notation = columns.notation_of(name)
    plain = _all_finite(columns.cells[name], notation)
    if plain is not None:
        return plain
    booleans = booleans and is_boolean(columns, name)
    values = np.empty(len(columns.lines))
    for row, cell in enumerate(columns.cells[name]):
        value = BOOLEANS.get(cell.lower(), math.nan) if booleans else number(cell, notation)
        if value is None or math.isinf(value) or (missing is not None and math.isnan(value)):
            fault = (
                f"{quote(cell)} is not a finite number, which"
                if cell
                else "The cell is empty, but a finite number"
            )
            raise DataError(
                f"{columns.file} line {columns.lines[row]}, column {quote(name)}: {fault} is required. Correct the "
                f"cell, or remove the line.{_hint(cell, value, columns, missing)}"
            )
        values[row] = value
    _check_units(columns, name)
    return values


def _hint(cell: str, value: float | None, columns: Columns, missing: str | None) -> str:
    """Return a further remedy, with a leading space, for a cell without a finite number; "" if none is known."""
    if value is not None:
        return f" Or {missing}." if math.isnan(value) and missing else ""
    mend = _other_reading(cell, columns.notation)
    return f" The cell is a number {mend.form}. {remedy(mend, columns.writing)}" if mend else ""


def _check_units(columns: Columns, name: str) -> None:
    """Raise an error if not all numbers of a column have the same unit, or if only some of them have one."""
    notation = columns.notation
    if not notation.units:
        return
    first: tuple[str, str] | None = None
    for cell, line in zip(columns.cells[name], columns.lines, strict=True):
        if cell.lower() in notation.missing:
            continue
        unit = notation.split_unit(cell)[1]
        first = first or (unit, cell)
        if unit != first[0]:
            raise DataError(
                f"{columns.file} line {line}, column {quote(name)}: {quote(cell)} has another unit than "
                f"{quote(first[1])}, the first number of the column. Use one unit in all cells of the column, or none."
            )


def _all_finite(cells: Sequence[str], writing: Writing = PLAIN) -> Float[np.ndarray, "rows"] | None:
    """Return the numbers that `number` returns for all cells, several times as fast; None if one is not finite."""
    joined = "".join(cells)
    if "_" in joined:
        return None
    if not writing.plain:
        if writing.sign != "," or writing.thousands or writing.units or "." in joined or "\n" in joined:
            return None
        cells = "\n".join(cells).replace(",", ".").split("\n")
    try:
        values = np.fromiter(map(float, cells), np.float64, len(cells))
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def _check_header(file: Path, header: Sequence[str]) -> None:
    if not any(header):
        raise DataError(
            f"{file} is empty or begins with a blank line, but the first line must name the columns. Write their "
            "names."
        )
    if all(name and text.parse_number(name) is not None for name in header):
        raise DataError(
            f"{file} line 1: {quote(', '.join(header))} are numbers, but the first line must name the columns. "
            "Insert a line with the names."
        )
    try:
        text.require_distinct(header)
    except ValueError as error:
        raise DataError(f"{file}: {error}") from None


def _check_blanks(file: Path, header: Sequence[str], columns: Sequence[Sequence[str]]) -> None:
    """Raise an error if the cells of a table are separated by blanks.

    Without another separator, such a table has a single column, in which every cell consists of equally many words.
    """
    words = len(header[0].split())
    if len(header) == 1 and words > 1 and all(len(cell.split()) == words for cell in columns[0]):
        raise DataError(
            f"{file} is separated by blanks: its first line is {quote(header[0])}. Commas, semicolons, tabs or bars "
            "are expected. Set data.separator=space if the data set has that setting, or save the file with commas."
        )
