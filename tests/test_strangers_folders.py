"""Run and sweep folders from somebody else: every attack ends with an error message, for every command.

What an attack must not reach lies in `home`; a listener on a second loopback address must hear nothing. `SECURITY.md`
says what is trusted.
"""

import importlib
import json
import os
import shutil
import socket
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from framework.errors import UserError
from framework.sweeps import comparison
from tests.conftest import TINY, Done, Forks, Once, command, first_of_each

SECRET = b"the user's own line\nand one that does not end"
COMMANDS: dict[str, list[str]] = {
    "resume": ["resume={run}"],
    "sync": ["mode=sync", "mode.run={run}"],
    "test": ["mode=test", "checkpoint={run}", "logger=none"],
    "predict": ["mode=predict", "checkpoint={run}", "logger=none"],
    "export": ["mode=export", "checkpoint={run}", "logger=none"],
    "report": ["mode=report", "mode.run={run}"],
    "work_precision": ["mode=work_precision", "checkpoint={run}", "logger=none"],
    "combine": ["mode=combine", "mode.members={sweep}", "logger=none"],
    "train from it": [*TINY, "trainer.max_epochs=1", "checkpoint={run}", "logger=none"],
    "train into it": [*TINY, "trainer.max_epochs=1", "logger=none", "hydra.run.dir={run}"],
    "sweep": ["-m", *TINY, "trainer.max_epochs=1", "seed=0", "logger=none", "hydra.sweep.dir={sweep}"],
    "sweep with a store": ["-m", *TINY, "trainer.max_epochs=1", "seed=0", "hydra.sweep.dir={sweep}"],
}
"""Commands that read a run folder or write into it."""


@dataclass
class Sent:
    """An unpacked archive with a sweep of two jobs, and what it must not reach."""

    run: Path
    home: Path
    port: int

    def edit(self, name: str, change: Callable[[dict], object]) -> None:
        """Change what a JSON or YAML file of the run says."""
        path = self.run / name
        content = yaml.safe_load(path.read_text())
        change(content)
        path.write_text(json.dumps(content) if name.endswith("json") else yaml.safe_dump(content))

    def goes_to(self, uri: str, status: str = "KILLED") -> None:
        """Let the run's files name a store."""
        self.edit(
            "run.json",
            lambda info: info.update(uri=uri, status=status, run_id="0" * 32, sent=0, experiment="dial"),
        )
        self.edit(
            "config.yaml",
            lambda config: config.update(logger={"name": "mlflow", "uri": uri, "experiment": None}),
        )


def journal_linked(sent: Sent) -> None:
    (sent.run / "journal.jsonl").unlink()
    (sent.run / "journal.jsonl").symlink_to(sent.home / "secret.txt")


def results_of_two_names(sent: Sent) -> None:
    (sent.run / "results.json").unlink()
    (sent.run / "results.json").hardlink_to(sent.home / "secret.txt")


def checkpoints_linked(sent: Sent) -> None:
    shutil.move(sent.run / "checkpoints", sent.home / "checkpoints")
    (sent.run / "checkpoints").symlink_to(sent.home / "checkpoints")


def record_piped(sent: Sent) -> None:
    (sent.run / "run.json").unlink()
    os.mkfifo(sent.run / "run.json")


def sweep_linked(sent: Sent) -> None:
    for name in ("multirun.yaml", ".numbers.lock", "comparison.csv"):
        (sent.run.parent / name).symlink_to(sent.home / "made through a link")


LINKS = [journal_linked, results_of_two_names, checkpoints_linked, record_piped, sweep_linked]


def server(sent: Sent) -> None:
    sent.goes_to(f"http://127.0.0.2:{sent.port}")


def server_of_a_finished_run(sent: Sent) -> None:
    sent.goes_to(f"http://127.0.0.2:{sent.port}", "FINISHED")


def server_that_looks_local(sent: Sent) -> None:
    sent.goes_to(f"http://127.0.0.2:{sent.port}\\@localhost", "FINISHED")


