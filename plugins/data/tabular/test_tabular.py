"""Tests of a user's table: what is read and refused, and a whole run on it."""

import csv
import json
import math
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.impute import SimpleImputer
from sklearn.preprocessing import StandardScaler

from framework.configuration.schema import build, resolve
from framework.datasets.fields import Fields
from framework.errors import ConfigError, DataError
from framework.testing.commands import run_commands
from framework.testing.data_samples import fields_of
from plugins.data.tabular.data import Tabular
from plugins.data.tabular.picture import HEIGHT, bars
from plugins.data.tabular.table import Standardise, fit_scaling, standardise

SPLITS = ("train", "validation", "test")
ROWS = 40


def table(folder: Path, text: str | None = None, rows: int = ROWS) -> Path:
    """Write a table, and return its file.

    Without `text`, the columns are a number, its square, a word, a constant, and three columns for the target.
    """
    lines = ["number,square,word,same,class,real,angle"]
    for row in range(rows):
        label = ("cat", "dog", "emu")[row % 3]
        lines.append(f"{row},{row * row},{'abc'[row % 3]},7,{label},{row / 2 - 3},{20 * row - 360}")
    file = folder / "mine.csv"
    file.write_text("\n".join(lines) if text is None else text, encoding="utf-8")
    return file


def build_data(file: Path, **config: Any) -> Tabular:
    return build("data", resolve("data", {"name": "tabular", "path": str(file), "target": "class", **config}))


def prepare_data(file: Path, **config: Any) -> Tabular:
    data = build_data(file, **config)
    data.prepare()
    return data


def test_a_table_is_split_and_standardised_by_its_training_rows(tmp_path: Path) -> None:
    data = prepare_data(table(tmp_path), columns=None, target="class")
    assert data.input_shape == (5,)  # number, square, same, real and angle; words are not read
    assert data.target.kind == "class"
    assert data.target.names == ("cat", "dog", "emu")
    assert data.groups == ("mine",)
    assert [len(fields_of(data, name)["index"]) for name in SPLITS] == [28, 6, 6]
    rows = {name: fields_of(data, name)["line"].numpy() - 2 for name in SPLITS}
    assert sorted(np.concatenate(list(rows.values())).tolist()) == list(range(ROWS))
    columns = np.array([[row, row * row, 7, row / 2 - 3, 20 * row - 360] for row in range(ROWS)])
    trained = columns[rows["train"]]
    for name in SPLITS:
        expected = (columns[rows[name]] - trained.mean(0)) / np.where(trained.std(0) > 0, trained.std(0), 1)
        np.testing.assert_allclose(fields_of(data, name)["input"], expected, atol=1e-6)
        assert fields_of(data, name)["target"].tolist() == (rows[name] % 3).tolist()
        assert fields_of(data, name)["group"].tolist() == [0] * len(rows[name])
    assert data.fingerprint()["constant"] == "same"
    assert data.fingerprint()["columns"] == "number, square, same, real, angle"


def test_the_data_seed_determines_the_random_split(tmp_path: Path) -> None:
    file = table(tmp_path)
    lines = [fields_of(prepare_data(file, data_seed=seed), "test")["line"].tolist() for seed in (0, 0, 1)]
    assert lines[0] == lines[1] != lines[2]
    shares = prepare_data(file, validation=0.25, test=0.5)
    assert [len(fields_of(shares, name)["index"]) for name in SPLITS] == [10, 10, 20]
    assert (
        prepare_data(file).fingerprint()["sha256"] != prepare_data(file, data_seed=1).fingerprint()["sha256"]
    )


def test_reals_keep_their_unit_and_degrees_become_radians(tmp_path: Path) -> None:
    file = table(tmp_path)
    reals = prepare_data(file, target="real", kind="real")
    assert (reals.target.kind, reals.target.names) == ("real", ("real",))
    train = fields_of(reals, "train")
    np.testing.assert_array_equal(train["target"][:, 0], (train["line"] - 2) / 2 - 3)
    angle = prepare_data(file, target="angle", kind="degrees")
    assert (angle.target.kind, angle.target.names) == ("angle", ("angle",))
    train = fields_of(angle, "train")
    degrees = 20 * (train["line"].double() - 2) - 360
    error = train["target"][:, 0].double() - torch.deg2rad(degrees)
    np.testing.assert_allclose(torch.remainder(error + 1, 2 * math.pi) - 1, 0, atol=1e-6)
    assert train["target"].abs().max() <= math.pi + 1e-6
    several = prepare_data(file, target=["real", "number"], kind="real")
    assert several.target.names == ("real", "number")
    assert fields_of(several, "train")["target"].shape == (28, 2)
    assert several.input_shape == (3,)


