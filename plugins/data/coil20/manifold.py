"""Appearance manifold of an object: a closed curve through its views."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from torch import Tensor

FINE = 1440
"""Number of angles at which the curve is tabulated: one for every quarter of a degree."""


def spline_weights(views: int) -> Float[Tensor, "fine views"]:
    """Return weights of equally spaced views: row i is the periodic cubic spline at (i + 1/2)/FINE of a turn.

    (Murase & Nayar 1995, §2.2, there in an eigenspace. A spline is linear in its points, so the choice of space does
    not change it.)
    """
    points = np.eye(views)
    spline = CubicSpline(np.arange(views + 1) / views, np.vstack([points, points[:1]]), bc_type="periodic")
    return torch.from_numpy(spline((np.arange(FINE) + 0.5) / FINE)).float()


def look_alikes(views: Float[Tensor, "object view 1 side side"]) -> Bool[Tensor, "object"]:
    """Return which objects have views half a turn apart that are closer than neighbouring ones (mean RMS)."""
    flat = views.flatten(2)
    half = (flat - flat.roll(flat.shape[1] // 2, 1)).square().mean(-1).sqrt().mean(-1)
    next_view = (flat - flat.roll(1, 1)).square().mean(-1).sqrt().mean(-1)
    return half < next_view
