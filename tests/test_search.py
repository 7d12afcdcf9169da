"""Tests of the random search: its samples, repetitions and extensions, and the experiment of its best trial."""

import csv
import json
import math
import os
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from framework.configuration.composition import folder, register
from framework.errors import ConfigError
from framework.runs.job import find_job_folders, find_members
from framework.sweeps import comparison, ranking
from hydra_plugins.framework_search import _best, _draws, _space
from tests.conftest import TINY, Framework, imported_by

SEARCH = ["-m", "hydra/sweeper=random_search"]
SCVAE = {"/experiment@_global_": "pascal3d/scvae"}
LEARNING_RATE = "optimizer.learning_rate=tag(log,interval(1e-4,1e-2))"


def space(*overrides: str) -> dict[str, _space.Domain]:
    return _space.parse_space(OverridesParser.create().parse_overrides(list(overrides)))


def drawn(*overrides: str, trials: int = 20, seed: int = 0) -> list[dict[str, str]]:
    trials_drawn, _ = _draws.draw(space(*overrides), trials, seed)
    return [dict(override.split("=", 1) for override in trial) for trial in trials_drawn]


def column(override: str, trials: int = 400) -> list[str]:
    key = override.partition("=")[0]
    return [trial[key] for trial in drawn(override, "other=interval(0.0,1.0)", trials=trials)]


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ("x=a,b,c", {"a", "b", "c"}),
        ("x=choice([1,2],{a:1})", {"[1,2]", "{a:1}"}),
        ("x='p, q',\"it's\"", {"'p, q'", '"it\'s"'}),
        ("x=range(1,9)", {"1", "2", "3", "4", "5", "6", "7", "8"}),
        ("x=range(0,1,0.25)", {"0.0", "0.25", "0.5", "0.75"}),
        ("x=sort(3,1,2,reverse=true)", {"1", "2", "3"}),
        ("x=shuffle(range(1,4))", {"1", "2", "3"}),
        ("x=interval(2,5)", {"2", "3", "4"}),
        ("x=interval(start=-1,end=2)", {"-1", "0", "1"}),
        ("x=int(interval(1.5,4))", {"1", "2", "3"}),
        ("x=tag(log,interval(1,5))", {"1", "2", "3", "4"}),
        ("+x=null,true", {"null", "True"}),
    ],
)
def test_a_finite_sweep_gives_each_of_its_values_and_no_other(override: str, wanted: set[str]) -> None:
    assert set(column(override)) == wanted


def test_choices_are_equally_likely() -> None:
    counts = Counter(column("x=a,b,c,d", trials=4000))
    # 5 standard deviations of a binomial count with p = 1/4
    assert all(abs(count - 1000) < 5 * math.sqrt(4000 * 0.25 * 0.75) for count in counts.values())


@pytest.mark.parametrize(
    ("override", "least", "most", "distribution"),
    [
        ("x=interval(-2.0,6)", -2.0, 6.0, lambda value: (value + 2) / 8),
        ("x=float(interval(1,9))", 1.0, 9.0, lambda value: (value - 1) / 8),
        ("x=tag(log,interval(1e-5,1e-1))", 1e-5, 1e-1, lambda value: (math.log10(value) + 5) / 4),
        ("x=interval(1.0,1.0001)", 1.0, 1.0001, lambda value: (value - 1) / 0.0001),
        ("x=tag(log,interval(1e-300,1e300))", 1e-300, 1e300, lambda value: math.log10(value) / 600 + 0.5),
    ],
)
def test_an_interval_is_drawn_from_uniformly(
    override: str, least: float, most: float, distribution: Any
) -> None:
    values = sorted(map(float, column(override, trials=1000)))
    assert least <= values[0]
    assert values[-1] < most
    distances = [abs(distribution(value) - (rank + 0.5) / 1000) for rank, value in enumerate(values)]
    assert max(distances) < 1.95 / math.sqrt(1000), "Kolmogorov-Smirnov at 1e-3"


