"""Reading of labelled images: folders named by class, a table of labels, or idx files."""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Int, UInt8
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field
from torch import Tensor

from framework.configuration.paths import Words
from framework.datasets.class_folders import describe_layouts, list_files
from framework.datasets.class_names import compare_classes
from framework.datasets.csv_columns import MISSING
from framework.datasets.fields import Fields
from framework.datasets.file_columns import FILE, SPLIT, SPLITS, read_file_columns
from framework.datasets.file_columns import list_files as list_rows
from framework.datasets.images import MODES, SUFFIXES, Crop, Crops, cut_square, load_splits
from framework.datasets.new_files import (
    TestShare,
    Trained,
    are_all_for_test,
    describe_tested_share,
    hash_array,
    hash_contents,
    hash_files,
    index_labels,
    leave_out_trained,
)
from framework.datasets.shares import check_shares, choose_splits
from framework.errors import DataError, count_of, did_you_mean, quote, shorten
from plugins.data.image_folder.idx import Pair, find_pairs, read_pair

LABEL = "label"
"""Name of the column of classes in a table."""
TEST_NAMES = ("t10k", "test")
"""Beginnings of the names of idx files that hold the test split, if there is a file of the training split."""
Share = Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)]
MakeFields = Callable[[Int[Tensor, "samples"], str], Mapping[str, Tensor]]
"""Function that returns the further fields of a split from the classes of its samples and the name of the split."""


class Listed(NamedTuple):
    """Labelled images before they are read into memory.

    Attributes:
        names: Name of each image: the path of its file relative to the folder, or a number in an idx file.
        labels: Name of the class of each image.
        splits: Split of each image; "" if it is to be chosen at random.
        pixels: Images of idx files; None if `names` are paths of files.
        remarks: Clauses about files and columns that are not read.
    """

    names: list[str]
    labels: list[str]
    splits: NDArray
    pixels: list[UInt8[np.ndarray, "height width"]] | None = None
    remarks: tuple[str, ...] = ()


class Loaded(NamedTuple):
    """Labelled images in three splits.

    Attributes:
        classes: Names of the classes.
        splits: Name of each split with its data set, which has "input", "index" and the fields that the argument
            `make_fields` of `load` returned.
        skipped: Number of images that cannot be read.
        remarks: Clauses about files and columns that are not read.
        digest: Hash of names, classes, splits and, for idx files, pixels.
        own: What a model that is trained on the images stores about them.
        tested: Index of the class of each test image, also of those that cannot be read.
    """

    classes: tuple[str, ...]
    splits: dict[str, Fields | Crops]
    skipped: int
    remarks: tuple[str, ...]
    digest: str
    own: Trained
    tested: NDArray


