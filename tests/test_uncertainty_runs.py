"""Uncertainty from the command line: ensembles that are trained together or combined from a sweep, and metrics of
outliers."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import framework as package
from framework.configuration.assembly import assemble, build_outliers
from framework.configuration.description import Description
from framework.configuration.schema import build, resolve
from framework.configuration.settings import Settings
from framework.distributions.density import Mixture
from framework.errors import CheckpointError, ConfigError, DataError
from framework.modes.combine import common_description, wrapper_config
from framework.runs.job import find_members
from framework.target import Target
from tests.conftest import Done, Framework

SMALL = [
    "experiment=moons/vanilla_128",
    "encoder.mlp.widths=[8]",
    "data.train=60",
    "data.validation=40",
    "data.test=100",
    "outliers.test=30",
    "data.data_seed=0",  # one data set for all seeds
    "batch_size=20",
    "trainer.max_epochs=3",
    "trainer.gradient_clip_val=0.3",
    "trainer.check_val_every_n_epoch=1",
    "logger=none",
    "threads=1",
]


def results(done: Done) -> dict[str, object]:
    assert done.code == 0, done.out
    return json.loads((done.folder / "results.json").read_text(encoding="utf-8"))


def test_pictures_not_asked_for_are_not_drawn(framework: Framework) -> None:
    for name, wanted in (("drawn", "true"), ("spared", "false")):
        done = framework(*SMALL, f"pictures={wanted}", folder=name)
        assert done.code == 0, done.out
        pictures = {path.name for path in done.folder.glob("figures/*")}
        assert (
            pictures == {"training_curve.png", "landscape.png", "reliability.png"}
            if name == "drawn"
            else not pictures
        )


def inputs() -> torch.Tensor:
    return torch.randn(50, 2, generator=torch.Generator().manual_seed(0))


@pytest.mark.slow
def test_a_sweep_becomes_an_ensemble_and_its_first_member_is_trained_alike_in_one_pass(
    framework: Framework, tmp_path: Path
) -> None:
    swept = framework("-m", *SMALL, "seed=0,1,2", f"hydra.sweep.dir={tmp_path}/sweep")
    assert swept.code == 0, swept.out
    folder = tmp_path / "sweep"
    done = framework("mode=combine", f"mode.members={folder}", "logger=none", "threads=1", folder="joined")
    numbers = results(done)
    assert numbers["method"] == "vanilla_128 + ensemble"
    assert numbers["synthetic"] is True
    assert "3 members" in done.out
    members = [package.load(folder / str(number)) for number in range(3)]
    whole = package.load(done.folder)
    labels = torch.zeros(50, dtype=torch.int64)
    with torch.no_grad():
        mean = torch.stack([member(inputs()).log_prob(labels).exp() for member in members]).mean(0)
        torch.testing.assert_close(whole(inputs()).log_prob(labels).exp(), mean)

    # around the members comes what is asked for, calibrated on the validation set
    scaled = framework(
        "mode=combine",
        f"mode.members=[{folder}/0,{folder}/2]",
        "uncertainty=[temperature]",
        "logger=none",
        "threads=1",
        folder="scaled",
    )
    assert results(scaled)["method"] == "vanilla_128 + ensemble + temperature"

    # a combined model may be a member again
    twice = f"mode.members=[{scaled.folder},{scaled.folder}]"
    nested = framework("mode=combine", twice, "logger=none", "threads=1", folder="nested")
    assert results(nested)["nll"] == pytest.approx(results(scaled)["nll"], rel=1e-6)

    # trained in one pass, with the seed of the first: its first member saw the same batches from the same start
    once = framework(*SMALL, "uncertainty=[ensemble]", "uncertainty.ensemble.members=3", folder="once")
    results(once)
    ensemble = package.load(once.folder)
    assert isinstance(ensemble(inputs()), Mixture)
    ensemble.members = 1  # type: ignore[assignment]
    with torch.no_grad():
        first = ensemble(inputs()).log_prob(labels)
        torch.testing.assert_close(first, members[0](inputs()).log_prob(labels), rtol=1e-4, atol=1e-5)

    # the same metrics from the stored model, and its curve of error against run time
    again = framework("mode=test", f"checkpoint={once.folder}", "logger=none", "threads=1", folder="again")
    for key in ("nll", "ood_entropy", "auroc"):
        assert results(again)[key] == pytest.approx(results(once)[key], rel=1e-6)  # other batches
    curve = framework(
        "mode=work_precision",
        f"checkpoint={once.folder}",
        "mode.metrics=[nll,ece]",
        "mode.repeats=2",
        "logger=none",
        "threads=1",
        folder="curve",
    )
    assert curve.code == 0, curve.out
    rows = (curve.folder / "work_precision.csv").read_text(encoding="utf-8").splitlines()
    assert [row.split(",")[1] for row in rows[1:]] == ["1", "2", "3"]
    assert {row.split(",")[0] for row in rows[1:]} == {results(once)["method"]}
    assert (curve.folder / "figures" / "work_precision.png").is_file()
    wrong = framework(
        "mode=work_precision",
        f"checkpoint={once.folder}",
        "mode.metrics=[nil]",
        "logger=none",
        folder="wrong",
    )
    assert wrong.code == 2
    assert "mode.metrics names 'nil'" in wrong.out
    assert "'nll'" in wrong.out


def described(**changes: Any) -> Description:
    config = {
        "density_head": {"name": "a"},
        "encoder": [],
        "uncertainty": [],
        "data": {"name": "d", "seed": 0},
    }
    config |= {key: value for key, value in changes.items() if key in config}
    description = Description(config, Target("class", ("a", "b")), (2,), (), synthetic=True, path="here")
    return replace(description, **{key: value for key, value in changes.items() if key not in config})


def test_only_models_that_are_alike_are_joined(tmp_path: Path) -> None:
    assert common_description([described(), described(path="there")]).path == "here"
    with pytest.raises(CheckpointError, match="differ in encoder"):
        common_description([described(), described(encoder=[{"name": "mlp"}])])
    with pytest.raises(
        CheckpointError,
        match=r"differ in data\.seed, .* Train all members .* add data\.seed=0 to the command",
    ):
        common_description([described(), described(data={"name": "d", "seed": 1})])
    with pytest.raises(CheckpointError, match="differ in input_shape"):
        common_description([described(), described(input_shape=(3,))])
    with pytest.raises(CheckpointError, match="differ in data_state"):
        common_description([described(), described(data_state={"mean": [1.0]})])
    scales = [{"scale": torch.arange(count)} for count in (2, 2, 3)]
    alike = [described(data_state=scale) for scale in scales]
    assert common_description(alike[:2]) is alike[0]
    with pytest.raises(CheckpointError, match="differ in data_state"):
        common_description(alike[1:])
    for name in ("10", "9"):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
        (tmp_path / name / "checkpoints" / "model.ckpt").touch()
    (tmp_path / "11").mkdir()  # a job that failed left no model
    assert find_members(str(tmp_path)) == [tmp_path / "9", tmp_path / "10"]
    with pytest.raises(ConfigError, match="names 1 trained model"):
        find_members(["alone"])
    assert wrapper_config("ensemble", 3) == resolve("uncertainty", {"name": "ensemble", "members": 3})
    with pytest.raises(ConfigError, match="temperature cannot join separately trained models"):
        wrapper_config("temperature", 3)


def chosen(outliers: object, *metrics: str) -> dict[str, object]:
    return {
        "data": {"name": "moons"},
        "encoder": {"mlp": {"name": "mlp"}},
        "density_head": {"name": "bernoulli"},
        "metric": {name: {"name": name} for name in metrics},
        "outliers": outliers,
    }


def test_outliers_are_built_only_for_metrics_that_read_them() -> None:
    data = build("data", resolve("data", "moons"))
    data.prepare()
    broken = {"name": "tabular", "path": "no_such_file.csv", "target": "y", "kind": "class"}
    assert (
        build_outliers(assemble(Settings.of(chosen(broken, "nll"))).parts, data) is None
    )  # the missing file disturbs nobody
    with pytest.raises(DataError, match=r"no_such_file\.csv"):
        build_outliers(assemble(Settings.of(chosen(broken, "nll", "out_of_distribution"))).parts, data)
    with pytest.raises(ConfigError, match="no outliers are chosen"):
        assemble(Settings.of(chosen(None, "nll", "out_of_distribution")))


def test_outliers_have_the_inputs_of_the_data(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    lines = [f"{row},{row % 7},{row % 5},{'ab'[row % 2]}" for row in range(40)]
    table.write_text("x,y,z,label\n" + "\n".join(lines) + "\n", encoding="utf-8")
    data = build("data", resolve("data", "moons"))
    data.prepare()
    three = {"name": "tabular", "path": str(table), "target": "label", "kind": "class"}
    with pytest.raises(ConfigError, match=r"shape \(3,\).*shape \(2,\)"):
        build_outliers(assemble(Settings.of(chosen(three, "out_of_distribution"))).parts, data)


def test_a_mistake_on_the_command_line_is_said_before_training(framework: Framework) -> None:
    done = framework(*SMALL, "trainer.keep=first")
    assert done.code == 2, done.out
    assert "trainer.keep = 'first': Input should be 'best' or 'last'" in done.out
    done = framework("experiment=moons/vanilla_128", "data@outliers=null")
    assert done.code == 2, done.out
    assert "Remove a group with `~`" in done.out
    assert "Traceback" not in done.out


@pytest.mark.parametrize(
    ("wrappers", "code"),
    [("conformal", 1), ("ensemble,conformal", 1), ("conformal,temperature", 1), ("ensemble,temperature", 0)],
)
def test_too_small_a_validation_split_is_said_before_training(
    wrappers: str, code: int, framework: Framework
) -> None:
    done = framework(*SMALL, "data.validation=1", f"uncertainty=[{wrappers}]", "pictures=false", folder="few")
    assert done.code == code, done.out
    if code:
        assert "are required, but got one sample" in done.out
        assert "run folder" not in done.out and not (done.folder / "run.json").exists()


def test_a_posterior_is_fitted_to_the_training_split(framework: Framework) -> None:
    done = framework(
        *SMALL, "uncertainty=[laplace,ensemble]", "uncertainty.ensemble.members=2", "pictures=false"
    )
    assert results(done)["nll"] is not None
    assert "60 samples determine" in done.out


@pytest.mark.parametrize(
    ("chosen", "said"),
    [
        (["uncertainty=[swag]", "trainer.keep=best"], "Set trainer.keep=last trainer.patience=null"),
        (["uncertainty=[swag]", "trainer.patience=3"], "Set trainer.keep=last trainer.patience=null"),
        (
            ["uncertainty=[laplace,folds]"],
            "Laplace reads the training split of the model that it wraps",
        ),
    ],
)
def test_wrappers_that_need_another_training_are_refused(
    framework: Framework, chosen: list[str], said: str
) -> None:
    done = framework(*SMALL, "pictures=false", *chosen)
    assert done.code == 2 and said in done.out, done.out


def test_epochs_are_followed_and_cannot_be_made_up_for(framework: Framework) -> None:
    done = framework(
        *SMALL, "uncertainty=[swag]", "uncertainty.swag.start=0.0", "pictures=false", folder="followed"
    )
    assert "swag: weights of 3 epochs" in done.out, done.out
    plain = framework(*SMALL, "pictures=false", folder="plain")
    wrong = framework(
        "mode=calibrate",
        f"checkpoint={plain.folder}",
        "uncertainty=[swag]",
        "logger=none",
        "threads=1",
        folder="late",
    )
    assert wrong.code == 2 and "collects weights during training" in wrong.out, wrong.out
