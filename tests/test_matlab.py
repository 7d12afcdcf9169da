"""Tests of the reader of MATLAB 5 files: undamaged files are read, and damaged ones are refused by name."""

import io
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from scipy.io.matlab import mat_struct

from framework.datasets.matlab import parse_variables, read_variables
from framework.errors import DataError
from framework.testing.sample_files import damaged_copies


def saved(compressed: bool) -> bytes:
    labels = np.empty((1, 2), dtype=[("angle", object), ("name", object)])
    labels[0, 0], labels[0, 1] = (12.5, "first"), (np.eye(3), "second")
    stream = io.BytesIO()
    scipy.io.savemat(stream, {"labels": labels, "count": np.uint8(2)}, do_compression=compressed)
    return stream.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
def test_named_variables_are_read_squeezed(tmp_path: Path, compressed: bool) -> None:
    (tmp_path / "one.mat").write_bytes(saved(compressed))
    content: dict[str, Any] = read_variables(tmp_path / "one.mat", ["labels"], "its source")
    assert "count" not in content
    first, second = content["labels"]
    assert (first["angle"], first["name"], second["name"]) == (12.5, "first", "second")
    assert np.array_equal(second["angle"], np.eye(3))


@pytest.mark.parametrize("compressed", [False, True])
def test_damage_is_named_or_harmless(tmp_path: Path, compressed: bool) -> None:
    whole, refused = saved(compressed), 0
    file = tmp_path / "one.mat"
    for damaged in damaged_copies(whole, 200):
        file.write_bytes(damaged)
        try:
            read_variables(file, ["labels"])
        except DataError as error:
            assert str(file) in str(error)
            refused += 1
    assert refused > 100
    for length in range(0, len(whole), 61):
        with pytest.raises((ValueError, zlib.error)):
            parse_variables(whole[: length or 1])


def test_other_versions_and_complex_numbers_are_refused(tmp_path: Path) -> None:
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400))
    with pytest.raises(DataError, match=r"new\.mat: got a MATLAB 7\.3 file, but version 5"):
        read_variables(tmp_path / "new.mat")
    with pytest.raises(ValueError, match="does not begin with the header of a MATLAB 5 file"):
        parse_variables(b"text" * 99)
    scipy.io.savemat(tmp_path / "complex.mat", {"labels": 1j})
    with pytest.raises(DataError, match=r"complex\.mat: .*complex numbers"):
        read_variables(tmp_path / "complex.mat", ["labels"])


def same(found: Any, wanted: Any) -> None:
    """Compare our variables with SciPy's to the last bit, with structs as dicts and empty texts as ''."""
    if isinstance(wanted, mat_struct):
        assert list(found) == wanted._fieldnames
        for name in found:
            same(found[name], getattr(wanted, name))
    elif isinstance(wanted, np.ndarray) and wanted.dtype == object and wanted.size:
        assert found.shape == wanted.shape
        for one, other in zip(found.ravel(), wanted.ravel(), strict=True):
            same(one, other)
    elif isinstance(wanted, np.ndarray) and wanted.dtype.kind == "U" and not wanted.size:
        assert found == ""
    elif isinstance(wanted, np.ndarray) and wanted.size:
        assert (found.dtype, found.shape) == (wanted.dtype.newbyteorder("="), wanted.shape)
        assert found.tobytes() == wanted.astype(found.dtype).tobytes()
    elif isinstance(wanted, np.ndarray):
        assert found.size == 0
    else:
        assert (type(found), found) == (type(wanted), wanted)


def compared(content: bytes) -> None:
    wanted = scipy.io.loadmat(io.BytesIO(content), squeeze_me=True, struct_as_record=False)
    found = parse_variables(content)
    names = [name for name in wanted if not name.startswith("__")]
    assert list(found) == names
    for name in names:
        same(found[name], wanted[name])


@pytest.mark.parametrize("compressed", [False, True])
def test_everything_that_labels_may_hold_is_read_as_scipy_reads_it(compressed: bool) -> None:
    random = np.random.default_rng(0)
    kinds = [np.dtype(kind) for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")]
    sides = [(1, 1), (3, 1), (1, 4), (2, 3), (2, 1, 3), (0, 0), (4, 0)]
    numbers = {
        f"{kind}_{number}": random.integers(0, 99, shape).astype(kind)
        for kind in kinds
        for number, shape in enumerate(sides)
    }
    cells = np.empty((2, 2), dtype=object)
    cells.flat = [1.5, "text", np.arange(3), {"a": 1, "b": {"c": "deep"}}]
    structs = np.empty((2, 3), dtype=[("first", object), ("second", object)])
    for one in structs.flat:
        one["first"], one["second"] = "ä ρ", random.integers(0, 99, (2, 2))
    more = {
        "cells": cells, "structs": structs, "one": {"field": [1, 2]}, "empty": np.empty((0, 0), object), "yes": True,
        "text": "häuser  ", "no_text": "", "rows": np.array(["ab", "cd", "e "]), "wide": "𝒳 𝒴",
        "a_name_of_thirty_one_letters_xx": 1,
    }  # fmt: skip
    stream = io.BytesIO()
    scipy.io.savemat(stream, {**numbers, **more}, do_compression=compressed)
    compared(stream.getvalue())


def test_what_is_no_label_is_none_and_what_is_not_asked_for_may_be_anything() -> None:
    stream = io.BytesIO()
    scipy.io.savemat(stream, {"sparse": scipy.sparse.eye(3), "complex": 1j, "gaze": 7})
    assert parse_variables(stream.getvalue(), ["gaze", "sparse"]) == {"gaze": 7, "sparse": None}


def bomb(size: int) -> bytes:
    """Return a compressed variable of many zeros, with a thousandth of their size."""
    stream = io.BytesIO()
    scipy.io.savemat(stream, {"labels": np.zeros(size, np.uint8)}, do_compression=True)
    return stream.getvalue()


def test_what_unfolds_to_far_more_than_the_file_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.storage.reading.SMALL", 2**20)
    assert not parse_variables(bomb(2**20 - 200))["labels"].any()
    with pytest.raises(ValueError, match="decompress to more than"):
        parse_variables(bomb(2**22))


def test_sides_that_the_data_do_not_have_are_refused_before_anything_is_allocated() -> None:
    stream = io.BytesIO()
    cells = np.empty((1, 3), dtype=object)
    cells[:] = [[1, 2, 3]]
    content = {"numbers": np.zeros((7, 5)), "cells": cells, "structs": np.zeros((7, 5), [("a", float)])}
    scipy.io.savemat(stream, content)
    for side in (7, 5, 3):
        for other in (2**31 - 1, 2**32 - 1, 10**8, side + 1):
            old, new = side.to_bytes(4, "little"), other.to_bytes(4, "little")
            whole = stream.getvalue()
            places = [place for place in range(0, len(whole), 4) if whole[place : place + 4] == old]
            refused = 0
            for place in places:
                try:
                    parse_variables(whole[:place] + new + whole[place + 4 :])
                except ValueError:
                    refused += 1
            assert refused


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_files_that_matlab_wrote_are_read_as_scipy_reads_them() -> None:
    files = sorted(Path(os.environ["REAL_DATA_ROOT"]).rglob("*.mat"))
    assert len(files) >= 5
    for file in files:
        compared(file.read_bytes())
