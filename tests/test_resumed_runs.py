"""Runs that fail or start from a checkpoint: their remaining files, refusals, and work that is done only once."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from framework.configuration import assembly, composition, loading
from framework.configuration.config import Config
from framework.data import Data
from framework.errors import CheckpointError, DataError
from framework.modes import calibrate, train
from framework.modes import test as testing
from framework.runs import run as runs
from framework.runs import session
from framework.runs.resuming import blame_checkpoint
from framework.runs.run import TRACEBACK, open_run
from framework.tracking.run_info import read_run_info
from framework.tracking.signals import Stopped
from plugins.data.moons.data import Moons
from tests.test_tracking import build, client, empty_store, folder, identity, impatient

__all__ = ["empty_store", "folder", "impatient"]

SMALL = (
    *("data=moons", "data.train=60", "data.validation=40", "data.test=40", "encoder=[mlp]"),
    *("encoder.mlp.widths=[4]", "density_head=bernoulli", "metric=[accuracy,nll]", "batch_size=20"),
    *("trainer.max_epochs=1", "logger=none", "threads=1", "pictures=false"),
)
Composed = Callable[..., Config]


@pytest.fixture
def composed() -> Iterator[Composed]:
    """Return the config of a command."""

    def config(folder: Path, *overrides: str) -> Config:
        values = composition.plain(compose("config", ["experiment_name=test", *overrides]))
        return Config.of({**values, "experiment_name": None}, folder, overrides)

    composition.register()
    with initialize_config_dir(str(composition.folder()), version_base="1.3"):
        yield config
    GlobalHydra.instance().clear()


def fail_in(module: str) -> None:
    """Raise an error in a function of a module of this name, in torch."""
    space: dict[str, Any] = {"__name__": module, "torch": torch}
    exec(compile("def fail():\n    return torch.zeros(2) @ torch.zeros(3)\n", f"{module}.py", "exec"), space)
    space["fail"]()


@pytest.mark.parametrize(
    ("module", "epochs", "kind", "message"),
    [
        (
            "plugins.encoder.mine",
            1,
            CheckpointError,
            r"a plugin failed at plugins\S*:2 \(RuntimeError: ",
        ),
        (
            "pytorch_lightning.loops",
            1,
            CheckpointError,
            r"^last\.ckpt: The training cannot continue from this",
        ),
        ("plugins.encoder.mine", 2, RuntimeError, "inconsistent tensor size"),
    ],
)
def test_an_error_in_the_first_epoch_of_a_resumed_run_leads_to_its_cause(
    module: str, epochs: int, kind: type[Exception], message: str
) -> None:
    training: Any = SimpleNamespace(begun_epochs=epochs)
    with pytest.raises(kind, match=message), blame_checkpoint(Path("last.ckpt"), training):
        fail_in(module)


@pytest.mark.parametrize("error", [KeyError("x"), DataError("bad"), KeyboardInterrupt()], ids=repr)
def test_a_run_that_has_finished_says_no_error_any_more(
    error: BaseException, folder: Path, composed: Composed, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = composed(folder, *SMALL[:-3])
    monkeypatch.setattr(runs, "_tracker", lambda config, run_id, resumed: build(folder, run_id=run_id))
    with pytest.raises(type(error)), open_run(config):
        raise error
    tags = client(folder).get_run(identity(folder)).data.tags
    assert "error" in tags and (folder / TRACEBACK).is_file()
    with open_run(config) as run:
        assert run.resumed
    found = client(folder).get_run(identity(folder))
    assert found.info.status == "FINISHED" and "error" not in found.data.tags
    assert not (folder / TRACEBACK).exists()


def numbers(folder: Path) -> dict[str, torch.Tensor]:
    return loading.read_stored(folder)[1]


@pytest.mark.parametrize("place", ["calibrate", "save", "report_test"])
@pytest.mark.parametrize(
    "how", [Stopped(signal.SIGTERM), pytest.param(OSError("disk"), marks=pytest.mark.slow)], ids=repr
)
def test_a_calibration_that_was_stopped_leaves_the_model_whole_and_can_be_repeated(
    place: str, how: BaseException, tmp_path: Path, composed: Composed
) -> None:
    train.run(composed(tmp_path / "plain", *SMALL))
    source = tmp_path / "plain" / "checkpoints" / "model.ckpt"
    before = source.read_bytes()
    words = ("mode=calibrate", f"checkpoint={tmp_path / 'plain'}", "uncertainty=[temperature]", *SMALL[-3:])
    calibrate.run(composed(tmp_path / "whole", *words))

    def stopped(*given: object, **named: object) -> None:
        raise how

    config = composed(tmp_path / "again", *words)
    with pytest.MonkeyPatch.context() as planted:
        planted.setattr(*{"save": (torch, "save")}.get(place, (calibrate, place)), stopped)
        with pytest.raises((type(how), CheckpointError, DataError)):
            calibrate.run(config)
    assert source.read_bytes() == before
    info = read_run_info(tmp_path / "again")
    assert info is not None and info.status == ("KILLED" if isinstance(how, Stopped) else "FAILED")
    if place != "report_test":
        assert not (tmp_path / "again" / "checkpoints" / "model.ckpt").exists()
    calibrate.run(config)
    assert source.read_bytes() == before
    info = read_run_info(tmp_path / "again")
    assert info is not None and info.status == "FINISHED"
    first, second = numbers(tmp_path / "whole"), numbers(tmp_path / "again")
    assert all(torch.equal(second[name], tensor) for name, tensor in first.items())
    testing.run(composed(tmp_path / "tested", "mode=test", f"checkpoint={tmp_path / 'again'}", *SMALL[-3:]))


@pytest.mark.parametrize(
    "change", ["encoder.mlp.widths=[5]", "encoder.mlp.batch_norm=true", "density_head=categorical"]
)
def test_a_checkpoint_of_another_model_is_refused_before_data_are_read(
    change: str, tmp_path: Path, composed: Composed, monkeypatch: pytest.MonkeyPatch
) -> None:
    train.run(composed(tmp_path / "first", *SMALL))

    def prepare(self: Data) -> None:
        raise AssertionError("data are read")

    monkeypatch.setattr(Moons, "prepare", prepare)
    start = f"checkpoint={tmp_path / 'first'}"
    with pytest.raises(CheckpointError, match="belongs to another model"):
        train.run(composed(tmp_path / "other", *SMALL, start, change))
    assert not (tmp_path / "other").exists()
    with pytest.raises(AssertionError, match="data are read"):
        train.run(composed(tmp_path / "same", *SMALL, start))


def test_a_training_reads_its_checkpoint_and_builds_its_model_and_every_plugin_once(
    tmp_path: Path, composed: Composed, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def counted(module: ModuleType, name: str) -> None:
        function = getattr(module, name)

        def call(*arguments: Any, **named: Any) -> object:
            calls.append(arguments[0] if name == "build" else name)
            return function(*arguments, **named)

        monkeypatch.setattr(module, name, call)

    counted(session, "build_predictor")
    counted(session, "read")
    counted(assembly, "build")
    plugins = ["data", "density_head", "encoder", "metric", "metric"]
    train.run(composed(tmp_path / "first", *SMALL))
    assert sorted(calls) == ["build_predictor", *plugins]
    calls.clear()
    train.run(composed(tmp_path / "second", *SMALL, f"checkpoint={tmp_path / 'first'}"))
    assert sorted(calls) == ["build_predictor", *plugins, "read"]


def test_a_stored_model_is_tested_under_the_name_of_its_data(tmp_path: Path, composed: Composed) -> None:
    train.run(composed(tmp_path / "first", *SMALL))
    config = composed(tmp_path / "tested", "mode=test", f"checkpoint={tmp_path / 'first'}", *SMALL[-3:])
    assert session.for_trained(config).config.trained_on == "moons"


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_batch_norm_wants_more_than_one_row(rows: int, tmp_path: Path, composed: Composed) -> None:
    config = composed(tmp_path / "run", *SMALL, f"batch_size={rows}", "encoder.mlp.batch_norm=true")
    if rows > 1:
        train.run(config)
        return
    with pytest.raises(Exception, match=r"batch norm one value per channel.*Set batch_size"):
        train.run(config)
