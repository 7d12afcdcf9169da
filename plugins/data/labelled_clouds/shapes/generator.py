"""Generator of a set of CAD models in ModelNet's layout: `<class>/{train,test}/<class>_<number>.off`, `synthetic.json`.

The same seed, sizes and classes give the same bytes. Each object has its own random stream, so that a larger set begins
with the objects of a smaller set.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from framework.geometry.solids import Solid, drop_degenerate
from framework.storage import cache
from framework.storage.generated import draw_all, ensure_generated
from plugins.data.labelled_clouds.shapes import buildings, cabinets, furniture, things, vessels

VERSION = 2
"""Version of the generator; increase it if the output changes, so that a new folder is written."""
CLASSES: dict[str, Callable[[np.random.Generator], Solid]] = {
    "airplane": things.airplane,
    "bathtub": vessels.bathtub,
    "bed": furniture.bed,
    "bench": furniture.bench,
    "bookshelf": cabinets.bookshelf,
    "bottle": vessels.bottle,
    "bowl": vessels.bowl,
    "car": things.car,
    "chair": furniture.chair,
    "cone": vessels.cone,
    "cup": vessels.cup,
    "curtain": buildings.curtain,
    "desk": furniture.desk,
    "door": buildings.door,
    "dresser": cabinets.dresser,
    "flower_pot": vessels.flower_pot,
    "glass_box": cabinets.glass_box,
    "guitar": things.guitar,
    "keyboard": things.keyboard,
    "lamp": things.lamp,
    "laptop": things.laptop,
    "mantel": buildings.mantel,
    "monitor": things.monitor,
    "night_stand": cabinets.night_stand,
    "person": things.person,
    "piano": things.piano,
    "plant": vessels.plant,
    "radio": cabinets.radio,
    "range_hood": buildings.range_hood,
    "sink": vessels.sink,
    "sofa": furniture.sofa,
    "stairs": buildings.stairs,
    "stool": furniture.stool,
    "table": furniture.table,
    "tent": buildings.tent,
    "toilet": vessels.toilet,
    "tv_stand": cabinets.tv_stand,
    "vase": vessels.vase,
    "wardrobe": cabinets.wardrobe,
    "xbox": cabinets.xbox,
}
"""Classes of ModelNet40, in its order, and the functions that make their objects."""
SPLITS = ("train", "test")
JITTER_DEG, QUARTERS = 12.0, 0.25
"""Largest random rotation of an object about the up axis, degrees; share of objects also rotated by 90°, 180° or 270°.

The objects are rotated because the official models are not aligned either.
"""
STRETCH = 0.2
"""Standard deviation of the logarithm of the factor by which each axis is stretched."""


@dataclass(frozen=True, kw_only=True)
class Models:
    """Number of generated models of each class for each split, and the seed."""

    train_models: Annotated[int, Field(ge=2, le=10_000)] = 60
    test_models: Annotated[int, Field(ge=1, le=10_000)] = 50
    generator_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


def generate_models(models: Models) -> Path:
    """Return the root of a generated set, after generating the set if the cache does not hold it.

    Raises:
        DataError: The cache cannot be written, or holds other data under the same name.
    """
    train, test, seed = models.train_models, models.test_models, models.generator_seed
    mark = {
        "generator_version": VERSION,
        "seed": seed,
        "train": train,
        "test": test,
        "classes": list(CLASSES),
    }
    root = cache.folder("modelnet40") / f"v{VERSION}-seed{seed}-train{train}-test{test}"
    return ensure_generated(root, mark, lambda part: _write(part, models))


def model(category: str, split: str, number: int, seed: int) -> Solid:
    """Return model `number` (0, 1, …) of a class and split."""
    stream = [seed, list(CLASSES).index(category), SPLITS.index(split), number]
    random = np.random.default_rng(stream)
    solid = CLASSES[category](random)
    stretch = np.exp(STRETCH * random.standard_normal(3))
    angle = JITTER_DEG * random.uniform(-1, 1)
    if random.random() < QUARTERS:
        angle += 90 * random.integers(1, 4)
    return drop_degenerate(solid.scale(*map(float, stretch)).rotate("z", float(angle)))


def as_off(solid: Solid) -> str:
    """Return the text of an OFF file.

    Coordinates are rounded to 10 µm, because the last bits of a cosine differ between machines.
    """
    rounded = np.round(solid.vertices, 5) + 0.0  # no -0
    vertices = [f"{x:g} {y:g} {z:g}" for x, y, z in rounded.tolist()]
    faces = [f"3 {a} {b} {c}" for a, b, c in solid.faces.tolist()]
    return "\n".join(["OFF", f"{len(vertices)} {len(faces)} 0", *vertices, *faces, ""])


def _write(part: Path, models: Models) -> None:
    sizes = {"train": models.train_models, "test": models.test_models}
    jobs = [(name, split, number) for name in CLASSES for split in SPLITS for number in range(sizes[split])]
    for name in CLASSES:
        for split in SPLITS:
            (part / name / split).mkdir(parents=True)

    def write(job: int) -> None:
        name, split, number = jobs[job]
        # as in the official set, the numbers of the test files continue those of the training files
        official_number = number + 1 + (models.train_models if split == "test" else 0)
        text = as_off(model(name, split, number, models.generator_seed))
        (part / name / split / f"{name}_{official_number:04d}.off").write_text(
            text, encoding="ascii", newline="\n"
        )

    draw_all(len(jobs), write, "the synthetic CAD models", in_processes=True)
