"""Requests that MLflow can parse in bounded memory: content types, and bodies of JSON or CSV, checked without parsing.

Parquet is not read. A file of a few kilobytes can expand to any size, and only the library that expands it can tell.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from framework.errors import quote, shorten

MOST_BODY = 2**26
"""Largest size of the body of a request, bytes."""
MOST_CONTENT = 2**25
"""Largest size of one file in a request, bytes."""
MOST_FILES = 64
"""Largest number of files in a request."""
MOST_ROWS = 2**17
"""Largest number of rows of a request, and of samples in its files."""
MOST_VALUES = 2**20
"""Largest number of values in a body, JSON or CSV; a list, a dictionary and an empty cell count as one value."""
MOST_DEPTH = 32
"""Largest depth of nested lists and dictionaries in JSON."""
MOST_INPUTS = 2**25
"""Largest number of numbers in all inputs that a request becomes."""
AT_ONCE = 2**28
"""Largest size, in bytes, of the bodies that the server holds at a time; one request at least is always answered."""

FORMS = ("dataframe_split", "dataframe_records", "instances", "inputs")
"""Keys of JSON under which MLflow takes rows."""


class Refused(Exception):
    """Refusal of a request: the HTTP status, and the sentence for the client."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


def content_type(headers: Mapping[bytes, bytes]) -> str:
    """Return the media type of a body, "application/json" or "text/csv".

    Raises:
        Refused: the media type is another one, or the encoding is not UTF-8.
    """
    said = headers.get(b"content-type", b"").decode("latin-1")
    kind, *parameters = (part.strip() for part in said.split(";"))
    if kind.lower() not in ("application/json", "text/csv"):
        raise Refused(415, f"Content-Type: {quote(said)} came; wanted application/json or text/csv.")
    for parameter in filter(None, parameters):
        name, _, value = parameter.partition("=")
        if name.strip().lower() != "charset" or value.strip(" \"'").lower() not in ("utf-8", "utf8"):
            raise Refused(415, f"Content-Type: {quote(said)} came; wanted {kind.lower()}; charset=utf-8.")
    if headers.get(b"content-encoding", b"identity") != b"identity":
        raise Refused(415, "A compressed body came; wanted one without Content-Encoding.")
    return kind.lower()


def require_bounded(body: bytes, kind: str) -> None:
    """Refuse a body that is too large, deep or malformed for MLflow to parse.

    Raises:
        Refused: the message says what came, what was wanted and what to do.
    """
    try:
        text = body.decode("utf-8")
    except UnicodeDecodeError as error:
        raise Refused(400, f"Byte {error.start} of the body is no UTF-8. Send the body in UTF-8.") from None
    if not text.strip():
        raise Refused(400, f"An empty body came; wanted {wanted_of(kind)}.")
    if kind == "text/csv":
        _require_table(text)
        return
    _require_few(body)
    try:
        found = json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # JSONDecodeError, or an integer of too many digits
        raise Refused(400, f"The body cannot be read as JSON ({shorten(error)}). Mend it.") from None
    _require_form(found)


def _require_few(body: bytes) -> None:
    """Check the number of values and the depth of JSON, which may be damaged, in bounded memory and without parsing."""
    # Escaped backslashes and quotation marks are removed; a remaining backslash precedes a letter that ends no text.
    plain = body.replace(b"\\\\", b"").replace(b'\\"', b"").translate(None, _OTHERS)
    if plain.count(b'"') > 4 * MOST_VALUES:
        raise Refused(413, _too_many(f"more than {2 * MOST_VALUES} texts"))
    marks = b"".join(plain.split(b'"')[::2])
    values = len(marks) - marks.count(b"]") - marks.count(b"}")
    if values > MOST_VALUES or len(marks) > 2 * MOST_VALUES:
        raise Refused(413, _too_many(f"{values} values"))
    codes = np.frombuffer(marks, np.uint8)
    steps = np.isin(codes, (ord("["), ord("{"))).astype(np.int64) - np.isin(codes, (ord("]"), ord("}")))
    depth = int(steps.cumsum().max(initial=0))
    if depth > MOST_DEPTH:
        raise Refused(
            400,
            f"Lists and dictionaries {depth} deep within each other came; at most {MOST_DEPTH} are read. Send "
            "rows, or an array of inputs.",
        )


_OTHERS = bytes(set(range(256)) - set(b'"[]{},'))


