"""Base class of the data sets of heads: whole images with angles, read in three splits."""

import hashlib
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.datasets import given_images, images
from framework.datasets.fields import Fields
from framework.datasets.images import Crop, Crops
from framework.errors import DataError
from framework.storage.generated import read_mark
from framework.storage.names import as_bytes
from plugins.data.head_pose.archive import Source

SPLITS = Splits._fields
SPLIT_SEED = 13
"""Seed of the thesis authors' code, for NumPy's legacy generator."""


class Labelled(NamedTuple):
    """One image and its angles, in radians, not wrapped to one turn, in the order of the target's names."""

    file: Path
    angles: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Settings for reading images: each image is read whole, made square by repeating its border, and scaled.

    Attributes:
        image_size: Side of the square, pixels.
        test_blur: Standard deviation of a Gaussian that blurs the test images, pixels of the square.
        jitter: Largest share by which training images are shifted, scaled and made brighter or darker.
        skip_unreadable: Whether images that cannot be read are left out and counted; otherwise they are an error.
    """

    image_size: Annotated[int, Field(ge=8, le=1024)] = 50
    test_blur: Annotated[float, Field(ge=0, le=1024, allow_inf_nan=False)] = 0.0
    jitter: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.08
    skip_unreadable: bool = False

    def crop(self, file: Path, split: str) -> Crop:
        """Return the settings that read the whole image `file`, blurred by `test_blur` if `split` is "test"."""
        return Crop(file, None, 0.0, self.image_size, blur=self.test_blur if split == "test" else 0.0)

    def read_unlabelled(self, files: Sequence[Path]) -> Fields | Crops:
        """Return a user's own images without labels, rotated as their EXIF entries say."""
        return images.load_unlabelled(
            [Crop(Path(file), None, 0.0, self.image_size, upright=True) for file in files]
        )


class Loaded(NamedTuple):
    """Data of all splits.

    Attributes:
        tables: Fields "input" (uint8, colour), "target" (radians in [-π, π)), "group" (0) and "index", by split.
        skipped: Number of images that were left out because they could not be read.
        fingerprint: Sizes of the splits, the test blur, and a hash of names and labels.
    """

    tables: Mapping[str, Fields | Crops]
    skipped: int
    fingerprint: dict[str, str]


class Labels(NamedTuple):
    """Labels of a data set.

    Attributes:
        samples: Labelled images by split. If "validation" is missing, half of the test images are used for validation.
        faults: Errors of labels that could not be read; they count as unreadable images.
        left_out: Clause about images that the labels themselves exclude; it is part of the message about an empty
            split.
    """

    samples: dict[str, list[Labelled]]
    faults: Sequence[DataError] = ()
    left_out: str = ""


class Heads(Data):
    """Base class of data sets of head images; a data set adds its constructor, its citation, and `read_labels`.

    The constructor sets `source`, `reading` and `target`. If training shows mirror images, it also sets `signs`, the
    factor of each angle in a mirror image.
    """

    suffixes = images.SUFFIXES
    source: Source
    reading: Reading
    signs: tuple[float, ...] = ()
    """Factors by which mirroring an image multiplies its angles; () if no image is mirrored."""

    @abstractmethod
    def read_labels(self, root: Path) -> Labels:
        """Return the labels in a folder.

        Raises:
            DataError: The labels cannot be read.
        """

    def check_files(self) -> None:
        if self.source.root is not None:
            self.read_labels(self.source.folder())

    def prepare(self) -> None:
        root = self.source.folder()
        self.synthetic = read_mark(root) is not None
        samples, faults, left_out = self.read_labels(root)
        if "validation" not in samples:
            samples["validation"], samples["test"] = halves(samples["test"])
        self._loaded = load(
            samples,
            self.target.names,
            self.reading,
            faults,
            generated_in=self.source.generated_in(),
            left_out=left_out,
        )
        self.skipped = self._loaded.skipped
        self.input_shape = (3, self.reading.image_size, self.reading.image_size)

    def splits(self) -> Splits:
        return Splits(**self._loaded.tables)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return self.reading.read_unlabelled(files)

    def inputs(self, user_data: Any) -> Tensor:
        return given_images.to_inputs(self, user_data)

    def augment(self, batch: Batch) -> Batch:
        return images.vary(batch, self.signs, self.reading.jitter)

    def fingerprint(self) -> Mapping[str, str]:
        return self.source.fingerprint(self.synthetic) | self._loaded.fingerprint

    def preview(self, inputs: Tensor) -> np.ndarray:
        return images.to_rgb8(inputs)


def halves(samples: Sequence[Labelled]) -> tuple[list[Labelled], list[Labelled]]:
    """Return the first half of the published test set for validation, and the second half for the test.

    The images are first shuffled at random, as in the thesis authors' code.
    """
    order = np.random.RandomState(SPLIT_SEED).choice(len(samples), len(samples), replace=False)
    shuffled = [samples[index] for index in order]
    return shuffled[: len(samples) // 2], shuffled[len(samples) // 2 :]


def load(
    samples: Mapping[str, Sequence[Labelled]],
    names: Sequence[str],
    reading: Reading,
    faults: Sequence[DataError] = (),
    *,
    generated_in: Path | None,
    left_out: str = "",
) -> Loaded:
    """Return the images of all splits.

    Args:
        samples: Labelled images by split.
        names: Names of the angles.
        reading: Settings for reading images.
        faults: Errors of labels that could not be read.
        generated_in: Cache folder of generated images; None for a user's images.
        left_out: Clause about images that the labels themselves exclude, for the message about an empty split.

    Raises:
        DataError: An angle is not finite, a split is empty, or images cannot be read and are not to be skipped.
    """
    _refuse_wrong_labels(samples)
    tables, skipped = images.load_splits(
        {split: [reading.crop(sample.file, split) for sample in samples[split]] for split in SPLITS},
        {split: images.angle_fields([sample.angles for sample in samples[split]], names) for split in SPLITS},
        faults,
        skip_unreadable=reading.skip_unreadable,
        generated_in=generated_in,
    )
    total = len(faults) + sum(map(len, samples.values()))
    for split, table in tables.items():
        if len(table) == 0:
            raise DataError(
                f"The {split} split is empty ({total} images in all, {skipped} unreadable{left_out}). "
                "Copy the missing images again from their source, or use other data."
            )
    sizes = {split: str(len(table)) for split, table in tables.items()}
    return Loaded(tables, skipped, {**sizes, "test_blur": str(reading.test_blur), "sha256": _digest(samples)})


def _refuse_wrong_labels(samples: Mapping[str, Sequence[Labelled]]) -> None:
    wrong = [
        f"{sample.file}: {', '.join(map(str, sample.angles))}"
        for chosen in samples.values()
        for sample in chosen
        if not all(map(math.isfinite, sample.angles))
    ]
    images.refuse_listed(
        wrong, "images have an angle that is not finite", "Correct these labels, or remove the images."
    )


def _digest(samples: Mapping[str, Sequence[Labelled]]) -> str:
    """Return the SHA-256 of the names and the angles of all images."""
    digest = hashlib.sha256()
    for split in SPLITS:
        for sample in samples[split]:
            digest.update(as_bytes(f"{split} {sample.file.name} {sample.angles}\n"))
    return digest.hexdigest()
