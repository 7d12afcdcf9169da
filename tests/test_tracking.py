"""Tests of tracking: each number is stored once, without delay of the run, even if the store or a process fails."""

import json
import logging
import math
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy
from pandas import DataFrame
from werkzeug.serving import make_server

from framework.configuration.assembly import assemble, build_data, build_predictor
from framework.configuration.description import Description
from framework.configuration.loading import PREFIX, load
from framework.configuration.settings import Settings
from framework.errors import CheckpointError, ConfigError, DataError, UserError
from framework.storage import checkpoints
from framework.sweeps.comparison import experiment_of
from framework.tracking import sender, store_process
from framework.tracking import tracker as tracking
from framework.tracking.ended import mark_dead, sync
from framework.tracking.journal import Journal
from framework.tracking.run_info import (
    MODEL,
    Destination,
    RunInfo,
    Sidecar,
    read_run_info,
)
from framework.tracking.sender import Record, Sender, Store, batches
from framework.tracking.stores import (
    Address,
    confirm_address,
    default_uri,
    require_no_password,
    store_uri,
    without_password,
)
from framework.tracking.tracker import MlflowTracker, NoTracker
from framework.training.checkpoint import WholeCheckpoints
from tests.conftest import importing_mlflow, wait_for

with importing_mlflow():
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException
    from mlflow.pyfunc import load_model

    from framework.tracking import mlflow_store
    from framework.tracking.mlflow_store import run_folder


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a new SQLite store; MLflow needs seconds to create it."""
    folder = tmp_path_factory.mktemp("store") / "outputs" / "run"
    tracker = open_tracker(folder, experiment="made with the store")
    tracker.close("FINISHED")
    return folder.parent / "mlflow.db"


@pytest.fixture
def folder(tmp_path: Path, empty_store: Path) -> Path:
    """Return the path of a new run folder with a store beside it."""
    (tmp_path / "outputs").mkdir()
    shutil.copy(empty_store, tmp_path / "outputs" / "mlflow.db")
    return tmp_path / "outputs" / "some experiment" / "run"


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in {"_SECONDS": 0.1, "_PAUSE": 0.02, "_FIRST_RETRY": 0.05, "_LAST_RETRY": 0.2}.items():
        monkeypatch.setattr(sender, name, seconds)


def build(folder: Path, run_id: str | None = None, **changes: object) -> MlflowTracker:
    """Return a tracker that sends from this process, in which a test can replace functions of MLflow."""
    named = {"uri": None, "experiment": "some/experiment", "run_name": "some run", "parent": None}
    destination = Destination(run_id=run_id, **{key: changes.pop(key, value) for key, value in named.items()})  # type: ignore[arg-type]
    options: dict[str, Any] = {"opening_patience": 30.0, "open_store": mlflow_store.MlflowStore, **changes}
    return MlflowTracker(folder, destination, **options)


def open_tracker(folder: Path, run_id: str | None = None, **changes: object) -> MlflowTracker:
    tracker = build(folder, run_id, **changes)
    tracker.open()
    return tracker


def sidecar_in(folder: Path) -> Sidecar:
    return Sidecar(folder, RunInfo(None, "sqlite:///x", "e", "r", None, None, "key", 0.0, "RUNNING"))


def client(folder: Path) -> MlflowClient:
    return MlflowClient(default_uri(folder))


def identity(folder: Path) -> str:
    info = read_run_info(folder)
    assert info is not None
    assert info.run_id is not None
    return info.run_id


def history(folder: Path, key: str = "loss") -> list[tuple[int, float]]:
    return [(point.step, point.value) for point in client(folder).get_metric_history(identity(folder), key)]


def status(folder: Path) -> str:
    return client(folder).get_run(identity(folder)).info.status


def ended(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def losses(steps: Sequence[int]) -> list[tuple[int, float]]:
    return [(step, step / 7) for step in steps]


def log(tracker: MlflowTracker | NoTracker, steps: Sequence[int]) -> None:
    for step in steps:
        tracker.log_metrics({"loss": step / 7}, step, 0)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the store of `folder`, as a backup does."""
    connection = sqlite3.connect(folder.parents[1] / "mlflow.db", isolation_level=None)
    connection.execute("BEGIN EXCLUSIVE")
    try:
        yield
    finally:
        connection.execute("ROLLBACK")
        connection.close()


@pytest.fixture
def short_locks() -> Iterator[None]:
    """MLflow waits 0.1 s for a locked SQLite store, not its 20 s."""

    def shorten(connection, cursor, statement, parameters, context, many):
        return statement.replace("busy_timeout = 20000", "busy_timeout = 100"), parameters

    sqlalchemy.event.listen(sqlalchemy.Engine, "before_cursor_execute", shorten, retval=True)
    yield
    sqlalchemy.event.remove(sqlalchemy.Engine, "before_cursor_execute", shorten)


def copies(empty_store: Path) -> Callable[[str, str], mlflow_store.SqlAlchemyStore]:
    """Copy an existing store, instead of the slow creation by MLflow."""
    make = mlflow_store.SqlAlchemyStore

    def make_quickly(uri: str, artifacts: str) -> mlflow_store.SqlAlchemyStore:
        if uri.endswith(".partial"):
            path = Path(uri.removeprefix("sqlite:///"))
            assert not path.exists()
            shutil.copy(empty_store, path)
        return make(uri, artifacts)

    return make_quickly


# What a run leaves in the store


def test_a_run_from_open_to_close(folder: Path, tmp_path: Path) -> None:
    tracker = build(folder, parent="0123456789abcdef0123456789abcdef")
    assert tracker.run_id is None
    tracker.open()
    assert tracker.run_id == identity(folder)
    assert status(folder) == "RUNNING"
    tracker.log_params({"seed": 0, "head.sizes": [1, 2], "none": None})
    tracker.set_tags({"git.commit": "abc"})
    tracker.log_metrics({"loss": 1.5, "validation/loss": 2.5}, 10, 1)
    tracker.log_metrics({"loss": math.nan, "rate": math.inf}, 20, 2)
    (folder / "config.yaml").write_text("seed: 0")
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "curve.png").write_text("picture")
    tracker.log_artifact(folder / "config.yaml")
    tracker.log_artifact(tmp_path / "figures" / "curve.png", "pictures")
    tracker.log_artifact(tmp_path / "figures")
    tracker.close("FINISHED")

    run = client(folder).get_run(identity(folder))
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "some run"
    assert run.info.end_time >= run.info.start_time
    assert run.data.params == {"seed": "0", "head.sizes": "[1, 2]", "none": "None"}
    assert run.data.tags["git.commit"] == "abc"
    assert run.data.tags["mlflow.parentRunId"] == "0123456789abcdef0123456789abcdef"
    assert run.data.metrics["validation/loss"] == 2.5
    first, second = client(folder).get_metric_history(identity(folder), "loss")
    assert (first.step, first.value, second.step) == (10, 1.5, 20)
    assert math.isnan(second.value)
    assert abs(first.timestamp / 1000 - time.time()) < 60
    assert run.data.metrics["rate"] > 1e308  # the store has no infinity; the journal does
    assert [line.values.get("rate") for line in tracker.journal.lines()] == [None, math.inf]
    files = folder.parents[1] / "artifacts" / identity(folder) / "artifacts"
    assert sorted(str(file.relative_to(files)) for file in files.rglob("*.*")) == [
        "config.yaml",
        "figures/curve.png",
        "pictures/curve.png",
    ]
    experiment = client(folder).get_experiment(run.info.experiment_id)
    assert experiment.name == "some/experiment"
    assert "viewStateShareKey=losses" in experiment.tags["mlflow.note.content"]
    (chart,) = json.loads(experiment.tags["mlflow.sharedViewState.losses"])["compareRunCharts"]
    assert chart["selectedMetricKeys"] == ["train/loss", "validation/loss"]
    info = read_run_info(folder)
    assert info is not None
    assert (info.status, info.owed, info.sent) == ("FINISHED", (), tracker.journal.last)
    assert sync(folder) == 0