def test_whole_numbers_of_a_log_interval_have_log_uniform_shares() -> None:
    counts = Counter(column("x=tag(log,interval(1,8))", trials=4000))
    for number in range(1, 8):
        share = math.log((number + 1) / number) / math.log(8)
        assert abs(counts[str(number)] - 4000 * share) < 5 * math.sqrt(4000 * share * (1 - share))


def test_more_trials_extend_a_search_and_another_parameter_changes_no_draw() -> None:
    few = drawn(LEARNING_RATE, "h=64,128,256", trials=10)
    assert drawn(LEARNING_RATE, "h=64,128,256", trials=30)[:10] == few
    more = drawn("d=interval(0.0,0.5)", LEARNING_RATE, "fixed=3", "h=64,128,256", trials=10)
    assert [{key: trial[key] for key in few[0]} for trial in more] == few
    assert len({trial["d"] for trial in more}) == 10
    assert drawn(LEARNING_RATE, "h=64,128,256", trials=10, seed=1) != few


def test_draws_are_the_same_on_every_machine() -> None:
    # 0.9437... is int(sha256(b"0\x000\x00x").hexdigest()[:16], 16) / 2**64, as any tool gives it
    done = subprocess.run(["sha256sum"], input=b"0\x000\x00x", capture_output=True, check=True)
    assert _draws.quantile(0, 0, "x") == pytest.approx(int(done.stdout[:16], 16) / 2**64, abs=2**-52)


def test_floats_are_short_and_come_back_from_hydra_as_they_went() -> None:
    for text in column(LEARNING_RATE):
        [override] = OverridesParser.create().parse_overrides([f"{LEARNING_RATE.partition('=')[0]}={text}"])
        assert override.value() == float(text)
        assert override.get_value_element_as_str() == text
        assert len(text) <= len("0.000123456")


def test_a_small_space_is_run_whole_and_then_ends() -> None:
    whole, repeated = _draws.draw(space("x=1,2,3", "y=range(0,4)", "z=5", "w=1,1"), 100, 0)
    assert len({tuple(trial) for trial in whole}) == len(whole) == 12
    assert repeated > 0
    assert all(trial[2:] == ["z=5", "w=1"] for trial in whole)
    some, _ = _draws.draw(space("x=1,2,3", "y=range(0,4)", "z=5", "w=1,1"), 7, 0)
    assert some == whole[:7], "a shorter search is the beginning of a longer one"


def test_the_last_override_of_a_key_counts() -> None:
    assert {trial["x"] for trial in drawn("x=1,2", "x=7", "y=1,2")} == {"7"}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["x=1", "~y"], "no search space, because no override is a sweep. Add a sweep"),
        (["x=interval(2,2)"], r"x=interval\(2,2\): The smaller end must come first"),
        (["x=interval(3.0,2)"], "The smaller end must come first"),
        (["x=interval(0,inf)"], "Both ends of the interval must be finite"),
        (["x=interval(0,1)"], r"only whole number in the interval is 0. Write interval\(0.0,1.0\)"),
        (["x=tag(log,interval(0.0,1))"], "0 has no logarithm. Start above 0"),
        (["x=tag(log,interval(-3,2))"], "-3 has no logarithm"),
        (
            ["x=tag(lgo,interval(1.0,2))"],
            "only tag of an interval is log, but lgo was given. Did you mean 'log'",
        ),
        (["x=tag(log,range(1,9))"], "The tag log is allowed on intervals only"),
        (["x=range(9,1)"], "The sweep has no value"),
        (["x=range(1,9,0)"], "step of the range is 0"),
    ],
)
def test_a_sweep_that_makes_no_sense_is_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        space(*overrides)


# ---------------------------------------------------------------- the best trial as an experiment


def composed(*overrides: str) -> DictConfig:
    return compose("config", overrides=["experiment_name=test", *overrides])


