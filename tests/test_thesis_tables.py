"""Content of `reproduction/thesis_tables.md` for runs that are finished, unfinished, or from another machine."""

import datetime
import itertools
import json
import math
import shutil
from pathlib import Path

import pytest

from reproduction import thesis_tables

PAGE = """
| 2.1 | moons | page | 45 of 45 | 19 | 2.0 | elsewhere |
| 3.3 | objects | page | 16 of 72 | 65 | 3.0 | elsewhere |
"""


def job(folder: Path, number: int, **record: object) -> None:
    fields = {
        "status": "completed",
        "started": 1.8e9 - 600,
        "ended": 1.8e9,
        "processor_seconds": 180.0,
    } | record
    path = folder / str(number) / "job.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(fields), encoding="utf-8")


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
    page = thesis_tables.report(PAGE, {})
    assert row(page, "2.1") == ["2.1", "moons", "page", "45 of 45", "19", "2.0", "elsewhere"]
    assert row(page, "3.3")[3:6] == ["1 of 72", "1.5", "3.0"]
    assert row(page, "3.3")[6].endswith(datetime.date.fromtimestamp(1.8e9).isoformat())
    assert row(page, "6.4")[3:] == ["0 of 2", "0.0", "not available", "not available"]
    assert row(thesis_tables.report(PAGE, {"3.3": 4.0}), "3.3")[5] == "4.0"


def test_only_completed_jobs_count_and_unknown_times_say_so(runs: Path) -> None:
    for number, fields in enumerate([{}, {"status": "died"}, {"status": "running", "ended": None}]):
        job(runs / "pascal3d", number, **fields)
    job(runs / "moons", 0, processor_seconds=None)
    page = thesis_tables.report("", {})
    assert row(page, "3.3")[3:6] == ["1 of 72", "1.5", "not available"]
    assert row(page, "2.1")[3:5] == ["1 of 60", "not available"]


def test_runs_that_go_alone_count_by_the_clock(runs: Path) -> None:
    job(runs / "registration", 0)
    assert row(thesis_tables.report("", {}), "6.4")[3:5] == ["1 of 2", "10.0"]


def test_hours_are_known_only_if_every_table_has_run() -> None:
    lines = ["| 3.3 | a | b | 16 of 72 | 65 | 3.0 | c |", "| 6.4 | a | b | 2 of 2 | 20 | 1.0 | c |"]
    assert thesis_tables.total_hours(lines) == pytest.approx((65 * 72 / 16 + 3 + 20 + 1) / 60)
    for line in (
        "| 6.4 | a | b | 0 of 1 | 0 | 1.0 | c |",
        "| 6.4 | a | b | 1 of 1 | not available | 1.0 | c |",
        "| 6.4 | a | b | 1 of 1 | 20 | not available | c |",
        "| 6.4 | a | b | 1 of 1 | 20 | of a page as it was before |",
    ):
        assert math.isnan(thesis_tables.total_hours([*lines, line]))


def test_what_ran_under_another_definition_is_put_aside(runs: Path) -> None:
    """Runs are moved if a choice, a setting or a named seed of the sweep has changed."""
    words = ("experiment=a/b,a/c", "data.angles=[pan],[Tilt]", "seed=0,7", "pictures=false", "threads=1")
    matching = [
        ["experiment=a/b", "data.angles=[pan]", "seed=0", "pictures=False", "threads=1"],
        ["experiment=a/c", "data.angles=[Tilt]", "seed=7", "pictures=False", "threads=1"],
    ]
    outdated = [
        ["experiment=a/d", *matching[0][1:]],
        [*matching[0], "trainer.max_epochs=3"],
        [*matching[0][:2], *matching[0][3:4]],
        [*matching[0][:-1], "threads=2"],
        [*matching[0][:2], "seed=1", *matching[0][3:]],
    ]
    for number, overrides in enumerate([*matching, *outdated]):
        job(runs / "a", number, overrides=overrides)
    job(runs / "a", 9, overrides=outdated[0], status="running", ended=None)
    job(runs / "b", 0, overrides=outdated[0])
    for _ in range(2):
        thesis_tables.put_aside(runs / "a", words)
        assert sorted(path.name for path in (runs / "a").iterdir()) == ["0", "1", "9"]
        assert len(list((runs / "aside").iterdir())) == len(outdated)
        assert (runs / "b" / "0").exists()
    job(runs / "a", 2, overrides=outdated[0])
    thesis_tables.put_aside(runs / "a", words)
    assert len(list((runs / "aside").iterdir())) == len(outdated) + 1


def test_where_no_seed_is_named_runs_of_every_seed_belong_to_the_table(runs: Path) -> None:
    for seed in range(3):
        job(runs / "a", seed, overrides=["experiment=a/b", f"seed={seed}"])
    thesis_tables.put_aside(runs / "a", ["experiment=a/b"])
    assert len(list((runs / "a").iterdir())) == 3


def test_nothing_that_a_table_asks_for_is_put_aside(runs: Path) -> None:
    """Check the runs of every table, with the overrides that Hydra records."""
    for name, table in thesis_tables.TABLES.items():
        for jobs, bfloat16 in itertools.product((1, 2), (False, True)):
            for command in thesis_tables.commands(name, 5, jobs, bfloat16)[0]:
                folder = runs / Path(command[-1].partition("=")[2]).name
                overrides = [word for word in command[4:] if not word.startswith("hydra.")]
                for number, run_overrides in enumerate(thesis_tables.expand_sweep(overrides)):
                    job(folder, number, overrides=run_overrides)
                words = (*table.sweeps[folder.name], *thesis_tables.common_overrides(table, jobs, bfloat16))
                thesis_tables.put_aside(folder, words)
                assert len(list(folder.iterdir())) == number + 1
                shutil.rmtree(folder)


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
    assert thesis_tables.count_runs(words, 5) == count


@pytest.mark.parametrize(
    "words, seeds, expected",
    [
        ((), 9, "0,1,2"),
        ((), 2, "0,1"),
        (("seed=0,4",), 9, "0,4"),
        (("seed=0,4",), 1, "0"),
    ],
)
def test_no_more_seeds_than_asked_for_or_named(words: tuple[str, ...], seeds: int, expected: str) -> None:
    assert thesis_tables.with_seeds(("a=1,2", *words), seeds, 3) == ["a=1,2", f"seed={expected}"]