def _require_table(text: str) -> None:
    lines = text.splitlines()
    if len(lines) > MOST_ROWS:
        raise Refused(413, _too_many(f"{len(lines)} lines"))
    # pandas pads short lines to the length of the longest one.
    columns = 1 + max(line.count(",") for line in lines)
    if columns * len(lines) > MOST_VALUES:
        raise Refused(413, _too_many(f"{len(lines)} lines of up to {columns} cells"))
    if "\0" in text:
        raise Refused(400, "The body holds a NUL character, which no CSV has. Send text.")
    if len(lines) < 2:
        raise Refused(400, f"{len(lines)} line of CSV came; wanted {wanted_of('text/csv')}.")


def _require_form(found: object) -> None:
    if not isinstance(found, dict) or len(set(FORMS) & set(found)) != 1:
        came = f"a dictionary with the keys {quote(list(found))}" if isinstance(found, dict) else _name(found)
        raise Refused(400, f"{_capital(came)} came; wanted {wanted_of('application/json')}.")
    form = next(name for name in FORMS if name in found)
    for key, value in found.items():
        if key == "params" and value:
            raise Refused(400, "The model has no parameters. Leave 'params' out.")
        if key not in (form, "params"):
            raise Refused(400, f"Beside {form!r} a key {quote(key)} came, which is not read. Leave it out.")
    given = found[form]
    if form == "dataframe_split":
        _require_split(given)
    elif form == "dataframe_records" or (
        form == "instances" and isinstance(given, list) and any(isinstance(row, dict) for row in given)
    ):
        _require_records(given, form)
    elif given is None or given in ([], {}, ""):
        raise Refused(400, f"{form!r} is empty; wanted a row at least.")
    if isinstance(given, list) and len(given) > MOST_ROWS:
        raise Refused(413, _too_many(f"{len(given)} rows"))


def _require_split(given: object) -> None:
    wanted = "wanted {'columns': [names], 'data': [rows, each a list with a value for each column]}"
    if not isinstance(given, dict):
        raise Refused(400, f"'dataframe_split' is {_name(given)}; {wanted}.")
    columns, rows, index = given.get("columns"), given.get("data"), given.get("index")
    if not set(given) <= {"columns", "data", "index"} or not isinstance(columns, list):
        raise Refused(400, f"'dataframe_split' has the keys {quote(list(given))}; {wanted}.")
    if not all(isinstance(name, str) for name in columns) or len(set(columns)) < len(columns):
        raise Refused(400, f"'columns' is {quote(columns)}; wanted names, each once.")
    if not isinstance(rows, list) or not rows:
        raise Refused(400, f"'data' is {_name(rows)}; wanted a row at least.")
    if len(rows) > MOST_ROWS:
        raise Refused(413, _too_many(f"{len(rows)} rows"))
    for number, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != len(columns):
            came = f"a list of {len(row)}" if isinstance(row, list) else _name(row)
            raise Refused(400, f"row {number} is {came}; wanted a list of {len(columns)} values.")
    if index is not None and (not isinstance(index, list) or len(index) != len(rows)):
        raise Refused(400, f"'index' does not have a value for each of {len(rows)} rows. Leave it out.")


def _require_records(given: object, form: str) -> None:
    """Refuse records with different keys: 1000 records of 1000 keys each would make a table of 10⁹ cells."""
    if not isinstance(given, list) or not given:
        raise Refused(400, f"{form!r} is {_name(given)}; wanted a list of rows, {{column: value}}.")
    if len(given) > MOST_ROWS:
        raise Refused(413, _too_many(f"{len(given)} rows"))
    for number, row in enumerate(given):
        if not isinstance(row, dict) or (number and row.keys() != given[0].keys()):
            came = f"has the keys {quote(list(row))}" if isinstance(row, dict) else f"is {_name(row)}"
            raise Refused(
                400, f"row {number} {came}; wanted {{column: value}}, with the same columns in each row."
            )


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {quote(twice)} comes twice in one dictionary")
    return found


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _name(value: object) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    kinds = {dict: "a dictionary", str: "a text", bool: "true or false", type(None): "nothing"}
    return kinds.get(type(value), "a number")


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def wanted_of(kind: str) -> str:
    """Return what a body of a media type should hold."""
    if kind == "text/csv":
        return "a line with the names of the columns, and a line for each row"
    return f"a dictionary with one of the keys {', '.join(FORMS)}"


def too_large(came: str) -> str:
    """Return the sentence for a body of too many bytes."""
    return f"A body of {came} came; at most {MOST_BODY} are read. Send fewer rows in one request, or smaller files."


def _too_many(came: str) -> str:
    return (
        f"{_capital(came)} came; at most {MOST_ROWS} rows and {MOST_VALUES} values are read. Send them in several "
        "requests, or as files in base64."
    )
