"""Tests of mode=encode: parts are complete, and each file is encoded once, even with interruptions and several jobs."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.datasets.shards import open_shards, part_name
from framework.errors import ConfigError, DataError
from framework.modes.encode import (
    Collection,
    Files,
    collect_files,
    describe,
    encode,
    parts_of_job,
    require_apart,
)
from framework.storage import progress
from tests.conftest import Done, Framework

CONFIG = {
    "data": resolve("data", {"name": "point_cloud_folder", "points": 50}),
    "encoder": [resolve("encoder", {"name": "bps", "points": 20, "features": ["distance", "delta"]})],
}
BATCH = 3


@pytest.fixture
def root(tmp_path):
    random = np.random.default_rng(0)
    for number in range(11):
        path = tmp_path / "clouds" / "ab"[number % 2] / f"{number:02}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, random.normal(size=(30 + number, 3)))
    (tmp_path / "clouds" / ".hidden").write_text("")
    return tmp_path / "clouds"


def collected(root, into, part):
    """Return the collection of all files of `root`."""
    names = [file.relative_to(root).as_posix() for file in collect_files(root)]
    return Collection(Files(root, names, part, build("data", CONFIG["data"])), into)


def alone(root, name):
    """Return the features of one file, encoded alone."""
    data = build("data", CONFIG["data"])
    clouds = data.read([root / name]).__getitems__([0])["input"]
    encoder = build("encoder", CONFIG["encoder"][0], input_shape=tuple(clouds.shape[1:]), input_columns=())
    return encoder(clouds)[0].numpy()


def test_rows_of_the_parts_are_the_files_by_name(root, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(progress, "QUIET_TIME", 0.0)
    monkeypatch.setattr(progress, "REPORT_INTERVAL", 0.0)
    collection = collected(root, tmp_path / "features", 4)
    describe(collection, CONFIG)
    assert encode(collection, CONFIG, range(3), BATCH) == 3
    assert re.findall(r"encoding: (\d+) of 11 files", capsys.readouterr().err) == ["3", "4", "7", "8", "11"]
    names = (tmp_path / "features" / "files.txt").read_text().splitlines()
    assert names == sorted(f"{'ab'[number % 2]}/{number:02}.npy" for number in range(11))
    rows = np.concatenate([np.load(tmp_path / "features" / f"part-{part:06}.npy") for part in range(3)])
    assert rows.shape == (11, 80) and rows.dtype == np.float32
    for row, name in zip(rows, names, strict=True):
        np.testing.assert_array_equal(row, alone(root, name))


def test_a_stopped_job_goes_on_and_jobs_share_the_parts(root, tmp_path):
    collection = collected(root, tmp_path / "features", 2)
    describe(collection, CONFIG)
    assert [list(parts_of_job(6, f"{job}/4")) for job in (1, 2, 3, 4)] == [[0, 4], [1, 5], [2], [3]]
    broken = collection.source.files(4)[1]
    content = broken.read_bytes()
    broken.write_bytes(b"no array")
    with pytest.raises(DataError, match=broken.name):
        encode(collection, CONFIG, parts_of_job(6, "1/2"), BATCH)
    assert collection.missing() == [1, 3, 4, 5]  # parts before it are kept
    first = collection.path(0).stat().st_mtime_ns
    broken.write_bytes(content)
    describe(collection, CONFIG)
    assert encode(collection, CONFIG, parts_of_job(6, "1/2"), BATCH) == 1
    assert encode(collection, CONFIG, parts_of_job(6, "2/2"), BATCH) == 3
    assert collection.missing() == []
    assert collection.path(0).stat().st_mtime_ns == first
    assert encode(collection, CONFIG, range(6), BATCH) == 0
    assert not list((tmp_path / "features").glob(".*"))  # nothing half written


@pytest.mark.parametrize("change", ["part", "encoder", "files"])
def test_parts_of_something_else_are_not_added_to(root, tmp_path, change):
    describe(collected(root, tmp_path / "features", 2), CONFIG)
    config, part = CONFIG, 2
    if change == "part":
        part = 3
    elif change == "encoder":
        config = {**CONFIG, "encoder": [resolve("encoder", {"name": "bps", "points": 21})]}
    else:
        np.save(root / "a" / "more.npy", np.zeros((4, 3)))
    with pytest.raises(ConfigError, match=rf"says {change} = .* do not belong to this job"):
        describe(collected(root, tmp_path / "features", part), config)


def test_what_cannot_be_encoded_is_refused(root, tmp_path):
    with pytest.raises(ConfigError, match="would be read as files"):
        require_apart(root, root / "a" / "features")
    with pytest.raises(DataError, match="is not a folder with files"):
        collect_files(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=r"no job 3 of 2\. Use 1/2 to 2/2"):
        parts_of_job(6, "3/2")
    collection = collected(root, tmp_path / "features", 4)
    (tmp_path / "features").mkdir()
    with pytest.raises(ConfigError, match="pointnet is trained"):
        encode(collection, {**CONFIG, "encoder": [resolve("encoder", {"name": "pointnet"})]}, range(3), BATCH)
    selected = {**CONFIG, "encoder": [resolve("encoder", {"name": "bps", "basis": "selected"})]}
    with pytest.raises(ConfigError, match="bps with these settings is fitted to the training split"):
        encode(collection, selected, range(3), BATCH)
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
    lines = done.out.splitlines()
    begin = next(number for number, line in enumerate(lines) if line.startswith("threads: "))
    assert lines[begin + 1 : begin + 3] == [
        f"reads 11 files in {root} as point_cloud_folder",
        "encodes them by bps, and writes 1 of 3 parts, with up to 4 samples each, to features",
    ]
    assert "first inputs: shape 40×3 each, features: shape 20" in lines[begin + 3 :]
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


def call(framework: Framework, *words: str) -> Done:
    return framework("mode=encode", "logger=none", "threads=1", "batch_size=3", *words, folder=None)


ENCODER = ("encoder=[bps]", "encoder.bps.points=20", "encoder.bps.features=[distance,delta]")


def test_shards_give_the_features_of_the_files(framework: Framework, root: Path, tmp_path: Path) -> None:
    """Packed by one command and encoded by another, clouds of different sizes have the same bytes as from files."""
    data = ("data=point_cloud_folder", "data.points=50")
    packed = call(framework, *data, f"mode.files={root}", "mode.into=shards", "mode.part=4", "mode.pack=true")
    assert packed.code == 0, packed.out
    shards = open_shards(tmp_path / "shards")
    assert (shards.samples, shards.columns, shards.size(2)) == (11, ("x", "y", "z"), 3)
    assert shards.read(1).shape == (4, 40, 3)
    assert [len(batch[0]) for batch in shards.batches(1, 3)] == [40, 33], "padding that no cloud needs"
    for source, into, more in ((root, "of_files", (*data, "mode.part=4")), ("shards", "of_shards", ())):
        done = call(framework, *ENCODER, *more, f"mode.files={source}", f"mode.into={into}")
        assert done.code == 0, done.out
    for number in range(3):
        parts = [tmp_path / folder / part_name(number) for folder in ("of_files", "of_shards")]
        assert parts[0].read_bytes() == parts[1].read_bytes()
    pack = ("mode.pack=true",)
    for words, message in (
        ((*ENCODER, "mode.part=5"), "mode.part=5 has no effect"),
        ((*ENCODER, "data=point_cloud_folder"), "inputs were read with data = "),
        (pack, "a folder of shards already"),
        ((*ENCODER, *pack), "an encoder is chosen too"),
        ((), "needs an encoder"),
    ):
        done = call(framework, *words, "mode.files=shards", "mode.into=three")
        assert done.code and message in done.out, done.out
    assert not (tmp_path / "three").exists()


INDEX = {"version": 1, "files": 5, "part": 3, "columns": ["x", "y", "z"]}


def test_shards_of_another_program_are_read_and_damaged_ones_refused(tmp_path: Path) -> None:
    clouds = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    index, first = tmp_path / "encoding.json", tmp_path / part_name(0)
    np.save(first, clouds[:3])
    np.save(tmp_path / part_name(1), clouds[3:])
    for entries in (INDEX, {key: INDEX[key] for key in ("version", "files", "part")}):
        index.write_text(json.dumps(entries))
        shards = open_shards(tmp_path)
        np.testing.assert_array_equal(torch.cat([shards.read(0), shards.read(1)]).numpy(), clouds)
    shards.read(0)[:] = 0  # a private copy
    np.testing.assert_array_equal(np.load(first), clouds[:3])
    for change in ({"version": 2}, {"files": 0}, {"part": True}, {"columns": "xyz"}, {"data": []}):
        index.write_text(json.dumps({**INDEX, **change}))
        with pytest.raises(DataError, match=rf"{next(iter(change))} = .* is not valid"):
            open_shards(tmp_path)
    index.write_text(json.dumps({**INDEX, "files": 10**9, "part": 1}))
    with pytest.raises(DataError, match="names 1,000,000,000 shards"):
        open_shards(tmp_path)
    index.write_text(json.dumps({**INDEX, "encoder": [{"name": "bps"}]}))
    with pytest.raises(DataError, match="features that mode=encode has computed"):
        open_shards(tmp_path)
    index.write_text(json.dumps(INDEX))
    shards = open_shards(tmp_path)
    for array, message in (
        (clouds[:2], "holds 3 samples"),
        (clouds[:3, :, :2], "names 3 columns"),
        (clouds[:3].astype(object), "no objects"),
        (clouds[:3].astype(">f4"), "cannot be read as a shard"),
    ):
        np.save(first, array)
        with pytest.raises(DataError, match=message):
            shards.read(0)
    np.save(first, clouds[:3])
    first.write_bytes(first.read_bytes()[:-1])
    with pytest.raises(DataError, match="takes 252 bytes, but only 251"):
        shards.read(0)
    for path in (first, index):
        moved = path.rename(tmp_path / "elsewhere")
        path.symlink_to(moved)
        with pytest.raises(DataError, match="is a link"):
            open_shards(tmp_path).read(0)
        moved.replace(path)
    first.unlink()
    with pytest.raises(DataError, match="the index of the folder names more shards"):
        shards.read(0)
