"""Every optimiser that a config may name is built, with its own settings and fused where torch can."""

import pytest

from framework.configuration.schema import build, resolve
from framework.configuration.settings import OptimizerSettings
from framework.target import Target
from framework.testing.wrappers import Plain
from framework.training.module import Training


@pytest.mark.parametrize("momentum", [None, 0.0, 0.9])
@pytest.mark.parametrize("name", ["adam", "adamw", "sgd", "nadam", "radam"])
def test_settings_reach_the_optimiser(
    monkeypatch: pytest.MonkeyPatch, name: str, momentum: float | None
) -> None:
    if momentum is not None and name != "sgd":
        with pytest.raises(ValueError, match=f"momentum is a setting of sgd, {name} has none"):
            OptimizerSettings(name=name, momentum=momentum)
        return
    settings = OptimizerSettings(name=name, learning_rate=0.25, weight_decay=0.5, momentum=momentum)
    data = build("data", resolve("data", {"name": "moons"}))
    training = Training(Plain(Target("real", ("x",))), [], data, settings, 0, {})
    monkeypatch.setattr(training, "_planned_steps", lambda: 10)
    made = training.configure_optimizers()["optimizer"]
    (group,) = made.param_groups
    assert type(made).__name__.lower() == name
    assert (group["initial_lr"], group["weight_decay"]) == (0.25, 0.5)
    assert group["params"] == list(training.parameters())
    if name == "sgd":
        assert group["momentum"] == (momentum or 0.0)
