"""Batches of point clouds: padding, sizes, normalisation and its inverse (thesis eq. 6.1-6.2).

A batch is a float tensor (batch, points, columns): x, y, z, then attributes of each point (colours, normals, anything).
Clouds of fewer points are padded at their end with rows that are NaN in every column. Messages count clouds and points
from 0.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from framework.errors import ConfigError, DataError

Normalisation = Literal["unit_ball", "robust", "none"]
REACH = 3.0
"""Distance beyond which the normalisation "robust" ignores points for centre and scale.

The distance is measured from the point with the median x, median y and median z of the cloud, in multiples of the
median distance of the cloud's points from it.
"""
LOOSE, TIGHT = 2.0, 0.01
"""Largest and smallest extent of a normalised cloud, in multiples of the extent of the basis or grid that describes it.

`require_normalised` refuses other clouds.
"""


class NormalisedClouds(NamedTuple):
    """Clouds around the origin, with the centre and scale that map them back (`denormalise_clouds`).

    Attributes:
        clouds: normalised clouds, of the input's dtype; attributes of the points and the padding are unchanged.
        centre: centre of each cloud, in the cloud's own units, float64, so that mapping back loses no digits of clouds
            that are far from the origin.
        scale: factor from normalised to own coordinates of each cloud, float64; 1 if all points are at one position.
    """

    clouds: Float[Tensor, "batch points columns"]
    centre: Float[Tensor, "batch 3"]
    scale: Float[Tensor, "batch"]


def require_clouds(input_shape: tuple[int, ...], by: str) -> None:
    """Require that the inputs of a model are clouds, (points, columns).

    Args:
        input_shape: shape of one input.
        by: name of the caller, for the message.

    Raises:
        ConfigError: the inputs are not clouds; the message says what `by` wants.
    """
    if len(input_shape) != 2 or input_shape[1] < 3:
        raise ConfigError(
            f"{by} got inputs of shape {input_shape}, but it reads clouds, (points, columns), with x, y, z in the "
            "first three columns. Choose data of point clouds, or another encoder."
        )


def sizes(clouds: Tensor) -> Int[Tensor, "batch"]:
    """Return the number of points of each cloud of a batch (batch, points, columns), without the padding.

    Raises:
        DataError: the tensor is not a batch of clouds, a cloud has no points, or a number of a point is not finite.
            The message names the cloud, and its first bad point.
    """
    if clouds.dim() != 3 or clouds.shape[2] < 3 or clouds.dtype not in (torch.float32, torch.float64):
        raise DataError(
            f"Got a batch of clouds of shape {tuple(clouds.shape)} and type {clouds.dtype}; expected (batch, "
            "points, columns) of float32 or float64 with x, y, z in the first three columns. Check the batches of "
            "`data`."
        )
    count, points, _ = clouds.shape
    if (
        torch.compiler.is_exporting()
    ):  # a trace depends on no value; an exported model's script checks its clouds
        return _rows_to_last_point(clouds)
    # a finite sum has only finite summands, so that one pass suffices for clouds without padding
    if points and math.isfinite(float(clouds.detach().sum())):
        return torch.full((count,), points, device=clouds.device)
    counts = clouds.new_zeros(count, dtype=torch.int64) if points == 0 else _rows_to_last_point(clouds)
    empty = (counts == 0).nonzero()
    if len(empty):
        raise DataError(
            f"Cloud {int(empty[0])} of the batch has no point (rows of NaN are padding); expected at least "
            "one. Leave out empty files."
        )
    bad = ~clouds.isfinite().all(-1) & point_mask(clouds, counts)
    if bad.any():
        cloud, point = bad.nonzero()[0].tolist()
        column = int((~clouds[cloud, point].isfinite()).nonzero()[0])
        raise DataError(
            f"Cloud {cloud} of the batch holds {clouds[cloud, point, column].item()} in column {column} of point "
            f"{point}; expected finite numbers, and rows of NaN only as padding at the end. Correct the file, or "
            "remove such points."
        )
    return counts


def _rows_to_last_point(clouds: Float[Tensor, "batch points columns"]) -> Int[Tensor, "batch"]:
    """Return the number of rows of each cloud up to the last row that is not padding."""
    number = torch.arange(1, clouds.shape[1] + 1, device=clouds.device)
    return number.where(~clouds.isnan().all(-1), 0).amax(1)


def point_mask(clouds: Tensor, sizes: Tensor | None) -> Bool[Tensor, "batch points"]:
    """Return a mask (batch, points) of the rows that hold points and no padding.

    Args:
        clouds: (batch, points, columns).
        sizes: number of points of each cloud, which are its first rows; None if all rows are points.
    """
    if sizes is None:
        return clouds.new_ones(clouds.shape[:2], dtype=torch.bool)
    return torch.arange(clouds.shape[1], device=clouds.device) < sizes.to(clouds.device)[:, None]


def pad(clouds: Sequence[Tensor]) -> Float[Tensor, "batch points columns"]:
    """Return clouds (points, columns) of different sizes as one batch, with rows of NaN at the end of smaller clouds.

    Raises:
        DataError: there is no cloud, or the clouds have different numbers of columns.
    """
    shapes = {tuple(cloud.shape[1:]) for cloud in clouds}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        shape_names = ", ".join(str(tuple(cloud.shape)) for cloud in clouds[:4]) or "none"
        raise DataError(
            f"Clouds of shapes {shape_names} do not form a batch; expected at least one cloud, each (points, columns), "
            "with the same number of columns. Give every cloud the same attributes."
        )
    return pad_sequence(list(clouds), batch_first=True, padding_value=math.nan)


def normalise_clouds(
    clouds: Float[Tensor, "batch points columns"], how: Normalisation, counts: Tensor | None = None
) -> NormalisedClouds:
    """Return clouds around the origin, within the unit ball; differentiable in the clouds.

    Args:
        clouds: (batch, points, columns).
        how: "unit_ball": the mean of the points is subtracted, then the coordinates are divided by the largest norm
            (thesis eq. 6.2). "robust": as "unit_ball", but mean and largest norm are those of the points that
            `near_middle` selects. Distant outliers, up to some 30 % of the points, then do not change the result,
            and lie outside of the ball. If half of the points or more are at one position, all points are used.
            "none": the clouds are unchanged, with centre 0 and scale 1.
        counts: number of points of each cloud, as `sizes` returns them; None if they are not known yet.

    Raises:
        DataError: a cloud has no points, a number of a point is not finite, or squared distances within a cloud exceed
            float64.
    """
    if counts is None:
        counts = sizes(clouds)
    count = clouds.shape[0]
    exporting = torch.compiler.is_exporting()  # a trace depends on no value and holds no compiled code
    if how == "none" or (not exporting and count == 0):
        origin = torch.zeros(count, 3, dtype=torch.float64, device=clouds.device)
        return NormalisedClouds(clouds, origin, torch.ones_like(origin[:, 0]))
    if exporting:
        return _composed(clouds, how, counts)
    if how == "unit_ball" and clouds.device.type == "cpu":
        arrays = unit_ball_arrays(clouds.detach().contiguous().numpy(), counts.numpy())
        normalised = NormalisedClouds(*(torch.from_numpy(array).to(clouds.device) for array in arrays))
        if clouds.requires_grad and torch.is_grad_enabled():  # adds a gradient and changes no bit
            traced = _composed(clouds, how, counts)
            pairs = zip(normalised, traced, strict=True)
            normalised = NormalisedClouds(*(value + (other - other.detach()) for value, other in pairs))
    else:
        normalised = _composed(clouds, how, counts)
    if clouds.dtype == torch.float64 and not bool(normalised.scale.isfinite().all()):
        cloud = int((~normalised.scale.isfinite()).nonzero()[0])
        raise DataError(
            f"Cloud {cloud} of the batch is so large that squared distances exceed float64; expected coordinates "
            "below 1e150. Choose other units."
        )
    return normalised


def unit_ball_arrays(clouds: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return clouds normalised by "unit_ball", their centres and their scales (`NormalisedClouds`), by compiled code.

    This takes a third of the time of tensor operations. The clouds are not checked; the result of a cloud with a number
    that is NaN or infinite contains NaN.

    Args:
        clouds: (batch, points, columns), contiguous.
        counts: number of points of each cloud, int64.
    """
    from framework.geometry.clouds_compiled import unit_ball

    normalised, centre, scale = np.empty_like(clouds), np.empty((len(clouds), 3)), np.empty(len(clouds))
    unit_ball(clouds, counts, normalised, centre, scale)
    return normalised, centre, scale


