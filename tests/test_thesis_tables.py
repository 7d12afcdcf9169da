"""What `benchmarks/thesis_tables.md` says of runs that are here, half done, or on another machine."""

import datetime
import json
import math
from pathlib import Path

import pytest

from benchmarks import thesis_tables

PAGE = """
| 2.1 | moons | page | 45 of 45 | 19 | elsewhere |
| 3.3 | objects | page | 16 of 72 | 65 | elsewhere |
"""


def job(folder: Path, number: int, **record: object) -> None:
    told = {"status": "completed", "ended": 1.8e9, "processor_seconds": 90.0} | record
    path = folder / str(number) / "job.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(told), encoding="utf-8")


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(thesis_tables, "FOLDER", tmp_path)
    return tmp_path


def row(page: str, table: str) -> list[str]:
    return (
        next(line for line in page.splitlines() if line.startswith(f"| {table} |")).strip("| ").split(" | ")
    )


def test_a_table_whose_runs_are_not_here_keeps_its_line(runs: Path) -> None:
    job(runs / "pascal3d", 0)
    page = thesis_tables.report(PAGE)
    assert row(page, "2.1") == ["2.1", "moons", "page", "45 of 45", "19", "elsewhere"]
    assert row(page, "3.3")[3:5] == ["1 of 72", "1.5"]
    assert row(page, "3.3")[5].endswith(datetime.date.fromtimestamp(1.8e9).isoformat())
    assert row(page, "6.4")[3:] == ["0 of 2", "0.0", "not available"]


def test_only_completed_jobs_count_and_unknown_times_say_so(runs: Path) -> None:
    for number, told in enumerate([{}, {"status": "died"}, {"status": "running", "ended": None}]):
        job(runs / "pascal3d", number, **told)
    job(runs / "moons", 0, processor_seconds=None)
    page = thesis_tables.report("")
    assert row(page, "3.3")[3:5] == ["1 of 72", "1.5"]
    assert row(page, "2.1")[3:5] == ["1 of 60", "not available"]


def test_a_whole_is_told_of_tables_that_all_have_run(runs: Path) -> None:
    assert thesis_tables.minutes_of("| 3.3 | a | b | 16 of 72 | 65 | c |") == 65 * 72 / 16
    assert math.isnan(thesis_tables.minutes_of("| 6.4 | a | b | 0 of 1 | 0 | c |"))
    assert math.isnan(thesis_tables.minutes_of("| 6.4 | a | b | 1 of 1 | not available | c |"))


@pytest.mark.parametrize(
    "words, count",
    [
        (("experiment=a/b,a/c", "data.angles=[pan],[tilt],[roll]"), 6 * 5),
        (("experiment=a/b", "objective=[adversarial]"), 5),
        (("experiment=a/b", "data.category=car,bus", "seed=0"), 2),
        (("experiment=a/b", "encoder=[bps,mlp],[mlp]"), 2 * 5),
    ],
)
def test_how_many_runs_a_sweep_has(words: tuple[str, ...], count: int) -> None:
    assert thesis_tables.choices(words, 5) == count
