"""Tests of sweeps, which check the user's files before their jobs start."""

import inspect
from pathlib import Path

import pytest

from framework.configuration.composition import plain
from framework.configuration.registry import installed, load
from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.sweeps.rehearsal import refuse_mistakes
from tests.test_composition import composed

BAD = {
    "a word too many": ("train", "validation", "test", "tset"),
    "one without": ("train", "validation", "test", ""),
    "none for test": ("train", "validation", "train", "train"),
}


def table(folder: Path, splits: tuple[str, ...]) -> None:
    rows = [f"{row}.png,{row * row % 7 * 40},{splits[row % 4]},{'ab'[row // 4 % 2]}" for row in range(40)]
    (folder / "angles.csv").write_text("\n".join(["file,a,split,y", *rows]), encoding="utf-8")


@pytest.mark.parametrize("name", BAD)
def test_data_look_at_the_column_split_of_their_table(tmp_path: Path, name: str) -> None:
    table(tmp_path, BAD[name])
    file = str(tmp_path / "angles.csv")
    with pytest.raises(DataError, match=r"angles\.csv.*split"):
        build("data", resolve("data", {"name": "tabular", "path": file, "target": "y"})).check_files()
    if name != "none for test":  # images may be unreadable: that split is empty is known when they are read
        with pytest.raises(DataError, match=r"angles\.csv.*split"):
            build(
                "data", resolve("data", {"name": "images_with_angles", "root": str(tmp_path)})
            ).check_files()


def test_a_sweep_refuses_an_incomplete_column_split_before_any_job(tmp_path: Path) -> None:
    table(tmp_path, BAD["one without"])
    overrides = [
        "data=tabular", f"data.path={tmp_path / 'angles.csv'}", "data.target=y", "encoder=[mlp]",
        "density_head=categorical", "metric=[accuracy]", "logger=none",
    ]  # fmt: skip
    with pytest.raises(ConfigError, match=r"angles\.csv line 5.*split.* No job of the sweep was run"):
        refuse_mistakes([(overrides, plain(composed(*overrides)))])


ROOTS = [
    name
    for name in installed("data")
    if {"root", "path"} & inspect.signature(load("data", name).__init__).parameters.keys()
]


@pytest.mark.parametrize("name", ROOTS)
@pytest.mark.parametrize("kind", ["missing", "wrong"])
def test_a_sweep_refuses_missing_and_wrong_files_of_every_data_set_before_any_job(
    tmp_path: Path, name: str, kind: str
) -> None:
    """Compare `check_files`, which a sweep calls before its jobs, with `prepare`."""
    (tmp_path / "x.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    (tmp_path / "note.txt").write_text("This is no data set.", encoding="utf-8")
    parameters = inspect.signature(load("data", name).__init__).parameters
    if "root" in parameters:
        config = {"root": str(tmp_path if kind == "wrong" else tmp_path / "missing")}
    else:
        config = {"path": str(tmp_path / ("x.csv" if kind == "wrong" else "missing.csv")), "target": "y"}
    data = build("data", resolve("data", {"name": name, **config}))
    with pytest.raises(DataError) as checked:
        data.check_files()
    with pytest.raises(DataError) as prepared:
        data.prepare()
    assert str(checked.value) == str(prepared.value)