def _composed(clouds: Tensor, how: Normalisation, counts: Tensor) -> NormalisedClouds:
    """Return the normalised clouds, computed by differentiable tensor operations on any device."""
    _, points, columns = clouds.shape
    real = None  # mask of the rows that hold points; None if no cloud is padded
    if torch.compiler.is_exporting() or not bool((counts == points).all()):
        real = point_mask(clouds, counts)[..., None]
    coordinates = clouds[..., :3].double()
    # relative to a place in the cloud: clouds far from the origin keep their digits, equal points are exactly equal.
    # "robust" takes the medians, because the first point may be an outlier, next to which the others have no digits
    if how == "unit_ball":
        reference = coordinates[:, :1]
    else:
        known = coordinates.detach() if real is None else coordinates.detach().where(real, math.nan)
        reference = _lower_median(known)
    offset = coordinates - reference
    if real is not None:
        offset = offset.where(real, 0)  # before anything is multiplied: NaN × 0 is not a gradient
    counted_points = real if how == "unit_ball" else near_middle(offset, real)
    if counted_points is None:
        mean = offset.mean(1, keepdim=True)
    else:
        mean = offset.where(counted_points, 0).sum(1, keepdim=True) / counted_points.sum(1, keepdim=True)
    local = offset - mean  # the numerator of eq. 6.2
    norm = torch.linalg.vector_norm(local, dim=-1)
    largest = (norm if counted_points is None else norm.where(counted_points[..., 0], 0)).amax(
        1
    )  # its denominator
    scale = largest.where(largest > 0, 1)
    local = (local / scale[:, None, None]).to(clouds.dtype)
    if real is not None:
        local = local.where(real, math.nan)
    if columns > 3:
        local = torch.cat([local, clouds[..., 3:]], -1)
    return NormalisedClouds(local, (reference + mean)[:, 0], scale)


