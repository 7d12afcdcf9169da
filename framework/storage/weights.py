"""Loading of pretrained weights from a local file of named tensors, and description of weights that do not fit."""

import logging
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from jaxtyping import Shaped
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from framework.errors import CheckpointError, ConfigError, shorten
from framework.storage.plain_tensors import load
from framework.storage.plain_values import Foreign
from framework.storage.reading import most_decompressed, open_regular

_log = logging.getLogger(__name__)

LISTED = 5
"""Largest number of names of weights that a message lists; of further names, it states only the number."""
NUMBERS = (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32)
"""Data types that weights may have; complex numbers would lose their imaginary parts silently."""


def fill_from_file(network: nn.Module, file: str, ignored: tuple[str, ...], within: str = "") -> None:
    """Copy the weights of `file` into `network`, name by name.

    Args:
        network: Network whose `state_dict` names the weights.
        file: Path of a file that `read_weights` reads.
        ignored: Prefixes of names that the network does not use, such as the classifier's; they may be absent.
        within: Prefix that is removed from the names in the file, such as "features.".

    Raises:
        ConfigError: The file does not exist.
        CheckpointError: The file cannot be read, or its names or shapes differ from the network's.
    """
    file_weights = read_weights(file)
    weights = {name: tensor for name, tensor in file_weights.items() if not name.startswith(ignored)}
    if len(weights) < len(file_weights):
        names = ", ".join(sorted(file_weights.keys() - weights.keys()))
        _log.info("The network does not use these weights of %s: %s.", file, names)
    weights = {name.removeprefix(within): tensor for name, tensor in weights.items()}
    network_weights = network.state_dict()
    # Since torch 0.4.1, batch norm counts its batches. Older files lack this count, which nothing reads.
    counters = {
        name: tensor for name, tensor in network_weights.items() if name.endswith(".num_batches_tracked")
    }
    weights = counters | weights
    mismatch = describe_mismatch(network_weights, weights)
    if mismatch:
        raise CheckpointError(
            f"{file} does not fit {type(network).__name__}: {mismatch} Give a file with the names and shapes of "
            f"{type(network).__name__}."
        )
    network.load_state_dict(weights)


def read_weights(file: str) -> dict[str, Shaped[Tensor, "..."]]:
    """Return the named tensors of a `.safetensors` file or a file of `torch.save` (`.pth`, `.pt`), on the CPU.

    The tensors of a torch file may lie under the key "state_dict" or "model", and their names may begin with
    "module.", as training scripts write them. Damage is detected by the checksums of torch's format. Files of
    `.safetensors` and files older than torch 1.6 have no checksums, so only damage to their structure is detected.

    Raises:
        ConfigError: The file does not exist.
        CheckpointError: The file is damaged, contains more than plain values, or has no named tensors.
    """
    path = Path(file).expanduser()
    if not path.is_file():
        raise ConfigError(
            f"The weight file {path} does not exist. Weights are not downloaded automatically. Download them and give "
            "the path of the file."
        )
    content = _read_safetensors(path) if path.suffix == ".safetensors" else _read_torch(path)
    for key in ("state_dict", "model"):
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if not isinstance(content, Mapping) or not content or not all(map(torch.is_tensor, content.values())):
        raise CheckpointError(
            f"{path} contains no named tensors. Give a file that `torch.save(network.state_dict(), ...)` has written."
        )
    return {str(name).removeprefix("module."): tensor for name, tensor in content.items()}


def _read_torch(path: Path) -> Any:
    try:
        # torch does not verify the checksums of its zip format, so a flipped bit would load as another number
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                # torch does not read a part that is marked as a folder (attribute 0x10); its tensor stays uninitialised
                folders = [part.filename for part in archive.infolist() if part.external_attr & 0x10]
                size = sum(part.file_size for part in archive.infolist())
                if size > most_decompressed(path.stat().st_size):
                    raise ValueError(
                        f"the parts of the zip archive decompress to {size} bytes, but at most "
                        f"{most_decompressed(path.stat().st_size)} bytes are allowed"
                    )
                failed = archive.testzip() or next(iter(folders), None)
            if failed:
                raise ValueError(f"the part {failed} of the zip archive fails its checksum")
        with open_regular(path) as file:
            return load(file)
    except (Foreign, UnpicklingError) as error:
        raise CheckpointError(
            f"{path} contains more than plain tensors: {_first_line(error)}. Reading other objects could run code. "
            "Save the weights again with `torch.save(network.state_dict(), ...)`."
        ) from None
    except Exception as error:  # for damaged bytes, zipfile and torch raise many classes, even AssertionError
        raise _damage_error(path, _first_line(error)) from None


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise _damage_error(path, _first_line(error)) from None
    for name, tensor in tensors.items():
        if tensor.dtype not in NUMBERS:
            raise _damage_error(
                path, f"{name} has numbers of type {tensor.dtype}; expected {', '.join(map(str, NUMBERS))}"
            )
    return tensors


