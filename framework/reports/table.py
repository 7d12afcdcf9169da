"""Result tables of numbers with their errors: for the terminal, in Markdown, in HTML, in LaTeX and as CSV."""

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from csv import writer
from html import escape
from numbers import Integral
from pathlib import Path
from typing import Literal, SupportsFloat

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from framework.errors import ConfigError, escape_undecodable
from framework.evaluation.significance import RULE, mean, significantly_best
from framework.storage.text import defuse_formulas

Row = Mapping[str, object]
"""Names and numbers of one result.

The number "<key>_std" (standard deviation over runs, see `aggregate`) or "<key>_sem" (standard error of the mean) is
printed after the number "<key>" as ±. "synthetic" is true if the data were generated.
"""

Better = Mapping[str, Literal["higher", "lower"]]
"""Direction in which the values of a column are better, by the key of the column.

The best value of a column is bold if it differs significantly from every other value
(`framework.evaluation.significance`). If a standard error is not known, no value is bold.
"""

COST_COLUMNS = {
    "milliseconds_per_sample": "ms / sample",
    "flops_per_sample": "FLOPs / sample",
    "parameters": "parameters",
}
"""Headings of the costs in every result table (framework.evaluation.cost.Cost), by key."""
COST_BETTER: Better = dict.fromkeys(COST_COLUMNS, "lower")
"""Direction in which costs are better, by the keys of COST_COLUMNS."""
NOT_AVAILABLE = "not available"
NO_BREAK = "\u00a0"
WIDTH = 80
"""Width of a line of the terminal, in characters, into which a table should fit."""
SPREADS = {"_std": "standard deviation over runs", "_sem": "standard error of the mean"}
"""Meaning of the numbers after ±, by the suffix of their keys."""


def results_table(
    rows: Sequence[Row], columns: Mapping[str, str], *, title: str, better: Better | None = None
) -> Table:
    """Return a table for the terminal.

    Each result is a line. If the table would be wider than WIDTH characters, each result is a column instead, unless
    the table would then be even wider.

    Args:
        rows: the results, one per row.
        columns: headings by key, in order; the first column names the result.
        title: title above the table. If all results are synthetic, "(synthetic data)" is added to it; if only some are,
            a further column says which.
        better: "higher" or "lower", whichever is better, for the key of each column in which the best number may be
            bold. A single result is never bold. The headings of these columns have arrows. None: the arrows are those
            of the first row's "better", if it has one.
    """
    synthetic = [_synthetic(row) for row in rows]
    if rows and all(synthetic) and "synthetic" not in title.lower():
        title = f"{title} (synthetic data)"
    lines = _lines(rows, columns, better or {}, origin=any(synthetic) and not all(synthetic))
    _add_arrows(lines[0], columns, better or (rows[0].get("better") if rows else None))
    transposed = [list(line) for line in zip(*lines, strict=True)]
    if _width(lines) > WIDTH and _width(transposed) < _width(lines):
        lines = transposed
    table = Table(title=Text(title), caption=_caption(rows, columns, lines) or None, box=box.SIMPLE_HEAD)
    for index, head in enumerate(lines[0]):
        heading = Text(_wrap(head.plain, max((len(cell) for cell in _column(lines, index)), default=0)))
        table.add_column(heading, justify="left" if index == 0 else "right", overflow="fold")
    for line in lines[1:]:
        table.add_row(*line)
    return table


def _add_arrows(heads: Sequence[Text], columns: Mapping[str, str], better: object) -> None:
    """Add ↑ to headings of columns in which higher is better, and ↓ where lower is better."""
    if isinstance(better, Mapping):
        ways = {**COST_BETTER, **better}
        for head, key in zip(heads, columns, strict=False):
            head.append({"higher": " ↑", "lower": " ↓"}.get(ways.get(key, ""), ""))


