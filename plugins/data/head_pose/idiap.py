"""Data set of IDIAP head-pose crops, published or synthetic: images in train/ and test/, `or_label_full.mat`."""

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from framework.configuration.paths import FilePath
from framework.errors import ConfigError
from framework.target import Target
from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.archive import Archive, Source, draw_train_and_test
from plugins.data.head_pose.idiap_labels import ANGLES, LABELS, Label, read_labels, write_labels
from plugins.data.head_pose.labelled_images import Heads, Labelled, Labels, Reading
from plugins.data.head_pose.synthetic_heads import Conditions, Person, Pose

SIDE = 75  # pixels, as published
TRAIN_SHARE = 0.64  # as published: 42,304 of 66,295
PEOPLE = 24
CONDITIONS = Conditions(
    pixels=(SIDE, SIDE), height=(0.62, 0.78), offset=0.04, blur=0.7, noise=0.03, clutter=5, occluded=0.03
)
AS_PUBLISHED = Reading(image_size=SIDE)


class Idiap(Heads):
    """Heads of a few people in a meeting room, and their pan, tilt and roll; generated if no root is given.

    Training mirrors no images, because the published set already contains the mirror images.

    Args:
        root: The unpacked IHDPHeadPose; None to generate images in the same layout.
        angles: Angles to predict, in this order; None for pan, tilt and roll.
        angles_in: Unit of the angles in the label file of `root`; generated labels are in radians.
        reading: Settings for reading images.
        images: Number of generated images.
        generator_seed: Seed of the generated images.

    Raises:
        ConfigError: `angles_in` is "degrees", but no `root` is given; generated labels are in radians.
    """

    bibtex = "ba2005evaluation, tosato2013characterizing"
    groups = ("idiap",)

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        angles: list[Literal["pan", "tilt", "roll"]] | None = None,
        angles_in: Literal["radians", "degrees"] = "radians",
        reading: Reading = AS_PUBLISHED,
        images: Annotated[int, Field(ge=20, le=1_000_000)] = 2000,
        generator_seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        if root is None and angles_in != "radians":
            raise ConfigError(
                f"data.angles_in={angles_in} is the unit of the label file in data.root, but data.root is not set, and "
                "generated labels are in radians. Set data.root, or leave data.angles_in out."
            )
        self.source = Source(ARCHIVE, root, images, generator_seed)
        self.angles_in: Literal["radians", "degrees"] = angles_in
        self.reading = reading
        self.varies = reading.jitter > 0
        self.target = Target("angle", tuple(dict.fromkeys(angles or ANGLES)))

    def read_labels(self, root: Path) -> Labels:
        columns = [ANGLES.index(name) for name in self.target.names]
        labels = read_labels(root / LABELS, self.angles_in)
        return Labels(
            {
                split: [
                    Labelled(root / split / label.name, tuple(label.angles[column] for column in columns))
                    for label in labels_of_split
                ]
                for split, labels_of_split in labels.items()
            }
        )


def random_pose(random: np.random.Generator) -> Pose:
    """Return a random head pose of a person at a table; most people look forwards and slightly down."""
    pan, tilt, roll = random.normal((0, -8, 0), (35, 14, 10)).clip((-90, -60, -45), (90, 45, 45))
    return Pose(float(pan), float(tilt), float(roll))


def random_people(seed: int) -> list[Person]:
    """Return random people; training and test images show the same people, as frames of the same recordings would."""
    return [
        synthetic_heads.random_person(np.random.default_rng([seed, 1, number])) for number in range(PEOPLE)
    ]


def _draw(root: Path, images: int, seed: int) -> None:
    people = random_people(seed)

    def draw(number: int) -> tuple[str, np.ndarray, Label]:
        random = np.random.default_rng([seed, 0, number])
        person, pose = int(random.integers(PEOPLE)), random_pose(random)
        image = synthetic_heads.photograph(random, people[person], pose, SIDE, CONDITIONS)
        name = f"synthetic_{person:02d}_{number:06d}"
        pan, tilt, roll = map(math.radians, pose)
        return name, image, Label(f"{name}.jpg", (pan, tilt, roll))

    write_labels(root / LABELS, draw_train_and_test(root, images, TRAIN_SHARE, "idiap", draw))


ARCHIVE = Archive("idiap", "IHDPHeadPose", ("train/", "test/", LABELS), version=1, draw=_draw)
