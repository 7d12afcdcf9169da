"""An object's appearance as a closed curve through its views."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from torch import Tensor

FINE = 1440
"""The curve is tabulated at so many angles: every quarter of a degree."""


def spline_weights(views: int) -> Float[Tensor, "fine views"]:
    """Weigh equally spaced views so that row i is the periodic cubic spline through them at (i + 1/2)/FINE of a turn.

    (Murase & Nayar 1995, §2.2, there in an eigenspace; a spline is linear in its points, so the space is no matter.)
    """
    points = np.eye(views)
    spline = CubicSpline(np.arange(views + 1) / views, np.vstack([points, points[:1]]), bc_type="periodic")
    return torch.from_numpy(spline((np.arange(FINE) + 0.5) / FINE)).float()


def look_alikes(views: Float[Tensor, "object view 1 side side"]) -> Bool[Tensor, "object"]:
    """Find objects whose views half a turn apart are nearer (root mean square, on the mean) than neighbouring ones."""
    flat = views.flatten(2)
    half = (flat - flat.roll(flat.shape[1] // 2, 1)).square().mean(-1).sqrt().mean(-1)
    next_view = (flat - flat.roll(1, 1)).square().mean(-1).sqrt().mean(-1)
    return half < next_view