@torch.no_grad()
def near_middle(
    offset: Float[Tensor, "batch points 3"], real: Bool[Tensor, "batch points 1"] | None
) -> Bool[Tensor, "batch points 1"]:
    """Return a mask of the points near the middle of their cloud, the point with the median x, median y and median z.

    A point is near if its distance from the middle is at most `REACH` times the median of these distances. If half of
    the points or more are at the middle, all points count as near.

    Args:
        offset: coordinates of the points, relative to any origin.
        real: mask of the rows that hold points; None if all do.
    """
    known = offset if real is None else offset.where(real, math.nan)
    distance = torch.linalg.vector_norm(known - _lower_median(known), dim=-1, keepdim=True)
    typical = _lower_median(distance)
    near = distance <= REACH * typical  # False for NaN
    typical_is_known = typical > 0
    return (near & typical_is_known) | (~typical_is_known & ~distance.isnan())


def _lower_median(
    values: Float[Tensor, "batch points columns"],
) -> Float[Tensor, "batch 1 columns"]:
    """Return the median over the points, ignoring NaN; of two middle values, it is the lower one."""
    if not torch.compiler.is_exporting():
        return values.nanmedian(1, keepdim=True).values
    # ONNX has no such median
    known = ~values.isnan()
    ordered = values.where(known, math.inf).sort(1).values
    return ordered.gather(1, (known.sum(1, keepdim=True) - 1) // 2)


def denormalise_clouds(
    points: Float[Tensor, "batch points columns"],
    centre: Float[Tensor, "batch 3"],
    scale: Float[Tensor, "batch"],
) -> Float[Tensor, "batch points columns"]:
    """Return normalised points in their cloud's own units, of the input's dtype; their attributes are unchanged.

    Args:
        points: normalised points, (batch, points, columns).
        centre: centre of each cloud, in the cloud's own units.
        scale: factor from normalised to own coordinates of each cloud.
    """
    back = points[..., :3] * scale[:, None, None] + centre[:, None]
    return torch.cat([back.to(points.dtype), points[..., 3:]], -1)


def require_normalised(
    coordinates: Float[Tensor, "batch points 3"], reach: float, counts: Tensor, by: str
) -> None:
    """Require that clouds are normalised, because a basis or a grid around the origin cannot describe other clouds.

    Args:
        coordinates: clouds that `normalise_clouds` did not change, since the caller has chosen "none".
        reach: largest coordinate of the basis or grid.
        counts: number of points of each cloud.
        by: name of the caller, for the message.

    Raises:
        DataError: more than half of a cloud's points are farther than 2 · `reach` from the origin; fewer such points
            may be outliers, which a robust normalisation leaves there. Or all points are nearer than 0.01 · `reach`,
            and not all of them are at the origin.
    """
    if torch.compiler.is_exporting():  # a trace depends on no value
        return
    real = point_mask(coordinates, counts)
    norm = torch.linalg.vector_norm(coordinates.detach().double(), dim=-1)
    largest = norm.where(real, 0).amax(1) if norm.shape[1] else norm.sum(1)
    far = largest > LOOSE * reach
    if far.any():
        far = norm.where(real, torch.nan).nanmedian(1).values > LOOSE * reach
    bad = far | ((largest < TIGHT * reach) & (largest > 0))
    if bad.any():
        cloud = int(bad.nonzero()[0])
        raise DataError(
            f"Cloud {cloud} of the batch extends to {largest[cloud]:.3g} from the origin, but {by} with "
            f"normalise=none requires that a cloud extends to {TIGHT * reach:g} at least and {LOOSE * reach:g} at "
            "most, apart from some outliers. Choose normalise=unit_ball."
        )


def cell_centres(side: int) -> Float[Tensor, "cells 3"]:
    """Return the centres of the side³ cells of the cube [-1, 1]³, float64; x changes slowest, z fastest."""
    axis = (torch.arange(side, dtype=torch.float64) * 2 + 1 - side) / side  # exactly symmetric around 0
    return torch.cartesian_prod(axis, axis, axis)
