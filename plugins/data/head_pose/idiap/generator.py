"""Drawn heads in the layout of the IDIAP crops: pictures in train/ and test/, `or_label_full.mat`."""

import math
from pathlib import Path

import numpy as np
from PIL import Image

from framework.storage import cache, generated
from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.idiap.labels import LABELS, Label, write_labels
from plugins.data.head_pose.synthetic_heads import Conditions, Person, Pose

VERSION = 1
"""Of the generator; a change in what it draws or writes takes a new number, and with it a new folder."""
SIDE = 75  # pixels, as published
TRAIN_SHARE = 0.64  # as published: 42,304 of 66,295
PEOPLE = 24
CONDITIONS = Conditions(
    pixels=(SIDE, SIDE), height=(0.62, 0.78), offset=0.04, blur=0.7, noise=0.03, clutter=5, occluded=0.03
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
    return generated.generated(cache.folder("idiap") / name, mark, lambda root: _write(root, images, seed))


def pose(random: np.random.Generator) -> Pose:
    """Where somebody at a table looks, mostly forwards and down."""
    pan, tilt, roll = random.normal((0, -8, 0), (35, 14, 10)).clip((-90, -60, -45), (90, 45, 45))
    return Pose(float(pan), float(tilt), float(roll))


def people(seed: int) -> list[Person]:
    """Who sits there, in both splits: frames of the same recordings."""
    return [synthetic_heads.person(np.random.default_rng([seed, 1, number])) for number in range(PEOPLE)]


def _write(root: Path, images: int, seed: int) -> None:
    train = round(TRAIN_SHARE * images)
    seated = people(seed)
    labels: list[Label] = [Label("", (0.0, 0.0, 0.0))] * images
    for split in ("train", "test"):
        (root / split).mkdir()

    def draw(number: int) -> None:
        random = np.random.default_rng([seed, 0, number])
        who, looks = int(random.integers(PEOPLE)), pose(random)
        picture = synthetic_heads.photograph(random, seated[who], looks, SIDE, CONDITIONS)
        name = f"synthetic_{who:02d}_{number:06d}.jpg"
        Image.fromarray(picture).save(root / ("train" if number < train else "test") / name, quality=95)
        pan, tilt, roll = map(math.radians, looks)
        labels[number] = Label(name, (pan, tilt, roll))

    generated.draw_all(images, draw, "the synthetic idiap images")
    write_labels(root / LABELS, {"train": labels[:train], "test": labels[train:]})
