"""Encoders that are fitted to the training split before training (`FitsInputs`), in whole runs."""

from pathlib import Path

import numpy as np
import pytest
import torch

from framework import load
from framework.configuration.schema import build, resolve
from tests.conftest import Framework


@pytest.fixture
def clouds(tmp_path: Path) -> Path:
    """Return a folder of clouds of different sizes and two classes."""
    random = np.random.default_rng(0)
    for number in range(12):
        path = tmp_path / "clouds" / "ab"[number % 2] / f"{number:02}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, random.normal(size=(30 + number, 3)) * [1, 1, 1 + number % 2])
    return tmp_path / "clouds"


def test_each_encoder_of_a_chain_is_fitted_to_the_features_of_those_before_it(
    framework: Framework, clouds: Path, tmp_path: Path
) -> None:
    done = framework(
        "data=point_cloud_folder",
        f"data.root={clouds}",
        "density_head=categorical",
        "metric=[accuracy]",
        "encoder=[bps,normal_scores,mlp]",
        "encoder.bps.basis=selected",
        "encoder.bps.points=6",
        "encoder.mlp.widths=[4]",
        "trainer.max_epochs=1",
        "batch_size=3",
        "logger=none",
        "pictures=false",
        "hydra.run.dir=run",
        folder=None,
    )
    assert done.code == 0, done.out
    stored = list(load(str(tmp_path / "run")).encoders)
    data = build("data", resolve("data", {"name": "point_cloud_folder", "root": str(clouds)}))
    data.prepare()
    train = data.splits().train
    inputs = train.__getitems__(range(len(train)))["input"]
    fitted = [
        build("encoder", resolve("encoder", config), input_shape=shape, input_columns=())
        for config, shape in (
            ({"name": "bps", "basis": "selected", "points": 6}, inputs.shape[1:]),
            ({"name": "normal_scores"}, (6,)),
        )
    ]
    before = fitted[0].basis.clone()
    fitted[0].fit_inputs([inputs])
    fitted[1].fit_inputs([fitted[0](inputs)])
    assert not torch.equal(stored[0].basis, before)
    assert torch.equal(stored[0].basis, fitted[0].basis)
    torch.testing.assert_close(stored[1].values, fitted[1].values)
    torch.testing.assert_close(stored[1].scores, fitted[1].scores)


def test_the_first_encoder_of_each_model_is_fitted_although_it_is_trained(
    framework: Framework, clouds: Path, tmp_path: Path
) -> None:
    settings = (
        *("data=point_cloud_folder", f"data.root={clouds}", "density_head=categorical", "metric=[accuracy]"),
        *("encoder.bps.basis=selected", "encoder.bps.learned=true", "encoder.bps.points=6", "batch_size=3"),
        *("trainer.max_epochs=1", "logger=none", "pictures=false", "uncertainty=[ensemble]"),
        *("uncertainty.ensemble.members=2", "encoder.mlp.widths=[4]"),
    )
    done = framework(*settings, "encoder=[bps,mlp]", "hydra.run.dir=run", folder=None)
    assert done.code == 0, done.out
    found = [module for module in load(str(tmp_path / "run")).modules() if type(module).__name__ == "BPS"]
    plain = build(
        "encoder", resolve("encoder", {"name": "bps", "points": 6}), input_shape=(41, 3), input_columns=()
    )
    assert len(found) == 2 and torch.equal(found[0].basis, found[1].basis)
    assert not torch.equal(found[0].basis, plain.basis)
    assert all(encoder.moved.abs().max() > 0 for encoder in found)
