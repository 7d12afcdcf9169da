"""Tests of mode=calibrate: a model that is wrapped after training gives the results of one that was trained in its
wrappers."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from scipy import stats
from torch import Tensor, nn
from torch.distributions import Distribution

import framework as package
from framework.configuration import schema
from framework.configuration.loading import read_stored
from framework.distributions.protocol import value_set
from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.model import FrozenFrontEnd, Predictor
from framework.modes import calibrate
from framework.target import Target
from framework.testing.plain import LENGTH, Plain
from framework.uncertainty import Uncertainty
from tests.conftest import Done, Framework

SMALL = (
    *("experiment=moons/vanilla_128", "encoder.mlp.widths=[8]", "data.train=60", "data.validation=40"),
    *("data.test=100", "outliers.test=30", "batch_size=20", "trainer.max_epochs=2", "trainer.patience=null"),
    *("logger=none", "threads=1", "pictures=false"),
)
QUIET = ("logger=none", "threads=1", "pictures=false")
CLASSES, REAL = Target("class", ("a", "b", "c")), Target("real", ("height",))


def numbers(done: Done) -> dict[str, Any]:
    assert done.code == 0, done.out
    found = json.loads((done.folder / "results.json").read_text(encoding="utf-8"))
    costs = ("seconds", "milliseconds", "memory", "folder", "latency", "threads", "experiment")
    return {key: value for key, value in found.items() if not any(one in key for one in costs)}


def test_it_is_the_model_that_was_trained_with_the_wrappers(framework: Framework) -> None:
    plain = framework(*SMALL, folder="plain")
    numbers(plain)
    both = framework(*SMALL, "uncertainty=[temperature,conformal]", folder="both")
    wrapped = ("mode=calibrate", f"checkpoint={plain.folder}", "uncertainty=[temperature,conformal]")
    done = framework(*wrapped, *QUIET, folder="calibrated")
    assert numbers(done) == numbers(both)
    assert numbers(done)["method"] == "vanilla_128 + temperature + conformal"
    for remark in ("temperature: ", "conformal: the threshold is set by 20 validation samples"):
        assert remark in done.out and remark in both.out and remark in str(read_stored(done.folder)[0])
    # what every other mode takes
    again = framework("mode=test", f"checkpoint={done.folder}", *QUIET, folder="again")
    assert numbers(again) == numbers(done) and "set by 20 validation samples" in again.out
    predicted = framework("mode=predict", f"checkpoint={done.folder}", *QUIET[:2], folder="predicted")
    assert predicted.code == 0 and "set" in (predicted.folder / "predictions.csv").read_text().splitlines()[0]
    assert "predictions for the test split, because mode.files is not set, in " in predicted.out
    first, second = package.load(done.folder), package.load(both.folder)
    inputs = torch.randn(20, 2, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        labels = torch.zeros(20, dtype=torch.int64)
        assert torch.equal(first(inputs).log_prob(labels), second(inputs).log_prob(labels))
    finished = framework(f"resume={done.folder}", folder="resumed")
    assert finished.code == 2 and "has finished" in finished.out
    # one step further, and what cannot be
    twice = framework(
        "mode=calibrate", f"checkpoint={done.folder}", "uncertainty=[temperature]", *QUIET, folder="twice"
    )
    assert twice.code == 2 and "is already wrapped in temperature + conformal" in twice.out
    drops = framework(
        "mode=calibrate", f"checkpoint={done.folder}", "uncertainty=[platt]", *QUIET, folder="drops"
    )
    assert drops.code == 2 and "uncertainty=platt would be put around a model that predicts sets" in drops.out
    other = ("mode=calibrate", f"checkpoint={plain.folder}", "uncertainty=[temperature]")
    for change, sentence in (
        ("data=dial", "but the data have targets"),
        ("uncertainty=[]", "no wrapper is chosen. Add uncertainty="),
        ("checkpoint=null", "needs checkpoint="),
        ("checkpoint=nowhere", "nowhere is neither a file"),
        ("uncertainty=[ensemble]", "mode=combine"),
        ("uncertainty.temperature.lower=2", "uncertainty.temperature.lower"),
    ):
        given = [one for one in other if one.partition("=")[0] != change.partition("=")[0]]
        refused = framework(*given, change, *QUIET, folder="refused")
        assert refused.code in (1, 2) and sentence in refused.out, (change, refused.out)
        assert "Traceback" not in refused.out


class Twice(Uncertainty):
    """Wrapper that requires two models, or has a weight that must be trained."""

    bibtex = ""

    def __init__(self, model: Callable[[], Predictor], *, copies: int = 2, learns: bool = False) -> None:
        super().__init__()
        self.models = nn.ModuleList(model() for _ in range(copies))
        if learns:
            self.weight = nn.Parameter(torch.ones(()))

    def forward(self, inputs: Tensor) -> Distribution:
        return self.models[0](inputs)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return self.models[0].loss(inputs, target)  # type: ignore[operator]

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self(inputs)

    def calibrate(self, batches: object) -> None:
        pass


@pytest.mark.parametrize(
    "settings, sentence", [({}, "wraps 2 models"), ({"copies": 1, "learns": True}, "has trainable weights")]
)
def test_what_has_to_be_trained_is_refused(
    settings: dict[str, Any], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibrate, "build", lambda group, part, model, target: Twice(model, **settings))
    with pytest.raises(ConfigError, match=sentence):
        calibrate.wrap_trained(Plain(CLASSES).eval(), [{"name": "twice"}], CLASSES, torch.zeros(2, LENGTH))


def test_fixed_encoders_stay_in_front() -> None:
    class Doubled(Encoder):
        bibtex = ""

        def forward(self, inputs: Tensor) -> Tensor:
            return 2 * inputs

    plain = Plain(REAL)
    front = FrozenFrontEnd([Doubled()], plain)
    inputs = torch.randn(5, LENGTH)
    found = calibrate.wrap_trained(front.eval(), [schema.resolve("uncertainty", "conformal")], REAL, inputs)
    assert isinstance(found, FrozenFrontEnd)
    assert value_set(found(inputs)) is not None
    assert torch.equal(found(inputs).mean, front(inputs).mean)


@pytest.mark.parametrize("rows", [4, 5, 14, 100, 1000])
@pytest.mark.parametrize("miscoverage", [0.1, 0.2])
def test_few_rows_are_said_with_what_they_leave_open(rows: int, miscoverage: float) -> None:
    """The message agrees with simulations, in which the k-th smallest of uniform scores is the coverage itself."""
    config = {"name": "conformal", "miscoverage": miscoverage}
    wrapper = schema.build(
        "uncertainty", schema.resolve("uncertainty", config), model=lambda: Plain(REAL), target=REAL
    )
    generator = torch.Generator().manual_seed(rows)
    batch = {
        "input": torch.randn(2 * rows, LENGTH, generator=generator),
        "target": torch.randn(2 * rows, 1, generator=generator),
    }
    assert not wrapper.remark
    wrapper.calibrate([batch])
    said = wrapper.remark
    assert f"the threshold is set by {rows} validation samples" in said
    kept = rows - int((rows + 1) * miscoverage * (1 + 1e-12))
    if kept == rows:
        assert "every set holds all values" in said and wrapper.threshold.isinf()
        least = int(re.search(r"At least (\d+) are needed", said)[1])
        assert (least + 1) * miscoverage >= 1 - 1e-9 and least * miscoverage < 1
        return
    low, high = stats.beta(kept + 1, rows - kept).ppf([0.05, 0.95])
    assert f"between {100 * low:.3g} and {100 * high:.3g} %" in said
    scores = torch.rand(4000, rows, generator=generator).sort(1).values[:, kept]
    inside = ((scores >= low) & (scores <= high)).double().mean().item()
    assert inside == pytest.approx(0.9, abs=0.02)
    assert ("this share would be within" in said) == (
        max(high - 1 + miscoverage, 1 - miscoverage - low) > 0.03
    )


def test_a_checkpoint_of_before_has_no_remarks(tmp_path: Path) -> None:
    from framework.configuration.description import Description

    content: dict[str, Any] = {
        "config": {
            "encoder": [],
            "density_head": {"name": "gaussian"},
            "uncertainty": [],
            "metric": [],
            "objective": [],
        },
        "target": {"kind": "real", "names": ["x"]},
        "input_shape": [2],
        "format": 1,
    }
    assert Description.read({"framework": content}, str(tmp_path)).remarks == ()
    content["remarks"] = ["\x1b[31mred", "b" * 10_000, *["c"] * 1000]
    found = Description.read({"framework": content}, str(tmp_path)).remarks
    assert len(found) == 8 and "\x1b" not in found[0] and len(found[1]) <= 500
