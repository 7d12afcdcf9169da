"""Reads NumPy's files, which may be damaged: nothing is allocated that a file does not bring, nothing is unpickled."""

import io
import math
import zipfile
from collections.abc import Collection

import numpy as np
from numpy.lib import format as layout
from numpy.typing import NDArray

from framework.errors import shown
from framework.storage.reading import room

MAGIC = b"\x93NUMPY"
HEADERS = {(1, 0): layout.read_array_header_1_0, (2, 0): layout.read_array_header_2_0}
KINDS = "biufcUS"


def array(content: bytes) -> NDArray:
    """The numbers or texts of an .npy file.

    Raises:
        ValueError: it is none, or damaged; objects and records are refused.
    """
    stream = io.BytesIO(content)
    version = layout.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"version {version} of the format; wanted an array of numbers")
    shape, by_columns, kind = HEADERS[version](stream)
    if kind.kind not in KINDS or not kind.itemsize or any(side < 0 for side in shape):
        raise ValueError(
            f"an array of {shown(kind)} {shown(shape)}; wanted plain numbers or text, no objects"
        )
    count, start = math.prod(shape), stream.tell()  # whole numbers of Python: nothing overflows
    if count * kind.itemsize > len(content) - start:
        raise ValueError(
            f"an array of {kind} {shape} takes {count * kind.itemsize} bytes, but {len(content) - start} follow"
        )
    if not count:
        return np.empty(shape, kind)
    order = "F" if by_columns else "C"
    return np.frombuffer(content, kind, count, start).reshape(shape, order=order).copy(order)


def real(values: object, what: str) -> NDArray:
    """An array as float64, of complex numbers too if none has an imaginary part.

    Raises:
        ValueError: some have; what a cast would drop without a word.
    """
    found = np.asarray(values)
    if found.dtype.kind == "c":
        if np.imag(found).any():
            raise ValueError(
                f"{what} holds complex numbers, of which the imaginary part would be lost; wanted real ones. Save "
                "their magnitudes, numpy.abs"
            )
        found = np.real(found)
    return found.astype(np.float64)


def archive(content: bytes, names: Collection[str] | None = None) -> dict[str, NDArray]:
    """Those of the arrays of an .npz file that have one of these names, or all.

    Raises:
        ValueError: it unfolds to far more than it is, or an array as above.
        Exception: what `zipfile` raises on damage.
    """
    if content.startswith(MAGIC):
        raise ValueError("it is a single array; name it .npy")
    with zipfile.ZipFile(io.BytesIO(content)) as packed:
        parts = {part.filename.removesuffix(".npy"): part for part in packed.infolist()}
        chosen = {name: part for name, part in parts.items() if names is None or name in names}
        size = sum(part.file_size for part in chosen.values())
        if size > room(len(content)):
            raise ValueError(f"its {len(content)} bytes unfold to {size}")
        found = {}
        for name, part in chosen.items():
            if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{shown(name)} is compressed by method {part.compress_type}")
            with packed.open(part) as stream:
                # so many bytes: asked for all, zipfile would first unfold whatever there is
                content = stream.read(part.file_size)
            try:
                found[name] = array(content)
            except ValueError as error:
                raise ValueError(f"{shown(name)} cannot be read as plain numbers: {error}") from error
        return found
