"""Scans of random people, computed when they are fetched."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from framework.bodies.body import BodyModel
from framework.bodies.people import BodyParameters
from framework.data import Batch
from framework.datasets.fields import FetchedInBatches
from framework.geometry import clouds
from framework.geometry.meshes import Mesh
from plugins.data.registration.scanned_bodies import normalise_scans
from plugins.data.registration.scanner import KINDS, Scanner, scan


class Scans(FetchedInBatches):
    """Bodies that are posed and scanned when they are fetched.

    Args:
        model: body model.
        people: shape and pose of every body, which `model` turns into vertices.
        kind: kind of every scan, as an index of KINDS.
        scanner: settings of the simulated scanner.
        seed: seed of the scans; a scan also depends on the number of its sample.
        precision: dtype of the targets.
    """

    def __init__(
        self,
        model: BodyModel,
        people: BodyParameters,
        kind: Tensor,
        scanner: Scanner,
        seed: tuple[int, int],
        precision: torch.dtype,
    ) -> None:
        self.model = model
        self.shape, self.pose = people
        self.kind = kind
        self.scanner = scanner
        self.seed = seed
        self.precision = precision

    def __len__(self) -> int:
        return len(self.shape)

    @torch.no_grad()
    def __getitems__(self, indices: Sequence[int]) -> Batch:
        chosen = torch.tensor(list(indices), dtype=torch.int64)
        vertices = self.model(self.shape[chosen], self.pose[chosen])
        faces = self.model.faces.numpy()
        points_of_scans = [
            scan(
                Mesh(f"body {index}", body_vertices.double().numpy(), faces),
                KINDS[int(self.kind[index])],
                self.scanner,
                np.random.default_rng([*self.seed, index]),
            )
            for index, body_vertices in zip(indices, vertices, strict=True)
        ]
        fields = normalise_scans(
            clouds.pad([torch.from_numpy(points).float() for points in points_of_scans]), vertices
        )
        fields["target"] = fields["target"].to(self.precision)
        return {**fields, "group": self.kind[chosen], "index": chosen}
