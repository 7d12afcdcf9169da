"""Tests of the reader of CSV columns, and of its messages, which name line and column."""

import bz2
import gzip
import lzma
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.datasets.csv_columns import Writing, mostly_numbers, number, numbers, read_columns, require
from framework.errors import DataError


def written(folder: Path, content: str | bytes) -> Path:
    file = folder / "table.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


def test_what_a_spreadsheet_writes_is_read(tmp_path: Path) -> None:
    """A byte-order mark, carriage returns, quotes, blanks, empty lines and lines of nothing but commas."""
    text = 'a, b ,word\r\n1, 2.5 ,"x, y"\r\n\r\n,,\r\n"-1e3",nan, z\r\n'
    columns = read_columns(written(tmp_path, b"\xef\xbb\xbf" + text.encode()))
    assert columns.cells == {"a": ["1", "-1e3"], "b": ["2.5", "nan"], "word": ["x, y", "z"]}
    assert columns.lines == [2, 5]
    np.testing.assert_array_equal(numbers(columns, "a", missing=""), [1.0, -1000.0])
    np.testing.assert_array_equal(numbers(columns, "b", missing=None), [2.5, math.nan])


def test_an_empty_cell_in_a_table_of_one_column_is_a_row(tmp_path: Path) -> None:
    columns = read_columns(written(tmp_path, 'a\n1\n""\n\n3\n'))
    assert columns.lines == [2, 3, 5]
    np.testing.assert_array_equal(numbers(columns, "a", missing=None), [1.0, math.nan, 3.0])


def test_a_packed_and_a_parquet_table_are_read_as_the_same_table_in_csv(tmp_path: Path) -> None:
    """All types of columns that pandas writes: numbers of each size, logical values, words, categories and dates."""
    count = 70_000  # more rows than are read at once
    random = np.random.default_rng(0)
    words = random.choice(["red", " blue ", "NA", "1,5", ""], count)
    frame = pd.DataFrame(
        {
            "real": random.normal(size=count) * 10.0 ** random.integers(-300, 300, count),
            "single": random.normal(size=count).astype(np.float32).astype(np.float64),
            "whole": random.integers(-(2**62), 2**62, count),
            "small": pd.array(random.integers(0, 255, count), "UInt8"),
            "logical": random.random(count) > 0.5,
            "words": words,
            "kinds": pd.Categorical(words),
            "date": pd.date_range("1970-01-01", periods=count, freq="D").date,
            "empty": [None] * count,
            "a.b": 1.5,
        }
    )
    frame.loc[3, ["real", "small", "words", "kinds", "date"]] = None
    frame.to_csv(tmp_path / "table.csv", index=False)
    content = (tmp_path / "table.csv").read_bytes()
    (tmp_path / "packed").write_bytes(gzip.compress(content[:9]) + gzip.compress(content[9:]))
    expected = read_columns(tmp_path / "table.csv")
    packed = read_columns(tmp_path / "packed")
    assert packed.cells == expected.cells and packed.lines == expected.lines
    frame["lists"] = [[1, 2]] * count
    frame.set_index(np.array([f"row {number}" for number in range(count)])).to_parquet(tmp_path / "parquet")
    columns = read_columns(tmp_path / "parquet")
    assert columns.left_out == {
        "lists": "holds values of type list<element: int64>",
        "__index_level_0__": "row labels of pandas",
    }
    logical = [cell.upper() for cell in expected.cells["logical"]]
    assert columns.cells == {**expected.cells, "logical": logical}
    assert columns.lines == [*range(1, count + 1)]


@pytest.mark.parametrize(
    ("name", "value"),
    [("separator", "semicolon"), ("decimal", "comma"), ("thousands", "space"), ("encoding", "windows-1252")],
)
def test_the_notation_of_text_is_refused_for_a_parquet_table(tmp_path: Path, name: str, value: str) -> None:
    pd.DataFrame({"a": [1.5]}).to_parquet(tmp_path / "table")
    with pytest.raises(DataError, match=f"data.{name} is set, but the table is a Parquet file"):
        read_columns(tmp_path / "table", Writing(**{name: value}))


