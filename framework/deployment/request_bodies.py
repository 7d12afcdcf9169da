"""Checks of requests, so that MLflow parses them in bounded memory: content types, and bodies of JSON or CSV.

Parquet is not accepted, because a file of a few kilobytes can expand to any size, which is known only after expansion.
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
"""Largest number of values in a body of JSON or CSV; each list, dictionary and empty cell counts as one value."""
MOST_DEPTH = 32
"""Largest depth of nested lists and dictionaries in JSON."""
MOST_INPUTS = 2**25
"""Largest number of numbers in all model inputs of a request."""
AT_ONCE = 2**28
"""Largest total size, in bytes, of the bodies that the server holds at a time; a single body may exceed it."""

FORMS = ("dataframe_split", "dataframe_records", "instances", "inputs")
"""Keys of a JSON body under which MLflow accepts rows."""


class Refusal(Exception):
    """Exception that refuses a request, with the HTTP status and the message for the client."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


def content_type(headers: Mapping[bytes, bytes]) -> str:
    """Return the media type of a body, "application/json" or "text/csv".

    Raises:
        Refusal: the media type is another one, the encoding is not UTF-8, or the body is compressed.
    """
    value = headers.get(b"content-type", b"").decode("latin-1")
    kind, *parameters = (part.strip() for part in value.split(";"))
    if kind.lower() not in ("application/json", "text/csv"):
        raise Refusal(415, f"Got Content-Type: {quote(value)}, but application/json or text/csv is required.")
    for parameter in filter(None, parameters):
        name, _, charset = parameter.partition("=")
        if name.strip().lower() != "charset" or charset.strip(" \"'").lower() not in ("utf-8", "utf8"):
            raise Refusal(415, f"Got Content-Type: {quote(value)}. Use {kind.lower()}; charset=utf-8.")
    if headers.get(b"content-encoding", b"identity") != b"identity":
        raise Refusal(415, "The body is compressed. Send it uncompressed, without Content-Encoding.")
    return kind.lower()


def require_bounded(body: bytes, kind: str) -> None:
    """Raise a Refusal if a body of the media type `kind` is too large, too deeply nested or malformed.

    Raises:
        Refusal: the message names the fault and the remedy.
    """
    try:
        text = body.decode("utf-8")
    except UnicodeDecodeError as error:
        raise Refusal(
            400, f"Byte {error.start} of the body is not UTF-8. Encode the body in UTF-8."
        ) from None
    if not text.strip():
        raise Refusal(400, f"The body is empty. Send {expected_body(kind)}.")
    if kind == "text/csv":
        _require_table(text)
        return
    _require_few_values(body)
    try:
        content = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # JSONDecodeError, or an integer of too many digits
        raise Refusal(400, f"The body cannot be read as JSON ({shorten(error)}). Correct the body.") from None
    _require_form(content)


def _require_few_values(body: bytes) -> None:
    """Refuse JSON with too many values or too deep nesting, in bounded memory and without parsing it.

    The JSON may be malformed.
    """
    # Remove escaped backslashes and quotation marks, so that every remaining quotation mark begins or ends a text.
    plain = body.replace(b"\\\\", b"").replace(b'\\"', b"").translate(None, _WITHOUT_MEANING)
    if plain.count(b'"') > 4 * MOST_VALUES:
        raise Refusal(413, _too_many_message(f"more than {2 * MOST_VALUES} texts"))
    marks = b"".join(plain.split(b'"')[::2])
    values = len(marks) - marks.count(b"]") - marks.count(b"}")
    if values > MOST_VALUES or len(marks) > 2 * MOST_VALUES:
        raise Refusal(413, _too_many_message(f"{values} values"))
    codes = np.frombuffer(marks, np.uint8)
    steps = np.isin(codes, (ord("["), ord("{"))).astype(np.int64) - np.isin(codes, (ord("]"), ord("}")))
    depth = int(steps.cumsum().max(initial=0))
    if depth > MOST_DEPTH:
        raise Refusal(
            400,
            f"Lists and dictionaries are nested {depth} levels deep, but at most {MOST_DEPTH} levels are read. Send "
            "rows, or an array of inputs.",
        )


_WITHOUT_MEANING = bytes(set(range(256)) - set(b'"[]{},'))


def _require_table(text: str) -> None:
    lines = text.splitlines()
    if len(lines) > MOST_ROWS:
        raise Refusal(413, _too_many_message(f"{len(lines)} lines"))
    # pandas pads short lines to the length of the longest one.
    columns = 1 + max(line.count(",") for line in lines)
    if columns * len(lines) > MOST_VALUES:
        raise Refusal(413, _too_many_message(f"{len(lines)} lines of up to {columns} cells"))
    if "\0" in text:
        raise Refusal(
            400, "The body contains a NUL character, which is not allowed in CSV. Send text without it."
        )
    if len(lines) < 2:
        raise Refusal(400, f"Got {len(lines)} line of CSV. Send {expected_body('text/csv')}.")


