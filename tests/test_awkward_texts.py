"""Numbers, headers and encodings as people and programs write them, through every reader of text.

A case is read with the right value, or refused with a sentence that names file and line and says what to do; no reader
makes other numbers of it silently.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import nibabel
import numpy as np
import pytest

from framework.bodies import motion
from framework.datasets.csv_columns import (
    ColumnChoice,
    LabelledWriting,
    Writing,
    describe_choice,
    numbers,
    numeric_columns,
    read_columns,
    tables,
)
from framework.errors import DataError
from framework.geometry import meshes
from framework.scenes import scene_files
from framework.storage import text
from plugins.data.cest.volumes import read_volume
from plugins.data.head_pose import towncentre_labels
from plugins.data.images_with_angles.table import read_table
from plugins.data.moons.points import read_points
from plugins.data.table_tennis import recordings


@dataclass(frozen=True)
class TextReader:
    """A reader of text, and a file for it.

    Attributes:
        name: of the file.
        content: with {} where the number in question stands.
        read: the number in question.
        line: where it stands, from 1; 0 where no line is named.
        beside: other files that the reader wants.
        signed: whether the number may be negative.
        cells: whether quotation marks may stand around the number.
    """

    name: str
    content: str
    read: Callable[[Path], float]
    line: int
    beside: dict[str, str | bytes] | None = None
    signed: bool = True
    cells: bool = False


def vertex(file: Path) -> float:
    return float(meshes.read(file).vertices[2, 1])


def color(file: Path) -> float:
    return float(meshes.read(file).attribute(("green",))[2, 0])


def material(file: Path) -> float:
    colors = scene_files.read(file.with_suffix(".obj")).scene.colors
    return float(colors[0, 1])  # type: ignore[index]


OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 {} 0\n3 0 1 2\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 {} 0\n3 0 1 2\n"
)
OBJ = "# a triangle\nv 0 0 0\nv 1 0 0\nv 0 {} 0\nf 1 2 3\n"
COLOURED = "v 0 0 0 0 0 0\nv 1 0 0 0 0 0\nv 0 1 0 1 {} 0\nf 1 2 3\n"
STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 {} 0\nendloop\nendfacet\n"
    "endsolid a\n"
)
MTL = "newmtl a\nKd 1 {} 0\n"
NAMED = "mtllib one.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"
BVH = (
    "HIERARCHY\nROOT Hips\n{{\nOFFSET 0 {} 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n"
    "End Site\n{{\nOFFSET 0 1 0\n}}\n}}\nMOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0\n"
)
TURNED = BVH.replace("OFFSET 0 {} 0", "OFFSET 0 0 0").replace("\n0 0 0\n", "\n0 0 {}\n")


def cell(file: Path) -> float:
    ((_, found),) = tables([file], ("a",), "The test", LabelledWriting())
    return float(found[1, 0])


def pan(file: Path) -> float:
    return math.degrees(read_table(file, None, None).rows[1].angles[0])


def offset(file: Path) -> float:
    return float(read_volume(file.with_name("one.nii")).offsets[1])


def turned(file: Path) -> float:
    rotation = motion.read(file).rotations[0, 0]
    return math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))


TABLE = (
    "a,b,y\n"
    + "0,0,no\n{},1,yes\n"
    + "".join(f"{row / 8},{row * row % 7},{('no', 'yes')[row % 2]}\n" for row in range(30))
)
ANGLES = "file,pan\na.png,0\nb.png,{}\n" + "".join(f"{row}.png,{row * 31 % 360}\n" for row in range(30))
FLIGHT = "t,x,y,z\n0.000,0,0,0\n0.016,{},0,0\n0.032,0,0,0\n"
POINTS = "x,y\n0,1\n{},0\n2,2\n"
SPECTRA = 1 - 0.5 / (1 + np.linspace(-1, 1, 3) ** 2) + np.zeros((2, 2, 1, 3))


READERS = {
    "OFF": TextReader("one.off", OFF, vertex, 5),
    "PLY": TextReader("one.ply", PLY, vertex, 12),
    "OBJ": TextReader("one.obj", OBJ, vertex, 4),
    "OBJ, colours": TextReader("one.obj", COLOURED, color, 3, signed=False),
    "STL": TextReader("one.stl", STL, vertex, 6),
    "MTL": TextReader("one.mtl", MTL, material, 2, {"one.obj": NAMED}, signed=False),
    "XYZ": TextReader("one.xyz", "0 0 0\n1 0 0\n0 {} 0\n", vertex, 3),
    "XYZ, semicolons": TextReader("one.xyz", "x;y;z\n0;0;0\n1;0;0\n0;{};0\n", vertex, 4),
    "XYZ, tabs": TextReader("one.xyz", "# x y z\n0\t0\t0\n1\t0\t0\n0\t{}\t0\n", vertex, 4),
    "BVH, offsets": TextReader("walk.bvh", BVH, lambda file: float(motion.read(file).offsets[0, 1]), 4),
    "BVH, frames": TextReader("walk.bvh", TURNED, turned, 14),
    "labels of TownCentre": TextReader(
        "one.txt", "pan = {}\nvalid = 1\n", lambda file: towncentre_labels.read_label(file)[0], 1
    ),
    "offsets of Z-spectra": TextReader(
        "one.offsets.txt",
        "-1\n{}\n1\n",
        offset,
        2,
        {"one.nii": nibabel.Nifti1Image(SPECTRA, np.eye(4)).to_bytes()},
    ),
    "tables": TextReader("one.csv", TABLE, cell, 3, cells=True),
    "tables, semicolons": TextReader("one.csv", TABLE.replace(",", ";"), cell, 3, cells=True),
    "tables, tabs": TextReader("one.csv", TABLE.replace(",", "\t"), cell, 3, cells=True),
    "images with angles": TextReader("angles.csv", ANGLES, pan, 3, cells=True),
    "flights": TextReader(
        "one.csv", FLIGHT, lambda file: recordings.flights_of(file, 0.016)[0].places[1, 0], 3, cells=True
    ),
    "points of the plane": TextReader(
        "one.csv", POINTS, lambda file: read_points([file]).fields["input"][1, 0].item(), 3, cells=True
    ),
}
NOT_NUMBERS = (
    *(
        "1,5",
        "1,234",
        "1.234,5",
        "1'234",
        "5%",
        "$5",
        "5 €",
        "TRUE",
        "1_0",
        "0x10",
        "(5)",
        "5-",
        '"5"x',
        "<5",
        "1.5e",
    ),
    *(f"1{blank}234" for blank in "\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\N{THIN SPACE}"),
    *("NA", "1.5.2", "1#5", "0.5#c", "1/2", "abc", "-"),
    *("1.#IND", "-1.#IND00", "1.#INF", "-1.#INF", "1.#QNAN", "1.#J", "nan", "-inf", "1e999"),
)
"""Texts that every reader refuses, or reads as a missing value."""
NUMBERS = {
    "0.5": 0.5, "+.5": 0.5, "5e-1": 0.5, "5E-001": 0.5, "0.05D+1": 0.5, "5.d-01": 0.5, "5D-1": 0.5,
    "\N{MINUS SIGN}0.5": -0.5, "5e\N{MINUS SIGN}1": 0.5, "\N{EN DASH}0.5": -0.5,
}  # fmt: skip
"""Texts with only one possible meaning as a number, which a reader reads with this value or refuses."""


def write(folder: Path, reader: TextReader, word: str) -> Path:
    file = folder / reader.name
    file.parent.mkdir(exist_ok=True, parents=True)
    for name, content in (reader.beside or {}).items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    quoted = '"{}"'.format(word.replace('"', '""')) if reader.cells else word
    file.write_bytes(reader.content.format(quoted).encode())
    return file


@pytest.mark.parametrize("name", READERS)
def test_numbers_are_read_right_or_refused_by_line(tmp_path: Path, name: str) -> None:
    reader = READERS[name]
    for word, number in [*NUMBERS.items(), *((word, None) for word in NOT_NUMBERS)]:
        if number is not None and number < 0 and not reader.signed:
            continue
        file = write(tmp_path, reader, word)
        try:
            found = reader.read(file)
        except DataError as error:
            said = str(error)
            assert number is None, f"{name}, {word}: {said}"
            assert str(tmp_path) in said, f"{name}, {word}: {said}"
            assert f"line {reader.line}" in said.lower() or "finite" in said, f"{name}, {word}: {said}"
            assert any(
                remedy in said
                for remedy in ("write", "Write", "Mend", "Correct", "Save", "Wanted:", "Restore", "Copy")
            ), said
        else:
            assert number is not None, f"{name}: {word!r} is read as {found}"
            assert found == pytest.approx(number, rel=1e-6), f"{name}, {word}"


@pytest.mark.parametrize("name", READERS)
def test_encodings_and_ends_of_lines_change_no_number(tmp_path: Path, name: str) -> None:
    reader = READERS[name]
    file = write(tmp_path, reader, "0.5")
    whole = reader.read(file)
    assert whole == pytest.approx(0.5, rel=1e-6)
    plain = file.read_bytes()
    for changed in (
        b"\xef\xbb\xbf" + plain,
        plain.replace(b"\n", b"\r\n"),
        plain.replace(b"\n", b"\r"),
        b"\xef\xbb\xbf" + plain.replace(b"\n", b"\r\n"),
        plain.rstrip(b"\n"),
        plain + b"\n\n",
    ):
        file.write_bytes(changed)
        assert reader.read(file) == whole, changed[:60]
    for encoding in ("utf-16", "utf-16-le", "utf-16-be", "utf-32"):
        file.write_bytes(plain.decode().encode(encoding))
        with pytest.raises(
            DataError, match=r"UTF-(16|32).*UTF-8 is required. Save the file as UTF-8"
        ) as raised:
            reader.read(file)
        assert str(tmp_path) in str(raised.value)


HEADED = {
    **dict.fromkeys(("tables", "images with angles", "flights", "points of the plane"), ","),
    **dict.fromkeys(("tables, semicolons", "XYZ, semicolons"), ";"),
}
"""Readers with names of columns in the first line, and what separates them."""


@pytest.mark.parametrize("name", HEADED)
def test_headers_are_read_or_refused_by_name(tmp_path: Path, name: str) -> None:
    reader, sign = READERS[name], HEADED[name]
    file = write(tmp_path, reader, "0.5")
    first, _, rest = file.read_text(encoding="utf-8").partition("\n")
    names = first.split(sign)
    for header in (
        sign.join(f'"{one}"' for one in names),
        "\ufeff" + sign.join(f'"{one}"' for one in names),
        sign.join(f" {one}\N{ZERO WIDTH SPACE}" for one in names),
        sign.join(f"{one}\N{NO-BREAK SPACE}" for one in names),
    ):
        file.write_text(f"{header}\n{rest}", encoding="utf-8")
        assert reader.read(file) == pytest.approx(0.5, rel=1e-6), header
    twice = [*names, names[-1]]
    longer = "\n".join(f"{line}{sign}1" for line in rest.splitlines())
    file.write_text(f"{sign.join(twice)}\n{longer}\n", encoding="utf-8")
    with pytest.raises(DataError, match=rf"{file.name}.*the column '{names[-1]}' is named twice"):
        reader.read(file)
    if reader.cells:  # others have no names, and then a number in the first line is one
        file.write_text(rest, encoding="utf-8")
        with pytest.raises(DataError, match=str(file)):
            reader.read(file)


INDEX = ("", "Unnamed: 0", "index", "id", "row_number")


@pytest.mark.parametrize("name", INDEX)
@pytest.mark.parametrize("start", [0, 1, 100])
def test_row_numbers_are_no_inputs_and_no_angles(tmp_path: Path, name: str, start: int) -> None:
    """Row numbers may also be shuffled, as in a table that was sampled from another one."""
    order = np.random.default_rng(0).permutation(30) if start == 100 else np.arange(30)
    file = tmp_path / "one.csv"
    lines = [f"{name},a,file,y"] + [
        f"{start + order[row]},{row * row % 7},{row}.png,{row % 2}" for row in range(30)
    ]
    file.write_text("\n".join(lines), encoding="utf-8")
    columns = read_columns(file, LabelledWriting())
    chosen = numeric_columns(columns, ("file", "y"), "data.columns")
    assert chosen.names == ("a",)
    assert any("row numbers" in said for said in describe_choice(chosen))
    table = read_table(file, None, "degrees")
    assert table.columns == ("a", "y")
    assert any("row numbers" in said for said in table.remarks)
    if name:  # who names it means it
        assert read_table(file, [name], "degrees").columns == (name,)


def _choose_columns(tmp_path: Path, lines: list[str]) -> ColumnChoice:
    file = tmp_path / "one.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    return numeric_columns(read_columns(file, LabelledWriting()), ("y",), "data.columns")


@pytest.mark.parametrize("name", INDEX[1:])
def test_copied_rows_hide_no_row_numbers(tmp_path: Path, name: str) -> None:
    rows = [f"{100000 + row},{row * row % 7},{row % 2}" for row in range(30)]
    chosen = _choose_columns(tmp_path, [f"{name},a,y", *rows, rows[4], rows[4]])
    assert chosen.names == ("a",)


@pytest.mark.parametrize("name", INDEX)
def test_repeated_numbers_are_left_out_only_where_the_name_leaves_no_doubt(tmp_path: Path, name: str) -> None:
    rows = [f"{row % 20},{row * row % 7},{row % 2}" for row in range(60)]
    chosen = _choose_columns(tmp_path, [f"{name or 'Unnamed: 7'},a,y", *rows])
    expected = ("index", "a") if name == "index" else ("row_number", "a") if name == "row_number" else ("a",)
    assert chosen.names == expected


NUMBERS_OF_THINGS = ("customer_id", "PassengerId", "Order No.", "Nr", "Kundennummer", "lfd. Nr.", "caseID")


@pytest.mark.parametrize("name", [*NUMBERS_OF_THINGS, "acid", "grid", "milli", "nrooms", "area"])
def test_a_column_that_may_number_things_is_reported(tmp_path: Path, name: str) -> None:
    rows = [f"{997 * row % 1009},{row * row % 7},{row % 2}" for row in range(60)]
    chosen = _choose_columns(tmp_path, [f"{name},a,y", *rows, rows[3]])
    assert chosen.names == (name, "a")
    assert ("has another whole number in each row" in chosen.odd.get(name, "")) == (name in NUMBERS_OF_THINGS)


@pytest.mark.parametrize("start", [0, 1, 100000])
def test_a_column_that_counts_from_any_number_is_reported(tmp_path: Path, start: int) -> None:
    rows = [f"{start + row},{row * row % 7},{row % 2}" for row in range(60)]
    chosen = _choose_columns(tmp_path, ["case,a,y", *rows])
    assert f"counts the rows from {start} to {start + 59}" in chosen.odd["case"]


def test_a_column_that_counts_the_rows_under_another_name_is_said(tmp_path: Path) -> None:
    file = tmp_path / "one.csv"
    file.write_text("azimuth,file\n" + "".join(f"{row},{row}.png\n" for row in range(30)), encoding="utf-8")
    table = read_table(file, None, "degrees")
    assert table.columns == ("azimuth",)
    assert "'azimuth' counts the rows from 0 to 29; set data.angle_columns to leave it out" in table.remarks


WRITTEN = {
    "1,5": {"decimal": "comma"},
    "1.234,5": {"decimal": "comma", "thousands": "point"},
    "1,234": {"thousands": "comma"},
    "1 234": {"thousands": "space"},
    "1\N{NARROW NO-BREAK SPACE}234": {"thousands": "space"},
    "1'234": {"thousands": "apostrophe"},
    "5%": {"units": ["%"]},
    "$5": {"units": ["$"]},
    "$1,234.5": {"units": ["$"], "thousands": "comma"},
    "5 km/h": {"units": ["km/h"]},
    "1.234,5 €": {"units": ["€"], "decimal": "comma", "thousands": "point"},
    "12°": {"units": ["°"]},
    "12.5 °C": {"units": ["°C"]},
    "3 mm²": {"units": ["mm²"]},
}
VALUES = (1.5, 1234.5, 1234.0, 1234.0, 1234.0, 1234.0, 5.0, 5.0, 1234.5, 5.0, 1234.5, 12.0, 12.5, 3.0)


@pytest.mark.parametrize("sign", ["", "-", "+", "\N{MINUS SIGN}"])
@pytest.mark.parametrize("word", WRITTEN)
def test_a_column_written_otherwise_is_refused_and_read_by_the_setting_that_is_told(
    tmp_path: Path, word: str, sign: str
) -> None:
    file = tmp_path / "one.csv"
    file.write_text(
        "file;a;b\n" + "".join(f"{row}.png;{sign}{word};{row / 8}\n" for row in range(30)), encoding="utf-8"
    )
    wanted = VALUES[list(WRITTEN).index(word)] * (-1 if sign in ("-", "\N{MINUS SIGN}") else 1)
    plain = read_columns(file, Writing())
    with pytest.raises(DataError, match=r"one\.csv line 2, column 'a'") as raised:
        numeric_columns(plain, ("file",), "data.columns")
    for key, value in WRITTEN[word].items():
        assert f"data.{key}=" in str(raised.value)
        assert (value if isinstance(value, str) else f'["{value[0]}"]') in str(raised.value)
    with pytest.raises(DataError, match=r"line 2, column 'a'"):
        numbers(plain, "a", missing="")
    told_of = read_columns(file, Writing(**WRITTEN[word]))
    assert numeric_columns(told_of, ("file",), "data.columns").names == ("a", "b")
    np.testing.assert_array_equal(numbers(told_of, "a", missing=""), np.full(30, wanted))
    np.testing.assert_array_equal(numbers(told_of, "b", missing=""), np.arange(30) / 8)


def test_a_table_in_another_encoding_is_refused_and_read_by_the_setting_that_is_told(tmp_path: Path) -> None:
    file, words = tmp_path / "one.csv", "Größe;y\nStraße;5 €\nCafé;7 €\n"
    file.write_bytes(words.encode("cp1252"))
    with pytest.raises(
        DataError, match=r"one\.csv: line 1 contains the byte 0xf6.* data\.encoding=windows-1252 if"
    ):
        read_columns(file, Writing())
    with pytest.raises(DataError, match=r"which Excel calls CSV UTF-8\.$"):
        read_columns(file)
    other = Writing(encoding="windows-1252", units=["€"])
    assert read_columns(file, other).cells == {"Größe": ["Straße", "Café"], "y": ["5 €", "7 €"]}
    file.write_bytes(b"\xef\xbb\xbf" + words.encode())
    assert read_columns(file, other).cells["Größe"] == ["Straße", "Café"]
    file.write_bytes(b"a,b\n1,2\n\x81,3\n")
    with pytest.raises(
        DataError, match=r"line 3 contains the byte 0x81, which is not in Windows-1252\. Save"
    ):
        read_columns(file, other)


WORDS = (
    "0.png",
    "img001.png",
    "S001",
    "A1",
    "12:30",
    "2024-01-01",
    "1/2",
    "v1.2.3",
    "192.168.0.1",
    "north",
    "-",
    "#5",
)


@pytest.mark.parametrize("word", WORDS)
def test_words_with_figures_are_left_out_and_not_taken_for_numbers(tmp_path: Path, word: str) -> None:
    file = tmp_path / "one.csv"
    file.write_text("a;b\n" + "".join(f"{word};{row / 8}\n" for row in range(30)), encoding="utf-8")
    chosen = numeric_columns(read_columns(file, Writing()), (), "data.columns")
    assert chosen.names == ("b",)
    assert chosen.left_out["a"].partition(";")[0] in ("words", "dates", "empty")


LONG = (
    "1,2 " + " " * 300_000 + "x 1,3", "1" * 300_000, "1.#" * 100_000, "1//2" * 100_000, '"' * 300_001, "1,23" * 100_000,
    "1\N{NO-BREAK SPACE}123" * 50_000, "v 1 2 3 \\\n" * 50_000,
)  # fmt: skip


@pytest.mark.parametrize("number", range(len(LONG)))
def test_long_texts_take_linear_time(tmp_path: Path, number: int) -> None:
    """A regular expression with quadratic time would take minutes."""
    start = time.process_time()
    for name, read in (("one.xyz", vertex), ("one.obj", vertex), ("one.off", vertex), ("one.csv", cell)):
        (tmp_path / name).write_text(f"a;b\n{LONG[number]}", encoding="utf-8")
        with pytest.raises(DataError):
            read(tmp_path / name)
    text.suggest_number(LONG[number])
    assert time.process_time() - start < 10
