"""Loaded models, which read the user's files of each kind of data without the training data."""

import base64
import copy
import pickle
import shutil
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import framework as package
from framework.configuration.assembly import build_predictor
from framework.configuration.loading import find_checkpoint
from framework.configuration.schema import resolve
from framework.deployment.frozen import Frozen
from framework.deployment.served import _load_pyfunc
from framework.errors import CheckpointError, DataError
from framework.geometry.meshes import read
from framework.model import Predictor, fitted_models
from framework.target import Target
from framework.testing.rows import DataRow
from tests.conftest import Framework

KINDS = {
    "tabular": ("two numbers", "density_head=gaussian", "encoder=[mlp]", "metric=[rmse,mae]"),
    "images_with_angles": (
        "mirrored",
        "density_head=von_mises",
        "encoder=[mlp]",
        "metric=[angular_deviation]",
    ),
    "point_cloud_folder": (
        "pieces of land",
        "density_head=categorical",
        "encoder=[bps,mlp]",
        "metric=[accuracy]",
    ),
    "registration": (
        "a doll",
        "density_head=gaussian",
        "density_head.scale=fixed",
        "encoder=[bps,mlp]",
        "encoder.bps.normalise=none",
        "metric=[vertex_error]",
    ),
}
HOMES = {"point_cloud_folder": "labelled_clouds"}


QUICK = (
    "encoder.mlp.widths=[8]",
    "trainer.max_epochs=1",
    "batch_size=8",
    "pictures=false",
    "logger=none",
    "threads=1",
)
"""Return the settings of a small training for any data."""


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_takes_files_when_its_training_data_are_gone(
    kind: str, framework: Framework, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = import_module(f"plugins.data.{HOMES.get(kind, kind)}.rows").ROWS[kind]
    name, *arguments = KINDS[kind]
    row: DataRow = next(row for row in rows if row.name == name)
    home, own = tmp_path / "home", tmp_path / "own"
    home.mkdir(), own.mkdir()
    assert row.write is not None and row.files is not None
    said = {**row.write(home), **row.config}
    options = [f"data.{key}={str(value).replace(' ', '')}" for key, value in said.items()]
    done = framework(f"data={kind}", *options, *arguments, *QUICK)
    assert done.code == 0, done.out
    shutil.rmtree(home)
    files = sorted(Path(file) for file in row.files(own))
    predicted = framework(
        "mode=predict", f"checkpoint={done.folder}", f"mode.files={own}", "logger=none", folder="predicted"
    )
    assert predicted.code == 0, predicted.out
    assert "mode.files is not set" not in predicted.out
    lines = (predicted.folder / "predictions.csv").read_text().splitlines()

    state = torch.get_rng_state()
    model, frozen = package.load(done.folder), package.freeze(done.folder)
    assert torch.equal(torch.get_rng_state(), state), "loading does not draw from the global generator"
    assert f"trained on {kind}" in repr(model)
    assert f"reads    inputs of shape {'×'.join(map(str, model.description.input_shape))}" in repr(model)
    density = [model(str(file)) for file in files]
    np.testing.assert_array_equal(np.asarray(density[0].mode), density[0].mode.numpy())
    monkeypatch.setenv("HOME", str(own))
    assert model(f"~/{files[0].relative_to(own)}").mode.equal(density[0].mode)
    monkeypatch.undo()
    assert sum(len(one.sample()) for one in density) == len(lines) - 1
    for one, file in zip(density, files, strict=True):
        here = one.sample()
        twin = frozen.density(file)
        torch.testing.assert_close(twin.mode, one.mode, rtol=1e-5, atol=1e-5)
        assert bool(torch.isfinite(twin.log_prob(here)).all())
        assert bool(torch.isfinite(one.log_prob(here)).all())
    for copied in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        torch.testing.assert_close(copied(str(files[0])).mode, density[0].mode, rtol=0, atol=0)
        assert copied.double()(str(files[0])).log_prob(density[0].sample()).dtype == torch.float64
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(frozen))(files[0]), frozen(files[0]))
    with pytest.raises(
        CheckpointError,
        match=f"Got a {type(model).__name__} as the source of a trained model; expected a run",
    ):
        find_checkpoint(model)
    if kind == "registration":
        follows_the_scan(model, frozen, files[0], lines)

    served = _load_pyfunc(str(done.folder / "checkpoints" / "model.ckpt"))
    told = pd.read_csv(predicted.folder / "predictions.csv").drop(columns="sample")
    contents = [base64.b64encode(file.read_bytes()).decode() for file in files]
    named = pd.DataFrame({"base64": contents, "name": [file.name for file in files]})
    for given in (files, named, *([contents] if kind == "images_with_angles" else [])):
        answer = served.predict_table(given)
        assert set(answer) - set(told) == {
            f"{name.removesuffix('_deg')}_mode{'_deg' * name.endswith('_deg')}"
            for name in told
            if kind != "point_cloud_folder" and name != "entropy_nats"
        }
        pd.testing.assert_frame_equal(answer[list(told)], told, rtol=1e-6, check_dtype=False)
    for wrong in ([str(file) for file in files], ["etc"], named.assign(base64="/etc/hostname"), object()):
        with pytest.raises(DataError):
            served.predict_table(wrong)
    dates = pd.DataFrame({"day": pd.to_datetime(["2026-11-26", "2026-11-27"])})
    for wrong in (object(), tmp_path / "gone.csv", np.zeros((2, 77, 5, 3)), [], np.zeros((0, 3)), dates):
        for form in (model, frozen):
            with pytest.raises(DataError):
                form(wrong)


