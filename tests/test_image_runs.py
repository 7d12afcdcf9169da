"""Runs whose targets are images, with objectives, discriminators, ensembles and figures."""

import base64
import json
import signal
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from torch.utils.data import default_collate

import framework as package
from framework.configuration.assembly import assemble, build_data, build_predictor
from framework.configuration.composition import plain
from framework.configuration.paths import paths_of
from framework.configuration.settings import Settings
from framework.datasets.scan_layout import write_registration
from framework.deployment.served import _load_pyfunc
from framework.encoder import Encoder
from framework.errors import DataError
from framework.geometry.srgb import bytes_from_linear, linear_from_srgb
from framework.testing.bodies import colored_mesh, write_body_file, write_subjects
from plugins.data.human_scans.rows import colored_meshes
from tests.conftest import Done, Framework, paths_again
from tests.test_composition import composed

SQUARES = (
    "data=faded",
    "encoder=[slim]",
    "encoder.slim.widths=[8,8]",
    "density_head=laplace_image",
    "metric=[psnr,ssim]",
    "batch_size=12",
    "trainer.max_epochs=3",
    "trainer.log_every_steps=1",
    "trainer.checkpoint_every_steps=1",
    "optimizer.learning_rate=3e-3",
    "threads=1",
    "logger=none",
    "pictures=false",
    "samples=1",
)
"""Settings of a run of 9 steps, 3 in each epoch."""
RIVALS = (
    "objective=[random_features,patch_gan]",
    "objective.random_features.width=4",
    "objective.random_features.depth=2",
    "objective.patch_gan.width=4",
    "objective.patch_gan.learning_rate=1e-2",
    "objective.patch_gan.schedule=cosine",
)


def journal(done: Done) -> dict[int, dict[str, Any]]:
    """Return all values that were logged in training, by step."""
    found: dict[int, dict[str, Any]] = {}
    for line in (done.folder / "journal.jsonl").read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        if any(name.startswith("train/") for name in record.get("values", {})):
            found[record["step"]] = record["values"]
    return found


def trained(framework: Framework, *more: str, folder: str) -> Done:
    done = framework(*SQUARES, *more, folder=folder)
    assert done.code == 0, done.out
    return done


@pytest.mark.slow
@pytest.mark.parametrize("objectives", [(), RIVALS], ids=["likelihood", "rivals"])
@pytest.mark.parametrize("at", [2, 7])
def test_a_killed_run_goes_on_bit_by_bit(
    framework: Framework, tmp_path: Path, objectives: tuple[str, ...], at: int
) -> None:
    """Return the losses of the predictor and its discriminators, and the final weights."""
    whole = trained(framework, *objectives, folder="whole")
    signals = (f"+data.signal_at={at}", f"+data.signal_marker={tmp_path / 'marker'}")
    killed = framework(*SQUARES, *objectives, *signals, folder="killed")
    assert killed.code == -signal.SIGKILL
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 0, resumed.out
    first, again = journal(whole), journal(killed)
    assert sorted(first) == sorted(again) == list(range(1, 10))
    assert first == again
    terms = {"train/discriminator", "train/generator", "train/feature_matching", "train/random_features"}
    assert terms <= set(first[1]) if objectives else not terms & set(first[1])
    models = [
        torch.load(done.folder / "checkpoints" / "model.ckpt", weights_only=True)["state_dict"]
        for done in (whole, killed)
    ]
    assert all(torch.equal(models[1][name], tensor) for name, tensor in models[0].items())
    assert not any("discriminator" in name for name in models[0]), "a rival is not part of the model"


def people(folder: Path) -> tuple[str, ...]:
    """Return the arguments of a small run on photographs of a dressed doll."""
    file = write_body_file(folder)["body"]
    drawing = ("views=3", "height=32", "width=24", "texture_side=0", "topologies=[7k]")
    counts = ("train=2", "validation=1", "test=1")
    return (
        "experiment=smplpix/quick",
        f"data.body={file}",
        *(f"data.{setting}" for setting in (*drawing, *counts)),
        "metric=[psnr]",
        "encoder.slim.widths=[8,8]",
        "trainer.max_epochs=2",
        "threads=1",
        "logger=none",
        "pictures=false",
    )