def test_angles_of_many_turns_keep_their_digits(tmp_path: Path) -> None:
    text = "x,angle\n" + "\n".join(f"{row},{360 * 10**9 * (row - 20) + row}" for row in range(40))
    angle = prepare_data(table(tmp_path, text), target="angle", kind="degrees")
    for name in SPLITS:
        expected = torch.deg2rad((fields_of(angle, name)["line"] - 2).double())
        np.testing.assert_allclose(fields_of(angle, name)["target"][:, 0], expected, atol=1e-6)


def test_landmarks_and_head_poses_beyond_half_a_turn(tmp_path: Path) -> None:
    # a table as of AFLW2000: a file name, landmarks in pixels, and a few poses beyond ±180°
    landmarks = [f"{axis}{number}" for number in range(1, 5) for axis in "xy"]
    poses = np.random.default_rng(0).normal(0, (20, 45, 15), (40, 3)).round(3)
    poses[3], poses[17] = (190.5, -200.25, 10), (-12, 350, -365)
    lines = [",".join(["image", *landmarks, "pitch", "yaw", "roll"])]
    for row, pose in enumerate(poses):
        lines.append(",".join(map(str, [f"image{row:05d}.jpg", *range(row, row + 8), *pose])))
    data = prepare_data(table(tmp_path, "\n".join(lines)), target=["pitch", "yaw", "roll"], kind="degrees")
    assert (data.target.kind, data.target.names) == ("angle", ("pitch", "yaw", "roll"))
    assert data.input_shape == (8,)  # the names of the images are not read
    for name in SPLITS:
        fields = fields_of(data, name)
        expected = (poses[fields["line"].numpy() - 2] + 180) % 360 - 180
        np.testing.assert_allclose(np.degrees(fields["target"].double().numpy()), expected, atol=1e-4)


def test_splits_and_groups_come_from_columns_of_these_names(tmp_path: Path) -> None:
    lines = ["split,group,x,class"]
    lines += [f"{SPLITS[row % 3]},{(10, 9, 'b')[row % 5 % 3]},{row},{row // 3 % 2}" for row in range(60)]
    data = prepare_data(table(tmp_path, "\n".join(lines)))
    assert data.input_shape == (1,)
    assert data.groups == ("9", "10", "b")  # numbers by size
    for index, name in enumerate(SPLITS):
        row = fields_of(data, name)["line"] - 2
        assert (row % 3 == index).all()
        expected = [{"10": 1, "9": 0, "b": 2}[("10", "9", "b")[int(number) % 5 % 3]] for number in row]
        assert fields_of(data, name)["group"].tolist() == expected


@pytest.mark.parametrize("words", ["train,validation,test", "Train,Val,Test", "TRAINING,dev,eval"])
@pytest.mark.parametrize("name", ["Split", "set", "usage"])
def test_a_column_of_splits_with_another_name_is_refused(tmp_path: Path, name: str, words: str) -> None:
    """Otherwise test rows would be used for training without notice, or be an input with data.words=levels."""
    rows = "\n".join(f"{row},{row % 2},{words.split(',')[row % 3]}" for row in range(ROWS))
    file = table(tmp_path, f"number,class,{name}\n{rows}")
    for settings_of_words in ({}, {"words": "levels"}):
        with pytest.raises(
            DataError, match=rf"mine\.csv: The column '{name}' seems to assign each row to a split"
        ):
            prepare_data(file, **settings_of_words)
    prepare_data(table(tmp_path, f"number,class,{name}\n" + rows.replace(words.split(",")[1], "other")))


def test_classes_of_similar_names_are_refused_or_reported(tmp_path: Path) -> None:
    def write(*labels: str) -> Path:
        rows = "\n".join(f"{row},{labels[row % len(labels)]}" for row in range(ROWS))
        return table(tmp_path, f"number,class\n{rows}")

    assert any(
        "'No' and 'no' differ only" in remark for remark in prepare_data(write("no", "yes", "No")).remarks
    )
    with pytest.raises(DataError, match=r"mine\.csv, column 'class': The classes .* look the same"):
        prepare_data(write("café", "cafe\u0301"))


