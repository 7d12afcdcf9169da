"""Errors of the dense correspondences between scans that follow from templates registered to the scans."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.geometry.nearest import nearest


class Correspondence(NamedTuple):
    """Mean correspondence errors, centimetres, over pairs of different scans.

    `intra` is over pairs of scans of the same person, and `inter` over pairs of scans of two people. A mean is NaN if
    there is no such pair.
    """

    intra_cm: Tensor
    inter_cm: Tensor


def correspondence(
    truth: Float[Tensor, "scan point 3"],
    registered: Float[Tensor, "scan vertex 3"],
    subject: Int[Tensor, "scan"],
) -> Correspondence:
    """Return the errors of the correspondences between all ordered pairs of scans.

    A point of one scan is assigned to the nearest vertex of the template registered to that scan. Its predicted
    position on the other scan is the same vertex of the template registered to the other scan. The error is the
    distance from the predicted position to the true position (Bogo et al. 2014, §5; thesis §6.5.2).

    Args:
        truth: points that correspond across scans, metres: vertices of the true registrations, which lie on the scans.
        registered: predicted meshes, metres, which all have the same topology.
        subject: number of the person on each scan.
    """
    vertex = nearest(registered.float(), truth.float()).index
    total, count = torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for scan in range(len(truth)):
        # (scan, point, 3): positions of these vertices on the template of every scan
        predicted_points = registered[:, vertex[scan]].double()
        error = 100 * torch.linalg.vector_norm(predicted_points - truth.double(), dim=-1).mean(1)
        for kind, same in enumerate((True, False)):
            other_scans = (subject == subject[scan]) == same
            other_scans[scan] = False
            total[kind] += error[other_scans].sum()
            count[kind] += other_scans.sum()
    return Correspondence(*(total / count))
