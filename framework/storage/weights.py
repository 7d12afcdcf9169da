"""Loading of pretrained weights from a local file of named tensors, with a message on what does not fit."""

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
from framework.storage.reading import opened, room

_log = logging.getLogger(__name__)

LISTED = 5
"""Number of names of weights that a message lists before it counts the rest."""
NUMBERS = (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32)
"""Data types that weights may have; complex numbers would lose their imaginary parts silently."""


def fill_from_file(network: nn.Module, file: str, ignored: tuple[str, ...], within: str = "") -> None:
    """Copy the weights of `file` into `network`, name by name.

    Args:
        network: Network whose `state_dict` names the weights.
        file: Path of a file that `read_weights` reads.
        ignored: Prefixes of names that the network does not use, such as the classifier's; they may be absent.
        within: Prefix of all names in the file (or of none) that the network's names lack, such as "features.".

    Raises:
        ConfigError: There is no such file.
        CheckpointError: The file cannot be read, or its names or shapes differ from the network's.
    """
    found = read_weights(file)
    kept = {name: tensor for name, tensor in found.items() if not name.startswith(ignored)}
    if len(kept) < len(found):
        names = ", ".join(sorted(found.keys() - kept.keys()))
        _log.info("%s: ignored %s, not used here.", file, names)
    kept = {name.removeprefix(within): tensor for name, tensor in kept.items()}
    wanted = network.state_dict()
    # Batch norm counts its batches since torch 0.4.1; older files lack the count, which nothing reads.
    counters = {name: tensor for name, tensor in wanted.items() if name.endswith(".num_batches_tracked")}
    kept = counters | kept
    mismatch = describe_mismatch(wanted, kept)
    if mismatch:
        raise CheckpointError(
            f"{file} does not fit {type(network).__name__}: {mismatch} Give a file with its names and shapes."
        )
    network.load_state_dict(kept)


def read_weights(file: str) -> dict[str, Shaped[Tensor, "..."]]:
    """Return the named tensors of a `.safetensors` file or a file of `torch.save` (`.pth`, `.pt`), on the CPU.

    The tensors of a torch file may lie under the key "state_dict" or "model", and their names may begin with
    "module.", as training scripts write them. Damage is found by the checksums of torch's format. Files of
    `.safetensors` and files older than torch 1.6 have no checksums, so only damage to their structure is found.

    Raises:
        ConfigError: There is no such file.
        CheckpointError: The file is damaged, holds more than plain values, or has no named tensors.
    """
    path = Path(file).expanduser()
    if not path.is_file():
        raise ConfigError(
            f"There is no weight file {path}. Nothing is downloaded: fetch the weights yourself and give "
            "their path."
        )
    content = _safetensors(path) if path.suffix == ".safetensors" else _torch(path)
    for key in ("state_dict", "model"):
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if not isinstance(content, Mapping) or not content or not all(map(torch.is_tensor, content.values())):
        raise CheckpointError(
            f"{path} holds no named tensors; wanted what `torch.save(network.state_dict(), ...)` writes."
        )
    return {str(name).removeprefix("module."): tensor for name, tensor in content.items()}


def _torch(path: Path) -> Any:
    try:
        # torch does not check the checksums in its own zip: a flipped bit would load as another number
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                # nor does torch read a part marked as a folder (attribute 0x10): that tensor stays uninitialised
                folders = [part.filename for part in archive.infolist() if part.external_attr & 0x10]
                size = sum(part.file_size for part in archive.infolist())
                if size > room(path.stat().st_size):
                    raise ValueError(f"its parts unfold to {size} bytes")
                failed = archive.testzip() or next(iter(folders), None)
            if failed:
                raise ValueError(f"its part {failed} fails its checksum")
        with opened(path) as file:
            return load(file)
    except (Foreign, UnpicklingError) as error:
        raise CheckpointError(
            f"{path} is no file of plain tensors ({_first_line(error)}). Reading anything else could run "
            "code: save it again where it comes from, with `torch.save(network.state_dict(), ...)`."
        ) from None
    except Exception as error:  # for damaged bytes zipfile and torch raise a dozen kinds, even AssertionError
        raise _damaged(path, _first_line(error)) from None


