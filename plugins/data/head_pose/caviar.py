"""Data set of CAVIAR crops with partly hidden heads, published or synthetic: train/ and test/, `or_label.mat`."""

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from framework.configuration.paths import FilePath
from framework.target import Target
from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.archive import Archive, Source, draw_train_and_test
from plugins.data.head_pose.caviar_labels import LABELS, Label, read_labels, write_labels
from plugins.data.head_pose.labelled_images import Heads, Labelled, Labels, Reading
from plugins.data.head_pose.synthetic_heads import Conditions, Pose

SIDE = 50  # pixels, as published
TRAIN_SHARE = 0.6
PEOPLE = 200
CONDITIONS = Conditions(
    pixels=(12, 26), height=(0.5, 0.66), offset=0.06, blur=0.8, noise=0.05, clutter=6, occluded=0.5
)
AS_PUBLISHED = Reading(image_size=SIDE)


class Caviar(Heads):
    """Partly hidden heads of people in a shopping centre, and their gaze; generated if no root is given.

    Training mirrors no images, because the thesis authors' data hold no mirror images.

    Args:
        root: The unpacked CAVIARShoppingCenterFullOccl; None to generate images in the same layout.
        reading: Settings for reading images.
        images: Number of generated images.
        generator_seed: Seed of the generated images.
    """

    bibtex = "fisher2005caviar, tosato2013characterizing"
    groups = ("caviar",)
    target = Target("angle", ("gaze",))

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        reading: Reading = AS_PUBLISHED,
        images: Annotated[int, Field(ge=20, le=1_000_000)] = 2400,
        generator_seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        self.source = Source(ARCHIVE, root, images, generator_seed)
        self.reading = reading
        self.varies = reading.jitter > 0

    def read_labels(self, root: Path) -> Labels:
        labels = read_labels(root / LABELS)
        return Labels(
            {
                split: [
                    Labelled(root / split / f"{label.name}.jpg", (math.radians(label.gaze),))
                    for label in labels_of_split
                ]
                for split, labels_of_split in labels.items()
            }
        )


def _draw(root: Path, images: int, seed: int) -> None:
    def draw(number: int) -> tuple[str, np.ndarray, Label]:
        random = np.random.default_rng([seed, 0, number])
        person = synthetic_heads.random_person(np.random.default_rng([seed, 1, int(random.integers(PEOPLE))]))
        gaze = float(random.uniform(0, 360))
        pose = Pose(gaze, float(random.normal(0, 6)), float(random.normal(0, 4)))
        image = synthetic_heads.photograph(random, person, pose, SIDE, CONDITIONS)
        name = f"synthetic_{number:06d}"
        return name, image, Label(name, gaze)

    write_labels(root / LABELS, draw_train_and_test(root, images, TRAIN_SHARE, "caviar", draw), SIDE)


ARCHIVE = Archive(
    "caviar", "CAVIARShoppingCenterFullOccl", ("train/", "test/", LABELS), version=1, draw=_draw
)