def test_labels_are_ordered_by_size_where_they_are_numbers(tmp_path: Path) -> None:
    text = "x,class\n" + "\n".join(f"{row},{(10, 2, -1)[row % 3]}" for row in range(60))
    data = prepare_data(table(tmp_path, text))
    assert data.target.names == ("-1", "2", "10")
    row = fields_of(data, "test")["line"] - 2
    assert fields_of(data, "test")["target"].tolist() == [(2, 1, 0)[int(number) % 3] for number in row]


def with_cell(cell: str, line: int = 5, column: int = 0) -> str:
    """Return a good table in which one cell is replaced."""
    lines = [f"{row},{row + 1},{'ab'[row % 2]}" for row in range(ROWS)]
    cells = lines[line - 2].split(",")
    cells[column] = cell
    lines[line - 2] = ",".join(cells)
    return "\n".join(["x,y,class", *lines])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "mine.csv is empty"),
        ("x,class", "has no row below its first line"),
        ("x class\n1 2", "is separated by blanks"),
        ("x,x,class\n1,2,a", "the column 'x' is named twice"),
        (
            "x,klass\n1,a",
            r"data\.target names the column 'class', which .*mine\.csv does not have\. Did you mean 'klass'\?",
        ),
        ("word,class\na,b\nc,d", "has no column of numbers besides class"),
        (with_cell("abc"), r"mine\.csv line 5, column 'x': 'abc' is not a finite number"),
        (
            with_cell(""),
            r"line 5, column 'x': The cell is empty, but .* Or set data\.missing=median to fill .*, or set "
            r"data\.missing=skip to leave such rows out",
        ),
        (with_cell("nan", 7, 1), r"line 7, column 'y': 'nan' is not a finite number"),
        (with_cell("-inf", 7, 1), r"line 7, column 'y': '-inf' is not a finite number"),
        (with_cell("1,2"), r"line 5: the line has 4 cells, but the first line names 3"),
        (
            with_cell("", 9, 2),
            r"line 9, column 'class': The label is missing\. Write a label, or set data\.missing=skip",
        ),
        ("x,class\n" + "1,a\n" * 9, "All rows have the label 'a', but at least two classes"),
        (
            "x,class\n" + "\n".join(f"{row},name {row}" for row in range(50)),
            "50 different labels in 50 rows are not",
        ),
        (
            "x,class\n" + "\n".join(f"{row},{row / 7}" for row in range(50)),
            r"50 different numbers in 50 rows are not classes\. Set data\.kind=real",
        ),
        ("x,class\n1,a\n2,b", r"The validation split is empty \(2 rows are used\)\. Add rows"),
        ("split,x,class\ntrain,1,a\ntest,2,b", r"The validation split is empty .* column `split`"),
        ("x,Class\n1,a\n2,b", r"data\.target names the column 'class', .* Did you mean 'Class'\?"),
        (
            "split,x,class\ntrain,1,a\ntset,2,b",
            r"line 3, column `split`: 'tset' is not a split\. .* Did you mean 'test'\?",
        ),
        ("group,x,class\na,1,a\n,2,b", r"line 3, column `group`: The name is missing"),
        (
            "group,x,class\na,1,a\nNA,2,b",
            r"line 3, column `group`: 'NA' means that .* data\.missing_words=\[\]",
        ),
        *(
            (
                with_cell(word, 9, 2),
                rf"line 9, column 'class': '{word}' means that .* data\.missing_words=\[\]",
            )
            for word in ("nan", "NA", "N/A", "None", "null", "NaN", "-")
        ),
        (with_cell("1", 9, 2).replace(",b", ",1.0"), r"labels '1' and '1\.0' are the same number"),
        (
            "x,class\n" + "\n".join(f"{row},{max(row - 30, 0) if row < 45 else 3}" for row in range(90)),
            r"No training row has the label '\d+', so .* The labels look like numbers; set data\.kind=real",
        ),
        (with_cell("1e300", 3), r"line 3, column 'x': '1e300' lies beyond single precision"),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    file = table(tmp_path, text)
    with pytest.raises(DataError, match=message):
        prepare_data(file)