def database(sent: Sent) -> None:
    sent.goes_to(f"postgresql://localhost/db?host=127.0.0.2&port={sent.port}", "RUNNING")


def store_of_the_users(sent: Sent) -> None:
    sent.goes_to(f"sqlite:///{sent.home}/mlflow.db", "FINISHED")


def own_store_that_writes_elsewhere(sent: Sent) -> None:
    """The store in the place of the default one, whose files lie in the user's home."""
    outputs = sent.run.parents[1]
    with closing(sqlite3.connect(outputs / "mlflow.db")) as store, store:
        store.execute("update experiments set artifact_location = ?", [str(sent.home / "planted")])
    sent.goes_to(f"sqlite:///{outputs}/mlflow.db", "FINISHED")
    line = {"n": 10_000, "time": 1.0, "artifact": "results.json", "folder": ""}
    with (sent.run / "journal.jsonl").open("a") as journal:
        journal.write(json.dumps(line) + "\n")


def own_store_that_is_changed_by_a_trigger(sent: Sent) -> None:
    """The store in the place of the default one; the folder of a run's files changes after the run is found."""
    outputs = sent.run.parents[1]
    sent.goes_to(f"sqlite:///{outputs}/mlflow.db", "FINISHED")
    with closing(sqlite3.connect(outputs / "mlflow.db")) as store, store:
        store.execute("UPDATE experiments SET artifact_location = ?", [str(outputs / "artifacts")])
        for event in ("INSERT ON tags", "INSERT ON params", "INSERT ON metrics", "UPDATE ON runs"):
            store.execute(
                f"CREATE TRIGGER {event.replace(' ', '_')} AFTER {event} BEGIN UPDATE runs SET artifact_uri = "
                f"'{sent.home / 'planted'}' WHERE artifact_uri <> '{sent.home / 'planted'}'; END"
            )
    line = {"n": 10_000, "time": 1.0, "artifact": "results.json", "folder": ""}
    with (sent.run / "journal.jsonl").open("a") as journal:
        journal.write(json.dumps(line) + "\n")


def own_store_that_is_a_link(sent: Sent) -> None:
    outputs = sent.run.parents[1]
    (outputs / "mlflow.db").unlink()
    (outputs / "mlflow.db").symlink_to(sent.home / "mlflow.db")
    sent.goes_to(f"sqlite:///{outputs}/mlflow.db", "FINISHED")


STORES = [
    *(server, server_of_a_finished_run, server_that_looks_local, database),
    *(store_of_the_users, own_store_that_writes_elsewhere, own_store_that_is_a_link),
    own_store_that_is_changed_by_a_trigger,
]


def target_in_its_config(sent: Sent) -> None:
    sent.edit("config.yaml", lambda config: config["data"].update(a={"_target_": "os.system"}))


def mode_in_its_config(sent: Sent) -> None:
    mode = {"name": "encode", "files": str(sent.home), "into": str(sent.home / "planted")}
    sent.edit("config.yaml", lambda config: config.update(mode=mode))


def folder_in_its_config(sent: Sent) -> None:
    sent.edit(
        "config.yaml", lambda config: config["trainer"].update(default_root_dir=str(sent.home / "planted"))
    )


CONFIGS = [target_in_its_config, mode_in_its_config, folder_in_its_config]
CASES = [
    *(
        (attack, name)
        for attack in LINKS
        for name in COMMANDS
        if attack is not sweep_linked or "sweep" in name
    ),
    *((attack, name) for attack in STORES for name in ("resume", "sync")),
    *((attack, "sweep with a store") for attack in (database, own_store_that_is_a_link)),
    *((attack, "resume") for attack in CONFIGS),
]
OFTEN: dict[Callable[[Sent], None], str] = {}
for number, attack in enumerate(dict.fromkeys(attack for attack, _ in CASES)):
    names = [name for case, name in CASES if case is attack]
    OFTEN[attack] = names[number % len(names)]
