"""Tests of the comparison of class names: names that look the same are refused, and similar ones are reported."""

import unicodedata

import pytest

from framework.datasets.class_names import compare_classes
from framework.errors import DataError
from framework.storage.text import INVISIBLE

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