@pytest.mark.parametrize(
    ("overrides", "name", "defaults"),
    [
        (
            ["experiment=pascal3d/scvae", "optimizer.learning_rate=1.2672e-05", "density_head.latent=7"],
            "pascal3d/scvae_best",
            [SCVAE],
        ),
        (
            ["experiment=pascal3d/scvae", "density_head=mixture", "optimizer=adam", "data.category=car"],
            "pascal3d/scvae_best",
            [SCVAE, {"override /density_head": "mixture"}, {"override /optimizer": "adam"}],
        ),
        (
            ["experiment=pascal3d/mixture", "preset=thesis/pascal3d", "data.image_size=64", "encoder=[mlp]"],
            "pascal3d/mixture_best",
            [
                {"/experiment@_global_": "pascal3d/mixture"},
                {"/preset@_global_": "thesis/pascal3d"},
                {"override /encoder": ["mlp"]},
            ],
        ),
        (
            ["data=pascal3d", "metric=[log_likelihood]", "trainer={max_epochs:3}", "+trainer.max_steps=2"],
            "best",
            [{"override /data": "pascal3d"}, {"override /metric": ["log_likelihood"]}],
        ),
        (
            ["experiment=pascal3d/scvae", "data.category='1e-3'", "seed=4", "~batch_size", "logger=none"],
            "pascal3d/scvae_best",
            [SCVAE],
        ),
    ],
)
def test_the_experiment_composes_to_the_config_of_the_trial(
    overrides: list[str], name: str, defaults: list[Any], tmp_path: Path
) -> None:
    register()
    with initialize_config_dir(str(folder()), version_base="1.3"):
        wanted = composed(*overrides)
        name_found, content = _best.build_experiment(
            overrides, GlobalHydra.instance().config_loader(), "trial 3"
        )
        assert name_found == name
        header, command, comment = content.splitlines()[:3]
        assert (header, comment) == ("# @package _global_", "# trial 3")
        assert command.startswith(f"# python -m framework experiment={name}")
        assert yaml.safe_load(content)["defaults"] == defaults
        path = tmp_path / "experiment" / f"{name}.yaml"
        path.parent.mkdir(parents=True)
        path.write_text(content)
        arguments = shlex.split(command)[4:]
        given = composed(f"hydra.searchpath=[file://{tmp_path}]", *arguments)
    assert OmegaConf.to_container(given) == OmegaConf.to_container(wanted)


# ---------------------------------------------------------------- multiruns

# The framework's command line, but for what runs a job: a script that returns a value without training.
APP = """
import sys
from pathlib import Path
from framework.sweeps import jobs as sweep
sweep.COMMAND = [sys.executable, "-S", str(Path(__file__).with_name("job.py"))]
sys.argv[0] = "framework"
from framework.app import main
main()
"""
JOB = """
import json, math, sys
from pathlib import Path

given = dict(argument.split("=", 1) for argument in sys.argv[1:] if "=" in argument)
folder = Path(given["hydra.run.dir"][1:-1])
with (folder / "started").open("a") as file:
    file.write("x")
if given["batch_size"] == "8":
    raise ValueError("batches too small")
rate, width = float(given["optimizer.learning_rate"]), int(given["density_head.hidden"])
value = math.nan if given["batch_size"] == "16" else abs(math.log10(rate) + 3) + width / 1e6
(folder / "value.json").write_text(json.dumps(value))
results = {
    "method": "scvae", "data": "car", "seed": 0, "synthetic": True, "folder": str(folder),
    "milliseconds_per_sample": 1.0, "parameters": width, "columns": {}, "better": {},
}
(folder / "results.json").write_text(json.dumps(results))
"""
SPACE = [LEARNING_RATE, "density_head.hidden=64,128", "batch_size=8,16,32,32"]