@pytest.mark.parametrize("end", ["FAILED", "KILLED"])
def test_a_run_keeps_the_status_with_which_it_first_ended(folder: Path, end: str) -> None:
    tracker = open_tracker(folder)
    log(tracker, [1])
    tracker.close(end)
    tracker.close("FINISHED")  # too late
    assert status(folder) == end
    assert history(folder) == losses([1])


def test_a_short_run_leaves_sending_to_whoever_syncs(folder: Path) -> None:
    tracker = open_tracker(folder, wait=1e6)
    log(tracker, range(5))
    tracker.close("FINISHED")
    info = read_run_info(folder)
    assert info is not None
    assert (info.run_id, info.sent, info.status) == (None, 0, "FINISHED")
    assert sync(folder) > 0
    assert history(folder) == losses(range(5))
    assert status(folder) == "FINISHED"
    assert sync(folder) == 0


def test_a_run_that_lasts_sends_from_then_on(folder: Path) -> None:
    tracker = open_tracker(folder, wait=0.2)
    assert tracker.run_id is None
    log(tracker, [0])

    def sent_by_the_next_line() -> bool:
        tracker.set_tags({"still": "here"})
        return tracker.run_id is not None

    wait_for(sent_by_the_next_line)
    tracker.close("FINISHED")
    assert history(folder) == losses([0])
    assert status(folder) == "FINISHED"


def test_long_parameters_are_shortened_visibly_and_kept_whole(folder: Path) -> None:
    tracker = open_tracker(folder)
    fits, long, longer = "x" * 250, "y" * 251, "z" * 10_000
    tracker.log_params({"fits": fits, "long": long})
    tracker.log_params({"longer": longer})
    tracker.close("FINISHED")
    params = client(folder).get_run(identity(folder)).data.params
    assert params == {"fits": fits, "long": "y" * 249 + "…", "longer": "z" * 249 + "…"}
    (artifact,) = client(folder).list_artifacts(identity(folder))
    stored = folder.parents[1] / "artifacts" / identity(folder) / "artifacts" / artifact.path
    assert json.loads(stored.read_text()) == {"long": long, "longer": longer}


def on_a_full_disk(path: Path, content: bytes) -> None:
    raise OSError(28, "No space left on device")


