"""Weights trained elsewhere: fills a network from a local file of named tensors, or says what differs."""

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

from framework.errors import CheckpointError, ConfigError, shown
from framework.storage.plain_tensors import load
from framework.storage.plain_values import Foreign
from framework.storage.reading import opened, room

_log = logging.getLogger(__name__)

LISTED = 5
"""Names of weights that a message lists before it counts the rest."""
NUMBERS = (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32)
"""What weights may be made of; complex numbers would lose half of theirs without a word."""


def fill_from_file(network: nn.Module, file: str, ignored: tuple[str, ...], within: str = "") -> None:
    """Copy the weights of `file` into `network`, name by name.

    Args:
        network: whose `state_dict` names the weights.
        file: what `read_weights` reads.
        ignored: beginnings of names the network has no use for, such as the classifier's; they may be absent.
        within: what the file's names begin with beside the network's, all or none of them: "features." say.

    Raises:
        ConfigError: there is no such file.
        CheckpointError: it cannot be read, or its names or shapes are not the network's.
    """
    found = read_weights(file)
    kept = {name: tensor for name, tensor in found.items() if not name.startswith(ignored)}
    if len(kept) < len(found):
        names = ", ".join(sorted(found.keys() - kept.keys()))
        _log.info("%s: ignored %s, not used here.", file, names)
    kept = {name.removeprefix(within): tensor for name, tensor in kept.items()}
    wanted = network.state_dict()
    # Batch norm counts its batches since torch 0.4.1 only; older files lack the count, and nothing reads it.
    counters = {name: tensor for name, tensor in wanted.items() if name.endswith(".num_batches_tracked")}
    kept = counters | kept
    mismatch = describe_mismatch(wanted, kept)
    if mismatch:
        raise CheckpointError(
            f"{file} does not fit {type(network).__name__}: {mismatch} Give a file with its names and shapes."
        )
    network.load_state_dict(kept)


def read_weights(file: str) -> dict[str, Shaped[Tensor, "..."]]:
    """Named tensors, on the CPU, from a `.safetensors` file or from what `torch.save` wrote (`.pth`, `.pt`).

    The tensors of a torch file may lie under the key "state_dict" or "model", and their names may begin with
    "module.", as training scripts write them. Damage is found by the checksums of torch's format;
    `.safetensors` and files older than torch 1.6 have none, so there only damage to the structure shows.

    Raises:
        ConfigError: there is no such file.
        CheckpointError: it is damaged, holds more than plain values, or no named tensors.
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
                # nor does it read a part marked as a folder (attribute 0x10): its tensor stays uninitialised
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
    except Exception as error:  # on damaged bytes zipfile and torch raise a dozen kinds, AssertionError too
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
    return shown((str(error).splitlines() or [type(error).__name__])[0].rstrip("."))


def describe_mismatch(
    wanted: Mapping[str, Shaped[Tensor, "..."]], found: Mapping[str, Any], any_shape: tuple[str, ...] = ()
) -> str | None:
    """One sentence on how the weights of a file differ from those a model wants, or None where they fit.

    Floating-point numbers may be of any width: they are cast when they are copied. Nothing else is: a complex number
    would lose its imaginary part, and an integer its upper half, without an error.

    Args:
        any_shape: beginnings of names whose weights may be of any shape, or lacking.
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
"""What the numbers of a buffer may be: least and most."""


def require_state(module: nn.Module, **bounds: tuple[float, float] | tuple[Tensor, Tensor]) -> None:
    """Let `load_state_dict` refuse buffers of the module that are not what was fitted: of another shape, out of bounds.

    Args:
        bounds: the least and the most that a buffer's numbers may be, all or each, by its name; NaN is neither.
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
    return shown(", ".join(names[:LISTED]), 400) + (f" and {rest} more" if rest > 0 else "")
