"""Tests of sweeps: they continue, keep right records and can be resumed, even if jobs or the sweep itself fail."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from framework.errors import ConfigError, DataError, UserError
from framework.runs.job import write_value
from framework.sweeps import engines, sending
from framework.sweeps import jobs as sweep
from framework.tracking import ended
from tests.conftest import PATIENCE, imported_by, wait_for

LINUX = pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere a fork is not safe once torch is imported"
)
ROOT = Path(__file__).resolve().parent.parent

# The sweep: a Hydra app as small as can be. Its jobs are another script, its hooks write down their calls.
APP = """
import json, os, sys, time, types
from pathlib import Path
import hydra
from framework.runs.job import write_value
from framework.sweeps import jobs as sweep

HERE = Path(__file__).parent

def begin(folder, config):
    with (HERE / "begun.jsonl").open("a") as file:
        file.write(json.dumps([str(folder), config]) + "\\n")
    return "parent-run"

def summarise(folder, overrides, config):
    (HERE / "summarised.json").write_text(json.dumps([str(folder), overrides]))

sys.modules["framework.sweeps.comparison"] = types.SimpleNamespace(
    begin=begin, summarise=summarise, store_of=lambda config: None
)
sweep.COMMAND = json.loads(os.environ["JOB"])

def meet(jobs):
    (HERE / f"rehearsed {os.getpid()}").touch()
    while len(list(HERE.glob("rehearsed *"))) < int(os.environ.get("MEET", 0)):
        time.sleep(0.005)

# the real module imports torch, and checks only jobs that train
sys.modules["framework.sweeps.rehearsal"] = types.SimpleNamespace(refuse_mistakes=meet)

if "IMPORTS" in os.environ:
    import functools
    from framework.sweeps import engines
    imports = os.environ["IMPORTS"].split(",")
    engines.Forks = functools.partial(lambda kind, modules: kind(imports), engines.Forks)

@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def run(config):
    from hydra.core.hydra_config import HydraConfig
    folder = Path(HydraConfig.get().runtime.output_dir)
    seen = [config.what, config.x, config.number, dict(config.get("extra") or {})]
    (folder / "seen.json").write_text(json.dumps(seen))

run()
"""

# A job: what it does is named on its command line.
JOB = """
import json, os, signal, sys, time
from pathlib import Path

given = dict(argument.split("=", 1) for argument in sys.argv[1:] if "=" in argument)
folder = Path(given["hydra.run.dir"][1:-1])
here = Path(__file__).parent
with (folder / "started").open("a") as file:
    file.write("x")
tries = len((folder / "started").read_text())

def wait_for(path):
    while not path.exists():
        time.sleep(0.005)

def fail():
    raise ValueError("this job is bad")

what = given.get("what", "ok")
print("hello from", what)
if what == "raise":
    fail()
elif what == "exit":
    sys.exit(7)
elif what == "kill" or what == "once" and tries == 1:
    os.kill(os.getpid(), signal.SIGKILL)
elif what == "work" or what == "work_once":
    while time.process_time() < 0.5:
        pass
    if what == "work_once" and tries == 1:
        os.kill(os.getpid(), signal.SIGKILL)
elif what == "random":
    import random
    given = [random.random(), *(sys.modules["numpy"].random.random(2) if "numpy" in sys.modules else ())]
    (folder / "random.json").write_text(json.dumps(given))
elif what == "environment":
    (folder / "environment.json").write_text(json.dumps(dict(os.environ)))
    own = [os.getpgrp() == os.getpid(), sys.stdin.read(), os.getcwd(), sys.argv[1:], __name__]
    (folder / "own.json").write_text(json.dumps(own))
elif what == "meet":
    (here / f"met{given['x']}").touch()
    while len(list(here.glob("met*"))) < 2:
        time.sleep(0.005)
elif what == "hold":
    def close(number, frame):
        (folder / f"closed {signal.Signals(number).name}").touch()
        sys.exit(128 + number)
    signal.signal(signal.SIGINT, close)
    signal.signal(signal.SIGTERM, close)
    (folder / "ready").touch()
    wait_for(here / "release")
