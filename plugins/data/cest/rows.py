"""Contract-test cases: a small slice, generated, or read from a NumPy or MATLAB file."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.io import savemat

from framework.spectra.offsets import OFFSETS
from framework.testing.rows import DAMAGES, DataRow
from plugins.data.cest.generator import write_slice


def slice_of(folder: Path, data_seed: int = 0) -> dict[str, np.ndarray]:
    """Write a small synthetic slice and return its arrays."""
    write_slice(folder, side=32, noise=0.01, shift=0.05, data_seed=data_seed)
    with np.load(folder / "brain.npz") as content:
        return dict(content)


def as_numpy(folder: Path) -> Mapping[str, str]:
    """Write a slice as `.npz`, and return the settings that name the file."""
    slice_of(folder)
    return {"root": str(folder / "brain.npz")}


def as_matlab(folder: Path) -> Mapping[str, str]:
    """Write a slice as `.mat`, and return the settings that name the file."""
    arrays = slice_of(folder)
    (folder / "brain.npz").unlink()
    savemat(
        folder / "brain.mat",
        {"rawData": arrays["spectra"][:, :, None], "offsets": arrays["offsets"][:, None]},
    )
    return {"root": str(folder / "brain.mat")}


def files(folder: Path) -> Sequence[Path]:
    """Write part of one slice to a NumPy file and part of another slice to a MATLAB file; return both paths."""
    first, second = (slice_of(folder, seed)["spectra"][8:16, 8:16] for seed in (1, 2))
    (folder / "brain.npz").unlink()
    np.savez(folder / "mine_1.npz", spectra=first, offsets=OFFSETS)
    savemat(folder / "mine_2.mat", {"spectra": second, "offsets": OFFSETS})
    return [folder / "mine_1.npz", folder / "mine_2.mat"]


SMALL = {"band": 3, "side": 32}
ROWS = {
    "cest": (
        DataRow(
            "generated", SMALL, synthetic=True, files=files, changes={"data_seed": 1, "preset": "fifteen"}
        ),
        DataRow(
            "NumPy's file", SMALL, as_numpy, False, files, fragile={"brain.npz": DAMAGES}, changes={"band": 4}
        ),
        DataRow("MATLAB's file", SMALL, as_matlab, False, files, fragile={"brain.mat": DAMAGES}),
    ),
}
