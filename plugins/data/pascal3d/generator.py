"""Generator of images in the layout of PASCAL3D+: annotation files, lists and images, and `synthetic.json`.

A root is a function of class, number of images, seed and renderer, to the byte: each image has its own random stream,
whichever thread draws it. A root is written beside its place and renamed when it is complete.
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
from framework.storage.generated import draw_all
from framework.storage.generated import ensure_generated as whole
from plugins.data.pascal3d.families import FAMILIES
from plugins.data.pascal3d.layout import VOC_LISTS
from plugins.data.pascal3d.scene import Shot, Thing, shoot

VERSION = 1
"""Version of the generator; a change in what it draws or writes takes a new number, and thus a new folder."""
SHARES = {"imagenet_train": 0.4, "imagenet_val": 0.2, "pascal_train": 0.2, "pascal_val": 0.2}
SAVING = Lock()
"""Lock for SciPy's writers of MATLAB files.

They share the tag with which they write sizes: two of them at once would write each other's.
"""
HEADER = b"MATLAB 5.0 MAT-file, synthetic annotation".ljust(116)  # SciPy's holds the date


def generated(parent: Path, category: str, images: int, seed: int, renderer: Renderer) -> Path:
    """Return the root of a generated class; it is drawn now if it is not there.

    Raises:
        DataError: the cache cannot be written, or holds something else in its place.
        ConfigError: the renderer cannot draw what is needed.
    """
    missing = {"color", "mask"} - renderer.channels
    if missing:
        raise ConfigError(
            f"data.renderer = {type(renderer).__name__} draws no {' and no '.join(sorted(missing))}; wanted "
            "color and mask. Choose another renderer."
        )
    drawn_by = f"{type(renderer).__module__}.{type(renderer).__qualname__}"
    mark = {
        "generator_version": VERSION,
        "seed": seed,
        "images": images,
        "symmetry": {category: FAMILIES[category].symmetry},
        "renderer": drawn_by,
    }
    folder = parent / f"v{VERSION}-{drawn_by}-seed{seed}-images{images}"
    return whole(folder / category, mark, lambda root: _draw_all(root, category, images, seed, renderer))


def _draw_all(part: Path, category: str, images: int, seed: int, renderer: Renderer) -> None:
    names = list(_names(images))
    for source in ("pascal", "imagenet"):
        for top in ("Annotations", "Images"):
            (part / top / f"{category}_{source}").mkdir(parents=True)
    one_at_a_time = Lock()  # a renderer may keep buffers between calls

    def render(*arguments: Any) -> Any:
        with one_at_a_time:
            return renderer(*arguments)

    flags = [False] * images

    def draw(number: int) -> None:
        split, name = names[number]
        random = np.random.default_rng([seed, sorted(FAMILIES).index(category), number])
        shot = shoot(category, random, render)
        _save(part, f"{category}_{split.partition('_')[0]}", name, shot)
        flags[number] = any(thing.category == category and not thing.difficult for thing in shot.things)

    draw_all(images, draw, f"the synthetic {category} images")
    _save_lists(part, category, names, flags)


def _names(images: int) -> Iterator[tuple[str, str]]:
    """Yield list and name of every image."""
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
    from scipy.io import savemat  # takes a quarter of a second, which only the generation needs

    content = io.BytesIO()
    with SAVING:
        savemat(content, {"record": record}, do_compression=True)
    (part / "Annotations" / folder / f"{name}.mat").write_bytes(HEADER + content.getvalue()[len(HEADER) :])


def _objects(shot: Shot) -> np.ndarray:
    """Return the struct array `record.objects`; `symmetry` and `blur` are not in the official files."""
    entries = [
        {
            "class": thing.category,
            "view": "",
            "truncated": float(thing.truncated),
            "occluded": float(thing.occluded),
            "difficult": float(thing.difficult),
            "bbox": np.array([thing.box], dtype=np.float64) + 1,  # the official boxes count from 1
            "cad_index": 1.0,
            "viewpoint": _viewpoint(thing),
            "symmetry": float(thing.symmetry),
            "blur": float(shot.blur),
        }
        for thing in shot.things
    ]
    array = np.empty((1, len(entries)), dtype=[(name, object) for name in entries[0]])
    for index, entry in enumerate(entries):
        array[0, index] = tuple(entry.values())
    return array


def _viewpoint(thing: Thing) -> dict[str, float]:
    """Return the official fields; `focal` × `viewport` is the focal length, (px, py) the principal point, pixels."""
    view = thing.view
    coarse = {
        "azimuth_coarse": float(45 * round(view.azimuth / 45) % 360),
        "elevation_coarse": float(15 * round(view.elevation / 15)),
    }
    fine = {"azimuth": view.azimuth, "elevation": view.elevation, "theta": view.tilt} if thing.fine else {}
    return {
        **coarse,
        **fine,
        "distance": view.distance if thing.fine else 0.0,
        "focal": 1.0,
        "viewport": view.focal,
        "px": view.principal[0] + 1,
        "py": view.principal[1] + 1,
    }


def _save_lists(part: Path, category: str, names: Sequence[tuple[str, str]], easy: Sequence[bool]) -> None:
    """Write the lists; those of VOC flag an image 1, or 0 where its only objects of the class are difficult."""
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
