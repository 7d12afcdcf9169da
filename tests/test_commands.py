"""Commands and loaded models on unusual machines and terminals, and with unusual input of the user."""

import errno
import fcntl
import io
import math
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.distributions import Categorical
from torch.utils.data import DataLoader, Dataset

from framework.configuration.command_line import command_line
from framework.configuration.newest import newest_run
from framework.configuration.settings import OptimizerSettings, store_experiment
from framework.distributions.density import Mixture
from framework.distributions.description import LONGEST, one_line
from framework.errors import LISTED, LISTED_WHOLE, CheckpointError, list_names, nearest_name
from framework.storage import files
from framework.storage.closed_pipes import DroppingWriter
from framework.storage.files import describe_unwritable, hold_lock
from framework.sweeps import jobs
from framework.training.batches import outlive_signals
from framework.training.schedules import WARMUP_SHARE, count_warmup_steps, make_schedule, smooth_factor


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("flags", [["-m"], ["--cfg", "job"], ["--multirun", "-p", "data"]])
def test_flags_stand_anywhere(flags: list[str], place: int) -> None:
    settings = ["seed=1", "batch_size=2", "samples=3"]
    assert command_line([*settings[:place], *flags, *settings[place:]]) == [*flags, *settings]


@pytest.mark.parametrize(
    ("word", "known", "wanted"),
    [
        ("resnet50", ["unet", "mlp"], None),
        ("resnet", ["unet"], None),
        ("regression", ["degrees", "gaussian"], None),
        ("mpl", ["mlp", "unet"], "mlp"),
        ("lr", ["learning_rate", "logger"], "learning_rate"),
        ("moons", ["coil20/scvae", "moons/everything"], "moons/everything"),
        ("outlier", ["outlier_exposure"], "outlier_exposure"),
    ],
)
def test_only_what_is_near_is_suggested(word: str, known: list[str], wanted: str | None) -> None:
    assert nearest_name(word, known) == wanted


