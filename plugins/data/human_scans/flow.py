"""Exact optical flow between two images of a moving mesh, and images warped by it."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from framework.renderer import Scene

CHANNELS = ("face", "barycentric", "depth")
"""Channels that a renderer has to draw of each scene."""
STEEPEST = 2.0
"""Largest difference in depth of neighbouring pixels of one surface, in widths of a pixel at that depth."""

Channels = Mapping[str, Tensor]


def flow(
    before: Scene, after: Scene, channels_before: Channels, channels_after: Channels
) -> tuple[Float[Tensor, "height width 2"], Bool[Tensor, "height width"]]:
    """Return the optical flow from the second image back to the first, and a mask of the pixels with a known flow.

    For each pixel of the second image the flow is the position (column, row), float64, of the same point of the mesh in
    the first image. A point is seen in an image if the pixels around it show the mesh at its depth: it lies neither at
    an outline nor behind something. The flow of a point that is not seen in both images has no meaning, and the mask is
    False there. `before` and `after` are scenes of one mesh with the same faces; `channels_before` and `channels_after`
    are the rendered `CHANNELS`.
    """
    face = channels_after["face"].long()
    corners = before.vertices.double()[after.faces.long()[face.clamp(min=0)]]
    weights = channels_after["barycentric"].double()
    place, depth = before.camera.project((weights[..., None] * corners).sum(-2))
    depth_before = channels_before["depth"].double()
    height, width = depth_before.shape
    low = place.nan_to_num(-1.0).clamp(-1, max(height, width)).floor().long()
    depth_after = channels_after["depth"].double()
    visible = _inside(depth_after, STEEPEST * depth_after / _focal(after))
    slack = STEEPEST * depth / _focal(before)
    for right in (0, 1):
        for down in (0, 1):
            column, row = low[..., 0] + right, low[..., 1] + down
            within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            near = depth_before[row.clamp(0, height - 1), column.clamp(0, width - 1)]
            visible &= within & ((near - depth).abs() < slack)
    return place, visible


def _focal(scene: Scene) -> float:
    return min(map(float, scene.camera.focal))


def _inside(
    depth: Float[Tensor, "height width"], slack: Float[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Return a mask of the pixels whose neighbours all show the same surface; it is false at the image's border.

    Pixels show the same surface if their depths differ by less than twice `slack`.
    """
    far = torch.nn.functional.pad(depth, (1, 1, 1, 1), value=torch.inf)[None]
    highest, lowest = (sign * max_pool2d(sign * far, 3, 1)[0] for sign in (1, -1))
    return depth.isfinite() & ((highest - lowest) < 2 * slack)


def warp(
    picture: Float[Tensor, "height width channels"], place: Float[Tensor, "height width 2"]
) -> Float[Tensor, "height width channels"]:
    """Return the colours of `picture` at the positions `place` (column, row), interpolated between pixel centres.

    With the first image and the flow from the second image to the first, the result is the first image as the second
    camera would show it.
    """
    height, width = picture.shape[:2]
    share = 2 * place / (torch.tensor([width, height]) - 1).clamp(min=1) - 1
    sampled = grid_sample(
        picture.movedim(-1, 0)[None].double(),
        share[None].nan_to_num(-2.0),
        padding_mode="border",
        align_corners=True,
    )
    return sampled[0].movedim(0, -1).to(picture.dtype)
