"""Decoding of text files, names of columns, and parsing of the numbers that people and programs write.

Every reader of text uses these functions, so that a cell means the same in a table, a point cloud, a mesh, a flight, a
list of offsets and a motion. A number in an unusual form is read if its meaning is unique (a Unicode minus, Fortran's
exponent). For any other unusual form, `suggest_number` provides a correction for the error message.
"""

import codecs
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple

from framework.errors import quote

SAVE = "Save the file as UTF-8"
WIDE = (
    (codecs.BOM_UTF32_LE, "UTF-32"),  # before UTF-16, because this mark begins with the mark of UTF-16
    (codecs.BOM_UTF32_BE, "UTF-32"),
    (codecs.BOM_UTF16_LE, "UTF-16"),
    (codecs.BOM_UTF16_BE, "UTF-16"),
)
LONGEST = 64
"""Largest number of characters of a word that `suggest_number` examines, because its patterns take superlinear time."""
PACKED = {
    b"PK\x03\x04": "an archive, such as an Excel workbook (.xlsx)",
    b"\xd0\xcf\x11\xe0": "a file of an old Office program, such as an Excel workbook (.xls)",
    b"\x1f\x8b": "compressed with gzip",
    **{b"BZh%d1AY&SY" % level: "compressed with bzip2" for level in range(1, 10)},
    b"\xfd7zXZ": "compressed with xz",
    b"\x28\xb5\x2f\xfd": "compressed with zstd",
    b"PAR1\x15": "a Parquet table",
    b"\x89HDF": "an HDF5 file",
}
"""First bytes of files that users give where text is required, and what such a file is.

They are so long that no text begins with them: a table may begin with a column PAR1.
"""
LOOKED_AT = 64
"""Number of leading bytes that are searched for UTF-16 without a byte-order mark, in which every second byte is 0."""
MINUS = str.maketrans(
    dict.fromkeys("\N{MINUS SIGN}\N{EN DASH}\N{SMALL HYPHEN-MINUS}\N{FULLWIDTH HYPHEN-MINUS}", "-")
)
"""Characters that mean a minus at the beginning of a number. A word such as 1–5, a range, is not a number."""
NOT_FINITE = re.compile(r"[+-]?1\.#([A-Za-z]+)\d*")
"""Pattern of NaN and infinity as Microsoft's C library writes them: 1.#INF, -1.#IND, 1.#QNAN, sometimes truncated."""
FORTRAN = re.compile(r"([+-]?(?:\d+\.\d*|\.\d+))[dD]([+-]?\d+)|([+-]?\d+)[dD]([+-]\d+)")
FIGURE = re.compile(r"\d")
FIGURES = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
BLANKS = " \N{NO-BREAK SPACE}\N{THIN SPACE}\N{NARROW NO-BREAK SPACE}"
INVISIBLE = "\ufeff\u200b\u200c\u200d\u200e\u200f\u2060"
"""Zero-width characters, which text copied from web pages and office programs contains."""
AT_ENDS = INVISIBLE + "".join(filter(str.isspace, map(chr, range(0x3001))))
"""Characters that `trim` removes: the zero-width characters, and all blanks of Unicode."""


FORMULA = re.compile(
    rf"(^|[;,\t\r\n])((?:[^\S\t\r\n]|[\x00-\x08\x0e-\x1f{INVISIBLE}])*+)([=+\-@＝＋－＠])(?=[^;,\t\r\n]*[(|!])"
)
"""Pattern of a formula that calls a function or a program, at the start of a cell for any separator of cells.

Blanks and invisible characters may stand before the sign, and the sign may be a full-width one. The blanks do not
include separators, so that the time is linear in the length of the text.
"""


def defuse_formulas(cell: str) -> str:
    """Return the text of a CSV cell in which a spreadsheet finds no formula that calls a function or a program.

    The names of classes, methods and files may come from another person, and a formula can start a program or send the
    table to a server. An apostrophe before the sign makes the formula plain text. Other names that begin with such a
    sign, such as -ve, are unchanged.
    """
    return FORMULA.sub(r"\1\2'\3", cell)


def remove_byte_order_mark(content: bytes) -> bytes:
    """Return the bytes of a text, or of a file that begins with text, without the byte-order mark of UTF-8.

    Raises:
        ValueError: The text is UTF-16 or UTF-32, or the file is no text, but a workbook or a compressed file.
    """
    for start, kind in PACKED.items():
        if content.startswith(start):
            raise ValueError(f"the file is {kind}, but plain text is required")
    for mark, name in WIDE:
        if content.startswith(mark):
            raise ValueError(f"the file is text in {name}, but UTF-8 is required. {SAVE}")
    first = content[:LOOKED_AT]
    odd, even = first[1::2], first[::2]
    if len(first) >= 4 and any(not any(zero) and all(other) for zero, other in ((odd, even), (even, odd))):
        raise ValueError(f"every second byte of the file is 0, as in UTF-16, but UTF-8 is required. {SAVE}")
    return content.removeprefix(codecs.BOM_UTF8)


