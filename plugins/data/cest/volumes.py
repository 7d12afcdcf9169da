"""Reading of Z-spectra volumes: MATLAB 5 (.mat), NumPy (.npz), and NIfTI (.nii, .nii.gz) beside a list of offsets."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from framework.datasets.matlab import read_variables
from framework.errors import DataError, shown
from framework.storage.arrays import archive, real
from framework.storage.limits import MOST_OF_SPECTRA, MOST_VOXELS
from framework.storage.reading import guarded, read_bytes, require_numbers

SUFFIXES = (".mat", ".npz", ".nii", ".gz")
SPECTRA = ("spectra", "rawData")
KNOWN = ("offsets", "M0", "mask", "region", "affine")
UNSATURATED = 100.0
"""Offset, ppm, from which nothing is saturated: images there are M0, by which the others are divided."""
PLAUSIBLE = 2.0
"""Upper limit of a plausible Z, which is about 1 at most; above it, a volume was not divided by M0."""
WANTED = (
    "Wanted: `spectra` (or `rawData`), the voxels' axes first and the offsets last, and `offsets` in ppm; where there "
    "are, `M0` (or images at 100 ppm or more) and `mask`, of the voxels' axes."
)


class Volume(NamedTuple):
    """Z-spectra of the voxels of a volume.

    Attributes:
        offsets: (offset,), ppm, ascending.
        spectra: (voxel, offset), Z of the voxels within the mask.
        place: (voxel, 3), index of each voxel in the volume.
        region: (voxel,), index into `regions`.
        shape: shape of the whole volume.
        regions: names of the regions.
        left_out: (dropped, 3), voxels of the mask with a number that is not finite.
        affine: for a NIfTI file, the transform from voxels to millimetres; otherwise None.
        unread: names of other arrays in the file.
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
    """Read the spectra of one file, divided by M0 if the file holds it.

    Raises:
        DataError: the file is missing, damaged, of another layout, or holds no voxel; the message says what was wanted.
    """
    with guarded(file, "a volume of Z-spectra", WANTED):
        found = _found(file)
        numbers = sum(np.size(values) for values in found.values())
        size = file.stat().st_size
        require_numbers(numbers, MOST_OF_SPECTRA, size)
        return _volume(found, size)


def _found(file: Path) -> Mapping[str, Any]:
    name = file.name.lower()
    if name.endswith(".mat"):
        return read_variables(file, remedy=WANTED)
    if name.endswith(".npz"):
        return archive(read_bytes(file))
    if name.endswith((".nii", ".nii.gz")):
        return _nifti(file)
    raise DataError(f"a file of suffix {shown(file.suffix) or 'none'}; wanted .mat, .npz, .nii or .nii.gz.")


def _nifti(file: Path) -> Mapping[str, Any]:
    try:
        from plugins.data.cest.nifti import read_nifti
    except ImportError as error:
        raise DataError(
            "NIfTI needs nibabel, which is not installed. pip install -e '.[nifti]', or save the volume as .npz."
        ) from error
    return read_nifti(file)


def _volume(found: Mapping[str, Any], size: int) -> Volume:
    name = next((name for name in SPECTRA if name in found), None)
    if name is None or "offsets" not in found:
        raise DataError(f"it holds {shown(', '.join(found)) or 'nothing'}. {WANTED}")
    spectra, offsets = real(found[name], name), real(found["offsets"], "offsets").ravel()
    if not 2 <= spectra.ndim <= 4 or spectra.shape[-1] != len(offsets):
        raise DataError(f"{name} is of shape {spectra.shape} for {len(offsets)} offsets. {WANTED}")
    if not np.isfinite(offsets).all() or len(np.unique(offsets)) < len(offsets):
        raise DataError("offsets that are not finite, or stand there twice. Mend the list; it is in ppm.")
    require_numbers(math.prod(spectra.shape[:-1]), MOST_VOXELS, size // 4)
    shape = (*spectra.shape[:-1], *(1,) * (4 - spectra.ndim))
    spectra = spectra.reshape(*shape, -1)
    spectra, offsets = _normalised(spectra, offsets, found.get("M0"))
    order = np.argsort(offsets)
    spectra, offsets = spectra[..., order], offsets[order]
    inside = _mask(found.get("mask"), spectra)
    whole = np.isfinite(spectra).all(-1)
    kept = inside & whole
    if not inside.any():
        raise DataError("its mask holds no voxel: nowhere is it above 0. Mend it, or leave it out.")
    if not kept.any():
        raise DataError(
            f"no voxel of {inside.sum()} within the mask is whole: each has a number that is not finite."
        )
    middle = float(np.median(spectra[kept].max(-1)))
    if not 0 < middle < PLAUSIBLE:
        raise DataError(
            f"the greatest number of half its spectra is beyond {middle:g}, where Z is about 1: they were not divided "
            "by M0. Give M0, or images at 100 ppm or more."
        )
    region = found.get("region")
    regions = ("voxels",) if region is None else ("healthy", "tumour")
    numbers = (
        np.zeros(shape, np.int64)
        if region is None
        else real(region, "region").astype(np.int64).reshape(shape)
    )
    if numbers.min() < 0 or numbers.max() >= len(regions):
        raise DataError(f"regions {numbers.min()} to {numbers.max()}; wanted 0 (healthy) and 1 (tumour).")
    place = np.argwhere(kept)
    left_out = np.argwhere(inside & ~whole)
    unread = tuple(shown(other, 40) for other in found if other not in (name, *KNOWN))[:12]
    return Volume(
        offsets, spectra[kept], place, numbers[kept], shape, regions, left_out, found.get("affine"), unread
    )


def _normalised(spectra: np.ndarray, offsets: np.ndarray, given: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return spectra divided by M0, and their offsets; a voxel becomes NaN where M0 is 0."""
    far = np.abs(offsets) >= UNSATURATED
    if far.all():
        raise DataError(f"every offset is {UNSATURATED:g} ppm or more. They are to be in ppm, not in Hz.")
    if given is not None:
        whole = real(given, "M0").reshape(*spectra.shape[:-1], 1)
    elif far.any():
        whole = spectra[..., far].mean(-1, keepdims=True)
    else:
        return spectra, offsets
    with np.errstate(divide="ignore", invalid="ignore"):
        spectra = np.where(whole > 0, spectra / whole, np.nan)
    return spectra[..., ~far], offsets[~far]


def _mask(given: Any, spectra: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Return the mask of voxels to read; without a given mask, voxels with any number other than 0."""
    if given is None:
        return np.asarray(np.nan_to_num(spectra, nan=1.0).any(-1))
    return np.asarray(np.nan_to_num(real(given, "mask").reshape(spectra.shape[:-1])) > 0)
