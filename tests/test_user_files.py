"""Tests of the choice of files that are read from a user's folder."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from framework.runs.user_files import select_files

SHAPES = {"moons": (3, 2), "tabular": (3, 2), "table_tennis": (30, 4)}
END = [
    (main, mask) for main in ("nii", "nii.gz", "NII") for mask in ("mask.nii", "mask.nii.gz", "MASK.nii.gz")
]


@pytest.mark.parametrize("unreadable", ["skip", "error"])
@pytest.mark.parametrize("main, mask", END)
def test_what_belongs_to_others_is_no_file_to_predict_for(
    tmp_path: Path, unreadable: str, main: str, mask: str
) -> None:
    """A mask and a list of offsets are read with their volume, and are neither samples nor damaged."""
    nibabel = pytest.importorskip("nibabel")
    spectra = np.random.default_rng(0).uniform(0.3, 0.9, (3, 4, 1, 13)).astype(np.float32)
    for name in ("one", "two"):
        for end, array in ((main, spectra), (mask, spectra[..., 0])):
            file = tmp_path / f"{name}.{end.replace('NII', 'nii')}"
            nibabel.save(nibabel.Nifti1Image(array, np.eye(4)), file)
            file.rename(tmp_path / f"{name}.{end}")
        (tmp_path / f"{name}.offsets.txt").write_text("\n".join(map(str, range(-6, 7))))
    config = resolve("data", {"name": "cest", "unreadable": unreadable, "offsets": list(range(-6, 7))})
    said = io.StringIO()
    files, bad = select_files(
        build("data", config), sorted(tmp_path.iterdir()), config, Console(file=said, width=500)
    )
    assert [file.name for file in files] == [f"one.{main}", f"two.{main}"]
    assert not bad
    assert said.getvalue().startswith("4 files belong to other files and are read with them: one.")
    assert len(said.getvalue().splitlines()) == 1


@pytest.mark.parametrize("name, given", [(n, np.ones(s) + 0.1j) for n, s in SHAPES.items()])
def test_complex_inputs_are_refused(name: str, given: np.ndarray) -> None:
    data = build("data", resolve("data", name))
    if name == "tabular":
        data.load_state_dict({"columns": ["a", "b"], "largest": [1, 1], "mean": [0, 0], "deviation": [1, 1]})
    elif name == "moons":
        data.input_shape = given.shape[1:]
    with pytest.raises(DataError, match="complex numbers"):
        data.inputs(given)
