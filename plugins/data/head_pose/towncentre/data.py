"""The TownCentre heads; the contract is framework.data's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data
from framework.datasets import images
from framework.storage.generated import read_mark
from framework.target import Target
from plugins.data.head_pose import labelled_images
from plugins.data.head_pose.towncentre.generator import VERSION, generate
from plugins.data.head_pose.towncentre.labels import by_person, find_heads


class TownCentre(Data):
    """Heads of pedestrians seen by a surveillance camera, and their pan; generated where no root is given.

    Attributes:
        invalid: how many heads their label marks as not valid, which are left out; set by `prepare`.
    """

    bibtex = """@inproceedings{benfold2009guiding,
  author = {Benfold, Ben and Reid, Ian},
  title = {Guiding Visual Surveillance by Tracking Human Attention},
  booktitle = {British Machine Vision Conference (BMVC)},
  year = {2009}
}
@inproceedings{beyer2015biternion,
  author = {Beyer, Lucas and Hermans, Alexander and Leibe, Bastian},
  title = {Biternion Nets: Continuous Head Pose Regression from Discrete Training Labels},
  booktitle = {German Conference on Pattern Recognition},
  year = {2015}
}"""
    target = Target("angle", ("pan",))

    def __init__(
        self,
        *,
        root: str | None = None,
        image_size: Annotated[int, Field(ge=8, le=1024)] = 50,
        test_blur: Annotated[float, Field(ge=0, le=1024, allow_inf_nan=False)] = 0.0,
        mirror: bool = True,
        jitter: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.08,
        skip_unreadable: bool = False,
        images: Annotated[int, Field(ge=200, le=1_000_000)] = 2400,
        generator_seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        self.root = root
        self.image_size = image_size
        self.test_blur = test_blur
        self.mirror = mirror
        self.jitter = jitter
        self.skip_unreadable = skip_unreadable
        self.images = images
        self.generator_seed = generator_seed

    def prepare(self) -> None:
        if self.root is None:
            root = generate(self.images, self.generator_seed)
        else:
            root = Path(self.root).expanduser()
        self.input_shape = (3, self.image_size, self.image_size)
        self.groups = ("towncentre",)
        heads, self.invalid, faults = find_heads(root)
        self.synthetic = read_mark(root) is not None
        self._splits = labelled_images.read_splits(
            by_person(heads),
            faults,
            side=self.image_size,
            test_blur=self.test_blur,
            skip_unreadable=self.skip_unreadable,
            remedy=labelled_images.remedy(self.root, "towncentre"),
            left_out=f", {self.invalid} marked as not valid",
        )
        self.skipped = self._splits.skipped

    def train(self) -> Dataset[Batch]:
        return self._splits.tables["train"]

    def validation(self) -> Dataset[Batch]:
        return self._splits.tables["validation"]

    def test(self) -> Dataset[Batch]:
        return self._splits.tables["test"]

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return images.unlabelled([labelled_images.own(Path(file), self.image_size) for file in files])

    def augment(self, batch: Batch) -> Batch:
        # The mirror image of a head at pan p shows one at -p, 360° - p in the words of Beyer et al.
        return labelled_images.varied(batch, ("pan",), ("pan",) if self.mirror else (), self.jitter)

    def fingerprint(self) -> Mapping[str, str]:
        version = f"generator {VERSION}" if self.synthetic else "TownCentreHeadImages"
        return self._splits.fingerprint(self.root, self.generator_seed, version, self.test_blur)

    def picture(self, inputs: Tensor) -> np.ndarray:
        return images.picture(inputs)
