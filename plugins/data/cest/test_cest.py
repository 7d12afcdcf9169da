"""Tests of volumes of Z-spectra: files that are read and refused, splits without neighbours, maps."""

import gzip

import numpy as np
import pytest
import torch

from framework.errors import DataError
from framework.spectra.offsets import OFFSETS
from framework.spectra.spectrum import PRESETS, Parameters, spectrum
from plugins.data.cest.data import CEST
from plugins.data.cest.maps import ASYMMETRY, write_maps
from plugins.data.cest.resampling import resample
from plugins.data.cest.volumes import read_volume

MODEL_OFFSETS = torch.tensor(OFFSETS, dtype=torch.float64)


def test_bands_have_no_neighbour_in_another_split(brain):
    data = CEST(root=str(brain), band=3)
    data.prepare()
    rows = [set(part.fields["place"][:, 0].tolist()) for part in data.splits()]
    for first in range(3):
        for second in range(3):
            if first != second:
                assert min(abs(a - b) for a in rows[first] for b in rows[second]) > 1
    assert data.groups == ("healthy", "tumour") and data.target.names[0] == "water_amplitude"


@pytest.mark.parametrize("preset", PRESETS)
def test_training_sees_shifted_lines_with_the_noise_of_the_spectrum(preset, brain):
    data = CEST(root=str(brain), preset=preset, band=3, noise=0.0, shift=0.3)
    data.prepare()
    batch = data.splits().train.__getitems__(range(50))
    augmented = data.augment(batch)
    b0_shift = augmented["lines"][:, 10] - batch["lines"][:, 10]
    assert 0.2 < float(b0_shift.abs().max()) <= 0.3
    noise = batch["input"] - spectrum(batch["lines"], MODEL_OFFSETS.float())
    lines = batch["lines"].clone()
    lines[:, 10] += b0_shift
    expected = spectrum(lines, MODEL_OFFSETS.float()) + noise
    torch.testing.assert_close(augmented["input"], expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(augmented["target"], lines[:, : augmented["target"].shape[1]])
    assert torch.equal(batch["lines"][:, :10], augmented["lines"][:, :10])


def test_other_offsets_are_resampled_or_refused():
    parameters = torch.tensor([Parameters.of("ten").start], dtype=torch.float64)
    dense = np.linspace(-41, 41, 1641)
    measured = spectrum(parameters, torch.from_numpy(dense)).numpy()
    resampled = resample(measured, dense, OFFSETS, "scan.npz")
    np.testing.assert_allclose(resampled, spectrum(parameters, MODEL_OFFSETS).numpy(), atol=1e-4)
    with pytest.raises(DataError, match="offsets were measured, from -30 to 41 ppm"):
        resample(measured[:, 220:], dense[220:], OFFSETS, "scan.npz")
    with pytest.raises(DataError, match="too far to resolve a line"):
        resample(measured[:, ::41], dense[::41], OFFSETS, "scan.npz")


def volume_with(**changes):
    """Return the arrays of a good volume with these changes; None leaves an array out."""
    arrays = {"spectra": np.full((4, 5, 6), 0.5), "offsets": np.array([-5.0, -2.0, 0.0, 2.0, 5.0, 9.0])}
    arrays |= changes
    return {name: array for name, array in arrays.items() if array is not None}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            volume_with(offsets=None),
            "The file holds the arrays spectra, but spectra and offsets are required. A volume holds",
        ),
        (volume_with(spectra=np.ones((4, 5, 7))), "for 6 offsets"),
        (volume_with(offsets=np.array([0.0, 0, 1, 2, 3, 4])), "occur twice"),
        (volume_with(offsets=np.array([-500.0, -200, -100, 100, 200, 900])), "not in Hz"),
        (volume_with(spectra=np.full((4, 5, 6), np.nan)), "None of the 20 voxels"),
        (volume_with(spectra=np.full((4, 5, 6), 900.0)), "not divided by M0"),
        (volume_with(mask=np.zeros((4, 5))), "The mask contains no voxel"),
        (volume_with(region=np.full((4, 5), 7)), "numbers from 7 to 7"),
    ],
)
def test_the_message_about_a_bad_volume_names_the_fault(arrays, message, tmp_path):
    np.savez(tmp_path / "scan.npz", **arrays)
    with pytest.raises(DataError, match=message):
        read_volume(tmp_path / "scan.npz")


def test_m0_divides_and_voxels_with_gaps_are_counted(tmp_path):
    spectra = np.full((4, 5, 7), 400.0)
    spectra[..., 0] = 800.0
    spectra[1, 2, 3] = np.nan
    offsets = np.array([-300.0, 9.0, 5.0, 2.0, 0.0, -2.0, -5.0])
    np.savez(tmp_path / "scan.npz", spectra=spectra, offsets=offsets)
    volume = read_volume(tmp_path / "scan.npz")
    assert volume.offsets.tolist() == [-5, -2, 0, 2, 5, 9] and volume.dropped == 1
    np.testing.assert_array_equal(volume.spectra, np.full((19, 6), 0.5))


