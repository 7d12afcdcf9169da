"""Result tables for people and for programs: numbers with their errors, in text, Markdown and CSV."""

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from csv import writer
from numbers import Integral
from pathlib import Path
from typing import Literal, SupportsFloat

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from framework.errors import ConfigError, escape_undecodable
from framework.evaluation.significance import RULE, mean, significantly_best

Row = Mapping[str, object]
"""Names and numbers of one result.

"<key>_std" (standard deviation over runs, see `aggregate`) or "<key>_sem" (standard error of the mean) is printed
behind "<key>" as ±. "synthetic" says whether the data were generated.
"""

Better = Mapping[str, Literal["higher", "lower"]]
"""Direction in which a column is better.

Its best value is bold if it differs significantly from every other one (`framework.evaluation.significance`), so never
if a ± is not known.
"""

COST_COLUMNS = {
    "milliseconds_per_sample": "ms / sample",
    "flops_per_sample": "FLOPs / sample",
    "parameters": "parameters",
}
"""Costs in every result table (framework.evaluation.cost.Cost), with the headings."""
COST_BETTER: Better = dict.fromkeys(COST_COLUMNS, "lower")
"""Direction in which costs are better."""
NOT_AVAILABLE = "not available"
NO_BREAK = "\u00a0"
WIDTH = 100
"""Width of a terminal's line, in characters, that a table should fit into."""
SPREADS = {"_std": "standard deviation over runs", "_sem": "standard error of the mean"}
"""Suffixes of the keys of errors, and their meaning."""


def results_table(
    rows: Sequence[Row], columns: Mapping[str, str], *, title: str, better: Better | None = None
) -> Table:
    """Return a table for the terminal.

    Each row is a line. If lines would be wider than 100 characters, each row is a column, unless that is even wider.

    Args:
        rows: one result each.
        columns: the keys to show with their headings, in order; the first names the row.
        title: title above the table; it says "synthetic" if all rows are (a column says so if only some are).
        better: directions for bold; a single row is never best.
    """
    synthetic = [_synthetic(row) for row in rows]
    if rows and all(synthetic) and "synthetic" not in title.lower():
        title = f"{title} (synthetic data)"
    lines = _lines(rows, columns, better or {}, origin=any(synthetic) and not all(synthetic))
    turned = [list(line) for line in zip(*lines, strict=True)]
    if _width(lines) > WIDTH and _width(turned) < _width(lines):
        lines = turned
    table = Table(title=Text(title), caption=_caption(rows, columns, lines) or None, box=box.SIMPLE_HEAD)
    for index, head in enumerate(lines[0]):
        heading = Text(_wrapped(head.plain, max((len(cell) for cell in _column(lines, index)), default=0)))
        table.add_column(heading, justify="left" if index == 0 else "right", overflow="fold")
    for line in lines[1:]:
        table.add_row(*line)
    return table


def markdown(rows: Sequence[Row], columns: Mapping[str, str], *, better: Better | None = None) -> str:
    """Return the table in Markdown; if any row is synthetic, a column says which."""
    lines = _lines(rows, columns, better or {}, origin=any(map(_synthetic, rows)))
    written = [[_escaped(cell) for cell in line] for line in lines]
    rule = ["---", *["---:"] * (len(written[0]) - 1)]
    text = "".join(f"| {' | '.join(line)} |\n" for line in [written[0], rule, *written[1:]])
    caption = _caption(rows, columns, lines)
    return f"{text}\n{caption}\n" if caption else text


def csv(rows: Sequence[Row], columns: Iterable[str] | None, path: Path) -> None:
    """Write the columns under their keys, with all digits and with errors beside; missing values are left empty.

    Args:
        rows: one result each.
        columns: the keys, in order; None: all keys of any row.
        path: file to write.
    """
    if columns is None:
        columns = dict.fromkeys(key for row in rows for key in row if not key.endswith(tuple(SPREADS)))
    keys = [
        f"{key}{suffix}"
        for key in columns
        for suffix in ("", *SPREADS)
        if not suffix or any(f"{key}{suffix}" in row for row in rows)
    ]
    if "synthetic" not in keys and any("synthetic" in row for row in rows):
        keys.append("synthetic")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = writer(file, lineterminator="\n")
        table.writerow(map(escape_undecodable, keys))
        table.writerows([_raw(row.get(key)) for key in keys] for row in rows)