@pytest.mark.parametrize(
    ("cells", "words"),
    [("2024-05-01", "dates"), ("1.5.2024", "dates"), ("high", "words"), ("3 or 4", "words")],
)
def test_a_column_without_numbers_is_no_real_target(tmp_path: Path, cells: str, words: str) -> None:
    file = table(tmp_path, "x,y\n" + f"1,{cells}\n" * 30)
    with pytest.raises(DataError, match=f"column 'y': The column holds {words} such as '{cells}'"):
        prepare_data(file, target="y", kind="real")


def test_every_class_keeps_a_training_row(tmp_path: Path) -> None:
    text = with_cell("c", 4, 2)
    # a seed that puts line 4 into the test split
    seed = next(seed for seed in count() if 2 in np.random.default_rng(seed).permutation(ROWS)[6:12].tolist())
    data = prepare_data(table(tmp_path, text), data_seed=seed)
    assert data.target.names == ("a", "b", "c")
    assert fields_of(data, "train")["line"][fields_of(data, "train")["target"] == 2].tolist() == [4]
    assert any("moved to the training split: 'c'" in remark for remark in data.remarks)
    others = prepare_data(table(tmp_path, with_cell("a", 4, 2)), data_seed=seed)
    lines = [set(fields_of(either, "train")["line"].tolist()) for either in (data, others)]
    assert lines[0] - lines[1] == {4}


def test_without_rows_for_validation_a_share_of_the_training_rows_is_chosen(tmp_path: Path) -> None:
    text = "split,x,class\n" + "\n".join(
        f"{'test' if row % 4 == 0 else 'train'},{row},{'ab'[row % 2]}" for row in range(40)
    )
    data = prepare_data(table(tmp_path, text), validation=0.2)
    lines = {name: fields_of(data, name)["line"].numpy() - 2 for name in SPLITS}
    assert [len(lines[name]) for name in SPLITS] == [24, 6, 10]
    assert sorted(lines["test"]) == list(range(0, 40, 4))
    assert len(np.unique(np.concatenate([*lines.values()]))) == 40
    assert any(
        "6 of 30 training rows are used for validation, because data.validation=0.2" in remark
        for remark in data.remarks
    )


def test_a_trained_model_is_tested_on_all_rows_of_another_table(tmp_path: Path) -> None:
    trained = prepare_data(table(tmp_path), columns=["number"])
    state = dict(trained.state_dict())
    (tmp_path / "other").mkdir()

    def prepare_other(text: str, **config: Any) -> Tabular:
        data = build_data(table(tmp_path / "other", text), columns=["number"], **config)
        data.load_state_dict(state)
        data.prepare()
        return data

    rows = [f"{row},{('cat', 'dog')[row % 2]}" for row in range(20)]  # no row of the third class
    for text, config in (
        ("\n".join(["number,class", *rows]), {"test": 1}),
        ("\n".join(["split,number,class", *(f"test,{row}" for row in rows)]), {}),
    ):
        data = prepare_other(text, **config)
        assert data.target == trained.target
        assert [len(fields_of(data, name)["line"]) for name in SPLITS] == [0, 0, 20]
        assert fields_of(data, "test")["target"].tolist() == [0, 1] * 10
        expected = fields_of(trained, "train")
        slope, start = np.polyfit(expected["line"] - 2, expected["input"][:, 0], 1)
        np.testing.assert_allclose(
            fields_of(data, "test")["input"][:, 0], start + slope * np.arange(20), atol=1e-5
        )
    part = prepare_other("\n".join(["number,class", *rows]))
    assert len(fields_of(part, "test")["line"]) == 3
    assert any(
        "3 of its 20 rows, chosen at random, are the test split; data.test=1" in x for x in part.remarks
    )
    with pytest.raises(DataError, match=r"line 22, column 'class': The model does not know the class 'bird'"):
        prepare_other("\n".join(["number,class", *rows, "3,bird"]))
    with pytest.raises(DataError, match=r"data\.test=1 has no effect, because the column `split`"):
        prepare_other("\n".join(["split,number,class", *(f"test,{row}" for row in rows)]), test=1)
    with pytest.raises(DataError, match="The test split is empty"):
        prepare_other("\n".join(["split,number,class", *(f"train,{row}" for row in rows)]))
    same = build_data(table(tmp_path), columns=["number"])
    same.load_state_dict(state)
    same.prepare()
    assert not any("training table" in remark for remark in same.remarks)
    assert same.fingerprint() == trained.fingerprint()
    refused = build_data(table(tmp_path), columns=["number"], test=1)
    refused.load_state_dict(state)
    with pytest.raises(DataError, match="the model was trained on this table"):
        refused.prepare()
    with pytest.raises(DataError, match="there is no trained model"):
        prepare_data(table(tmp_path), test=1)


