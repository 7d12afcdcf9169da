"""Gives a trained model back, from a run folder, a checkpoint file or an MLflow run id; no Hydra needed."""

from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import get_ident
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.utils.weak import WeakTensorKeyDictionary

from framework.configuration import registry
from framework.configuration.assembly import build_data, build_predictor
from framework.configuration.description import Description, stored_names, stored_shape, stored_target
from framework.configuration.paths import require_said
from framework.configuration.schema import resolve
from framework.data import Batch, Data, Frame
from framework.density_head import Fitted
from framework.distributions.moved import Moved
from framework.errors import CheckpointError, ConfigError, DataError, UserError, shown
from framework.model import FrozenFrontEnd, Predictor
from framework.storage import budget
from framework.storage.checkpoints import latest_good, read
from framework.storage.enclosed import require_plain_within
from framework.storage.reading import guarded
from framework.storage.weights import describe_mismatch
from framework.target import Target

FOREIGN = "This framework did not write it: do not use it."
PREFIX = "predictor."
"""What Lightning's checkpoints put before the predictor's own parameter names."""


def load(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> Predictor:
    """The trained model in evaluation mode, on the CPU; it takes what its user has, and answers in the user's unit.

    `model(given)` is the density over the target, with batch_shape (batch,): of files, arrays, or what else the data
    set takes (`Data.inputs`); angles in radians, reals in their own unit, classes by their number in `density.names`,
    which of other targets are those of their numbers. Its other methods take inputs as the data set makes them. What is
    drawn (latent variables, dropout, samples) comes from torch's global generator: `torch.manual_seed` before a call
    repeats it. Loading draws nothing from it. The weights ask for no gradient, so that NumPy, pandas and Matplotlib
    take what comes out; `model.requires_grad_()` before training on.

    Args:
        run_or_checkpoint: a run folder (`outputs/...`), a `.ckpt` file, or an MLflow run id.
        uri: tracking store for a run id; the local one under `outputs/` by default.
        paths: files and folders by their keys in the model's config, {"encoder.rasterised.body": "/my/body.npz"}. A
            path that the checkpoint names itself is used for nothing: it may come from anybody.

    Raises:
        CheckpointError: nothing is there, it is damaged, or it does not fit the model it describes.
        ConfigError: the model needs a path that `paths` does not give.
    """
    predictor, description = load_with_description(run_or_checkpoint, uri=uri, paths=paths)
    predictor.description = description
    predictor.requires_grad_(False)
    user = User(reader(description))
    predictor.register_forward_pre_hook(user.asks, prepend=True)  # before what looks at inputs
    predictor.register_forward_hook(user.hears)
    return predictor


class User:
    """What a loaded model takes and answers, as its hooks: methods of an object, so that the model can be copied,
    pickled and sent to another process with them.

    Args:
        data: the data set of the model; it makes inputs of what is given, and knows the unit of the answer.
    """

    def __init__(self, data: Data) -> None:
        self.data = data
        self.frames = WeakTensorKeyDictionary()  # of the inputs that are being predicted for

    def asks(self, model: nn.Module, given: tuple[Any]) -> Tensor:
        batch = asked_of(model, self.data, *given)
        self.frames[batch["input"]] = self.data.frame(batch)
        return batch["input"]

    def hears(self, model: nn.Module, inputs: tuple[Tensor], density: Distribution) -> Distribution:
        frame: Frame | None = self.frames.pop(inputs[0])
        answer = density if frame is None else Moved(density, *(part.to(inputs[0]) for part in frame))
        with suppress(AttributeError):  # a density may have names of its own
            answer.names = self.data.target.names  # type: ignore[attr-defined]
        return answer

    def __reduce__(self) -> tuple[type["User"], tuple[Data]]:
        return User, (self.data,)  # weak references cannot be pickled, and no call is under way in the copy


def asked_of(model: nn.Module, data: Data, given: Any) -> Batch:
    """Return what a model reads of what a user gives; a path may begin with `~`.

    Raises:
        DataError: as `Data.asked`, and for whatever else it cannot make inputs of.
    """
    given = _without_tilde(given)
    if hasattr(given, "__len__") and not isinstance(given, str) and not len(given):
        raise DataError(
            f"An empty {type(given).__name__} holds no input. Give at least one file, row or array."
        )
    try:
        batch = data.asked(given)
    except UserError:
        raise
    except Exception as error:  # of NumPy, pandas or torch, about a date or a tensor with a gradient, say
        raise DataError(
            f"{type(given).__name__} cannot be read as inputs ({shown(error)}). Give files, an array of numbers, or "
            "what else the data set of this model takes."
        ) from error
    inputs = batch["input"]
    own = next(model.parameters(), inputs)
    # bytes are pixels, which encoders scale; any other number is one of the model's own type
    kind = inputs.dtype if inputs.dtype == torch.uint8 else own.dtype
    return {**batch, "input": inputs.to(own.device, kind)}


def _without_tilde(given: Any) -> Any:
    """Return paths in which `~` is the user's folder; anything else as it is."""
    if isinstance(given, str | Path):
        return type(given)(Path(given).expanduser()) if str(given).startswith("~") else given
    if isinstance(given, list | tuple) and given and all(isinstance(item, str | Path) for item in given):
        return [_without_tilde(item) for item in given]
    return given


def reader(description: Description) -> Data:
    """The data set of a model, not prepared: it makes inputs of what a user gives.

    Where a path of it was not said again, preparing it is refused: it would be other data.
    """
    with guarded(Path(description.path), "a checkpoint of this framework", FOREIGN, kind=CheckpointError):
        try:
            data = build_data({"data": resolve("data", description.config["data"])})
        except ConfigError:
            require_said(description.dropped, ("data",), description.path)
            raise
        data.target, data.input_shape = description.target, description.input_shape
        data.columns, data.synthetic = description.columns, description.synthetic
        data.load_state_dict(description.data_state)
    if any(key.startswith("data.") for key in description.dropped):
        refuse = partial(require_said, description.dropped, ("data",), description.path)
        data.prepare = refuse  # type: ignore[method-assign]
    return data


def load_with_description(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> tuple[Predictor, Description]:
    """The trained predictor, as `load`, with what the checkpoint says of itself."""
    description, state = stored(run_or_checkpoint, uri=uri, paths=paths)
    return rebuilt(description, state), description


def stored(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> tuple[Description, dict[str, torch.Tensor]]:
    """What a checkpoint says of its model, and the model's weights; as `load`."""
    path = find_checkpoint(run_or_checkpoint, uri=uri)
    content = read(path)
    with guarded(path, "a checkpoint of this framework", FOREIGN, kind=CheckpointError):
        return Description.read(content, str(path), paths), weights(content)


def interface(described: Mapping[str, Any], path: Path) -> tuple[Target, tuple[int, ...], tuple[str, ...]]:
    """Return the target, the shape of an input and its columns that the checkpoint `path` describes.

    Raises:
        CheckpointError: what stands there describes none.
    """
    with guarded(path, "a checkpoint of this framework", FOREIGN, kind=CheckpointError):
        return (
            stored_target(described["target"]),
            stored_shape(described["input_shape"]),
            stored_names(described.get("columns", ()), "columns"),
        )


def rebuilt(description: Description, state: Mapping[str, torch.Tensor]) -> Predictor:
    """The predictor that is described, with these weights, in evaluation mode.

    Raises:
        CheckpointError: they are of another model.
    """
    with guarded(Path(description.path), "a checkpoint of this framework", FOREIGN, kind=CheckpointError):
        parts = description.config
        for part in parts["encoder"]:
            # the checkpoint holds the weights now; the file they were started from may be gone
            part.update(dict.fromkeys(registry.load("encoder", part["name"]).initial))
        shape, columns = description.input_shape, description.columns
        # the initial weights are drawn, and replaced: the user's own draws stay what they were
        with budget.building(description.path, state.values()), torch.random.fork_rng(devices=[]):
            predictor = build_predictor(parts, description.target, shape, 0, columns)
            fill(predictor, state, description.path)
    bounded_at_first(predictor, description.path)
    return predictor.eval()


def bounded_at_first(predictor: Predictor, path: str) -> None:
    """Let the first prediction of a stored model end in an error before it takes far more memory than the weights and
    inputs account for (`budget.predicting`)."""
    # of one with fixed encoders in front each is called apart, by the frozen form
    split = isinstance(predictor, FrozenFrontEnd)
    for module in (predictor.encoders, predictor.predictor) if split else (predictor,):
        first = FirstPrediction(path)
        module.register_forward_pre_hook(first.begins)
        module.register_forward_hook(first.ends, always_call=True)


class FirstPrediction:
    """The hooks of `bounded_at_first`; later predictions for as many samples do nothing with them.

    Args:
        path: the checkpoint.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.bounded = 0  # rows of the largest batch that was predicted for
        self.active: dict[int, budget.Budget] = {}  # by thread

    def begins(self, module: nn.Module, given: tuple[Any, ...]) -> None:
        if isinstance(given[0], Tensor) and len(given[0]) > self.bounded:
            active = budget.predicting(self.path, module.state_dict().values(), given[0])
            self.active[get_ident()] = active.__enter__()

    def ends(self, module: nn.Module, given: tuple[Any, ...], density: Any) -> None:
        active = self.active.pop(get_ident(), None)
        if active is not None:
            active.__exit__(None, None, None)
            self.bounded = max(self.bounded, len(given[0]) if density is not None else 0)


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
    require_match(describe_mismatch(predictor.state_dict(), state, any_shape=own), name)
    predictor.load_state_dict(dict(state))
    # of a row of numbers torch takes the first where it wants one
    require_match(describe_mismatch(predictor.state_dict(), state), name)


def require_match(mismatch: str | None, name: str) -> None:
    """Refuse weights that do not fit; errors as `fill`."""
    if mismatch:
        raise CheckpointError(
            f"{name} belongs to another model: {mismatch} Use the config it was trained with, or another checkpoint."
        )


def find_checkpoint(run_or_checkpoint: object, *, uri: str | None = None) -> Path:
    """The file meant by a run folder, a file or an MLflow run id.

    Raises:
        CheckpointError: nothing is there, or it is no path or name.
    """
    if not isinstance(run_or_checkpoint, (str, Path)):
        raise CheckpointError(
            f"A trained model was asked of a {type(run_or_checkpoint).__name__}; wanted a run folder, a checkpoint "
            "file or an MLflow run id. Give what the model was loaded from."
        )
    path = Path(run_or_checkpoint).expanduser()
    if path.is_file():
        return path
    if path.is_dir():
        for folder in (path / "checkpoints", path):
            require_plain_within(folder / "any", path, CheckpointError)
            for name in ("model.ckpt", "best.ckpt"):
                if (folder / name).is_file():
                    require_plain_within(folder / name, path, CheckpointError)
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
