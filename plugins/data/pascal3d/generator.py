"""Generator of images in the layout of PASCAL3D+: annotation files, lists and images, and `synthetic.json`.

The same class, number of images, seed and renderer give the same bytes. Each image has its own random stream, so the
order in which threads or processes draw the images does not matter.
"""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from PIL import Image

from framework.errors import ConfigError
from framework.renderer import Renderer
from framework.storage.generated import draw_all, ensure_generated
from plugins.data.pascal3d.families import FAMILIES
from plugins.data.pascal3d.layout import VOC_LISTS
from plugins.data.pascal3d.scene import AnnotatedObject, Shot, shoot

VERSION = 1
"""Version of the generator; increase it if the output changes, so that a new folder is written."""
SHARES = {"imagenet_train": 0.4, "imagenet_val": 0.2, "pascal_train": 0.2, "pascal_val": 0.2}
SAVING = Lock()
"""Lock for SciPy's writers of MATLAB files.

All writers share one variable for the sizes that they write, so two writers at the same time would mix them up.
"""
# SciPy's own header holds the date, which would change the bytes of the file
HEADER = b"MATLAB 5.0 MAT-file, synthetic annotation".ljust(116)


def generate_class(parent: Path, category: str, images: int, seed: int, renderer: Renderer) -> Path:
    """Return the root of a generated class, after generating it if it does not exist.

    Args:
        parent: Folder of the generated roots.
        category: Name of the class.
        images: Number of images.
        seed: Seed of the images.
        renderer: Renderer of the objects.

    Raises:
        DataError: The cache cannot be written, or holds other data under the same name.
        ConfigError: The renderer does not draw colours and masks.
    """
    missing = {"color", "mask"} - renderer.channels
    if missing:
        raise ConfigError(
            f"data.renderer = {type(renderer).__name__} draws no {' and no '.join(sorted(missing))}, but color and "
            "mask are required. Choose another renderer."
        )
    renderer_name = f"{type(renderer).__module__}.{type(renderer).__qualname__}"
    mark = {
        "generator_version": VERSION,
        "seed": seed,
        "images": images,
        "symmetry": {category: FAMILIES[category].symmetry},
        "renderer": renderer_name,
    }
    folder = parent / f"v{VERSION}-{renderer_name}-seed{seed}-images{images}"
    return ensure_generated(
        folder / category, mark, lambda root: _draw_all(root, category, images, seed, renderer)
    )


def _draw_all(part: Path, category: str, images: int, seed: int, renderer: Renderer) -> None:
    names = list(_names(images))
    for source in ("pascal", "imagenet"):
        for top in ("Annotations", "Images"):
            (part / top / f"{category}_{source}").mkdir(parents=True)
    renderer_lock = Lock()  # a renderer may keep buffers between calls

    def render(*arguments: Any) -> Any:
        with renderer_lock:
            return renderer(*arguments)

    def draw(number: int) -> bool:
        """Draw an image, and return whether it shows an object of the class that is not difficult."""
        split, name = names[number]
        random = np.random.default_rng([seed, sorted(FAMILIES).index(category), number])
        shot = shoot(category, random, render)
        _save(part, f"{category}_{split.partition('_')[0]}", name, shot)
        return any(entry.category == category and not entry.difficult for entry in shot.objects)

    easy = draw_all(images, draw, f"the synthetic {category} images", in_processes=True)
    _save_lists(part, category, names, easy)


def _names(images: int) -> Iterator[tuple[str, str]]:
    """Yield for each image the list that it belongs to, such as "pascal_val", and its name."""
    ends = np.round(np.cumsum([0.0, *SHARES.values()]) * images).astype(int)
    for split, first, last in zip(SHARES, ends, ends[1:], strict=False):
        for number in range(first, last):
            yield split, f"synthetic_{number:06d}"


def _save(part: Path, folder: str, name: str, shot: Shot) -> None:
    suffix = ".jpg" if folder.endswith("_pascal") else ".JPEG"
    image = part / "Images" / folder / f"{name}{suffix}"
    Image.fromarray(shot.pixels).save(image, "JPEG", quality=90)
    height, width, depth = shot.pixels.shape
    record = {
        "folder": folder,
        "filename": image.name,
        "size": {"width": float(width), "height": float(height), "depth": float(depth)},
        "imgsize": np.array([[width, height, depth]], dtype=np.float64),
        "database": "synthetic",
        "objects": _objects(shot),
    }
    from scipy.io import (
        savemat,  # reading the data does not need this import
    )

    content = io.BytesIO()
    with SAVING:
        savemat(content, {"record": record}, do_compression=True)
    (part / "Annotations" / folder / f"{name}.mat").write_bytes(HEADER + content.getvalue()[len(HEADER) :])


def _objects(shot: Shot) -> np.ndarray:
    """Return the struct array `record.objects` of an annotation file.

    It has all fields of the official files, and in addition the fields `symmetry` and `blur`.
    """
    entries = [
        {
            "class": annotated.category,
            "view": "",
            "truncated": float(annotated.truncated),
            "occluded": float(annotated.occluded),
            "difficult": float(annotated.difficult),
            "bbox": np.array([annotated.box], dtype=np.float64) + 1,  # the official boxes count from 1
            "cad_index": 1.0,
            "viewpoint": _viewpoint(annotated),
            "symmetry": float(annotated.symmetry),
            "blur": float(shot.blur),
        }
        for annotated in shot.objects
    ]
    array = np.empty((1, len(entries)), dtype=[(name, object) for name in entries[0]])
    for index, entry in enumerate(entries):
        array[0, index] = tuple(entry.values())
    return array


def _viewpoint(annotated: AnnotatedObject) -> dict[str, float]:
    """Return the fields of the official struct `viewpoint`.

    The focal length in pixels is `focal` × `viewport`; (`px`, `py`) is the principal point, pixels counted from 1.
    """
    view = annotated.view
    coarse = {
        "azimuth_coarse": float(45 * round(view.azimuth / 45) % 360),
        "elevation_coarse": float(15 * round(view.elevation / 15)),
    }
    fine = (
        {"azimuth": view.azimuth, "elevation": view.elevation, "theta": view.tilt} if annotated.fine else {}
    )
    return {
        **coarse,
        **fine,
        "distance": view.distance if annotated.fine else 0.0,
        "focal": 1.0,
        "viewport": view.focal,
        "px": view.principal[0] + 1,
        "py": view.principal[1] + 1,
    }


def _save_lists(part: Path, category: str, names: Sequence[tuple[str, str]], easy: Sequence[bool]) -> None:
    """Write the lists of images of a class.

    The lists of VOC give each image a flag: 0 if all its objects of the class are difficult, otherwise 1.

    Args:
        part: Folder of the class.
        category: Name of the class.
        names: List and name of each image.
        easy: Whether each image shows an object of the class that is not difficult.
    """
    (part / "Image_sets").mkdir()
    (part / VOC_LISTS).mkdir(parents=True)
    for split in SHARES:
        source, _, half = split.partition("_")
        lines = [
            f"{name} {1 if flag else 0:2d}" if source == "pascal" else name
            for (owner, name), flag in zip(names, easy, strict=True)
            if owner == split
        ]
        file = (
            VOC_LISTS / f"{category}_{half}.txt"
            if source == "pascal"
            else Path("Image_sets", f"{category}_{split}.txt")
        )
        (part / file).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