@pytest.mark.parametrize("wrong", [{"labels": "ab"}, {"labels": [1]}, {"labels": None}, {"content": 3}])
def test_stored_labels_are_checked(tmp_path: Path, wrong: dict[str, Any]) -> None:
    state = prepare_data(table(tmp_path)).state_dict()
    assert state["labels"] == ["cat", "dog", "emu"]
    with pytest.raises(DataError, match="The stored state of tabular"):
        build_data(table(tmp_path)).load_state_dict({**state, **wrong})


def test_a_constant_target_is_reported(tmp_path: Path) -> None:
    data = prepare_data(table(tmp_path), target=["same", "real"], kind="real")
    assert [remark for remark in data.remarks if "nothing can be learned" in remark] == [
        "'same' is 7 in all training rows, so that nothing can be learned about it"
    ]


def test_missing_words_determine_which_words_are_labels(tmp_path: Path) -> None:
    text = "x,class\n" + "\n".join(f"{row},{('none', 'mild', 'NA')[row % 3]}" for row in range(60))
    data = prepare_data(table(tmp_path, text), missing_words=[])
    assert data.target.names == ("NA", "mild", "none")
    skipping = prepare_data(table(tmp_path, text), missing_words=["na"], missing="skip")
    assert (skipping.target.names, skipping.skipped) == (("mild", "none"), 20)


@pytest.mark.parametrize("kind", ["degrees", "radians"])
def test_angles_in_the_other_unit_are_refused(tmp_path: Path, kind: str) -> None:
    degrees = np.linspace(-180, 180, 61).round(3)
    values = {"degrees": np.deg2rad(degrees).round(4), "radians": degrees}[kind]
    text = "x,angle\n" + "\n".join(f"{row * row},{value}" for row, value in enumerate(values))
    file = table(tmp_path, text)
    other = {"degrees": "radians", "radians": "degrees"}[kind]
    with pytest.raises(DataError, match=rf"column 'angle': .* looks like {other}, .* Set data\.kind={other}"):
        prepare_data(file, target="angle", kind=kind)
    data = prepare_data(file, target="angle", kind=other)
    angle, line = (fields_of(data, "train")[name] for name in ("target", "line"))
    error = angle[:, 0].double() - torch.deg2rad(torch.from_numpy(degrees)[line - 2])
    np.testing.assert_allclose(torch.remainder(error + 1, 2 * math.pi) - 1, 0, atol=1e-3)
    if kind == "degrees":
        prepare_data(file, target="angle", kind=kind, small_angles=True)
        with pytest.raises(DataError, match=r"small_angles=true has no effect with data\.kind=real"):
            prepare_data(file, target="angle", kind="real", small_angles=True)


def test_remarks_name_the_target_and_the_columns_that_are_left_out(tmp_path: Path) -> None:
    text = "Unnamed: 0,a,flag,note,none,class\n"
    text += "\n".join(
        f"{row + 5},{row * row % 7},{('TRUE', 'false')[row % 2]},w,,{'ab'[row % 2]}" for row in range(40)
    )
    data = prepare_data(table(tmp_path, text))
    assert data.columns == ("a", "flag")
    assert data.remarks == (
        "predicted: the column 'class', data.kind=class",
        "left out: 'Unnamed: 0' (row numbers; name it in data.columns to read it), 'note' (words), 'none' (empty)",
        "'flag' holds TRUE and FALSE, read as 1 and 0",
    )