OFTEN[database] = "resume"  # a sweep waits 16 s for the database
"""One command of each attack, in turn; the others are slow tests."""
SURVIVED = {("results_of_two_names", name) for name in ("test", "predict", "train from it")} | {
    (attack, name)
    for attack in ("journal_linked", "record_piped")
    for name in ("test", "predict", "train from it")
}
"""Commands that do not read the file, or write to the folder that they checked; they succeed and change nothing."""


@pytest.fixture(scope="session")
def mlflow_database(once: Once) -> Path:
    """An SQLite store with an experiment, which takes MLflow seconds to make."""

    def make(folder: Path) -> None:
        made = f"c = MlflowClient('sqlite:///{folder}/mlflow.db'); c.create_experiment('dial', '{folder}/artifacts')"
        code = f"from mlflow import MlflowClient; {made}"
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=200, cwd=folder)

    return once("database", make) / "mlflow.db"


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.socket() as found:
        found.bind(("127.0.0.2", 0))
        found.listen()
        found.setblocking(False)
        yield found


@pytest.fixture
def sent(whole: Done, tmp_path: Path, mlflow_database: Path, listener: socket.socket) -> Sent:
    sweep = tmp_path / "unpacked" / "outputs" / "sweep"
    for number in "01":
        shutil.copytree(whole.folder, sweep / number)
        overrides = [*TINY, "trainer.max_epochs=1", f"seed={number}"]
        record = {"number": int(number), "key": number, "status": "completed", "overrides": overrides}
        (sweep / number / "job.json").write_text(json.dumps(record))
    home = tmp_path / "home"
    home.mkdir()
    (home / "secret.txt").write_bytes(SECRET)
    shutil.copy(mlflow_database, home / "mlflow.db")
    shutil.copy(mlflow_database, sweep.parent / "mlflow.db")
    found = Sent(sweep / "0", home, listener.getsockname()[1])
    found.edit("run.json", lambda info: info.update(status="KILLED"))
    return found


def state(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Return the mode, modification time and content of all files below a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        status = path.lstat()
        content = path.read_bytes() if stat.S_ISREG(status.st_mode) else b""
        found[str(path.relative_to(folder))] = status.st_mode, status.st_mtime_ns, content
    return found


@pytest.mark.parametrize(
    ("attack", "name"),
    [
        pytest.param(attack, name, marks=() if OFTEN[attack] == name else pytest.mark.slow)
        for attack, name in CASES
    ],
    ids=lambda one: one if isinstance(one, str) else one.__name__,
)
def test_a_strangers_folder_does_nothing_but_say_a_sentence(
    attack: Callable[[Sent], None],
    name: str,
    sent: Sent,
    listener: socket.socket,
    forks: Forks,
    stranger_site: Path,
    tmp_path: Path,
) -> None:
    attack(sent)
    before, base = state(sent.home), tmp_path / "work"
    base.mkdir()
    words = [word.format(run=sent.run, sweep=sent.run.parent) for word in COMMANDS[name]]
    more = {"MLFLOW_TRACKING_USERNAME": "user", "MLFLOW_TRACKING_PASSWORD": "secret"}
    done = command(forks, stranger_site, base)(*words, folder="run", more=more)
    assert "Traceback" not in done.out, done.out
    if (attack.__name__, name) in SURVIVED:
        assert done.code == 0, done.out
    elif (
        attack is not database or name != "sweep with a store"
    ):  # that compares the jobs, and says what it left out
        assert done.code in (1, 2), done.out
        assert "error: " in done.out
    assert state(sent.home) == before
    assert not (sent.home / "made through a link").exists()
    with pytest.raises(BlockingIOError):
        listener.accept()


PLUGIN_COMMANDS = {
    "plugins.data.registration": ["{run}", "{run}/results.json", "--folder={out}"],
    "plugins.data.human_scans.animate": ["{run}", "--out={out}/film.gif"],
    "plugins.data.registration.correspond": ["{run}", "--out={out}"],
    "plugins.data.human_scans.repose": ["{run}", "--out={out}", "--body={run}/results.json", "--random=1"],
    "plugins.data.human_scans.photograph_meshes": ["{run}", "{out}/root"],
    "plugins.renderer.rasterizer": ["{run}/results.json", "--out={out}/picture.png"],
}
"""Test every command of a plugin with the folder of somebody else."""


def test_these_are_all_commands_of_plugins() -> None:
    root = Path(__file__).parent.parent
    commands = set()
    for file in (root / "plugins").rglob("*.py"):
        if (
            '__name__ == "__main__"' in file.read_text(encoding="utf-8")
            and file.name != "fit_coefficients.py"
        ):
            commands.add(".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__main__"))
    assert commands == PLUGIN_COMMANDS.keys()