class Search:
    """Searches in one folder."""

    sweeper: tuple[str, ...] = tuple(SEARCH)

    def __init__(self, home: Path) -> None:
        self.home = home
        self.folder = home / "search"
        (home / "app.py").write_text(APP)
        (home / "job.py").write_text(JOB)

    def __call__(self, *arguments: str) -> tuple[int, str]:
        """Exit code and output."""
        done = subprocess.run(
            [sys.executable, "app.py", *self.sweeper, "hydra.sweep.dir=search", *arguments],
            cwd=self.home,
            env={**os.environ, "COLUMNS": "160"},
            capture_output=True,
            text=True,
            timeout=120,
        )
        return done.returncode, done.stdout + done.stderr

    def ranking(self) -> list[dict[str, str]]:
        with (self.folder / "ranking.csv").open(encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def jobs(self) -> list[dict[str, Any]]:
        paths = sorted(self.folder.glob("*/job.json"), key=lambda path: int(path.parent.name))
        return [json.loads(path.read_text()) for path in paths]

    def tries(self) -> list[int]:
        return [record["tries"] for record in self.jobs()]


@pytest.mark.slow
def test_a_search_ranks_its_trials_and_goes_on_where_it_was(tmp_path: Path) -> None:
    search = Search(tmp_path)
    unchecked = "from framework.sweeps import rehearsal\nrehearsal.COMMAND = [sys.executable, '-c', '']\n"
    (tmp_path / "app.py").write_text(APP.replace("from framework.app", unchecked + "from framework.app"))
    arguments = ["experiment=pascal3d/scvae", "logger=none", "data.category=car", *SPACE]
    code, output = search(*arguments, "hydra.sweeper.trials=8")
    assert code == 1, output
    statuses = Counter(record["status"] for record in search.jobs())
    assert len(search.jobs()) == 8
    assert min(statuses["completed"], statuses["failed"]) >= 1
    assert f"{statuses['failed']} of 8 jobs did not complete" in output
    assert "Traceback" not in output
    rows = search.ranking()
    finite = [float(row["value"]) for row in rows if row["value"]]
    assert [bool(row["value"]) for row in rows] == sorted((bool(row["value"]) for row in rows), reverse=True)
    assert finite == sorted(finite)
    assert {row["batch_size"] for row in rows[: len(finite)]} == {"32"}
    assert {row["batch_size"] for row in rows[len(finite) :]} == {"8", "16"}
    assert "(did not complete)" in output
    assert "(value nan)" in output

    best = yaml.safe_load((search.folder / "best.yaml").read_text())
    assert best["defaults"] == [SCVAE]
    assert f"{best['optimizer']['learning_rate']}" == rows[0]["optimizer.learning_rate"]
    assert best["data"] == {"category": "car"}
    assert f"trial {rows[0]['trial']} of 8 (seed 0)" in (search.folder / "best.yaml").read_text()
    assert "logger" not in best

    first = [record["overrides"] for record in search.jobs()]
    code, output = search(*arguments, "hydra.sweeper.trials=12", "hydra.launcher.jobs=2")
    assert [record["overrides"] for record in search.jobs()][:8] == first
    assert search.tries() == [2 if "batch_size=8" in one else 1 for one in first] + [1] * 4
    assert len(search.ranking()) == 12


def test_a_launcher_that_runs_jobs_in_this_process_will_do(tmp_path: Path) -> None:
    search = Search(tmp_path)
    modes = (
        "import types\n"
        "run = lambda values, folder, overrides: float(values['seed'])\n"
        "sys.modules['framework.modes'] = types.SimpleNamespace(run=run)\n"
    )
    (tmp_path / "app.py").write_text(APP.replace("from framework.app", modes + "from framework.app"))
    code, output = search("hydra/launcher=basic", "seed=range(3,9)", "hydra.sweeper.trials=6")
    assert code == 0, output
    rows = search.ranking()
    assert [row["seed"] for row in rows] == ["3", "4", "5", "6", "7", "8"]
    assert sorted(row["trial"] for row in rows) == ["0", "1", "2", "3", "4", "5"]
    assert yaml.safe_load((search.folder / "best.yaml").read_text()) == {"seed": 3}


def trials(folder: Path, *values: float | None, **more: list[float]) -> list[ranking.Trial]:
    """Return trials with the results `values` (None for a failed trial) and the further measurements `more`."""
    made_trials = []
    for number, value in enumerate(values):
        home = folder / str(number)
        home.mkdir()
        results = {
            **{key: column[number] for key, column in more.items()},
            "method": "m",
            "data": "d",
            "columns": {"accuracy": "accuracy (share)"},
            "better": {"accuracy": "higher"},
        }
        (home / "results.json").write_text(json.dumps(results))
        made_trials.append(ranking.Trial(home, [f"+x={number}", "y=1"], value, completed=value is not None))
    return made_trials


def ranked(folder: Path) -> list[str]:
    with (folder / "ranking.csv").open(encoding="utf-8") as file:
        return [row["trial"] for row in csv.DictReader(file)]


def test_the_best_is_first_and_what_has_no_finite_value_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = trials(tmp_path, math.nan, 2.0, None, -1.5, math.inf, 2.0)
    result = ranking.rank(tmp_path, given, ["+x"])
    assert ranked(tmp_path) == ["3", "1", "5", "0", "2", "4"]
    assert result.best == given[3]
    assert result.summary == "best validation loss (nats): -1.5"
    said = " ".join(capsys.readouterr().out.split())
    assert "#0 (value nan), #2 (did not complete), #4 (value inf)" in said
    assert ranking.rank(tmp_path, given, ["+x"], directions=["maximize"]).best == given[1]


def test_a_search_without_any_value_has_no_best(tmp_path: Path) -> None:
    assert ranking.rank(tmp_path, trials(tmp_path, math.nan, None), ["+x"]).best is None


def test_a_metric_of_the_results_ranks_its_own_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = {"accuracy": [0.5, 0.7, 0.9], "parameters": [3, 1, 2], "odd": [0.1, 0.3, 0.2]}
    given = trials(tmp_path, 1.0, 2.0, None, **numbers)
    assert ranking.rank(tmp_path, given, [], ["accuracy"]).best == given[1], "that of a failed trial is none"
    assert "accuracy was computed on the test split" in capsys.readouterr().out
    assert ranking.rank(tmp_path, given, [], ["accuracy"], ["minimize"]).best == given[0]
    assert ranking.rank(tmp_path, given, [], ["parameters"]).best == given[1], "costs are to be low"
    assert ranking.rank(tmp_path, given, [], ["odd"], ["maximize"]).best == given[1]
    with pytest.raises(
        ConfigError, match=r"does not state whether higher or lower is better\. Set hydra\.sweeper\.direction"
    ):
        ranking.rank(tmp_path, given, [], ["odd"])
    with pytest.raises(
        ConfigError,
        match=r"no trial has a number of this name\. Did you mean 'accuracy'\? The trials have: accuracy, ",
    ):
        ranking.rank(tmp_path, given, [], ["acuracy"])


def completed(
    home: Path, overrides: list[str], data: str = "d", milliseconds: float = 1.0, seed: int = 0
) -> None:
    """Write the files of a finished job into `home`."""
    results = {
        "method": "m",
        "data": data,
        "seed": seed,
        "milliseconds_per_sample": milliseconds,
        "batch_size": 15,
        "columns": {},
        "better": {},
    }
    home.mkdir(parents=True)
    (home / "results.json").write_text(json.dumps(results))
    (home / "job.json").write_text(json.dumps({"status": "completed", "overrides": overrides}))


def table(folder: Path, *given: list[str]) -> list[dict[str, str]]:
    """Return the lines of comparison.csv."""
    comparison.summarise(folder, given, {})
    with (folder / "comparison.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def compared(folder: Path, *jobs: tuple[str, list[str]]) -> list[dict[str, str]]:
    """The lines of completed jobs, whose data and overrides are given; the first took 1 ms."""
    for number, (data, overrides) in enumerate(jobs):
        completed(folder / str(number), overrides, data, number + 1.0)
    return table(folder, jobs[1][1])


def test_jobs_of_two_commands_in_one_folder_are_told_apart(tmp_path: Path) -> None:
    rows = compared(tmp_path, ("d", ["x=1", "size=32"]), ("d", ["x=1", "size=16"]), ("d", ["x=1"]))
    assert [row["size"] for row in rows] == ["32", "16", ""]
    assert [float(row["milliseconds_per_sample"]) for row in rows] == [1.0, 2.0, 3.0]


def test_a_setting_that_only_one_of_two_commands_names_tells_their_jobs_apart(tmp_path: Path) -> None:
    jobs = ("d", ["x=1", "seed=0", "threads=1"]), ("d", ["x=1", "seed=0", "threads=1", "size=16"])
    rows = compared(tmp_path, *jobs)
    assert [row["size"] for row in rows] == ["", "16"]
    assert "threads" not in rows[0]


def test_seeds_that_another_command_adds_are_the_same_row_whatever_else_it_names(tmp_path: Path) -> None:
    completed(tmp_path / "0", ["x=1", "seed=0"])
    completed(tmp_path / "1", ["x=1", "seed=1", "logger=none"], seed=1, milliseconds=3.0)
    rows = table(tmp_path, ["x=1", "seed=1", "logger=none"])
    assert [float(row["milliseconds_per_sample"]) for row in rows] == [2.0]


def test_what_the_data_column_says_already_is_left_out(tmp_path: Path) -> None:
    jobs = [(kind, [f"data.kind={kind}", f"size={size}"]) for kind in ("a", "b") for size in (8, 16)]
    rows = compared(tmp_path, *jobs)
    assert [(row["data"], row["size"]) for row in rows] == [("a", "8"), ("a", "16"), ("b", "8"), ("b", "16")]
    assert "kind" not in rows[0]


def test_a_swept_batch_size_is_not_that_at_which_the_cost_was_measured(tmp_path: Path) -> None:
    rows = compared(tmp_path, ("d", ["batch_size=16"]), ("d", ["batch_size=32"]))
    assert [row["batch_size"] for row in rows] == ["16", "32"]


def test_a_key_that_varies_within_the_data_is_shown(tmp_path: Path) -> None:
    rows = compared(tmp_path, ("a", ["kind=x"]), ("a", ["kind=y"]), ("b", ["kind=x"]))
    assert [row["kind"] for row in rows] == ["x", "y", "x"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["seed=3"], "has no search space"),
        (
            ["seed=1,2", "hydra.sweeper.trials=0"],
            "hydra.sweeper.trials = 0, but a whole number of at least 1 is required",
        ),
        (["seed=1,2", "hydra.sweeper.trials=many"], "hydra.sweeper.trials = 'many', but"),
        (["seed=1,2", "hydra.sweeper.seed=-1"], "hydra.sweeper.seed = -1"),
        (["seed=1,2", "hydra.sweeper.direction=minimise"], "Did you mean 'minimize'"),
        (["seed=interval(5,1)"], "seed=interval(5,1): The smaller end must come first"),
        (["sed=1,2"], "Did you mean 'seed'"),
    ],
)
def test_bad_input_gets_a_sentence_and_runs_nothing(
    arguments: list[str], message: str, tmp_path: Path
) -> None:
    search = Search(tmp_path)
    code, output = search("experiment=pascal3d/scvae", *arguments)
    assert code == 2, output
    assert message in output
    assert "Traceback" not in output
    assert not search.jobs()