@dataclass(frozen=True, kw_only=True)
class LabelledImages:
    """Settings of labelled images.

    Attributes:
        csv: Path of a table with the columns `file`, `label` and perhaps `split`, relative to the folder of the images;
            None: folders or idx files state the classes.
        classes: Names of the classes to read; None for all.
        validation: Share of the images for validation, equal in every class, if no folder or column states which images
            are for validation.
        test: Share of the images for the test, equal in every class, if no folder, file or column states which images
            are for the test; 1 makes all images test images, for a model that was trained on other images.
        data_seed: Seed of the splits, independent of the seed of the run.
        image_size: Side of the square inputs, pixels.
        grayscale: Whether images are read in grey.
        unreadable: Treatment of files that cannot be read. "error" refuses them, "skip" leaves them out.
    """

    csv: str | None = None
    classes: list[Words] | None = None
    validation: Share = 0.15
    test: TestShare = 0.15
    data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    image_size: Annotated[int, Field(ge=8, le=1024)] = 48
    grayscale: bool = False
    unreadable: Literal["error", "skip"] = "error"

    @property
    def input_shape(self) -> tuple[int, int, int]:
        return (1 if self.grayscale else 3, self.image_size, self.image_size)

    def list_images(self, root: Path, fewest: int, *, test_only: bool = False) -> Listed:
        """Return the chosen images of a folder, of at least `fewest` classes, with their classes and splits.

        With `test_only`, images of the test split suffice.

        Raises:
            DataError: The table or an idx file is missing or damaged, the folder has another layout, a class is
                unknown, or there are fewer classes than `fewest`.
        """
        check_shares(self.validation, self.test)
        if self.csv is not None:
            listed = _list_table(root, root / self.csv)
        elif pairs := find_pairs(root):
            listed = _list_idx(pairs)
        else:
            try:
                files = list_files(root, SUFFIXES, fewest, test_only=test_only)
            except DataError as error:
                tables = sorted(path.name for path in root.glob("*.csv")) if root.is_dir() else []
                if not tables:
                    raise
                raise DataError(
                    f"{error} If {quote(tables[0])} is a table of labels, set data.csv={tables[0]}."
                ) from error
            listed = Listed(
                [path.relative_to(root).as_posix() for path in files.files],
                [files.classes[label] for label in files.labels],
                files.splits,
                remarks=(f"left out: {count_of(files.ignored, 'file')} of other kinds",)
                if files.ignored
                else (),
            )
        listed = self._select(root, listed)
        classes = set(listed.labels)
        if len(classes) < fewest:
            raise DataError(
                f"{root}: There are images of {len(classes)} classes, but at least {fewest} are required. Add images, "
                "or correct data.classes."
            )
        return listed

    def _select(self, root: Path, listed: Listed) -> Listed:
        """Return only the images of the chosen classes, with a remark about classes of similar names."""
        names = sorted(set(listed.labels))
        for name in self.classes or ():
            if name not in names:
                raise DataError(
                    f"data.classes names {quote(name)}, which {root} does not hold.{did_you_mean(name, names)} "
                    f"The classes there are {shorten(', '.join(names))}."
                )
        wanted = names if self.classes is None else set(self.classes)
        kept = [index for index, label in enumerate(listed.labels) if label in wanted]
        place = str(root if self.csv is None else root / self.csv)
        return listed._replace(
            remarks=(*listed.remarks, *compare_classes(wanted, place)),
            names=[listed.names[index] for index in kept],
            labels=[listed.labels[index] for index in kept],
            splits=listed.splits[kept],
            pixels=None if listed.pixels is None else [listed.pixels[index] for index in kept],
        )

    def load(
        self, root: Path, make_fields: MakeFields, fewest: int, trained: Trained | None = None
    ) -> Loaded:
        """Read the images and return them in three splits.

        Args:
            root: Folder of the images.
            make_fields: Function that returns further fields of a split from the classes of its samples and its name.
            fewest: Smallest number of classes.
            trained: What a trained model stores about its images; None without one. A trained model needs no images of
                other splits than the test split, and not all of its classes.

        Raises:
            DataError: An image cannot be read and `unreadable` is "error", a split is empty, a class has no training
                image, there are fewer classes than `fewest`, or the trained model does not know a class.
        """
        listed = self.list_images(root, fewest if trained is None else 1, test_only=trained is not None)
        classes, labels = index_labels(listed.labels, trained, root)
        content = _hash(root, listed)
        random = np.random.default_rng(self.data_seed)
        if are_all_for_test(listed.splits, self.test, trained, content, root):
            splits = np.full(len(labels), "test")
        else:
            splits = choose_splits(listed.splits, labels, self.validation, self.test, random)
        hashes = _hash_each(root, listed)
        splits, left_out = leave_out_trained(listed.splits, splits, hashes, trained, content, root)
        remarks = (*describe_tested_share(listed.splits, splits, trained, content, root), *left_out)
        indices = {split: np.flatnonzero(splits == split) for split in SPLITS}
        self._check_splits(root, classes, labels, indices, trained)
        fields = {
            split: make_fields(torch.from_numpy(labels[chosen]), split) for split, chosen in indices.items()
        }
        skipped, digest = 0, hashlib.sha256()
        if listed.pixels is None:
            crops = {
                split: [self.crop(root / listed.names[i]) for i in chosen]
                for split, chosen in indices.items()
            }
            tables, skipped = load_splits(
                crops,
                fields,
                skip_unreadable=self.unreadable == "skip",
                skip_setting="data.unreadable=skip",
            )
        else:
            tables = {}
            for split, chosen in indices.items():
                squares = torch.empty((len(chosen), *self.input_shape), dtype=torch.uint8)
                for row, index in enumerate(chosen):
                    squares[row] = self._square(listed.pixels[index])
                tables[split] = Fields(input=squares, **fields[split], index=torch.arange(len(chosen)))
                digest.update(squares.numpy().tobytes())
        digest.update(repr((listed.names, listed.labels, splits.tolist())).encode())
        own = Trained.on(content, classes, hashes, splits)
        remarks = (*listed.remarks, *remarks)
        return Loaded(classes, tables, skipped, remarks, digest.hexdigest(), own, labels[splits == "test"])

    @staticmethod
    def _check_splits(
        root: Path,
        classes: Sequence[str],
        labels: NDArray,
        indices: Mapping[str, NDArray],
        trained: Trained | None,
    ) -> None:
        for split, chosen in indices.items():
            if not len(chosen) and (trained is None or split == "test"):
                remedy = "Add images." if split == "train" else f"Add images, or increase data.{split}."
                raise DataError(f"{root}: The {split} split is empty ({len(labels)} images in all). {remedy}")
        missing = set(range(len(classes))) - set(labels[indices["train"]].tolist())
        if missing and trained is None:
            raise DataError(
                f"{root}: The class {quote(classes[min(missing)])} has no training image, but every class needs one. "
                "Add images."
            )

    def crop(self, file: Path) -> Crop:
        """Return the settings that read an image file as an input: the whole image, made square and scaled."""
        channels, side, _ = self.input_shape
        return Crop(file, None, 0.0, side, channels, upright=True)

    def _square(self, pixels: UInt8[np.ndarray, "height width"]) -> UInt8[Tensor, "channels side side"]:
        channels, side, _ = self.input_shape
        image = Image.fromarray(pixels).convert(MODES[channels])
        square = cut_square(image, (0.0, 0.0, float(image.width), float(image.height)), 0.0, side)
        assert square is not None  # `read_pair` refuses images without pixels
        return torch.from_numpy(square)