def _require_form(content: object) -> None:
    if not isinstance(content, dict) or len(set(FORMS) & set(content)) != 1:
        description = (
            f"a dictionary with the keys {quote(list(content))}"
            if isinstance(content, dict)
            else _describe(content)
        )
        raise Refusal(400, f"Got {description}. Send {expected_body('application/json')}.")
    form = next(name for name in FORMS if name in content)
    for key, value in content.items():
        if key == "params" and value:
            raise Refusal(400, "The model has no parameters. Leave 'params' out.")
        if key not in (form, "params"):
            raise Refusal(400, f"The key {quote(key)} beside {form!r} is not read. Leave the key out.")
    rows = content[form]
    if form == "dataframe_split":
        _require_split(rows)
    elif form == "dataframe_records" or (
        form == "instances" and isinstance(rows, list) and any(isinstance(row, dict) for row in rows)
    ):
        _require_records(rows, form)
    elif rows is None or rows in ([], {}, ""):
        raise Refusal(400, f"{form!r} is empty. Send at least one row.")
    if isinstance(rows, list) and len(rows) > MOST_ROWS:
        raise Refusal(413, _too_many_message(f"{len(rows)} rows"))


def _require_split(table: object) -> None:
    expected = "Expected {'columns': [names], 'data': [rows, each a list with a value for each column]}"
    if not isinstance(table, dict):
        raise Refusal(400, f"'dataframe_split' is {_describe(table)}. {expected}.")
    columns, rows, index = table.get("columns"), table.get("data"), table.get("index")
    if not set(table) <= {"columns", "data", "index"} or not isinstance(columns, list):
        raise Refusal(400, f"'dataframe_split' has the keys {quote(list(table))}. {expected}.")
    if not all(isinstance(name, str) for name in columns) or len(set(columns)) < len(columns):
        raise Refusal(400, f"'columns' is {quote(columns)}, but must be a list of distinct names.")
    if not isinstance(rows, list) or not rows:
        raise Refusal(400, f"'data' is {_describe(rows)}. Send a list with at least one row.")
    if len(rows) > MOST_ROWS:
        raise Refusal(413, _too_many_message(f"{len(rows)} rows"))
    for number, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != len(columns):
            description = f"a list of {len(row)}" if isinstance(row, list) else _describe(row)
            raise Refusal(400, f"row {number} is {description}, but must be a list of {len(columns)} values.")
    if index is not None and (not isinstance(index, list) or len(index) != len(rows)):
        raise Refusal(400, f"'index' does not have a value for each of {len(rows)} rows. Leave 'index' out.")


def _require_records(records: object, form: str) -> None:
    """Raise a Refusal if the rows in `records` have different keys.

    A table has a column for each key, so 1000 rows of 1000 different keys each would make 10⁹ cells.
    """
    if not isinstance(records, list) or not records:
        raise Refusal(400, f"{form!r} is {_describe(records)}. Send a list of rows, {{column: value}}.")
    if len(records) > MOST_ROWS:
        raise Refusal(413, _too_many_message(f"{len(records)} rows"))
    for number, row in enumerate(records):
        if not isinstance(row, dict) or (number and row.keys() != records[0].keys()):
            description = (
                f"has the keys {quote(list(row))}" if isinstance(row, dict) else f"is {_describe(row)}"
            )
            raise Refusal(
                400, f"row {number} {description}. Send {{column: value}}, with the same columns in each row."
            )


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    dictionary = dict(pairs)
    if len(dictionary) < len(pairs):
        earlier: set[str] = set()
        twice = next(key for key, _ in pairs if key in earlier or earlier.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {quote(twice)} occurs twice in one dictionary")
    return dictionary


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number in JSON")


def _describe(value: object) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    kinds = {dict: "a dictionary", str: "a text", bool: "true or false", type(None): "nothing"}
    return kinds.get(type(value), "a number")


def expected_body(kind: str) -> str:
    """Return a description of the body that is expected for the media type `kind`."""
    if kind == "text/csv":
        return "a line with the names of the columns, and a line for each row"
    return f"a dictionary with one of the keys {', '.join(FORMS)}"


def too_large_message(size: str) -> str:
    """Return the message about a body that is too large; `size` is its size in words, such as "5 bytes"."""
    return f"The body has {size}, but at most {MOST_BODY} are read. Send fewer rows in one request, or smaller files."


def _too_many_message(amount: str) -> str:
    return (
        f"Got {amount}, but at most {MOST_ROWS} rows and {MOST_VALUES} values are read. Send them in several "
        "requests, or as files in base64."
    )
