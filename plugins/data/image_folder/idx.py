"""Reading of idx files, in which MNIST and similar data sets are distributed.

The format is described by LeCun, Cortes & Burges, The MNIST database of handwritten digits
(http://yann.lecun.com/exdb/mnist): two zero bytes, a byte for the type (8: unsigned byte), a byte for the number of
dimensions, each dimension as a big-endian integer of four bytes, and the values.
"""

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from framework.errors import DataError
from framework.storage.limits import BYTES_PER_IMAGE, FEW_IMAGES
from framework.storage.reading import inflate, most_decompressed, read_bytes, translate_errors

NAME = re.compile(r"(?P<start>.*)(images(?P<sign>[-.])idx3|labels(?P<other>[-.])idx1)-ubyte(\.gz)?")
"""Pattern of the names of files of images and of labels."""
UNSIGNED_BYTE = 8
GZIP = b"\x1f\x8b"


class Pair(NamedTuple):
    """A file of images and the file of their labels.

    Attributes:
        name: Beginning of the two names, such as "t10k-".
        images: File of the images.
        labels: File of the labels.
    """

    name: str
    images: Path
    labels: Path


def find_pairs(root: Path) -> list[Pair]:
    """Return the pairs of a file of images and a file of labels (idx format) in a folder, sorted by name.

    If a file is there twice, packed by gzip and unpacked, the unpacked one is used.

    Raises:
        DataError: A file of images has no file of labels, or the reverse.
    """
    files = {path.name: path for path in sorted(root.iterdir())}
    pairs: dict[str, Pair] = {}
    for name in files:
        match = NAME.fullmatch(name)
        if match is None or match["start"] in pairs:
            continue
        chosen: dict[str, Path] = {}
        for part, dimensions in (("images", 3), ("labels", 1)):
            wanted = f"{match['start']}{part}{match['sign'] or match['other']}idx{dimensions}-ubyte"
            path = files.get(wanted) or files.get(f"{wanted}.gz")
            if path is None:
                raise DataError(
                    f"{root} holds {name}, but neither {wanted} nor {wanted}.gz, which belongs to it. Add this file."
                )
            chosen[part] = path
        pairs[match["start"]] = Pair(match["start"], chosen["images"], chosen["labels"])
    return list(pairs.values())


def read_pair(pair: Pair) -> tuple[UInt8[np.ndarray, "images height width"], UInt8[np.ndarray, "images"]]:
    """Return the images and the labels of a pair of files.

    Raises:
        DataError: A file is damaged, or the numbers of images and of labels differ.
    """
    images, labels = read_idx(pair.images, 3), read_idx(pair.labels, 1)
    if len(images) != len(labels) or not images.size:
        raise DataError(
            f"{pair.images} holds {len(images)} images of {images.shape[1]} × {images.shape[2]} pixels, and "
            f"{pair.labels} {len(labels)} labels, but a label for each image, and at least one image, is required. "
            "Copy both files again from their source."
        )
    return images, labels


def read_idx(file: Path, dimensions: int) -> UInt8[np.ndarray, "..."]:
    """Return the array in an idx file of unsigned bytes, which may be packed by gzip.

    Raises:
        DataError: The file is missing or damaged, or holds another type or number of dimensions.
    """
    with translate_errors(file, "an idx file of bytes"):
        content = read_bytes(file)
        if content.startswith(GZIP):
            content = inflate(content, most_decompressed(len(content)))
        start = 4 + 4 * dimensions
        if content[:4] != bytes([0, 0, UNSIGNED_BYTE, dimensions]) or len(content) < start:
            raise ValueError(
                f"the header is {content[:4].hex()}, but 0000{UNSIGNED_BYTE:02x}{dimensions:02x} is expected"
            )
        shape = tuple(np.frombuffer(content[4:start], ">u4").tolist())
        if math.prod(shape) != len(content) - start:
            raise ValueError(
                f"the header states {' × '.join(map(str, shape))} values, but {len(content) - start} values follow"
            )
        size = file.stat().st_size
        if dimensions == 3 and shape[0] > (most := max(FEW_IMAGES, size // BYTES_PER_IMAGE)):
            raise ValueError(
                f"the header states {shape[0]} images, but a file of {size} bytes may hold at most {most}"
            )
        return np.frombuffer(content, np.uint8, offset=start).reshape(shape)