def test_images_are_predicted_loaded_frozen_served_and_trained_further(
    framework: Framework, tmp_path: Path
) -> None:
    """Every way from a user's coloured mesh to an image gives the same image."""
    done = framework(*people(tmp_path), folder="first")
    assert done.code == 0, done.out
    files = list(colored_meshes(tmp_path))
    for file in files:
        (tmp_path / "meshes").mkdir(exist_ok=True)
        file.rename(tmp_path / "meshes" / file.name)
    files = [tmp_path / "meshes" / file.name for file in files]
    options = (f"mode.files={tmp_path / 'meshes'}", f"checkpoint={done.folder}", "logger=none")
    predicted = framework("mode=predict", *options, folder="predicted")
    assert predicted.code == 0, predicted.out
    rows = (predicted.folder / "predictions.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0] == "sample,image,entropy_nats"
    pictures = [np.asarray(Image.open(predicted.folder / row.split(",")[1])).astype(int) for row in rows[1:]]
    assert len(pictures) == 2

    model, frozen = package.load(done.folder), package.freeze(done.folder)
    assert "predicts images: red, green, blue" in repr(model)
    served = _load_pyfunc(str(done.folder / "checkpoints" / "model.ckpt")).predict_table(files)
    with torch.no_grad():
        for number, file in enumerate(files):
            density = model(file)
            assert density.event_shape == (32, 24, 3)
            np.testing.assert_allclose(frozen(file), density.mean.numpy(), atol=1e-5)
            wanted = bytes_from_linear(linear_from_srgb(density.mean[0])).numpy().astype(int)
            answered = Image.open(BytesIO(base64.b64decode(served["png"][number])))
            for picture in (pictures[number], np.asarray(answered).astype(int)):
                assert np.abs(picture - wanted).max() <= 1

    again = framework(
        *people(tmp_path), f"checkpoint={done.folder}", "optimizer.learning_rate=1e-9", folder="further"
    )
    assert again.code == 0, again.out
    assert "starting a new training from the weights of" in again.out
    # the same parameters but for the rate; moments of batches go on
    first, further = (
        torch.load(one.folder / "checkpoints" / "model.ckpt", weights_only=True)["state_dict"]
        for one in (done, again)
    )
    parameters = {
        name: weight for name, weight in first.items() if name.endswith(("weight", "gain", "offset", "bias"))
    }
    assert len(parameters) > 10
    for name, weight in parameters.items():
        torch.testing.assert_close(further[name], weight, rtol=0, atol=1e-6)
    other = framework(
        *people(tmp_path), "encoder.slim.widths=[8,16]", f"checkpoint={done.folder}", folder="other"
    )
    assert other.code == 1
    assert "belongs to another model" in other.out
    assert not (other.folder / "run.json").exists()


def test_what_learns_nothing_is_tested_as_it_is(framework: Framework, tmp_path: Path) -> None:
    """A rasteriser has no trained parameters; only the scale of its density is fitted."""
    run = [item for item in people(tmp_path) if not item.startswith(("experiment", "encoder", "trainer"))]
    done = framework("experiment=smplpix/rasterised", *run, folder="drawn")
    assert done.code == 0, done.out
    assert "epoch 1" not in done.out
    results = json.loads((done.folder / "results.json").read_text(encoding="utf-8"))
    assert results["psnr_db"] > 15
    test = ("mode=test", f"checkpoint={done.folder}", "logger=none")
    unsaid = framework(*test, folder="unsaid")
    assert unsaid.code == 2 and "encoder.rasterised.body=" in unsaid.out, unsaid.out
    tested = framework(*test, *paths_again([f"resume={done.folder}"]), folder="tested")
    assert tested.code == 0, tested.out
    for further, sentence in (
        ("objective=[random_features]", "No part of this model learns by gradient"),
        (
            "trainer.max_epochs=2",
            "trainer.max_epochs=2 has no effect: no part of this model learns by gradient",
        ),
    ):
        refused = framework("experiment=smplpix/rasterised", *run, further, folder="no")
        assert refused.code == 2
        assert sentence in refused.out


def test_textures_are_drawn_wherever_the_subjects_are_and_nowhere_else(
    framework: Framework, tmp_path: Path
) -> None:
    """Loaded and frozen alike; a mesh of somebody else, and a folder that is gone, get a sentence."""
    scans = tmp_path / "scans"
    run = (
        "threads=1",
        "logger=none",
        "pictures=false",
        "metric=[psnr]",
        f"data.root={write_subjects(scans)['root']}",
        "data.height=12",
        "data.width=9",
    )
    done = framework("experiment=smplpix/textured", *run, folder="drawn")
    assert done.code == 0, done.out
    paths = paths_of(yaml.safe_load((done.folder / "config.yaml").read_text(encoding="utf-8")))
    models = package.load(done.folder, paths=paths), package.freeze(done.folder, paths=paths).density
    mesh, *_ = colored_meshes(tmp_path)  # who has the colours of the first subject
    assert torch.equal(models[0](mesh).mean, models[1](mesh).mean)
    write_registration(mesh, colored_mesh(9))
    for model in models:
        with pytest.raises(DataError, match="has the vertex colours of no subject in"):
            model(mesh)
    models = package.load(done.folder, paths=paths), package.freeze(done.folder, paths=paths)
    scans.rename(tmp_path / "moved")
    for model in models:
        with pytest.raises(DataError, match="no such folder; expected the folder of the subjects"):
            model(mesh)


@pytest.mark.parametrize(
    "wrapped",
    [
        pytest.param(
            ("uncertainty=[ensemble]", "uncertainty.ensemble.members=2"),
            id="ensemble",
            marks=pytest.mark.slow,
        ),
        pytest.param(("uncertainty=[temperature]",), id="temperature", marks=pytest.mark.slow),
        pytest.param(
            ("density_head.scale=pixel", "encoder.slim.scales=1", "uncertainty=[ensemble,temperature]"),
            id="scales",
        ),
    ],
)
def test_wrappers_and_objectives_work_on_images(framework: Framework, wrapped: tuple[str, ...]) -> None:
    done = trained(
        framework, *wrapped, *RIVALS, "metric=[psnr,log_likelihood,pixel_uncertainty]", folder="wrapped"
    )
    results = json.loads((done.folder / "results.json").read_text(encoding="utf-8"))
    names = ("psnr_db", "log_likelihood", "pixel_coverage_90", "pixel_coverage_90_masked")
    assert np.isfinite([results[name] for name in names]).all()
    tested = framework("mode=test", f"checkpoint={done.folder}", "logger=none", folder="tested")
    assert tested.code == 0, tested.out
    again = json.loads((tested.folder / "results.json").read_text(encoding="utf-8"))
    assert {name: again[name] for name in names} == {name: results[name] for name in names}


@pytest.mark.parametrize(
    "way, own",
    [("quick", ["encoder.projection.splat=1", "encoder.slim.crop=1"]), ("hybrid", ["encoder.slim.crop=2"])],
)
def test_the_ground_of_a_photograph_is_white_to_the_bit_and_is_not_computed(
    tmp_path: Path, way: str, own: list[str]
) -> None:
    """Losses weigh figures by it, networks leave it out."""
    settings = [*people(tmp_path)[1:], *own]
    resolved = assemble(Settings.of(plain(composed(f"experiment=smplpix/{way}", *settings)))).parts
    data = build_data(resolved)
    data.prepare()
    batch = default_collate([data.splits().train[index] for index in range(3)])
    ground = (batch["target"] == 1).all(-1)
    assert 0.5 < ground.float().mean() < 1
    assert not (ground & batch["mask"]).any()
    predictor = build_predictor(resolved, data.target, data.input_shape, 0, data.columns).eval()
    *drawn, painted = [module for module in predictor.modules() if isinstance(module, Encoder)]
    with torch.no_grad():
        picture = drawn[0](batch["input"])
        painted(picture)
    seen = (picture != 1).any(1)
    assert 0 < seen.float().mean() < 0.5
    assert painted.report is not None
    assert painted.report.computed < ground.numel()


def test_what_does_not_fit_an_image_gets_a_sentence(framework: Framework) -> None:
    for wrong, wanted in (
        (("encoder.slim.colors=1",), "gives 1×16×12 numbers, but LaplaceImageHead reads 576 numbers"),
        (("density_head.scale=pixel",), "gives 3×16×12 numbers, but LaplaceImageHead reads 768 numbers"),
        (
            ("density_head=gaussian",),
            "describes targets of kind 'real', but the targets of this data set are of kind 'image'",
        ),
        (("metric=[rmse]",), "kind"),
    ):
        refused = framework(*SQUARES, *wrong, folder="refused")
        assert refused.code == 2, refused.out
        assert wanted in refused.out, (wrong, refused.out)
        assert not (refused.folder / "run.json").exists(), wrong