@pytest.mark.parametrize("count", [0, 1, LISTED_WHOLE, LISTED_WHOLE + 1, 3000])
def test_a_long_list_is_cut_to_the_nearest(count: int) -> None:
    names = [f"name{number}" for number in range(count)]
    text = list_names("name7", names)
    if count <= LISTED_WHOLE:
        assert text == ", ".join(names)
    else:
        assert text.startswith("name7, ")
        assert text.endswith(f" and {count - LISTED} more")
        assert text.count("name") == LISTED


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP])
@pytest.mark.parametrize("records", [True, False], ids=["record locks", "no locks"])
def test_a_file_system_without_flock_takes_a_sweep(
    number: int,
    records: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def refuse(*arguments: Any) -> None:
        raise OSError(number, os.strerror(number))

    class Lock:
        def __init__(self, *arguments: Any, **keywords: Any) -> None: ...

        acquire = refuse

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(files, "FileLock", Lock)
    if not records:
        monkeypatch.setattr(fcntl, "lockf", refuse)
    with hold_lock(tmp_path / "lock"), hold_lock(tmp_path / "lock"):
        pass
    job = jobs.Job(0, [], [], tmp_path, "", "")
    for _ in range(2):
        descriptor = jobs._lock(job)
        assert descriptor is not None
        os.close(descriptor)
    assert ("does not support locks" in caplog.text) == (not records)


def test_output_that_nobody_reads_is_dropped() -> None:
    reads, writes = os.pipe()
    stream = io.TextIOWrapper(io.BufferedWriter(DroppingWriter(writes, "wb")), line_buffering=True)
    stream.write("first\n")
    assert os.read(reads, 6) == b"first\n"
    os.close(reads)
    for _ in range(3):
        stream.write("nobody\n" * 10_000)
    stream.flush()
    assert Path(f"/proc/self/fd/{writes}").readlink() == Path(os.devnull)
    stream.close()


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_a_folder_that_cannot_be_made_gets_a_sentence(number: int) -> None:
    def mkdir() -> None:
        raise OSError(number, os.strerror(number), "/proc/self/x")

    with pytest.raises(OSError, match="proc") as caught:
        mkdir()
    assert "/proc/self/x cannot be written" in str(describe_unwritable(caught.value))
    missing = OSError(errno.ENOENT, "none", "x")
    assert describe_unwritable(missing) is None


@pytest.mark.parametrize("kind", ["constant", "cosine", "plateau", "step"])
@pytest.mark.parametrize("steps", [1, 9, 10, 40, 999, 1000, 1001, 50_000])
@pytest.mark.parametrize("asked", [0, 20, 100])
def test_warm_up_is_a_share_of_the_run(kind: str, steps: int, asked: int) -> None:
    more = {"milestones": [2]} if kind == "step" else {}
    chosen = OptimizerSettings(schedule=kind, warmup_steps=asked, **more)
    factor = make_schedule(chosen, steps, 5)
    assert count_warmup_steps(chosen, steps) <= WARMUP_SHARE * steps
    if steps >= asked / WARMUP_SHARE:
        assert count_warmup_steps(chosen, steps) == asked
    if kind == "cosine" and steps >= 4 * asked:  # not a bit of a long training changes
        expected = [
            min(1.0, (step + 1) / (asked + 1)) * 0.5 * (1 + math.cos(math.pi * min(1.0, step / steps)))
            for step in range(0, steps, 97)
        ]
        assert [factor(step) for step in range(0, steps, 97)] == expected
    if kind == "cosine" and steps >= 10:
        assert max(factor(step) for step in range(steps)) > 0.8
    assert smooth_factor(0, total=None) == 1


def test_the_newest_run_is_that_whose_checkpoint_is_newest(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no run in that folder has a checkpoint"):
        newest_run(tmp_path)
    for age, name in enumerate(["a/2", "b/1", "sweeps/x/0"]):
        folder = tmp_path / name / "checkpoints"
        folder.mkdir(parents=True)
        (folder / "model.ckpt").touch()
        os.utime(folder / "model.ckpt", (100 - age % 2, 100 - age % 2))
    os.utime(tmp_path / "b" / "1" / "checkpoints" / "model.ckpt", (200, 200))
    (tmp_path / "c" / "checkpoints").mkdir(parents=True)  # it has not trained for an epoch
    assert newest_run(tmp_path) == tmp_path / "b" / "1"


@pytest.mark.parametrize(
    ("config", "wanted"),
    [
        ({}, "Default"),
        ({"experiment_name": None, "data": {"name": "tabular"}}, "tabular"),
        ({"experiment_name": "moons/scvae", "data": {"name": "tabular"}}, "moons"),
        ({"experiment_name": "moons/scvae", "logger": {"experiment": "mine"}}, "mine"),
    ],
)
def test_no_run_goes_to_an_experiment_called_default(config: dict[str, Any], wanted: str) -> None:
    assert store_experiment(config) == wanted
    # a stored model, which a command without data tests
    assert store_experiment(config, "moons") == (wanted if wanted != "Default" else "moons")


@pytest.mark.parametrize("names", [(), ("cat", "dog"), tuple(map(str, range(100)))], ids=len)
@pytest.mark.parametrize("rows", [1, 3, 1000])
def test_a_density_says_what_it_is_in_one_line(rows: int, names: tuple[str, ...]) -> None:
    density = Mixture(torch.zeros(rows, 2), Categorical(logits=torch.randn(rows, 2, 2)))
    density.names = names  # type: ignore[attr-defined]
    line = repr(density)
    assert line == one_line(density)
    assert line.startswith(f"Mixture(batch=({rows},), event=()")
    assert "\n" not in line
    assert len(line) <= LONGEST
    assert ("cat" in line) == ("cat" in names)
    assert "components=Categorical" in line or names


class _Slow(Dataset[int]):
    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> int:
        if index == 2:
            os.kill(os.getpid(), signal.SIGTERM)  # as one to all processes of a run
        return index


def test_data_workers_outlive_a_signal_to_all_processes() -> None:
    loader = DataLoader(_Slow(), num_workers=1, worker_init_fn=outlive_signals)
    assert [int(item) for item in loader] == list(range(8))
