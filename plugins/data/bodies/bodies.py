"""What the data sets of bodies share: clouds normalised robustly, and every vertex of a mesh in the same frame."""

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Frame, Splits, as_inputs
from framework.datasets import cloud_picture
from framework.datasets.fields import Fields, fetched
from framework.errors import DataError
from framework.geometry import clouds
from framework.geometry.mesh_files import XYZ
from framework.geometry.meshes import READERS
from framework.target import Target


class Bodies(Data):
    """Scans of bodies, with every vertex of a registered mesh for target.

    Inputs are clouds about the origin, normalised robustly (geometry.clouds); targets are in the same frame, x, y, z of
    vertex 0, then of vertex 1, ...; "centre" (batch, 3) and "scale" (batch,), metres, lead back. A data set of the
    family adds its constructor, what to cite, `prepare`, `fingerprint` and `cloud`.
    """

    suffixes = tuple(READERS)
    varies = False
    columns = XYZ
    _splits: Splits

    @abstractmethod
    def cloud(self, file: Path) -> Float[Tensor, "points 3"]:
        """The points of a scan that are read, metres, float32.

        Raises:
            DataError: it cannot be read.
        """

    def splits(self) -> Splits:
        return self._splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        if not files:
            raise DataError("No file was given; wanted the scan of a body, or several.")
        found = clouds.pad([self.cloud(file) for file in files])
        return Fields(**normalised(found), index=torch.arange(len(files)))

    def asked(self, given: Any) -> Batch:
        """Of scans in metres: files, or an array of one cloud or of a batch, padded with NaN."""
        files = [given] if isinstance(given, str | Path) else given
        if isinstance(files, Sequence) and files and all(isinstance(file, str | Path) for file in files):
            return fetched(self.read([Path(file) for file in files]), range(len(files)))
        clouds = as_inputs(given, self.input_shape)
        found = normalised(clouds if clouds.is_floating_point() else clouds.double())
        return {**found, "input": found["input"].float()}

    def inputs(self, given: Any) -> Tensor:
        return self.asked(given)["input"]

    def frame(self, batch: Batch) -> Frame:
        """Metres, as the scan lies."""
        vertices = len(self.target.names) // 3
        location = batch["centre"].repeat(1, vertices)
        return Frame(location, batch["scale"][:, None].expand_as(location))

    def augment(self, batch: Batch) -> Batch:
        return batch

    def picture(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.picture(inputs[..., [2, 0, 1]])  # its third axis is up


def target_of(vertices: int) -> Target:
    """The coordinates of so many vertices."""
    return Target("real", tuple(f"{axis}{vertex}" for vertex in range(vertices) for axis in XYZ))


def normalised(
    batch: Float[Tensor, "batch points columns"], vertices: Float[Tensor, "batch vertex 3"] | None = None
) -> Batch:
    """The fields "input", "centre" and "scale" of clouds in metres, and with vertices, metres, "target"."""
    found = clouds.normalised(batch[..., :3], "robust")
    centre, scale = found.centre.float(), found.scale.float()
    fields = {"input": found.clouds, "centre": centre, "scale": scale}
    if vertices is not None:
        fields["target"] = ((vertices - centre[:, None]) / scale[:, None, None]).flatten(1)
    return fields
