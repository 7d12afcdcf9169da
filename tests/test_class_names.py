"""Tests of class names and shares: names that look the same are refused, and what may mislead is reported."""

import shutil
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from framework.datasets.class_names import compare_classes, describe_dominant
from framework.errors import DataError
from framework.storage.text import INVISIBLE
from framework.testing.contract import contract
from framework.testing.data_samples import prepared
from framework.testing.rows import DataRow

SAME = (
    unicodedata.normalize("NFD", "café one"),
    "café  one",
    "café\N{NO-BREAK SPACE}one",
    *(f"caf{letter}é one" for letter in INVISIBLE),
)
"""Texts that look like "café one"."""


@pytest.mark.parametrize("name", SAME, ids=ascii)
def test_names_that_look_the_same_are_refused_with_their_characters(name: str) -> None:
    with pytest.raises(
        DataError, match=r"^table\.csv: The classes .* look the same \('café one'\)"
    ) as raised:
        compare_classes(["tea", name, "café one"], "table.csv")
    assert ascii(name) in str(raised.value)


@pytest.mark.parametrize("name", ["1.0", "01", "+1", "1e0"])
def test_the_same_number_in_different_notation_is_refused(name: str) -> None:
    with pytest.raises(DataError, match=r"^table\.csv: The classes .* are the same number"):
        compare_classes(["1", "2", name, "nan", "inf"], "table.csv")


def test_names_that_differ_in_capital_letters_are_reported() -> None:
    (remark,) = compare_classes(["no", "yes", "No", "no"], "table.csv")
    assert remark.startswith("the classes 'No' and 'no' differ only in capital letters")
    assert compare_classes(["no", "yes", "m2", "m²"], "table.csv") == ()


@pytest.mark.parametrize(
    ("counts", "is_reported"),
    [((27, 3), True), ((89, 11), False), ((2, 95, 3), True), ((9, 0), False), ((), False)],
)
def test_a_class_of_nearly_all_test_samples_is_reported(counts: tuple[int, ...], is_reported: bool) -> None:
    remarks = describe_dominant(("a", "b", "c"), np.repeat(np.arange(len(counts)), counts))
    assert len(remarks) == is_reported
    if is_reported:
        most = max(counts)
        assert (
            f"{most} of {sum(counts)} test samples have the class '{'abc'[counts.index(most)]}'" in remarks[0]
        )
        assert f"has the accuracy {most / sum(counts):.4g}." in remarks[0]


@pytest.mark.parametrize("name", ["image_folder", "turned_images", "point_cloud_folder", "tabular"])
def test_data_sets_of_classes_report_a_class_of_nearly_all_test_samples(name: str, tmp_path: Path) -> None:
    """Repeat the files or rows of one class; images that are turned have no classes to report."""
    if name == "tabular":
        file = tmp_path / "rows.csv"
        rows = [f"{row},{'no' if row % 20 else 'yes'}" for row in range(200)]
        file.write_text("\n".join(["x,y", *rows]), encoding="utf-8")
        settings = {"path": str(file), "target": "y", "test": 0.5}
    else:
        (row, *_) = contract("data", name).rows
        assert isinstance(row, DataRow) and row.write is not None
        settings = {"root": row.write(tmp_path)["root"], "validation": 0.1, "test": 0.1}
        assert not any("always" in x for x in prepared(name, **settings).remarks)
        first = min(path for path in tmp_path.iterdir() if path.is_dir())
        for file in [*first.iterdir()]:
            for number in range(30):
                shutil.copy(file, first / f"{file.stem}_{number}{file.suffix}")
    remarks = prepared(name, **settings).remarks
    assert any("model that always predicts it" in x for x in remarks) == (name != "turned_images")


@pytest.mark.parametrize("name", ["image_folder", "turned_images", "point_cloud_folder"])
def test_a_folder_of_classes_is_compared_as_a_table_is(name: str, tmp_path: Path) -> None:
    """Give the files of a class to two classes, whose names differ in capital letters or in a blank."""
    (row, *_) = contract("data", name).rows
    assert isinstance(row, DataRow) and row.write is not None
    settings = {"root": row.write(tmp_path)["root"], "validation": 0.1, "test": 0.1}
    first = min(path for path in tmp_path.iterdir() if path.is_dir())
    assert not any("capital letters" in x for x in prepared(name, **settings).remarks)
    shutil.copytree(first, tmp_path / first.name.upper())
    remarks = prepared(name, **settings).remarks
    assert any(
        f"{first.name.upper()}' and '{first.name}' differ only in capital letters" in x for x in remarks
    )
    (tmp_path / first.name.upper()).rename(tmp_path / f"{first.name} ")
    with pytest.raises(DataError, match=f"look the same .'{first.name}'"):
        prepared(name, **settings)