def _safetensors(path: Path) -> dict[str, Tensor]:
    try:
        found = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise _damaged(path, _first_line(error)) from None
    for name, tensor in found.items():
        if tensor.dtype not in NUMBERS:
            raise _damaged(
                path, f"{name} has numbers of type {tensor.dtype}, wanted {', '.join(map(str, NUMBERS))}"
            )
    return found


def _damaged(path: Path, why: str) -> CheckpointError:
    return CheckpointError(f"The weight file {path} is damaged: {why}. Fetch it again.")


def _first_line(error: Exception) -> str:
    return shorten((str(error).splitlines() or [type(error).__name__])[0].rstrip("."))


def describe_mismatch(
    wanted: Mapping[str, Shaped[Tensor, "..."]], found: Mapping[str, Any], any_shape: tuple[str, ...] = ()
) -> str | None:
    """Return one sentence on how the weights of a file differ from those of a model, or None where they fit.

    Floating-point numbers may have any width, because they are cast when they are copied. Other types must agree: a
    complex number would lose its imaginary part, and an integer its upper half, without an error.

    Args:
        wanted: Weights of the model, by name.
        found: Weights of the file, by name.
        any_shape: Prefixes of names whose weights may have any shape or be absent.
    """
    names = {name for name in (*wanted, *found) if not name.startswith(any_shape)}
    missing = [name for name in wanted if name in names and name not in found]
    unexpected = [name for name in found if name in names and name not in wanted]
    both = [(name, tensor, found[name]) for name, tensor in wanted.items() if name in found]
    retyped = [
        f"{name} ({_kind(given)}, wanted {_kind(tensor)})"
        for name, tensor, given in both
        if not (isinstance(given, Tensor) and _same_kind(tensor, given))
    ]
    reshaped = [
        f"{name} ({_shape(given)}, wanted {_shape(tensor)})"
        for name, tensor, given in both
        if name in names and isinstance(given, Tensor) and given.shape != tensor.shape
    ]
    parts = [
        f"{len(names)} of {total} {what}: {_some(names)}"
        for names, total, what in (
            (missing, len(wanted), "weights are missing"),
            (unexpected, len(found), "weights found are unknown"),
            (reshaped, len(wanted), "weights have another shape"),
            (retyped, len(wanted), "weights have numbers of another type"),
        )
        if names
    ]
    return "; ".join(parts) + "." if parts else None


LARGEST = torch.finfo(torch.float64).max
FINITE, FROM_0, ABOVE_0 = (-LARGEST, LARGEST), (0.0, LARGEST), (torch.finfo(torch.float64).tiny, LARGEST)
"""Bounds of the values of a buffer: least and largest."""


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
        buffer, found = module.get_buffer(name), state.get(prefix + name)
        if found is None:
            continue  # torch says what is missing
        mismatch = describe_mismatch({name: buffer}, {name: found})
        if mismatch is None and not ((found.double() >= least) & (found.double() <= most)).all():
            mismatch = f"{name} has numbers that are not between {_told(least)} and {_told(most)}."
        if mismatch:
            raise CheckpointError(
                f"The state of {type(module).__name__} is damaged: {mismatch} Load another checkpoint, or train anew."
            )


def _told(bound: float | Tensor) -> str:
    numbers = bound.tolist() if isinstance(bound, Tensor) else [bound]
    return _some([f"{number:.4g}" for number in numbers])


def _same_kind(wanted: Tensor, found: Tensor) -> bool:
    return wanted.dtype == found.dtype or (wanted.is_floating_point() and found.is_floating_point())


def _kind(found: Any) -> str:
    return str(found.dtype).removeprefix("torch.") if isinstance(found, Tensor) else type(found).__name__


def _shape(tensor: Shaped[Tensor, "..."]) -> str:
    return "×".join(map(str, tensor.shape)) or "scalar"


def _some(names: list[str]) -> str:
    rest = len(names) - LISTED
    return shorten(", ".join(names[:LISTED]), 400) + (f" and {rest} more" if rest > 0 else "")
