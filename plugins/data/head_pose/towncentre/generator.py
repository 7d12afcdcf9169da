"""Drawn pedestrians in the layout of the TownCentre heads: a folder a person, an image and a text file a head."""

from pathlib import Path

import numpy as np
from PIL import Image

from framework.storage import cache, generated
from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.synthetic_heads import Conditions, Pose
from plugins.data.head_pose.towncentre.labels import label_text

VERSION = 1
"""Of the generator; a change in what it draws or writes takes a new number, and with it a new folder."""
SIDE = 50  # pixels
EACH = 8
"""Images of a person."""
CONDITIONS = Conditions(
    pixels=(20, 46), height=(0.5, 0.66), offset=0.05, blur=0.9, noise=0.05, clutter=6, occluded=0.12
)


def generate(images: int, seed: int) -> Path:
    """The root of a generated set of that many images; drawn now unless it is there.

    Raises:
        DataError: the cache cannot be written, or holds something else in its place.
    """
    mark = {
        "generator_version": VERSION,
        "heads_version": synthetic_heads.VERSION,
        "images": images,
        "seed": seed,
    }
    name = f"v{VERSION}.{synthetic_heads.VERSION}-seed{seed}-images{images}"
    return generated.generated(
        cache.folder("towncentre") / name, mark, lambda root: _write(root, images, seed)
    )


def pose(heading: float, random: np.random.Generator) -> Pose:
    """Where somebody looks who walks towards `heading`, degrees."""
    pan = heading + random.normal(0, 35)
    return Pose(float(pan), float(random.normal(0, 6)), float(random.normal(0, 4)))


def _write(root: Path, images: int, seed: int) -> None:
    for person in range(-(-images // EACH)):
        (root / f"{person:04d}").mkdir()

    def draw(number: int) -> None:
        person = number // EACH
        of_person = np.random.default_rng([seed, 1, person])
        who, heading = synthetic_heads.person(of_person), of_person.uniform(0, 360)
        random = np.random.default_rng([seed, 0, number])
        looks, valid = pose(heading, random), random.random() >= 0.03
        picture = synthetic_heads.photograph(random, who, looks, SIDE, CONDITIONS)
        if not valid:
            picture = picture[:5]  # a head that was cut off
        folder, stem = root / f"{person:04d}", f"synthetic_{person}_{number:06d}"
        # the official names go on behind the stem as well
        Image.fromarray(picture).save(folder / f"{stem}_{number % EACH}.jpg", quality=95)
        (folder / f"{stem}.txt").write_text(
            label_text((looks.pan + 180) % 360 - 180, valid), encoding="utf-8"
        )

    generated.draw_all(images, draw, "the synthetic towncentre images")
