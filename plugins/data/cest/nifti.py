"""Z-spectra and maps in NIfTI, through nibabel (the extra `nifti`), which nothing else needs."""

import math
import re
from collections.abc import Mapping
from pathlib import Path

import nibabel
import numpy as np

from framework.errors import DataError
from framework.storage.arrays import real
from framework.storage.limits import MOST_OF_SPECTRA
from framework.storage.reading import guarded, inflated, read_bytes, require_numbers, room
from framework.storage.text import decoded, require_numbers_in, words_of

PACKED = b"\x1f\x8b"
MASKS = (".mask.nii.gz", ".mask.nii")
"""Endings of the names of mask files."""
SECOND = (540).to_bytes(4, "little"), (540).to_bytes(4, "big")
"""First bytes of a NIfTI-2 file: the size of its header."""


def read_nifti(file: Path) -> Mapping[str, np.ndarray]:
    """Read the images of `file` and their `affine`, the `offsets` beside it, and the `mask` if there is one.

    Offsets are in `<name>.offsets.txt`; the mask is in `<name>.mask.nii.gz` or `<name>.mask.nii`.

    Raises:
        DataError: there is no file of offsets beside it.
        Exception: nibabel's own errors on a damaged file.
    """
    name = re.sub(r"\.nii(\.gz)?$", "", file.name, flags=re.IGNORECASE)
    beside = file.with_name(f"{name}.offsets.txt")
    wanted = [f"{name}{end}".lower() for end in MASKS]
    masks = sorted(other for other in file.parent.iterdir() if other.name.lower() in wanted)
    images = _read(file)
    found = {"spectra": real(images.dataobj, "spectra"), "affine": np.asarray(images.affine)}
    if not beside.is_file():
        raise DataError(
            f"no {beside.name} beside it; wanted the offsets in ppm, one a line, as many as images."
        )
    with guarded(beside, "offsets", "Wanted: numbers in ppm, one a line, as many as images."):
        text = decoded(read_bytes(beside))
        found["offsets"] = np.array(require_numbers_in(words_of(text), text))
        if len(found["offsets"]) != images.shape[-1]:
            raise DataError(
                f"{len(found['offsets'])} offsets for {images.shape[-1]} images of {file.name}; wanted one for each."
            )
    if len(masks) > 1:
        raise DataError(f"{masks[0].name} and {masks[1].name} are beside it; wanted one mask. Take one away.")
    for mask in masks:
        with guarded(mask, "a mask", "Restore it, or take it away: every voxel with a number is meant then."):
            found["mask"] = real(_read(mask).dataobj, "mask")
            if found["mask"].squeeze().shape != found["spectra"][..., 0].squeeze().shape:
                raise DataError(
                    f"of shape {found['mask'].shape}; wanted {images.shape[:-1]}, that of {file.name}."
                )
    return found


def write_nifti(file: Path, maps: np.ndarray, affine: np.ndarray) -> None:
    """Write maps (x, y, z, map), float32, at the place of the spectra."""
    nibabel.Nifti1Image(maps.astype(np.float32), affine).to_filename(file)


def _read(file: Path) -> "nibabel.Nifti1Image | nibabel.Nifti2Image":
    content = read_bytes(file)
    if content.startswith(PACKED):
        content = inflated(content, room(len(content)))
    kind = nibabel.Nifti2Image if content.startswith(SECOND) else nibabel.Nifti1Image
    image = kind.from_bytes(content)
    require_numbers(math.prod(map(int, image.shape)), MOST_OF_SPECTRA, file.stat().st_size)
    return image
