"""Loading of a trained model from a run folder, a checkpoint file or an MLflow run id, without Hydra."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
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
from framework.configuration.paths import require_paths
from framework.configuration.schema import resolve
from framework.data import Batch, Data, Frame
from framework.density_head import Fitted
from framework.distributions.affine import AffineDensity
from framework.errors import CheckpointError, ConfigError, DataError, UserError, shorten
from framework.model import FrozenFrontEnd, Predictor
from framework.storage import budget
from framework.storage.checkpoints import latest_good, read
from framework.storage.enclosed import require_plain_within
from framework.storage.old_versions import complete_description
from framework.storage.reading import translate_errors
from framework.storage.weights import describe_mismatch
from framework.target import Target

FOREIGN = "This framework did not write the file. Do not use the file."
PREFIX = "predictor."
"""Prefix of the predictor's parameter names in Lightning's checkpoints."""


def load(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> Predictor:
    """Return the trained model in evaluation mode, like `framework.load` without a budget; see its docstring."""
    predictor, description = load_with_description(run_or_checkpoint, uri=uri, paths=paths)
    return for_user(predictor, description)


def for_user(predictor: Predictor, description: Description) -> Predictor:
    """Return a loaded model after adding its description and the hooks with which it reads the user's own data."""
    predictor.description = description
    predictor.requires_grad_(False)
    user = User(reader(description))
    predictor.register_forward_pre_hook(
        user.convert_inputs, prepend=True
    )  # before other hooks, which check the inputs
    predictor.register_forward_hook(user.convert_density)
    return predictor


class User:
    """Hooks of a loaded model that convert the user's data to inputs and the density to the user's unit.

    The hooks are methods of an object, so that a model with these hooks can be copied, pickled and sent to another
    process.

    Args:
        data: Data set of the model, which converts the user's data to inputs and knows the unit of the target.
    """

    def __init__(self, data: Data) -> None:
        self.data = data
        self.frames = WeakTensorKeyDictionary()  # frames of the inputs of the calls in progress

    def convert_inputs(self, model: nn.Module, arguments: tuple[Any]) -> Tensor:
        """Return the model's inputs for a user's data, and store the result of `Data.frame` for `convert_density`.

        This is a forward pre-hook of torch: `arguments` holds the only argument of a call of the model, the user's
        data.
        """
        batch = read_batch(model, self.data, *arguments)
        self.frames[batch["input"]] = self.data.frame(batch)
        return batch["input"]

    def convert_density(self, model: nn.Module, inputs: tuple[Tensor], density: Distribution) -> Distribution:
        """Return `density` converted to the user's unit (`Data.frame`), with the names of the target.

        This is a forward hook of torch: `inputs` holds the inputs that `convert_inputs` returned.
        """
        frame: Frame | None = self.frames.pop(inputs[0])
        user_density = (
            density if frame is None else AffineDensity(density, *(part.to(inputs[0]) for part in frame))
        )
        with suppress(AttributeError):  # a density may have an attribute `names` that cannot be set
            user_density.names = self.data.target.names  # type: ignore[attr-defined]
        return user_density

    def __reduce__(self) -> tuple[type["User"], tuple[Data]]:
        return User, (self.data,)  # weak references cannot be pickled, and the copy has no call in progress


def read_batch(model: nn.Module, data: Data, user_data: Any) -> Batch:
    """Return the batch that a model reads for the user's data, in the model's data type and on its device.

    Raises:
        DataError: The user's data are empty, or the data set refuses them or fails to read them.
    """
    batch = user_batch(data, user_data)
    inputs = batch["input"]
    own = next(model.parameters(), inputs)
    # encoders scale bytes, which are pixels; numbers of other types are converted to the type of the model's weights
    kind = inputs.dtype if inputs.dtype == torch.uint8 else own.dtype
    return {**batch, "input": inputs.to(own.device, kind)}


def user_batch(data: Data, user_data: Any) -> Batch:
    """Return the batch of a data set for the user's data; a path may begin with `~`.

    Raises:
        DataError: The user's data are empty, or the data set refuses them or fails to read them.
    """
    user_data = _expand_home(user_data)
    if hasattr(user_data, "__len__") and not isinstance(user_data, str) and not len(user_data):
        raise DataError(
            f"Got an empty {type(user_data).__name__}, but at least one input is required. Give at least one file, "
            "row or array."
        )
    try:
        return data.user_batch(user_data)
    except UserError:
        raise
    except Exception as error:
        # for example for a date or a tensor with a gradient
        raise DataError(
            f"The {type(user_data).__name__} cannot be read as inputs ({shorten(error)}). Give files, an array of "
            "numbers, or another kind of input that the data set of this model reads."
        ) from error