@pytest.mark.parametrize("eol", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    ("header", "names"),
    [
        ("a;b", ("a", "b")),
        ('"a\n(cm)";b', ("a (cm)", "b")),  # a line break that a spreadsheet allows in a cell
        ('a;"b\n\n(x, y)"', ("a", "b (x, y)")),
        ("a, cm;b", ("a, cm", "b")),
        ("a, cm;b, kg", ("a, cm", "b, kg")),
        ('a";b', ('a"', "b")),
    ],
)
@pytest.mark.parametrize("sign", [";", "\t", "|"])
def test_the_separator_is_found_by_the_names_and_the_first_row(
    tmp_path: Path, sign: str, header: str, names: tuple[str, str], eol: str
) -> None:
    text = "\n".join([header.replace(";", sign), f"0,5{sign}1", "", f"2{sign}3", ""]).replace("\n", eol)
    columns = read_columns(written(tmp_path, text))
    assert columns.cells == {names[0]: ["0,5", "2"], names[1]: ["1", "3"]}
    assert columns.lines == [2 + header.count("\n"), 4 + header.count("\n")]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty or begins with a blank line"),
        ("\na,b\n1,2", "is empty or begins with a blank line"),
        ("a,b", "has no row below its first line"),
        ("a,b\n,\n\n", "has no row below its first line"),
        ("a b\n1 2\n3 4", r"is separated by blanks: its first line is 'a b'. Commas"),
        ('"a" "b"\n"1" 2\n', "blanks separate the cells; set data.separator=space"),
        (
            "measured today\n\na,b\n1,2",
            r"line 3: the line has 2 cells, .* such as a title, stand above the names",
        ),
        ("1,2\n3,4", r"line 1: '1, 2' are numbers, but the first line must name the columns"),
        ("a,b,a\n1,2,3", "the column 'a' is named twice"),
        (",a\nx,1", r"column 1 has no name, but holds 'x', which is not a row number"),
        (
            "a,b\n1,5,2\n",
            r"line 2: the line has 3 cells, but the first line names 2 .* with a decimal comma in quotation marks",
        ),
        ("a,b\n1,2\n1,2,3", "line 3: the line has 3 cells, but the first line names 2"),
        ("a,b\n1,2\n1\n", "line 3: the line has 1 cells, but the first line names 2"),
        ('a,b\n1,"2', "cannot be read"),
        (b"a,b\n\xe4,2", "line 2 .* not UTF-8. Save the table as UTF-8, which Excel calls CSV UTF-8"),
        (
            b"PK\x03\x04\x14\x00",
            r"an archive, such as an Excel workbook \(.xlsx\), but plain text is required",
        ),
        (gzip.compress(b"a,b\n1,2", mtime=0)[:-9], "Compressed file ended before"),
        (
            gzip.compress(bz2.compress(b"a,b\n1,2"), mtime=0),
            "compressed with bzip2, but plain text is required",
        ),
        (gzip.compress(bytes(2**28), 1, mtime=0), "decompresses to more than 134217728 bytes"),
        (gzip.compress(b"a,b\n" + b"," * 2**25, 1, mtime=0), "decompresses to 33554434 numbers, but at most"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, content: str | bytes, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_columns(written(tmp_path, content))


@pytest.mark.parametrize("packed", [bz2.compress, lambda content: bz2.compress(content, 1), lzma.compress])
def test_packed_files_are_named(tmp_path: Path, packed: Callable[[bytes], bytes]) -> None:
    with pytest.raises(
        DataError, match=r"the file is compressed with (bzip2|xz), but plain text is required"
    ):
        read_columns(written(tmp_path, packed(b"a,b\n1,2")))


@pytest.mark.parametrize("name", ["PAR1", "BZh", "BZh9", "PK", "HDF", "7zXZ"])
def test_a_column_named_like_the_beginning_of_a_packed_file_is_read(tmp_path: Path, name: str) -> None:
    assert [*read_columns(written(tmp_path, f"{name},b\n1,2\n")).cells] == [name, "b"]


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.csv: no such file; a CSV table is expected"):
        read_columns(tmp_path / "none.csv")
    with pytest.raises(DataError, match=r"cannot be read as a table, because it is a folder\. Name a file"):
        read_columns(tmp_path)


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("abc", r"line 4, column 'a': 'abc' is not a finite number"),
        ("", r"line 4, column 'a': The cell is empty, but a finite number.* Or set it to skip\."),
        ("NA", r"'NA' is not a finite number.* Or set it to skip\."),
        ("nan", r"'nan' is not a finite number.* Or set it to skip\."),
        (
            "-inf",
            r"'-inf' is not a finite number, which is required\. Correct the cell, or remove the line\.$",
        ),
        ("1e999", "'1e999' is not a finite number"),
        ("1_0", "'1_0' is not a finite number"),
        ('"1,5"', r"'1,5' is not a finite number.* The cell is a number with a decimal comma\. Write 1\.5"),
    ],
)
def test_cells_that_are_no_finite_number_are_named(tmp_path: Path, cell: str, message: str) -> None:
    columns = read_columns(written(tmp_path, f"a,b\n1,1\n2,2\n{cell},3\nxyz,4\n"))
    with pytest.raises(DataError, match=message):
        numbers(columns, "a", missing="set it to skip")
    np.testing.assert_array_equal(numbers(columns, "b", missing=""), [1.0, 2.0, 3.0, 4.0])


