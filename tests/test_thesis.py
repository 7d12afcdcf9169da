"""Networks and settings of the thesis: numbers of parameters in Tables 6.1 and 6.2, and preset=thesis."""

import json
from typing import Any

import pytest
import yaml

from framework.configuration.command_line import command_line
from framework.configuration.composition import folder, plain
from framework.configuration.schema import build, resolve
from framework.model import Model
from framework.target import Target
from tests.conftest import Framework
from tests.test_composition import composed

CLASSES = Target("class", tuple(f"class {number}" for number in range(40)))
"""Target of ModelNet40."""
PARAMETERS = {
    # Table 6.1, in the order of its rows
    "voxnet": "9e5",
    "occ_mlp_32": "1.7e7",
    "occ_mlp_8": "5.5e5",
    "tdf_mlp_32": "1.7e7",
    "tdf_mlp_8": "5.5e5",
    "bps_mlp_grid_32": "1.7e7",
    "bps_mlp_grid_8": "5.5e5",
    "bps_mlp_ball_grid": "5.5e5",
    "bps_mlp": "5.5e5",
    "bps_mlp_hexagonal": "5.5e5",
    "bps_conv3d": "1.7e7",
    "bps_mlp_delta": "1.1e6",
    "bps_conv3d_delta": "1.7e7",
    # Table 6.2
    "deepsets": "2.1e5",
    "deepsets_micro": "2.1e5",
    "pointnet": "3.5e6",
    "pointnet_vanilla": "8e5",
    "pointnet2": "1.7e6",
    "bps_mlp_400": "3.8e5",
    "bps_conv3d_unpadded": "4.4e6",
}
"""Numbers of parameters as the thesis prints them; VoxNet and vanilla PointNet without zeros after the decimal point,
which their papers do not give."""


def encoders_of(name: str) -> list[dict[str, Any]]:
    """Return the encoder settings of an experiment on ModelNet40, read without Hydra, which would take a second."""
    config = yaml.safe_load((folder() / "experiment/modelnet40" / f"{name}.yaml").read_text(encoding="utf-8"))
    names = next(line["override /encoder"] for line in config["defaults"] if "override /encoder" in line)
    return [{"name": name, **config.get("encoder", {}).get(name, {})} for name in names]


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_network_has_the_parameters_that_the_thesis_gives(name: str) -> None:
    """Require agreement to less than one unit of the last printed digit: the thesis prints 4,452,840 as 4.4e6."""
    shape: tuple[int, ...] = (2048, 3)
    encoders = []
    for chosen in encoders_of(name):
        config = resolve("encoder", chosen)
        encoders.append(build("encoder", config, input_shape=shape, input_columns=("x", "y", "z")))
        shape = encoders[-1].output_shape
    model = Model(encoders, build("density_head", resolve("density_head", "categorical"), target=CLASSES))
    parameters = sum(parameter.numel() for parameter in model.parameters())
    printed = PARAMETERS[name]
    digits, exponent = printed.split("e")
    step = 10.0 ** (int(exponent) - len(digits.partition(".")[2]))
    assert abs(parameters - float(printed)) < step, parameters


def test_the_ensemble_of_table_62_is_of_its_network() -> None:
    assert encoders_of("bps_conv3d_ensemble") == encoders_of("bps_conv3d_unpadded")


HEADS = {"optimizer.name": "adam", "trainer.max_epochs": 1000, "trainer.patience": 200, "data.jitter": 0.0}
THESIS_SETTINGS = {
    # §3.6.1
    "pascal3d/scvae encoder.inception_resnet_v2.weights=null": {
        "optimizer.name": "adam",
        "trainer.max_epochs": 200,
        "trainer.patience": 10,
        "data.jitter": 0.0,
    },
    "idiap/von_mises": HEADS,
    "caviar/cvae": {**HEADS, "density_head.backbones": "each"},
    "towncentre/mixture": HEADS,
    # §6.5.3
    "modelnet40/bps_mlp_400": {
        "optimizer.name": "adam",
        "optimizer.learning_rate": 1e-4,
        "optimizer.milestones": [2000],
        "optimizer.factor": 0.1,
        "trainer.max_epochs": 2500,
        "batch_size": 2048,
        "data.validation_share": 0,
        "encoder.mlp.dropout": [0.8, 0.4],
    },
    "modelnet40/bps_conv3d_ensemble": {
        "optimizer.learning_rate": 1e-4,
        "optimizer.milestones": [500],
        "trainer.max_epochs": 505,
        "batch_size": 512,
        "data.validation_share": 0,
        "encoder.voxnet.dropout": [0.8, 0.6],
    },
    **{
        f"modelnet40/bps_conv3d{kind}": {"encoder.voxnet.dropout": [0.8, 0.6], "trainer.max_epochs": 505}
        for kind in ("", "_delta", "_unpadded")
    },
    "cest/mlp": {
        "data.preset": "ten",
        "encoder.mlp.widths": [100, 100],
        "encoder.mlp.activation": "elu",
        "density_head.name": "gaussian",
    },
    "registration/large data.body=null": {
        "optimizer.name": "sgd",
        "optimizer.momentum": 0.9,
        "optimizer.schedule": "plateau",
        "optimizer.factor": 0.5,
        "optimizer.patience": 5,
        "trainer.max_epochs": 1000,
        "encoder.dense_blocks.width": 1024,
        "encoder.dense_blocks.bottleneck": None,
    },
}
"""Settings of training that the thesis states, by experiment."""


@pytest.mark.parametrize("experiment", THESIS_SETTINGS)
def test_a_preset_is_what_the_thesis_says(experiment: str) -> None:
    values = plain(composed(*command_line([*f"experiment={experiment}".split(), "preset=thesis"])))
    for key, expected in THESIS_SETTINGS[experiment].items():
        value: Any = values
        for part in key.split("."):
            value = value[part]
        assert value == expected, key


@pytest.mark.parametrize(
    "experiment",
    [
        "modelnet40/bps_mlp_400",
        pytest.param("modelnet40/bps_conv3d batch_size=4", marks=pytest.mark.slow),
        pytest.param(
            "pascal3d/von_mises data.image_size=75 data.images=60 batch_size=2 "
            "encoder.inception_resnet_v2.weights=null",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_preset_trains(experiment: str, framework: Framework) -> None:
    """Train with these presets; test_composition.py tests the presets of the other data sets."""
    run = ("preset=thesis", "debug=fast", "logger=none", "pictures=false", "threads=1")
    finished_run = framework(*f"experiment={experiment}".split(), *run)
    assert finished_run.code == 0, finished_run.out
    results = json.loads((finished_run.folder / "results.json").read_text(encoding="utf-8"))
    assert results["synthetic"]
    if "pascal3d" in experiment:
        assert results["parameters"] == pytest.approx(54_306_464 + 1537 * 9)