def _hash(root: Path, listed: Listed) -> str:
    """Return a hash of images and labels, without splits."""
    if listed.pixels is None:
        return hash_files(root, listed.names, listed.labels)
    digest = hashlib.sha256(repr(listed.labels).encode())
    for pixels in listed.pixels:
        digest.update(pixels.tobytes())
    return digest.hexdigest()


def _hash_each(root: Path, listed: Listed) -> list[str]:
    """Return a hash of each image, whatever its name and label."""
    if listed.pixels is None:
        return hash_contents(root / name for name in listed.names)
    return [hash_array(pixels) for pixels in listed.pixels]


def find_folder(root: str | None) -> Path:
    """Return the folder that the setting `data.root` names.

    Raises:
        DataError: The setting is not set, or there is no such folder.
    """
    remedy = f"{describe_layouts(SUFFIXES)} Idx files are read too, and data.csv names a table of labels."
    if root is None:
        raise DataError(f"data.root is not set. {remedy}")
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise DataError(f"data.root = {folder} does not exist or is not a folder. {remedy}")
    return folder


def _list_table(root: Path, file: Path) -> Listed:
    """Return the images that a table lists."""
    table = read_file_columns(
        file,
        None,
        f"expected a table with the columns `{FILE}` and `{LABEL}`. Write such a table, or set data.csv to the path of "
        "another table.",
    )
    if LABEL not in table.cells:
        raise DataError(
            f"{file} has no column `{LABEL}`.{did_you_mean(LABEL, table.cells)} Its first line names "
            f"{shorten(', '.join(table.cells))}. Name the column of the classes `{LABEL}`."
        )
    labels = table.cells[LABEL]
    for line, label in zip(table.lines, labels, strict=True):
        if label.lower() in MISSING:
            raise DataError(
                f"{file} line {line}: The column `{LABEL}` is {quote(label)}. Write the name of a class there, or "
                "remove the line."
            )
    rows = list(list_rows(table))
    unread = [name for name in table.cells if name not in (FILE, LABEL, SPLIT)]
    return Listed(
        [name for name, _ in rows],
        labels,
        np.array([split or "" for _, split in rows], "<U10"),
        remarks=(f"left out: the columns {shorten(', '.join(unread))} of {file.name}",) if unread else (),
    )


def _list_idx(pairs: Sequence[Pair]) -> Listed:
    """Return the images of idx files; files of the test split are recognised by their names."""
    counts = Counter(pair.name.startswith(TEST_NAMES) for pair in pairs)
    names, labels, pixels, splits = [], [], [], []
    for pair in pairs:
        images, numbers = read_pair(pair)
        names += [f"{pair.name}{index:05d}" for index in range(len(images))]
        labels += [str(number) for number in numbers]
        pixels += list(images)
        for_test = pair.name.startswith(TEST_NAMES)
        # without files of a training split, all images are split at random
        split = ("test" if for_test else "train") if len(counts) == 2 else ""
        splits += [split] * len(images)
    return Listed(names, labels, np.array(splits, "<U10"), pixels)