def aggregate(rows: Sequence[Row], by: Sequence[str], over: str = "seed") -> list[dict[str, object]]:
    """Return mean and standard deviation over runs that differ in `over` only.

    Args:
        rows: one run each.
        by: keys that distinguish the groups; synthetic and real results are always in different groups.
        over: the key that distinguishes the runs of a group.

    Returns:
        One row per group, in order of first appearance. It has the keys of `by`; for every number "<key>" the mean and,
        as "<key>_std", the sample standard deviation (NaN for one run); "n", the number of runs; and every other value
        that all runs of the group share. A number that one of the runs lacks is NaN. A single run keeps its standard
        errors "<key>_sem"; for several runs they are left out, because their mean means nothing.

    Raises:
        ConfigError: a row lacks a key, or two runs of a group have the same `over`.
    """
    groups: dict[tuple[object, ...], list[Row]] = {}
    for row in rows:
        missing = [key for key in (*by, over) if key not in row]
        if missing:
            raise ConfigError(f"A result has no {missing[0]!r} to aggregate by; it has: {', '.join(row)}.")
        groups.setdefault((*(row[key] for key in by), _synthetic(row)), []).append(row)
    return [_aggregated(members, by, over) for members in groups.values()]


def format_number(value: int | float, spread: int | float = math.nan) -> str:
    """Return a number to three significant digits, or as its error allows: "1.23 ± 0.04", "22.8 ± 1.0".

    The error is given to one significant digit, to two if the first is 1. Whole numbers (`int`) are exact below 100,000
    and "1.23 M" above. NaN is "not available".
    """
    if math.isnan(value):
        return NOT_AVAILABLE
    if math.isnan(spread) or math.isinf(value):
        return _plain(value)
    if spread == 0 or math.isinf(spread):
        return f"{_plain(value)} ± {spread:.0f}"
    size = max(abs(value), spread)
    if not 1e-4 <= size < 1e15:
        return f"{value:.2e} ± {spread:.0e}"
    if size >= 1e5:
        scale, unit = _unit(size)
        return f"({format_number(value / scale, spread / scale)}) {unit}"
    decimals = -_exponent(spread) + (1 if spread < 1.95 * 10.0 ** _exponent(spread) else 0)
    if decimals > 5 - _exponent(size):  # beyond six digits of the value, the size of the error suffices
        return f"{value:.{5 - _exponent(size)}f} ± {spread:.0e}"
    kept = max(decimals, 0)
    return f"{round(value, decimals):.{kept}f} ± {round(spread, decimals):.{kept}f}"


def machine(device: object, threads: object) -> str:
    """Return the machine of a measurement as text: "cpu (AMD EPYC), 2 threads"."""
    return f"{device}, {threads} thread{'' if threads == 1 else 's'}"


def _plain(value: int | float) -> str:
    """Return a number without its error."""
    if isinstance(value, Integral) and abs(value) < 1e15:
        if abs(value) < 1e5:
            return str(value)
        scale, unit = _unit(value)
        return f"{_plain(float(value) / scale)} {unit}"
    if value == 0 or math.isinf(value):
        return f"{value:.0f}"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.2e}"
    return f"{value:.{max(0, 2 - _exponent(float(f'{value:.2e}')))}f}"


def _unit(value: int | float) -> tuple[float, str]:
    """Return the decimal prefix of a large number, with its factor: 1e3 and "k", and so on."""
    return next(pair for pair in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")) if abs(value) >= pair[0])


def _exponent(value: int | float) -> int:
    """Return the decimal exponent of a number."""
    return math.floor(math.log10(abs(value)))


def _lines(
    rows: Sequence[Row], columns: Mapping[str, str], better: Better, *, origin: bool
) -> list[list[Text]]:
    """Return headings and cells; `origin` adds a column that says which data are synthetic."""
    lines = [[Text(_cell(row, key)) for key in columns] for row in rows]
    for index, key in enumerate(columns):
        values = {
            place: value for place, row in enumerate(rows) if (value := _number(row.get(key))) is not None
        }
        if key not in better or len(values) < 2:
            continue
        places = list(values)
        means = [mean(rows[place], key, rows[place].get("n")) for place in places]
        for place, best in zip(places, significantly_best(means, better[key]), strict=True):
            if best:
                lines[place][index].stylize("bold")
    heads = [Text(head) for head in columns.values()]
    if origin:
        heads.append(Text("data"))
        for row, line in zip(rows, lines, strict=True):
            line.append(Text("synthetic" if _synthetic(row) else "real"))
    return [heads, *lines]


def _cell(row: Row, key: str) -> str:
    """Return the text of a cell."""
    value = row.get(key)
    if value is None:
        return NOT_AVAILABLE
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, SupportsFloat):
        return str(value)
    spread = _spread(row, key)
    return format_number(
        int(value) if isinstance(value, Integral) else float(value), math.nan if spread is None else spread
    )


