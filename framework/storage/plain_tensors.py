"""Reader for files of `torch.save` that admits plain values and dense tensors only.

`torch.load(weights_only=True)` runs no code. It does, however, build storages of any size, tensors that repeat one
stored number millions of times, and sparse, nested and quantised tensors, whose internal arrays it does not check. The
pickle is therefore inspected before torch reads it, and the tensors are inspected afterwards.
"""

import math
import os
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO

import torch
from torch import Tensor, nn

from framework.errors import shorten
from framework.storage.plain_values import Foreign, instructions, require_plain_pickle

TENSORS = ("_rebuild_tensor", "_rebuild_tensor_v2", "_rebuild_tensor_v3", "_rebuild_parameter")
NUMBERS = {
    "uint8": "Byte",
    "int8": "Char",
    "int16": "Short",
    "int32": "Int",
    "int64": "Long",
    "float16": "Half",
    "bfloat16": "BFloat16",
    "float32": "Float",
    "float64": "Double",
    "bool": "Bool",
    "complex64": "ComplexFloat",
    "complex128": "ComplexDouble",
    "uint16": "",
    "uint32": "",
    "uint64": "",
}
"""Data types that a tensor may have, with the prefix of their storage class; "" if there is no such class."""
CALLED = frozenset(
    {
        "collections OrderedDict",
        "collections Counter",  # milestones of a learning-rate schedule
        "builtins set",
        "builtins complex",
        "_codecs encode",  # bytes, as protocol 2 stores them
        "torch Size",
        "torch device",
        "torch.nn.parameter Parameter",  # files of torch before 0.4
        *(f"torch._utils {name}" for name in TENSORS),
    }
)
NAMED = frozenset(
    {
        "torch.storage UntypedStorage",
        *(f"torch {name}" for name in NUMBERS),
        *(f"torch {name}Storage" for name in NUMBERS.values() if name),
    }
)
"""Globals that a pickle of plain values and dense tensors names without calling them.

Each is written as its module and its name in Python 3, with a blank between them. `CALLED` contains the globals that
such a pickle calls.
"""
TYPES = frozenset(getattr(torch, name) for name in NUMBERS)
MOST_EXPANDED = 1000
"""Largest number of elements of a tensor that has more elements than its storage, as an expanded tensor has."""
MOST_SHARED = 1000
"""Largest ratio of the bytes of all tensors to the bytes of the file; above 1, because tensors may share storage."""
PICKLES_BEFORE_ZIP = 5
"""Number of pickles in a file of torch before 1.6: magic number, version, system, values, and names of the storages."""
LENGTH_OF_MARK = 20


def load(file: BinaryIO) -> Any:
    """Return the object that `torch.save` wrote to a file, with its tensors on the CPU.

    Args:
        file: File that `framework.storage.reading.open_regular` returned.

    Raises:
        Foreign: The file contains something other than plain values and dense tensors.
        Exception: The file is damaged; torch, pickle and zipfile raise errors of many classes.
    """
    size = os.fstat(file.fileno()).st_size
    require_admitted_pickles(file)
    file.seek(0)
    content = torch.load(file, weights_only=True, map_location="cpu")
    require_dense(content, size)
    return content


def require_admitted_pickles(file: BinaryIO) -> None:
    """Inspect the pickles of a file of `torch.save` without building any object; raises the errors of `load`."""
    for pickled in _pickles(file):
        require_plain_pickle(pickled, CALLED, NAMED)


def _pickles(file: BinaryIO) -> Iterator[bytes]:
    """Yield the pickles of a file from which torch builds objects.

    Raises:
        ValueError: The file is a zip archive in which Python and torch find different parts.
    """
    file.seek(0)
    if file.read(4) != b"PK\x03\x04":
        yield from _pickles_before_zip(file)
        return
    file.seek(0)
    reader = _reader(file)
    names = reader.get_all_records()
    records = {name: (reader.get_record_header_offset(name), _record_size(reader, name)) for name in names}
    file.seek(0)
    with zipfile.ZipFile(file) as archive:
        parts = {
            part.filename.partition("/")[2]: (part.header_offset, part.file_size)
            for part in archive.infolist()
        }
        if parts != records or len(archive.infolist()) != len(names) or "data.pkl" not in records:
            raise ValueError(
                "Python and torch find different parts in the zip archive, or the archive lacks the part data.pkl"
            )
    yield reader.get_record("data.pkl")


def _reader(file: BinaryIO) -> Any:
    """Return the reader that `torch.load` uses."""
    return torch._C.PyTorchFileReader(file)


def _record_size(reader: Any, name: str) -> int:
    """Return the size of a record in bytes as torch sees it; torch 2.11 must read the record to know it."""
    if hasattr(reader, "get_record_size"):
        return reader.get_record_size(name)
    return len(reader.get_record(name))


def _pickles_before_zip(file: BinaryIO) -> Iterator[bytes]:
    file.seek(0)
    for number in range(PICKLES_BEFORE_ZIP):
        start = file.tell()
        for _, _, place in instructions(file):
            if number == 0 and (place or 0) > LENGTH_OF_MARK:
                raise ValueError("the file does not begin like a file that torch.save writes")
        end = file.tell()
        file.seek(start)
        yield file.read(end - start)


def require_dense(content: Any, size: int | float = math.inf) -> None:
    """Check that every tensor in dictionaries, lists, tuples and sets is dense.

    Args:
        content: Values read from a file, or to be written to one.
        size: Bytes of the file.

    Raises:
        Foreign: A tensor is not dense, or its data type or class is not one of those that this module reads.
        ValueError: A tensor has far more elements than its storage, or all tensors have far more bytes than the file.
    """
    visited: set[int] = set()
    bytes_left = MOST_SHARED * size
    stack: list[tuple[str, Any]] = [("", content)]
    while stack:
        name, item = stack.pop()
        if isinstance(item, Tensor):
            bytes_left -= _require_dense(item, name or "a tensor")
            if bytes_left < 0:
                raise ValueError("the tensors share storage, and have far more bytes in all than the file")
        elif isinstance(item, torch.UntypedStorage | torch.TypedStorage):
            raise Foreign("the file contains the storage of a tensor without the tensor")
        elif isinstance(item, dict | list | tuple | set) and id(item) not in visited:
            visited.add(id(item))
            inner = item.items() if isinstance(item, dict) else enumerate(item)
            stack += [(str(key) if isinstance(key, str) else name, value) for key, value in inner]


def _require_dense(tensor: Tensor, name: str) -> int:
    """Check one tensor, as `require_dense` does, and return the bytes of its elements."""
    if type(tensor) not in (Tensor, nn.Parameter) or tensor.layout != torch.strided:
        raise Foreign(
            f"{shorten(name)} is a {type(tensor).__name__} of layout {tensor.layout}, but only dense tensors are "
            "allowed"
        )
    if tensor.dtype not in TYPES or tensor.is_nested or tensor.is_conj() or tensor.is_neg():
        raise Foreign(
            f"{shorten(name)} is a tensor of type {tensor.dtype}, but only arrays of plain numbers are allowed"
        )
    size, stored = tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes()
    if size > stored and tensor.numel() > MOST_EXPANDED:
        raise ValueError(
            f"{shorten(name)} has {tensor.numel()} numbers, but only {stored // tensor.element_size()} of them are "
            "stored. Store every number (.contiguous())"
        )
    return size
