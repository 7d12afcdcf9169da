"""A checkpoint without a training: of a model with drawn weights, for rows and tests of what reads one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from framework.configuration.assembly import Resolved, build_predictor
from framework.configuration.description import Description
from framework.configuration.loading import PREFIX
from framework.configuration.schema import resolve
from framework.storage import checkpoints
from framework.target import Target


def checkpoint(
    file: Path,
    parts: Mapping[str, Any],
    target: Target,
    shape: tuple[int, ...],
    columns: tuple[str, ...] = (),
    data_state: Mapping[str, Any] | None = None,
) -> str:
    """What a run would leave behind; its path.

    Args:
        parts: "data", "density_head", "encoder" and "uncertainty", the last two lists, each a name or a config.
        shape, columns: of an input.
        data_state: as of `Data.state_dict`.
    """
    config: Resolved = {"objective": [], "metric": [], "outliers": None}
    for group in ("data", "density_head"):
        config[group] = resolve(group, parts[group])
    for group in ("encoder", "uncertainty"):
        config[group] = [resolve(group, part) for part in parts.get(group, ())]
    made = build_predictor(config, target, shape, 0, columns)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    described = Description(config, target, shape, columns, True, data_state=data_state or {})
    weights = {PREFIX + key: value for key, value in made.state_dict().items()}
    checkpoints.write({"framework": described.stored(), "state_dict": weights}, file)
    return str(file)
