"""Data set COIL-20, real objects on a turntable; framework.data describes the contract."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath
from framework.data import Batch, Data, Splits
from framework.datasets import given_images, images
from framework.datasets.fields import Fields
from framework.datasets.images import Crop
from framework.target import Target
from plugins.data.coil20.manifold import look_alikes, spline_weights
from plugins.data.coil20.views import STEP_DEG, VIEWS, find_views, read_views

GROUPS = ("unique", "look-alikes")


class COIL20(Data):
    """Columbia Object Image Library: 20 objects seen every 5° of a turntable (Nene, Nayar & Murase 1996).

    The views at multiples of `every` degrees are for training. Between two neighbouring training views, the view in the
    middle (or just before the middle) is for validation, and all others are for the test. The model must therefore
    interpolate between views. With `interpolate`, training batches show the objects at random angles. These images are
    interpolated by the objects' appearance manifolds, which are periodic cubic splines through the training views
    (Murase & Nayar 1995).

    Results are also reported separately for the objects that look nearly the same from two opposite sides. For these
    objects, two training views 180° apart are on average more similar than two neighbouring training views.

    Args:
        root: Folder that holds COIL20.mat or the processed images, or the path of COIL20.mat.
        every: Degrees between two training views.
        image_size: Side of the images, pixels.
        interpolate: Whether training batches show interpolated views.
        jitter: Largest share by which training images are shifted, scaled and made brighter or darker.
    """

    bibtex = "nene1996coil20"

    suffixes = images.SUFFIXES

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        every: Literal[15, 20, 30, 40, 45, 60, 90] = 20,
        image_size: Annotated[int, Field(ge=8, le=128)] = 32,
        interpolate: bool = True,
        jitter: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.05,
    ) -> None:
        self.root = root
        self.every = every
        self.image_size = image_size
        self.interpolate = interpolate
        self.jitter = jitter
        self.varies = interpolate or jitter > 0

    def check_files(self) -> None:
        find_views(self.root)

    def prepare(self) -> None:
        views = read_views(self.root, self.image_size)  # (object, view, 1, side, side)
        stride = self.every // STEP_DEG
        index = torch.arange(VIEWS)
        split = torch.where(index % stride == 0, 0, torch.where(index % stride == stride // 2, 1, 2))
        training = views[:, split == 0].float()
        alike = look_alikes(training)
        self.target = Target("angle", ("azimuth",))
        self.input_shape = (1, self.image_size, self.image_size)
        self.groups = GROUPS
        self.synthetic = False
        self.skipped = 0
        self._tables = {
            name: self._table(views, alike, split == number) for number, name in enumerate(Splits._fields)
        }
        self._training = training
        self._weights = spline_weights(VIEWS // stride)
        self._alike = [number + 1 for number in alike.nonzero()[:, 0].tolist()]
        self._digest = hashlib.sha256(views.numpy().tobytes()).hexdigest()

    def _table(self, views: Tensor, alike: Tensor, chosen: Tensor) -> Fields:
        """Return the samples of the views where `chosen` (view,) is true, for all objects."""
        objects, count = len(views), int(chosen.sum())
        azimuth = torch.arange(VIEWS)[chosen] * math.radians(STEP_DEG)
        azimuth = torch.where(azimuth >= math.pi, azimuth - 2 * math.pi, azimuth)
        object_index = torch.arange(objects).repeat_interleave(count)
        return Fields(
            input=views[:, chosen].flatten(0, 1),
            target=azimuth.float().repeat(objects)[:, None],
            group=alike.long()[object_index],
            object=object_index,
            index=torch.arange(objects * count),
        )

    def splits(self) -> Splits:
        return Splits(**self._tables)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return images.load_unlabelled(
            [Crop(Path(file), None, 0.0, self.image_size, 1, upright=True) for file in files]
        )

    def inputs(self, user_data: Any) -> Tensor:
        return given_images.to_inputs(self, user_data)

    def augment(self, batch: Batch) -> Batch:
        if self.interpolate:
            batch = self._interpolate(batch)
        if not self.jitter:
            return batch
        no_mirror = torch.zeros(len(batch["target"]), dtype=torch.bool)
        return {**batch, "input": images.augment(batch["input"], no_mirror, self.jitter)}

    def _interpolate(self, batch: Batch) -> Batch:
        """Return the batch with each object rotated by a random angle, at most half the step between training views."""
        target = batch["target"]
        shift = (torch.rand(len(target), 1, device=target.device) - 0.5) * math.radians(self.every)
        azimuth = target + shift
        share_of_turn = torch.remainder(azimuth[:, 0].double() / (2 * math.pi), 1.0)
        row = (share_of_turn * len(self._weights)).long().clamp(max=len(self._weights) - 1).cpu()
        views = self._training[batch["object"].cpu()]
        interpolated = torch.einsum("bv,bvchw->bchw", self._weights[row], views).clamp(0, 255).round()
        return {
            **batch,
            "input": interpolated.to(batch["input"].dtype).to(batch["input"].device),
            "target": torch.where(azimuth >= math.pi, azimuth - 2 * math.pi, azimuth),
        }

    def fingerprint(self) -> Mapping[str, str]:
        return {
            "root": str(self.root),
            "version": "COIL-20",
            **{name: str(len(table)) for name, table in self._tables.items()},
            "look_alikes": " ".join(map(str, self._alike)),
            "sha256": self._digest,
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return images.to_rgb8(inputs)
