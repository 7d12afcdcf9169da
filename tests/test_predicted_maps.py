"""Tests of mode=predict for volumes: maps if the data set draws them, and a list of unusable voxels and files."""

import csv
from pathlib import Path

import numpy as np

from plugins.data.cest.generator import write_slice
from tests.conftest import Framework


def test_maps_are_written_and_what_is_bad_is_listed(tmp_path: Path, framework: Framework) -> None:
    """Train a model shortly, and make a folder of two volumes, one with unusable voxels, and a damaged file."""
    write_slice(tmp_path, side=32, noise=0.01, shift=0.05, data_seed=0)
    with np.load(tmp_path / "brain.npz") as stored:
        held = dict(stored)
    mask, bad = held["mask"], held["spectra"].copy()
    first, second = np.argwhere(mask)[[5, 80]]
    bad[first[0], first[1], 3], bad[second[0], second[1]] = np.nan, np.inf
    mine = tmp_path / "mine"
    mine.mkdir()
    for name, spectra in (("one", bad), ("two", held["spectra"])):
        np.savez(mine / f"{name}.npz", spectra=spectra, offsets=held["offsets"], mask=mask)
    (mine / "three.npz").write_bytes((mine / "two.npz").read_bytes()[:3000])
    always = ("logger=none", "threads=1")
    trained = framework(
        "experiment=cest/mlp",
        "debug=fast",
        f"data.root={tmp_path}",
        "pictures=false",
        *always,
        folder="trained",
    )
    assert trained.code == 0, trained.out
    done = framework(
        "mode=predict", f"checkpoint={trained.folder}", f"mode.files={mine}", *always, folder="predicted"
    )
    assert done.code == 0, done.out
    assert (done.folder / "unreadable.txt").read_text() == f"{mine / 'three.npz'}\n"
    maps = done.folder / "maps"
    wanted = [f"{name}_maps.{kind}" for name in ("one", "two") for kind in ("npz", "png")]
    assert {file.name for file in maps.iterdir()} == {*wanted, "one_maps_left_out.csv"}
    listed = np.loadtxt(maps / "one_maps_left_out.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(listed[:, :2], [first, second])
    with (done.folder / "predictions.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    for name, left_out in (("one", 2), ("two", 0)):
        own = [float(row["amide_amplitude"]) for row in rows if f"{name}.npz" in row["sample"]]
        with np.load(maps / f"{name}_maps.npz") as found:
            amide, deviation = (found[f"amide_amplitude{end}"][..., 0] for end in ("", "_deviation"))
        assert len(own) == mask.sum() - left_out == np.isfinite(amide).sum()
        np.testing.assert_allclose(amide[np.isfinite(amide)], own, rtol=1e-6)
        assert (deviation[np.isfinite(amide)] > 0).all()
        assert np.isnan(amide[~mask]).all()
