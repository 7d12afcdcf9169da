"""Maps of the predictions for a volume's voxels and of their standard deviations: files and a figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from framework.figures.style import save_figure
from plugins.data.cest.maps_picture import SHOWN, Maps, maps_figure
from plugins.data.cest.volumes import Volume, read_volume

ASYMMETRIC = 3.5
"""Offset of the amide protons, ppm, at which the asymmetry is reported."""
ASYMMETRY = "mtr_asymmetry_3.5_ppm"


def write_maps(
    file: Path, names: Sequence[str], point: Tensor, deviation: Tensor, folder: Path, *, synthetic: bool
) -> Sequence[Path]:
    """Write the predicted maps of a volume and return the paths of the files.

    `<file>_maps.npz` holds a map of each predicted number, a map of each standard deviation (its name ends in
    `_deviation`) and a map of the asymmetry; they are NaN where there is no voxel. `<file>_maps.png` is the figure. For
    a NIfTI file, `<file>_maps.nii.gz` holds the same maps, and `<file>_maps.txt` their names. Bad voxels, if there are
    any, are listed in `<file>_maps_left_out.csv`.

    Args:
        file: The volume.
        names: Names of the predicted numbers.
        point: Point predictions (voxel, number), with the voxels in the order in which `read_volume` returns them.
        deviation: Standard deviations of the predictions, (voxel, number).
        folder: Folder of the written files.
        synthetic: True if the model was trained on generated spectra.
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
        left_out_file = stem.with_name(f"{stem.name}_left_out.csv")
        np.savetxt(left_out_file, volume.left_out, "%d", ",", header="x,y,z", comments="")
        written.append(left_out_file)
    title = f"{file.name}: amplitudes of the lines" + ", by a model of synthetic data" * synthetic
    return [*written, save_figure(maps_figure({"": slice_of(maps, volume)}, title), stem, True)]


def maps_of(
    volume: Volume,
    names: Sequence[str],
    point: Float[np.ndarray, "voxel number"],
    deviation: Float[np.ndarray, "voxel number"],
) -> dict[str, np.ndarray]:
    """Return the maps (x, y, z) by name, NaN where there is no voxel; amplitudes are shares of the unsaturated signal.

    The maps are the asymmetry, each predicted number, and each standard deviation. `point` holds the point predictions
    of the volume's voxels, `deviation` their standard deviations, and `names` the names of the predicted numbers.
    """
    columns = {ASYMMETRY: asymmetry(volume)}
    for number, name in enumerate(names):
        columns[name], columns[f"{name}_deviation"] = point[:, number], deviation[:, number]
    maps = {}
    for name, values in columns.items():
        maps[name] = np.full(volume.shape, np.nan)
        maps[name][tuple(volume.place.T)] = values
    return maps


def asymmetry(volume: Volume) -> Float[np.ndarray, "voxel"]:
    """Return Z(-Δω) - Z(Δω) of the measured spectra, Δω = 3.5 ppm, without B0 correction (Zhou et al. 2003, eq. 1)."""
    left, right = (
        np.array([np.interp(sign * ASYMMETRIC, volume.offsets, spectrum) for spectrum in volume.spectra])
        for sign in (-1, 1)
    )
    return left - right


def slice_of(maps: Mapping[str, np.ndarray], volume: Volume) -> Maps:
    """Return the contrast maps that the figure shows, with standard deviations, of the slice with the most voxels.

    The maps are cropped to the voxels of that slice. The asymmetry has no standard deviation (None).
    """
    fullest = np.bincount(volume.place[:, 2]).argmax()
    rows, columns = volume.place[volume.place[:, 2] == fullest, :2].T
    frame = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1, fullest]
    return {
        name: (maps[name][frame], maps[f"{name}_deviation"][frame])
        for name in SHOWN
        if f"{name}_deviation" in maps
    } | {ASYMMETRY: (maps[ASYMMETRY][frame], None)}
