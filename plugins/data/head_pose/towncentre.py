"""Data set of TownCentre heads, published or synthetic: a folder for each person, an image and a text file per head."""

from pathlib import Path
from typing import Annotated

import numpy as np
from PIL import Image
from pydantic import Field

from framework.configuration.paths import FilePath
from framework.storage.generated import draw_all
from framework.target import Target
from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.archive import Archive, Source
from plugins.data.head_pose.labelled_images import Heads, Labels, Reading
from plugins.data.head_pose.synthetic_heads import Conditions, Pose
from plugins.data.head_pose.towncentre_labels import FOLDER, find_heads, label_text, split_by_person

SIDE = 50  # pixels
IMAGES_PER_PERSON = 8
"""Number of synthetic images that show the same person."""
CONDITIONS = Conditions(
    pixels=(20, 46), height=(0.5, 0.66), offset=0.05, blur=0.9, noise=0.05, clutter=6, occluded=0.12
)
AS_PUBLISHED = Reading(image_size=SIDE)


class TownCentre(Heads):
    """Heads of pedestrians seen by a surveillance camera, and their pan; generated if no root is given.

    Args:
        root: The unpacked TownCentreHeadImages; None to generate images in the same layout.
        reading: Settings for reading images.
        mirror: Whether half of the training images are mirrored left to right.
        images: Number of generated images, some of which are marked as not valid.
        generator_seed: Seed of the generated images.

    Attributes:
        invalid: Number of heads that are left out because their labels mark them as not valid; `prepare` sets it.
    """

    bibtex = "benfold2009guiding, beyer2015biternion"
    groups = ("towncentre",)
    target = Target("angle", ("pan",))

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        reading: Reading = AS_PUBLISHED,
        mirror: bool = True,
        images: Annotated[int, Field(ge=200, le=1_000_000)] = 2400,
        generator_seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        self.source = Source(ARCHIVE, root, images, generator_seed)
        self.reading = reading
        self.varies = reading.jitter > 0 or mirror
        # The mirror image of a head at pan p shows a head at pan -p, which Beyer et al. write as 360° - p.
        self.signs = (-1.0,) if mirror else ()

    def read_labels(self, root: Path) -> Labels:
        heads, self.invalid, faults = find_heads(root)
        return Labels(split_by_person(heads), faults, f", {self.invalid} marked as not valid")


def random_pose(heading: float, random: np.random.Generator) -> Pose:
    """Return a random head pose of a person who walks towards `heading`, degrees."""
    pan = heading + random.normal(0, 35)
    return Pose(float(pan), float(random.normal(0, 6)), float(random.normal(0, 4)))


def _draw(root: Path, images: int, seed: int) -> None:
    for index in range(-(-images // IMAGES_PER_PERSON)):
        (root / f"{index:04d}").mkdir()

    def draw(number: int) -> None:
        index = number // IMAGES_PER_PERSON
        person_random = np.random.default_rng([seed, 1, index])
        person, heading = synthetic_heads.random_person(person_random), person_random.uniform(0, 360)
        random = np.random.default_rng([seed, 0, number])
        pose, valid = random_pose(heading, random), random.random() >= 0.03
        image = synthetic_heads.photograph(random, person, pose, SIDE, CONDITIONS)
        if not valid:
            image = image[:5]  # a head that was cut off
        folder, stem = root / f"{index:04d}", f"synthetic_{index}_{number:06d}"
        # the official names also have a part after the stem
        Image.fromarray(image).save(folder / f"{stem}_{number % IMAGES_PER_PERSON}.jpg", quality=95)
        text = label_text((pose.pan + 180) % 360 - 180, valid)
        (folder / f"{stem}.txt").write_text(text, encoding="utf-8")

    draw_all(images, draw, "the synthetic towncentre images")


ARCHIVE = Archive("towncentre", FOLDER, (), version=1, draw=_draw)
