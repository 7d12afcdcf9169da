"""`optimizer.learning_rate=auto`: a range test before the training finds the learning rate."""

import copy
import json
import math
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pytorch_lightning as pl
import torch
from pytorch_lightning.tuner import Tuner
from torch import nn

from framework.configuration.assembly import assemble, build_predictor
from framework.configuration.schema import build
from framework.configuration.settings import OptimizerSettings, Settings
from framework.data import Data
from framework.errors import CheckpointError, ConfigError
from framework.model import Predictor
from framework.objective import AdversaryOptimizer, Objective
from framework.tracking.signals import Stopper
from framework.training.batches import Batches
from framework.training.module import LoadedBatches
from framework.training.range_test import (
    HIGHEST,
    LOWEST,
    STEPS,
    RangeTest,
    RangeTestResult,
    measure_losses,
    range_test_figure,
    rate_of_step,
    suggest,
)
from tests.conftest import TINY, Framework

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*LeafSpec:FutureWarning",
    "ignore:.*lr_scheduler.step:UserWarning",
    "ignore:.*does not have many workers",
    "ignore:.*not resumable",
    "ignore:.*`training_step` returned `None`",
    "ignore:.*number of training batches",
)
AUTO = [*TINY, "logger=none", "optimizer.learning_rate=auto"]
RATES = [rate_of_step(step) for step in range(STEPS)]
LOGARITHMS = np.log10(RATES)


def moons(**changes: Any) -> tuple[Predictor, Data, Batches]:
    """Return an untrained predictor of classes, its prepared data, and batches."""
    config = {
        "data": "moons",
        "encoder": {"mlp": {"name": "mlp", "widths": [32]}},
        "density_head": "bernoulli",
    }
    resolved = assemble(Settings.of(config | changes)).parts
    data = build("data", resolved["data"])
    data.prepare()
    torch.manual_seed(0)
    return (
        build_predictor(resolved, data.target, (2,), 0),
        data,
        Batches(data, batch_size=32, workers=0, seed=3),
    )


def measured(
    predictor: Predictor, data: Data, batches: Batches, **changes: Any
) -> tuple[list[float], list[float]]:
    optimizer = OptimizerSettings(**({"name": "adam", "learning_rate": "auto"} | changes))
    return measure_losses(predictor, [], data, batches, optimizer, {"accelerator": "cpu"}, Stopper())


