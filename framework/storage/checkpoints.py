"""Checkpoints that are whole or absent: written aside, synced, renamed; verified before they are read."""

import hashlib
import os
import shutil
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, BinaryIO, cast

import torch
from torch import Tensor

from framework.errors import CheckpointError, shown
from framework.storage.files import full, remove_leftovers, replacing
from framework.storage.plain_tensors import load, require_admitted_pickles, require_dense
from framework.storage.plain_values import Foreign
from framework.storage.reading import opened

# A checkpoint is what `torch.save` writes (`torch.load` reads it as ever), then this mark and the SHA-256 of
# all before it. The checksums inside torch's zip would not do: they leave out its directory, where a flipped
# bit can make torch 2.13 return uninitialised memory for a tensor.
MARK = b"\nsha256 of above:"
TRAILER = len(MARK) + hashlib.sha256().digest_size


def write(checkpoint: Mapping[str, Any], path: Path) -> None:
    """Write a tree of dicts, lists, tuples, plain values and tensors, whole or not at all.

    Holds across SIGKILL and power loss: the bytes are on disk before the name points at them.

    Raises:
        CheckpointError: the disk has no room (nothing was written), or the contents are not plain values;
            the file that was there before is untouched.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    needed = _bytes_needed(checkpoint)
    if shutil.disk_usage(path.parent).free < needed:
        raise _no_room(path, needed)
    try:
        with replacing(path) as partial:
            with partial.open("wb") as file:
                hashed = _Hashed(file)
                torch.save(checkpoint, cast(BinaryIO, hashed))
                file.write(MARK + hashed.digest.digest())
            _require_plain(partial, path, checkpoint)
    except (OSError, RuntimeError) as error:
        # torch fails once more when it closes a file that took no more
        fault = error if isinstance(error, OSError) else error.__context__
        if isinstance(fault, OSError) and full(fault):
            raise _no_room(path, needed) from fault
        raise


def read(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint, on the CPU, after all its bytes passed the checksum.

    Raises:
        CheckpointError: missing, empty, cut, damaged, or holding anything but plain values. The message names
            the newest whole checkpoint beside it, where there is one.
    """
    if not path.is_file():
        raise CheckpointError(f"There is no checkpoint {path}. {_remedy(path)}")
    with opened(path) as file:
        fault = _fault(file)
        if fault is not None:
            raise CheckpointError(f"The checkpoint {path} cannot be used: {fault}. {_remedy(path)}")
        file.seek(0)
        try:
            _require_unfolded(file)
            content = load(file)
            if not isinstance(content, dict):
                raise ValueError(f"it holds {type(content).__name__}")
            return content
        except (Foreign, UnpicklingError) as error:
            named = shown(error) if isinstance(error, Foreign) else "what pickle could make anything of"
            raise CheckpointError(
                f"The checkpoint {path} holds more than dicts, lists, numbers, strings and dense tensors, namely "
                f"{named}, which could run code or harm. This framework did not write it: do not use it."
            ) from None
        except Exception as error:  # its checksum is right and its content is not: torch raises a dozen kinds
            raise CheckpointError(
                f"The checkpoint {path} cannot be used: {shown(error)}. {_remedy(path)}"
            ) from error


def _require_unfolded(file: BinaryIO) -> None:
    """Refuse parts that are compressed: torch does not write such, and a small file could take any memory by them."""
    with zipfile.ZipFile(file) as archive:
        parts = archive.infolist()
        size = os.fstat(file.fileno()).st_size
        if any(part.compress_type for part in parts) or sum(part.file_size for part in parts) > size:
            raise ValueError("its parts unfold to more than the file")


def verify(path: Path) -> str | None:
    """What is wrong with a checkpoint file, as a clause, or None. Reads it once and unpickles nothing."""
    with path.open("rb") as file:
        return _fault(file)


def latest_good(folder: Path, names: Collection[str] | None = None) -> Path | None:
    """The most recently written checkpoint of a folder that verifies; of these `names` only, where given."""
    files = [
        path
        for path in folder.glob("*.ckpt")
        if path.is_file() and not path.is_symlink() and (names is None or path.name in names)
    ]
    files.sort(key=lambda path: (path.stat().st_mtime_ns, path.name), reverse=True)
    return next((path for path in files if verify(path) is None), None)


def _fault(file: BinaryIO) -> str | None:
    size = os.fstat(file.fileno()).st_size
    if size == 0:
        return "it is empty"
    file.seek(max(0, size - TRAILER))
    mark, wanted = file.read(len(MARK)), file.read()
    if mark != MARK:
        return "it is cut short, or not a checkpoint of this framework"
    file.seek(0)
    digest = hashlib.sha256()
    rest = size - TRAILER
    while rest > 0 and (data := file.read(min(rest, 1 << 20))):
        digest.update(data)
        rest -= len(data)
    return None if digest.digest() == wanted else "it is damaged, its contents fail their checksum"


def _remedy(path: Path) -> str:
    good = latest_good(path.parent)
    return (
        f"Use {good}, the newest whole one beside it." if good else "No whole one is beside it: train anew."
    )


class _Hashed:
    """The part of a file that `torch.save` writes to, and the checksum of what it wrote."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.digest = hashlib.sha256()

    def write(self, data: bytes | memoryview) -> int:
        self.digest.update(data)
        return self.file.write(data)

    def flush(self) -> None:
        self.file.flush()


def _require_plain(partial: Path, path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Refuse what `read` would not give back."""
    try:
        with partial.open("rb") as file:
            require_admitted_pickles(file)
        require_dense(checkpoint, partial.stat().st_size)
    except ValueError as error:
        held = f"it would hold {shown(error)}" if isinstance(error, Foreign) else shown(error)
        raise CheckpointError(
            f"The checkpoint {path} was not written: {held}, and only dicts, lists, tuples, numbers, strings and dense "
            "tensors are read. Convert these where the state is made."
        ) from None


def _no_room(path: Path, needed: int) -> CheckpointError:
    free = shutil.disk_usage(path.parent).free
    return CheckpointError(
        f"The checkpoint {path} needs {needed / 1e6:.3g} MB and its disk has {free / 1e6:.3g} MB free. "
        "It was not written; earlier ones are untouched. Free some space and resume the run."
    )


def _bytes_needed(checkpoint: object) -> int:
    """An upper estimate of the file's size: each storage and text once, and what pickle and zip add."""
    needed = 8192
    seen: set[int] = set()
    stack: list[Any] = [checkpoint]
    while stack:
        item = stack.pop()
        needed += 10
        if not isinstance(item, Tensor | Mapping | list | tuple | set | str | bytes):
            continue
        if isinstance(item, Tensor) and item.layout is not torch.strided:
            continue  # has no storage of its own to ask; a disk that fills up is met when it does
        identity = item.untyped_storage().data_ptr() if isinstance(item, Tensor) else id(item)
        if identity in seen:
            needed += 128
            continue
        seen.add(identity)
        if isinstance(item, Tensor):
            needed += item.untyped_storage().nbytes() + 512
        elif isinstance(item, Mapping):
            stack.extend([*item.keys(), *item.values()])
        elif isinstance(item, str):
            needed += len(item.encode("utf-8", "surrogatepass"))
        elif isinstance(item, bytes):
            needed += 2 * len(item) + 64  # pickled as text
        else:
            stack.extend(item)
    return needed
