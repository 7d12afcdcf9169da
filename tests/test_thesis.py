"""The thesis's own networks and settings: parameter counts of Tables 6.1 and 6.2."""

from typing import Any

import pytest
import yaml

from framework.configuration.composition import folder
from framework.configuration.schema import build, resolve
from framework.model import Model
from framework.target import Target

CLASSES = Target("class", tuple(f"class {number}" for number in range(40)))
"""Of ModelNet40."""
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
    "bps_mlp_400": "3.8e5",
    "bps_conv3d_unpadded": "4.4e6",
}
"""As printed; of VoxNet's and vanilla PointNet's zeros after the point the papers they come from say nothing."""


def encoders_of(name: str) -> list[dict[str, Any]]:
    """What an experiment on ModelNet40 says of its encoders; without Hydra, which takes a second to compose it."""
    said = yaml.safe_load((folder() / "experiment/modelnet40" / f"{name}.yaml").read_text(encoding="utf-8"))
    chosen = next(one["override /encoder"] for one in said["defaults"] if "override /encoder" in one)
    return [{"name": one, **said.get("encoder", {}).get(one, {})} for one in chosen]


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_network_has_the_parameters_that_the_thesis_gives(name: str) -> None:
    """To less than one in the last digit printed: 4,452,840 is 4.4e6 there."""
    shape: tuple[int, ...] = (2048, 3)
    encoders = []
    for chosen in encoders_of(name):
        config = resolve("encoder", chosen)
        encoders.append(build("encoder", config, input_shape=shape, input_columns=("x", "y", "z")))
        shape = encoders[-1].output_shape
    model = Model(encoders, build("density_head", resolve("density_head", "categorical"), target=CLASSES))
    found = sum(parameter.numel() for parameter in model.parameters())
    printed = PARAMETERS[name]
    digits, exponent = printed.split("e")
    step = 10.0 ** (int(exponent) - len(digits.partition(".")[2]))
    assert abs(found - float(printed)) < step, found


def test_the_ensemble_of_table_62_is_of_its_network() -> None:
    assert encoders_of("bps_conv3d_ensemble") == encoders_of("bps_conv3d_unpadded")
