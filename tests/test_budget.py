"""Budgets: the cheapest setting of a model's knobs that meets a limit, and the refusal of limits that cannot be met."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import pytest
import torch
from torch.distributions import Distribution, Independent, Normal

import framework as product
from framework.configuration.schema import build, check, resolve
from framework.configuration.settings import BudgetSettings
from framework.data import Data
from framework.datasets.fields import Fields
from framework.density_head import DensityHead
from framework.errors import ConfigError
from framework.evaluation import cost
from framework.evaluation.budget import Bench, Errors, meet_budget
from framework.model import Model
from framework.target import Target
from tests.conftest import Framework

TARGET = Target("real", ("y",))
COUNT = 40
SECONDS = 0.004
"""Time that one sample of `Slow` takes, for a batch; with batches of ten, 0.4 ms per sample of the data."""


CLOCK = SimpleNamespace(now=0.0)
"""Clock of the run times, which `Slow` advances, so that they do not depend on other programs."""


class Slow(DensityHead):
    """A normal density whose location is wrong by 1 / samples; each sample takes `SECONDS` of `CLOCK`."""

    bibtex = ""
    size = 1
    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"samples": (1, 2, 8)}
    samples, useful = 8, 8

    def forward(self, raw: torch.Tensor) -> Distribution:
        CLOCK.now += SECONDS * self.samples
        wrong = 1 / min(self.samples, self.useful)
        return Independent(Normal(torch.full_like(raw, wrong), 1.0), 1)


def model(**attributes: Any) -> tuple[Model, Slow]:
    head = Slow()
    for name, value in attributes.items():
        setattr(head, name, value)
    return Model([], head, (1,)).eval(), head


def meet(predictor: Model, location: float = 0.0, spread: float = 0.0, **budget: Any) -> str:
    """Return the sentence of `meet_budget` on normal targets with this location and spread."""
    target = location + spread * torch.randn(COUNT, 1, generator=torch.Generator().manual_seed(0))
    fields = {"input": target, "target": target, "group": torch.zeros(COUNT, dtype=torch.int64)}
    data = SimpleNamespace(splits=lambda: SimpleNamespace(validation=Fields(**fields)))
    metrics = [build("metric", resolve("metric", "nll"), target=TARGET)]
    limits = BudgetSettings.model_validate(check(BudgetSettings, {"batch_size": 10, **budget}, "budget"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cost, "time", SimpleNamespace(perf_counter=lambda: CLOCK.now))
        return meet_budget(predictor, cast(Data, data), metrics, limits, samples=3, seed=0)


@pytest.mark.parametrize(
    ("attributes", "budget", "samples", "reason"),
    [
        ({}, {"milliseconds": 1.9}, 2, "the best of 2 settings within budget.milliseconds=1.9"),
        ({"useful": 2}, {"milliseconds": 99}, 2, "the best of 3 settings"),
        ({}, {"error": 1.1}, 2, "the cheapest of 3 with nll at most 1.1"),
        ({"useful": 2}, {"error": 9}, 1, "the cheapest of 3 with nll at most 9"),
        ({"samples": 4}, {"milliseconds": 2.9}, 4, "the best of 3 settings"),
    ],
)
def test_the_cheapest_setting_that_meets_a_budget_is_set(
    attributes: dict[str, Any], budget: dict[str, Any], samples: int, reason: str
) -> None:
    predictor, head = model(**attributes)
    before = head.samples
    sentence = meet(predictor, **budget)
    assert head.samples == samples
    assert sentence.startswith(f"budget: samples={samples} takes ") and reason in sentence
    assert (f"Before, samples={before} took" in sentence) == (before != samples)
    assert f"errors with the first {COUNT} validation samples" in sentence


def test_a_cheap_setting_that_is_as_good_as_the_best_is_set() -> None:
    """Targets around the middle of the locations of samples=2 and samples=8 hardly prefer one of them."""
    predictor, head = model()
    sentence = meet(predictor, 0.35, 1.0, milliseconds=99)
    assert head.samples == 2 and "the cheapest that is within one standard error of samples=8" in sentence


@pytest.mark.parametrize(
    ("attributes", "budget", "message"),
    [
        ({}, {"milliseconds": 0.1}, r"The nearest is samples=1, with [0-9.]+ ms per sample"),
        ({}, {"error": 0.5}, r"The nearest is samples=8, with nll 0\.9[0-9]+ "),
        ({"knobs": {}}, {"error": 2}, "No part of this model has a knob"),
        ({}, {"milliseconds": 1, "metric": "nl"}, "Did you mean 'nll'"),
        ({}, {"milliseconds": -1}, "budget.milliseconds"),
        ({}, {"milliseconds": 0}, "budget.milliseconds"),
        ({}, {"error": float("nan")}, "budget.error"),
        ({}, {"milliseconds": 1, "error": 1}, "both set"),
        ({}, {"metric": "nll"}, "has no effect without a limit"),
        ({}, {"seconds": 1}, "seconds"),
    ],
)
def test_a_bad_budget_is_refused_and_changes_nothing(
    attributes: dict[str, Any], budget: dict[str, Any], message: str
) -> None:
    predictor, head = model(**attributes)
    with pytest.raises(ConfigError, match=message):
        meet(predictor, **budget)
    assert head.samples == 8


def test_a_setting_that_meets_an_error_only_by_luck_is_not_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The setting samples=1 has an error within the limit with the first draws only."""

    def errors(bench: Bench, setting: tuple[int, ...], repeat: int = 0) -> Errors:
        return Errors(1.0 if repeat == 0 else 6.0 / setting[0], 0.1, (1.0, 1.0))

    monkeypatch.setattr(Bench, "errors", errors)
    predictor, head = model()
    assert "also with other draws" in meet(predictor, error=4.0)
    assert head.samples == 2