elif what == "sleep":
    (folder / "ready").touch()
    wait_for(here / "release")
elif what == "stubborn":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    (folder / "ready").touch()
    wait_for(here / "release")
"""

CONFIG = """
defaults:
  - extra: null
  - experiment: null
  - _self_
what: ok
x: 0
value: 1
number: ${hydra:job.num}
experiment_name: ${hydra:runtime.choices.experiment}
hydra:
  output_subdir: null
  sweep:
    dir: sweep
  job_logging:
    root: {handlers: [console]}
"""


def handle_signals() -> None:
    """Handle the signals that this process may ignore: SIGINT as a background job of a shell, SIGHUP under nohup."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class App:
    """Small application in a folder of its own, with the folder of its sweep."""

    def __init__(self, folder: Path, fork: bool = False, launcher: str = "pool") -> None:
        self.folder = folder
        self.launcher = [f"hydra.launcher.fork={str(fork).lower()}"] if launcher == "pool" else []
        self.chosen = f"hydra/launcher={launcher}"
        self.sweep = folder / "sweep"
        self.output = folder / "output.txt"
        self.processes: list[subprocess.Popen[bytes]] = []
        (folder / "app.py").write_text(APP)
        (folder / "job.py").write_text(JOB)
        for path, text in {
            "config.yaml": CONFIG,
            "experiment/pooled.yaml": "# @package _global_\ndefaults:\n  - override /hydra/launcher: pool\n",
        }.items():
            (folder / "conf" / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / "conf" / path).write_text(text)
        shutil.copytree(ROOT / "conf" / "hydra" / "launcher", folder / "conf" / "hydra" / "launcher")
        self.environment = {
            **{key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"},
            "JOB": json.dumps([sys.executable, *([] if fork else ["-S"]), str(folder / "job.py")]),
            "HYDRA_FULL_ERROR": "1",
        }

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        with self.output.open("wb") as output:
            process = subprocess.Popen(
                [sys.executable, "app.py", *arguments, *self.launcher],
                cwd=self.folder,
                env=self.environment,
                stdout=output,
                stderr=subprocess.STDOUT,
                preexec_fn=handle_signals,
            )
        self.processes.append(process)
        return process

    def __call__(self, *arguments: str) -> tuple[int, str]:
        """Run a sweep, and return its exit code and output."""
        return self.start("-m", self.chosen, *arguments).wait(timeout=PATIENCE), self.said()

    def said(self) -> str:
        return self.output.read_text(encoding="utf-8")

    def close(self) -> None:
        """Leave no process behind, however the test ended."""
        (self.folder / "release").touch()
        for process in self.processes:
            process.kill()
            process.wait()

    def record(self, number: int) -> dict[str, Any]:
        return json.loads((self.sweep / str(number) / "job.json").read_text())

    def tries(self, number: int) -> int:
        return len((self.sweep / str(number) / "started").read_text())

    def until_ready(self, *numbers: int) -> None:
        def ready() -> bool:
            assert not any(process.poll() for process in self.processes[-1:]), self.said()
            return all((self.sweep / str(number) / "ready").exists() for number in numbers)

        wait_for(ready)


@pytest.fixture(
    params=[pytest.param("processes", marks=pytest.mark.slow), pytest.param("forks", marks=LINUX)]
)
def app(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[App]:
    app = App(tmp_path, request.param == "forks")
    yield app
    app.close()


def test_the_others_go_on_when_a_job_fails_or_is_killed(app: App) -> None:
    code, output = app("what=raise,kill,ok,exit", "hydra.launcher.jobs=2")
    assert code == 1
    records = [app.record(number) for number in range(4)]
    assert [record["status"] for record in records] == ["failed", "died", "completed", "failed"]
    assert [record["error"] for record in records] == [
        "ValueError: this job is bad (exit code 1)",
        "killed by SIGKILL, as the system does when memory runs out",
        None,
        "hello from exit (exit code 7)",
    ]
    assert all(record["tries"] == 1 and record["ended"] >= record["started"] for record in records)
    console = (app.sweep / "0" / "console.log").read_text()
    assert console.startswith("hello from raise\nTraceback")
    assert "in fail\n" in console
    assert (app.sweep / "1" / "console.log").read_text() == "hello from kill\n", (
        "printed before it was killed"
    )
    assert "3 of 4 jobs did not complete" in output
    for number in (0, 1, 3):
        assert f"({app.sweep / str(number) / 'console.log'})" in output.rpartition("did not complete")[2]
    overrides = [[f"what={what}"] for what in ("raise", "kill", "ok", "exit")]
    assert [record["overrides"] for record in records] == overrides
    assert json.loads((app.folder / "summarised.json").read_text()) == [str(app.sweep), overrides]
    [begun] = [json.loads(line) for line in (app.folder / "begun.jsonl").read_text().splitlines()]
    assert begun[0] == str(app.sweep)
    assert begun[1] == {"what": "raise", "x": 0, "value": 1, "number": 0, "experiment_name": None}


def test_jobs_that_fail_alike_are_listed_together(app: App) -> None:
    code, output = app("what=raise,exit", "x=0,1")
    assert code == 1
    listed = output.rpartition("did not complete")[2]
    assert listed.count("ValueError: this job is bad") == 1
    assert "  #0, #1 failed: ValueError" in listed
    assert "  #2, #3 failed: hello from exit" in listed


def test_the_same_sweep_again_runs_what_did_not_complete(app: App) -> None:
    assert app("what=ok,once,raise", "x=1")[0] == 1
    assert [app.record(number)["status"] for number in range(3)] == ["completed", "died", "failed"]
    code, output = app("what=ok,once", "x=1")
    assert (code, [app.tries(number) for number in range(3)]) == (0, [1, 2, 1])
    assert "2 jobs, 1 of them already completed" in output
    assert app.record(1)["status"] == "completed"
    assert app.record(1)["tries"] == 2
    assert (app.sweep / "1" / "console.log").read_text() == "hello from once\n" * 2


def test_a_sweep_can_grow_and_repeat_itself(app: App) -> None:
    assert app("x=5,6,6")[0] == 0
    assert app("x=4,5,6,6")[0] == 0
    assert [app.record(number)["overrides"] for number in range(4)] == [["x=5"], ["x=6"], ["x=6"], ["x=4"]]
    assert [app.tries(number) for number in range(4)] == [1, 1, 1, 1]


def test_a_completed_job_whose_config_changed_runs_again(app: App) -> None:
    assert app("x=1,2")[0] == 0
    config = app.folder / "conf" / "config.yaml"
    config.write_text(config.read_text().replace("value: 1", "value: 2"))
    assert app("x=1,2")[0] == 0
    assert [app.tries(number) for number in range(2)] == [2, 2]


def test_a_job_that_was_killed_is_started_again_when_asked(app: App) -> None:
    code, _ = app("what=once,kill,raise", "hydra.launcher.retries=1")
    assert code == 1
    assert [app.tries(number) for number in range(3)] == [2, 2, 1]
    assert [app.record(number)["status"] for number in range(3)] == ["completed", "died", "failed"]


def test_the_processor_time_of_all_tries_is_recorded(app: App) -> None:
    assert app("what=ok,work,work_once", "hydra.launcher.retries=1", "hydra.launcher.jobs=3")[0] == 0
    idle, once, twice = (app.record(number)["processor_seconds"] for number in range(3))
    assert 0 < idle < 0.5 <= once < 1 <= twice


@pytest.mark.slow
def test_processor_time_is_not_known_where_the_sweep_was_killed_or_the_config_changed(app: App) -> None:
    process = app.start("-m", "hydra/launcher=pool", "what=hold", "x=0,1", "hydra.launcher.jobs=1")
    app.until_ready(0)
    process.kill()
    process.wait()
    (app.folder / "release").touch()
    assert app("what=hold", "x=0,1", "hydra.launcher.jobs=1")[0] == 0
    assert app.record(0)["processor_seconds"] is None
    assert app.record(1)["processor_seconds"] > 0
    config = app.folder / "conf" / "config.yaml"
    config.write_text(config.read_text().replace("value: 1", "value: 2"))
    assert app("what=hold", "x=0,1", "hydra.launcher.jobs=1")[0] == 0
    assert app.record(0)["processor_seconds"] > 0


def test_as_many_at_once_as_asked_for(app: App) -> None:
    assert app("what=meet", "x=1,2", "hydra.launcher.jobs=2")[0] == 0, "each waits for the other"
    first, second = (app.record(number) for number in range(2))
    assert first["started"] < second["ended"]
    assert second["started"] < first["ended"]
    assert app("x=3,4,5", "hydra.launcher.jobs=1", "hydra.sweep.dir=one")[0] == 0
    app.sweep = app.folder / "one"
    times = [(record["started"], record["ended"]) for record in map(app.record, range(3))]
    assert all(ended <= started for (_, ended), (started, _) in pairwise(times))


def test_what_a_job_is_told(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    cores = engines.cores()
    assert app("what=environment", "x=0,1,2", "hydra.launcher.jobs=1", "hydra.launcher.devices=[4,5]")[0] == 0
    told = [json.loads((app.sweep / str(number) / "environment.json").read_text()) for number in range(3)]
    assert {one["OMP_NUM_THREADS"] for one in told} == {str(cores)}
    assert {one["FRAMEWORK_SWEEP_PARENT"] for one in told} == {"parent-run"}
    assert {one["CUDA_VISIBLE_DEVICES"] for one in told} == {"4"}
    assert not any("MLFLOW_RUN_ID" in one for one in told)
    app.environment["OMP_NUM_THREADS"] = "3"
    assert app("what=environment", "x=3", "hydra.launcher.jobs=1")[0] == 0
    told = json.loads((app.sweep / "3" / "environment.json").read_text())
    assert told["OMP_NUM_THREADS"] == "3", "what the user set stands"
    own = json.loads((app.sweep / "3" / "own.json").read_text())
    assert own == [True, "", str(app.folder), app.record(3)["command"][-len(own[3]) :], "__main__"]


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_lets_the_jobs_close_and_the_sweep_be_resumed(number: signal.Signals, app: App) -> None:
    arguments = ["what=hold", "x=0,1,2", "hydra.launcher.jobs=2"]
    process = app.start("-m", "hydra/launcher=pool", *arguments)
    app.until_ready(0, 1)
    process.send_signal(number)
    assert process.wait(timeout=PATIENCE) == 128 + number, app.said()
    records = [app.record(job) for job in range(3)]
    assert [record["status"] for record in records] == ["died", "died", "queued"]
    assert [record["error"] for record in records] == [f"stopped by {number.name}"] * 2 + [None]
    assert all((app.sweep / str(job) / f"closed {number.name}").exists() for job in (0, 1))
    assert (app.folder / "summarised.json").exists()
    (app.folder / "release").touch()
    assert app(*arguments)[0] == 0
    assert [app.record(job)["tries"] for job in range(3)] == [2, 2, 1]


def test_ctrl_c_at_the_terminal_reaches_each_job_once(app: App) -> None:
    # A terminal signals its whole foreground group; a job signalled twice would not wait for its batch's end.
    process = app.start("-m", "hydra/launcher=pool", "what=hold", "x=0,1", "hydra.launcher.jobs=2")
    app.until_ready(0, 1)
    wait_for(lambda: app.record(0)["pid"] is not None)
    assert os.getsid(app.record(0)["pid"]) == app.record(0)["pid"]
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=PATIENCE) == 130, app.said()


def test_a_third_signal_kills(app: App) -> None:
    process = app.start("-m", "hydra/launcher=pool", "what=stubborn")
    app.until_ready(0)
    for count, number in enumerate((signal.SIGINT, signal.SIGINT, signal.SIGTERM), 1):
        process.send_signal(number)
        wait_for(lambda count=count: app.said().count("asked to stop") == count)
    assert process.wait(timeout=PATIENCE) == 130
    assert app.record(0)["error"].startswith("killed by SIGKILL")


def test_jobs_of_a_killed_sweep_close_and_the_next_sweep_waits_for_them(app: App) -> None:
    arguments = ["what=hold,stubborn", "hydra.launcher.jobs=2"]
    process = app.start("-m", "hydra/launcher=pool", *arguments)
    app.until_ready(0, 1)
    process.kill()
    process.wait()
    if sys.platform == "linux":
        wait_for((app.sweep / "0" / "closed SIGTERM").exists)
    again = app.start("-m", "hydra/launcher=pool", *arguments)
    wait_for(lambda: "#1 waits" in app.said())
    assert app.record(1)["status"] == "running"
    assert app.tries(1) == 1, "two processes in one folder would mix their checkpoints"
    (app.folder / "release").touch()
    assert again.wait(timeout=PATIENCE) == 0, app.said()
    assert [app.record(job)["tries"] for job in range(2)] == [2, 2]


@LINUX
def test_jobs_end_with_the_process_they_are_forks_of_and_the_next_ones_get_another(tmp_path: Path) -> None:
    """The record states how each job ended: one closes its run, one ignores the signal and completes, one is killed."""
    app = App(tmp_path, fork=True)
    jobs = ["what=hold,stubborn,sleep,ok", "hydra.launcher.jobs=3"]
    process = app.start("-m", "hydra/launcher=pool", *jobs)
    try:
        app.until_ready(0, 1, 2)
        wait_for(lambda: app.record(0)["pid"] is not None)
        server = parent_of(app.record(0)["pid"])
        assert server not in (1, process.pid)
        os.kill(server, signal.SIGKILL)
        wait_for((app.sweep / "0" / "closed SIGTERM").exists)
        wait_for(lambda: app.record(3)["status"] == "completed")
        (app.folder / "release").touch()
        assert process.wait(timeout=PATIENCE) == 1
    finally:
        app.close()
    records = [app.record(number) for number in range(4)]
    assert [one["status"] for one in records] == ["died", "completed", "died", "completed"]
    assert [one["error"] for one in records] == ["stopped by SIGTERM", None, "killed by SIGTERM", None]
    assert all(one["processor_seconds"] > 0 for one in records)


@LINUX
def test_a_signal_that_comes_before_a_job_has_begun_reaches_it(tmp_path: Path) -> None:
    """The signal comes while the server process, of which the job will be a fork, is still importing."""
    app = App(tmp_path, fork=True)
    (app.folder / "slow.py").write_text(
        "from pathlib import Path\nimport time\n"
        "here = Path(__file__).parent\n(here / 'importing').touch()\n"
        "while not (here / 'signalled').exists():\n    time.sleep(0.005)\n"
    )
    app.environment["PYTHONPATH"] = os.pathsep.join([str(app.folder), os.environ.get("PYTHONPATH", "")])
    app.environment["IMPORTS"] = "slow"
    process = app.start("-m", "hydra/launcher=pool", "what=hold", "x=0,1", "hydra.launcher.jobs=2")
    try:
        wait_for((app.folder / "importing").exists)
        wait_for(lambda: all(app.record(number)["status"] == "running" for number in range(2)))
        process.send_signal(signal.SIGTERM)
        wait_for(lambda: "asked to stop" in app.said())
        (app.folder / "signalled").touch()
        assert process.wait(timeout=PATIENCE) == 128 + signal.SIGTERM
    finally:
        app.close()
    assert [app.record(number)["status"] for number in range(2)] == ["died", "died"]


@LINUX
def test_jobs_are_processes_of_their_own_where_none_can_be_forked(tmp_path: Path) -> None:
    app = App(tmp_path, fork=True)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\ncase "$*" in *fork_server*) exit 3;; esac\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    app.environment["JOB"] = json.dumps([str(python), str(tmp_path / "job.py")])
    assert app("x=0,1,2", "hydra.launcher.jobs=2")[0] == 0
    (tmp_path / "deadly.py").write_text("import os\nos.kill(os.getpid(), 9)\n")
    app.environment["JOB"] = json.dumps([sys.executable, str(tmp_path / "job.py")])
    app.environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    app.environment["IMPORTS"] = "deadly"
    assert app("x=3,4,5", "hydra.launcher.jobs=2")[0] == 0
    records = [app.record(number) for number in (3, 4, 5)]
    assert [one["tries"] for one in records] == [1, 1, 1]
    assert all(one["processor_seconds"] > 0 and one["pid"] for one in records)


@LINUX
def test_forks_draw_random_numbers_of_their_own(tmp_path: Path) -> None:
    app = App(tmp_path, fork=True)
    app.environment["IMPORTS"] = "numpy,no_such_module"
    assert app("what=random", "x=0,1,2,3", "hydra.launcher.jobs=2")[0] == 0
    drawn = [json.loads((app.sweep / str(number) / "random.json").read_text()) for number in range(4)]
    assert len({value for one in drawn for value in one}) == 12


def test_what_jobs_are_forks_of_asks_for_no_device_and_starts_no_thread() -> None:
    """A process that has used CUDA cannot have forks that use CUDA, and threads do not continue in forks."""
    code = (
        "import importlib, threading, torch\n"
        "asked = []\n"
        "for name in ('is_available', 'device_count', '_lazy_init', 'init', 'current_device', 'is_bf16_supported'):\n"
        "    setattr(torch.cuda, name, lambda *given, name=name: asked.append(name))\n"
        "from framework.modes import MODES\n"
        "importlib.import_module('framework.configuration.composition')\n"
        "for mode in MODES:\n"
        "    importlib.import_module(f'framework.modes.{mode}')\n"
        "print(asked, threading.active_count())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout == "[] 1\n"


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def test_a_job_composes_the_config_the_sweep_composed(app: App) -> None:
    # Jobs that are Hydra apps themselves, in a folder with every awkward letter, from a second config folder;
    # the launcher named by an experiment, the mode by the config.
    app.environment["JOB"] = json.dumps([sys.executable, str(app.folder / "app.py")])
    (app.folder / "more" / "extra").mkdir(parents=True)
    (app.folder / "more" / "extra" / "deep.yaml").write_text("depth: 3\n")
    name = "a b='c',{d}: é"
    process = app.start(
        "--config-dir=more",
        "hydra.mode=MULTIRUN",
        "experiment=pooled",
        "what=p,q",
        "x='quoted, text'",
        "extra=deep",
        f"hydra.sweep.dir='{name.replace(chr(39), chr(92) + chr(39))}'",
        "hydra.sweep.subdir=${hydra.job.override_dirname}/${hydra.job.num}",
    )
    assert process.wait(timeout=PATIENCE) == 0, app.said()
    seen = sorted((app.folder / name).rglob("seen.json"))
    assert [json.loads(path.read_text()) for path in seen] == [
        ["p", "quoted, text", 0, {"depth": 3}],
        ["q", "quoted, text", 1, {"depth": 3}],
    ]


@pytest.mark.parametrize(
    "sweeps",
    [
        ["x=0,1", "x=1,2", "x=3"],
        *(
            pytest.param(sweeps, marks=pytest.mark.slow)
            for sweeps in (["x=5,5", "x=5", "x=6,5"], ["x=0", "x=1"], ["x=0,1", "x=0,1"])
        ),
    ],
)
def test_sweeps_that_begin_at_once_in_one_folder_keep_their_jobs_apart(app: App, sweeps: list[str]) -> None:
    app.environment["MEET"] = str(len(sweeps))
    begun = [app.start("-m", "hydra/launcher=pool", one, "hydra.launcher.jobs=2") for one in sweeps]
    assert [process.wait(timeout=PATIENCE) for process in begun] == [0] * len(sweeps), app.said()
    records = [json.loads(path.read_text()) for path in app.sweep.glob("*/job.json")]
    most: Counter[str] = Counter()
    for one in sweeps:
        most |= Counter(f"x={value}" for value in one.partition("=")[2].split(","))
    assert Counter(one for record in records for one in record["overrides"]) == most, (
        "a job of both is run once"
    )
    assert sorted(record["number"] for record in records) == list(range(len(records)))
    for record in records:
        assert record["status"] == "completed"
        assert record["overrides"][0] in record["command"]
        assert app.tries(record["number"]) == 1
    assert app(*sweeps[:1])[0] == 0
    assert len(list(app.sweep.glob("*/job.json"))) == len(records)


def test_a_folder_that_another_job_has_taken_is_left_to_it(app: App) -> None:
    """A sweep of an earlier version could take the folder, or another folder can be copied over it."""
    process = app.start("-m", "hydra/launcher=pool", "what=hold", "x=0,1", "hydra.launcher.jobs=1")
    app.until_ready(0)
    record = app.record(1) | {"key": "another", "overrides": ["y=3"]}
    (app.sweep / "1" / "job.json").write_text(json.dumps(record))
    (app.folder / "release").touch()
    assert process.wait(timeout=PATIENCE) == 1
    assert "#1 failed: its folder now belongs to the job 'y=3'" in app.said()
    assert app.record(1) == record
    assert app("what=hold", "x=0,1")[0] == 0
    assert app.record(2)["overrides"] == ["what=hold", "x=1"]


def test_two_jobs_in_one_folder_are_refused(app: App) -> None:
    code, output = app("x=1,2", "hydra.sweep.subdir=same")
    assert code == 1
    assert "ConfigError: hydra.sweep.subdir gives two jobs the folder" in output


def test_a_job_gets_the_first_number_that_is_not_taken() -> None:
    taken = {Path("0"), Path("1"), Path("3")}
    assert sweep.free_number(lambda number: Path(str(number)), 0, taken) == 2
    assert sweep.free_number(lambda number: Path(str(number)), 4, taken) == 4
    with pytest.raises(ConfigError, match="two jobs the folder 1"):
        sweep.free_number(lambda number: Path("1"), 4, taken)


def test_what_a_job_leaves_for_an_optimising_sweeper(tmp_path: Path) -> None:
    job = sweep.Job(0, [], [], tmp_path, "key", "config")
    write_value(tmp_path, 0.25)
    assert job.value() is None, "a run of no sweep leaves nothing"
    assert not list(tmp_path.iterdir())
    (tmp_path / "job.json").touch()
    write_value(tmp_path, 0.25)
    assert job.value() == 0.25
    assert {path.name for path in tmp_path.iterdir()} == {"job.json", "value.json"}


def test_the_launcher_costs_other_commands_nothing() -> None:
    heavy = {
        "torch",
        "numpy",
        "pytorch_lightning",
        "mlflow",
        "pandas",
        "matplotlib",
        "framework.sweeps.comparison",
    }
    assert not heavy & imported_by("hydra_plugins.framework_pool")


def test_journals_that_the_store_did_not_accept_are_sent_again_while_a_sweep_runs_and_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    accepted = [list[str]() for _ in range(3)]
    tries = Counter[str]()

    def run(number: int, accepts: Callable[[str], bool], *names: str) -> None:
        def sync(folder: Path, store: str | None) -> None:
            tries[folder.name] += 1
            if folder.name == "damaged":
                raise DataError("this journal is damaged")
            if not accepts(folder.name):
                raise UserError("The store is away.")
            accepted[number].append(folder.name)

        monkeypatch.setattr(ended, "sync", sync)
        tries.clear()
        with sending.JournalSender(None) as sender:
            for name in names:
                sender.add(tmp_path / name)

    monkeypatch.setattr(sending, "_is_sent", lambda folder: False)
    monkeypatch.setattr(sending, "_FIRST_RETRY", 0.01)
    monkeypatch.setattr(sending, "PATIENCE", 0.1)
    run(0, lambda name: tries[name] > 2, "a", "b", "damaged")
    assert (sorted(accepted[0]), tries["damaged"]) == (["a", "b"], 1)
    assert caplog.text.count("The sweep tries again") == 1
    assert "this journal is damaged" in caplog.text
    run(1, lambda name: name != "a", "a", "b")
    assert accepted[1] == ["b"], "a job that the store refuses holds up the others"
    assert (
        f"incomplete in the tracking store: 1. The store is away. The command for all of them: `python -m framework "
        f"mode=sync mode.run={tmp_path / 'a'}`" in caplog.text
    )
