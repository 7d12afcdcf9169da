"""A trained model is tested on all labelled files of a further folder: the same way for every source of files."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from framework.configuration.schema import build, resolve
from framework.data import Data
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


def sizes(data: Data) -> list[int]:
    return [len(part) for part in data.splits()]  # type: ignore[arg-type]


@pytest.mark.parametrize("name", SOURCES)
def test_a_trained_model_is_tested_on_all_files_of_another_folder(name: str, tmp_path: Path) -> None:
    trained = prepared(name, **written(name, tmp_path / "first"))
    settings = written(name, tmp_path / "second")
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
    assert not any("data.test=1" in remark for remark in every.remarks)


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