@pytest.mark.parametrize("level", [1e-3, 1.0, 1e4])
def test_of_settings_that_differ_by_rounding_the_fastest_is_chosen(
    monkeypatch: pytest.MonkeyPatch, level: float
) -> None:
    """Each further sample lowers the error of all batches by the same share, which is float32 rounding."""

    def errors(bench: Bench, setting: tuple[int, ...], repeat: int = 0) -> Errors:
        value = level * (1 - 1e-7 * setting[0])
        return Errors(value, 0.1 * level, (value, 2 * value, 3 * value))

    monkeypatch.setattr(Bench, "errors", errors)
    monkeypatch.setattr(Bench, "_times", lambda _, settings, calls: [float(count) for (count,) in settings])
    predictor, head = model()
    meet(predictor, milliseconds=1e6)
    assert head.samples == 1


def test_an_ensemble_is_loaded_and_predicts_with_fewer_members(
    framework: Framework, monkeypatch: pytest.MonkeyPatch
) -> None:
    # on a busy machine two members may take less time than one
    monkeypatch.setattr(
        Bench, "_times", lambda _, settings, calls: [float(members) for (members,) in settings]
    )
    run = framework(
        "experiment=moons/ensemble", "trainer.max_epochs=2", "uncertainty.ensemble.members=3",
        "metric=[nll]", "pictures=false", "logger=none", folder="trained",
    ).folder  # fmt: skip
    loaded = product.load(run, budget={"error": 1e3})
    wrapper = next(module for module in loaded.modules() if hasattr(module, "members"))
    assert wrapper.members == 1 and "budget: members=1" in repr(loaded)
    density = loaded(torch.zeros(2, 2))
    assert density.batch_shape == (2,) and density.names == ("upper", "lower")

    done = framework("mode=predict", f"checkpoint={run}", "budget.error=1e3", "logger=none")
    assert done.code == 0 and "budget: members=" in done.out, done.out
    done = framework("mode=predict", f"checkpoint={run}", "budget.error=-1", "logger=none")
    assert done.code == 2 and "The nearest is members=" in done.out, done.out
    done = framework(
        "mode=predict", f"checkpoint={run}", "budget.error=1", "budget.batch_size=8", "logger=none"
    )
    assert done.code == 2 and "Leave budget.batch_size out" in done.out, done.out
    done = framework("mode=test", f"checkpoint={run}", "budget.error=1", "logger=none")
    assert done.code == 2 and "mode=test reads no budget" in done.out, done.out
