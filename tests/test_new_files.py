"""A trained model is tested on all labelled files of a further folder: the same way for every source of files."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.datasets.new_files import (
    DIGITS,
    READ_WHOLE,
    Trained,
    hash_contents,
    leave_out_trained,
)
from framework.errors import ConfigError, DataError
from framework.testing.contract import contract
from framework.testing.data_samples import prepared
from framework.testing.rows import DataRow


def drop_a_file(folder: Path) -> None:
    next(file for file in sorted(folder.rglob("*.*")) if file.is_file()).unlink()


def change_a_number(folder: Path) -> None:
    (table,) = folder.glob("*.csv")
    lines = table.read_text(encoding="utf-8").splitlines()
    first, *cells = lines[1].split(",")
    cells[0] = "7"
    table.write_text("\n".join([lines[0], ",".join([first, *cells]), *lines[2:]]), encoding="utf-8")


SOURCES: dict[str, Callable[[Path], None]] = {
    "image_folder": drop_a_file,
    "turned_images": drop_a_file,
    "point_cloud_folder": drop_a_file,
    "labelled_points": drop_a_file,
    "images_with_angles": change_a_number,
    "tabular": change_a_number,
}
"""Sources of labelled files, each with a function that changes some of the files that its contract row writes."""


def written(name: str, folder: Path) -> dict[str, Any]:
    """Write the files of the first contract row of a source, and return the settings that read them."""
    (row, *_) = contract("data", name).rows
    assert isinstance(row, DataRow) and row.write is not None
    folder.mkdir()
    config = {key: value for key, value in row.config.items() if key != "policy"}  # needs a further package
    return {**config, **row.write(folder)}


def for_model(trained: Data, name: str, settings: Mapping[str, Any]) -> Data:
    """Return the data set of a model that was trained on `trained`, before `prepare`."""
    data: Data = build("data", resolve("data", {"name": name, **settings}))
    data.load_state_dict(trained.state_dict())
    return data


def written_anew(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Write files as `written`, but with other random numbers."""
    generator = np.random.default_rng
    with monkeypatch.context() as patched:
        patched.setattr(np.random, "default_rng", lambda seed: generator([seed, 99]))
        return written(name, folder)


def sizes(data: Data) -> list[int]:
    """Return the number of files of each split; rows of a table count as files."""
    return [len(getattr(part, "scans", part)) for part in data.splits()]  # type: ignore[arg-type]


@pytest.mark.parametrize("name", SOURCES)
def test_a_trained_model_is_tested_on_all_files_of_another_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = prepared(name, **written(name, tmp_path / "first"))
    settings = written_anew(name, tmp_path / "second", monkeypatch)
    SOURCES[name](tmp_path / "second")
    share = for_model(trained, name, settings)
    share.prepare()
    count = sum(sizes(share))
    assert 0 < sizes(share)[2] < count
    assert any(
        f"{sizes(share)[2]} of its {count}" in x and "data.test=1 makes all" in x for x in share.remarks
    )
    every = for_model(trained, name, {**settings, "test": 1})
    every.prepare()
    assert sizes(every) == [0, 0, count]
    assert every.target.names == trained.target.names
    assert not any("data.test=1" in x or "trained on" in x for x in every.remarks)


@pytest.mark.parametrize("name", sorted(SOURCES.keys() - {"tabular"}))
def test_files_that_the_model_was_trained_on_are_not_tested(name: str, tmp_path: Path) -> None:
    """Test on a copy of the training folder with one file less, or with another table."""
    trained = prepared(name, **written(name, tmp_path / "first"))
    settings = written(name, tmp_path / "second")
    SOURCES[name](tmp_path / "second")
    fewer = SOURCES[name] is drop_a_file
    every = for_model(trained, name, {**settings, "test": 1})
    every.prepare()
    tested, of_training = sizes(every)[2], sizes(trained)[2]
    assert of_training - fewer <= tested <= of_training
    left_out = sum(sizes(trained)) - fewer - tested
    assert f"left out of the test: {left_out} files that the model was trained on" in every.remarks
    if name == "images_with_angles":  # the name of a file chooses its split, which is that of the training
        return
    share = for_model(trained, name, {**settings, "test": 0.5})
    share.prepare()
    assert 0 < sizes(share)[2] < sum(sizes(trained)) // 2
    assert any(x.startswith("left out of the test: ") for x in share.remarks)