def _damage_error(path: Path, why: str) -> CheckpointError:
    return CheckpointError(f"The weight file {path} is damaged: {why}. Download the file again.")


def _first_line(error: Exception) -> str:
    return shorten((str(error).splitlines() or [type(error).__name__])[0].rstrip("."))


def describe_mismatch(
    model_weights: Mapping[str, Shaped[Tensor, "..."]],
    file_weights: Mapping[str, Any],
    any_shape: tuple[str, ...] = (),
) -> str | None:
    """Return one sentence on how the weights of a file differ from those of a model, or None if they fit.

    Floating-point numbers may have any width, because copying casts them. Other types must agree, because copying
    would silently drop the imaginary part of a complex number and the upper half of an integer.

    Args:
        model_weights: Weights of the model, by name.
        file_weights: Weights of the file, by name.
        any_shape: Prefixes of names whose weights may have any shape or be absent.
    """
    names = {name for name in (*model_weights, *file_weights) if not name.startswith(any_shape)}
    missing = [name for name in model_weights if name in names and name not in file_weights]
    unexpected = [name for name in file_weights if name in names and name not in model_weights]
    both = [
        (name, tensor, file_weights[name]) for name, tensor in model_weights.items() if name in file_weights
    ]
    retyped = [
        f"{name} ({_kind(file_tensor)} instead of {_kind(tensor)})"
        for name, tensor, file_tensor in both
        if not (isinstance(file_tensor, Tensor) and _same_kind(tensor, file_tensor))
    ]
    reshaped = [
        f"{name} ({_shape(file_tensor)} instead of {_shape(tensor)})"
        for name, tensor, file_tensor in both
        if name in names and isinstance(file_tensor, Tensor) and file_tensor.shape != tensor.shape
    ]
    parts = [
        f"{len(names)} of {total} {difference}: {_list_names(names)}"
        for names, total, difference in (
            (missing, len(model_weights), "weights are missing"),
            (unexpected, len(file_weights), "weights of the file are unknown"),
            (reshaped, len(model_weights), "weights have another shape"),
            (retyped, len(model_weights), "weights have numbers of another type"),
        )
        if names
    ]
    return "; ".join(parts) + "." if parts else None


LARGEST = torch.finfo(torch.float64).max
FINITE, FROM_0 = (-LARGEST, LARGEST), (0.0, LARGEST)
"""Bounds of a buffer for `require_state`: FINITE allows every finite number, FROM_0 those of at least 0."""


def require_state(module: nn.Module, **bounds: tuple[float, float] | tuple[Tensor, Tensor]) -> None:
    """Make `load_state_dict` refuse buffers of the module that have another shape or values out of bounds.

    Args:
        module: Module that owns the buffers.
        bounds: Least and largest value of each buffer, by its name; a tensor bounds each element separately. NaN is
            out of bounds.
    """
    module.register_load_state_dict_pre_hook(partial(_require_state, bounds))


def _require_state(
    bounds: Mapping[str, tuple[float, float] | tuple[Tensor, Tensor]],
    module: nn.Module,
    state: Mapping[str, Any],
    prefix: str,
    *_: Any,
) -> None:
    for name, (least, most) in bounds.items():
        buffer, stored = module.get_buffer(name), state.get(prefix + name)
        if stored is None:
            continue  # torch raises the error for a missing buffer
        mismatch = describe_mismatch({name: buffer}, {name: stored})
        if mismatch is None and not ((stored.double() >= least) & (stored.double() <= most)).all():
            mismatch = (
                f"{name} has numbers that are not between {_bounds_text(least)} and {_bounds_text(most)}."
            )
        if mismatch:
            raise CheckpointError(
                f"The state of {type(module).__name__} is damaged: {mismatch} Load another checkpoint, or train the "
                "model again."
            )


def _bounds_text(bound: float | Tensor) -> str:
    numbers = bound.tolist() if isinstance(bound, Tensor) else [bound]
    return _list_names([f"{number:.4g}" for number in numbers])


def _same_kind(model_tensor: Tensor, file_tensor: Tensor) -> bool:
    return model_tensor.dtype == file_tensor.dtype or (
        model_tensor.is_floating_point() and file_tensor.is_floating_point()
    )


def _kind(value: Any) -> str:
    return str(value.dtype).removeprefix("torch.") if isinstance(value, Tensor) else type(value).__name__


def _shape(tensor: Shaped[Tensor, "..."]) -> str:
    return "×".join(map(str, tensor.shape)) or "scalar"


def _list_names(names: list[str]) -> str:
    rest = len(names) - LISTED
    return shorten(", ".join(names[:LISTED]), 400) + (f" and {rest} more" if rest > 0 else "")
