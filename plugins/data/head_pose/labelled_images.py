"""Whole images with angles, in three splits: what a loader does once it knows which image has which label."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from framework.data import Batch
from framework.datasets import images
from framework.datasets.fields import Fields
from framework.datasets.images import Crop, Crops
from framework.errors import DataError
from framework.storage import cache

SPLITS = ("train", "validation", "test")
SPLIT_SEED = 13
"""That of the thesis authors' code, for NumPy's legacy generator."""


class Labelled(NamedTuple):
    """One image; angles in radians, any number of turns, in the order of the target's names."""

    file: Path
    angles: tuple[float, ...]


@dataclass(frozen=True)
class Splits:
    """What can be trained on and tested with.

    Attributes:
        tables: the fields "input" (uint8, colour, side × side), "target" (radians in [-π, π)), "group" (0) and
            "index" of every split.
        skipped: how many images were left out because they could not be read.
        digest: a hash over the names and labels of every split.
    """

    tables: Mapping[str, Fields | Crops]
    skipped: int
    digest: str

    def sizes(self) -> dict[str, str]:
        return {split: str(len(table)) for split, table in self.tables.items()}

    def fingerprint(
        self, root: str | None, generator_seed: int, version: str, test_blur: float
    ) -> dict[str, str]:
        """What tells one state of a data set from another; `root` None: generated."""
        return {
            "root": f"synthetic, seed {generator_seed}" if root is None else root,
            "version": version,
            **self.sizes(),
            "test_blur": str(test_blur),
            "sha256": self.digest,
        }


def remedy(root: str | None, name: str) -> str:
    """What to do about unreadable images of the data set `name`, as a sentence; `root` None: generated."""
    if root is None:
        return f"Delete {cache.folder(name)}: the data are generated anew."
    return "Restore them, or set data.skip_unreadable=true to leave them out."


def halves(samples: Sequence[Labelled]) -> tuple[list[Labelled], list[Labelled]]:
    """Validation and test halves of what was published as one test set, as the thesis authors' code draws them."""
    order = np.random.RandomState(SPLIT_SEED).choice(len(samples), len(samples), replace=False)
    shuffled = [samples[index] for index in order]
    return shuffled[: len(samples) // 2], shuffled[len(samples) // 2 :]


def read_splits(
    samples: Mapping[str, Sequence[Labelled]],
    faults: Sequence[DataError],
    *,
    side: int,
    test_blur: float,
    skip_unreadable: bool,
    remedy: str,
    left_out: str = "",
) -> Splits:
    """Read all images, those of the test split blurred by a Gaussian of `test_blur` pixels of the input.

    Args:
        faults: labels that could not be read; they count as unreadable images.
        remedy: what to do about unreadable images, as a sentence.
        left_out: what else is missing from the splits, for the complaint about an empty one.

    Raises:
        DataError: an angle is not finite, images cannot be read and are not to be skipped, or a split is empty.
    """
    _refuse_wrong_labels(samples)
    faults = list(faults)
    total = len(faults) + sum(map(len, samples.values()))
    in_memory = images.fit_in_memory(total, side, 3)
    tables = {}
    for split in SPLITS:
        chosen = samples[split]
        blur = test_blur if split == "test" else 0.0
        # whole, and squared by repeating the border
        crops = [Crop(sample.file, None, 0.0, side, blur=blur) for sample in chosen]
        angles = [[(a + math.pi) % (2 * math.pi) - math.pi for a in sample.angles] for sample in chosen]
        fields = {
            "target": torch.tensor(angles, dtype=torch.float32).reshape(len(chosen), -1 if chosen else 1),
            "group": torch.zeros(len(chosen), dtype=torch.int64),
        }
        tables[split], bad = images.load(crops, fields, f"the {split} images", in_memory=in_memory)
        faults += bad
    if faults and not skip_unreadable:
        raise DataError(images.fault_message(faults, total, remedy))
    for split, table in tables.items():
        if len(table) == 0:
            raise DataError(
                f"The {split} split is empty ({total} images in all, {len(faults)} unreadable{left_out}). "
                "Restore what is missing, or use other data."
            )
    return Splits(tables, len(faults), _digest(samples))


def own(file: Path, side: int) -> Crop:
    """A user's own image file, turned as its EXIF entry says."""
    return Crop(file, None, 0.0, side, upright=True)


def varied(batch: Batch, names: Sequence[str], mirrored: Sequence[str], jitter: float) -> Batch:
    """A training batch as `images.augmented` varies it; where `mirrored` names angles, half of it is mirrored too.

    `names` are the target's; the `mirrored` of them change their sign in a mirror image.
    """
    if not mirrored and not jitter:
        return batch
    chosen = (torch.rand(len(batch["target"])) < 0.5) & bool(mirrored)
    target: Tensor = batch["target"]
    signs = torch.tensor([-1.0 if name in mirrored else 1.0 for name in names]).to(target)
    return {
        **batch,
        "input": images.augmented(batch["input"], chosen, jitter),
        "target": torch.where(chosen.to(target.device)[:, None], target * signs, target),
    }


def _refuse_wrong_labels(samples: Mapping[str, Sequence[Labelled]]) -> None:
    wrong = [
        f"{sample.file}: {', '.join(map(str, sample.angles))}"
        for chosen in samples.values()
        for sample in chosen
        if not all(map(math.isfinite, sample.angles))
    ]
    if wrong:
        raise DataError(
            f"{len(wrong)} images have an angle that is not finite:{images.listed(wrong)}\n"
            "Mend these labels, or take the images out."
        )


def _digest(samples: Mapping[str, Sequence[Labelled]]) -> str:
    digest = hashlib.sha256()
    for split in SPLITS:
        for sample in samples[split]:
            digest.update(f"{split} {sample.file.name} {sample.angles}\n".encode())
    return digest.hexdigest()