def test_test_files_that_a_folder_states_are_counted_and_tested() -> None:
    hashes = [f"{number:016x}" for number in range(4)]
    splits = np.array(["train", "validation", "test", "test"])
    trained = Trained.on("first", (), hashes, splits)
    assert trained.has([*hashes, "0" * 15 + "9"]).tolist() == [True, True, False, False, False]
    every, source = np.full(4, "test"), Path("folder")
    chosen, remarks = leave_out_trained(every, every, hashes, trained, "second", source)
    assert chosen.tolist() == every.tolist()
    assert "2 of the 4 test files have the content of files for training or validation" in remarks[0]
    unstated = np.full(4, "")
    chosen, remarks = leave_out_trained(unstated, every, hashes, trained, "second", source)
    assert chosen.tolist() == ["left out", "left out", "test", "test"] and len(remarks) == 1
    with pytest.raises(DataError, match="trained on each of the 2 files that are to be tested"):
        leave_out_trained(unstated[:2], every[:2], hashes[:2], trained, "second", source)
    copies = [hashes[0], hashes[1], hashes[0], hashes[3]]  # within the folder of the training
    chosen, remarks = leave_out_trained(unstated, splits, copies, None, "first", source)
    assert chosen.tolist() == splits.tolist() and "1 of the 2 test files" in remarks[0]


def test_files_with_the_same_content_have_the_same_hash(tmp_path: Path) -> None:
    size = READ_WHOLE + 1
    contents = [b"", b"a", bytes(size), bytes(size - 1), bytes(size - 1) + b"a", b"a" + bytes(size - 1)]
    files = [tmp_path / f"{number}" for number in range(len(contents))]
    for file, content in zip(files, contents, strict=True):
        file.write_bytes(content)
    hashes = hash_contents(files)
    assert len(set(hashes)) == len(files) and {len(one) for one in hashes} == {DIGITS}
    files[0].write_bytes(contents[2])
    assert hash_contents([files[0], tmp_path / "none", tmp_path]) == [hashes[2], "", ""]


@pytest.mark.parametrize("name", SOURCES)
def test_all_files_are_tested_only_by_a_model_that_was_trained_on_others(name: str, tmp_path: Path) -> None:
    settings = written(name, tmp_path / "first")
    trained = prepared(name, **settings)
    with pytest.raises(DataError, match="there is no trained model"):
        prepared(name, **settings, test=1)
    same = for_model(trained, name, {**settings, "test": 1})
    with pytest.raises(DataError, match=r"data\.test=1 makes all .* but the model was trained on th"):
        same.prepare()
    again = for_model(trained, name, settings)
    again.prepare()
    assert sizes(again) == sizes(trained) and again.fingerprint() == trained.fingerprint()
    with pytest.raises(DataError, match=r"[Ss]tored state of \w+ must hold"):
        again.load_state_dict({"content": 3, "columns": []})
    if name != "tabular":
        with pytest.raises(DataError, match=r"[Ss]tored state of \w+ must hold"):
            again.load_state_dict({**trained.state_dict(), "files": "abc"})


@pytest.mark.parametrize("name", ["image_folder", "turned_images", "point_cloud_folder"])
def test_a_folder_of_test_files_suffices_for_a_trained_model(name: str, tmp_path: Path) -> None:
    trained = prepared(name, **written(name, tmp_path / "first"))
    settings = written(name, tmp_path / "second")
    root = tmp_path / "second"
    removed, *others = sorted(root.iterdir())
    (root / "test").mkdir()
    for folder in (removed, *others):
        folder.rename(root / "test" / folder.name)
    with pytest.raises(DataError, match="holds no folder train"):
        prepared(name, **settings)
    for folder in (root / "test" / removed.name).iterdir():
        folder.unlink()
    (root / "test" / removed.name).rmdir()
    data = for_model(trained, name, settings)
    data.prepare()
    assert sizes(data)[:2] == [0, 0] and sizes(data)[2] == sum(1 for file in root.rglob("*.*"))
    assert any("test files have the content of files for training or validation" in x for x in data.remarks)
    assert data.target.names == trained.target.names
    if data.target.kind == "class":  # the files of the second class keep its number
        assert {int(data.splits().test[index]["target"]) for index in range(sizes(data)[2])} == {1}
        (root / "test" / others[0].name).rename(root / "test" / "unknown")
        strange = for_model(trained, name, settings)
        with pytest.raises(DataError, match=r"does not know the class '?unknown"):
            strange.prepare()
        (root / "test" / "unknown").rename(root / "test" / others[0].name)
    stated = for_model(trained, name, {**settings, "test": 1})
    with pytest.raises((DataError, ConfigError), match=r"data\.test=1 has no effect.*Leave data\.test out"):
        stated.prepare()
