"""Tests of mode=encode: parts are complete, and each file is encoded once, even with interruptions and several jobs."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from framework.configuration.schema import build, resolve
from framework.configuration.settings import Settings
from framework.errors import ConfigError, DataError
from framework.modes.encode import collect_files, describe, encode, parts_of_job
from framework.storage import progress
from tests.conftest import Done, Framework

CONFIG = {
    "data": resolve("data", {"name": "point_cloud_folder", "points": 50}),
    "encoder": [resolve("encoder", {"name": "bps", "points": 20, "features": ["distance", "delta"]})],
}
SETTINGS = Settings(batch_size=3)


@pytest.fixture
def root(tmp_path):
    random = np.random.default_rng(0)
    for number in range(11):
        path = tmp_path / "clouds" / "ab"[number % 2] / f"{number:02}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, random.normal(size=(30 + number, 3)))
    (tmp_path / "clouds" / ".hidden").write_text("")
    return tmp_path / "clouds"


def alone(root, name):
    """Return the features of one file, encoded alone."""
    data = build("data", CONFIG["data"])
    clouds = data.read([root / name]).__getitems__([0])["input"]
    encoder = build("encoder", CONFIG["encoder"][0], input_shape=tuple(clouds.shape[1:]), input_columns=())
    return encoder(clouds)[0].numpy()


def test_rows_of_the_parts_are_the_files_by_name(root, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(progress, "QUIET_TIME", 0.0)
    monkeypatch.setattr(progress, "REPORT_INTERVAL", 0.0)
    collection = collect_files(root, tmp_path / "features", 4)
    describe(collection, CONFIG)
    assert encode(collection, CONFIG, range(3), SETTINGS) == 3
    assert re.findall(r"encoding: (\d+) of 11 files", capsys.readouterr().err) == ["3", "4", "7", "8", "11"]
    names = (tmp_path / "features" / "files.txt").read_text().splitlines()
    assert names == sorted(f"{'ab'[number % 2]}/{number:02}.npy" for number in range(11))
    rows = np.concatenate([np.load(tmp_path / "features" / f"part-{part:06}.npy") for part in range(3)])
    assert rows.shape == (11, 80) and rows.dtype == np.float32
    for row, name in zip(rows, names, strict=True):
        np.testing.assert_array_equal(row, alone(root, name))


def test_a_stopped_job_goes_on_and_jobs_share_the_parts(root, tmp_path):
    collection = collect_files(root, tmp_path / "features", 2)
    describe(collection, CONFIG)
    assert [list(parts_of_job(6, f"{job}/4")) for job in (1, 2, 3, 4)] == [[0, 4], [1, 5], [2], [3]]
    broken = collection.files(4)[1]
    content = broken.read_bytes()
    broken.write_bytes(b"no array")
    with pytest.raises(DataError, match=broken.name):
        encode(collection, CONFIG, parts_of_job(6, "1/2"), SETTINGS)
    assert collection.missing() == [1, 3, 4, 5]  # parts before it are kept
    first = collection.path(0).stat().st_mtime_ns
    broken.write_bytes(content)
    describe(collection, CONFIG)
    assert encode(collection, CONFIG, parts_of_job(6, "1/2"), SETTINGS) == 1
    assert encode(collection, CONFIG, parts_of_job(6, "2/2"), SETTINGS) == 3
    assert collection.missing() == []
    assert collection.path(0).stat().st_mtime_ns == first
    assert encode(collection, CONFIG, range(6), SETTINGS) == 0
    assert not list((tmp_path / "features").glob(".*"))  # nothing half written


@pytest.mark.parametrize("change", ["part", "encoder", "files"])
def test_parts_of_something_else_are_not_added_to(root, tmp_path, change):
    describe(collect_files(root, tmp_path / "features", 2), CONFIG)
    config, part = CONFIG, 2
    if change == "part":
        part = 3
    elif change == "encoder":
        config = {**CONFIG, "encoder": [resolve("encoder", {"name": "bps", "points": 21})]}
    else:
        np.save(root / "a" / "more.npy", np.zeros((4, 3)))
    with pytest.raises(ConfigError, match=rf"says {change} = .* do not belong to this job"):
        describe(collect_files(root, tmp_path / "features", part), config)


def test_what_cannot_be_encoded_is_refused(root, tmp_path):
    with pytest.raises(ConfigError, match="would be read as files"):
        collect_files(root, root / "a" / "features", 4)
    with pytest.raises(DataError, match="no folder with files"):
        collect_files(tmp_path / "nowhere", tmp_path / "features", 4)
    with pytest.raises(ConfigError, match=r"no job 3 of 2\. Use 1/2 to 2/2"):
        parts_of_job(6, "3/2")
    collection = collect_files(root, tmp_path / "features", 4)
    for encoders, told in (
        ([], "needs an encoder"),
        ([resolve("encoder", {"name": "pointnet"})], "pointnet is trained"),
    ):
        (tmp_path / "features").mkdir(exist_ok=True)
        with pytest.raises(ConfigError, match=told):
            encode(collection, {**CONFIG, "encoder": encoders}, range(3), SETTINGS)
    assert collection.missing() == [0, 1, 2]


def test_from_the_command_line(framework: Framework, root: Path, tmp_path: Path) -> None:
    def call(*arguments: str) -> Done:
        return framework("mode=encode", "data=point_cloud_folder", "logger=none", *arguments, folder=None)

    places = [f"mode.files={root}", "mode.into=features", "mode.part=4"]
    done = call("encoder=[bps]", "encoder.bps.points=20", *places, "mode.share=2/2")
    assert done.code == 0, done.out
    assert (
        "1 parts written, 0 of this job's 1 parts existed already; 2 of all 3 parts are missing in features"
        in done.out
    )
    assert np.load(tmp_path / "features" / "part-000001.npy").shape == (4, 20)
    described = json.loads((tmp_path / "features" / "encoding.json").read_text())
    assert described["encoder"][0]["points"] == 20 and described["files"] == 11
    (run,) = Path(tmp_path, "outputs").glob("**/run.json")
    assert json.loads(run.read_text())["status"] == "FINISHED"
    done = call("encoder=[bps]", *places, "mode.share=0/2")
    assert done.code != 0 and "mode.share" in done.out and "Traceback" not in done.out


def test_a_folder_may_hold_other_files_and_a_failure_leaves_nothing(
    framework: Framework, root: Path, tmp_path: Path
) -> None:
    (root / "README").write_text("clouds")
    (root / "a" / "angles.csv").write_text("file,pan\n00.npy,3\n")
    (root / "a" / "00.npy").write_bytes(b"damaged")
    common = (
        "mode=encode",
        "data=point_cloud_folder",
        "logger=none",
        "encoder=[bps]",
        "encoder.bps.points=20",
    )
    places = (f"mode.files={root}", "mode.into=features", "mode.part=20")
    failed = framework(*common, *places, folder=None)
    assert failed.code == 1, failed.out
    assert "00.npy" in failed.out
    assert not [*(tmp_path / "features").iterdir()], "what failed says nothing of a later attempt"
    done = framework(*common, *places, "data.unreadable=skip", folder=None)
    assert done.code == 0, done.out
    assert "2 files ignored, because they are of another kind: README, angles.csv" in done.out
    assert "1 files left out, because they cannot be read: 00.npy" in done.out
    features = tmp_path / "features"
    assert (features / "unreadable.txt").read_text() == "a/00.npy\n"
    names = (features / "files.txt").read_text().splitlines()
    assert names == sorted(f"{'ab'[number % 2]}/{number:02}.npy" for number in range(1, 11))
    assert np.load(features / "part-000000.npy").shape == (10, 20)
