import pytest

from framework.configuration.schema import build, resolve
from framework.errors import DataError


def prepared(root, **config):
    data = build("data", resolve("data", {"name": "uci", "root": str(root), "set": "mine", **config}))
    data.prepare()
    return data


@pytest.fixture
def root(tmp_path):
    lines = [
        f"{row},{row * row},{row / 2},{'T.' if row % 10 == 0 else '.T' if row % 10 == 1 else '..'}"
        for row in range(100)
    ]
    (tmp_path / "mine.csv").write_text("a,b,y,test_in_splits\n" + "\n".join(lines), encoding="utf-8")
    return tmp_path


def test_the_marks_decide_the_test_rows_and_all_others_train_or_validate(root):
    for split in (0, 1):
        data = prepared(root, split=split)
        assert data.target.names == ("y",) and data.columns == ("a", "b") and data.title == "mine"
        lines = [{int(part[i]["line"]) for i in range(len(part))} for part in data.splits()]
        assert lines[2] == {row + 2 for row in range(100) if row % 10 == split}
        assert [len(part) for part in lines] == [81, 9, 10] and len(set.union(*lines)) == 100


def test_files_of_another_form_are_refused(root):
    with pytest.raises(DataError, match=r"line 2, column 'test_in_splits': 'T.' does not say .* split 2"):
        prepared(root, split=2)
    (root / "mine.csv").write_text("a,b,y\n1,2,3\n", encoding="utf-8")
    with pytest.raises(DataError, match="'test_in_splits' as the last one are expected"):
        prepared(root)
    with pytest.raises(DataError, match=r"data\.root is not set"):
        build("data", resolve("data", {"name": "uci"})).prepare()
