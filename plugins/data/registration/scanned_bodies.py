"""Base class of the data sets of bodies: robustly normalised clouds, and the vertices of a mesh in the same frame."""

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
from framework.datasets.fields import Fields, fetch
from framework.errors import DataError
from framework.geometry import clouds
from framework.geometry.mesh_files import XYZ
from framework.geometry.meshes import READERS
from framework.target import Target


class Bodies(Data):
    """Scans of bodies, whose target is every vertex of a registered mesh.

    Inputs are clouds around the origin, with the robust normalisation of `framework.geometry.clouds`. Targets are in
    the same frame: x, y, z of vertex 0, then of vertex 1, and so on. The batch fields "centre" (batch, 3) and "scale"
    (batch,), metres, undo the normalisation: a point p lies at centre + scale · p. A subclass adds its constructor, its
    citation, `prepare`, `fingerprint` and `cloud`.
    """

    suffixes = tuple(READERS)
    varies = False
    columns = XYZ
    _splits: Splits

    @abstractmethod
    def cloud(self, file: Path) -> Float[Tensor, "points 3"]:
        """Return the points of a scan as the input of a model, metres, float32.

        Raises:
            DataError: the file cannot be read.
        """

    def splits(self) -> Splits:
        return self._splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        if not files:
            raise DataError("The list of files is empty; expected one or more scans of bodies.")
        padded = clouds.pad([self.cloud(file) for file in files])
        return Fields(**normalise_scans(padded), index=torch.arange(len(files)))

    def user_batch(self, user_data: Any) -> Batch:
        """Return the batch with a user's scans, normalised.

        Args:
            user_data: path or paths of files, or an array of one cloud or of several clouds, padded with NaN; metres.
        """
        files = [user_data] if isinstance(user_data, str | Path) else user_data
        if isinstance(files, Sequence) and files and all(isinstance(file, str | Path) for file in files):
            return fetch(self.read([Path(file) for file in files]), range(len(files)))
        clouds = as_inputs(user_data, self.input_shape)
        fields = normalise_scans(clouds if clouds.is_floating_point() else clouds.double())
        return {**fields, "input": fields["input"].float()}

    def inputs(self, user_data: Any) -> Tensor:
        return self.user_batch(user_data)["input"]

    def frame(self, batch: Batch) -> Frame:
        """Return the transform of targets into metres, in the coordinates of the scan."""
        vertices = len(self.target.names) // 3
        location = batch["centre"].repeat(1, vertices)
        return Frame(location, batch["scale"][:, None].expand_as(location))

    def augment(self, batch: Batch) -> Batch:
        return batch

    def preview(self, inputs: Tensor) -> np.ndarray:
        return cloud_picture.draw_cloud(inputs[..., [2, 0, 1]])  # the third axis of the figure points up


def target_of(vertices: int) -> Target:
    """Return the target of a mesh with this number of vertices: their coordinates."""
    return Target("real", tuple(f"{axis}{vertex}" for vertex in range(vertices) for axis in XYZ))


def normalise_scans(
    batch: Float[Tensor, "batch points columns"], vertices: Float[Tensor, "batch vertex 3"] | None = None
) -> Batch:
    """Return the fields "input", "centre" and "scale" of a batch of clouds; with `vertices`, also "target".

    Args:
        batch: clouds, metres, padded with NaN.
        vertices: vertices of the registered meshes, metres.
    """
    normalised_clouds = clouds.normalise_clouds(batch[..., :3], "robust")
    centre, scale = normalised_clouds.centre.float(), normalised_clouds.scale.float()
    fields = {"input": normalised_clouds.clouds, "centre": centre, "scale": scale}
    if vertices is not None:
        fields["target"] = ((vertices - centre[:, None]) / scale[:, None, None]).flatten(1)
    return fields
