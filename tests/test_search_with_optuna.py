"""Tests of the search with Optuna: its suggestions, interruptions and several commands, its front, and pruning."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

import hydra_plugins.framework_search as framework_search
from framework.errors import ConfigError, DataError
from framework.runs.job import PRUNED
from framework.sweeps import ranking
from framework.sweeps.jobs import Job, short_hash
from framework.tracking.journal import Journal
from hydra_plugins.framework_search import _space
from hydra_plugins.framework_search._study import FILE, Sampling, Study, require_address
from tests.conftest import TINY, Framework, wait_for
from tests.test_search import LEARNING_RATE, Search

SAMPLERS = ["tpe", "random", "quasi_random", "nsga2"]
SPACE = [
    "a=tag(log,interval(1e-4,1e-1))",
    "b=8,16,32",
    "c=range(9,1,-2)",
    "d=interval(0.0,0.5)",
    "e=interval(1,9)",
]


def study(
    folder: Path,
    *space: str,
    sampler: str = "random",
    seed: int = 0,
    pruner: str | None = None,
    storage: str | None = None,
    fixed: Sequence[str] = (),
    metrics: Sequence[str] | None = None,
) -> Study:
    parsed = _space.parse_space(OverridesParser.create().parse_overrides(list(space or SPACE)))
    metrics = metrics or ["error", "size"][: 2 if sampler == "nsga2" else 1]
    return Study(folder, storage, "s", parsed, fixed, metrics, Sampling(sampler, seed, 4, pruner))


def values(overrides: list[str]) -> dict[str, str]:
    return dict(override.split("=", 1) for override in overrides)


def tell(one: Study, overrides: list[str], objectives: int = 1) -> None:
    given = values(overrides)
    error = abs(math.log10(float(given["a"])) + 2.5) + float(given["d"]) + 1 / int(given["b"])
    one.tell(overrides, [error, float(given["b"])][:objectives])


def searched(one: Study, trials: int) -> list[list[str]]:
    objectives = len(one.ways)
    while suggested := one.suggest(2, trials):
        for overrides in suggested:
            tell(one, overrides, objectives)
    return [point.overrides for point in one.points()]


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_search_in_two_parts_is_the_uninterrupted_search(sampler: str, tmp_path: Path) -> None:
    for name in ("whole", "parts", "other"):
        (tmp_path / name).mkdir()
    whole = searched(study(tmp_path / "whole", sampler=sampler), 16)
    assert len({tuple(overrides) for overrides in whole}) == 16
    for given in map(values, whole):
        assert 1e-4 <= float(given["a"]) < 1e-1
        assert 0 <= float(given["d"]) < 0.5
        assert given["b"] in ("8", "16", "32")
        assert given["c"] in ("9", "7", "5", "3")
        assert given["e"] in "12345678"
    first = searched(study(tmp_path / "parts", sampler=sampler), 6)
    assert searched(study(tmp_path / "parts", sampler=sampler), 16) == whole
    assert first == whole[:6]
    assert searched(study(tmp_path / "other", sampler=sampler, seed=1), 16) != whole


def test_two_commands_repeat_no_suggestion_of_each_other(tmp_path: Path) -> None:
    both = [study(tmp_path, sampler="nsga2"), study(tmp_path, sampler="nsga2")]
    for number in range(12):
        for overrides in both[number % 2].suggest(1, 12):
            tell(both[number % 2], overrides, 2)
    assert len(both[0].points()) == 12
    assert all(point.values for point in both[1].points())


def test_what_a_killed_command_began_is_suggested_again(tmp_path: Path) -> None:
    killed = study(tmp_path, sampler="tpe")
    running, failed, live = killed.suggest(3, 5)
    killed.tell(failed, None)
    with (tmp_path / FILE).open("a") as file:
        file.write('{"op_code":5,"wor')  # the process was killed while it wrote
    another = study(tmp_path, sampler="tpe")
    another.take_up(lambda overrides: overrides == live)
    assert sorted(another.suggest(2, 5)) == sorted([running, failed])
    tell(another, running)
    another.tell(failed, None)
    rest = another.suggest(9, 5)
    assert len(rest) == 2, "a trial that fails again is not repeated by the same command"
    for overrides in rest:
        tell(another, overrides)
    assert another.suggest(9, 5) == []
    assert another.take_over()
    assert another.suggest(9, 5) == [live]
    tell(another, live)
    tell(killed, running)  # a command that was taken for killed may still tell its values
    assert not another.take_over()
    assert [point.state.name for point in another.points()] == ["COMPLETE", "FAIL", *["COMPLETE"] * 3]


def test_the_values_of_a_trial_that_was_taken_over_are_kept(tmp_path: Path) -> None:
    first, second = study(tmp_path), study(tmp_path)
    [overrides] = first.suggest(1, 1)
    assert second.take_over()
    tell(first, overrides)
    assert second.suggest(1, 1) == []
    assert not second.take_over()
    assert [len(point.values) for point in second.points()] == [1]


def test_a_small_space_is_run_whole_and_then_ends(tmp_path: Path) -> None:
    one = study(tmp_path, "x=1,2,2,3", "y=range(0,2)", "z=5", sampler="tpe")
    while suggested := one.suggest(4, 100):
        for overrides in suggested:
            one.tell(overrides, [float(values(overrides)["x"])])
    assert Counter(tuple(point.overrides) for point in one.points()) == {
        (f"x={x}", f"y={y}", "z=5"): 1 for x in (1, 2, 3) for y in (0, 1)
    }


def test_a_study_of_another_search_is_refused_and_a_damaged_one_too(tmp_path: Path) -> None:
    study(tmp_path, fixed=["batch_size=8"])
    study(tmp_path, fixed=["batch_size=8"], sampler="tpe", seed=3)
    for changed, word in (
        ({"fixed": ["batch_size=16"]}, "fixed .*batch_size=8.* this command has .*batch_size=16"),
        ({"fixed": ["batch_size=8"], "metrics": ["accuracy"]}, "metrics .*error.* another folder"),
    ):
        with pytest.raises(ConfigError, match=f"was begun with {word}"):
            study(tmp_path, **changed)
    with pytest.raises(ConfigError, match="was begun with space"):
        study(tmp_path, "a=1,2", fixed=["batch_size=8"])
    (tmp_path / FILE).write_text("[1]\n{}\n")
    with pytest.raises(DataError, match=r"study\.jsonl: cannot be read as a study .* Delete the file"):
        study(tmp_path)


NONSENSE = [None, -1, 10**400, 1e308, math.nan, "x", [], {}, [1], {"a": 1}, True]


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_study_of_somebody_else_gets_a_sentence(sampler: str, tmp_path: Path) -> None:
    """Replace each value of each kind of line by one of another kind; the search goes on, or says a sentence."""
    one = study(tmp_path, sampler=sampler)
    objectives = 2 if sampler == "nsga2" else 1
    one.store_ways(["minimize"] * objectives)
    for _ in range(4):
        tell(one, one.suggest(1, 9)[0], objectives)
    one.suggest(1, 9)
    lines = [json.loads(line) for line in (tmp_path / FILE).read_text().splitlines()]
    places = {}
    for number, line in enumerate(lines):
        for key, value in line.items():
            inside = (
                list(value)
                if isinstance(value, dict)
                else range(len(value))
                if isinstance(value, list)
                else ()
            )
            places |= {(line["op_code"], key, inner): (number, key, inner) for inner in (None, *inside)}
    outcomes = Counter[str]()
    for turn, (number, key, inner) in enumerate(places.values()):
        changed = json.loads(json.dumps(lines))
        for value in (NONSENSE[turn % len(NONSENSE)], NONSENSE[(7 * turn + 3) % len(NONSENSE)]):
            if inner is None:
                changed[number][key] = value
            else:
                changed[number][key][inner] = value
            (tmp_path / FILE).write_text("".join(f"{json.dumps(line)}\n" for line in changed))
            try:
                again = study(tmp_path, sampler=sampler)
                assert len(again.ways) == objectives
                again.take_up(lambda overrides: False)
                for overrides in again.suggest(2, 12):
                    tell(again, overrides, objectives)
                again.take_over()
                outcomes["went on"] += 1
            except (ConfigError, DataError) as error:
                assert "study" in str(error) and len(str(error)) < 1000
                outcomes["sentence"] += 1
    assert min(outcomes["went on"], outcomes["sentence"]) > 3, outcomes


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("postgresql://me:secret@host/db", "PGPASSWORD"),
        ("postgresql+psycopg2://host/db?user=me&password=secret", "PGPASSWORD"),
        ("sqlite:///secret.db", "expected postgresql://"),
    ],
)
def test_an_address_with_a_password_is_refused(address: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        require_address(address)
    assert message != "PGPASSWORD" or "secret" not in str(caught.value)


def test_a_database_that_cannot_be_reached_gets_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("psycopg2", reason="the driver psycopg2 is not installed")
    with pytest.raises(ConfigError, match=r"cannot be reached .*Start the database"):
        study(tmp_path, storage="postgresql://me@127.0.0.1:1/db")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sampler": "nsga"}, "Did you mean 'nsga2'"),
        ({"pruner": "mean"}, "median, halving or null"),
        ({"batch": 0}, "batch = 0, but a whole number of at least 1"),
        ({"population": 5}, "population has no effect with hydra.sweeper.sampler=tpe"),
        ({"study": "mine"}, "study has no effect without hydra.sweeper.storage"),
        ({"pruner": "median", "sampler": "nsga2"}, "ranked by them and by nothing else"),
        ({"pruner": "median", "metric": "accuracy"}, "ranked by them and by nothing else"),
        ({"pruner": "median"}, "needs hydra/launcher=pool"),
        ({"metric": ["a", "b", "c"]}, "one or two keys"),
        ({"metric": ["a", "a"]}, "the same metric twice"),
        ({"metric": ["a", "b"], "direction": ["minimize"]}, "1 entries, but there are 2 metrics"),
    ],
)
def test_bad_settings_get_a_sentence(settings: dict[str, Any], message: str) -> None:
    sweeper = framework_search.OptunaSearch(**settings)
    sweeper.launcher = None
    with pytest.raises(ConfigError, match=message):
        sweeper._check()


def test_a_missing_package_gets_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.sweeps.engines.find_spec", lambda name: None)
    sweeper = framework_search.OptunaSearch()
    sweeper.launcher = None
    with pytest.raises(
        ConfigError, match=r"sweeper=optuna needs .* not installed.*robust-visual-learning\[search\]"
    ):
        sweeper._check()


def test_the_front_is_first_and_is_written_as_a_plain_file(tmp_path: Path) -> None:
    measured = [(0.3, 1.0), (0.1, 4.0), (0.2, 2.0), (0.4, 0.99), (0.25, 3.0), (math.nan, 1.0)]
    trials = []
    for number, (error, milliseconds) in enumerate(measured):
        folder = tmp_path / str(number)
        folder.mkdir()
        results = {"milliseconds_per_sample": milliseconds, "accuracy": 1 - error}
        content = {**results, "method": "m", "data": "d", "columns": {}, "better": {"accuracy": "higher"}}
        (folder / "results.json").write_text(json.dumps(content).replace("NaN", "null"))
        trials.append(ranking.Trial(folder, [f"x={number}"], error, completed=True))
    for metrics in ([None, ranking.MILLISECONDS], ["accuracy", ranking.MILLISECONDS]):
        result = ranking.rank(tmp_path, trials, ["x"], metrics, [None, None])
        # trial 3 is only one per cent faster than trial 0, which counts as equal
        assert result.front == [trials[1], trials[2], trials[0]]
        with (tmp_path / "ranking.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        assert [row["trial"] for row in rows] == ["1", "2", "0", "4", "3", "5"]
        assert [row["front"] for row in rows] == ["true"] * 3 + ["false"] * 3
    ranking.write_results(tmp_path, "optuna", result, ["x"])
    content = yaml.safe_load((tmp_path / ranking.RESULTS).read_text())
    assert content["solutions"][0] == {"params": {"x": 1}, "values": [0.9, 4.0]}
    swapped = ranking.rank(tmp_path, trials, [], [ranking.MILLISECONDS, None], [None, None])
    assert set(map(id, swapped.front)) == set(map(id, result.front))


# ---------------------------------------------------------------- commands

JOB = """
import json, sys, time
from pathlib import Path