def markdown(rows: Sequence[Row], columns: Mapping[str, str], *, better: Better | None = None) -> str:
    """Return a table of the results in Markdown; if any result is synthetic, a column says which ones are.

    Args:
        rows: the results, one per row.
        columns: headings by key, in order; the first column names the result.
        better: "higher" or "lower", whichever is better, for the key of each column in which the best number may be
            bold; None: no number is bold.
    """
    lines = _lines(rows, columns, better or {}, origin=any(map(_synthetic, rows)))
    cells = [[_escape(cell) for cell in line] for line in lines]
    rule = ["---", *["---:"] * (len(cells[0]) - 1)]
    text = "".join(f"| {' | '.join(line)} |\n" for line in [cells[0], rule, *cells[1:]])
    caption = _caption(rows, columns, lines)
    return f"{text}\n{caption}\n" if caption else text


def html(rows: Sequence[Row], columns: Mapping[str, str], *, better: Better | None = None) -> str:
    """Return a table of the results in HTML; the attribute `data-value` of a cell is the number to sort by.

    If any result is synthetic, a column says which ones are.

    Args:
        rows: the results, as in `markdown`.
        columns: headings by key, as in `markdown`.
        better: better directions, as in `markdown`; None: no number is bold, and no heading has an arrow.
    """
    lines = _lines(rows, columns, better or {}, origin=any(map(_synthetic, rows)))
    _add_arrows(lines[0], columns, better)
    heads = "".join(f"<th>{escape(head.plain)}</th>" for head in lines[0])
    body = ""
    for row, line in zip(rows, lines[1:], strict=True):
        numbers = [*(_number(row.get(key)) for key in columns), *[None] * (len(line) - len(columns))]
        sort_keys = ("" if number is None else f' data-value="{number!r}"' for number in numbers)
        cells = (
            f"<td{sort_key}>{_bold_html(cell)}</td>" for sort_key, cell in zip(sort_keys, line, strict=True)
        )
        body += f"<tr>{''.join(cells)}</tr>\n"
    caption = _caption(rows, columns, lines)
    note = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f"<table>{note}<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}</tbody></table>\n"


def latex(rows: Sequence[Row], columns: Mapping[str, str], *, better: Better | None = None) -> str:
    """Return a table of the results in LaTeX; the table needs no LaTeX package.

    The arguments are those of `markdown`. If any result is synthetic, a column says which ones are.
    """
    lines = _lines(rows, columns, better or {}, origin=any(map(_synthetic, rows)))
    head, *body = (" & ".join(_latex_cell(cell) for cell in line) + r" \\" for line in lines)
    caption = _caption(rows, columns, lines)
    return "\n".join(
        [
            rf"\begin{{tabular}}{{l{'r' * (len(lines[0]) - 1)}}}",
            r"\hline",
            head,
            r"\hline",
            *body,
            r"\hline",
            r"\end{tabular}",
            *([f"% {caption}"] if caption else []),
            "",
        ]
    )


def write_csv(rows: Sequence[Row], columns: Iterable[str] | None, path: Path) -> None:
    """Write results to a CSV file with keys as headings and all digits.

    Standard deviations and standard errors have columns of their own; the cells of missing values are empty.

    Args:
        rows: the results, one per row.
        columns: the keys to write, in order; None: every key that any row has.
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
        table.writerow(defuse_formulas(escape_undecodable(key)) for key in keys)
        table.writerows([_raw(row.get(key)) for key in keys] for row in rows)


def aggregate(rows: Sequence[Row], by: Sequence[str], over: str = "seed") -> list[dict[str, object]]:
    """Return means and standard deviations over groups of runs that differ in `over` only.

    Args:
        rows: the results of runs, one per row.
        by: keys that distinguish the groups; synthetic and real results are always in different groups.
        over: the key that distinguishes the runs of a group.

    Returns:
        One row per group, in order of first appearance. It has the keys of `by`; for every number, the mean "<key>" and
        the sample standard deviation "<key>_std" (NaN for one run); "n", the number of runs; and each other value that
        is equal in all runs of the group. A number that one of the runs lacks is NaN. The standard errors "<key>_sem"
        are kept in a group of a single run; in a group of several runs they are left out, because their mean has no
        meaning.

    Raises:
        ConfigError: a row lacks a key, or two runs of a group have the same `over`.
    """
    groups: dict[tuple[object, ...], list[Row]] = {}
    for row in rows:
        missing = [key for key in (*by, over) if key not in row]
        if missing:
            raise ConfigError(
                f"A result lacks the key {missing[0]!r}, by which results are to be aggregated. Choose among the "
                f"keys of the result: {', '.join(row)}."
            )
        groups.setdefault((*(row[key] for key in by), _synthetic(row)), []).append(row)
    return [_aggregate_group(members, by, over) for members in groups.values()]


def format_number(value: int | float, spread: int | float = math.nan) -> str:
    """Return the text of a number with its error `spread`, such as "1.23 ± 0.04" or "22.8 ± 1.0".

    The error has one significant digit, or two if the first is 1, and determines the digits of the number. Without an
    error, the number has three significant digits. Whole numbers (`int`) are written exactly below 100,000, and
    abbreviated from there on, such as "1.23 M". NaN is "not available".
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
    if decimals > 5 - _exponent(
        size
    ):  # at most six digits of the value; a smaller error is given by its order of magnitude
        return f"{value:.{5 - _exponent(size)}f} ± {spread:.0e}"
    printed = max(decimals, 0)
    return f"{round(value, decimals):.{printed}f} ± {round(spread, decimals):.{printed}f}"