def decode(content: bytes) -> str:
    """Return the text that UTF-8 bytes encode, without its byte-order mark.

    Raises:
        ValueError: The bytes have another encoding; the message names the line.
    """
    content = remove_byte_order_mark(content)
    place = place_of_other_encoding(content, "utf-8")
    if place:
        raise ValueError(f"{place}, which is not UTF-8. {SAVE}")
    return content.decode("utf-8")


def place_of_other_encoding(content: bytes, encoding: str) -> str:
    """Return "line 3 contains the byte 0xfc" for the first byte that is not in an encoding of Python; "" if all are."""
    try:
        content.decode(encoding)
    except UnicodeDecodeError as error:
        line = len(re.split(rb"\r\n|\r|\n", content[: error.start]))
        return f"line {line} contains the byte 0x{content[error.start]:02x}"
    return ""


def lines_of(content: bytes) -> list[str]:
    r"""Return the lines of a text, split at \r\n, \r and \n only.

    Raises:
        ValueError: `decode` refuses the bytes.
    """
    return re.split(r"\r\n|\r|\n", decode(content))


def words_of(written: str) -> list[str]:
    """Return the words between blanks, tabs and line ends; a no-break space, as in 1 234, does not separate words."""
    return (
        written.split()
        if written.isascii()
        else [word for word in re.split(r"[ \t\r\n\f\v]+", written) if word]
    )


def trim(cell: str) -> str:
    """Return a cell without blanks and zero-width characters at its ends."""
    return cell.strip(AT_ENDS)


def column_name(cell: str) -> str:
    """Return the name of a column from its header cell.

    The name is on one line, trimmed, without quotation marks, composed (NFC).
    """
    name = re.sub(r"\s*[\r\n]\s*", " ", trim(cell))
    if len(name) > 1 and name[0] == name[-1] and name[0] in "\"'":
        name = trim(name[1:-1])
    return unicodedata.normalize("NFC", name)


def require_distinct(names: Sequence[str], kind: str = "column") -> None:
    """Refuse a list of names in which a name occurs twice; empty names may repeat. `kind` says what has the names.

    Raises:
        ValueError: A name occurs twice; the message quotes the first such name.
    """
    twice = [name for name, count in Counter(names).items() if count > 1 and name]
    if twice:
        raise ValueError(
            f"the {kind} {quote(twice[0])} is named twice, but every name must be unique. Rename one of them."
        )


def parse_number(word: str) -> float | None:
    """Return the number that a word represents, which may be NaN or infinite, or None if the word is not a number.

    In addition to the forms of Python, the function reads a Unicode minus, Fortran's 1.5D+3, and 1.#INF or -1.#IND of
    Microsoft's C library.
    """
    if "_" in word:
        return None  # Python reads 1_0 as 10, but no file means that
    try:
        return float(word)
    except ValueError:
        if not FIGURE.search(word):
            return None
    word = trim(word).translate(MINUS)
    match = NOT_FINITE.fullmatch(word)
    if match:
        sign = -1 if word.startswith("-") else 1
        return sign * math.inf if match[1].upper().startswith("INF") else math.nan
    match = FORTRAN.fullmatch(word)
    if match:
        word = f"{match[1] or match[3]}e{match[2] or match[4]}"
    try:
        return float(word)
    except ValueError:
        return None


class Suggestion(NamedTuple):
    """Correction of a word that is a number in an unusual form.

    Attributes:
        form: Form of the word, such as "with a decimal comma".
        number: The number in plain form.
        settings: Settings of `framework.datasets.csv_columns.Writing` that would read the word, by key; one dictionary
            for each meaning that the word can have.
        unit: Unit before or after the number.
    """

    form: str
    number: str
    settings: tuple[dict[str, str], ...] = ()
    unit: str = ""


Sign = Literal["comma", "point", "space", "apostrophe"]
GROUPED: dict[Sign, str] = {
    "comma": r"\d{1,3}(?:,\d{3})+",
    "point": r"\d{1,3}(?:\.\d{3})+",
    "space": rf"\d{{1,3}}(?:[{BLANKS}]\d{{3}})+",
    "apostrophe": r"\d{1,3}(?:['\N{RIGHT SINGLE QUOTATION MARK}]\d{3})+",
}
"""Patterns of digits in groups of three, by the separator between the groups."""
BETWEEN: dict[Sign, str] = {
    "comma": ",",
    "point": ".",
    "space": BLANKS,
    "apostrophe": "'\N{RIGHT SINGLE QUOTATION MARK}",
}
OTHERS: tuple[tuple[str, str, str], ...] = (
    (rf"\(({FIGURES})\)", "in brackets, as accounts write negative numbers", r"-\1"),
    (rf"({FIGURES})\s*-", "with the minus behind it", r"-\1"),
    (rf"([+-])\s+({FIGURES})", "with a blank behind its sign", r"\1\2"),
    (rf"=?[\"'](?:\s*)([+-]?{FIGURES})\s*[\"']?", "in quotation marks", r"\1"),
    (rf"([+-]?{FIGURES})\s*[x×*·]\s*10\s*\^?\s*([+-]?\d+)", "as a product with a power of ten", r"\1e\2"),
    (rf"[<>≤≥~≈]\s*([+-]?{FIGURES})", "as a bound", r"\1"),
)
"""Patterns of numbers that no setting reads, each with a name of the form and a template for the plain number."""
UNIT = re.compile(
    r"([+-]?)(?:([A-Z]{3}(?=[ \xa0])|[^\w\s.,()+\-'\"<>≤≥~≈=#]{1,3})\s*)?([+-]?[\d.,].*?)\s*"
    r"(°[CFK]|[^\W\d_]{1,8}(?:/[^\W\d_]{1,4})?[²³]?|[^\w\s.,()+\-'\"#*]{1,3})?"
)
"""Pattern of a sign, a unit before the number ($, EUR), the number, and a unit after the number (%, kg, mm², °C)."""


