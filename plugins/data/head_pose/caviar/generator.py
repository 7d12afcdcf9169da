"""Drawn, partly hidden pedestrians in the layout of the CAVIAR crops: pictures in train/ and test/, `or_label.mat`."""

from pathlib import Path

import numpy as np
from PIL import Image

from framework.storage import cache, generated
from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.caviar.labels import LABELS, Label, write_labels
from plugins.data.head_pose.synthetic_heads import Conditions, Pose

VERSION = 1
"""Of the generator; a change in what it draws or writes takes a new number, and with it a new folder."""
SIDE = 50  # pixels, as published
TRAIN_SHARE = 0.6
PEOPLE = 200
CONDITIONS = Conditions(
    pixels=(12, 26), height=(0.5, 0.66), offset=0.06, blur=0.8, noise=0.05, clutter=6, occluded=0.5
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
    return generated.generated(cache.folder("caviar") / name, mark, lambda root: _write(root, images, seed))


def _write(root: Path, images: int, seed: int) -> None:
    train = round(TRAIN_SHARE * images)
    labels = [Label("", 0.0)] * images
    for split in ("train", "test"):
        (root / split).mkdir()

    def draw(number: int) -> None:
        random = np.random.default_rng([seed, 0, number])
        who = synthetic_heads.person(np.random.default_rng([seed, 1, int(random.integers(PEOPLE))]))
        gaze = float(random.uniform(0, 360))
        looks = Pose(gaze, float(random.normal(0, 6)), float(random.normal(0, 4)))
        picture = synthetic_heads.photograph(random, who, looks, SIDE, CONDITIONS)
        label = Label(f"synthetic_{number:06d}", gaze)
        folder = root / ("train" if number < train else "test")
        Image.fromarray(picture).save(folder / f"{label.name}.jpg", quality=95)
        labels[number] = label

    generated.draw_all(images, draw, "the synthetic caviar images")
    write_labels(root / LABELS, {"train": labels[:train], "test": labels[train:]}, SIDE)
