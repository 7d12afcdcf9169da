"""Gives a trained model back, from a run folder, a checkpoint file or an MLflow run id; no Hydra needed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import torch
from torch import nn
from torch.distributions import Distribution

from framework.configuration import registry
from framework.configuration.assembly import build_data, build_predictor
from framework.configuration.schema import resolve
from framework.data import Data
from framework.density_head import Fitted
from framework.errors import CheckpointError
from framework.model import Predictor, describe_mismatch
from framework.runs.description import Description
from framework.target import Target
from framework.training.checkpoint import latest_good, read

PREFIX = "predictor."
"""What Lightning's checkpoints put before the predictor's own parameter names."""


@final
class Loaded(nn.Module):
    """A trained model that takes what its user has, and answers in the user's unit.

    Attributes:
        predictor: the model itself, from inputs as its data set makes them to a density.
        description: what its checkpoint says of it: parts, target, method, data.
        data: the data set it was trained on, which nothing was read of: it knows how raw input is made ready.
    """

    def __init__(self, predictor: Predictor, description: Description, data: Data) -> None:
        super().__init__()
        self.predictor = predictor
        self.description = description
        self.data = data

    @property
    def target(self) -> Target:
        """What is predicted: its kind, and the names of its numbers or classes."""
        return self.description.target

    def forward(self, given: Any) -> Distribution:
        """The density over the target, with batch_shape (batch,): angles in radians, reals in their own unit.

        Args:
            given: files, arrays, or what else the data set takes (`Data.inputs`).

        Raises:
            DataError: it is no input of this model.
        """
        inputs = self.data.inputs(given)
        own = next(self.predictor.parameters(), inputs)
        # bytes are pixels, which encoders scale; any other number is one of the model's own type
        return self.predictor(
            inputs.to(own.device, inputs.dtype if inputs.dtype == torch.uint8 else own.dtype)
        )

    def __repr__(self) -> str:
        about, parts = self.description, self.description.config
        names = " + ".join(
            part["name"] for part in [*parts["encoder"], parts["density_head"], *parts["uncertainty"]]
        )
        count = sum(parameter.numel() for parameter in self.predictor.parameters())
        unit = {"angle": "angles in radians", "real": "reals in their own unit", "class": "classes"}[
            about.target.kind
        ]
        data = f"{parts['data']['name']}{' (synthetic)' if about.synthetic else ''}"
        return "\n".join(
            [
                f"{about.method or names}, trained on {data}",
                f"  reads    {'×'.join(map(str, about.input_shape))} {', '.join(about.columns)}".rstrip(),
                f"  predicts {unit}: {about.target.told}",
                f"  made of  {names}, {count:,} parameters",
                f"  from     {about.path}",
            ]
        )


def load(run_or_checkpoint: str | Path, *, uri: str | None = None) -> Loaded:
    """The trained model in evaluation mode, on the CPU.

    Args:
        run_or_checkpoint: a run folder (`outputs/...`), a `.ckpt` file, or an MLflow run id.
        uri: tracking store for a run id; the local one under `outputs/` by default.

    Raises:
        CheckpointError: nothing is there, it is damaged, or it does not fit the model it describes.
    """
    predictor, description = load_with_description(run_or_checkpoint, uri=uri)
    return Loaded(predictor, description, reader(description)).eval()


def reader(description: Description) -> Data:
    """The data set of a model, not prepared: it makes inputs of what a user gives."""
    data = build_data({"data": resolve("data", description.config["data"])})
    data.target, data.input_shape = description.target, description.input_shape
    data.columns, data.synthetic = description.columns, description.synthetic
    data.load_state_dict(description.data_state)
    return data


def load_with_description(
    run_or_checkpoint: str | Path, *, uri: str | None = None
) -> tuple[Predictor, Description]:
    """The trained predictor, as `load`, with what the checkpoint says of itself."""
    path = find_checkpoint(run_or_checkpoint, uri=uri)
    content = read(path)
    description = Description.read(content, str(path))
    parts = description.config
    for part in parts["encoder"]:
        # the checkpoint holds the weights now; the file they were started from may be gone
        part.update(dict.fromkeys(registry.load("encoder", part["name"]).initial))
    predictor = build_predictor(parts, description.target, description.input_shape, 0, description.columns)
    fill(predictor, weights(content), str(path))
    return predictor.eval(), description


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
