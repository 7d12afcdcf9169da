import pandas as pd
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from plugins.data.tabular.levels import MOST_LEVELS


def prepared(folder, text, **config):
    file = folder / "mine.csv"
    file.write_text(text, encoding="utf-8")
    settings = {
        "name": "tabular",
        "path": str(file),
        "target": "y",
        "kind": "real",
        "words": "levels",
        **config,
    }
    data = build("data", resolve("data", settings))
    data.prepare()
    return data


COLOURS = ("red", "green", "blue")
TABLE = "x,colour,name,y\n" + "\n".join(f"{row % 7},{COLOURS[row % 3]},n{row},{row}" for row in range(90))


def rows_of(data, split):
    part = getattr(data.splits(), split)
    return torch.stack([part[index]["input"] for index in range(len(part))])


def test_each_word_has_a_column(tmp_path):
    data = prepared(tmp_path, TABLE)
    assert data.columns == ("x", "colour=blue", "colour=green", "colour=red")
    assert any("'name' (90 different words; at most 50 are read)" in remark for remark in data.remarks)
    training = rows_of(data, "train")
    assert ((training[:, 1:] > 0).sum(1) == 1).all()
    torch.testing.assert_close(training.mean(0), torch.zeros(4), atol=1e-5, rtol=0)


def test_new_rows_are_read_with_the_words_of_the_training_table(tmp_path, caplog):
    data = prepared(tmp_path, TABLE)
    new = tmp_path / "new.csv"
    new.write_text("colour,x\nred,3\nviolet,3\n,3\n", encoding="utf-8")
    samples = data.read([new])
    file_rows = torch.stack([samples[index]["input"] for index in range(3)])
    assert "1 rows have levels in the column 'colour'" in caplog.text and "'violet'" in caplog.text
    assert torch.equal(file_rows[1], file_rows[2]) and not torch.equal(file_rows[0], file_rows[1])
    assert (file_rows[1, 1:] < 0).all()
    frame = pd.DataFrame({"colour": ["red", "violet", None], "x": [3, 3, 3]})
    torch.testing.assert_close(data.inputs(frame), file_rows)
    state = data.state_dict()
    fresh = build("data", resolve("data", {"name": "tabular", "target": "y", "kind": "real"}))
    fresh.load_state_dict(state)
    torch.testing.assert_close(fresh.inputs(frame), file_rows)
    as_numbers = pd.DataFrame({"x": [3.0], "colour=blue": [0], "colour=green": [0], "colour=red": [1]})
    torch.testing.assert_close(fresh.inputs(as_numbers), file_rows[:1])
    with pytest.raises(DataError, match="The model reads the column 'colour=blue'"):
        fresh.inputs(pd.DataFrame({"x": [3.0]}))


def test_columns_of_words_may_be_named(tmp_path):
    assert prepared(tmp_path, TABLE, columns=["colour"]).columns == (
        "colour=blue",
        "colour=green",
        "colour=red",
    )
    with pytest.raises(DataError, match="column 'name'"):
        prepared(tmp_path, TABLE, columns=["name", "x"])


def test_a_column_with_many_words_or_only_one_is_left_out(tmp_path):
    lines = [f"{row},{'w' + str(row % (MOST_LEVELS + 1))},same,{row}" for row in range(200)]
    data = prepared(tmp_path, "x,many,same,y\n" + "\n".join(lines))
    assert data.columns == ("x",)


def test_words_are_left_out_by_default(tmp_path):
    assert prepared(tmp_path, TABLE, words="leave_out").columns == ("x",)
