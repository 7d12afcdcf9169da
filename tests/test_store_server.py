"""Runs that are sent to an MLflow server on PostgreSQL with passwords, which is killed while they run."""

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from framework.tracking.ended import sync
from framework.tracking.run_info import MODEL, Destination, Sidecar, read_run_info
from framework.tracking.stores import Address
from framework.tracking.tracker import MlflowTracker
from tests.conftest import importing_mlflow
from tests.store_server import Counts, StoreServer, count, missing_parts

with importing_mlflow():
    from mlflow import MlflowClient

RUNS = 4


@pytest.fixture(scope="module")
def server() -> Iterator[StoreServer]:
    if missing := missing_parts():
        pytest.skip(f"the store needs {' and '.join(missing)}")
    # PostgreSQL's user may not enter pytest's folder
    with tempfile.TemporaryDirectory(prefix="store") as folder, StoreServer(Path(folder)) as server:
        yield server


@pytest.fixture
def client(server: StoreServer, monkeypatch: pytest.MonkeyPatch) -> MlflowClient:
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    return MlflowClient(server.uri)


@pytest.mark.slow
def test_runs_lose_nothing_and_send_nothing_twice_when_the_server_is_killed(
    server: StoreServer, client: MlflowClient, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two of the runs end while the server is away, and are sent later."""
    folders = [tmp_path / f"run{number}" for number in range(RUNS)]
    trackers = [
        MlflowTracker(folder, Destination(None, "parallel", folder.name), patience=60.0 * (number < 2))
        for number, folder in enumerate(folders)
    ]
    steps = 0

    def log_until(condition: Callable[[], object], open_trackers: list[MlflowTracker] = trackers) -> None:
        nonlocal steps
        end = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end, caplog.text
            steps += 1
            for number, tracker in enumerate(open_trackers):
                values = {"loss": 1 / steps, "number": number, "bad": float("nan")}
                tracker.log_metrics(values, steps, 0)
            time.sleep(0.05)

    def files(tracker: MlflowTracker) -> None:
        figures = tracker.folder / "figures" / "more"
        figures.mkdir(parents=True)
        (figures / "density.png").write_bytes(bytes(3000))
        tracker.log_artifact(figures.parent)
        (tracker.folder / "model.ckpt").write_bytes(bytes(200_000))
        tracker.log_artifact(tracker.folder / "model.ckpt", MODEL)

    for tracker in trackers:
        tracker.open()
        tracker.log_params({"folder": tracker.folder.name})
    log_until(lambda: all((read_run_info(folder) or pytest.fail()).sent > 20 for folder in folders))
    server.kill()
    for tracker in trackers:
        files(tracker)
    log_until(lambda: caplog.text.count("cannot be reached or written") == RUNS)
    steps_away = steps
    for tracker in trackers[2:]:
        tracker.close("FINISHED")
    assert caplog.text.count("`python -m framework mode=sync mode.run=") == 2
    server.start()
    log_until(lambda: caplog.text.count("can be reached again after") == 2, trackers[:2])
    for tracker in trackers[:2]:
        tracker.close("FINISHED")
    values = [3 * steps, 3 * steps, 3 * steps_away, 3 * steps_away]
    assert count(client, folders[:2]) == Counts(runs=2, values=sum(values[:2]), files=4)
    assert [sync(folder, server.uri) > 0 for folder in folders] == [False, False, True, True]
    for folder in folders:  # as if the process had died before it noted down what was sent
        info = read_run_info(folder)
        assert info is not None
        Sidecar(folder, info.at_store(Address(server.uri, True), folder)).update(sent=0)
        assert sync(folder, server.uri) > 0
    assert count(client, folders) == Counts(runs=RUNS, values=sum(values), files=2 * RUNS)
    experiment = client.get_experiment_by_name("parallel")
    assert experiment is not None
    runs = client.search_runs([experiment.experiment_id])
    assert {(run.info.status, run.data.params["folder"]) for run in runs} == {
        ("FINISHED", folder.name) for folder in folders
    }


@pytest.mark.slow
def test_a_wrong_password_is_said_and_the_run_is_sent_later(
    server: StoreServer, client: MlflowClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    with monkeypatch.context() as wrong:
        wrong.setenv("MLFLOW_TRACKING_PASSWORD", "a-wrong-one")
        tracker = MlflowTracker(
            tmp_path / "run", Destination(None, "one", "run"), opening_patience=60.0, patience=0.0
        )
        tracker.open()
        tracker.log_metrics({"loss": 0.5}, 1, 0)
        tracker.close("FINISHED")
    assert "MLFLOW_TRACKING_PASSWORD" in caplog.text
    assert "a-wrong-one" not in caplog.text
    assert sync(tmp_path / "run", server.uri) == 3
    assert count(client, [tmp_path / "run"]) == Counts(runs=1, values=1)


@pytest.mark.slow
def test_a_run_is_sent_to_a_database_whose_password_no_file_holds(
    server: StoreServer, client: MlflowClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"{server.database}/runs")
    folder = tmp_path / "outputs" / "run"
    tracker = MlflowTracker(folder, Destination(None, "database", "run"))
    tracker.open()
    tracker.log_metrics({"loss": 0.5}, 1, 0)
    tracker.close("FINISHED")
    assert json.loads((folder / "run.json").read_text())["uri"].startswith("postgresql+psycopg2://127.0.0.1:")
    password = server.database.partition("@")[0].rpartition(":")[2].encode()
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and password in path.read_bytes()]
    assert count(client, [folder]) == Counts(runs=1, values=1)
