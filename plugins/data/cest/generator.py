"""Generator of a brain-like slice of Z-spectra, with tissues, a tumour-like region, B0 shift and noise.

It writes the layout that `read_volume` reads.
"""

from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from framework.spectra.offsets import OFFSETS
from framework.spectra.spectrum import CENTRES, spectrum

# columns: amplitude of water, amide, NOE, MT and amine, then their widths (ppm) in the same order
TISSUES = np.array(
    [
        [0.76, 0.030, 0.15, 0.12, 0.08, 0.90, 0.8, 4.6, 55.0, 4.5],  # grey matter
        [0.72, 0.027, 0.19, 0.17, 0.08, 0.95, 0.8, 4.4, 45.0, 4.5],  # white matter
        [0.95, 0.010, 0.03, 0.02, 0.02, 0.50, 0.8, 4.0, 60.0, 4.0],  # cerebrospinal fluid
        [0.80, 0.050, 0.09, 0.07, 0.10, 1.10, 1.0, 4.8, 50.0, 4.5],  # tumour: more amide, less NOE and MT
    ]
)
"""Typical parameters of fits to a human brain at 7 T; the tumour's parameters follow Zaiss et al. (2015)."""
VARIATION = 0.08
"""Relative standard deviation of a parameter within a tissue; the variation is smooth over the slice."""


def write_slice(folder: Path, *, side: int, noise: float, shift: float, data_seed: int) -> None:
    """Write `brain.npz`: spectra (side, side, offset), offsets, mask, region (1: tumour), and the true parameters.

    Args:
        folder: Folder of the file.
        side: Side of the slice, voxels.
        noise: Standard deviation of the noise on each number of a spectrum.
        shift: Standard deviation of the smooth B0 shift, ppm.
        data_seed: Seed of all random numbers.
    """
    generator = np.random.default_rng((data_seed, 42))

    def field(smooth: float) -> np.ndarray:
        """Return a smooth random field of mean 0 and standard deviation 1."""
        values = gaussian_filter(generator.normal(size=(side, side)), smooth * side, mode="reflect")
        return (values - values.mean()) / values.std()

    row, column = np.mgrid[:side, :side] / (side - 1) * 2 - 1
    radius = np.hypot(row / 0.92, column / 0.76)
    mask = radius < 1
    folds = 0.16 * field(0.035)
    tissue = np.where(radius + folds > 0.72, 0, 1)
    tissue = np.where(np.hypot((np.abs(column) - 0.13) / 0.10, (row + 0.05) / 0.33) + folds < 1, 2, tissue)
    tumour = np.hypot(row - 0.30, column - 0.38) + 0.3 * folds < 0.2
    tissue = np.where(tumour & mask, 3, tissue)
    parameters = TISSUES[tissue]
    parameters = parameters * (1 + VARIATION * np.stack([field(0.05) for _ in range(10)], -1))
    b0_shift = shift * field(0.2)
    numbers = np.concatenate(
        [parameters, b0_shift[..., None], np.broadcast_to(CENTRES[1:], (side, side, 4))], -1
    )
    offsets = np.array(OFFSETS)
    clean = spectrum(torch.from_numpy(numbers.reshape(-1, 15)), torch.from_numpy(offsets)).numpy()
    spectra = clean.reshape(side, side, -1) + noise * generator.normal(size=(side, side, len(offsets)))
    np.savez_compressed(
        folder / "brain.npz",
        spectra=np.where(mask[..., None], spectra, 0).astype(np.float32),
        offsets=offsets,
        mask=mask,
        region=(tissue == 3) & mask,
        truth=numbers.astype(np.float32),
    )