def follows_the_scan(model: Predictor, frozen: Frozen, file: Path, lines: list[str]) -> None:
    """Predictions are in metres at the place of the scan: a scan of twice the size at another place has its mesh
    there."""
    scan = torch.from_numpy(read(file).vertices)
    away = torch.tensor([3.0, -2.0, 5.0])
    here, there = model(scan[None]), model(2 * scan + away)
    everywhere = away.repeat(here.event_shape[0] // 3)
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-4)
    close(there.mean, 2 * here.mean + everywhere)
    close(there.variance, 4 * here.variance)
    close(there.entropy(), here.entropy() + here.event_shape[0] * np.log(2))
    close(torch.from_numpy(frozen(2 * scan + away)), there.mode)
    named = next(line for line in lines[1:] if file.name in line).split(",")
    close(torch.tensor([float(number) for number in named[1:-1]])[None], here.mode)
    close(float(named[-1]), float(here.entropy()))


@pytest.mark.parametrize("unit", [(0.0, 1.0), (1e6, 1e-3), (-3e-9, 1e-12), (0.0, 1e30)])
@pytest.mark.parametrize("head", ["gaussian", "mixture", "extra_trees", "cvae"])
def test_reals_are_fitted_and_given_back_in_any_unit(head: str, unit: tuple[float, float]) -> None:
    """The fitted density is shifted and scaled with the unit; log-densities differ by the logarithm of the scale."""
    random = torch.Generator().manual_seed(0)
    inputs = torch.rand(64, 2, generator=random)
    law = torch.stack([inputs.sum(-1), inputs[:, 0] - 1], -1).double() + 0.1 * torch.rand(
        64, 2, generator=random
    )
    found = []
    for here, wide in ((0.0, 1.0), unit):
        target = here + wide * law
        mean, deviation = target.mean(0), target.std(0)
        component = {"component": {"name": "gaussian"}} if head in ("mixture", "cvae") else {}
        parts = {
            "encoder": [],
            "uncertainty": [],
            "density_head": resolve("density_head", {"name": head, **component}),
        }
        about = Target("real", ("x", "y"), tuple(mean.tolist()), tuple(deviation.tolist()))
        predictor = build_predictor(parts, about, (2,), seed=0)
        if fitted_models(predictor):
            predictor.head.fit(inputs, target, 0)
        torch.manual_seed(1)
        loss = predictor.loss(inputs, target).mean()
        if not fitted_models(predictor):
            loss.backward()
        torch.manual_seed(2)
        density = predictor.eval()(inputs)
        torch.manual_seed(3)
        drawn = density.sample()
        torch.manual_seed(4)
        found.append(
            ((drawn - here) / wide, density.log_prob(target) + 2 * np.log(wide), loss - 2 * np.log(wide))
        )
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one.double(), other.double(), rtol=1e-4, atol=2e-4)
