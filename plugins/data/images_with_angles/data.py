"""Data set of a user's own images and angles; framework.data describes the contract."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath, Words
from framework.data import Batch, Data, Splits
from framework.datasets import given_images, images
from framework.datasets.csv_columns import Writing
from framework.datasets.file_columns import SPLITS
from framework.datasets.images import Crop
from framework.datasets.new_files import (
    LEFT_OUT,
    Trained,
    are_all_for_test,
    describe_tested_share,
    hash_contents,
    hash_files,
    leave_out_trained,
    restore_trained,
)
from framework.errors import DataError, did_you_mean
from framework.storage.names import spell_name
from framework.target import Target
from plugins.data.images_with_angles.table import Table, read_table


class ImagesWithAngles(Data):
    """A user's own folder of images, with a CSV table of their angles.

    Args:
        root: Folder of the images.
        csv: Path of the table, relative to `root`.
        angle_columns: Columns of the table to predict, in this order; None for every column of numbers.
        angles_in: Unit of the angles in the table; None means degrees, and a column that looks like radians is refused.
        image_size: Side of the square inputs, pixels.
        grayscale: Whether images are read in grey.
        mirror: Angles that change sign in a mirror image; if it names any, half of the training images are mirrored.
        jitter: Largest share by which training images are shifted, scaled and made brighter or darker.
        skip_unreadable: Whether images that cannot be read are left out and counted; otherwise they are an error.
        test: 1 makes all images test images, for a model that was trained on other images; None: a column `split` of
            the table, or a hash of the names, states which images are for the test.
        writing: Notation of the table: separator, decimal sign and the like.
    """

    bibtex = "images_with_angles"

    suffixes = images.SUFFIXES

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        *,
        root: FilePath | None = None,
        csv: str = "angles.csv",
        angle_columns: list[Words] | None = None,
        angles_in: Literal["degrees", "radians"] | None = None,
        image_size: Annotated[int, Field(ge=8, le=1024)] = 48,
        grayscale: bool = False,
        mirror: list[Words] | None = None,
        jitter: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.08,
        skip_unreadable: bool = False,
        test: Literal[1] | None = None,
        writing: Writing,
    ) -> None:
        self.root = root
        self.csv = csv
        self.angle_columns = angle_columns
        self.angles_in: Literal["degrees", "radians"] | None = angles_in
        self.image_size = image_size
        self.channels = 1 if grayscale else 3
        self.mirror = tuple(mirror or ())
        self.jitter = jitter
        self.varies = bool(mirror) or jitter > 0
        self.skip_unreadable = skip_unreadable
        self.test: Literal[1] | None = test
        self._trained: Trained | None = None
        self._own = Trained()
        self.writing = writing

    def prepare(self) -> None:
        root, table = self._labels()
        self.remarks = table.remarks
        for name in self.mirror:
            if name not in table.columns:
                raise DataError(
                    f"data.mirror names {name!r}, which is not an angle of the table."
                    f"{did_you_mean(name, table.columns)} The angles are {', '.join(table.columns)}."
                )
        self.target = Target("angle", table.columns)
        self.input_shape = (self.channels, self.image_size, self.image_size)
        self.groups = (spell_name(root.resolve().name),)
        self.synthetic = False
        self._signs = [-1.0 if name in self.mirror else 1.0 for name in table.columns] if self.mirror else []
        table = self._choose_test_rows(root, table)
        self._digest = hashlib.sha256(repr((table.columns, table.rows)).encode()).hexdigest()
        chosen = {split: [row for row in table.rows if row.split == split] for split in SPLITS}
        self._tables, self.skipped = images.load_splits(
            {split: [self._crop(root / row.file) for row in rows] for split, rows in chosen.items()},
            {
                split: images.angle_fields([row.angles for row in rows], table.columns)
                for split, rows in chosen.items()
            },
            skip_unreadable=self.skip_unreadable,
        )
        for split, samples in self._tables.items():
            if len(samples) == 0 and (self._trained is None or split == "test"):
                raise DataError(
                    f"The {split} split is empty ({len(table.rows)} images in all, {self.skipped} unreadable). Add "
                    f"images, or assign each image to {', '.join(SPLITS)} in a column `split` of the table."
                )

    def _choose_test_rows(self, root: Path, table: Table) -> Table:
        """Return the table with the rows that are used, and note its content.

        If `test` is 1, all rows are in the test split. Test rows of a further folder whose images the model was trained
        on are left out.
        """
        content = hash_files(root, [row.file for row in table.rows], [row.angles for row in table.rows])
        chosen = np.array([row.split for row in table.rows])
        stated = chosen if table.states_splits else np.full(len(chosen), "")
        if are_all_for_test(stated, float(self.test or 0), self._trained, content, root):
            chosen = np.full(len(chosen), "test")
        hashes = hash_contents(root / row.file for row in table.rows)
        splits, left_out = leave_out_trained(stated, chosen, hashes, self._trained, content, root)
        self._own = Trained.on(content, (), hashes, splits)
        self.remarks += (*describe_tested_share(stated, splits, self._trained, content, root), *left_out)
        pairs = zip(table.rows, splits.tolist(), strict=True)
        return table._replace(rows=[row._replace(split=split) for row, split in pairs if split != LEFT_OUT])

    def state_dict(self) -> Mapping[str, Any]:
        return (self._trained or self._own).state()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._trained = restore_trained(state, type(self).__name__)

    def _labels(self) -> tuple[Path, Table]:
        """Return the folder of the images, and the table of angles in it."""
        if self.root is None:
            raise DataError(
                "data.root is not set. Set data.root to the folder that holds your images and their table."
            )
        root = Path(self.root).expanduser()
        if not root.is_dir():
            raise DataError(
                f"data.root = {root} does not exist or is not a folder. Set data.root to the folder of your images."
            )
        return root, read_table(root / self.csv, self.angle_columns, self.angles_in, self.writing)

    def check_files(self) -> None:
        self._labels()

    def _crop(self, file: Path) -> Crop:
        return Crop(file, None, 0.0, self.image_size, self.channels, upright=True)

    def splits(self) -> Splits:
        return Splits(**self._tables)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return images.load_unlabelled([self._crop(Path(file)) for file in files])

    def inputs(self, user_data: Any) -> Tensor:
        return given_images.to_inputs(self, user_data)

    def augment(self, batch: Batch) -> Batch:
        return images.vary(batch, self._signs, self.jitter)

    def fingerprint(self) -> Mapping[str, str]:
        sizes = {split: str(len(table)) for split, table in self._tables.items()}
        return {"root": str(self.root), "version": self.csv, **sizes, "sha256": self._digest}

    def preview(self, inputs: Tensor) -> np.ndarray:
        return images.to_rgb8(inputs)