def suggest_number(word: str) -> Suggestion | None:
    """Return the correction of a word that is a number in an unusual form; None for any other word.

    Examples of unusual forms are a decimal comma, separators between thousands, and a unit.
    """
    word = trim(word).translate(MINUS)
    if len(word) > LONGEST or not any(letter.isdigit() for letter in word):
        return None
    sign, figures = (word[0], word[1:]) if word[:1] in "+-" else ("", word)
    suggestion = _separated(sign, figures)
    if suggestion:
        return suggestion
    for pattern, form, number in OTHERS:
        if re.fullmatch(pattern, word):
            return Suggestion(form, re.sub(pattern, number, word))
    return _with_unit(word)


def _separated(sign: str, figures: str) -> Suggestion | None:
    """Return the correction of a number with a decimal comma or digits in groups; None if it has neither."""
    decimal = {"decimal": "comma"}
    if re.fullmatch(r"\d*,\d+(?:[eE][+-]?\d+)?|\d+,", figures):
        number = sign + figures.replace(",", ".")
        if re.fullmatch(r"[1-9]\d{0,2},\d{3}", figures):
            whole = sign + figures.replace(",", "")
            return Suggestion("with a comma", f"{number} or {whole}", (decimal, {"thousands": "comma"}))
        return Suggestion("with a decimal comma", number, (decimal,))
    for name, pattern in GROUPED.items():
        match = re.fullmatch(rf"({pattern})(?:([.,])(\d*))?", figures)
        if match is None or match[2] == BETWEEN[name]:
            continue
        if name == "point" and match[2] is None and figures.count(".") == 1:
            continue  # 1.234 is a plain number
        whole = re.sub(r"\D", "", match[1]) + (f".{match[3]}" if match[3] else "")
        settings = {"thousands": name} | (decimal if match[2] == "," else {})
        return Suggestion("with digits in groups", sign + whole, (settings,))
    return None


def _with_unit(word: str) -> Suggestion | None:
    match = UNIT.fullmatch(word)
    if match is None or not (match[2] or match[4]):
        return None
    unit = match[2] or match[4]
    if (match[2] and match[4]) or match[3].endswith("."):  # a file name such as 0.png
        return None
    inner = match[1] + match[3]
    if parse_number(inner) is not None:
        return Suggestion(f"with the unit {unit!r}", inner, ({"units": f'["{unit}"]'},), unit)
    sign, figures = (inner[0], inner[1:]) if inner[:1] in "+-" else ("", inner)
    core = _separated(sign, figures)
    if core is None:
        return None
    settings = tuple({"units": f'["{unit}"]'} | core_setting for core_setting in core.settings)
    return Suggestion(
        f"with the unit {unit!r} and {core.form.removeprefix('with ')}", core.number, settings, unit
    )


def line_of_word(text: str, number: int) -> int:
    """Return the number, from 1, of the line of `text` that contains the word with the index `number`, from 0."""
    line = 1
    for line, words in enumerate(re.split(r"\r\n|\r|\n", text), 1):
        number -= len(words_of(words))
        if number < 0:
            return line
    return line


def require_numbers_in(words: Sequence[str], text: str, first: int = 0) -> list[float]:
    """Return the numbers that some words of a text represent.

    Args:
        words: Consecutive words of the text.
        text: Whole text; an error message gives the number of a line in it.
        first: Index of `words[0]` among all words of `text`.

    Raises:
        ValueError: A word is not a number; the message names its line.
    """
    try:
        numbers = list(map(float, words))
    except ValueError:
        numbers = []
    if len(numbers) == len(words) and "_" not in "".join(words):
        return numbers
    values = [parse_number(word) for word in words]
    for index, (word, number) in enumerate(zip(words, values, strict=True)):
        if number is None:
            raise ValueError(f"line {line_of_word(text, first + index)}: {describe_no_number(word)}")
    return [number for number in values if number is not None]


def describe_no_number(word: str, where: str = "") -> str:
    """Return the error message for a word that is not a number, with a correction if there is one.

    `where` says where the word stands; the message contains this text after the word.
    """
    remedy = suggest_number(word)
    why = f", which is a number {remedy.form}; write {remedy.number}" if remedy else ""
    return f"expected a number, got {quote(word)}{where}{why}"