def _expand_home(user_data: Any) -> Any:
    """Return paths with `~` replaced by the user's home folder; other values are returned unchanged."""
    if isinstance(user_data, str | Path):
        return type(user_data)(Path(user_data).expanduser()) if str(user_data).startswith("~") else user_data
    if (
        isinstance(user_data, list | tuple)
        and user_data
        and all(isinstance(item, str | Path) for item in user_data)
    ):
        return [_expand_home(item) for item in user_data]
    return user_data


def reader(description: Description, chosen: Data | None = None) -> Data:
    """Return the data set of a model, not prepared, which converts the user's data to inputs.

    If the user has not repeated a path of the data set, its `prepare` raises an error, because the default path leads
    to other data.

    Args:
        description: Description of the model.
        chosen: Data set that the caller has built already, and which is then returned; None: it is built from the
            description.
    """
    with (
        translate_errors(
            Path(description.path), "a checkpoint of this framework", FOREIGN, kind=CheckpointError
        ),
        blame_plugin(description.path),
    ):
        try:
            data = (
                build_data({"data": resolve("data", description.config["data"])})
                if chosen is None
                else chosen
            )
        except ConfigError:
            require_paths(description.dropped, ("data",), description.path)
            raise
        data.target, data.input_shape = description.target, description.input_shape
        data.columns, data.synthetic = description.columns, description.synthetic
        data.load_state_dict(description.data_state)
    if any(key.startswith("data.") for key in description.dropped):
        refuse = partial(require_paths, description.dropped, ("data",), description.path)
        data.prepare = refuse  # type: ignore[method-assign]
    return data


def training_data(description: Description, name: str) -> Any:
    """Return the data set that a stored model was trained on, without preparing it.

    Args:
        description: Description of the stored model.
        name: Name of the only data set that the calling command can use.

    Raises:
        ConfigError: The model was trained on other data, or the user has not repeated a path of the data set.
    """
    part = description.config["data"]
    if part["name"] != name:
        raise ConfigError(
            f"{description.path} was trained on data {part['name']!r}; expected a model trained on {name!r}. Choose "
            "another run or checkpoint."
        )
    require_paths(description.dropped, ("data",), description.path)
    return build_data({"data": resolve("data", part)})


