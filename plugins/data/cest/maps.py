"""Maps of the predictions for a volume's voxels, with their standard deviations: files and a figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from framework.figures.style import saved
from plugins.data.cest.maps_picture import SHOWN, Maps, pictured
from plugins.data.cest.volumes import Volume, read_volume

ASYMMETRIC = 3.5
"""Offset of the amide protons, ppm, at which the asymmetry is reported."""
ASYMMETRY = "mtr_asymmetry_3.5_ppm"


def write_maps(
    file: Path, names: Sequence[str], point: Tensor, deviation: Tensor, folder: Path, *, synthetic: bool
) -> Sequence[Path]:
    """Write the predicted maps of a volume, and return the files.

    The files are `<file>_maps.npz` (a map of each name, one of each name with `_deviation`, and one of the asymmetry;
    NaN where there is no voxel); for a NIfTI file also `_maps.nii.gz`, with the maps' names beside it; the figure; and
    a list of bad voxels if there are any.

    Args:
        file: the volume.
        names: names of the predicted numbers.
        point: point predictions (voxel, number), for the file's voxels in their order.
        deviation: standard deviations, of the same shape.
        folder: folder of the written files.
        synthetic: whether the model learnt from generated spectra.
    """
    volume = read_volume(file)
    maps = maps_of(volume, names, point.double().numpy(), deviation.double().numpy())
    stem = folder / f"{file.name.split('.')[0]}_maps"
    written = [stem.with_suffix(".npz")]
    np.savez_compressed(written[0], **maps)  # pyright: ignore[reportArgumentType]
    if volume.affine is not None:
        from plugins.data.cest.nifti import write_nifti

        written += [stem.with_suffix(".nii.gz"), stem.with_suffix(".txt")]
        write_nifti(written[1], np.stack(list(maps.values()), -1), volume.affine)
        written[2].write_text("".join(f"{name}\n" for name in maps), encoding="utf-8")
    if volume.dropped:
        bad = stem.with_name(f"{stem.name}_left_out.csv")
        np.savetxt(bad, volume.left_out, "%d", ",", header="x,y,z", comments="")
        written.append(bad)
    title = f"{file.name}: lines' amplitudes" + ", by a model of synthetic data" * synthetic
    return [*written, saved(pictured({"": slice_of(maps, volume)}, title), stem, True)]


def maps_of(
    volume: Volume,
    names: Sequence[str],
    point: Float[np.ndarray, "voxel number"],
    deviation: Float[np.ndarray, "voxel number"],
) -> dict[str, np.ndarray]:
    """Return maps (x, y, z) by name, NaN where there is no voxel; amplitudes are shares of the unsaturated signal."""
    columns = {ASYMMETRY: asymmetry(volume)}
    for number, name in enumerate(names):
        columns[name], columns[f"{name}_deviation"] = point[:, number], deviation[:, number]
    found = {}
    for name, values in columns.items():
        found[name] = np.full(volume.shape, np.nan)
        found[name][tuple(volume.place.T)] = values
    return found


def asymmetry(volume: Volume) -> Float[np.ndarray, "voxel"]:
    """Return Z(-Δω) - Z(Δω) of the measured spectra; B0 is not corrected (Zhou et al. 2003, eq. 1)."""
    left, right = (
        np.array([np.interp(sign * ASYMMETRIC, volume.offsets, spectrum) for spectrum in volume.spectra])
        for sign in (-1, 1)
    )
    return left - right


def slice_of(maps: Mapping[str, np.ndarray], volume: Volume) -> Maps:
    """Return the maps to show of the slice with most voxels, cropped to them, each with its deviation."""
    where = np.bincount(volume.place[:, 2]).argmax()
    rows, columns = volume.place[volume.place[:, 2] == where, :2].T
    frame = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1, where]
    return {
        name: (maps[name][frame], maps[f"{name}_deviation"][frame])
        for name in SHOWN
        if f"{name}_deviation" in maps
    } | {ASYMMETRY: (maps[ASYMMETRY][frame], None)}