def machine(device: object, threads: object) -> str:
    """Return a description of the machine on which something was measured, such as "cpu (AMD EPYC), 2 threads"."""
    return f"{device}, {threads} thread{'' if threads == 1 else 's'}"


def _plain(value: int | float) -> str:
    """Return the text of a number that has no error."""
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
    """Return the factor by which a large number is divided, and its decimal prefix, such as (1e3, "k")."""
    return next(pair for pair in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")) if abs(value) >= pair[0])


def _exponent(value: int | float) -> int:
    """Return the decimal exponent of a number."""
    return math.floor(math.log10(abs(value)))


def _lines(
    rows: Sequence[Row], columns: Mapping[str, str], better: Better, *, origin: bool
) -> list[list[Text]]:
    """Return the lines of a table, headings first, each as a list of cells.

    If `origin` is True, a further column says which results have synthetic data.
    """
    lines = [[Text(_cell(row, key)) for key in columns] for row in rows]
    for index, key in enumerate(columns):
        values = {
            row_index: value
            for row_index, row in enumerate(rows)
            if (value := _number(row.get(key))) is not None
        }
        if key not in better or len(values) < 2:
            continue
        row_indices = list(values)
        means = [mean(rows[row_index], key, rows[row_index].get("n")) for row_index in row_indices]
        for row_index, best in zip(row_indices, significantly_best(means, better[key]), strict=True):
            if best:
                lines[row_index][index].stylize("bold")
    heads = [Text(head) for head in columns.values()]
    if origin:
        heads.append(Text("origin" if "data" in columns.values() else "data"))
        for row, line in zip(rows, lines, strict=True):
            line.append(Text("synthetic" if _synthetic(row) else "real"))
    return [heads, *lines]


def _cell(row: Row, key: str) -> str:
    """Return the text of the cell of `row` in the column `key`."""
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
    """Return the number that is printed after ± in the column `key`; None if there is none."""
    spreads = (_number(row.get(key + suffix)) for suffix in SPREADS)
    return next((spread for spread in spreads if spread is not None), None)


def _number(value: object) -> float | None:
    """Return a value as float; None if it is not a number, NaN or a truth value."""
    if isinstance(value, bool | np.bool_ | str) or not isinstance(value, SupportsFloat):
        return None
    number = float(value)
    return None if math.isnan(number) else number


def _raw(value: object) -> object:
    """Return a value as it is written to a CSV file."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, str):
        return defuse_formulas(escape_undecodable(value).replace("\r", r"\x0d"))
    if isinstance(value, Integral) or not isinstance(value, SupportsFloat):
        return "" if value is None else value
    return "" if math.isnan(float(value)) else repr(float(value))


def _synthetic(row: Row) -> bool:
    return bool(row.get("synthetic", False))


def _caption(rows: Sequence[Row], columns: Mapping[str, str], lines: Sequence[Sequence[Text]]) -> str:
    """Return the caption that explains ± and bold, as far as the table contains them."""
    spreads = [
        meaning
        for suffix, meaning in SPREADS.items()
        if any(_number(row.get(key + suffix)) is not None for row in rows for key in columns)
    ]
    bold = any(cell.spans for line in lines[1:] for cell in line)
    return "; ".join(
        [f"± {'; for a single run: '.join(spreads)}"] * bool(spreads) + [f"bold: best, {RULE}"] * bold
    )


def _width(lines: Sequence[Sequence[Text]]) -> int:
    """Return the smallest width of a table, in characters, if headings are wrapped at every space and cells are not."""
    widths = [
        max(map(len, [*_wrap(head.plain, 0).splitlines(), *_column(lines, index)]), default=0)
        for index, head in enumerate(lines[0])
    ]
    return sum(widths) + 3 * len(widths) + 1


def _column(lines: Sequence[Sequence[Text]], index: int) -> list[Text]:
    return [line[index] for line in lines[1:]]


def _wrap(heading: str, width: int) -> str:
    """Return a heading with line breaks between words; lines have at most `width` characters, if each word fits."""
    # A single sign, such as "°" or "/", stays with the word before it.
    words = re.sub(r" (?=[^\w\s]( |$))", NO_BREAK, heading)
    width = max([1, width, *map(len, words.split(" "))])
    return textwrap.fill(words, width, break_on_hyphens=False).replace(NO_BREAK, " ")


def _escape(cell: Text) -> str:
    text = " ".join(cell.plain.splitlines())
    # a name of another person must not become an image that a reader's browser loads, nor end the cell
    text = re.sub(r"([\\|\[\]`*])", r"\\\1", text).replace("<", "&lt;")
    return f"**{text}**" if cell.spans else text


def _bold_html(cell: Text) -> str:
    text = escape(cell.plain)
    return f"<b>{text}</b>" if cell.spans else text


_LATEX = {
    **{sign: rf"\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "°": r"$^\circ$",
    "−": "$-$",
    "×": r"$\times$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "·": r"$\cdot$",
    "²": "$^2$",
    "³": "$^3$",
    "κ": r"$\kappa$",
    "μ": r"$\mu$",
    "µ": r"$\mu$",
    "σ": r"$\sigma$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "\n": " ",
}
"""Signs of tables → LaTeX."""


def _latex_cell(cell: Text) -> str:
    text = "".join(_LATEX.get(letter, letter) for letter in cell.plain)
    if text.startswith(("[", "*")):  # the end of the line before, \\, would take these signs as its arguments
        text = f"{{}}{text}"
    return rf"\textbf{{{text}}}" if cell.spans else text


def _aggregate_group(members: Sequence[Row], by: Sequence[str], over: str) -> dict[str, object]:
    """Return the aggregated row of a group of runs."""
    first = members[0]
    distinguishing = [member[over] for member in members]
    repeated = [value for index, value in enumerate(distinguishing) if value in distinguishing[:index]]
    if repeated:
        group = ", ".join(f"{key}={first[key]}" for key in by) or "the sweep"
        raise ConfigError(
            f"Two results of {group} have {over}={repeated[0]}, so they are not independent runs. "
            f"Add the key in which they differ to the grouping ({', '.join(by)}), or leave one of the results out."
        )
    group_row: dict[str, object] = {key: first[key] for key in by}
    keys = dict.fromkeys(key for member in members for key in member)
    for key in keys:
        if key in (*by, over):
            continue
        if key.endswith(tuple(SPREADS)):
            if len(members) == 1:
                group_row[key] = first[key]
            continue
        values = [member.get(key) for member in members]
        if all(value == values[0] for value in values) and not isinstance(values[0], float):
            group_row[key] = values[0]
        elif all(value is None or _is_number(value) for value in values):
            numbers = np.array([math.nan if value is None else float(value) for value in values])  # type: ignore[arg-type]
            with np.errstate(invalid="ignore"):  # the spread of infinite values is NaN
                group_row[key] = float(numbers.mean())
                group_row[f"{key}_std"] = float(numbers.std(ddof=1)) if len(numbers) > 1 else math.nan
    return {**group_row, "n": len(members)}


def _is_number(value: object) -> bool:
    return isinstance(value, SupportsFloat) and not isinstance(value, bool | np.bool_)
