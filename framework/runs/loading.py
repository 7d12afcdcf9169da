"""Gives a trained model back, from a run folder, a checkpoint file or an MLflow run id; no Hydra needed."""

from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import torch

from framework.configuration import registry
from framework.configuration.assembly import Resolved, build_predictor
from framework.configuration.schema import resolve
from framework.data import Data
from framework.density_head import Fitted
from framework.errors import CheckpointError
from framework.model import Predictor, describe_mismatch
from framework.storage.reading import guarded
from framework.target import Kind, Target
from framework.training.checkpoint import latest_good, read

LONGEST_NAME = 1000
"""Letters of a target's name."""
PREFIX = "predictor."
"""What Lightning's checkpoints put before the predictor's own parameter names."""


def description(resolved: Resolved, data: Data) -> dict[str, Any]:
    """What a checkpoint must hold beside the weights so that the model can be built again: plain values only."""
    return {
        "format": 1,
        "version": version("robust-visual-learning"),
        "config": resolved,
        "target": {**asdict(data.target), "names": list(data.target.names)},
        "input_shape": list(data.input_shape),
        "columns": list(data.columns),
        "synthetic": data.synthetic,
    }


def load(run_or_checkpoint: str | Path, *, uri: str | None = None) -> Predictor:
    """The trained predictor in evaluation mode, on the CPU.

    Args:
        run_or_checkpoint: a run folder (`outputs/...`), a `.ckpt` file, or an MLflow run id.
        uri: tracking store for a run id; the local one under `outputs/` by default.

    Raises:
        CheckpointError: nothing is there, it is damaged, or it does not fit the model it describes.
    """
    return load_with_description(run_or_checkpoint, uri=uri)[0]


def load_with_description(
    run_or_checkpoint: str | Path, *, uri: str | None = None
) -> tuple[Predictor, dict[str, Any]]:
    """As `load`, with what the checkpoint says of itself (`description`)."""
    path = find_checkpoint(run_or_checkpoint, uri=uri)
    content = read(path)
    described = content.get("framework")
    format_of = described.get("format") if isinstance(described, Mapping) else None
    if not isinstance(described, Mapping) or not isinstance(format_of, int) or format_of != 1:
        raise CheckpointError(
            f"{path} was not written by this framework (it holds no model description of format 1). "
            "Give a run folder, or a checkpoint from its checkpoints/."
        )
    remedy = "This framework did not write it: do not use it."
    with guarded(path, "a checkpoint of this framework", remedy, kind=CheckpointError):
        resolved = checked(described["config"])
        for part in resolved["encoder"]:
            # the checkpoint holds the weights now; the file they were started from may be gone
            part.update(dict.fromkeys(registry.load("encoder", part["name"]).initial))
        target = Target(described["target"]["kind"], tuple(described["target"]["names"]))
        if target.kind not in get_args(Kind) or any(len(name) > LONGEST_NAME for name in target.names):
            raise ValueError(f"a target of kind {target.kind!r} with the names {target.names}")
        columns = tuple(described.get("columns", ()))
        predictor = build_predictor(resolved, target, tuple(described["input_shape"]), 0, columns)
        fill(predictor, weights(content), str(path))
    return predictor.eval(), {**described, "config": resolved, "path": str(path)}


def checked(config: Mapping[str, Any]) -> Resolved:
    """A stored config, checked again: a checkpoint can only choose among installed plugins and valid values."""
    resolved: Resolved = {}
    for group, part in config.items():
        if isinstance(part, list):
            resolved[group] = [resolve(group, item, f"{group}[{i}]") for i, item in enumerate(part)]
        elif group in ("encoder", "density_head", "uncertainty"):
            resolved[group] = resolve(group, part)
        else:
            resolved[group] = None if part is None else dict(part)
    return resolved


def weights(content: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """The predictor's own parameters and buffers out of a checkpoint of either kind."""
    state = content["state_dict"]
    return {key.removeprefix(PREFIX): value for key, value in state.items() if key.startswith(PREFIX)}


def fill(predictor: Predictor, state: Mapping[str, torch.Tensor], name: str) -> None:
    """Copy weights into a predictor.

    Raises:
        CheckpointError: they belong to another model; says what does not fit.
    """
    # what a head fitted at once holds depends on the data it was fitted to
    own = tuple(
        f"{name}." if name else "" for name, part in predictor.named_modules() if isinstance(part, Fitted)
    )
    wanted, found = (
        {name: value for name, value in weights.items() if not name.startswith(own)}
        for weights in (predictor.state_dict(), state)
    )
    mismatch = describe_mismatch(wanted, found)
    if mismatch:
        raise CheckpointError(
            f"{name} belongs to another model: {mismatch} Use the config it was trained with, or another checkpoint."
        )
    predictor.load_state_dict(dict(state))


def find_checkpoint(run_or_checkpoint: str | Path, *, uri: str | None = None) -> Path:
    """The file meant by a run folder, a file or an MLflow run id.

    Raises:
        CheckpointError: nothing is there.
    """
    path = Path(run_or_checkpoint).expanduser()
    if path.is_file():
        return path
    if path.is_dir():
        for folder in (path / "checkpoints", path):
            for name in ("model.ckpt", "best.ckpt"):
                if (folder / name).is_file():
                    return folder / name
            good = latest_good(folder) if folder.is_dir() else None
            if good is not None:
                return good
        raise CheckpointError(f"{path} holds no checkpoint. Give a run folder that has trained for an epoch.")
    name = str(run_or_checkpoint)
    if len(name) == 32 and all(letter in "0123456789abcdef" for letter in name):
        from framework.tracking.mlflow_store import run_folder

        return find_checkpoint(run_folder(name, uri))
    raise CheckpointError(
        f"{run_or_checkpoint} is neither a file, a folder nor an MLflow run id. "
        "Give the folder a run printed at its start (outputs/<experiment>/<time>)."
    )