@pytest.mark.parametrize("attack", LINKS, ids=lambda one: one.__name__)
@pytest.mark.parametrize("name", PLUGIN_COMMANDS)
def test_a_plugins_command_does_nothing_but_say_a_sentence(
    name: str, attack: Callable[[Sent], None], sent: Sent, listener: socket.socket, tmp_path: Path
) -> None:
    attack(sent)
    before, module = state(sent.home), name if name.count(".") > 2 else f"{name}.__main__"
    main = importlib.import_module(module).main
    with pytest.raises(UserError):
        main([word.format(run=sent.run, out=tmp_path / "out") for word in PLUGIN_COMMANDS[name]])
    assert state(sent.home) == before
    with pytest.raises(BlockingIOError):
        listener.accept()


WRONG = [None, -1, 10**400, "", "\x1b[2J$\\frac{", "\udce9\ud800\ufffe", [], {"a": {"b": [None]}}]
RESULTS = {
    "method": "m",
    "data": "d",
    "seed": 0,
    "milliseconds_per_sample": 1.0,
    "device": "cpu",
    "threads": 1,
    "columns": {"nll": "NLL"},
    "better": {"nll": "lower"},
    "nll": 1.0,
    "nll_sem": 0.1,
    "synthetic": True,
    "folder": "/etc",
}
RECORD = {
    "number": 0,
    "overrides": ["x=1"],
    "key": "k",
    "config": "c",
    "command": ["x"],
    "pid": 1,
    "tries": 1,
    "error": None,
    "started": 1.0,
    "ended": 2.0,
    "processor_seconds": 1.0,
    "status": "completed",
}


@pytest.mark.parametrize(
    "key",
    first_of_each([*RESULTS, *(f"record {key}" for key in RECORD)], lambda key: key.startswith("record ")),
)
def test_a_job_that_says_nonsense_is_left_out_of_the_table(
    key: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Each key of results.json and job.json with values of every kind, or without; nothing steers the terminal."""
    if key.startswith("record "):
        # a record has no part in the figure
        monkeypatch.setattr(comparison, "comparison_figure", lambda compared: None)
    for value in [*WRONG, "missing"]:
        files = {"results.json": dict(RESULTS), "job.json": dict(RECORD)}
        told = files["job.json" if key.startswith("record ") else "results.json"]
        told[key.removeprefix("record ")] = value
        if value == "missing":
            del told[key.removeprefix("record ")]
        for name, content in files.items():
            (tmp_path / "0").mkdir(exist_ok=True)
            (tmp_path / "0" / name).write_text(json.dumps(content))
        # a second job, by which the table has a column for what was overridden
        (tmp_path / "1").mkdir(exist_ok=True)
        steered = {**RECORD, "overrides": ["x=\x1b[2J", "\x1b[31m=2"]}
        (tmp_path / "1" / "job.json").write_text(json.dumps(steered))
        (tmp_path / "1" / "results.json").write_text(json.dumps(RESULTS))
        with suppress(UserError):
            comparison.summarise(tmp_path, [], {})
        out = capsys.readouterr().out + caplog.text
        assert all(letter.isprintable() or letter == "\n" for letter in out), f"{value}: {out!r}"
