"""The CAVIAR crops with partly hidden heads; the contract is framework.data's."""

import math
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
from plugins.data.head_pose.caviar.generator import VERSION, generate
from plugins.data.head_pose.caviar.labels import LABELS, check_root, read_labels
from plugins.data.head_pose.labelled_images import Labelled


class Caviar(Data):
    """Partly hidden heads of people in a shopping centre, and their gaze; generated where no root is given."""

    bibtex = """@misc{fisher2005caviar,
  author = {Fisher, Robert and Santos-Victor, Jose and Crowley, James},
  title = {{CAVIAR}: Context Aware Vision using Image-based Active Recognition},
  year = {2005}
}
@article{tosato2013characterizing,
  author = {Tosato, Diego and Spera, Mauro and Cristani, Marco and Murino, Vittorio},
  title = {Characterizing Humans on {Riemannian} Manifolds},
  journal = {IEEE Transactions on Pattern Analysis and Machine Intelligence},
  volume = {35},
  number = {8},
  pages = {1972--1984},
  year = {2013}
}"""
    target = Target("angle", ("gaze",))

    def __init__(
        self,
        *,
        root: str | None = None,
        image_size: Annotated[int, Field(ge=8, le=1024)] = 50,
        test_blur: Annotated[float, Field(ge=0, le=1024, allow_inf_nan=False)] = 0.0,
        jitter: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.08,
        skip_unreadable: bool = False,
        images: Annotated[int, Field(ge=20, le=1_000_000)] = 2400,
        generator_seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        self.root = root
        self.image_size = image_size
        self.test_blur = test_blur
        self.jitter = jitter
        self.skip_unreadable = skip_unreadable
        self.images = images
        self.generator_seed = generator_seed

    def prepare(self) -> None:
        if self.root is None:
            root = generate(self.images, self.generator_seed)
        else:
            root = Path(self.root).expanduser()
            check_root(root)
        self.input_shape = (3, self.image_size, self.image_size)
        self.groups = ("caviar",)
        self.synthetic = read_mark(root) is not None
        samples = {
            split: [
                Labelled(root / split / f"{label.name}.jpg", (math.radians(label.gaze),)) for label in found
            ]
            for split, found in read_labels(root / LABELS).items()
        }
        samples["validation"], samples["test"] = labelled_images.halves(samples["test"])
        self._splits = labelled_images.read_splits(
            samples,
            [],
            side=self.image_size,
            test_blur=self.test_blur,
            skip_unreadable=self.skip_unreadable,
            remedy=labelled_images.remedy(self.root, "caviar"),
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
        # No mirroring: the thesis authors' data hold no mirror images.
        return labelled_images.varied(batch, ("gaze",), (), self.jitter)

    def fingerprint(self) -> Mapping[str, str]:
        version = f"generator {VERSION}" if self.synthetic else "CAVIARShoppingCenterFullOccl"
        return self._splits.fingerprint(self.root, self.generator_seed, version, self.test_blur)

    def picture(self, inputs: Tensor) -> np.ndarray:
        return images.picture(inputs)
