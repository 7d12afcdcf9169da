"""Further forms of a run's record: they hold the numbers of the journal, and never stop a run."""

import csv
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from framework.configuration.command_line import _list_loggers
from framework.errors import ConfigError
from framework.tracking import copies
from framework.tracking.copies import Copy, CopyingTracker, CsvCopy, TensorBoardCopy
from framework.tracking.journal import Journal
from framework.tracking.tracker import NoTracker, Status
from tests.conftest import TINY, Framework

BAD = [
    ("logger=[mlflw]", "Did you mean 'mlflow'"),
    ("logger=[none,csv]", "or logger=none"),
    ("logger=[]", "one or more"),
]


@pytest.mark.parametrize(
    ("written", "chosen"),
    [
        ("logger=[mlflow,csv]", ["logger=mlflow", "logger.copies=[csv]"]),
        ("logger=[tensorboard,csv]", ["logger=none", "logger.copies=[tensorboard,csv]"]),
        ("logger=[mlflow]", ["logger=mlflow"]),
        ("logger=[none]", ["logger=none"]),
        ("logger=csv", ["logger=csv"]),
        ("logger.uri=[x]", ["logger.uri=[x]"]),
    ],
)
def test_a_list_of_loggers_is_a_store_and_copies(written: str, chosen: list[str]) -> None:
    assert _list_loggers(["seed=1", written]) == ["seed=1", *chosen]


@pytest.mark.parametrize(("written", "said"), BAD)
def test_a_wrong_list_is_refused(written: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        _list_loggers([written])


def journal_numbers(folder: Path) -> dict[tuple[str, int], float]:
    return {
        (name, line.step): value
        for line in Journal(folder / "journal.jsonl").lines()
        for name, value in line.values.items()
    }


def test_a_run_writes_the_numbers_of_its_journal_in_every_form(
    framework: Framework, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("WANDB_MODE", "WANDB_DIR"):
        monkeypatch.delenv(name, raising=False)
    done = framework(*TINY, "logger=[csv,tensorboard,wandb]")
    assert done.code == 0, done.out
    wanted = journal_numbers(done.folder)
    assert len(wanted) > 30
    with (done.folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = {
        (name, int(row["step"])): float(value)
        for row in rows
        for name, value in row.items()
        if value and name not in ("step", "epoch", "time")
    }
    assert {key: value for key, value in wanted.items() if not math.isnan(value)} == {
        key: value for key, value in found.items() if not math.isnan(value)
    }
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator"
    ).EventAccumulator
    events = accumulator(str(done.folder / "tensorboard"))
    events.Reload()
    assert {(name, event.step) for name in events.Tags()["scalars"] for event in events.Scalars(name)} == set(
        wanted
    )
    for name in events.Tags()["scalars"]:
        for event in events.Scalars(name):
            assert event.value == pytest.approx(wanted[name, event.step], rel=1e-6, nan_ok=True)
    (offline,) = (tmp_path / "outputs" / "wandb").glob("offline-run-*")  # nothing is sent
    assert list(offline.glob("*.wandb")) and "Copy stopped" not in done.out
    assert not any(path.is_symlink() for path in done.folder.rglob("*")), (
        "commands would refuse the run folder"
    )


class Broken(Copy):
    """Copy that fails at its first number."""

    def log_params(self, flat: Mapping[str, object]) -> None:
        pass

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        raise OSError("no space left")

    def drop_after(self, step: int) -> None:
        raise AssertionError("a copy that failed is called again")

    def close(self, status: Status, journal: Journal) -> None:
        raise AssertionError("a copy that failed is called again")


def test_a_copy_that_fails_stops_neither_the_run_nor_the_other_copies(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    copies = [Broken(tmp_path, "run", "project"), CsvCopy(tmp_path, "run", "project")]
    tracker = CopyingTracker(NoTracker(tmp_path), copies)
    tracker.open()
    tracker.log_metrics({"loss": 2.0}, 1, 0)
    tracker.log_metrics({"loss": math.nan, "other": 1.0}, 2, 0)
    tracker.drop_after(1)
    tracker.log_metrics({"loss": 0.5}, 2, 0)
    tracker.close("FINISHED")
    with (tmp_path / "metrics.csv").open(newline="") as file:
        assert [row["loss"] for row in csv.DictReader(file)] == ["2.0", "0.5"]
    assert "Broken stopped: OSError: no space left" in caplog.text
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "FINISHED"


def test_a_resumed_run_replaces_the_steps_that_it_repeats(tmp_path: Path) -> None:
    copy = TensorBoardCopy(tmp_path, "run", "project")
    for step in range(6):
        copy.log_metrics({"loss": 1.0}, step, 0)
    copy.drop_after(3)
    for step in (4, 5):
        copy.log_metrics({"loss": 2.0}, step, 0)
    copy.close("FINISHED", Journal(tmp_path / "journal.jsonl"))
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator"
    ).EventAccumulator
    events = accumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [event.value for event in events.Scalars("loss")] == [1.0, 1.0, 1.0, 1.0, 2.0, 2.0]


@pytest.mark.parametrize("form", copies.PACKAGES)
def test_a_missing_package_is_said_with_the_remedy(form: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copies, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=rf"pip install 'robust-visual-learning\[{form}\]'"):
        copies.require_packages([form])
    copies.require_packages(["csv"])