@pytest.mark.slow
def test_the_best_of_a_real_search_can_be_run_and_repeats_its_trial(
    framework: Framework, tmp_path: Path
) -> None:
    searched = framework(
        *SEARCH,
        *TINY,
        "logger=none",
        "trainer.max_epochs=1",
        "hydra.sweep.dir=a search",
        "hydra.sweeper.trials=2",
        "hydra.launcher.jobs=2",
        "hydra.sweeper.params={optimizer.learning_rate:'tag(log,interval(1e-4,1e-2))'}",
    )
    assert searched.code == 0, searched.out
    home = tmp_path / "a search"
    with (home / "ranking.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    values = [json.loads((home / row["trial"] / "value.json").read_text()) for row in rows]
    assert values == sorted(values)
    assert [float(row["value"]) for row in rows] == values
    again = framework("--config-dir=a search", "experiment=best", "logger=none", "hydra.run.dir=again")
    assert again.code == 0, again.out
    again.folder = tmp_path / "again"
    repeated, trial = (
        yaml.safe_load((one / "config.yaml").read_text()) for one in (again.folder, home / rows[0]["trial"])
    )
    assert {key for key in trial if repeated[key] != trial[key]} <= {"experiment_name", "threads"}
    results = [
        json.loads((one / "results.json").read_text()) for one in (again.folder, home / rows[0]["trial"])
    ]
    assert results[0]["log_likelihood"] == results[1]["log_likelihood"]


def test_the_sweeper_costs_other_commands_nothing() -> None:
    heavy = {
        "torch",
        "numpy",
        "pytorch_lightning",
        "mlflow",
        "matplotlib",
        "rich",
        "optuna",
        "framework.sweeps.comparison",
        "framework.sweeps.ranking",
    }
    assert not heavy & imported_by("hydra_plugins.framework_search")


def test_jobs_are_found_however_deep_they_lie_and_those_of_a_sweep_below_are_not(tmp_path: Path) -> None:
    for number, name in enumerate(["x=10", "x=9", "experiment=a/b,x=1"]):
        completed(tmp_path / name, [name[-3:] if "/" in name else name], milliseconds=number + 1.0)
    completed(tmp_path / "another" / "0", ["x=5"])
    (tmp_path / "another" / "multirun.yaml").touch()
    rows = table(tmp_path)
    assert sorted(row["x"] for row in rows) == ["1", "10", "9"]
    assert [path.name for path in find_job_folders(tmp_path)[:2]] == ["x=9", "x=10"]
    assert {path.relative_to(tmp_path).parts[0] for path in find_job_folders(tmp_path)} == {
        "x=9",
        "x=10",
        "experiment=a",
    }


def test_members_are_found_however_deep_the_jobs_of_a_sweep_lie(tmp_path: Path) -> None:
    names = ["experiment=a/seed=9", "experiment=a/seed=10", "experiment=b/seed=9"]
    for name in names:
        completed(tmp_path / name, [])
    for name in names[:2]:
        (tmp_path / name / "checkpoints").mkdir()
        (tmp_path / name / "checkpoints" / "model.ckpt").touch()
    assert find_members(str(tmp_path)) == [tmp_path / name for name in names[:2]]
    with pytest.raises(ConfigError, match="names 0 trained models"):
        find_members(str(tmp_path / "experiment=b"))


@pytest.mark.parametrize("damage", ["", "{", "[1]", "{}", '{"method": "m", "data": "d"}', None])
def test_a_job_whose_results_cannot_be_read_is_left_out_of_the_table(
    tmp_path: Path, damage: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    for x in (1, 2):
        completed(tmp_path / str(x), [f"x={x}"])
    completed(tmp_path / "3", ["x=3"])
    (tmp_path / "a folder of something else").mkdir()
    shutil.copy(tmp_path / "3" / "results.json", tmp_path / "a folder of something else")
    if damage is None:
        (tmp_path / "3" / "results.json").unlink()
    else:
        (tmp_path / "3" / "results.json").write_text(damage)
    assert [row["x"] for row in table(tmp_path)] == ["1", "2"]
    assert (str(tmp_path / "3" / "results.json") in caplog.text) == (damage is not None)
    given = [ranking.Trial(tmp_path / str(x), [f"x={x}"], float(-x), completed=True) for x in (1, 2, 3)]
    assert ranking.rank(tmp_path, given, ["x"], ["milliseconds_per_sample"]).best == given[0]
    assert ranked(tmp_path) == ["1", "2", "3"]
