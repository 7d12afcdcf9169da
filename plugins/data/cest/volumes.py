"""Reading of volumes of Z-spectra: MATLAB 5 (.mat), NumPy (.npz), and NIfTI (.nii, .nii.gz) with a list of offsets."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from framework.datasets.matlab import read_variables
from framework.errors import DataError, shorten
from framework.storage.arrays import read_npz, to_real
from framework.storage.limits import MOST_OF_SPECTRA, MOST_VOXELS
from framework.storage.reading import read_bytes, require_numbers, translate_errors

SUFFIXES = (".mat", ".npz", ".nii", ".gz")
SPECTRA = ("spectra", "rawData")
KNOWN = ("offsets", "M0", "mask", "region", "affine")
UNSATURATED = 100.0
"""Smallest absolute value of an offset, ppm, at which nothing is saturated.

Images at such offsets, and at larger ones, are M0. All other images are divided by M0.
"""
PLAUSIBLE = 2.0
"""Limit of the median over voxels of the largest Z of a spectrum.

Z is about 1 at most, so a volume above this limit was not divided by M0.
"""
LAYOUT = (
    "A volume holds `spectra` (or `rawData`), with the axes of the voxels first and the offsets last, and `offsets` in "
    "ppm. It may also hold `M0` (or images at 100 ppm or more) and `mask`, with the axes of the voxels."
)


class Volume(NamedTuple):
    """Z-spectra of the voxels of a volume.

    Attributes:
        offsets: Offsets, (offset,), ppm, ascending.
        spectra: Z of the voxels within the mask, (voxel, offset).
        place: Index of each voxel in the volume, (voxel, 3).
        region: Region of each voxel, (voxel,), an index into `regions`.
        shape: Shape of the whole volume.
        regions: Names of the regions.
        left_out: Indices of the voxels in the mask that are left out because one of their numbers is not finite,
            (dropped, 3).
        affine: Transform from voxels to millimetres, for a NIfTI file; otherwise None.
        unread: Names of other arrays in the file.
    """

    offsets: Float[np.ndarray, "offset"]
    spectra: Float[np.ndarray, "voxel offset"]
    place: Int[np.ndarray, "voxel 3"]
    region: Int[np.ndarray, "voxel"]
    shape: tuple[int, ...]
    regions: tuple[str, ...]
    left_out: Int[np.ndarray, "dropped 3"]
    affine: Float[np.ndarray, "4 4"] | None = None
    unread: tuple[str, ...] = ()

    @property
    def dropped(self) -> int:
        """Number of voxels of the mask that are left out."""
        return len(self.left_out)


def read_volume(file: Path) -> Volume:
    """Read the spectra of one file; if the file holds M0, the unsaturated signal, the spectra are divided by it.

    Raises:
        DataError: The file is missing, damaged, of another layout, or holds no voxel.
    """
    with translate_errors(file, "a volume of Z-spectra", LAYOUT):
        arrays = _read_arrays(file)
        numbers = sum(np.size(values) for values in arrays.values())
        size = file.stat().st_size
        require_numbers(numbers, MOST_OF_SPECTRA, size)
        return _volume(arrays, size)


def _read_arrays(file: Path) -> Mapping[str, Any]:
    name = file.name.lower()
    if name.endswith(".mat"):
        return read_variables(file, remedy=LAYOUT)
    if name.endswith(".npz"):
        return read_npz(read_bytes(file))
    if name.endswith((".nii", ".nii.gz")):
        return _nifti(file)
    raise DataError(
        f"The suffix of the file is {shorten(file.suffix) or 'empty'}; expected .mat, .npz, .nii or .nii.gz."
    )


def _nifti(file: Path) -> Mapping[str, Any]:
    try:
        from plugins.data.cest.nifti import read_nifti
    except ImportError as error:
        raise DataError(
            "Reading NIfTI files needs nibabel, which is not installed. Run pip install -e '.[nifti]', or save the "
            "volume as .npz."
        ) from error
    return read_nifti(file)


def _volume(arrays: Mapping[str, Any], size: int) -> Volume:
    """Return the volume that the arrays of a file hold; `size` is the size of the file, bytes."""
    name = next((name for name in SPECTRA if name in arrays), None)
    if name is None or "offsets" not in arrays:
        raise DataError(
            f"The file holds the arrays {shorten(', '.join(arrays)) or 'none'}, but spectra and offsets are "
            f"required. {LAYOUT}"
        )
    spectra, offsets = to_real(arrays[name], name), to_real(arrays["offsets"], "offsets").ravel()
    if not 2 <= spectra.ndim <= 4 or spectra.shape[-1] != len(offsets):
        raise DataError(f"The array {name} has shape {spectra.shape} for {len(offsets)} offsets. {LAYOUT}")
    if not np.isfinite(offsets).all() or len(np.unique(offsets)) < len(offsets):
        raise DataError(
            "Some of the offsets are not finite or occur twice. Correct the list of offsets; the unit is ppm."
        )
    require_numbers(math.prod(spectra.shape[:-1]), MOST_VOXELS, size // 4)
    shape = (*spectra.shape[:-1], *(1,) * (4 - spectra.ndim))
    spectra = spectra.reshape(*shape, -1)
    spectra, offsets = _divide_by_m0(spectra, offsets, arrays.get("M0"))
    order = np.argsort(offsets)
    spectra, offsets = spectra[..., order], offsets[order]
    inside = _mask(arrays.get("mask"), spectra)
    finite = np.isfinite(spectra).all(-1)
    usable = inside & finite
    if not inside.any():
        raise DataError(
            "The mask contains no voxel: no number of the mask is above 0. Correct the mask, or leave it out."
        )
    if not usable.any():
        raise DataError(
            f"None of the {inside.sum()} voxels within the mask can be read: each has a number that is not finite. "
            "Correct the spectra or the mask."
        )
    middle = float(np.median(spectra[usable].max(-1)))
    if not 0 < middle < PLAUSIBLE:
        raise DataError(
            f"The median of the spectra's largest numbers is {middle:g}, but Z is at most about 1. The spectra were "
            "not divided by M0. Add M0, or images at 100 ppm or more, to the file."
        )
    region = arrays.get("region")
    regions = ("voxels",) if region is None else ("healthy", "tumour")
    numbers = (
        np.zeros(shape, np.int64)
        if region is None
        else to_real(region, "region").astype(np.int64).reshape(shape)
    )
    if numbers.min() < 0 or numbers.max() >= len(regions):
        raise DataError(
            f"The array `region` holds numbers from {numbers.min()} to {numbers.max()}; expected 0 (healthy) and 1 "
            "(tumour). Correct the array, or leave it out."
        )
    place = np.argwhere(usable)
    left_out = np.argwhere(inside & ~finite)
    unread = tuple(shorten(other, 40) for other in arrays if other not in (name, *KNOWN))[:12]
    return Volume(
        offsets,
        spectra[usable],
        place,
        numbers[usable],
        shape,
        regions,
        left_out,
        arrays.get("affine"),
        unread,
    )


def _divide_by_m0(spectra: np.ndarray, offsets: np.ndarray, m0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the saturated spectra divided by M0, the unsaturated signal, and their offsets.

    If `m0` is None, M0 is the mean of the unsaturated images; without such images the spectra are already divided.
    Voxels whose M0 is 0 become NaN.
    """
    far = np.abs(offsets) >= UNSATURATED
    if far.all():
        raise DataError(
            f"Every offset is {UNSATURATED:g} ppm or more, but offsets near 0 ppm are required. Write the offsets in "
            "ppm, not in Hz."
        )
    if m0 is not None:
        unsaturated = to_real(m0, "M0").reshape(*spectra.shape[:-1], 1)
    elif far.any():
        unsaturated = spectra[..., far].mean(-1, keepdims=True)
    else:
        return spectra, offsets
    with np.errstate(divide="ignore", invalid="ignore"):
        spectra = np.where(unsaturated > 0, spectra / unsaturated, np.nan)
    return spectra[..., ~far], offsets[~far]


def _mask(mask: Any, spectra: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Return a mask of the voxels to read.

    They are the voxels where `mask` is above 0 or, if `mask` is None, those whose spectrum holds a number other than 0.
    """
    if mask is None:
        return np.asarray(np.nan_to_num(spectra, nan=1.0).any(-1))
    return np.asarray(np.nan_to_num(to_real(mask, "mask").reshape(spectra.shape[:-1])) > 0)