@pytest.mark.parametrize(
    ("form", "words", "advice"),
    [
        ("2024-01-{0:02d}", "leave_out", r"holds dates such as '2024-01-01', .* days since the first date"),
        ("2024-{1:02d}-{0:02d}", "levels", r"holds dates such as '2024-00-01', .* days since the first date"),
        ("w{0}", "leave_out", r"holds words such as 'w1', .* To read words, set data\.words=levels"),
        ("w{0}", "levels", ""),
        ("w{0}_{1}", "leave_out", r"It has 80 different words, but data\.words=levels reads 2 to 50"),
        ("w{0}_{1}", "levels", r"It has 80 different words, but data\.words=levels reads 2 to 50"),
        ("same", "levels", r"It has 1 different words, but data\.words=levels reads 2 to 50"),
        ("{0}.5", "leave_out", ""),
    ],
)
def test_named_columns_that_hold_no_numbers_are_refused_with_what_helps(
    tmp_path: Path, form: str, words: str, advice: str
) -> None:
    file = tmp_path / "mine.csv"
    rows = [f"{form.format(row % 9 + 1, row)},{row / 4},{row}" for row in range(80)]
    file.write_text("\n".join(["named,x,y", *rows]), encoding="utf-8")
    settings = {"target": "y", "kind": "real", "words": words}
    if advice:
        with pytest.raises(DataError, match=rf"mine\.csv, column 'named': data\.columns names .*{advice}"):
            prepare_data(file, columns=["named", "x"], **settings)
    else:
        assert len(prepare_data(file, columns=["named", "x"], **settings).columns) >= 2


def test_settings_that_do_not_fit_the_table_are_refused(tmp_path: Path) -> None:
    file = table(tmp_path)
    with pytest.raises(
        DataError, match=r"data\.columns names the column 'nomber', .* Did you mean 'number'\?"
    ):
        prepare_data(file, columns=["nomber"])
    with pytest.raises(DataError, match=r"data\.columns names 'class', but this column is the target"):
        prepare_data(file, columns=["number", "class"])
    with pytest.raises(
        DataError, match=r"'word': .* holds words such as 'a', .* set data\.words=levels, or remove"
    ):
        prepare_data(file, columns=["word"])
    with pytest.raises(
        DataError, match=r"'class': The column holds words such as 'cat', .*experiment=tabular/classification"
    ):
        prepare_data(file, kind="real")
    with pytest.raises(DataError, match=r"data\.target = \['class', 'word'\] does not fit data\.kind=class"):
        prepare_data(file, target=["class", "word"])
    with pytest.raises(DataError, match=r"data\.target = \[\]"):
        prepare_data(file, target=[], kind="real")
    with pytest.raises(DataError, match="the sum must be less than 1"):
        prepare_data(file, validation=0.5, test=0.5)
    with pytest.raises(DataError, match="has no column of numbers besides"):
        prepare_data(file, columns=[])


@pytest.mark.parametrize("cell", ["", "NA", "nan", "?"])
def test_missing_skip_leaves_out_rows_without_a_number(tmp_path: Path, cell: str) -> None:
    lines = with_cell(cell).splitlines()
    lines[10] = lines[10].replace(",a", ",").replace(",b", ",")
    data = prepare_data(table(tmp_path, "\n".join(lines)), missing="skip")
    assert data.skipped == 2
    used_lines = torch.cat([fields_of(data, name)["line"] for name in SPLITS])
    assert sorted(used_lines.tolist()) == [line for line in range(2, ROWS + 2) if line not in (5, 11)]
    reals = prepare_data(
        table(tmp_path, with_cell(cell)), missing="skip", target="x", kind="real", columns=["y"]
    )
    assert reals.skipped == 1
    with pytest.raises(DataError, match="line 5, column 'x': 'inf'"):
        prepare_data(table(tmp_path, with_cell("inf")), missing="skip")
    with pytest.raises(DataError, match="line 5, column 'x': 'abc'"):
        prepare_data(table(tmp_path, with_cell("abc")), missing="skip")


def test_read_uses_the_training_rows_and_needs_no_prepare(tmp_path: Path) -> None:
    file = table(tmp_path)
    data = prepare_data(file, columns=["square", "number"])
    other = tmp_path / "other.csv"
    test = fields_of(data, "test")
    numbers = (test["line"] - 2).tolist()
    other.write_text("number,note,square\n" + "\n".join(f"{n},hello,{n * n}" for n in numbers))
    fresh = build_data(file, columns=["square", "number"])
    read = fresh.read([other, other])
    assert isinstance(read, Fields)
    assert torch.equal(read.fields["input"], torch.cat([test["input"], test["input"]]))
    other.write_text("number\n3\n")
    with pytest.raises(
        DataError, match=r"The trained model names the column 'square', which .*other\.csv does not have"
    ):
        fresh.read([other])
    other.write_text("number,square\n3,9\n4,\n")
    with pytest.raises(
        DataError, match=r"other\.csv line 3, column 'square': The cell is empty, but a finite number"
    ):
        fresh.read([other])


