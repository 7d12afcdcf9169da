"""Reading of PASCAL3D+ release 1.1: its folders, its lists of images, and its annotations in MATLAB files.

The release has the files Annotations/<class>_{pascal,imagenet}/<name>.mat,
Images/<class>_{pascal,imagenet}/<name>.{jpg,JPEG}, Image_sets/<class>_imagenet_{train,val}.txt and
PASCAL/VOCdevkit/VOC2012/ImageSets/Main/<class>_{train,val}.txt.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.datasets import matlab
from framework.datasets.images import Box
from framework.datasets.matlab import read_variables
from framework.errors import DataError, quote
from framework.storage.names import is_within
from framework.storage.parsed_files import ParsedFiles
from framework.storage.reading import read_bytes, translate_errors
from framework.storage.text import lines_of

CLASSES = (
    "aeroplane", "bicycle", "boat", "bottle", "bus", "car",
    "chair", "diningtable", "motorbike", "sofa", "train", "tvmonitor",
)  # fmt: skip
VOC_LISTS = Path("PASCAL", "VOCdevkit", "VOC2012", "ImageSets", "Main")
Struct = Mapping[str, Any]
SUFFIXES = {"pascal": (".jpg", ".JPEG"), "imagenet": (".JPEG", ".jpg")}


@dataclass(frozen=True)
class Labels:
    """Labels of one object of the requested class.

    Attributes:
        box: Left, top, right and bottom edge, pixels from the corner of the image; it may reach beyond the image.
        angles: Azimuth, elevation and tilt in degrees, not wrapped to one turn; None if the object has no fine label.
        truncated, occluded, difficult: Flags of the annotation.
        symmetry: Symmetry of a generated object (`Family.symmetry`); 1 for a real object.
        blur: Standard deviation of the blur of a generated image, pixels of the image; None for a real image.
    """

    box: Box
    angles: tuple[float, float, float] | None
    truncated: bool
    occluded: bool
    difficult: bool
    symmetry: int
    blur: float | None


@dataclass(frozen=True)
class Annotation(Labels):
    """One object of the requested class, with its files.

    Attributes:
        file: File of the annotation.
        image: Path of the image, which may not exist.
    """

    file: Path
    image: Path


@dataclass(frozen=True)
class Content:
    """Content of an annotation file.

    Attributes:
        image: Path of the image as the file states it; it may be empty.
        objects: Labels of the objects of the requested class.
    """

    image: str
    objects: list[Labels]


def parsed_annotations(root: Path, category: str) -> ParsedFiles[Content]:
    """Return the cached contents of the annotation files of a class, as earlier commands parsed them."""
    return ParsedFiles(root, f"pascal3d-{category}", Content, (Path(__file__), Path(matlab.__file__)))


def check_root(root: Path, category: str) -> None:
    """Refuse a folder that does not hold the release.

    Raises:
        DataError: The folder is missing, or lacks a folder or a list of the class; the message names them.
    """
    if not root.is_dir():
        raise DataError(
            f"data.root = {root} does not exist or is not a folder. Set data.root to the unpacked "
            "PASCAL3D+_release1.1, or to null for synthetic images."
        )
    folders = [Path(top, f"{category}_{source}") for top in ("Annotations", "Images") for source in SUFFIXES]
    lists = [name for names in split_lists(category).values() for _, name in names]
    missing = [str(path) + "/" for path in folders if not (root / path).is_dir()]
    missing += [str(path) for path in lists if not (root / path).is_file()]
    if missing:
        inner = [child.name for child in sorted(root.iterdir()) if (child / "Annotations").is_dir()]
        hint = f"Did you mean {root / inner[0]}?" if inner else "Unpack the whole release into this folder."
        raise DataError(
            f"data.root = {root} does not have the layout of PASCAL3D+ release 1.1: it holds no "
            f"{', no '.join(missing)}. "
            f"{hint}"
        )


def split_lists(category: str) -> dict[str, list[tuple[str, Path]]]:
    """Return the lists of images of each split, each with its source ("pascal" or "imagenet").

    "train" has the training images of VOC and all images of ImageNet; "test" has the validation images of VOC. This is
    the protocol of Tulsiani & Malik (CVPR 2015) and of Su et al. (ICCV 2015), thesis §3.6.1.
    """
    return {
        "train": [
            ("pascal", VOC_LISTS / f"{category}_train.txt"),
            ("imagenet", Path("Image_sets") / f"{category}_imagenet_train.txt"),
            ("imagenet", Path("Image_sets") / f"{category}_imagenet_val.txt"),
        ],
        "test": [("pascal", VOC_LISTS / f"{category}_val.txt")],
    }


def read_list(file: Path) -> list[str]:
    """Return the image names of a list; names whose flag is -1 (the class is not in the image) are left out.

    Raises:
        DataError: The file cannot be read, or a line is neither a name nor a name and one of the flags -1, 0, 1.
    """
    names = []
    with translate_errors(file, "a list of image names", "Copy it again from the release."):
        lines = lines_of(read_bytes(file))
    for number, line in enumerate(lines, start=1):
        match line.split():
            case []:
                continue
            case [name] | [name, "1" | "0"] if is_within(name):
                names.append(name)
            case [_, "-1"]:
                continue
            case _:
                raise DataError(
                    f"{file} line {number}: {quote(line)} is neither an image name nor a name and one of -1, 0, 1. "
                    "Copy the list again from the release."
                )
    return list(dict.fromkeys(names))


def read_annotations(
    root: Path, category: str, source: str, name: str, parsed: ParsedFiles[Content] | None = None
) -> list[Annotation]:
    """Return the objects of class `category` in one annotation file.

    Args:
        root: The unpacked release.
        category: Name of the class.
        source: Source of the image, "pascal" or "imagenet".
        name: Name of the image, without its ending.
        parsed: Cached contents of files, which are not parsed again (`parsed_annotations`).

    Raises:
        DataError: The file is missing, is not a MATLAB file, or does not have the structure of an annotation.
    """
    file = root / "Annotations" / f"{category}_{source}" / f"{name}.mat"

    def parse(file: Path) -> Content:
        with translate_errors(file, "a PASCAL3D+ annotation", "Copy it again from the release."):
            return _content(file, _load(file), category)

    content = parse(file) if parsed is None else parsed.get(file, parse)
    image = _image(root / "Images" / file.parent.name, name, source, content.image)
    return [Annotation(**vars(labels), file=file, image=image) for labels in content.objects]


def _content(file: Path, record: Struct, category: str) -> Content:
    """Return the content of an annotation file from its struct `record`."""
    objects = []
    for number, entry in enumerate(_structs(record.get("objects")), start=1):
        if _text(entry, "class") != category:
            continue
        corners = _numbers(entry, "bbox")
        if len(corners) != 4 or not all(map(math.isfinite, corners)):
            raise DataError(
                f"{file}: Object {number} has the bbox {corners}, but four finite numbers x1 y1 x2 y2 are required. "
                "Correct the annotation."
            )
        x1, y1, x2, y2 = corners
        symmetry = _number(entry, "symmetry")
        objects.append(
            Labels(
                box=(x1 - 1, y1 - 1, x2, y2),  # the file counts pixels from 1, and (x2, y2) is inside the box
                angles=_angles(entry.get("viewpoint")),
                truncated=bool(_number(entry, "truncated")),
                occluded=bool(_number(entry, "occluded")),
                difficult=bool(_number(entry, "difficult")),
                symmetry=1 if symmetry is None or not math.isfinite(symmetry) else int(symmetry),
                blur=_number(entry, "blur"),
            )
        )
    return Content(_text(record, "filename"), objects)


def _load(file: Path) -> Struct:
    """Return the struct `record` of an annotation file."""
    if not file.exists():
        raise DataError(f"{file}: no such file, although a list names it. Copy it again from the release.")
    record = read_variables(file, ["record"], "Copy it again from the release.").get("record")
    if not isinstance(record, dict):
        raise DataError(
            f"{file}: The file holds no struct `record`, so it is not a PASCAL3D+ annotation. Copy it again from the "
            "release."
        )
    return record


def _image(folder: Path, name: str, source: str, recorded: str) -> Path:
    """Return the path of the image of an annotation.

    If no possible path exists, return the first one, so that the message about the missing image names it.

    Args:
        folder: Folder of the images.
        name: Name of the annotation without suffix.
        source: "pascal" or "imagenet", which have different suffixes.
        recorded: Path of the image in the annotation; it may be empty.
    """
    candidates = [folder / f"{name}{suffix}" for suffix in SUFFIXES[source]]
    if recorded:
        candidates.append(folder / Path(recorded).name)
    return next((path for path in candidates if path.is_file()), candidates[0])


def _structs(value: Any) -> Iterator[Struct]:
    """Yield the structs of a struct array or cell array, or a struct that is stored without an array."""
    for item in np.atleast_1d(np.asarray(value, dtype=object)).ravel():
        if isinstance(item, dict):
            yield item


def _text(entry: Struct, name: str) -> str:
    """Return the text of a field; an empty string if the field is missing, empty or holds something else."""
    value = entry.get(name)
    return value.strip() if isinstance(value, str) else ""


def _numbers(entry: Struct, name: str) -> list[float]:
    """Return at most five numbers of a field; an empty list if the field is missing, empty or holds something else."""
    value = np.asarray(entry.get(name))
    real = np.issubdtype(value.dtype, np.integer) or np.issubdtype(value.dtype, np.floating)
    return value.ravel()[:5].astype(np.float64).tolist() if real else []


def _number(entry: Struct, name: str) -> float | None:
    """Return the first number of a field; None if there is none."""
    return next(iter(_numbers(entry, name)), None)


def _angles(viewpoint: Any) -> tuple[float, float, float] | None:
    """Return azimuth, elevation and tilt of the fine label, degrees; None if there is no fine label.

    An object has a fine label if its fields of azimuth, elevation and tilt are filled and its distance is not 0. In a
    damaged file the angles may be NaN.
    """
    if not isinstance(viewpoint, dict) or _number(viewpoint, "distance") == 0:
        return None
    azimuth, elevation, tilt = (_number(viewpoint, name) for name in ("azimuth", "elevation", "theta"))
    if azimuth is None or elevation is None or tilt is None:
        return None
    return azimuth, elevation, tilt


def radians(degrees: float) -> float:
    """Return the angle in radians, in [-π, π)."""
    return math.radians((degrees + 180) % 360 - 180)