def test_only_missing_numbers_may_be_missing(tmp_path: Path) -> None:
    columns = read_columns(written(tmp_path, "a\n1\nNone\n?\ninf\n"))
    with pytest.raises(DataError, match="line 5, column 'a': 'inf'"):
        numbers(columns, "a", missing=None)


def test_columns_of_numbers_are_told_from_columns_of_words(tmp_path: Path) -> None:
    text = "numbers,typo,words,empty,half\n1,1,a,,1\n2,x,b,NA,b\n3,3,3,,\n"
    columns = read_columns(written(tmp_path, text))
    found = [name for name in columns.cells if mostly_numbers(columns, name)]
    assert found == ["numbers", "typo"]


def test_a_name_that_is_no_column_is_refused_with_the_nearest(tmp_path: Path) -> None:
    columns = read_columns(written(tmp_path, "height,width\n1,2\n"))
    require(columns, ("width", "height"), "data.columns")
    with pytest.raises(
        DataError, match=r"data\.columns names the column 'heigth', .* Did you mean 'height'\?"
    ):
        require(columns, ("heigth",), "data.columns")


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=20))
@settings(deadline=None, max_examples=50)
def test_every_float_comes_back_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, values: list[float]
) -> None:
    text = "a,b\n" + "\n".join(f"{value!r},{'' if index else 1}" for index, value in enumerate(values))
    columns = read_columns(written(tmp_path_factory.mktemp("any"), text))
    assert numbers(columns, "a", missing="").tolist() == values
    found = numbers(columns, "b", missing=None)  # through the cells one by one
    assert found[0] == 1
    assert np.isnan(found[1:]).all()


@given(st.text(max_size=80))
@settings(deadline=None, max_examples=150)
def test_any_text_is_read_or_refused_with_a_sentence(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    file = tmp_path_factory.mktemp("any") / "table.csv"
    file.write_text(text, encoding="utf-8", errors="replace", newline="")
    try:
        columns = read_columns(file)
    except DataError as error:
        assert str(file) in str(error)
        return
    assert all(len(column) == len(columns.lines) >= 1 for column in columns.cells.values())
    for name in columns.cells:
        alone = [number(cell) for cell in columns.cells[name]]
        finite = all(value is not None and math.isfinite(value) for value in alone)
        try:
            assert finite == (numbers(columns, name, missing="").tolist() == alone)
        except DataError:
            assert not finite