def load_with_description(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> tuple[Predictor, Description]:
    """Return the trained predictor and the description in its checkpoint; arguments and errors are those of `load`."""
    description, state = read_stored(run_or_checkpoint, uri=uri, paths=paths)
    return rebuild(description, state), description


def read_stored(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> tuple[Description, dict[str, torch.Tensor]]:
    """Return the description and the weights in a checkpoint; arguments and errors are those of `load`."""
    path = find_checkpoint(run_or_checkpoint, uri=uri)
    content = read(path)
    with translate_errors(path, "a checkpoint of this framework", FOREIGN, kind=CheckpointError):
        return Description.read(content, str(path), paths), predictor_weights(content)


def read_interface(
    described: Mapping[str, Any], path: Path
) -> tuple[Target, tuple[int, ...], tuple[str, ...]]:
    """Return the target, the shape of an input and the names of its columns that a checkpoint describes.

    Args:
        described: Description in the checkpoint, as plain values.
        path: Path of the checkpoint, for messages.

    Raises:
        CheckpointError: The description is invalid.
    """
    with translate_errors(path, "a checkpoint of this framework", FOREIGN, kind=CheckpointError):
        complete = complete_description(described)
        return (
            stored_target(complete["target"]),
            stored_shape(complete["input_shape"]),
            stored_names(complete["columns"], "columns"),
        )


def rebuild(description: Description, state: Mapping[str, torch.Tensor]) -> Predictor:
    """Build the predictor that `description` describes, copy the weights `state` into it, and set evaluation mode.

    Raises:
        CheckpointError: The weights belong to another model.
    """
    with (
        translate_errors(
            Path(description.path), "a checkpoint of this framework", FOREIGN, kind=CheckpointError
        ),
        blame_plugin(description.path),
    ):
        parts = description.config
        for part in parts["encoder"]:
            # the checkpoint contains the weights, and the file of the initial weights may have been removed
            part.update(dict.fromkeys(registry.load("encoder", part["name"]).initial))
        shape, columns = description.input_shape, description.columns
        # initial weights are sampled and then replaced; fork_rng preserves the state of the user's generator
        with budget.building(description.path, state.values()), torch.random.fork_rng(devices=[]):
            predictor = build_predictor(parts, description.target, shape, 0, columns)
            fill(predictor, state, description.path)
    bound_first_prediction(predictor, description.path)
    return predictor.eval()


@contextmanager
def blame_plugin(path: str) -> Iterator[None]:
    """Convert an error that passes through a plugin to an error that names the line of the plugin.

    Args:
        path: Path of the checkpoint whose model is built in the block.

    Raises:
        CheckpointError: A plugin failed.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        place = registry.plugin_line(error)
        if not place:
            raise
        fault = f"{type(error).__name__}: {shorten(error)}".removesuffix(": ")
        raise CheckpointError(
            f"{path}: the model of this checkpoint cannot be built, because a plugin failed at {place} ({fault}). Mend "
            "the plugin if it has changed since the training. Otherwise the file is damaged or was not written by this "
            "framework: do not use it."
        ) from error


def bound_first_prediction(predictor: Predictor, path: str) -> None:
    """Limit the memory of predictions of a stored model (`budget.predicting`).

    A prediction that would take far more memory than the sizes of the model's weights and of the inputs justify raises
    an error before the memory is allocated. The limit holds for every batch with more samples than all earlier ones.
    """
    # a frozen model calls the fixed encoders and the predictor behind them separately
    split = isinstance(predictor, FrozenFrontEnd)
    for module in (predictor.encoders, predictor.predictor) if split else (predictor,):
        first = FirstPrediction(path)
        module.register_forward_pre_hook(first.start)
        module.register_forward_hook(first.stop, always_call=True)


class FirstPrediction:
    """Hooks of `bound_first_prediction`, which limit the memory of predictions.

    A prediction is limited only if its batch has more samples than every earlier batch.

    Args:
        path: Path of the checkpoint.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.bounded = 0  # number of samples of the largest batch so far
        self.active: dict[int, budget.Budget] = {}  # by thread

    def start(self, module: nn.Module, inputs: tuple[Any, ...]) -> None:
        """Limit the memory of this prediction if its batch is larger than every batch before."""
        if isinstance(inputs[0], Tensor) and len(inputs[0]) > self.bounded:
            active = budget.predicting(self.path, module.state_dict().values(), inputs[0])
            self.active[get_ident()] = active.__enter__()

    def stop(self, module: nn.Module, inputs: tuple[Any, ...], density: Any) -> None:
        """End the limit of `start`, and note the size of the batch if the prediction succeeded."""
        active = self.active.pop(get_ident(), None)
        if active is not None:
            active.__exit__(None, None, None)
            self.bounded = max(self.bounded, len(inputs[0]) if density is not None else 0)


def predictor_weights(content: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return the predictor's parameters and buffers in a checkpoint of Lightning or of `Session.save_model`."""
    state = content["state_dict"]
    return {key.removeprefix(PREFIX): value for key, value in state.items() if key.startswith(PREFIX)}


def fill(predictor: Predictor, state: Mapping[str, torch.Tensor], name: str) -> None:
    """Copy the weights `state` from the checkpoint `name` into a predictor.

    Raises:
        CheckpointError: The weights belong to another model; the message says what does not fit.
    """
    # the shapes of a head that is fitted in one step depend on its training data
    own = tuple(
        f"{name}." if name else "" for name, part in predictor.named_modules() if isinstance(part, Fitted)
    )
    require_match(describe_mismatch(predictor.state_dict(), state, any_shape=own), name)
    predictor.load_state_dict(dict(state))
    # torch copies the first number of a row into a scalar without an error
    require_match(describe_mismatch(predictor.state_dict(), state), name)


def require_match(mismatch: str | None, name: str) -> None:
    """Raise a CheckpointError if weights do not fit the model of the checkpoint `name`.

    `mismatch` is a sentence that says what does not fit; None if the weights fit.
    """
    if mismatch:
        raise CheckpointError(
            f"{name} belongs to another model: {mismatch} Use the config of its training, or give another checkpoint."
        )


def find_checkpoint(run_or_checkpoint: object, *, uri: str | None = None) -> Path:
    """Return the checkpoint file of a model.

    Args:
        run_or_checkpoint: Run folder, path of a checkpoint file, or MLflow run id.
        uri: Tracking store of the run id; None for the local store under `outputs/`.

    Raises:
        CheckpointError: There is no checkpoint, or the argument is neither a path nor a name.
    """
    if not isinstance(run_or_checkpoint, (str, Path)):
        raise CheckpointError(
            f"Got a {type(run_or_checkpoint).__name__} as the source of a trained model; expected a run folder, a "
            "checkpoint file or an MLflow run id. Give one of these."
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
            newest = latest_good(folder) if folder.is_dir() else None
            if newest is not None:
                return newest
        raise CheckpointError(
            f"{path} contains no checkpoint. Give the folder of a run that has trained for at least one epoch."
        )
    name = str(run_or_checkpoint)
    if len(name) == 32 and all(letter in "0123456789abcdef" for letter in name):
        from framework.tracking.mlflow_store import run_folder

        return find_checkpoint(run_folder(name, uri))
    raise CheckpointError(
        f"{run_or_checkpoint} is neither a file, a folder nor an MLflow run id. "
        "Give the folder that a run printed at its start (outputs/<experiment>/<time>)."
    )