def test_long_parameters_on_a_full_disk_stop_nobody(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = open_tracker(folder)
    monkeypatch.setattr(tracking, "write_whole", on_a_full_disk)
    tracker.log_params({"long": "y" * 251})
    tracker.close("FINISHED")
    assert client(folder).get_run(identity(folder)).data.params == {"long": "y" * 249 + "…"}
    assert "No space left" in caplog.text


@pytest.mark.parametrize("content", ["{", "[1]", "\0"])
def test_long_parameters_beside_damaged_ones_stop_nobody(
    folder: Path, content: str, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = open_tracker(folder)
    (folder / "params.json").write_text(content)
    tracker.log_params({"long": "y" * 251})
    tracker.close("FINISHED")
    assert client(folder).get_run(identity(folder)).data.params == {"long": "y" * 249 + "…"}
    assert "params.json: cannot be read as parameters" in caplog.text


def test_more_parameters_than_the_store_takes_at_once_are_all_stored(folder: Path) -> None:
    params = {f"group.key{i}": i for i in range(350)}  # the store takes 100 at once
    tracker = open_tracker(folder)
    tracker.log_params(params)
    tracker.close("FINISHED")
    assert client(folder).get_run(identity(folder)).data.params == {key: str(i) for key, i in params.items()}


def test_names_the_store_does_not_take(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    tracker = open_tracker(folder)
    for step in range(3):
        tracker.log_metrics({"deviation [°]": 1.0, "/a//../b": 2.0, "": 3.0, "n" * 300: 4.0}, step, 0)
    tracker.log_params({"x=y": 1})
    tracker.set_tags({"x=y": "1"})
    tracker.close("FINISHED")
    run = client(folder).get_run(identity(folder))
    assert run.data.metrics == {
        "deviation [°]".replace("[°]", "___"): 1.0,
        "a/b": 2.0,
        "_": 3.0,
        "n" * 250: 4.0,
    }
    assert run.data.params == {"x_y": "1"}
    assert run.data.tags["x_y"] == "1"
    assert caplog.text.count("MLflow does not accept the name") == 5  # each name once


def test_an_entry_the_store_refuses_holds_up_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("MLFLOW_TRUNCATE_LONG_VALUES", "false")
    tracker = open_tracker(folder)
    tracker.set_tags({"good": "1", "bad": "x" * 10_000})
    log(tracker, [1, 2])
    tracker.set_tags({"bad": "x" * 10_000})
    tracker.close("FINISHED")
    assert history(folder) == losses([1, 2])
    assert client(folder).get_run(identity(folder)).data.tags["good"] == "1"
    assert status(folder) == "FINISHED"
    assert "MLflow refuses an entry" in caplog.text


def test_a_file_that_is_gone_holds_up_nothing(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    tracker = open_tracker(folder)
    tracker.log_artifact(folder / "missing.png")
    log(tracker, [1])
    tracker.close("FINISHED")
    assert status(folder) == "FINISHED"
    assert "missing.png was removed" in caplog.text


@pytest.mark.parametrize("path", ["/etc/hostname", "../secret.txt", "a/../../secret.txt", ".."])
def test_a_strangers_journal_gives_away_nothing_but_the_run_folder(
    path: str, folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = open_tracker(folder, wait=1e6)
    log(tracker, range(3))
    (folder.parent / "secret.txt").write_text("secret")
    (folder / "a").mkdir()
    tracker._log(artifact=path, folder="")  # pyright: ignore[reportPrivateUsage]
    tracker.close("FINISHED")
    info = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(
        json.dumps({**info, "owed": [[path, ""]], "artifacts": str(tmp_path / "there")})
    )
    sync(folder)
    assert history(folder) == losses(range(3))
    assert "leads out of the run folder" in caplog.text
    sent = [
        file for file in (tmp_path / "there", folder.parents[1] / "artifacts") for file in file.rglob("*.txt")
    ]
    assert not sent


FOREIGN = [
    *(
        "https://attacker.example/api",
        "postgresql://a:b@attacker.example/db",
        "databricks",
        "http://localhost:5000",
    ),
    *("http://127.0.0.2\\@localhost:5000", "http://127.0.0.2#@localhost", "http://localhost@127.0.0.2"),
    *(
        "http://localhost:x@127.0.0.2",
        "http://[::1]@127.0.0.2/",
        "http://127.0.0.2?@localhost",
        "http://LOCALHOST:5000/",
    ),
    *(
        "postgresql://localhost/db?host=127.0.0.2",
        "postgresql:///db?service=x",
        "mysql://localhost:1@127.0.0.2/db",
    ),
    *("sqlite:////anywhere/mlflow.db", "sqlite:///mlflow.db", "file:///tmp/store", "", "\x1b[2J"),
]
"""Addresses that a run.json of somebody else may name and that no setting of the user names."""


@pytest.mark.parametrize("own", [None, "http://localhost:5001", "https://mine.example", "sqlite:///mine.db"])
@pytest.mark.parametrize("recorded", FOREIGN)
def test_a_store_that_only_a_file_names_is_not_contacted(
    recorded: str, own: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The store is not contacted, even if the user names another one in the command or in the environment."""
    for named, setting in ((own, None), (None, own)):
        monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
        if setting:
            monkeypatch.setenv("MLFLOW_TRACKING_URI", setting)
        with pytest.raises(ConfigError, match=r"is your store, add logger\.uri=") as caught:
            confirm_address(recorded, named, tmp_path / "run", Path("run.json"))
        assert "a:b" not in str(caught.value)
        assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("recorded", "own"),
    [
        ("https://mine.example", "https://mine.example"),
        ("https://mine.example", "https://me:secret@mine.example"),
        ("postgresql://db/x", "postgresql://me:a/b@db/x"),
        ("sqlite:////anywhere/mlflow.db", "sqlite:////anywhere/mlflow.db"),
    ],
)
def test_what_is_contacted_is_the_users_own_text(
    recorded: str, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert confirm_address(recorded, own, tmp_path, Path("run.json")) == Address(own, True)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", own)
    assert confirm_address(recorded, None, tmp_path, Path("run.json")) == Address(own, True)
    default = default_uri(tmp_path / "run")
    assert confirm_address(default, None, tmp_path / "run", Path("run.json")) == Address(default, False)


@pytest.mark.parametrize(
    "uri",
    [
        *(
            "postgresql://me:secret@host/db",
            "postgresql+psycopg2://me:se/cret@host/db",
            "mysql://:secret@host/db",
        ),
        *("http://me:secret@host", "https://secret@host", "postgresql://host/db?user=me&password=secret"),
        *(
            "postgresql://host/db?sslpassword=secret",
            "https://host/?access_token=secret",
            "mssql://me:se@cret@host/db",
        ),
    ],
)
def test_no_address_with_a_password_is_shown_or_taken_from_a_command(uri: str) -> None:
    assert "secret" not in without_password(uri) and "cret" not in without_password(uri)
    assert without_password(uri) == without_password(without_password(uri))
    with pytest.raises(ConfigError, match="MLFLOW_TRACKING_URI") as caught:
        require_no_password(uri)
    assert "secret" not in str(caught.value) and "cret@" not in str(caught.value)


@pytest.mark.parametrize(
    "uri", ["sqlite:////home/me@work/a:b@c/mlflow.db", "http://host:5000/a", "mysql://me@host/db"]
)
def test_an_address_without_password_passes(uri: str) -> None:
    require_no_password(uri)
    assert without_password(uri) == uri.replace("me@host", "host")


@pytest.mark.parametrize("by_setting", [False, True], ids=["in Python", "by MLFLOW_TRACKING_URI"])
def test_no_file_of_a_run_holds_the_password_of_its_store(
    by_setting: bool, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Every record of a store is written to the journal first."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    uri = f"http://me:pa/ssw0rd@{address}"
    if by_setting:
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    tracker = open_tracker(folder, uri=None if by_setting else uri, patience=0.0, opening_patience=0.0)
    log(tracker, [1, 2])
    tracker.close("FINISHED")
    assert json.loads((folder / "run.json").read_text())["uri"] == f"http://{address}"
    assert not [path for path in folder.rglob("*") if path.is_file() and b"ssw0rd" in path.read_bytes()]
    assert "ssw0rd" not in caplog.text + tracker.url


@pytest.mark.parametrize("table", ["tags", "runs"])
def test_the_default_store_names_no_other_folder_to_load_from(
    table: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A default store may come from somebody else; only a store that the user names decides where its files are."""
    tracker = open_tracker(folder)
    log(tracker, [1])
    tracker.close("FINISHED")
    elsewhere = tmp_path / "elsewhere"
    if table == "tags":
        shutil.move(folder, elsewhere)
    with sqlite3.connect(folder.parents[1] / "mlflow.db") as store:
        change = {"tags": "value = ? where key = 'framework.folder'", "runs": "artifact_uri = ?"}[table]
        store.execute(f"update {table} set {change}", [str(elsewhere)])
    store.close()
    monkeypatch.chdir(tmp_path)
    if table == "runs":
        shutil.rmtree(folder)
    with pytest.raises(UserError, match=r"keeps files in|has no checkpoints"):
        run_folder(str(tracker.run_id))
    if table == "tags":
        assert run_folder(str(tracker.run_id), default_uri(folder)) == elsewhere


# Few calls, in order


class ListStore(Store):
    """Store that records its calls, and whose first calls fail."""

    def __init__(self, failures: int = 0) -> None:
        self.failures = failures
        self.identity = {"run_id": "1"}
        self.replay = {}
        self.got: list[Record] = []
        self.files: list[str] = []
        self.calls = 0

    def send(self, batch: Sequence[Record]) -> None:
        self.calls += 1
        if self.calls <= self.failures:
            raise ConnectionError("away")
        self.got.extend(batch)

    def send_file(self, path: str, place: str) -> None:
        self.files.append(path)


def send_steps(folder: Path, journal: Journal, store: ListStore, count: int) -> None:
    """Send losses while they are written, and check that each of them comes once and in order."""
    carrier = Sender(folder, journal, sidecar_in(folder), lambda folder, info: store)
    carrier.start()
    for step in range(count):
        journal.write({"loss": 1.0}, step, 0)
        carrier.notice()
    assert carrier.finish(60.0)
    assert [record["step"] for record in store.got] == list(range(count))


def test_ten_thousand_metrics_take_few_calls(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.jsonl")
    store = ListStore()
    send_steps(tmp_path, journal, store, 10_000)
    assert store.calls <= 10_000 / 50
    journal.close()


def test_a_training_is_not_followed_line_by_line(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.jsonl")
    for step in range(20):
        journal.write({"loss": 1.0}, step, 0)

    class GoesOn(ListStore):
        def send(self, batch: Sequence[Record]) -> None:
            super().send(batch)
            journal.write({"loss": 1.0}, 20 + self.calls, 0)  # the training, meanwhile

    store = GoesOn()
    sidecar = sidecar_in(tmp_path)
    assert sender.send_new(journal, sidecar, store, lambda: store.calls > 5) == 20
    assert store.calls == 1
    journal.close()


def test_what_waited_goes_in_the_largest_batches(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.jsonl")
    for step in range(10_000):
        journal.write({"loss": 1.0, "rate": 2.0}, step, 0)
    store = ListStore()
    sidecar = sidecar_in(tmp_path)
    assert sender.send_all(tmp_path, journal, sidecar, lambda folder, info: store) == 10_000
    assert 20 <= store.calls <= 22  # 1000 values each; a block that was read may end with fewer
    journal.close()


def test_a_store_that_fails_again_and_again_gets_everything_once_and_in_order(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    journal = Journal(tmp_path / "journal.jsonl")
    store = ListStore(failures=7)
    send_steps(tmp_path, journal, store, 500)
    assert caplog.text.count("cannot be reached or written (away)") == 1
    assert caplog.text.count("can be reached again after") == 1
    journal.close()


def test_batches_keep_order_and_bounds() -> None:
    records: list[Record] = [
        {"n": 1, "values": {"a": 1.0}},
        {"n": 2, "params": {"b": "c"}},
        {"n": 3, "artifact": "d"},
    ]
    records += [{"n": 4, "tags": {"e": "f"}}, {"n": 5, "status": "FINISHED"}, {"n": 6, "resumed_after": 1}]
    records += [{"n": 7 + i, "values": {str(j): 1.0 for j in range(300)}} for i in range(7)]
    records += [{"n": 14, "values": {str(j): 1.0 for j in range(1500)}}]
    found = [[record["n"] for record in batch] for batch in batches(records)]
    assert found == [[1, 2], [3], [4], [5], [6], [7, 8, 9], [10, 11, 12], [13], [14]]
    assert list(batches([])) == []


# A store that is locked, full or away


@pytest.mark.usefixtures("short_locks")
def test_a_store_locked_for_longer_than_mlflow_waits(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    tracker = open_tracker(folder)
    log(tracker, range(100))
    with locked(folder):
        # One thread holds the lock and logs: it would never come to release it if logging waited.
        log(tracker, range(100, 200))
        wait_for(lambda: "database is locked" in caplog.text)
        log(tracker, range(200, 300))
    log(tracker, range(300, 400))
    tracker.close("FINISHED")
    assert history(folder) == losses(range(400))
    assert status(folder) == "FINISHED"
    assert caplog.text.count("cannot be reached or written") == 1
    assert "can be reached again after" in caplog.text


@pytest.mark.usefixtures("short_locks")
def test_a_store_locked_at_the_start(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    uri = default_uri(folder) + "?timeout=0.1"
    tracker = build(folder, uri=uri)
    with locked(folder):
        tracker.open()
        assert tracker.run_id is None
        assert "The run continues" in caplog.text
        log(tracker, range(10))
    wait_for(lambda: tracker.run_id is not None)
    tracker.close("FINISHED")
    assert history(folder) == losses(range(10))


@pytest.mark.usefixtures("short_locks")
def test_a_store_locked_until_after_the_end(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    tracker = open_tracker(folder, patience=0.3)
    with locked(folder):
        log(tracker, range(10))
        tracker.close("FAILED")
        command = f"`python -m framework mode=sync mode.run='{folder}'`"
        assert command in caplog.text  # quoted: the path has a space
        assert str(folder / "journal.jsonl") in caplog.text
        with pytest.raises(UserError, match=r"database is locked.*Try again"):
            sync(folder)
    assert sync(folder) > 10
    assert history(folder) == losses(range(10))
    assert status(folder) == "FAILED"
    assert sync(folder) == 0


def test_a_full_disk_under_the_store(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    database = sqlite3.connect(default_uri(folder).removeprefix("sqlite:///"))
    pages = database.execute("PRAGMA page_count").fetchone()[0]
    database.close()

    def nearly_full(connection, record) -> None:
        connection.execute(f"PRAGMA max_page_count = {pages + 20}")

    sqlalchemy.event.listen(sqlalchemy.Engine, "connect", nearly_full)
    tracker = open_tracker(folder)
    for step in range(500):
        tracker.log_metrics({f"metric {i}": float(step) for i in range(10)}, step, 0)
    wait_for(lambda: "database or disk is full" in caplog.text)
    sqlalchemy.event.remove(sqlalchemy.Engine, "connect", nearly_full)
    mlflow_store.SqlAlchemyStore._engine_map[default_uri(folder)].dispose()
    tracker.close("FINISHED")
    assert history(folder, "metric 7") == [(step, float(step)) for step in range(500)]


def test_a_place_for_files_that_is_away_holds_up_no_number(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = open_tracker(folder)
    names = ["a.txt", "b.txt", "c.txt"]
    for name in names:
        (folder / name).write_text(name)
    sent: list[str] = []
    send_file = mlflow_store.MlflowStore.send_file
    away = threading.Event()
    away.set()

    def fails(self: mlflow_store.MlflowStore, path: str, place: str) -> None:
        if away.is_set():
            raise PermissionError(13, "Permission denied")
        sent.append(path)
        send_file(self, path, place)

    monkeypatch.setattr(mlflow_store.MlflowStore, "send_file", fails)
    for step, name in enumerate(names):
        tracker.log_artifact(folder / name)
        log(tracker, [step])
    wait_for(lambda: len(history(folder)) == 3)
    wait_for(lambda: "Permission denied" in caplog.text)
    info = read_run_info(folder)
    assert info is not None
    assert [path for path, _ in info.owed] == names
    away.clear()
    tracker.close("FINISHED")
    assert sent == names
    assert [file.path for file in client(folder).list_artifacts(identity(folder))] == names


def test_a_run_deleted_in_the_store_goes_on_and_is_whole_when_restored(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = open_tracker(folder)
    log(tracker, [1])
    wait_for(lambda: history(folder))
    client(folder).delete_run(identity(folder))
    log(tracker, [2, 3])
    wait_for(lambda: "must be in the 'active' state" in caplog.text)
    client(folder).restore_run(identity(folder))
    tracker.close("FINISHED")
    assert history(folder) == losses([1, 2, 3])


def test_a_deleted_experiment_is_said(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    experiment = client(folder).create_experiment("some/experiment")
    client(folder).delete_experiment(experiment)
    tracker = open_tracker(folder, patience=0.0)
    log(tracker, [1])
    tracker.close("FINISHED")
    assert (
        "'some/experiment' was deleted in the store; restore the experiment, or choose another name"
        in caplog.text
    )
    client(folder).restore_experiment(experiment)
    sync(folder)
    assert history(folder) == losses([1])


@pytest.mark.filterwarnings("ignore:starlette.middleware.wsgi")  # of MLflow's server
def test_a_server_away_from_start_to_end_and_then_back(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    uri = f"http://user:secret@127.0.0.1:{port}"
    tracker = open_tracker(folder, uri=uri, patience=0.0)
    tracker.log_params({"seed": 3})
    log(tracker, range(30))
    (folder / "note.txt").write_text("a note")
    tracker.log_artifact(folder / "note.txt")
    tracker.close("FINISHED")
    assert tracker.run_id is None
    assert tracker.url == f"http://127.0.0.1:{port}"
    with pytest.raises(UserError, match="did not accept everything"):
        sync(folder, uri)
    assert "secret" not in caplog.text

    monkeypatch.setenv("_MLFLOW_SERVER_FILE_STORE", default_uri(folder))
    monkeypatch.setenv("_MLFLOW_SERVER_ARTIFACT_ROOT", str(folder.parents[1] / "artifacts"))
    monkeypatch.setenv("MLFLOW_SERVER_ENABLE_JOB_EXECUTION", "false")
    from mlflow.server import app

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = make_server("127.0.0.1", port, app)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        assert sync(folder, uri) == 34  # with parameters, the file and two changes of status
        assert sync(folder, uri) == 0
        info = read_run_info(folder)
        assert info is not None
        Sidecar(folder, info).update(sent=0)  # as if the process had died before it noted down anything
        assert sync(folder, uri) == 34
    finally:
        server.shutdown()
        server.server_close()
    assert history(folder) == losses(range(30))
    run = client(folder).get_run(identity(folder))
    assert (run.info.status, run.data.params) == ("FINISHED", {"seed": "3"})
    assert [file.path for file in client(folder).list_artifacts(identity(folder))] == ["note.txt"]


def test_a_store_that_does_not_answer_does_not_hold_up_the_start(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answer = threading.Event()
    opened = mlflow_store._open_client

    def hangs(info: RunInfo) -> tuple[MlflowClient, str]:
        assert answer.wait(60)
        return opened(info)

    monkeypatch.setattr(mlflow_store, "_open_client", hangs)
    tracker = open_tracker(folder, opening_patience=0.01)
    assert "the store has not responded yet" in caplog.text
    log(tracker, range(5))
    answer.set()
    tracker.close("FINISHED")
    assert history(folder) == losses(range(5))


# The process that sends


def sending_process(tracker: MlflowTracker) -> subprocess.Popen[bytes]:
    assert tracker._process is not None
    while (process := tracker._process._process) is None:  # between two of them
        time.sleep(0.01)
    return process


def test_what_sends_dies_and_another_goes_on(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    tracker = open_tracker(folder, open_store=None, opening_patience=0.0)
    assert tracker.run_id is None, "nobody waits for the store"
    first = sending_process(tracker)
    tracker.log_metrics({"a name [°]": 1.0}, 0, 0)
    wait_for(lambda: "MLflow does not accept the name 'a name [°]'" in caplog.text)
    log(tracker, range(10))
    first.kill()
    log(tracker, range(10, 20))
    wait_for(lambda: "the process that sends to the store has ended" in caplog.text)
    wait_for(lambda: sending_process(tracker) is not first)
    second = sending_process(tracker)
    tracker.close("FINISHED")
    assert history(folder) == losses(range(20))
    assert status(folder) == "FINISHED"
    assert second.returncode == 0


def test_a_process_started_early_is_that_of_the_run_or_ends_with_the_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_process, "_COMMAND", ("sleep", "100"))
    with store_process.started_early():
        unused = store_process._early[0]._process
    assert unused is not None and unused.returncode == -9
    with store_process.started_early():
        taken = store_process._early[0]._process
        tracker = open_tracker(folder, open_store=None, opening_patience=0.0, patience=0.1)
    assert sending_process(tracker) is taken
    assert taken.poll() is None
    tracker.close("FINISHED")
    assert taken.returncode == -9, "it never answers"


def test_what_sends_and_hangs_is_ended_with_the_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(store_process, "_COMMAND", ("sleep", "100"))
    tracker = open_tracker(folder, open_store=None, opening_patience=0.01, patience=0.1)
    assert "the store has not responded yet" in caplog.text
    log(tracker, range(5))
    process = sending_process(tracker)
    tracker.close("FAILED")
    assert process.returncode == -9
    assert "mode=sync" in caplog.text
    sync(folder)
    assert history(folder) == losses(range(5))
    assert status(folder) == "FAILED"


# A process that dies, and one that goes on


DYING = """
import os, signal, sys, time
from pathlib import Path
from framework.tracking import run_info
from framework.tracking.tracker import MlflowTracker

tracker = MlflowTracker(Path(sys.argv[1]), run_info.Destination(None, "some/experiment", "r"))
tracker.open()
for step in range(100):
    tracker.log_metrics({"loss": step / 7}, step, 0)
while tracker._sidecar.info.sent < 101:
    time.sleep(0.01)

def die(self, **changes):
    # The store has taken a batch, and the process dies before it can note that down.
    for step in range(150, 160):
        tracker.journal.write({"loss": step / 7}, step, 0)
    os.write(tracker.journal._file, b'{"n":1')
    os.kill(os.getpid(), signal.SIGKILL)

run_info.Sidecar.update = die
print(tracker._process._process.pid, flush=True)
for step in range(100, 150):
    tracker.log_metrics({"loss": step / 7}, step, 0)
time.sleep(60)
"""


@pytest.fixture(scope="session")
def died(tmp_path_factory: pytest.TempPathFactory, empty_store: Path) -> Path:
    """Return a run folder whose process was killed at the worst moment."""
    folder = tmp_path_factory.mktemp("died") / "outputs" / "some experiment" / "run"
    folder.mkdir(parents=True)
    shutil.copy(empty_store, folder.parents[1] / "mlflow.db")
    done = subprocess.run(
        [sys.executable, "-c", DYING, folder], timeout=120, check=False, stdout=subprocess.PIPE
    )
    assert done.returncode == -9
    wait_for(lambda: ended(int(done.stdout)))  # the sending process does not outlive it
    return folder


@pytest.fixture
def killed(died: Path, tmp_path: Path) -> Path:
    """Return a copy of the run folder whose process was killed."""
    shutil.copytree(died.parents[1], tmp_path / "outputs")
    folder = tmp_path / "outputs" / "some experiment" / "run"
    sidecar = folder / "run.json"
    sidecar.write_text(sidecar.read_text().replace(str(died.parents[2]), str(tmp_path)))
    assert status(folder) == "RUNNING"
    assert len(history(folder)) == 150
    info = read_run_info(folder)
    assert info is not None
    assert info.sent == 101  # less than what the store has
    return folder


def test_a_killed_run_is_closed_by_others_and_lost_nothing(
    killed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert mark_dead(killed)
    assert status(killed) == "KILLED"
    assert history(killed) == losses(range(160))
    assert "Cut off" in caplog.text
    assert not mark_dead(killed)
    info = read_run_info(killed)
    assert info is not None
    assert info.status == "KILLED"


def test_a_killed_run_is_synced(killed: Path) -> None:
    sync(killed)
    assert history(killed) == losses(range(160))


@pytest.mark.usefixtures("short_locks")
def test_a_killed_run_whose_store_is_away_is_closed_later(
    killed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with locked(killed):
        assert mark_dead(killed, "FAILED")
    assert "did not accept everything" in caplog.text
    sync(killed)
    assert status(killed) == "FAILED"


def resume(folder: Path, after: int, until: int) -> None:
    """Resume the run of a folder from the checkpoint of step `after`, and end it before step `until`."""
    tracker = open_tracker(folder, run_id=identity(folder))
    tracker.drop_after(after)
    log(tracker, range(after + 1, until))
    tracker.close("FINISHED")


@pytest.mark.parametrize("checkpoint", [0, 99, 120, 149, 155, 159])
def test_a_killed_run_is_resumed_and_each_step_is_stored_once(killed: Path, checkpoint: int) -> None:
    tracker = open_tracker(killed, run_id=identity(killed))
    assert status(killed) == "RUNNING"
    tracker.drop_after(checkpoint)
    log(tracker, range(checkpoint + 1, 200))
    tracker.log_metrics({"test/loss": 1.0}, 199, 0)
    tracker.close("FINISHED")
    assert history(killed) == losses(range(200))
    assert history(killed, "test/loss") == [(199, 1.0)]
    assert status(killed) == "FINISHED"
    assert [line.step for line in tracker.journal.lines()] == [*range(200), 199]


def test_a_run_resumed_before_it_is_opened_and_resumed_again(killed: Path) -> None:
    Journal(killed / "journal.jsonl").drop_after(50)
    first = open_tracker(killed, run_id=identity(killed))
    log(first, range(51, 101))
    first.leave_open()
    assert status(killed) == "RUNNING"
    resume(killed, after=80, until=180)
    assert history(killed) == losses(range(180))


def test_repeating_a_step_without_a_resumption_keeps_both_numbers(folder: Path) -> None:
    tracker = open_tracker(folder)
    tracker.log_metrics({"test/loss": 1.0}, 5, 0)
    tracker.close("FINISHED")
    again = open_tracker(folder, run_id=tracker.run_id)
    again.log_metrics({"test/loss": 2.0}, 5, 0)
    again.close("FINISHED")
    assert history(folder, "test/loss") == [(5, 1.0), (5, 2.0)]


def test_what_a_power_cut_took_from_the_journal_is_not_missed(folder: Path) -> None:
    tracker = open_tracker(folder)
    log(tracker, range(50))
    tracker.leave_open()
    path = tracker.journal.path
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:20]))
    resume(folder, after=10, until=60)
    assert history(folder) == losses(range(60))


def test_changed_parameters_of_a_resumed_run_become_tags(folder: Path) -> None:
    tracker = open_tracker(folder)
    tracker.log_params({"epochs": 3, "seed": 0})
    tracker.leave_open()
    again = open_tracker(folder, run_id=tracker.run_id)
    again.log_params({"epochs": 5, "seed": 0})
    again.close("FINISHED")
    run = client(folder).get_run(identity(folder))
    assert run.data.params == {"epochs": "3", "seed": "0"}
    assert run.data.tags["changed.epochs"] == "5"
    assert "changed.seed" not in run.data.tags


def test_a_creation_that_was_cut_short_is_found_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    created = mlflow_store.MlflowStore._create_run
    calls = 0

    def cut_short(self, info, experiment_id):
        nonlocal calls
        calls += 1
        created(self, info, experiment_id)
        raise ConnectionError("the answer was lost")

    monkeypatch.setattr(mlflow_store.MlflowStore, "_create_run", cut_short)
    tracker = open_tracker(folder)
    log(tracker, [1])
    tracker.close("FINISHED")
    assert calls == 1
    experiment = client(folder).get_experiment_by_name("some/experiment")
    assert experiment is not None
    assert len(client(folder).search_runs([experiment.experiment_id])) == 1
    assert history(folder) == losses([1])


def test_a_store_that_lost_the_run_gets_it_anew(
    folder: Path, empty_store: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = open_tracker(folder)
    log(tracker, range(5))
    tracker.leave_open()
    moved = f"sqlite:///{folder.parents[1] / 'other.db'}"
    shutil.copy(empty_store, folder.parents[1] / "other.db")
    again = open_tracker(folder, uri=moved, run_id=tracker.run_id)
    log(again, range(5, 8))
    again.close("FINISHED")
    assert again.run_id != tracker.run_id
    points = MlflowClient(moved).get_metric_history(str(again.run_id), "loss")
    assert [(point.step, point.value) for point in points] == losses(range(8))
    assert "the whole run is sent again" in caplog.text


@pytest.mark.parametrize("tags", [{}, {"framework.key": "another"}])
def test_a_run_of_another_program_or_folder_is_left_alone(folder: Path, tags: dict[str, str]) -> None:
    """The id in run.json may come from an untrusted source, and name any run of the user's store."""
    tracker = open_tracker(folder)
    log(tracker, range(3))
    tracker.leave_open()
    store = client(folder)
    run = store.create_run(store.create_experiment("of the user"), tags=tags)
    again = open_tracker(folder, run_id=run.info.run_id)
    log(again, range(3, 5))
    again.close("FINISHED")
    assert again.run_id not in (None, run.info.run_id)
    left = store.get_run(run.info.run_id)
    assert (left.info.status, left.data.metrics, left.data.params) == ("RUNNING", {}, {})
    assert left.data.tags == run.data.tags


def test_a_store_deleted_while_the_run_goes_on_is_made_again_with_everything(
    folder: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(mlflow_store, "SqlAlchemyStore", copies(empty_store))
    tracker = open_tracker(folder)
    tracker.log_params({"seed": 0})
    log(tracker, range(10))
    wait_for(lambda: len(history(folder)) == 10)
    before = tracker.run_id
    (folder.parents[1] / "mlflow.db").unlink()
    log(tracker, range(10, 20))
    tracker.close("FINISHED")
    assert tracker.run_id != before
    assert history(folder) == losses(range(20))
    assert client(folder).get_run(identity(folder)).data.params == {"seed": "0"}
    assert status(folder) == "FINISHED"
    assert f"contains no run {before}" in caplog.text


def test_a_new_run_in_a_used_folder_sets_the_old_one_aside(folder: Path) -> None:
    first = open_tracker(folder)
    log(first, range(3))
    first.close("FAILED")
    second = open_tracker(folder)
    log(second, range(5))
    second.close("FINISHED")
    assert second.run_id != first.run_id
    assert history(folder) == losses(range(5))
    assert len(list(Journal(folder / "journal.1.jsonl").lines())) == 3
    old = json.loads((folder / "run.1.json").read_text())
    assert (old["run_id"], old["status"]) == (first.run_id, "FAILED")
    third = open_tracker(folder)
    third.close("FINISHED")
    assert (folder / "journal.2.jsonl").exists()
    assert third.run_id not in (first.run_id, second.run_id)


def test_a_run_that_never_reached_its_store_goes_on_as_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:

        def away(info: RunInfo) -> None:
            raise ConnectionError("away")

        patched.setattr(mlflow_store, "_open_client", away)
        tracker = open_tracker(folder, patience=0.0)
        log(tracker, range(10))
        tracker.leave_open()
    assert tracker.run_id is None
    for resumed, expected in ((None, range(20)), (False, range(5))):
        again = open_tracker(folder, resumed=resumed)
        if resumed is None:
            again.drop_after(4)
        log(again, range(5, 20) if resumed is None else range(5))
        again.close("FINISHED")
        assert history(folder) == losses(expected)


@pytest.mark.slow
def test_four_processes_begin_at_once_where_there_is_no_store(tmp_path: Path) -> None:
    program = """
import os, sys
from pathlib import Path
import framework.tracking.mlflow_store
from framework.tracking.run_info import Destination, read_run_info
from framework.tracking.tracker import MlflowTracker

children = []
for number in range(4):
    child = os.fork()
    if child == 0:
        folder = Path(sys.argv[1]) / str(number)
        tracker = MlflowTracker(
            folder, Destination(None, "new/experiment", str(number)), opening_patience=300.0, patience=300.0,
        )
        tracker.open()
        reached = tracker.run_id is not None and not tracker._sender._away_since
        tracker.log_metrics({"loss": number / 7}, number, 0)
        tracker.close("FINISHED")
        os._exit(0 if reached and read_run_info(folder).sent == tracker.journal.last else 1)
    children.append(child)
sys.exit(sum(os.waitpid(child, 0)[1] != 0 for child in children))
"""
    outputs = tmp_path / "outputs"
    done = subprocess.run(
        [sys.executable, "-c", program, outputs], timeout=600, check=False, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert [history(outputs / str(number)) for number in range(4)] == [losses([n]) for n in range(4)]
    assert Counter(status(outputs / str(number)) for number in range(4)) == {"FINISHED": 4}
    names = {experiment.name for experiment in client(outputs / "0").search_experiments()}
    assert names == {"new/experiment", "Default"}
    assert not list(outputs.glob(".*partial*"))


def test_a_store_whose_making_was_cut_short_is_made_again(
    tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mlflow.db"
    info = RunInfo(None, f"sqlite:///{path}", "e", "r", None, str(tmp_path), "key", 0.0, "RUNNING")
    make_quickly = copies(empty_store)

    class Killed(BaseException):
        pass

    class CutShort:
        def __init__(self, uri: str, artifacts: str) -> None:
            file = Path(uri.removeprefix("sqlite:///"))
            assert file != path
            file.write_bytes(b"half a store")
            raise Killed

    monkeypatch.setattr(mlflow_store, "SqlAlchemyStore", CutShort)
    with pytest.raises(Killed):
        mlflow_store._open_client(info)
    assert not path.exists()
    with subprocess.Popen([sys.executable, "-S", "-c", ""]) as dead:
        pass
    left = (
        tmp_path / f".mlflow.db.{socket.gethostname()}.1.{dead.pid}.partial"
    )  # by a process that was killed
    left.write_bytes(b"half a store")
    monkeypatch.setattr(mlflow_store, "SqlAlchemyStore", make_quickly)
    _, experiment = mlflow_store._open_client(info)
    assert MlflowClient(info.uri).get_experiment(experiment).name == "e"
    assert not list(tmp_path.glob(".*partial"))


# One process to a folder


def test_nobody_else_touches_a_living_run(folder: Path) -> None:
    program = """
import sys
from pathlib import Path
from framework.errors import DataError
from framework.tracking import ended, tracker as tracking

for act in (
    ended.sync,
    ended.mark_dead,
    lambda folder: tracking.NoTracker(folder).open(),
):
    try:
        act(Path(sys.argv[1]))
    except DataError as error:
        assert "another process" in str(error), error
    else:
        sys.exit("it was allowed")
"""
    tracker = open_tracker(folder)
    subprocess.run([sys.executable, "-c", program, folder], check=True, timeout=120)
    log(tracker, [1])
    tracker.close("FINISHED")
    assert history(folder) == losses([1])


# Without a store


def test_no_tracker_keeps_the_journal(tmp_path: Path) -> None:
    tracker = NoTracker(tmp_path)
    tracker.open()
    tracker.log_params({"seed": 0})
    tracker.set_tags({"a": "b"})
    tracker.log_artifact(tmp_path / "missing")
    log(tracker, range(5))
    info = read_run_info(tmp_path)
    assert info is not None
    assert info.status == "RUNNING"
    assert tracker.run_id is None
    assert tracker.url == str(tmp_path / "journal.jsonl")
    tracker.leave_open()
    again = NoTracker(tmp_path)
    again.open()
    again.drop_after(2)
    log(again, range(3, 7))
    again.close("FINISHED")
    assert [line.step for line in again.journal.lines()] == list(range(7))
    info = read_run_info(tmp_path)
    assert info is not None
    assert info.status == "FINISHED"
    with pytest.raises(DataError, match="logger=none"):
        sync(tmp_path)
    fresh = NoTracker(tmp_path)
    fresh.open()
    fresh.close("FINISHED")
    assert list(fresh.journal.lines()) == []
    assert len(list(Journal(tmp_path / "journal.1.jsonl").lines())) == 7


def test_a_dead_run_without_a_store(tmp_path: Path) -> None:
    tracker = NoTracker(tmp_path)
    tracker.open()
    tracker.journal.close()
    assert mark_dead(tmp_path)
    info = read_run_info(tmp_path)
    assert info is not None
    assert info.status == "KILLED"
    assert not mark_dead(tmp_path / "nothing here")


# Addresses and run.json


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("sqlite:////abs/mlflow.db", "sqlite:////abs/mlflow.db"),
        ("sqlite:////abs/mlflow.db?timeout=1", "sqlite:////abs/mlflow.db?timeout=1"),
        ("http://host:5000", "http://host:5000"),
        ("https://host", "https://host"),
        ("postgresql+psycopg2://user@host/db", "postgresql+psycopg2://user@host/db"),
        ("databricks", "databricks"),
    ],
)
def test_absolute_addresses_of_stores_are_unchanged(uri: str, expected: str) -> None:
    assert store_uri(uri) == expected


def test_relative_addresses_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert store_uri("sqlite:///a/b.db?timeout=1") == f"sqlite:///{tmp_path}/a/b.db?timeout=1"
    assert default_uri(Path("outputs/a/b")) == f"sqlite:///{tmp_path}/outputs/mlflow.db"
    assert default_uri(Path("elsewhere/run")) == f"sqlite:///{tmp_path}/elsewhere/mlflow.db"


@pytest.mark.parametrize(
    "uri", ["file:///tmp/mlruns", "./mlruns", "sqlite:///", "sqlite:///:memory:", "http://", "ftp://a"]
)
def test_addresses_that_keep_nothing_are_refused(uri: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"logger\.uri="):
        build(tmp_path, uri=uri)


def test_what_to_type_to_see_a_run(folder: Path) -> None:
    tracker = build(folder)
    assert tracker.url == f"mlflow ui --backend-store-uri {default_uri(folder)}"
    remote = build(folder, uri="https://me:pass@host:5000/", run_id="12")
    remote._wanted = replace(remote._wanted, experiment_id="7")
    assert remote.url == "https://host:5000/#/experiments/7/runs/12"
    assert without_password("postgresql://me:p@db/x") == "postgresql://db/x"


def test_damaged_run_json_is_said(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(DataError, match=r"run\.json: cannot be read"):
        read_run_info(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(DataError, match=r"run\.json: cannot be read"):
        NoTracker(tmp_path).open()
    assert read_run_info(tmp_path / "missing") is None


def test_run_json_of_a_later_version_can_be_read(tmp_path: Path) -> None:
    info = RunInfo("1", "sqlite:///x", "e", "r", None, None, "key", 0.5, "RUNNING", owed=(("a", "b"),))
    Sidecar(tmp_path, info).update(sent=4)
    path = tmp_path / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "new": 1}))
    assert read_run_info(tmp_path) == replace(info, sent=4)


def test_run_json_that_cannot_be_written_stops_nobody(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = open_tracker(folder)
    monkeypatch.setattr("framework.tracking.run_info.write_whole", on_a_full_disk)
    log(tracker, range(5))
    tracker.close("FINISHED")
    assert history(folder) == losses(range(5))
    assert "run.json could not be written" in caplog.text


# Finding a run again


def test_the_folder_of_a_run_or_a_copy_of_its_checkpoints(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    tracker = open_tracker(folder)
    (folder / "model.ckpt").write_text("weights")
    tracker.log_artifact(folder / "model.ckpt", "checkpoints")
    tracker.close("FINISHED")
    run_id = str(tracker.run_id)
    assert run_folder(run_id) == folder
    shutil.move(folder, tmp_path / "moved")
    assert (run_folder(run_id) / "checkpoints" / "model.ckpt").read_text() == "weights"
    # another run was made in the folder since, or what was there cannot be read
    for left in ('{"run_id": "another"}', "{}", None):
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(tmp_path / "moved", folder)
        (folder / "model.ckpt").write_text("another's weights")
        described = folder / "run.json"
        kept = json.loads(described.read_text(encoding="utf-8"))
        if left is None:
            described.unlink()
        else:
            described.write_text(json.dumps({**kept, **json.loads(left)}) if left != "{}" else left)
        found = run_folder(run_id)
        assert found != folder
        assert (found / "checkpoints" / "model.ckpt").read_text() == "weights"
    with pytest.raises(CheckpointError, match="cannot be read from"):
        run_folder("0" * 32)
    with pytest.raises(CheckpointError, match="There is no tracking store"):
        run_folder(run_id, "sqlite:///missing.db")
    assert not (tmp_path / "missing.db").exists()


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DataFrame]:
    """A checkpoint of a model that reads a table, and rows for it."""
    folder = tmp_path_factory.mktemp("trained")
    lines = [f"{row},{row % 7},{1e6 * row}" for row in range(40)]
    (folder / "table.csv").write_text("width,height,mass\n" + "\n".join(lines))
    parts = assemble(
        Settings.of(
            {
                "data": {
                    "name": "tabular",
                    "path": str(folder / "table.csv"),
                    "target": "mass",
                    "kind": "real",
                },
                "encoder": {"mlp": {"name": "mlp", "widths": [4]}},
                "density_head": {"name": "gaussian"},
            }
        )
    ).parts
    data = build_data(parts)
    data.prepare()
    predictor = build_predictor(parts, data.target, data.input_shape, 0, data.columns)
    content = {
        "framework": Description.of(parts, data, "mine", Settings(seed=3, samples=10)).stored(),
        "state_dict": {f"{PREFIX}{name}": value for name, value in predictor.state_dict().items()},
    }
    WholeCheckpoints().save_checkpoint(content, folder / "model.ckpt")
    return folder / "model.ckpt", DataFrame({"height": [1.0, 5.0], "width": [3, 40]})


def test_a_runs_model_is_one_of_mlflow_that_answers_raw_rows(
    folder: Path, trained: tuple[Path, DataFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)  # MLflow makes a store where it loads a model
    checkpoint, rows = trained
    tracker = open_tracker(folder, run_name="mine, seed=3")
    facts = {"root": "table.csv", "sha256": "ab" * 32, "train": "28", "synthetic": "false"}
    tracker.log_dataset("tabular", "training", facts)
    (folder / "model.ckpt").write_bytes(checkpoint.read_bytes())
    tracker.log_artifact(folder / "model.ckpt", MODEL)
    tracker.close("FINISHED")
    for _ in range(2):  # a sending that was cut short begins again
        run = client(folder).get_run(identity(folder))
        (used,), (made,) = run.inputs.dataset_inputs, run.outputs.model_outputs
        assert (used.dataset.name, used.dataset.digest, used.tags[0].value) == (
            "tabular",
            "ab" * 8,
            "training",
        )
        assert json.loads(used.dataset.profile) == facts
        model = client(folder).get_logged_model(made.model_id)
        assert (model.name, str(model.status), model.source_run_id) == ("mine", "READY", run.info.run_id)
        info = read_run_info(folder)
        assert info is not None
        Sidecar(folder, info).update(sent=0)
        sync(folder)
    stored = [path.name for path in (folder.parents[1] / "artifacts").rglob("*") if path.is_file()]
    assert sorted(stored) == ["MLmodel", "model.ckpt"], "the weights lie in the store once"

    served = load_model(model.artifact_location)
    answer = served.predict(rows)
    density = load(checkpoint)(rows)
    assert list(answer) == ["mass", "entropy_nats", "mass_mode"]
    assert answer["mass_mode"].tolist() == density.mode.flatten().tolist()
    assert answer["entropy_nats"].tolist() == density.entropy().tolist()
    with pytest.raises(MlflowException, match=r"reads the column 'height', which the data do not have\."):
        served.predict(rows[["width"]])

    shutil.move(folder, tmp_path / "moved")
    copy = run_folder(run.info.run_id, default_uri(folder))
    assert load(copy)(rows).mode.equal(density.mode)


@pytest.mark.parametrize(("name", "expected"), [(None, "tabular"), ("tables/gaussian", "tables")])
def test_a_sweep_over_stored_models_is_in_the_experiment_of_its_jobs(
    trained: tuple[Path, DataFrame], tmp_path: Path, name: str | None, expected: str
) -> None:
    content = checkpoints.read(trained[0])
    content["framework"]["settings"]["experiment_name"] = name
    folders = [tmp_path / number for number in "01"]
    for run in folders:
        (run / "checkpoints").mkdir(parents=True)
        checkpoints.write(content, run / "checkpoints" / "model.ckpt")
    model = {"checkpoint": str(folders[0])}
    chosen = {"data": {"name": "moons"}}
    for config, experiment in (
        ({"mode": {"name": "test"}, **model}, expected),
        ({"mode": {"name": "predict"}, **model, "experiment_name": "mine/run"}, "mine"),
        ({"mode": {"name": "test"}, **model, "logger": {"experiment": "mine"}}, "mine"),
        ({"mode": {"name": "combine", "members": str(tmp_path)}}, expected),
        ({"mode": {"name": "combine", "members": [str(run) for run in folders]}}, expected),
        (
            {"mode": {"name": "train"}, **model, **chosen},
            "moons",
        ),  # its experiment is not that of the weights
        ({"mode": {"name": "test"}, "checkpoint": "nowhere", **chosen}, "moons"),  # the jobs report the error
    ):
        assert experiment_of(config) == experiment, config


def test_a_run_without_checkpoints_is_said(folder: Path) -> None:
    tracker = open_tracker(folder)
    tracker.close("FINISHED")
    shutil.rmtree(folder)
    with pytest.raises(CheckpointError, match="has no checkpoints"):
        run_folder(str(tracker.run_id), default_uri(folder))


# What it costs who does not use it


def test_nothing_heavy_is_imported_before_a_store_is_opened() -> None:
    program = (
        "import sys, framework.tracking.journal, framework.tracking.tracker, framework.runs.provenance\n"
        "assert not {'mlflow', 'torch', 'pytorch_lightning', 'sqlalchemy', 'numpy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_mlflow_reports_to_nobody() -> None:
    assert os.environ["MLFLOW_DISABLE_TELEMETRY"] == "true"