given = dict(argument.split("=", 1) for argument in sys.argv[1:] if "=" in argument)
folder = Path(given["hydra.run.dir"][1:-1])
with (folder / "started").open("a") as file:
    file.write("x")
time.sleep(0.2)
rate, width = float(given["optimizer.learning_rate"]), int(given["density_head.hidden"])
results = {
    "method": "scvae", "data": "car", "seed": 0, "synthetic": True, "folder": str(folder),
    "milliseconds_per_sample": width / 64, "parameters": width, "columns": {}, "better": {},
}
(folder / "results.json").write_text(json.dumps(results))
(folder / "value.json").write_text(json.dumps(abs(rate - 1e-3) + 1 / width))
"""
NSGA2 = ["experiment=pascal3d/scvae", "logger=none", "data.category=car", "hydra.sweeper.sampler=nsga2"]
NSGA2 += [LEARNING_RATE, "density_head.hidden=64,128,256", "hydra.launcher.jobs=2"]
UNCHECKED = "from framework.sweeps import rehearsal\nrehearsal.COMMAND = [sys.executable, '-c', '']\n"


class OptunaSearch(Search):
    """Searches with Optuna in one folder, whose jobs do not train."""

    sweeper = ("-m", "hydra/sweeper=optuna")

    def __init__(self, home: Path) -> None:
        super().__init__(home)
        app = (home / "app.py").read_text()
        (home / "app.py").write_text(app.replace("from framework.app", UNCHECKED + "from framework.app"))
        (home / "job.py").write_text(JOB)

    def begin(self, *arguments: str) -> "subprocess.Popen[bytes]":
        """Start a search in the background."""
        command = [sys.executable, "app.py", *self.sweeper, "hydra.sweep.dir=search", *arguments]
        return subprocess.Popen(command, cwd=self.home, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


@pytest.mark.slow
def test_a_killed_search_goes_on_with_two_commands_at_once(tmp_path: Path) -> None:
    search = OptunaSearch(tmp_path)
    with search.begin(*NSGA2, "hydra.sweeper.trials=8") as killed:
        wait_for(lambda: len(list(search.folder.glob("*/value.json"))) >= 3)
        os.kill(killed.pid, signal.SIGKILL)
    with search.begin(*NSGA2, "hydra.sweeper.trials=8", "hydra.launcher.jobs=1") as other:
        code, output = search(*NSGA2, "hydra.sweeper.trials=8")
        assert other.stdout is not None
        text = other.stdout.read().decode()
    assert (code, other.returncode) == (0, 0), output + text
    assert Counter(record["status"] for record in search.jobs()) == {"completed": 8}
    started = [len((search.folder / str(number) / "started").read_text()) for number in range(8)]
    assert sorted(started)[:6] == [1] * 6, "only jobs that ran when the command was killed begin again"
    rows = search.ranking()
    assert sorted(int(row["trial"]) for row in rows) == [*range(8)]
    front = [row for row in rows if row["front"] == "true"]
    assert rows[: len(front)] == front
    points = {(float(row["value"]), float(row["milliseconds_per_sample"])) for row in rows}
    for row in front:
        error, milliseconds = float(row["value"]), float(row["milliseconds_per_sample"])
        assert not any(
            a <= error and b <= milliseconds and (a, b) != (error, milliseconds) for a, b in points
        )
    solutions = yaml.safe_load((search.folder / ranking.RESULTS).read_text())["solutions"]
    assert [solution["values"][0] for solution in solutions] == [float(row["value"]) for row in front]
    best = yaml.safe_load((search.folder / "best.yaml").read_text())
    assert str(best["optimizer"]["learning_rate"]) == rows[0]["optimizer.learning_rate"]


def test_a_bad_space_gets_a_sentence_before_any_job(tmp_path: Path) -> None:
    search = OptunaSearch(tmp_path)
    app = (tmp_path / "app.py").read_text()
    (tmp_path / "app.py").write_text(app.replace(UNCHECKED, ""))
    code, output = search("experiment=pascal3d/scvae", "density_head.samples=interval(-5,100)")
    assert code == 2, output
    assert "density_head.samples" in output
    assert "No job of the sweep was run" in output
    assert not search.folder.exists()


# ---------------------------------------------------------------- pruning


@pytest.fixture
def journals() -> Iterator[list[Journal]]:
    opened: list[Journal] = []
    yield opened
    for journal in opened:
        journal.close()


def test_a_trial_with_higher_losses_than_the_others_is_asked_to_stop(
    tmp_path: Path, journals: list[Journal], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hydra_plugins.framework_search._study.INTERVAL", 0.0)
    one = study(tmp_path, pruner="median")
    suggested = one.suggest(7, 7)
    stopped = []
    for number, overrides in enumerate(suggested):
        folder = tmp_path / str(number)
        folder.mkdir()
        job = Job(number, overrides, [], folder, short_hash(*sorted(overrides)), "")
        one.watch(job)  # before the run has a journal
        journals.append(Journal(folder / "journal.jsonl"))
        for epoch in range(3):
            journals[-1].write({"train/loss": 100.0}, 10 * epoch, epoch)
            journals[-1].write(
                {"validation/loss": 9.0 if number == 6 else 1.0 - 0.1 * epoch}, 10 * epoch + 9, epoch
            )
            one.watch(job)
            if (folder / PRUNED).exists():
                stopped.append((number, epoch))
                break
        one.tell(overrides, None if stopped else [0.5], pruned=bool(stopped))
    assert stopped == [(6, 0)]
    assert [point.state.name for point in one.points()] == ["COMPLETE"] * 6 + ["PRUNED"]
    assert study(tmp_path, pruner="median").suggest(1, 7) == [], "a pruned trial has ended"


def test_a_training_that_is_asked_to_stop_ends_without_a_test(framework: Framework, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "job.json").write_text(json.dumps({"key": "k", "number": 0, "overrides": []}))
    (folder / PRUNED).touch()
    done = framework(*TINY, "logger=none", "hydra.run.dir=run")
    assert done.code == 0, done.out
    assert "The search ended this training" in done.out
    done.folder = folder
    assert len(done.values("validation/loss")) == 1, "three epochs were planned"
    assert not (folder / "results.json").exists()
    assert not (folder / "value.json").exists()
    assert json.loads((folder / "run.json").read_text())["status"] == "FINISHED"


@pytest.mark.slow
def test_a_real_search_prunes_trials_that_do_not_learn(framework: Framework, tmp_path: Path) -> None:
    done = framework(
        *("-m", "hydra/sweeper=optuna", *TINY, "logger=none", "trainer.max_epochs=60"),
        *("hydra.sweep.dir=search", "hydra.sweeper.trials=12", "hydra.sweeper.pruner=median"),
        *("hydra.launcher.jobs=2", "optimizer.learning_rate=tag(log,interval(1e-9,1e-2))"),
    )
    assert done.code == 0, done.out
    with (tmp_path / "search" / "ranking.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    pruned = [row for row in rows if not row["value"]]
    assert len(rows) == 12
    assert pruned, "half of the learning rates are too low to learn anything"
    assert "(pruned)" in done.out
    assert all((tmp_path / "search" / row["trial"] / PRUNED).exists() for row in pruned)
