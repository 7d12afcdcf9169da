"""Appearance manifold of an object: a closed curve through its views."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from torch import Tensor

FINE = 1440
"""Number of angles at which the curve is tabulated, one every 0.25°."""


def spline_weights(views: int) -> Float[Tensor, "fine views"]:
    """Return the weights with which equally spaced views are summed to interpolated images.

    Row i holds the weights of the views for the image at the angle 360° · (i + 1/2) / FINE. The weights define a
    periodic cubic spline through the views (Murase & Nayar 1995, §2.2, where the spline lies in an eigenspace). A
    spline is linear in its points, so a spline through the images themselves is the same curve.

    Args:
        views: number of views over the full circle.
    """
    points = np.eye(views)
    spline = CubicSpline(np.arange(views + 1) / views, np.vstack([points, points[:1]]), bc_type="periodic")
    return torch.from_numpy(spline((np.arange(FINE) + 0.5) / FINE)).float()


def look_alikes(views: Float[Tensor, "object view 1 side side"]) -> Bool[Tensor, "object"]:
    """Return which objects look nearly the same from two opposite sides.

    For such an object, the root mean square difference of two views 180° apart is smaller than between two neighbouring
    views; both differences are averaged over all views.
    """
    flat = views.flatten(2)
    half = (flat - flat.roll(flat.shape[1] // 2, 1)).square().mean(-1).sqrt().mean(-1)
    next_view = (flat - flat.roll(1, 1)).square().mean(-1).sqrt().mean(-1)
    return half < next_view