def test_nifti_is_read_with_its_offsets(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    spectra = np.random.default_rng(0).uniform(0.3, 0.9, (3, 4, 1, 6)).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(spectra, np.eye(4)), tmp_path / "scan.nii")
    with pytest.raises(DataError, match=r"holds no scan\.offsets\.txt"):
        read_volume(tmp_path / "scan.nii")
    (tmp_path / "scan.offsets.txt").write_text("-5\n-2\n0\n2\n5\n9\n")
    volume = read_volume(tmp_path / "scan.nii")
    np.testing.assert_array_equal(volume.spectra, spectra.reshape(12, 6))


def test_maps_of_a_nifti_file_have_its_affine(tmp_path, brain):
    nibabel = pytest.importorskip("nibabel")
    with np.load(brain) as content:
        spectra, mask = content["spectra"][:, :, None], content["mask"][:, :, None]
        offsets = content["offsets"]
    affine = np.diag([1.5, 1.5, 3.0, 1.0])
    affine[:3, 3] = -20, 10, 5
    nibabel.save(nibabel.Nifti1Image(spectra, affine), tmp_path / "scan.nii.gz")
    nibabel.save(nibabel.Nifti1Image(mask.astype(np.uint8), affine), tmp_path / "scan.mask.nii.gz")
    (tmp_path / "scan.offsets.txt").write_text("\n".join(map(str, offsets)))
    names = PRESETS["ten"].target
    point = torch.rand(int(mask.sum()), 10)
    written = write_maps(tmp_path / "scan.nii.gz", names, point, point / 10, tmp_path, synthetic=False)
    assert [file.name for file in written] == [
        f"scan_maps{end}" for end in (".npz", ".nii.gz", ".txt", ".png")
    ]
    images = nibabel.load(tmp_path / "scan_maps.nii.gz")
    np.testing.assert_array_equal(images.affine, affine)
    map_names = (tmp_path / "scan_maps.txt").read_text().split()
    values = np.asarray(images.dataobj)
    np.testing.assert_array_equal(values[mask, map_names.index("noe_amplitude")], point[:, 2].numpy())
    left, right = (spectra[mask][:, np.argmin(np.abs(offsets - ppm))] for ppm in (-3.5, 3.5))
    np.testing.assert_allclose(values[mask, map_names.index(ASYMMETRY)], left - right, atol=1e-6)
    assert np.isnan(values[~mask]).all()


@pytest.mark.parametrize("kind", ["npz", "nii", "mask", "M0"])
def test_an_imaginary_part_is_refused_and_not_lost(tmp_path, kind):
    """Check also that complex numbers without an imaginary part are read."""
    nibabel = pytest.importorskip("nibabel")
    spectra = np.random.default_rng(0).uniform(0.3, 0.9, (3, 4, 1, 6))
    arrays = {
        "spectra": spectra,
        "offsets": np.arange(6.0),
        "mask": np.ones((3, 4, 1)),
        "M0": np.ones((3, 4, 1)),
    }
    for part in (0j, 0.1j):
        changed = {"npz": "spectra"}.get(kind, kind)
        if kind == "nii":
            nibabel.save(
                nibabel.Nifti1Image((spectra + part).astype(np.complex64), np.eye(4)), tmp_path / "scan.nii"
            )
            (tmp_path / "scan.offsets.txt").write_text("0\n1\n2\n3\n4\n5\n")
            file = tmp_path / "scan.nii"
        else:
            file = tmp_path / "scan.npz"
            np.savez(file, **(arrays | {changed: arrays[changed] + part}))
        if part:
            with pytest.raises(
                DataError, match=r"scan\.(npz|nii).* complex numbers, .* magnitudes, numpy\.abs"
            ):
                read_volume(file)
        else:
            np.testing.assert_allclose(read_volume(file).spectra, spectra.reshape(12, 6), atol=1e-6)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("second", [False, True], ids=["NIfTI-1", "NIfTI-2"])
@pytest.mark.parametrize("end", ["nii", "nii.gz", "NII"])
@pytest.mark.parametrize("mask_end", ["nii", "nii.gz"])
def test_both_versions_of_nifti_are_read_with_either_mask(tmp_path, order, second, end, mask_end):
    nibabel = pytest.importorskip("nibabel")
    kind = nibabel.Nifti2Image if second else nibabel.Nifti1Image
    spectra = np.random.default_rng(0).uniform(0.3, 0.9, (3, 4, 1, 6)).astype(np.float32)
    mask = np.arange(12).reshape(3, 4, 1) % 3 == 0

    def save(name, array):
        header = (nibabel.Nifti2Header if second else nibabel.Nifti1Header)(endianness=order)
        header.set_data_dtype(array.dtype)
        content = kind(array, np.eye(4), header).to_bytes()
        (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)

    save(f"scan.{end}", spectra)
    save(f"scan.mask.{mask_end}", mask.astype(np.uint8))
    (tmp_path / "scan.offsets.txt").write_text("-5\n-2\n0\n2\n5\n9\n")
    volume = read_volume(tmp_path / f"scan.{end}")
    np.testing.assert_array_equal(volume.spectra, spectra[mask])
    other = {"nii": "nii.gz", "nii.gz": "nii"}[mask_end]
    save(f"scan.mask.{other}", mask.astype(np.uint8))
    with pytest.raises(DataError, match=r"holds two masks, .* Remove one of them"):
        read_volume(tmp_path / f"scan.{end}")