@given(
    st.lists(st.floats(-1e300, 1e300, allow_subnormal=False), min_size=2, max_size=30),
    st.floats(-1e300, 1e300, allow_subnormal=False),
)
@settings(deadline=None, max_examples=200)
def test_any_column_is_standardised_without_overflow(values: list[float], constant: float) -> None:
    inputs = np.array([values, [constant] * len(values)]).T
    scaling, is_constant = fit_scaling(inputs)
    scaled = standardise(inputs, scaling)
    assert is_constant.tolist() == [min(values) == max(values), True]
    np.testing.assert_array_equal(scaled[:, 1], 0)
    if not is_constant[0]:
        assert abs(scaled[:, 0].mean()) < 1e-6
        assert scaled[:, 0].std() == pytest.approx(1, abs=1e-6)
    else:
        np.testing.assert_array_equal(scaled[:, 0], 0)


def test_a_column_far_from_zero_keeps_its_digits() -> None:
    inputs = 1e9 + np.array([[0.0], [1.0], [2.0], [3.0]])
    scaled = standardise(inputs, fit_scaling(inputs)[0])
    np.testing.assert_allclose(scaled[:, 0], (np.arange(4) - 1.5) / np.std(np.arange(4)), rtol=1e-6)


def test_an_image_has_a_bar_for_every_column() -> None:
    image = bars(np.array([3.0, -1.5, 0.0, 99.0]))
    assert image.shape == (HEIGHT, 256, 3)
    blue, red = ((image == colour).all(-1).sum(0) for colour in ((31, 119, 180), (214, 39, 40)))
    heights = [(int(blue[column]), int(red[column])) for column in (10, 74, 138, 202)]
    assert heights == [(31, 0), (0, 15), (0, 0), (31, 0)]  # without the grey line in the middle
    assert bars(np.zeros(500)).shape == (HEIGHT, 1000, 3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("kind", "gradians"),
        ("missing", "drop"),
        ("validation", 0.0),
        ("test", math.nan),
        ("data_seed", -1),
        ("rot", 1),
    ],
)
def test_a_config_out_of_range_is_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.{key}"):
        resolve("data", {"name": "tabular", key: value})


RUNS = {
    "class": ("class", "categorical", "[log_likelihood]"),
    "real": ("real", "gaussian", "[log_likelihood]"),
    "degrees": ("angle", "von_mises", "[log_likelihood,angular_deviation]"),
}


@pytest.mark.slow
def test_training_test_and_prediction_run_with_every_kind_of_target(tmp_path: Path) -> None:
    file = table(tmp_path, rows=90)
    (tmp_path / "new.csv").write_text("square,number\n25,5\n")
    lines = []
    for kind, (target, head, metric) in RUNS.items():
        lines += [
            [
                "data=tabular",
                f"data.path={file}",
                f"data.target={target}",
                f"data.kind={kind}",
                "data.columns=[number,square]",
                "encoder=[mlp]",
                "encoder.mlp.widths=[8]",
                f"density_head={head}",
                f"metric={metric}",
                "batch_size=16",
                "trainer.max_epochs=2",
                f"hydra.run.dir={tmp_path / kind}",
            ],
            [
                "mode=predict",
                f"checkpoint={tmp_path / kind}",
                f"mode.files={tmp_path / 'new.csv'}",
                f"hydra.run.dir={tmp_path / kind / 'predicted'}",
            ],
        ]
    process = run_commands(tmp_path, *lines)
    assert process.returncode == 0, process.stdout + process.stderr
    assert "are few for a network" in process.stdout
    for kind in ("class", "real", "degrees"):
        results = json.loads((tmp_path / kind / "results.json").read_text())
        assert math.isfinite(results["log_likelihood"])
        assert results["data"] == "mine"
        assert not results["synthetic"]
        with (tmp_path / kind / "predicted" / "predictions.csv").open(encoding="utf-8") as stream:
            (row,) = csv.DictReader(stream)
        target_column = {"class": "class", "real": "real", "degrees": "angle_deg"}[kind]
        names = list(row)
        assert names[:2] == ["sample", target_column]
        if kind == "class":  # the name of the class, then the probability of every class
            probabilities = {name: float(value) for name, value in row.items() if name.startswith("p_")}
            assert sum(probabilities.values()) == pytest.approx(1, abs=1e-5)
            assert max(probabilities, key=probabilities.__getitem__) == f"p_{row['class']}"
            numbers = [value for name, value in row.items() if name not in ("sample", "class")]
        else:
            numbers = list(row.values())[1:]
        assert names[-1] == "entropy_nats"
        assert all(math.isfinite(float(cell)) for cell in numbers)


