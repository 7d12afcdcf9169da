"""File names with any bytes, in training, encoding, prediction, figures, tables and the store."""

import csv
import os
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from framework.configuration.schema import build, resolve
from framework.errors import DataError, escape_undecodable, quote, shorten
from framework.figures.style import save_figure
from framework.geometry import meshes
from framework.modes.encode import Collection, Files, collect_files, describe
from framework.reports import table
from framework.storage.names import as_bytes, path_of, spell_name
from framework.sweeps import jobs
from tests.conftest import Framework

NAMES = [
    b"caf\xe9", b"\xff\xfe", b"\x80", b"new\nline", b"bell\x07", b"tab\t", b"quo\"te'", b"back\\slash", b"caf\\xe9",
    b"\\\\xe9", "日本 ü".encode(), b"a,b;c", b"per%20cent", b"#1", b"{x}=[1]", b"$HOME", b"q?", b"cr\r",
    b"\xed\xa0\x80",
]  # fmt: skip
"""File names without their suffix."""
BYTES = st.binary(min_size=1, max_size=20).filter(lambda name: not {0, 47} & set(name))


@given(BYTES)
def test_a_spelling_is_a_line_of_text_from_which_the_name_is_found(name: bytes) -> None:
    spelling = spell_name(os.fsdecode(name))
    assert len(spelling.encode().splitlines()) == 1
    assert os.fsencode(path_of(spelling)) == os.fsencode(Path(os.fsdecode(name)))
    if spelling == os.fsdecode(name):
        assert escape_undecodable(spelling) == spelling


@given(st.sets(BYTES, min_size=2, max_size=5))
def test_spellings_and_hashed_names_tell_files_apart(names: set[bytes]) -> None:
    texts = [os.fsdecode(name) for name in names]
    assert len({spell_name(text) for text in texts}) == len({as_bytes(text) for text in texts}) == len(names)


def test_a_plain_name_is_spelled_as_it_is() -> None:
    for name in ("a.png", "ä b/c.png", "back\\slash", "日本"):
        assert spell_name(name) == name
    assert spell_name(os.fsdecode(b"caf\xe9.png")) == r"caf\xe9.png"
    assert as_bytes("ä") == "ä".encode(), "seeds of files are those of earlier versions"


@pytest.mark.filterwarnings("ignore:Glyph")  # the font has no Japanese
@pytest.mark.parametrize("name", NAMES)
def test_what_is_made_of_a_name_takes_any(name: bytes, tmp_path: Path) -> None:
    text = os.fsdecode(name)
    assert 0 <= meshes.stream(0, text).random() < 1
    assert jobs.short_hash(text, "a") != jobs.short_hash("a", text)
    for message in (str(DataError(f"{text}: no")), shorten(text), quote(text)):
        message.encode()
    figure = Figure()
    figure.suptitle(text.replace("$", r"\$"))
    save_figure(figure, tmp_path / "figure", "svg")
    table.write_csv([{"class": text, "nll": 1.0}], None, tmp_path / "table.csv")
    with (tmp_path / "table.csv").open(encoding="utf-8", newline="") as stream:
        assert list(csv.reader(stream))[1][0] == escape_undecodable(text).replace("\r", r"\x0d")


@pytest.fixture
def clouds(tmp_path: Path) -> Path:
    """Write two classes of clouds, one of them in a folder whose name is not UTF-8."""
    draws = np.random.default_rng(0)
    for number, name in enumerate(NAMES):
        for kind in (b"box", b"stra\xdfe"):
            file = tmp_path / "clouds" / os.fsdecode(kind) / os.fsdecode(name + b".xyz")
            file.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(file, draws.normal(number, 1, (8, 3)))
    return tmp_path / "clouds"


def test_encoded_files_are_found_by_the_names_beside_their_features(clouds: Path, tmp_path: Path) -> None:
    names = [file.relative_to(clouds).as_posix() for file in collect_files(clouds)]
    data = build("data", resolve("data", "point_cloud_folder"))
    collection = Collection(Files(clouds, names, 100, data), tmp_path / "features")
    describe(collection, {"data": {}, "encoder": []})
    lines = (tmp_path / "features" / "files.txt").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2 * len(NAMES)
    assert all((clouds / path_of(line)).is_file() for line in lines)


def test_a_run_trains_and_predicts_and_is_stored_whatever_its_files_are_called(
    framework: Framework, clouds: Path
) -> None:
    trained = framework(
        "data=point_cloud_folder", f"data.root={clouds}", "data.points=8", "encoder=[bps,mlp]",
        "density_head=categorical", "metric=[accuracy]", "trainer.max_epochs=1", "threads=1", "pictures=png",
    )  # fmt: skip
    assert trained.code == 0, trained.out
    (database,) = clouds.parent.rglob("mlflow.db")
    with sqlite3.connect(database) as store:
        assert store.execute("SELECT status FROM runs").fetchall() == [("FINISHED",)]
    predicted = framework(
        "mode=predict", f"checkpoint={trained.folder}", f"mode.files={clouds / 'box'}",
        "logger=none", folder="predicted",
    )  # fmt: skip
    assert predicted.code == 0, predicted.out
    with (predicted.folder / "predictions.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {path_of(row["sample"]) for row in rows} == set((clouds / "box").iterdir())
    assert {row["class"] for row in rows} <= {"box", r"stra\xdfe"}
