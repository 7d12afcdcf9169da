"""MATLAB 5 files (framework.datasets.matlab): whole ones are read, damaged ones named; none ends the process."""

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from framework.datasets.matlab import check, read_variables
from framework.errors import DataError


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
    assert (first.angle, first.name, second.name) == (12.5, "first", "second")
    assert np.array_equal(second.angle, np.eye(3))


@pytest.mark.filterwarnings("ignore")  # SciPy warns of some damage beside
@pytest.mark.parametrize("compressed", [False, True])
def test_damage_is_named_or_harmless(tmp_path: Path, compressed: bool) -> None:
    whole, random, refused = saved(compressed), np.random.default_rng(0), 0
    file = tmp_path / "one.mat"
    for _ in range(200):
        damaged = np.frombuffer(whole, np.uint8).copy()
        places = random.integers(0, len(whole), 3)
        damaged[places] = random.integers(0, 256, 3)
        file.write_bytes(damaged.tobytes())
        try:
            read_variables(file, ["labels"], "its source")
        except DataError:
            refused += 1
    assert refused > 100
    for length in range(0, len(whole), 61):
        with pytest.raises(Exception):  # noqa: B017  (nearly any)
            check(whole[: length or 1])


def test_other_versions_and_complex_numbers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a MATLAB 7\.3 file; wanted version 5"):
        check(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400))
    with pytest.raises(ValueError, match="no header of a MATLAB 5 file"):
        check(b"text" * 99)
    scipy.io.savemat(tmp_path / "complex.mat", {"labels": 1j})
    with pytest.raises(DataError, match=r"complex\.mat: cannot be read .*complex numbers.* from the attic"):
        read_variables(tmp_path / "complex.mat", ["labels"], "the attic")


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_files_that_matlab_wrote_pass() -> None:
    files = sorted(Path(os.environ["REAL_DATA_ROOT"]).rglob("*.mat"))
    assert len(files) >= 5
    for file in files:
        check(file.read_bytes())