def write_holes(folder: Path, rows: int = ROWS, start: int = 0) -> tuple[Path, np.ndarray]:
    """Write a table with holes in two of three input columns, and return its file and its inputs."""
    inputs = np.random.default_rng(start).normal(size=(rows, 3)) * [1, 50, 3] + [0, 1000, 0]
    inputs[::5, 0], inputs[1::7, 1] = np.nan, np.nan
    file = folder / f"holes{start}.csv"
    lines = [
        ",".join([*("" if np.isnan(cell) else f"{cell!r}" for cell in row), "cat" if index % 2 else "dog"])
        for index, row in enumerate(inputs.tolist())
    ]
    file.write_text("\n".join(["a,b,c,class", *lines]).replace(",,", ",NA,"), encoding="utf-8")
    return file, inputs


def test_missing_inputs_are_filled_as_scikit_learn_does(tmp_path: Path) -> None:
    file, inputs = write_holes(tmp_path)
    data = prepare_data(file, missing="median")
    assert data.columns == ("a", "b", "c", "a=", "b=") and data.input_shape == (5,) and data.skipped == 0
    assert any("'a' (8), 'b' (6)" in remark for remark in data.remarks)
    training = inputs[fields_of(data, "train")["line"].numpy() - 2]
    imputer = SimpleImputer(strategy="median", add_indicator=True).fit(training)
    scaler = StandardScaler().fit(imputer.transform(training))
    for name in SPLITS:
        rows = inputs[fields_of(data, name)["line"].numpy() - 2]
        np.testing.assert_allclose(
            fields_of(data, name)["input"], scaler.transform(imputer.transform(rows)), atol=1e-6
        )
    # a trained model fills further rows by the medians of its training rows, however they are given
    new = build_data(file, missing="median")
    new.load_state_dict(data.state_dict())
    other, rows = write_holes(tmp_path, 9, start=1)
    expected = scaler.transform(imputer.transform(rows))
    named = dict(zip("abc", rows.T, strict=True))
    absent = {name: [None if np.isnan(cell) else cell for cell in named[name]] for name in "abc"}
    marked = np.column_stack([rows, np.isnan(rows[:, :2])])
    computed = Standardise(new._input_columns.scaling, new._input_columns.fill)(torch.from_numpy(marked))
    user_inputs = [other, named, absent, rows, rows[0], marked]
    for inputs_of_new in (*(new.inputs(user_data) for user_data in user_inputs), computed):
        np.testing.assert_allclose(inputs_of_new, expected[: len(inputs_of_new)], atol=1e-6)


def test_missing_inputs_that_cannot_be_filled_are_refused(tmp_path: Path) -> None:
    file, _ = write_holes(tmp_path)
    with pytest.raises(DataError, match=r"line 2, column 'a': .* Or set data\.missing=median to fill in"):
        prepare_data(file)
    plain = prepare_data(file, missing="skip")
    new = build_data(file, missing="median")
    new.load_state_dict(plain.state_dict())
    with pytest.raises(DataError, match="was trained without this setting"):
        new.prepare()
    with pytest.raises(DataError, match=r"train the model with data\.missing=median"):
        new.inputs(file)
    with pytest.raises(DataError, match=r"trained with data\.missing=median"):
        new.inputs({"a": [math.nan], "b": [1.0], "c": [2.0]})
    parts = ("train", "train", "validation", "test")
    lines = [f"{row},{row if row % 4 > 1 else ''},{'ab'[row % 2]},{parts[row % 4]}" for row in range(ROWS)]
    empty = table(tmp_path, "\n".join(["x,y,class,split", *lines]))
    with pytest.raises(DataError, match="column 'y': No training row has a number"):
        prepare_data(empty, missing="median")
    with pytest.raises(DataError, match="stored state of tabular must hold"):
        new.load_state_dict({**plain.state_dict(), "fill": [math.nan] * 3})
