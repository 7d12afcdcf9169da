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
"""How the names of masks end."""
SECOND = (540).to_bytes(4, "little"), (540).to_bytes(4, "big")
"""How NIfTI-2 begins: the bytes of its header."""


def read_nifti(file: Path) -> Mapping[str, np.ndarray]:
    """Images of `file` and their `affine`; `offsets` of `<name>.offsets.txt` and `mask` of `<name>.mask.nii.gz` or
    `<name>.mask.nii` beside it, this if it is there.

    Raises:
        DataError: no offsets are beside it.
        Exception: what nibabel raises on damage.
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
    """Maps (x, y, z, map), float32, that lie where the spectra lay."""
    nibabel.Nifti1Image(maps.astype(np.float32), affine).to_filename(file)


def _read(file: Path) -> "nibabel.Nifti1Image | nibabel.Nifti2Image":
    content = read_bytes(file)
    if content.startswith(PACKED):
        content = inflated(content, room(len(content)))
    kind = nibabel.Nifti2Image if content.startswith(SECOND) else nibabel.Nifti1Image
    image = kind.from_bytes(content)
    require_numbers(math.prod(map(int, image.shape)), MOST_OF_SPECTRA, file.stat().st_size)
    return image
