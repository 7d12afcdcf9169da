"""Folder of a data set's images: the unpacked archive, or synthetic heads in the cache in the archive's layout."""

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
    """Published data set, and a function that writes synthetic heads in its layout.

    Attributes:
        name: Name of the data set's folder in the cache.
        folder: Name of the folder that the archive unpacks to.
        parts: Entries of that folder; names of folders end in a slash.
        version: Version of `draw`. If the output of `draw` changes, increase it, so that a new folder is written.
        draw: Function of an empty folder, a number of images and a seed, which writes the images into the folder.
    """

    name: str
    folder: str
    parts: tuple[str, ...]
    version: int
    draw: Callable[[Path, int, int], None]


@dataclass(frozen=True)
class Source:
    """Source of the images: the user's folder or, if there is none, a folder of synthetic images in the cache.

    Attributes:
        archive: The published data set.
        root: The user's folder; None for synthetic images.
        images: Number of synthetic images.
        seed: Seed of the synthetic images.
    """

    archive: Archive
    root: str | None
    images: int
    seed: int

    def folder(self) -> Path:
        """Return the folder to read. A user's folder is checked; synthetic images are drawn if they do not exist yet.

        Raises:
            DataError: The user's folder is missing or lacks a part, or the cache cannot be written or holds other data
                under the same name.
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
        path = (
            cache.folder(self.archive.name)
            / f"v{version}.{heads_version}-seed{self.seed}-images{self.images}"
        )
        return generated.ensure_generated(
            path, mark, lambda root: self.archive.draw(root, self.images, self.seed)
        )

    def generated_in(self) -> Path | None:
        """Return the cache folder of the synthetic images; None for a user's folder."""
        return cache.folder(self.archive.name) if self.root is None else None

    def fingerprint(self, synthetic: bool) -> dict[str, str]:
        """Return the entries of `Data.fingerprint` that say where the images come from: "root" and "version".

        Args:
            synthetic: Whether the images are synthetic, in a user's folder or in the cache.
        """
        return {
            "root": f"synthetic, seed {self.seed}" if self.root is None else self.root,
            "version": f"generator {self.archive.version}" if synthetic else self.archive.folder,
        }

    def _check(self, root: Path) -> None:
        if not root.is_dir():
            raise DataError(
                f"data.root = {root} does not exist or is not a folder. Set data.root to the unpacked "
                f"{self.archive.folder}, or to null for synthetic images."
            )
        missing = [
            part
            for part in self.archive.parts
            if not ((root / part).is_dir() if part.endswith("/") else (root / part).is_file())
        ]
        if missing:
            raise wrong_layout(root, self.archive.folder, f"it holds no {', no '.join(missing)}")


def wrong_layout(root: Path, folder: str, fault: str) -> DataError:
    """Return the error for a root that does not have the layout of the archive.

    Args:
        root: The user's folder.
        folder: Name of the folder that the archive unpacks to.
        fault: Clause that says what is missing.
    """
    inner = root / folder
    remedy = f"Did you mean {inner}?" if inner.is_dir() else "Unpack the whole archive into this folder."
    return DataError(f"data.root = {root} does not have the layout of {folder}: {fault}. {remedy}")


def draw_train_and_test(
    root: Path,
    images: int,
    train_share: float,
    name: str,
    draw: Callable[[int], tuple[str, NDArray[np.uint8], Label]],
) -> dict[str, list[Label]]:
    """Write JPEG images into train/ and test/, and return the labels of each folder in the order of its images.

    Args:
        root: Folder to write into.
        images: Number of images.
        train_share: Share of the images that are for training; these are the first ones.
        name: Name of the data set in the progress bar.
        draw: Function that returns the name, the pixels and the label of the image with a given number.
    """
    train = round(train_share * images)
    labels: dict[int, Label] = {}
    for split in TRAIN_AND_TEST:
        (root / split).mkdir()

    def write(number: int) -> None:
        stem, pixels, labels[number] = draw(number)
        folder = root / ("train" if number < train else "test")
        Image.fromarray(pixels).save(folder / f"{stem}.jpg", quality=95)

    generated.draw_all(images, write, f"the synthetic {name} images")
    ordered = [labels[number] for number in range(images)]
    return {"train": ordered[:train], "test": ordered[train:]}
