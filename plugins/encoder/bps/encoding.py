"""Conversion of clouds to features of basis points, and back (thesis eq. 6.1-6.5)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import ConfigError, UserError, did_you_mean
from framework.geometry.clouds import (
    LOOSE,
    Normalisation,
    denormalise_clouds,
    normalise_clouds,
    pad,
    require_normalised,
    sizes,
    unit_ball_arrays,
)
from framework.geometry.nearest import Queries, nearest, prepare, quick_distances
from plugins.encoder.bps.frame import frame

COLOR = ("red", "green", "blue")
NORMAL = ("normal_x", "normal_y", "normal_z")
GROUPS = {"color": COLOR, "normal": NORMAL}


class Basis(NamedTuple):
    """Basis points, prepared for searches of their nearest points in many clouds.

    Attributes:
        points: the basis points.
        queries: the same points in the data structure that the search reads.
    """

    points: Float[Tensor, "k 3"]
    queries: Queries


class Encoding(NamedTuple):
    """Features of a batch of clouds, and what `decode` needs to recover points from them.

    Attributes:
        features: tensors of shape (batch, k) or (batch, k, 3), by name of the feature.
        index: for each basis point, the index of the nearest point of each cloud; of equally near points the first.
        basis: the basis points.
        centre, scale: centre and scale of each cloud (framework.geometry.clouds.NormalisedClouds).
        frame: each cloud's own axes as columns, if the encoding is rotation-invariant; else None.
    """

    features: dict[str, Tensor]
    index: Int[Tensor, "batch k"]
    basis: Float[Tensor, "k 3"]
    centre: Float[Tensor, "batch 3"]
    scale: Float[Tensor, "batch"]
    frame: Float[Tensor, "batch 3 3"] | None


def prepare_basis(points: Float[Tensor, "k 3"]) -> Basis:
    """Return basis points prepared for `encode`."""
    return Basis(points, prepare(points))


def width(feature: str) -> int:
    """Return the number of values that a feature has for each basis point."""
    return 3 if feature == "delta" or feature in GROUPS else 1


def columns_of(feature: str, columns: Sequence[str]) -> list[int]:
    """Return the column indices of a feature's attributes in a cloud; an empty list for "distance" and "delta".

    Args:
        feature: "distance", "delta", "color", "normal", or the name of a column.
        columns: names of a cloud's columns (`Data.columns`).

    Raises:
        ConfigError: the clouds have no such column.
    """
    if feature in ("distance", "delta"):
        return []
    names = GROUPS.get(feature, (feature,))
    missing = [name for name in names if name not in columns]
    if missing:
        known = ["distance", "delta", *GROUPS, *columns]
        raise ConfigError(
            f"encoder bps: feature {feature!r} requires a column {missing[0]!r} of the clouds, whose columns are "
            f"{', '.join(columns) or 'not named'}.{did_you_mean(feature, known)} Leave the feature out, or choose data "
            "whose `columns` name this column."
        )
    return [columns.index(name) for name in names]


def encode(
    clouds: Float[Tensor, "batch points columns"],
    basis: Basis,
    features: Sequence[str] = ("distance",),
    normalise: Normalisation = "unit_ball",
    columns: Sequence[str] = (),
    *,
    rotation_invariant: bool = False,
) -> Encoding:
    """Return, for each basis point, the requested features of the nearest point of each cloud.

    "distance" is the distance of the nearest point from the basis point (thesis eq. 6.4). "delta" is the vector from
    the basis point to the nearest point (eq. 6.5). "color", "normal" or the name of a column are attributes of the
    nearest point, unchanged ("x", "y", "z" are normalised). Distances and deltas are in units of the normalised cloud.
    All features have the basis's dtype. They are differentiable in the clouds and in the basis points, except where
    another point becomes the nearest.

    Args:
        clouds: (batch, points, columns), padded as `framework.geometry.clouds` describes.
        basis: basis points, as `prepare_basis` returns them.
        features: names of the features, in the order of the result.
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`).
        columns: names of the clouds' columns, if a feature is an attribute.
        rotation_invariant: whether to encode each cloud in its own frame (`plugins.encoder.bps.frame`); normals are
            rotated into this frame too.

    Raises:
        ConfigError: a feature needs a column that the clouds do not have.
        DataError: a cloud has no points, or a number of a point is not finite; or `normalise` is "none" and the clouds
            are clearly not normalised.
    """
    columns_by_feature = {feature: columns_of(feature, columns) for feature in features}
    counts = sizes(clouds)
    local, centre, scale = normalise_clouds(clouds, normalise, counts)
    reach_of_inliers = 1.0
    if normalise == "none" and not torch.compiler.is_exporting():  # a trace depends on no value
        reach = max(1.0, float(basis.points.detach().abs().max()))
        require_normalised(local[..., :3], reach, counts, by="encoder bps")
        reach_of_inliers = (
            LOOSE * reach
        )  # `require_normalised` accepts at most half of the points beyond this norm, as outliers
    axes = frame(local[..., :3], reach_of_inliers) if rotation_invariant else None
    if axes is not None:
        local = _rotate_into_frames(
            local, axes, columns, {column for indices in columns_by_feature.values() for column in indices}
        )
    coordinates = local[..., :3].to(basis.points.dtype)
    neighbours = nearest(coordinates.detach(), basis.queries, counts)
    delta = None
    has_gradient = coordinates.requires_grad or basis.points.requires_grad
    if "delta" in columns_by_feature or ("distance" in columns_by_feature and has_gradient):
        delta = _gather_rows(coordinates, neighbours.index) - basis.points  # eq. 6.5
    values: dict[str, Tensor] = {}
    for feature, indices in columns_by_feature.items():
        if feature == "distance":
            values[feature] = neighbours.distance  # eq. 6.4
            if delta is not None and delta.requires_grad:
                length = torch.linalg.vector_norm(delta, dim=-1)
                values[feature] = neighbours.distance + (
                    length - length.detach()
                )  # adds a gradient and changes no bit
        elif feature == "delta" and delta is not None:
            values[feature] = delta
        else:
            attribute = _gather_rows(local[..., indices], neighbours.index).to(basis.points.dtype)
            values[feature] = attribute if width(feature) == 3 else attribute[..., 0]
    return Encoding(values, neighbours.index, basis.points, centre, scale, axes)


def encode_distances(clouds: Tensor, basis: Basis) -> Float[Tensor, "batch k"] | None:
    """Return the feature "distance" of clouds normalised to the unit ball, with the same bits as `encode`.

    The function is for clouds of finite float32 numbers on the CPU, without padding, attributes and gradient. For all
    other clouds it returns None, and the caller uses `encode`. For one cloud of 2,048 points, the checks and tensors
    that this function leaves out take half as long as the search itself.
    """
    if (
        torch.compiler.is_exporting()  # first, because a trace depends on no size
        or clouds.device.type != "cpu"
        or not clouds.dtype == basis.points.dtype == torch.float32
        or clouds.dim() != 3
        or clouds.shape[2] != 3
        or 0 in clouds.shape
        or (clouds.requires_grad and torch.is_grad_enabled())
    ):
        return None
    array, counts = clouds.detach().contiguous().numpy(), np.full(len(clouds), clouds.shape[1])
    local, _, _ = unit_ball_arrays(array, counts)  # NaN where a cloud has padding or bad numbers
    distances = quick_distances(local, basis.queries)
    return None if distances is None else torch.from_numpy(distances).to(clouds.device)


def channels(encoding: Encoding) -> Float[Tensor, "batch channels k"]:
    """Return all features in the requested order, with the components of vectors as separate channels."""
    parts = [part[:, None] if part.dim() == 2 else part.mT for part in encoding.features.values()]
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def decode(encoding: Encoding, *, unique: bool = False) -> Float[Tensor, "batch points 3"]:
    """Return the cloud points nearest to the basis points, in the clouds' own units (§6.4.1).

    The points are computed from the feature "delta". There is one point for each basis point, in the order of the
    basis, so that a point may occur several times. With `unique` each point occurs once, in the order of the cloud, and
    the result is padded with rows of NaN.

    Raises:
        UserError: the encoding has no feature "delta".
    """
    if "delta" not in encoding.features:
        raise UserError(
            f"An encoding of {', '.join(encoding.features)} cannot be decoded to points; the feature 'delta' is "
            "required. Encode with features=[delta]."
        )
    points = encoding.features["delta"] + encoding.basis
    if encoding.frame is not None:
        points = (points.double() @ encoding.frame.mT).to(points.dtype)
    points = denormalise_clouds(points, encoding.centre, encoding.scale)
    if not unique or len(points) == 0:
        return points
    rows_of_clouds = [_first_occurrences(index) for index in encoding.index]
    return pad([cloud[rows] for cloud, rows in zip(points, rows_of_clouds, strict=True)])


def per_point(
    encoding: Encoding, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points features"]:
    """Return the input of a network that predicts a quantity for each point, such as its segment (§8.2).

    For each point, the input holds all features of its cloud (as `channels` returns them, flattened), then the point's
    normalised coordinates. Padding stays NaN.

    Args:
        encoding: encoding of the clouds.
        points: points of the same clouds in the same order, in the clouds' own units.
    """
    local = (points.double() - encoding.centre[:, None]) / encoding.scale[:, None, None]
    if encoding.frame is not None:
        local = local @ encoding.frame
    whole = channels(encoding).flatten(1)
    return torch.cat([whole[:, None].expand(-1, points.shape[1], -1), local.to(whole.dtype)], -1)


def _gather_rows(numbers: Float[Tensor, "batch points columns"], index: Int[Tensor, "batch k"]) -> Tensor:
    """Return the rows of each cloud at the given indices, (batch, k, columns)."""
    return numbers.gather(1, index[..., None].expand(-1, -1, numbers.shape[2]))


def _rotate_into_frames(
    local: Float[Tensor, "batch points columns"], axes: Tensor, columns: Sequence[str], read: set[int]
) -> Float[Tensor, "batch points columns"]:
    """Return clouds whose coordinates and normals are expressed in each cloud's own frame.

    Args:
        local: clouds, whose coordinates are normalised.
        axes: axes of each cloud as columns, as `frame` returns them.
        columns: names of the clouds' columns.
        read: indices of the attributes that are read; normals are rotated only if one of their columns is among them.
    """
    parts = list(local.unbind(-1))
    vectors = [[0, 1, 2]]
    if read & {columns.index(name) for name in NORMAL if name in columns}:
        vectors.append(columns_of("normal", columns))
    for indices in vectors:
        vector = local[..., indices].double()
        padding = vector.isnan()  # padding must add nothing to the axes' gradient
        along = (vector.where(~padding, 0) @ axes).where(~padding, torch.nan).to(local.dtype)
        for column, part in zip(indices, along.unbind(-1), strict=True):
            parts[column] = part
    return torch.stack(parts, -1)


def _first_occurrences(index: Int[Tensor, "k"]) -> Int[Tensor, "different"]:
    """Return the position in `index` at which each distinct value occurs first; the values are in ascending order."""
    order = index.argsort(stable=True)
    ordered = index[order]
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return order[first]
