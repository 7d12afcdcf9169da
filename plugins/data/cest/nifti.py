"""Reading of Z-spectra from NIfTI files and writing of maps, with nibabel (the optional dependency `nifti`)."""

import math
import re
from collections.abc import Mapping
from pathlib import Path

import nibabel
import numpy as np

from framework.errors import DataError
from framework.storage.arrays import to_real
from framework.storage.limits import MOST_OF_SPECTRA
from framework.storage.reading import (
    inflate,
    most_decompressed,
    read_bytes,
    require_numbers,
    translate_errors,
)
from framework.storage.text import decode, require_numbers_in, words_of

PACKED = b"\x1f\x8b"
MASKS = (".mask.nii.gz", ".mask.nii")
"""Endings of the names of mask files."""
SECOND = (540).to_bytes(4, "little"), (540).to_bytes(4, "big")
"""First bytes of a NIfTI-2 file: the size of its header."""


def read_nifti(file: Path) -> Mapping[str, np.ndarray]:
    """Return the arrays `spectra`, `affine` and `offsets` of a NIfTI file, and its `mask` if there is one.

    The offsets are in `<name>.offsets.txt` in the same folder; the mask is in `<name>.mask.nii.gz` or
    `<name>.mask.nii`.

    Raises:
        DataError: The file of offsets is missing or damaged, there are two masks, or shapes do not agree.
        Exception: nibabel's own errors on a damaged file.
    """
    name = re.sub(r"\.nii(\.gz)?$", "", file.name, flags=re.IGNORECASE)
    offsets_file = file.with_name(f"{name}.offsets.txt")
    mask_names = [f"{name}{end}".lower() for end in MASKS]
    masks = sorted(path for path in file.parent.iterdir() if path.name.lower() in mask_names)
    images = _read(file)
    arrays = {"spectra": to_real(images.dataobj, "spectra"), "affine": np.asarray(images.affine)}
    if not offsets_file.is_file():
        raise DataError(
            f"{file}: the folder of this file holds no {offsets_file.name}. Write the offsets of the images in ppm "
            "into a file of this name, one offset per line."
        )
    with translate_errors(offsets_file, "offsets", "Write one number in ppm per line, one for each image."):
        text = decode(read_bytes(offsets_file))
        arrays["offsets"] = np.array(require_numbers_in(words_of(text), text))
        if len(arrays["offsets"]) != images.shape[-1]:
            raise DataError(
                f"{offsets_file.name} lists {len(arrays['offsets'])} offsets, but {file.name} holds "
                f"{images.shape[-1]} images. List one offset for each image."
            )
    if len(masks) > 1:
        raise DataError(
            f"{file}: the folder of this file holds two masks, {masks[0].name} and {masks[1].name}. Remove one of "
            "them."
        )
    for mask in masks:
        remedy = "Copy the mask again from its source, or remove the file to read every voxel with a number."
        with translate_errors(mask, "a mask", remedy):
            arrays["mask"] = to_real(_read(mask).dataobj, "mask")
            if arrays["mask"].squeeze().shape != arrays["spectra"][..., 0].squeeze().shape:
                raise DataError(
                    f"{mask}: the mask has shape {arrays['mask'].shape}, but the images of {file.name} have shape "
                    f"{images.shape[:-1]}. Give a mask with the shape of the images."
                )
    return arrays


def write_nifti(file: Path, maps: np.ndarray, affine: np.ndarray) -> None:
    """Write maps (x, y, z, map) as float32; `affine` maps voxels to millimetres, as in the file of the spectra."""
    nibabel.Nifti1Image(maps.astype(np.float32), affine).to_filename(file)


def _read(file: Path) -> "nibabel.Nifti1Image | nibabel.Nifti2Image":
    content = read_bytes(file)
    if content.startswith(PACKED):
        content = inflate(content, most_decompressed(len(content)))
    kind = nibabel.Nifti2Image if content.startswith(SECOND) else nibabel.Nifti1Image
    image = kind.from_bytes(content)
    require_numbers(math.prod(map(int, image.shape)), MOST_OF_SPECTRA, file.stat().st_size)
    return image
