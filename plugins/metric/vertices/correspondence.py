"""Dense correspondences between scans through registered templates, and how far off they are."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.geometry.nearest import nearest


class Correspondence(NamedTuple):
    """Mean error over pairs of different scans of one person, and of two people, centimetres; NaN without any."""

    intra_cm: Tensor
    inter_cm: Tensor


def correspondence(
    truth: Float[Tensor, "scan point 3"],
    registered: Float[Tensor, "scan vertex 3"],
    subject: Int[Tensor, "scan"],
) -> Correspondence:
    """Errors of all ordered pairs of scans.

    A point of one scan goes to the nearest vertex of the template registered to it, the same vertex of the template
    registered to the other scan is where it is thought to be there, and the error is the distance from there to where
    it is (Bogo et al. 2014, §5; thesis §6.5.2).

    Args:
        truth: points that correspond across scans, metres: vertices of the true registrations, which lie on the scans.
        registered: predicted meshes, metres, of any one topology.
        subject: who each scan is of.
    """
    place = nearest(registered.float(), truth.float()).index
    total, count = torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for one in range(len(truth)):
        # (scan, point, 3): where every other scan's template has those vertices
        thought = registered[:, place[one]].double()
        error = 100 * torch.linalg.vector_norm(thought - truth.double(), dim=-1).mean(1)
        for kind, same in enumerate((True, False)):
            others = (subject == subject[one]) == same
            others[one] = False
            total[kind] += error[others].sum()
            count[kind] += others.sum()
    return Correspondence(*(total / count))
