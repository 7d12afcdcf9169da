"""Writing and reading of checkpoint files, which are complete or absent.

A checkpoint is written to a temporary file, synced to disk and renamed, and its checksum is verified before it is read.
"""

import errno
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

from framework.errors import CheckpointError, shorten
from framework.storage.files import is_disk_full, remove_leftovers, replacing
from framework.storage.plain_tensors import load, require_admitted_pickles, require_dense
from framework.storage.plain_values import Foreign
from framework.storage.reading import open_regular

# A checkpoint is the output of `torch.save` (which `torch.load` can still read), followed by this mark and the
# SHA-256 of everything before the mark. The checksums inside torch's zip do not suffice: they leave out the zip
# directory, where a flipped bit can make torch 2.13 return uninitialised memory for a tensor.
MARK = b"\nsha256 of above:"
TRAILER = len(MARK) + hashlib.sha256().digest_size


def write(checkpoint: Mapping[str, Any], path: Path) -> None:
    """Write nested dicts, lists, tuples, plain values and tensors to a file, completely or not at all.

    This is true even if the process is killed or the power fails, because the bytes are on disk before the file gets
    its name.

    Raises:
        CheckpointError: The disk has too little free space, or the contents are not plain values. Nothing was written,
            and an older file at `path` is unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    needed = _bytes_needed(checkpoint)
    if shutil.disk_usage(path.parent).free < needed:
        raise _no_room(path, needed)
    try:
        with replacing(path) as partial:
            with partial.open("wb") as file:
                hashing_file = _HashingFile(file)
                torch.save(checkpoint, cast(BinaryIO, hashing_file))
                file.write(MARK + hashing_file.digest.digest())
            _require_plain(partial, path, checkpoint)
    except (OSError, RuntimeError) as error:
        # after a failed write, torch raises a second error when it closes the file
        fault = error if isinstance(error, OSError) else error.__context__
        if isinstance(fault, OSError) and is_disk_full(fault):
            raise _no_room(path, needed, fault) from fault
        raise


def read(path: Path) -> dict[str, Any]:
    """Return the contents of a checkpoint, with tensors on the CPU, after its bytes passed the checksum.

    Raises:
        CheckpointError: The file contains anything but plain values; or it is missing, empty, cut short or damaged,
            and the message then names the newest undamaged checkpoint in the same folder, if there is one.
    """
    if not path.is_file():
        raise CheckpointError(f"There is no checkpoint {path}. {_remedy(path)}")
    with open_regular(path) as file:
        fault = _fault(file)
        if fault is not None:
            raise CheckpointError(f"The checkpoint {path} cannot be used: {fault}. {_remedy(path)}")
        file.seek(0)
        try:
            _require_unfolded(file)
            content = load(file)
            if not isinstance(content, dict):
                raise ValueError(f"the file contains a {type(content).__name__}, but a dict is required")
            return content
        except (Foreign, UnpicklingError) as error:
            foreign_value = (
                shorten(error) if isinstance(error, Foreign) else "the pickle builds arbitrary objects"
            )
            raise CheckpointError(
                f"The checkpoint {path} contains more than dicts, lists, numbers, strings and dense tensors: "
                f"{foreign_value}. Other values could run code or exhaust the memory. This framework did not write "
                "the file. Do not use the file."
            ) from None
        except (
            Exception
        ) as error:  # for wrong contents with a correct checksum, torch raises errors of many classes
            raise CheckpointError(
                f"The checkpoint {path} cannot be used: {shorten(error)}. {_remedy(path)}"
            ) from error


def _require_unfolded(file: BinaryIO) -> None:
    """Refuse a checkpoint with compressed parts, which torch never writes and which may decompress to any size."""
    with zipfile.ZipFile(file) as archive:
        parts = archive.infolist()
        size = os.fstat(file.fileno()).st_size
        if any(part.compress_type for part in parts) or sum(part.file_size for part in parts) > size:
            raise ValueError("the parts of the zip archive decompress to more bytes than the file has")


def verify(path: Path) -> str | None:
    """Return a clause that says what is wrong with a checkpoint file, or None if its checksum is correct.

    The file is read once, and nothing is unpickled.
    """
    with path.open("rb") as file:
        return _fault(file)


def latest_good(folder: Path, names: Collection[str] | None = None) -> Path | None:
    """Return the most recently written checkpoint of a folder that `verify` finds correct; None if there is none.

    Args:
        folder: Folder of the checkpoints.
        names: File names to consider, or None for all.
    """
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
        return "the file is empty"
    file.seek(max(0, size - TRAILER))
    mark, stored_digest = file.read(len(MARK)), file.read()
    if mark != MARK:
        return "the file is cut short, or it is not a checkpoint of this framework"
    file.seek(0)
    digest = hashlib.sha256()
    rest = size - TRAILER
    while rest > 0 and (data := file.read(min(rest, 1 << 20))):
        digest.update(data)
        rest -= len(data)
    return (
        None
        if digest.digest() == stored_digest
        else "the file is damaged, since its contents fail their checksum"
    )


def _remedy(path: Path) -> str:
    newest = latest_good(path.parent)
    return (
        f"Use {newest}, the newest undamaged checkpoint in the same folder."
        if newest
        else "The folder of this checkpoint contains no undamaged checkpoint. Train the model again."
    )


class _HashingFile:
    """Output file for `torch.save` that also computes the checksum of the bytes written to it."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.digest = hashlib.sha256()

    def write(self, data: bytes | memoryview) -> int:
        """Write bytes and add them to the checksum."""
        self.digest.update(data)
        return self.file.write(data)

    def flush(self) -> None:
        """Flush the file."""
        self.file.flush()


def _require_plain(partial: Path, path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Refuse a checkpoint, already written to `partial`, if `read` would refuse to return it."""
    try:
        with partial.open("rb") as file:
            require_admitted_pickles(file)
        require_dense(checkpoint, partial.stat().st_size)
    except ValueError as error:
        raise CheckpointError(
            f"The checkpoint {path} was not written: {shorten(error)}. Only dicts, lists, tuples, numbers, strings "
            "and dense tensors can be read again. Convert other values in `state_dict`."
        ) from None


def _no_room(path: Path, needed: int, fault: OSError | None = None) -> CheckpointError:
    free = shutil.disk_usage(path.parent).free
    if fault is None or fault.errno == errno.ENOSPC:
        reason, remedy = f"the disk has only {free / 1e6:.3g} MB free", "Free some space"
    else:  # the free space of the disk is not the reason
        reason = f"a limit of the system is smaller ({fault.strerror})"
        remedy = "Raise the limit (ulimit -f) or the quota, or free some space,"
    return CheckpointError(
        f"The checkpoint {path} needs {needed / 1e6:.3g} MB, but {reason}. The checkpoint was not written; earlier "
        f"checkpoints are unchanged. {remedy} and resume the run."
    )


def _bytes_needed(checkpoint: object) -> int:
    """Return an upper bound of the file's size in bytes; storages and texts that occur several times count once."""
    needed = 8192
    counted: set[int] = set()
    stack: list[Any] = [checkpoint]
    while stack:
        item = stack.pop()
        needed += 10
        if not isinstance(item, Tensor | Mapping | list | tuple | set | str | bytes):
            continue
        if isinstance(item, Tensor) and item.layout is not torch.strided:
            continue  # the size of such a tensor is unknown; `write` handles a disk that fills up
        identity = item.untyped_storage().data_ptr() if isinstance(item, Tensor) else id(item)
        if identity in counted:
            needed += 128
            continue
        counted.add(identity)
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
