"""Functions that read image files, crop squares, build data sets of the squares, and augment and blur images."""

import itertools
import math
import os
import re
import struct
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageFile, ImageOps, UnidentifiedImageError
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.storage import reading
from framework.storage.limits import (
    AT_ONCE,
    LONGEST_SIDE,
    MOST_ICON,
    MOST_PADDED,
    MOST_PIXELS,
    MOST_PIXELS_OF,
    MOST_SCANS,
)
from framework.storage.progress import track_progress

READERS = min(8, os.cpu_count() or 1)
"""Number of threads that decode images at the same time."""
FORMATS = ("AVIF", "BMP", "GIF", "ICO", "JPEG", "JPEG2000", "PCX", "PNG", "PPM", "SGI", "TGA", "TIFF", "WEBP")
"""Pillow formats that are read, because reading them only decodes pixels. EPS, for example, would start a program."""
SUFFIXES = (".avif", ".bmp", ".gif", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
"""Usual suffixes of image files; a file with another suffix is read as an image if it can be decoded."""
MOST_ENTRIES = 1000
"""Largest number of entries of a folder that are searched for a missing image."""
ORIENTATION = 0x0112
"""Number of the EXIF entry with the orientation of an image."""
BITS_PER_SAMPLE, PHOTOMETRIC = 258, 262
"""Numbers of two TIFF entries: the bits per value, and the meaning of the value 0 (0: white, 1: black)."""
TILE_SIDES = (322, 323)
"""Numbers of the TIFF entries with the width and the height of a tile, which may be larger than the image."""
JPEG_MARKER = re.compile(rb"\xff([^\x00\x01\xd0-\xd7\xff])")
"""Pattern of a marker of a JPEG file; 00, 01 and D0 to D7 belong to the compressed pixels (ITU-T T.81, Table B.1).

More bytes ff may stand before a marker. The pattern leaves them out, because it would take quadratic time for a file of
such bytes alone.
"""
MODES = {1: "L", 3: "RGB", 4: "RGBA"}
"""Pillow's modes of decoded images, by number of channels."""
READ_AT_ONCE = 2**16
"""Largest size, in bytes, of a file that is read as a whole, although its header alone may be needed."""
STRIP = 256
"""Number of pixel rows of an image that are converted at a time."""
IN_MEMORY = 2 * 2**30
"""Largest total size, in bytes, of decoded crops that are kept in memory; more crops are decoded when needed."""

Box = tuple[float, float, float, float]
"""Left, top, right and bottom in pixels, measured from the outer corner: (0, 0, width, height) is the whole image."""


@dataclass(frozen=True)
class Crop:
    """A square part of an image file, scaled to a given size.

    Attributes:
        file: path of the image.
        box: part of the image on which the square is centred; None: the whole image.
        margin: border that is added on each side of the square, divided by the box's longer side.
        side: side of the resulting square, pixels.
        channels: 3 for colour, 1 for grey.
        upright: apply the EXIF orientation, as photo viewers do.
        blur: standard deviation of the Gaussian that blurs the result, pixels of the result; 0: no blur.
    """

    file: Path
    box: Box | None
    margin: float
    side: int
    channels: int = 3
    upright: bool = False
    blur: float = 0.0

    def read(self) -> UInt8[Tensor, "channels side side"]:
        """Read the file and return the square.

        Raises:
            DataError: the file is missing, is not an image or is truncated, or the box lies outside the image.
        """
        with open_image(self.file) as raw, DECODED.reserve(raw.width * raw.height):
            image = decode(raw, self.channels, upright=self.upright)
            whole = (0.0, 0.0, float(image.width), float(image.height))
            pixels = cut_square(image, self.box or whole, self.margin, self.side)
        if pixels is None:
            raise self._outside(image.size)
        return blur(torch.from_numpy(pixels), self.blur)

    def check(self) -> None:
        """Check the file's header and the box; pixels are not decoded.

        Raises:
            DataError: the file is missing, is not an image, or the box lies outside the image.
        """
        with open_image(self.file) as image:
            if self.box is not None and clip_box(self.box, image.size) is None:
                raise self._outside(image.size)

    def _outside(self, size: tuple[int, int]) -> DataError:
        return DataError(
            f"{self.file}: the box {self.box} lies outside the image of {size[0]} x {size[1]} pixels, but left < right "
            "and top < bottom within the image are required. Correct the annotation."
        )


@contextmanager
def open_image(file: Path) -> Iterator[Image.Image]:
    """Open an image file inside a `with` block.

    Raises:
        DataError: the file is missing, is not an image, or is truncated; the message names it.
    """
    with (
        reading.translate_errors(
            file,
            "an image",
            f"{reading.RESTORE} Scale the image down if it is too large.",
            advise_missing(file),
        ),
        reading.open_regular(file) as stream,
        open_stream(_read_at_once(stream)) as image,
    ):
        yield image


def _read_at_once(stream: reading.Bounded) -> BinaryIO | BytesIO:
    """Return a small file as bytes in memory, and a larger file unchanged.

    Pillow reads a file in dozens of pieces, which is faster from memory.
    """
    small = os.fstat(stream.fileno()).st_size <= READ_AT_ONCE
    return BytesIO(stream.read()) if small else stream


def advise_missing(file: Path) -> str:
    """Return advice about an image that does not exist, for a similar path that exists; "" if none is known.

    A similar path has / in place of each backslash, or the suffix of an image after the name, or lies in a subfolder of
    the folder of `file`.
    """
    if file.exists():
        return ""
    if "\\" in file.name and Path(str(file).replace("\\", "/")).exists():
        return "expected an image. Write / instead of \\ in the path."
    with_suffix = (f"{file.name}{suffix}" for suffix in SUFFIXES)
    similar = [name for name in with_suffix if (file.parent / name).exists()]
    if not similar and file.parent.is_dir():
        with os.scandir(file.parent) as entries:
            folders = [entry.name for entry in itertools.islice(entries, MOST_ENTRIES) if entry.is_dir()]
        similar = [
            f"{folder}/{file.name}" for folder in folders if (file.parent / folder / file.name).exists()
        ]
    return f"expected an image. Did you mean {similar[0]}?" if similar else ""


@contextmanager
def open_stream(stream: BinaryIO | BytesIO) -> Iterator[Image.Image]:
    """Open the content of an image file inside a `with` block; the file's suffix does not matter.

    If the file holds several images (frames, pages), the first one is opened.

    Raises:
        ValueError: the image has more pixels than `MOST_PIXELS_OF` and `LONGEST_SIDE` allow, tiles of so many pixels,
            or more than `MOST_SCANS` scans; or the file is an icon with an image of more than `MOST_ICON` pixels.
        Exception: the content is not an image, or damaged.
    """
    _require_bounded_icon(stream)
    try:
        opened = Image.open(stream, formats=FORMATS)
    except UnidentifiedImageError:
        raise ValueError(f"the content of the file is in none of the formats {', '.join(FORMATS)}") from None
    with opened as image:
        most = MOST_PIXELS_OF.get(image.format or "", MOST_PIXELS)
        if image.width * image.height > most or max(image.size) > LONGEST_SIDE:
            raise ValueError(
                f"the image has {image.width} x {image.height} pixels; at most {most} pixels, and {LONGEST_SIDE} "
                "along a side, are allowed"
            )
        _require_bounded_decoding(image, stream, most)
        yield image


def _require_bounded_icon(stream: BinaryIO | BytesIO) -> None:
    """Refuse an icon (ICO) that holds an image of many pixels, which Pillow decodes as soon as it opens the file.

    The directory of the file states at most 256 pixels along a side, but the image itself may be larger.

    Raises:
        ValueError: an image has more than `MOST_ICON` pixels.
    """
    start = stream.tell()
    head = stream.read(6)
    if head[:4] == b"\0\0\1\0":
        directory = stream.read(16 * int.from_bytes(head[4:], "little"))
        for entry in range(0, len(directory) - 15, 16):
            stream.seek(start + int.from_bytes(directory[entry + 12 : entry + 16], "little"))
            content = stream.read(24)
            of_png = content.startswith(b"\x89PNG")
            sides = struct.unpack(">II", content[16:24]) if of_png and len(content) == 24 else ()
            if not of_png and len(content) >= 12:  # a bitmap; its height counts the rows of its mask too
                sides = struct.unpack("<ii", content[4:12])
            if abs(math.prod(sides)) > MOST_ICON:
                raise ValueError(
                    f"the icon holds an image of {' x '.join(map(str, sides))} pixels; at most {MOST_ICON} are allowed"
                )
    stream.seek(start)


def _require_bounded_decoding(image: Image.Image, stream: BinaryIO | BytesIO, most: int) -> None:
    """Refuse an image that takes far more memory or time to decode than its number of pixels explains.

    Raises:
        ValueError: a TIFF image has tiles of more than `most` pixels, or a JPEG image more than `MOST_SCANS` scans.
    """
    tags = getattr(image, "tag_v2", {})
    sides = [tags.get(number, 1) for number in TILE_SIDES]
    if math.prod(sides) > most:
        raise ValueError(f"the image has tiles of {sides[0]} x {sides[1]} pixels; at most {most} are allowed")
    if image.format in ("JPEG", "MPO"):
        position = stream.tell()
        stream.seek(0)
        scans = _count_scans(stream.read())
        stream.seek(position)
        if scans > MOST_SCANS:
            raise ValueError(f"the image has more than {MOST_SCANS} scans, which is not allowed")


def _count_scans(content: bytes) -> int:
    """Return the number of scans of the first image in a JPEG file, at most `MOST_SCANS` + 1."""
    scans, position = 0, 2
    while scans <= MOST_SCANS and (marker := JPEG_MARKER.search(content, position)):
        code, position = marker[1], marker.end()
        if code == b"\xd9":  # end of the image; phones append a film, or another image
            break
        scans += code == b"\xda"
        position += int.from_bytes(content[position : position + 2], "big")
    return scans


class PixelLimit:
    """Limit on the number of decoded pixels in memory, over all threads together.

    A thread may exceed the limit if no other thread has decoded pixels, so that every image can be decoded.

    Args:
        most: largest number of pixels.
    """

    def __init__(self, most: int) -> None:
        self.most, self.reserved, self.changed = most, 0, threading.Condition()
        os.register_at_fork(after_in_child=self._forget)

    @contextmanager
    def reserve(self, pixels: int) -> Iterator[None]:
        """Wait until `pixels` more pixels fit within the limit, and count them during the `with` block."""
        with self.changed:
            self.changed.wait_for(lambda: not self.reserved or self.reserved + pixels <= self.most)
            self.reserved += pixels
        try:
            yield
        finally:
            with self.changed:
                self.reserved -= pixels
                self.changed.notify_all()

    def _forget(self) -> None:
        """Reset the count in a forked process, which does not have the threads that reserved pixels."""
        self.reserved, self.changed = 0, threading.Condition()


DECODED = PixelLimit(AT_ONCE)
"""Limit on the decoded pixels of this process."""


def decode(image: Image.Image, channels: int, *, upright: bool) -> Image.Image:
    """Decode an image to eight bits per channel; every reader of images calls this function.

    Args:
        image: an opened image.
        channels: 1 for grey, 3 for RGB, 4 for RGB with alpha. For 1 and 3, transparent pixels become white.
        upright: apply the EXIF orientation.

    Raises:
        DataError: the range of the stored values is unknown.
    """
    stored = _read_encoding(image)
    # exif_transpose would copy the image in any case
    rotated = upright and image.getexif().get(ORIENTATION, 1) != 1
    whole = ImageOps.exif_transpose(image) if rotated else image
    whole.load()
    mode = MODES[channels]
    if whole.mode == mode and "transparency" not in whole.info:
        return whole
    result = Image.new(mode, whole.size)
    # In strips, because whole intermediate images beside the source and the result would take four times the memory.
    for top, strip in _strips(whole, stored, channels, opaque=False):
        result.paste(strip, (0, top))
    return result


def decode_opaque(image: Image.Image) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Decode an image to RGB as `decode` does, but ignore its alpha: transparent pixels keep their colours.

    Yields:
        The index of the first row of each strip of the image, and the pixels of the strip.

    Raises:
        DataError: the range of the stored values is unknown.
    """
    for top, strip in _strips(image, _read_encoding(image), 3, opaque=True):
        yield top, np.asarray(strip)


def _strips(
    image: Image.Image, stored: "_Encoding", channels: int, *, opaque: bool
) -> Iterator[tuple[int, Image.Image]]:
    for top in range(0, image.height, STRIP):
        strip = image.crop((0, top, image.width, min(top + STRIP, image.height)))
        if stored.key is not None:
            strip.info["transparency"] = stored.key
        strip = _eight_bit(strip, stored)
        if channels != 4 and not opaque and has_alpha(strip):
            strip = Image.alpha_composite(Image.new("RGBA", strip.size, "white"), strip.convert("RGBA"))
        yield top, strip.convert(MODES[channels])


def has_alpha(image: Image.Image) -> bool:
    """Return whether an image has an alpha channel or a transparent colour."""
    return image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info


class _Encoding(NamedTuple):
    """Meaning of an image's stored pixel values; it must be read from the header before the pixels are loaded.

    Attributes:
        black: value of black in an image with more than eight bits per value.
        white: value of white in an image with more than eight bits per value.
        key: transparent colour, as a value of decoded pixels; None if no colour is transparent.
    """

    black: int
    white: int
    key: Any


def _read_encoding(image: Image.Image) -> _Encoding:
    """Read the meaning of an image's pixel values from its header.

    Raises:
        DataError: the range of the values is unknown; or a 16-bit colour is transparent, since only 8 bits are decoded.
    """
    tags = getattr(image, "tag_v2", {})  # entries of a TIFF file
    long = image.mode.startswith("I")
    if image.mode == "F" or (image.mode == "I" and tags):
        kind = "floating-point numbers" if image.mode == "F" else "integers of 32 bits or with a sign,"
        raise DataError(
            f"the pixels are {kind} of unknown range, but 8 or 16 bits are required. Scale the values to 16 bits, and "
            "save the image again."
        )
    key = image.info.get("transparency")
    if image.mode == "RGB" and isinstance(key, tuple) and max(key) > 255:
        raise DataError(
            "a 16-bit colour of the image stands for transparent pixels, which cannot be decoded. Save the image "
            "with an alpha channel."
        )
    if image.mode == "L" and isinstance(key, int) and isinstance(image, ImageFile.ImageFile) and image.tile:
        # Pillow returns the key with the bit depth of the PNG file.
        key *= {"L;2": 85, "L;4": 17}.get(str(image.tile[0].args), 1)
    most = 2 ** tags.get(BITS_PER_SAMPLE, (16,))[0] - 1 if long else 255
    return _Encoding(most, 0, key) if long and tags.get(PHOTOMETRIC) == 0 else _Encoding(0, most, key)


def _eight_bit(strip: Image.Image, stored: _Encoding) -> Image.Image:
    """Return a strip of an image with eight bits per channel, in a mode that Pillow converts to grey, RGB and RGBA."""
    if strip.mode.startswith("I"):
        numbers, most = np.asarray(strip).astype(np.int64), max(stored.black, stored.white)
        if numbers.size and not (numbers.min() >= 0 and numbers.max() <= most):
            raise DataError(
                f"the pixel values range from {numbers.min()} to {numbers.max()}, but 0 to {most} is required. Scale "
                "them, and save the image again."
            )
        grey = Image.fromarray(((255 * abs(numbers - stored.black) + most // 2) // most).astype(np.uint8))
        if stored.key is not None:
            grey.putalpha(Image.fromarray((255 * (numbers != stored.key)).astype(np.uint8)))
        return grey
    if strip.mode in ("La", "RGBa"):  # colours multiplied by alpha
        return strip.convert("LA" if strip.mode == "La" else "RGBA")
    if has_alpha(strip):
        return strip.convert("RGBA")
    return strip.convert("RGB") if strip.mode == "LAB" else strip


def cut_square(image: Image.Image, box: Box, margin: float, side: int) -> NDArray[np.uint8] | None:
    """Crop the square around a box and scale this square to `side` pixels; return None if the box is empty.

    The returned array has the shape (channels, side, side). The box is first clipped to the image. The square is
    centred at the clipped box; its side is the longer side of this box times 1 + 2 `margin`. Where the square extends
    beyond the image, border pixels are repeated. The image is low-pass filtered when it is scaled down.
    """
    inner = clip_box(box, image.size)
    if inner is None:
        return None
    left, top, right, bottom = inner
    half = (0.5 + margin) * max(right - left, bottom - top)
    x, y = (left + right) / 2, (top + bottom) / 2
    # Find the whole pixels that cover the square, then the part of them inside the image, then the square in that part.
    first_x, first_y = math.floor(x - half), math.floor(y - half)
    last_x, last_y = math.ceil(x + half), math.ceil(y + half)
    inside = (max(0, first_x), max(0, first_y), min(image.width, last_x), min(image.height, last_y))
    padded = inside != (first_x, first_y, last_x, last_y)
    if padded and (last_x - first_x) * (last_y - first_y) > MOST_PADDED:  # a long strip, for example
        step = math.ceil(max(last_x - first_x, last_y - first_y) / math.isqrt(MOST_PADDED))
        small = (left / step, top / step, right / step, bottom / step)
        return cut_square(image.reduce(step), small, margin, side)
    cut = image if inside == (0, 0, *image.size) else image.crop(inside)
    if padded:
        cut = _pad(cut, inside[0] - first_x, inside[1] - first_y, (last_x - first_x, last_y - first_y))
    start_x, start_y = max(0.0, x - half - first_x), max(0.0, y - half - first_y)
    window = (start_x, start_y, min(cut.width, start_x + 2 * half), min(cut.height, start_y + 2 * half))
    result = np.asarray(cut.resize((side, side), Image.Resampling.BILINEAR, box=window))
    return np.array(np.atleast_3d(result).transpose(2, 0, 1), order="C")


def _pad(image: Image.Image, left: int, top: int, size: tuple[int, int]) -> Image.Image:
    """Return an image of (width, height) `size` with `image` at (left, top), whose border pixels are repeated."""
    width, height = size
    right, bottom = left + image.width, top + image.height
    result = Image.new(image.mode, size)
    result.paste(image, (left, top))
    for edge, first, last in ((left, 0, left), (right - 1, right, width)):
        column = result.crop((edge, top, edge + 1, bottom))
        if last > first:
            result.paste(column.resize((last - first, image.height), Image.Resampling.NEAREST), (first, top))
    for edge, first, last in ((top, 0, top), (bottom - 1, bottom, height)):
        if last > first:
            row = result.crop((0, edge, width, edge + 1))
            result.paste(row.resize((width, last - first), Image.Resampling.NEAREST), (0, first))
    return result


def clip_box(box: Box, size: tuple[int, int]) -> Box | None:
    """Return a box clipped to an image of (width, height); None if nothing is left or the box is not finite."""
    if not all(map(math.isfinite, box)):
        return None
    width, height = map(float, size)
    left, top, right, bottom = max(0.0, box[0]), max(0.0, box[1]), min(width, box[2]), min(height, box[3])
    return (left, top, right, bottom) if left < right and top < bottom else None


class Crops(Dataset[dict[str, Tensor]]):
    """Data set that reads each crop from its file when the sample is indexed; the other fields are in memory.

    Indexing raises a DataError if the file cannot be read.

    Args:
        crops: the crops, one for each sample.
        fields: the other fields of all samples, by name; the first dimension is the sample.
    """

    def __init__(self, crops: Sequence[Crop], **fields: Tensor) -> None:
        self.crops = crops
        self.fields = Fields(**fields)

    def __len__(self) -> int:
        return len(self.crops)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return {"input": self.crops[index].read(), **self.fields[index]}


def load(
    crops: Sequence[Crop], fields: Mapping[str, Tensor], name: str, *, in_memory: bool
) -> tuple[Fields | Crops, list[DataError]]:
    """Return a data set of the readable crops, and the errors of the unreadable ones.

    The data set has "input", the `fields` of these crops, and "index". With `in_memory` every crop is decoded now.
    Otherwise only the headers of the files are read, and damage after the header is detected when a crop is indexed.
    `name` describes the images in the progress bar.
    """
    faults: dict[int, DataError] = {}
    shape = (len(crops), crops[0].channels, crops[0].side, crops[0].side) if crops and in_memory else (0,)
    pixels = torch.empty(shape, dtype=torch.uint8)

    def visit(index: int) -> None:
        try:
            if in_memory:
                pixels[index] = crops[index].read()
            else:
                crops[index].check()
        except DataError as error:
            faults[index] = error

    with ThreadPoolExecutor(READERS) as readers:
        for _ in track_progress(
            readers.map(visit, range(len(crops))), f"reading {name}", len(crops), "images"
        ):
            pass
    good = [index for index in range(len(crops)) if index not in faults]
    good_fields = {key: field[good] if faults else field for key, field in fields.items()}
    good_fields["index"] = torch.arange(len(good))
    reasons = [faults[index] for index in sorted(faults)]
    if in_memory and good:
        return Fields(input=pixels[good] if faults else pixels, **good_fields), reasons
    return Crops([crops[index] for index in good], **good_fields), reasons


def load_splits(
    crops: Mapping[str, Sequence[Crop]],
    fields: Mapping[str, Mapping[str, Tensor]],
    faults: Sequence[DataError] = (),
    *,
    skip_unreadable: bool,
    skip_setting: str = "data.skip_unreadable=true",
    generated_in: Path | None = None,
) -> tuple[dict[str, Fields | Crops], int]:
    """Return a data set of the readable crops of each split, and the number of samples that cannot be read.

    Args:
        crops: crops of each split, by the split's name.
        fields: further fields of each split, by the split's name.
        faults: errors of further samples, which have no crop because their labels could not be read.
        skip_unreadable: leave out samples that cannot be read.
        skip_setting: setting of the data set that leaves out unreadable samples, for the message.
        generated_in: the cache folder of generated images; None: the images are the user's.

    Raises:
        DataError: samples cannot be read and `skip_unreadable` is False; the message names the first ten.
    """
    every = [crop for chosen in crops.values() for crop in chosen]
    total = len(faults) + len(every)
    in_memory = not every or fit_in_memory(total, every[0].side, every[0].channels)
    loaded = {
        split: load(chosen, fields[split], f"the {split} images", in_memory=in_memory)
        for split, chosen in crops.items()
    }
    faults = [*faults, *(fault for _, bad in loaded.values() for fault in bad)]
    if faults and not skip_unreadable:
        remedy = advise_unreadable(faults, total, skip_setting)
        if generated_in is not None:
            remedy = f"Delete {generated_in}; the next run generates the data again."
        raise DataError(fault_message(faults, total, remedy))
    return {split: table for split, (table, _) in loaded.items()}, len(faults)


def angle_fields(angles: Sequence[Sequence[float]], names: Sequence[str]) -> dict[str, Tensor]:
    """Return the fields "target" and "group" for the angles of each sample, radians.

    "target" holds the angles in [-π, π), one column per name. "group" is 0 for every sample, since these data have a
    single group of results.
    """
    wrapped = [[(angle + math.pi) % (2 * math.pi) - math.pi for angle in row] for row in angles]
    return {
        "target": torch.tensor(wrapped, dtype=torch.float32).reshape(len(angles), len(names)),
        "group": torch.zeros(len(angles), dtype=torch.int64),
    }


def load_unlabelled(crops: Sequence[Crop]) -> Fields | Crops:
    """Return a data set with "input" and "index" of a user's images, in the order of `crops`.

    Raises:
        DataError: there is no image, or some cannot be read; the message names the first ten.
    """
    if not crops:
        raise DataError("No image file was given, but at least one is required.")
    in_memory = fit_in_memory(len(crops), crops[0].side, crops[0].channels)
    table, faults = load(crops, {}, "images", in_memory=in_memory)
    if faults:
        raise DataError(
            fault_message(faults, len(crops), "Leave these files out, or copy them again from their source.")
        )
    return table


def fit_in_memory(crops: int, side: int, channels: int) -> bool:
    """Return whether `crops` crops of `side` × `side` pixels take at most IN_MEMORY bytes."""
    return crops * channels * side**2 <= IN_MEMORY


def advise_unreadable(faults: Sequence[DataError], total: int, skip_setting: str) -> str:
    """Return advice about samples that cannot be read: to correct them, or to leave them out if others remain.

    Args:
        faults: errors of the samples.
        total: number of all samples.
        skip_setting: setting that leaves such samples out.
    """
    rest = f", or set {skip_setting} to leave them out" if len(faults) < total else ""
    return f"Correct these files or copy them again from their source{rest}."


def fault_message(faults: Sequence[DataError], total: int, remedy: str) -> str:
    """Return a message with the number of unreadable samples, at most ten of the reasons, and the remedy."""
    return f"{len(faults)} of {total} samples cannot be read:{list_lines(faults)}\n{remedy}"


def list_lines(items: Sequence[object]) -> str:
    """Return a text with at most ten items, each on its own line, and the number of the items that are left out."""
    lines = [str(item) for item in items[:10]]
    if len(items) > 10:
        lines.append(f"and {len(items) - 10} more")
    return "".join(f"\n  {line}" for line in lines)


def refuse_listed(wrong: Sequence[object], problem: str, remedy: str) -> None:
    """Raise an error that counts and lists the items in `wrong`; do nothing if there are none.

    Args:
        wrong: the items.
        problem: noun for the items and their fault, which follows their number in the message.
        remedy: advice, at the end of the message.

    Raises:
        DataError: `wrong` is not empty.
    """
    if wrong:
        raise DataError(f"{len(wrong)} {problem}:{list_lines(wrong)}\n{remedy}")


def vary(batch: Batch, signs: Sequence[float], jitter: float) -> Batch:
    """Augment the images of a training batch and, if `signs` is not empty, mirror half of them.

    Args:
        batch: fields of the samples, among them "input" and "target" (angles).
        signs: 1 or -1 for each angle; the angles of a mirrored image are multiplied by these.
        jitter: largest shift and change of size, as a share of the image's side (`augment`).
    """
    if not signs and not jitter:
        return batch
    target = batch["target"]
    mirrored = (torch.rand(len(target)) < 0.5) & bool(signs)
    reflected = target * torch.tensor(signs or 1.0).to(target)
    return {
        **batch,
        "input": augment(batch["input"], mirrored, jitter),
        "target": torch.where(mirrored.to(target.device)[:, None], reflected, target),
    }


def augment(
    images: Shaped[Tensor, "batch channels height width"], mirrored: Bool[Tensor, "batch"], jitter: float
) -> Float[Tensor, "batch channels height width"]:
    """Mirror, shift, scale and recolour images at random; return values in 0…1 on the images' device.

    Images for which `mirrored` is True are reflected left to right. Every image is shifted and scaled by up to `jitter`
    of its side (linear interpolation, border pixels repeated). Its brightness changes by up to `jitter`, and its
    contrast by up to twice that. Random numbers come from torch's global CPU generator.
    """
    batch, _, height, width = images.shape
    # The default type may be float64 if a float64 model trains.
    amount = (2 * torch.rand(5, batch, dtype=torch.float32) - 1) * jitter
    scale = amount[0].exp()
    sign = 1 - 2 * mirrored.to("cpu", torch.float32)
    rows = _positions(height, scale, amount[1] * height).to(images.device)
    columns = _positions(width, sign * scale, amount[2] * width).to(images.device)
    # Copying whole lines is fastest, so columns are interpolated as rows of the transposed image. kornia's warp_affine
    # agrees to 0.01 grey levels and takes twice to five times as long (batches of 48 to 75 pixels, one thread).
    image = _interpolate_rows(images.transpose(2, 3), columns)
    image = _interpolate_rows(image.transpose(2, 3), rows)

    full = 1.0 if images.is_floating_point() else 255.0
    contrast, brightness = (2 * amount[3]).exp(), amount[4]
    gain, offset = contrast / full, 0.5 - 0.5 * contrast + brightness
    return image.mul_(gain.view(-1, 1, 1, 1).to(image)).add_(offset.view(-1, 1, 1, 1).to(image)).clamp_(0, 1)


def _positions(length: int, scale: Tensor, shift: Tensor) -> Float[Tensor, "batch length"]:
    """Return for each of `length` pixels along an axis the position in the source image from which it is read.

    Positions are scaled about the middle, shifted by `shift` pixels, and clamped to the image.
    """
    middle = (length - 1) / 2
    offset = torch.arange(length, dtype=torch.float32) - middle
    return (middle + shift[:, None] + scale[:, None] * offset).clamp(0, length - 1)


def _interpolate_rows(images: Tensor, rows: Float[Tensor, "batch height"]) -> Tensor:
    """Return float32 images whose rows are interpolated linearly from `images` at the positions `rows`, in pixels."""
    batch, channels, height, width = images.shape
    lines = images.reshape(-1, width)
    plane = height * torch.arange(batch * channels, device=images.device).view(batch, channels, 1)
    first = rows.long()
    second = (first + 1).clamp(max=height - 1)
    above, below = (
        lines.index_select(0, (plane + row[:, None]).view(-1)).view(images.shape).float()
        for row in (first, second)
    )
    return above.lerp_(below, (rows - first)[:, None, :, None])


def blur(
    images: Shaped[Tensor, "*batch height width"], deviation: float
) -> Shaped[Tensor, "*batch height width"]:
    """Convolve images with a Gaussian of standard deviation `deviation` pixels; 0 returns the images themselves.

    The kernel is cut off at four times `deviation` and sums to 1. Beyond the border the image is mirrored about its
    edge (d c b a | a b c d | d c b a). The result has the images' type; integers are rounded.
    """
    if deviation == 0:
        return images
    values = images if images.is_floating_point() else images.float()
    height, width = images.shape[-2:]
    down = _smoothing_matrix(height, deviation).to(values)
    across = _smoothing_matrix(width, deviation).to(values)
    # Separable: G(x, y) = g(x) g(y). The cost of two matrix products does not depend on the deviation. kornia's
    # gaussian_blur2d takes 2 to 70 times as long, lacks this border mode, and refuses kernels larger than the image.
    smooth = down @ values @ across.mT
    return smooth if images.is_floating_point() else smooth.round_().to(images.dtype)


def _smoothing_matrix(length: int, deviation: float) -> Float[Tensor, "length length"]:
    """Return the float64 matrix that convolves a line of `length` pixels with a Gaussian."""
    radius = int(4 * deviation + 0.5)
    offsets = torch.arange(-radius, radius + 1)
    weights = (-0.5 * (offsets.double() / deviation).square()).exp()
    # A line that is mirrored repeatedly about its edges has a period of twice its length.
    source = (torch.arange(length)[:, None] + offsets) % (2 * length)
    source = torch.minimum(source, 2 * length - 1 - source)
    matrix = torch.zeros(length, length, dtype=torch.float64)
    return matrix.scatter_add_(1, source, (weights / weights.sum()).expand(length, -1))


def to_rgb8(image: Tensor) -> NDArray[np.uint8]:
    """Return one image (channels, height, width), uint8 or float in 0…1, as (height, width, 3) uint8."""
    pixels = image.detach().cpu()
    if pixels.is_floating_point():
        pixels = (255 * pixels.clamp(0, 1)).round().to(torch.uint8)
    return pixels.expand(3, -1, -1).permute(1, 2, 0).contiguous().numpy()