def test_rates_and_losses_are_those_of_lightnings_finder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lightning gives an exponential mean of the losses, from which the losses themselves follow.

    Its rates differ a little: the first one is used once, and then each is larger by a factor, up to the highest.
    """
    monkeypatch.setattr(
        "framework.training.range_test.rate_of_step",
        lambda step: LOWEST * (HIGHEST / LOWEST) ** ((step + 1) / STEPS if step else 0),
    )
    predictor, data, batches = moons()
    twin = copy.deepcopy(predictor).train()
    rates, losses = measured(predictor, data, batches)
    settings = OptimizerSettings(name="adam", learning_rate=LOWEST)
    training = RangeTest(twin, [], data, settings, 3, {})
    again = Batches(data, batch_size=32, workers=0, seed=3)
    trainer = pl.Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, max_epochs=STEPS, num_sanity_val_steps=0, default_root_dir=tmp_path,
    )  # fmt: skip
    found = Tuner(trainer).lr_find(
        training, datamodule=LoadedBatches(again, trainer), min_lr=LOWEST, max_lr=HIGHEST, num_training=STEPS,
        early_stop_threshold=None, update_attr=False,
    )  # fmt: skip
    assert found is not None
    smooth = np.array(found.results["loss"])
    sums = smooth * (1 - 0.98 ** np.arange(2, STEPS + 2))
    raw = (sums - 0.98 * np.concatenate([[0.0], sums[:-1]])) / 0.02
    np.testing.assert_allclose(found.results["lr"], rates, rtol=1e-9)
    np.testing.assert_allclose(raw, losses, rtol=1e-4)
    assert len(rates) == len(losses) == STEPS


def test_the_test_changes_nothing_and_repeats_itself() -> None:
    predictor, data, batches = moons()
    before = copy.deepcopy(predictor.state_dict())
    first = measured(predictor, data, batches)
    again = measured(predictor, data, Batches(data, batch_size=32, workers=0, seed=3))
    assert first == again
    for name, value in predictor.state_dict().items():
        assert torch.equal(value, before[name])
    assert first != measured(predictor, data, Batches(data, batch_size=32, workers=0, seed=4))


def test_accumulated_batches_are_one_step() -> None:
    predictor, data, batches = moons()
    optimizer = OptimizerSettings(name="adam", learning_rate="auto")
    arguments = {"accelerator": "cpu", "accumulate_grad_batches": 3, "max_epochs": 1, "profiler": "simple"}
    rates, losses = measure_losses(predictor, [], data, batches, optimizer, arguments, Stopper())
    assert len(losses) == STEPS
    np.testing.assert_allclose(rates, RATES, rtol=1e-12)


class FailsAt(nn.Module):
    """Predictor whose loss is infinite from a call on."""

    def __init__(self, call: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self.call, self.calls = call, 0

    def loss(self, inputs: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return (self.weight + (math.inf if self.calls > self.call else 1.0)).expand(len(inputs))


def test_a_loss_that_is_not_finite_ends_the_test() -> None:
    _, data, batches = moons()
    rates, losses = measured(FailsAt(40), data, batches)  # type: ignore[arg-type]
    assert len(rates) == len(losses) == 40
    with pytest.raises(ConfigError, match="never falls"):
        suggest(rates, [1.0 + 1e-3 * (step % 2) for step in range(40)])
    rates, losses = measured(FailsAt(4), data, Batches(data, batch_size=32, workers=0, seed=3))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="finite in only 4 steps"):
        suggest(rates, losses)


@pytest.mark.parametrize("offset", [0.0, -50.0])
@pytest.mark.parametrize("centre", [-4.5, -3.0, -2.0])
def test_the_rate_is_that_of_the_steepest_fall(centre: float, offset: float) -> None:
    """The loss is a logistic function of the logarithm of the rate, with its steepest slope of -1/4 · height · factor
    at a known place; from a rate on it grows without bound, and falls again from there."""
    noise = np.random.default_rng(0).normal(0, 0.01, STEPS)
    factor = 2.0
    losses = offset + 3 / (1 + np.exp(factor * (LOGARITHMS - centre))) + noise
    diverged = centre + 2 < LOGARITHMS
    losses[diverged] += 1e6 * np.linspace(1, 0, diverged.sum()) + 5
    result = suggest(RATES, losses.tolist())
    assert abs(math.log10(result.learning_rate) - centre) < 0.12
    # the mean slope in a window of one decade around the steepest place
    half = 7 * 7 / 99
    logistic = [1 / (1 + math.exp(factor * side)) for side in (half, -half)]
    assert result.slope == pytest.approx(3 * (logistic[0] - logistic[1]) / (2 * half), rel=0.06)
    assert result.learning_rate < result.lowest < 10 ** (centre + 2.1)
    assert f"{result.learning_rate:.2g}" in result.sentence()


def test_noise_alone_gives_no_rate() -> None:
    """Find a fall in at most 2 % of 400 tests without one."""
    generator = np.random.default_rng(1)
    found = 0
    for _ in range(400):
        try:
            suggest(RATES, generator.normal(1.0, 0.1, STEPS).tolist())
            found += 1
        except ConfigError as error:
            assert "never falls" in str(error)
    assert found <= 8


class Rival(Objective):
    """Objective with an adversary."""

    bibtex = ""

    def __init__(self) -> None:
        super().__init__()
        self.own = nn.Parameter(torch.zeros(1))
        self.adversary_optimizer = AdversaryOptimizer(learning_rate=0.1)

    def forward(self, predictor: Predictor, batch: Any) -> torch.Tensor:
        return self.own.sum()


def test_an_adversary_and_several_processes_are_refused() -> None:
    predictor, data, batches = moons()
    optimizer = OptimizerSettings(learning_rate="auto")
    with pytest.raises(ConfigError, match="Rival trains an adversary"):
        measure_losses(predictor, [Rival()], data, batches, optimizer, {"accelerator": "cpu"}, Stopper())
    two = {"accelerator": "cpu", "devices": 2, "strategy": "ddp"}
    with pytest.raises(ConfigError, match="2 train"):
        measure_losses(predictor, [], data, batches, optimizer, two, Stopper())


@pytest.mark.parametrize("value", ["fast", 0, -1.0, math.inf, math.nan])
def test_other_rates_are_refused(value: Any) -> None:
    with pytest.raises(ConfigError, match=r"optimizer\.learning_rate"):
        Settings.of({"optimizer": {"name": "adam", "learning_rate": value}})


def test_a_file_of_a_strangers_folder_is_checked(tmp_path: Path) -> None:
    result = suggest(RATES, (3 / (1 + np.exp(2 * (LOGARITHMS + 3)))).tolist())
    path = tmp_path / "learning_rate.json"
    result.save(path)
    assert RangeTestResult.read(path) == result
    good = json.loads(path.read_text())
    for change in (
        {"learning_rate": 7},
        {"learning_rate": "1"},
        {"losses": [None]},
        {"rates": 3},
        {"slope": None},
    ):
        path.write_text(json.dumps(good | change))
        with pytest.raises(CheckpointError, match="Start a new run"):
            RangeTestResult.read(path)


def test_the_figure_shows_the_fall(tmp_path: Path) -> None:
    losses = 3 / (1 + np.exp(2 * (LOGARITHMS + 3)))
    losses[-20:] += np.logspace(0, 8, 20)
    result = suggest(RATES, losses.tolist())
    axes = range_test_figure(result, "title", synthetic=True).axes[0]
    low, high = axes.get_ylim()
    assert low < losses.min() and losses[0] < high < 10, "what diverges does not hide the fall"


def test_a_run_finds_its_rate_and_trains_as_with_this_number(framework: Framework) -> None:
    found = framework(*AUTO, "pictures=true", folder="found")
    assert found.code == 0, found.out
    stored = json.loads((found.folder / "learning_rate.json").read_text())
    rate = stored["learning_rate"]
    assert f"learning rate: {rate:.2g}, where the loss of a range test over" in found.out
    assert found.values("learning_rate") == {0: rate}
    assert (found.folder / "figures" / "learning_rate.png").is_file()
    given = framework(*TINY, "logger=none", f"optimizer.learning_rate={rate!r}", folder="given")
    assert given.losses() == found.losses()
    assert given.values("train/learning_rate") == found.values("train/learning_rate")
    assert not (given.folder / "learning_rate.json").exists()


def test_a_resumed_run_keeps_its_rate(framework: Framework, tmp_path: Path) -> None:
    """The rate is read from the run's file, also if the first checkpoint was not reached."""
    whole = framework(*AUTO, folder="whole")
    stopped = framework(
        *AUTO, "+data.signal_at=114", f"+data.signal_number={int(signal.SIGTERM)}",
        f"+data.signal_marker={tmp_path / 'marker'}", folder="stopped",
    )  # fmt: skip
    assert stopped.code == 143, stopped.out
    shutil.rmtree(stopped.folder / "checkpoints")
    (stopped.folder / "checkpoints").mkdir()
    resumed = framework(f"resume={stopped.folder}")
    assert resumed.code == 0, resumed.out
    assert "found when this run began" in resumed.out
    assert resumed.out.count("range test") == 0
    assert stopped.losses() == whole.losses()
    assert stopped.values("learning_rate") == whole.values("learning_rate")


def test_a_loss_that_does_not_fall_ends_the_run_with_a_sentence(framework: Framework) -> None:
    """Targets of random directions cannot be learned; clipping to a tiny norm hinders the fall by other means."""
    done = framework(
        *AUTO, "trainer.gradient_clip_val=1e-12", "optimizer=sgd", "optimizer.learning_rate=auto"
    )
    assert done.code == 2, done.out
    assert "never falls by more than its noise" in done.out
    assert "Set optimizer.learning_rate to a number" in done.out
