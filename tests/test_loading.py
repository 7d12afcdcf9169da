"""Checkpoints of heads without gradient, and of encoders whose first weights came from a file."""

from pathlib import Path
from typing import Any

import pytest
import torch

from framework.configuration import loading
from framework.configuration.description import Description
from framework.configuration.registry import installed, load
from framework.configuration.schema import build, resolve
from framework.density_head import Fitted
from framework.errors import CheckpointError, UserError
from framework.model import Model
from framework.runs.session import require_fit
from framework.storage.checkpoints import read
from framework.target import Target
from framework.training.checkpoint import WholeCheckpoints

OF_ONE_TARGET = {"ballistic", "fit_pose", "lorentzian"}
"""Heads for the targets of a single data set, whose own tests check their checkpoints."""
WITHOUT_GRADIENT = [
    name
    for name in installed("density_head")
    if issubclass(load("density_head", name), Fitted) and name not in OF_ONE_TARGET
]
TARGETS = (Target("class", ("a", "b", "c")), Target("real", ("x", "y")))


@pytest.mark.parametrize("name", WITHOUT_GRADIENT)
@pytest.mark.parametrize("target", TARGETS, ids=["classes", "reals"])
def test_a_checkpoint_holds_what_was_fitted(name: str, target: Target, tmp_path: Path) -> None:
    def model() -> Model:
        return Model([], build("density_head", resolve("density_head", name), target=target), (5,))

    made, features = model(), torch.randn(60, 5)
    wanted = torch.arange(60) % 3 if target.kind == "class" else features[:, :2]
    made.head.fit(features, wanted, 5)  # type: ignore[operator]
    made.head.calibrate(features, wanted)
    WholeCheckpoints().save_checkpoint({"state_dict": made.state_dict()}, tmp_path / "model.ckpt")
    other = model()
    loading.fill(other, read(tmp_path / "model.ckpt")["state_dict"], "model.ckpt")
    assert other.head.size == 5
    inputs = torch.randn(60, 5)
    assert torch.equal(other(inputs).log_prob(wanted), made(inputs).log_prob(wanted))


class Built(UserError):
    """Exception that ends the loading before the model is built."""


def test_a_loaded_model_does_not_ask_for_what_its_training_started_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = resolve("encoder", {"name": "inception_resnet_v2", "weights": "gone.pth", "dropout": 0.3})
    described = {
        "format": 1,
        "config": {"encoder": [given, resolve("encoder", "mlp")]},
        "target": {"kind": "class", "names": ["a", "b"]},
        "input_shape": [3, 75, 75],
    }
    WholeCheckpoints().save_checkpoint({"framework": described, "state_dict": {}}, tmp_path / "model.ckpt")

    def built(resolved: dict[str, Any], *_: Any) -> None:
        assert resolved["encoder"] == [{**given, "weights": None}, resolve("encoder", "mlp")]
        raise Built

    monkeypatch.setattr(loading, "build_predictor", built)
    with pytest.raises(Built):
        loading.load(tmp_path / "model.ckpt")


@pytest.mark.parametrize(
    ("module", "message"),
    [
        ("plugins.encoder.mine", r"a plugin failed at plugins\S*:2 \(RuntimeError: .*\. Mend the plugin if"),
        ("torch.nn.mine", r"cannot be read as a checkpoint"),
    ],
)
@pytest.mark.parametrize("part", ["build_predictor", "build_data"])
def test_an_error_while_a_model_is_built_leads_to_the_plugin_that_failed(
    part: str, module: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    space: dict[str, Any] = {"__name__": module, "torch": torch}
    exec(compile("def fail(*_):\n return torch.zeros(2) @ torch.zeros(3)\n", f"{module}.py", "exec"), space)
    monkeypatch.setattr(loading, part, space["fail"])
    config = {"encoder": [], "data": resolve("data", "moons")}
    described = Description(config, Target("class", ("a", "b")), (2,), (), synthetic=True, path="model.ckpt")
    with pytest.raises(CheckpointError, match=rf"^model\.ckpt: .*{message}"):
        loading.rebuild(described, {}) if part == "build_predictor" else loading.reader(described)


def test_other_data_are_refused_in_a_sentence_however_many_numbers_they_have() -> None:
    mesh, twin = (Target("real", tuple(f"{axis}{row}" for row in range(999))) for axis in "xy")
    described, data = Description({}, mesh, (5,), (), synthetic=True), build("data", resolve("data", "moons"))
    data.target, data.input_shape = mesh, (5,)
    require_fit(data, described)
    for data.target, data.input_shape in (twin, (5,)), (mesh, (6,)), (Target("class", mesh.names), (5,)):
        with pytest.raises(CheckpointError, match=r"predicts real \(x0, .* and 989 more\), but") as caught:
            require_fit(data, described)
        assert len(str(caught.value)) < 400
