"""Tests of the remarks on rows that make results or predictions look better than they are."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from framework.configuration.schema import build, resolve
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.testing.data_samples import fields_of
from plugins.data.tabular.data import Tabular

ROWS = 60


def build_data(path: Path | None = None, **config: Any) -> Tabular:
    settings = {"name": "tabular", "target": "y", "kind": "real", "words": "levels", **config}
    return build("data", resolve("data", settings if path is None else {**settings, "path": str(path)}))


def prepare_data(folder: Path, text: str, **config: Any) -> Tabular:
    file = folder / "mine.csv"
    file.write_text(text, encoding="utf-8")
    data = build_data(file, **config)
    data.prepare()
    return data


def table(copied: int = 0) -> str:
    """Return a table whose last `copied` rows repeat the first ones but for their split and a number of the row."""
    rows = [
        f"{('train', 'validation', 'test')[row % 3]},n{row},{row % 7},{1 + row / 8},{row}"
        for row in range(ROWS)
    ]
    rows += [f"test,c{row},{row % 7},{1 + row / 8},{row}" for row in range(0, 3 * copied, 3)]
    return "\n".join(["split,name,x,size,y", *rows])


def remarks_with(words: str, data: Tabular) -> list[str]:
    return [remark for remark in data.remarks if words in remark]


def test_copies_of_training_rows_in_other_splits_are_counted(tmp_path: Path) -> None:
    assert not remarks_with("same inputs", prepare_data(tmp_path, table()))
    assert remarks_with("1 row for validation or test has the same", prepare_data(tmp_path, table(1)))
    (remark,) = remarks_with("same inputs", prepare_data(tmp_path, table(4)))
    assert remark.startswith("4 rows for validation and test have the same inputs and target")
    assert "line 62 as line 2;" in remark


def test_equal_rows_of_few_values_are_no_copies(tmp_path: Path) -> None:
    rows = [f"{row % 5},{row % 3},{row % 2}" for row in range(ROWS)]
    assert not remarks_with("same inputs", prepare_data(tmp_path, "\n".join(["a,b,y", *rows])))


def test_a_table_that_was_written_twice_is_reported(tmp_path: Path) -> None:
    rows = [f"{row / 7},{row}" for row in range(ROWS)]
    assert remarks_with(
        "rows for validation and test", prepare_data(tmp_path, "\n".join(["a,y", *rows, *rows]))
    )


def test_classes_without_a_test_row_are_named_with_their_numbers_of_rows(tmp_path: Path) -> None:
    kinds = ["a"] * 40 + ["b"] * 30 + ["rare"] * 2
    rows = "\n".join(f"{row % 11},{kind}" for row, kind in enumerate(kinds))
    for seed in range(8):
        data = prepare_data(tmp_path, f"x,y\n{rows}", kind="class", data_seed=seed)
        is_tested = 2 in fields_of(data, "test")["target"].tolist()
        assert bool(remarks_with("no test row has these classes", data)) != is_tested
        assert is_tested or remarks_with("'rare' (2)", data)


FAR = {
    "beyond": ("x,size\n3,17.5\n", "'size' is 17.5 in one of them, but 1 to 8.125 in the training rows"),
    "below": ("x,size\n3,-9\n4,2\n", "1 of 2 rows lies far outside the training rows"),
    "another unit": (
        "x,size\n3000,2000\n",
        "'x' is 3000 in one of them, but 0 to 6 in the training rows; 'size' is",
    ),
}
NEAR = {"inside": "x,size\n3,4\n", "at the ends": "x,size\n0,8.375\n", "a little outside": "x,size\n9,-3\n"}


@pytest.mark.parametrize("way", ["file", "frame", "array", "test"])
@pytest.mark.parametrize("name", [*FAR, *NEAR])
def test_rows_far_outside_the_training_rows_are_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, way: str
) -> None:
    state = prepare_data(tmp_path, table()).state_dict()
    text, message = FAR.get(name, (NEAR.get(name, ""), ""))
    file = tmp_path / "new.csv"
    file.write_text(text, encoding="utf-8")
    model = build_data(file if way == "test" else None, **({"test": 1} if way == "test" else {}))
    model.load_state_dict(state)
    with caplog.at_level(logging.WARNING):
        if way == "file":
            assert isinstance(model.read([file]), Fields)
        elif way == "test":
            frame = pd.read_csv(file).assign(y=0)
            frame.to_csv(file, index=False)
            model.prepare()
        else:
            frame = pd.read_csv(file)
            model.inputs(frame if way == "frame" else frame.to_numpy())
    messages = " ".join(model.remarks) if way == "test" else caplog.text
    assert message in messages
    assert ("far outside" in messages) == bool(message)


def test_another_value_of_a_constant_column_is_far_and_rounding_is_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = "\n".join(f"{row},0.3,{row}" for row in range(ROWS))
    model = prepare_data(tmp_path, f"x,same,y\n{rows}")
    model.inputs({"x": [1.0], "same": [0.1 + 0.2]})
    assert not caplog.text
    model.inputs({"x": [1.0], "same": [0.4]})
    assert "'same' is 0.4 in one of them, but 0.3 in all training rows" in caplog.text


def test_models_of_older_versions_load_and_wrong_ranges_are_refused(tmp_path: Path) -> None:
    state = dict(prepare_data(tmp_path, table()).state_dict())
    older = build_data()
    older.load_state_dict({key: state[key] for key in state if key not in ("low", "high")})
    assert older.inputs({"x": [1e6], "size": [2.0]}).shape == (1, 2)
    for wrong in ({"low": [1.0]}, {"high": [np.nan, 1.0]}, {"high": "ab"}, {"high": [1.0]}):
        with pytest.raises(DataError, match="The stored state of tabular"):
            build_data().load_state_dict({**state, **wrong})
    with pytest.raises(DataError, match="The stored state of tabular"):
        build_data().load_state_dict({key: state[key] for key in state if key != "high"})
