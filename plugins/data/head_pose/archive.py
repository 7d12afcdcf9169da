"""Folder of a data set's images: the unpacked archive, or one drawn into the cache in the archive's layout."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from framework.errors import DataError
from framework.storage import cache, generated
from plugins.data.head_pose import synthetic_heads

TRAIN_AND_TEST = ("train", "test")
"""Folders of the archives that are published in two splits."""
Label = TypeVar("Label")


class Archive(NamedTuple):
    """Published data set, and a function that draws heads in its layout.

    Attributes:
        name: name of its folder in the cache.
        folder: name of the folder that the archive unpacks to.
        parts: entries of that folder; names of folders end in a slash.
        version: version of `draw`; a change in what it draws or writes takes a new number, and thus a new folder.
        draw: function that writes the given number of images, drawn from a seed, into an empty folder.
    """

    name: str
    folder: str
    parts: tuple[str, ...]
    version: int
    draw: Callable[[Path, int, int], None]


@dataclass(frozen=True)
class Source:
    """User's folder `root` or, if it is None, a folder with the given number of images drawn from a seed."""

    archive: Archive
    root: str | None
    images: int
    seed: int

    def folder(self) -> Path:
        """Return the folder to read: the user's, which is checked, or one whose images are drawn unless they are there.

        Raises:
            DataError: the user's folder is missing or lacks a part, or the cache cannot be written or holds something
                else in its place.
        """
        if self.root is not None:
            root = Path(self.root).expanduser()
            self._check(root)
            return root
        version, heads_version = self.archive.version, synthetic_heads.VERSION
        mark = {
            "generator_version": version,
            "heads_version": heads_version,
            "images": self.images,
            "seed": self.seed,
        }
        place = (
            cache.folder(self.archive.name)
            / f"v{version}.{heads_version}-seed{self.seed}-images{self.images}"
        )
        return generated.generated(place, mark, lambda root: self.archive.draw(root, self.images, self.seed))

    def generated_in(self) -> Path | None:
        """Return the cache folder of drawn images; None for a user's folder."""
        return cache.folder(self.archive.name) if self.root is None else None

    def fingerprint(self, synthetic: bool) -> dict[str, str]:
        return {
            "root": f"synthetic, seed {self.seed}" if self.root is None else self.root,
            "version": f"generator {self.archive.version}" if synthetic else self.archive.folder,
        }

    def _check(self, root: Path) -> None:
        if not root.is_dir():
            raise DataError(
                f"data.root = {root}: no such folder; wanted the unpacked {self.archive.folder}, or null."
            )
        missing = [
            part
            for part in self.archive.parts
            if not ((root / part).is_dir() if part.endswith("/") else (root / part).is_file())
        ]
        if missing:
            raise wrong_layout(root, self.archive.folder, ", no ".join(missing))


def wrong_layout(root: Path, folder: str, missing: str) -> DataError:
    """Return the error for a root that does not hold what the archive unpacks to `folder`."""
    inner = root / folder
    hint = f"Did you mean {inner}?" if inner.is_dir() else "Unpack the whole archive there."
    return DataError(f"data.root = {root} is not laid out as {folder}: no {missing}. {hint}")


def draw_train_and_test(
    root: Path,
    images: int,
    train_share: float,
    what: str,
    draw: Callable[[int], tuple[str, NDArray[np.uint8], Label]],
) -> dict[str, list[Label]]:
    """Write JPEG images into train/ and test/, and return the labels of both in the images' order.

    Args:
        root: folder to write into.
        images: number of images.
        train_share: share of the images, the first ones, that are for training.
        what: name of the images in the progress bar.
        draw: function that returns name, pixels and label of an image by its number.
    """
    train = round(train_share * images)
    labels: dict[int, Label] = {}
    for split in TRAIN_AND_TEST:
        (root / split).mkdir()

    def write(number: int) -> None:
        name, pixels, labels[number] = draw(number)
        folder = root / ("train" if number < train else "test")
        Image.fromarray(pixels).save(folder / f"{name}.jpg", quality=95)

    generated.draw_all(images, write, f"the synthetic {what} images")
    ordered = [labels[number] for number in range(images)]
    return {"train": ordered[:train], "test": ordered[train:]}
