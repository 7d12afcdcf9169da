"""Tests of the CAVIAR label file, a MATLAB file: what is read, refused and written."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from framework.errors import DataError
from plugins.data.head_pose.caviar_labels import LABELS, Label, read_labels, write_labels
from plugins.data.head_pose.roots import (
    CAVIAR_FIELDS,
    caviar_row,
    prepare_data,
    save_caviar,
    struct_array,
    write_caviar,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_caviar(tmp_path / "CAVIARShoppingCenterFullOccl")


def test_fields_are_read_by_their_order(root: Path) -> None:
    """Check fields of other names, because the names in the published file are not known."""
    names = ("or", "xc", "yc", "s", "im")
    save_caviar(
        root, struct_array([caviar_row(0)], names), struct_array([caviar_row(n) for n in (20, 21, 22)], names)
    )
    labels = read_labels(root / LABELS)
    assert labels["train"] == [Label("head_0_x", -180.0)]  # a single struct is stored without the array
    assert [label.name for label in labels["test"]] == ["head_20_x", "head_21_x", "head_22_x"]


@pytest.mark.parametrize(
    "bad",
    [
        [[], 1, 1, 1, "a"],
        [1, 1, 1, 1, "../a"],
        [1, 1, 1, 1, "/a"],
        ["left", 1, 1, 1, "a"],
        [[1.0, 2.0], 1, 1, 1, "a"],
        [1j, 1, 1, 1, "a"],
        [1.0, 1, 1, 1, ""],
        [1.0, 1, 1, 1, 7],
    ],
    ids=["empty", "above", "absolute", "text", "two", "complex", "no name", "number for a name"],
)
def test_element_that_is_no_label_is_named(root: Path, bad: list[Any]) -> None:
    save_caviar(root, struct_array([caviar_row(0), bad]), struct_array([caviar_row(20)]))
    with pytest.raises(
        DataError, match=r"or_label\.mat: (or_label_train\(2\) holds|cannot be read as a MATLAB)"
    ):
        prepare_data("caviar", root)


def test_other_contents_are_refused(root: Path) -> None:
    save_caviar(root, struct_array([caviar_row(0)[:4]], CAVIAR_FIELDS[:4]), struct_array([caviar_row(20)]))
    with pytest.raises(
        DataError, match=r"or_label_train\(1\) holds .* expected a struct of gaze, x, y, size, name"
    ):
        prepare_data("caviar", root)
    scipy.io.savemat(
        root / LABELS, {"or_label_train": np.eye(2), "or_label_test": struct_array([caviar_row(20)])}
    )
    with pytest.raises(DataError, match=r"or_label_train\(1\) holds"):
        prepare_data("caviar", root)
    scipy.io.savemat(root / LABELS, {"or_label_train": struct_array([caviar_row(0)])})
    with pytest.raises(DataError, match=r"The file holds no or_label_test\. Copy"):
        prepare_data("caviar", root)


@pytest.mark.parametrize("gaze", [math.nan, -math.inf])
def test_gaze_that_is_not_finite_is_never_skipped(root: Path, gaze: float) -> None:
    rows = [caviar_row(n) for n in range(20, 31)]
    rows[3][0] = gaze
    save_caviar(root, struct_array([caviar_row(0)]), struct_array(rows))
    with pytest.raises(DataError, match=rf"1 images have an angle .*\n.*head_23_x\.jpg: {gaze}"):
        prepare_data("caviar", root, skip_unreadable=True)


def test_labels_are_written_as_they_are_read(tmp_path: Path) -> None:
    labels = {"train": [Label("a_1", 12.25), Label("b", -370.5)], "test": [Label("c", 0.0)]}
    write_labels(tmp_path / LABELS, labels, 50)
    assert read_labels(tmp_path / LABELS) == labels