def _spread(row: Row, key: str) -> float | None:
    """Return the number behind ±; None if there is none."""
    spreads = (_number(row.get(key + suffix)) for suffix in SPREADS)
    return next((spread for spread in spreads if spread is not None), None)


def _number(value: object) -> float | None:
    """Return a value as float; None if it is not a number, is NaN, or is a truth value."""
    if isinstance(value, bool | np.bool_ | str) or not isinstance(value, SupportsFloat):
        return None
    number = float(value)
    return None if math.isnan(number) else number


def _raw(value: object) -> object:
    """Return a value for a CSV file."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, str):
        return escape_undecodable(value).replace("\r", r"\x0d")
    if isinstance(value, Integral) or not isinstance(value, SupportsFloat):
        return "" if value is None else value
    return "" if math.isnan(float(value)) else repr(float(value))


def _synthetic(row: Row) -> bool:
    return bool(row.get("synthetic", False))


def _caption(rows: Sequence[Row], columns: Mapping[str, str], lines: Sequence[Sequence[Text]]) -> str:
    """Return the meaning of ± and bold, for those that the table has."""
    spreads = [
        meaning
        for suffix, meaning in SPREADS.items()
        if any(_number(row.get(key + suffix)) is not None for row in rows for key in columns)
    ]
    bold = any(cell.spans for line in lines[1:] for cell in line)
    return "; ".join(
        [f"± {'; of a single run '.join(spreads)}"] * bool(spreads) + [f"bold: best, {RULE}"] * bold
    )


def _width(lines: Sequence[Sequence[Text]]) -> int:
    """Return the width of a table, in characters, if cells are not broken and headings are broken between words."""
    widths = [
        max(map(len, [*_wrapped(head.plain, 0).splitlines(), *_column(lines, index)]), default=0)
        for index, head in enumerate(lines[0])
    ]
    return sum(widths) + 3 * len(widths) + 1


def _column(lines: Sequence[Sequence[Text]], index: int) -> list[Text]:
    return [line[index] for line in lines[1:]]


def _wrapped(heading: str, width: int) -> str:
    """Return a heading broken into lines between words, at most `width` wide if the words allow it."""
    # A single sign, such as "°" or "/", stays with the word before it.
    words = re.sub(r" (?=[^\w\s]( |$))", NO_BREAK, heading)
    width = max([1, width, *map(len, words.split(" "))])
    return textwrap.fill(words, width, break_on_hyphens=False).replace(NO_BREAK, " ")


def _escaped(cell: Text) -> str:
    text = cell.plain.replace("|", "\\|").replace("\n", " ")
    return f"**{text}**" if cell.spans else text


def _aggregated(members: Sequence[Row], by: Sequence[str], over: str) -> dict[str, object]:
    """Return the row of a group of runs."""
    first = members[0]
    seen = [member[over] for member in members]
    repeated = [value for index, value in enumerate(seen) if value in seen[:index]]
    if repeated:
        group = ", ".join(f"{key}={first[key]}" for key in by) or "the sweep"
        raise ConfigError(
            f"Two results of {group} have {over}={repeated[0]}: they are not independent runs. "
            f"Add the key in which they differ to the grouping ({', '.join(by)}), or leave one of them out."
        )
    found: dict[str, object] = {key: first[key] for key in by}
    keys = dict.fromkeys(key for member in members for key in member)
    for key in keys:
        if key in (*by, over):
            continue
        if key.endswith(tuple(SPREADS)):
            if len(members) == 1:
                found[key] = first[key]
            continue
        values = [member.get(key) for member in members]
        if all(value == values[0] for value in values) and not isinstance(values[0], float):
            found[key] = values[0]
        elif all(value is None or _is_number(value) for value in values):
            numbers = np.array([math.nan if value is None else float(value) for value in values])  # type: ignore[arg-type]
            with np.errstate(invalid="ignore"):  # infinite values have no spread
                found[key] = float(numbers.mean())
                found[f"{key}_std"] = float(numbers.std(ddof=1)) if len(numbers) > 1 else math.nan
    return {**found, "n": len(members)}


def _is_number(value: object) -> bool:
    return isinstance(value, SupportsFloat) and not isinstance(value, bool | np.bool_)
