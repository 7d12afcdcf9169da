"""Images of coloured points: red, green, blue and depth of the nearest point of each pixel (thesis eq. 7.3-7.4)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.geometry.camera import canonical_camera
from framework.geometry.clouds import sizes
from framework.geometry.mesh_files import COLOURS, XYZ
from framework.storage.threads import POOL
from plugins.encoder.projection import compiled, splats

COLUMNS = (*XYZ, *COLOURS)
CHANNELS = 4
"""Number of channels of a level: red, green, blue and depth."""
BACKGROUND = 1.0
"""Value of every channel at pixels that show no point."""
NOTHING = torch.iinfo(torch.int64).max
"""Number that stands for "no point" among the keys of `visible_points_in_torch`, which are all smaller."""


@dataclass(frozen=True)
class CameraView:
    """The camera that all images share (`framework.geometry.camera.canonical_camera`), for one size of images.

    The object also holds the range of visible depths and the number of images.

    Attributes:
        height, width: size of the image, pixels.
        limits: nearest and farthest depth, metres: points whose depth is in [nearest, farthest) are visible.
        levels: number of images; each has half the size of the previous one, rounded up.
    """

    height: int
    width: int
    limits: tuple[float, float]
    levels: int = 1

    @cached_property
    def lens(self) -> tuple[float, tuple[float, float]]:
        """Focal length, and (column, row) of the principal point from the upper left corner of the image, pixels.

        `Camera.principal` is measured from the centre of the first pixel, half a pixel from this corner.
        """
        camera = canonical_camera(self.height, self.width)
        across, down = camera.principal
        return float(camera.focal[0]), (float(across) + 0.5, float(down) + 0.5)

    def size(self, level: int) -> tuple[int, int]:
        """Return height and width of a level's image, pixels."""
        return -(-self.height >> level), -(-self.width >> level)


def project(
    clouds: Float[Tensor, "batch points columns"], view: CameraView
) -> Float[Tensor, "batch channels height width"]:
    """Return red, green, blue and depth of the point that each pixel shows, or 1 for pixels that show no point.

    A point is shown at the pixel whose centre is nearest, floor(u + 0.5) for a position u in pixels. Of several points
    the nearest to the camera is shown, of equally near points the first. Depth is (z - nearest) / (farthest - nearest).
    A point is left out if it is not in the image, if its depth is not in [nearest, farthest), or if a coordinate or
    colour is not finite. At level l the camera is scaled with its image: a position u becomes (u + 0.5) / 2^l - 0.5.
    Each pixel of this level then shows the nearest of the points that 2^l × 2^l pixels of the full image show. The
    pixels are repeated to the size of the full image.

    On the CPU the function is compiled; without a gradient it makes a single pass. It is differentiable in the colours
    and depths of the visible points, but not in the pixel at which a point is shown. All implementations give the same
    bits: pixels are determined in float64 for any dtype, depths are compared as float32, and the channels have the
    clouds' dtype.

    Args:
        clouds: (batch, points, columns); the columns are `COLUMNS`, then any others.
        view: camera, range of depths and number of levels.

    Returns:
        Images of shape (batch, 4 · levels, height, width).

    Raises:
        DataError: the points have no colours.
    """
    if clouds.shape[2] < len(COLUMNS):
        raise DataError(
            f"Got a batch of clouds of shape {tuple(clouds.shape)}, but (batch, points, columns) is required, where "
            f"the first six columns are {', '.join(COLUMNS)}. Check the samples of `data`."
        )
    if clouds.device.type != "cpu":
        return gather_images(clouds, visible_points_in_torch(clouds, view), view)
    detached = clouds.detach().contiguous()
    if clouds.requires_grad and torch.is_grad_enabled():
        return gather_images(clouds, visible_points(detached, view), view)
    result = clouds.new_empty(len(clouds), CHANNELS * view.levels, view.height, view.width)
    arrays, images = detached.numpy(), result.numpy()

    def draw(number: int) -> None:
        if view.levels == 1:
            depth = np.empty(view.size(0), np.float32)
            compiled.project(arrays[number], *view.lens, *view.limits, depth, None, images[number])
            return
        for level, index in enumerate(pyramid(arrays[number], view)):
            channels = images[number, CHANNELS * level : CHANNELS * (level + 1)]
            compiled.paint(arrays[number], index, level, *view.limits, channels)

    POOL.share(draw, len(clouds), torch.get_num_threads())
    return result


def pyramid(cloud: np.ndarray, view: CameraView) -> list[np.ndarray]:
    """Return for each level the index of the point that each pixel shows, or -1 for pixels that show no point.

    Level 0 is the full image; each further level has half the size of the previous one, rounded up.

    `cloud` is (points, columns); the first columns are x, y, z in the camera's coordinates, metres.
    """
    depth, index = np.empty(view.size(0), np.float32), np.empty(view.size(0), np.int32)
    compiled.project(cloud, *view.lens, *view.limits, depth, index, None)
    indices = [index]
    for level in range(1, view.levels):
        coarse = np.empty(view.size(level), np.float32), np.empty(view.size(level), np.int32)
        compiled.halve(depth, index, *coarse)
        depth, index = coarse
        indices.append(index)
    return indices


def visible_points(
    clouds: Float[Tensor, "batch points columns"], view: CameraView
) -> list[Int[Tensor, "batch _rows _columns"]]:
    """Return for each level the index of the point that each pixel shows, or -1 for pixels that show no point.

    Level 0 is the full image; each further level has half the size of the previous one, rounded up. The indices of a
    level are (batch, rows, columns), and count the points of a cloud. `clouds` is a contiguous tensor on the CPU.
    """
    arrays = clouds.numpy()
    pyramids = [pyramid(array, view) for array in arrays]
    return [
        torch.from_numpy(np.stack([indices[level] for indices in pyramids])).long()
        if pyramids
        else torch.zeros(0, *view.size(level), dtype=torch.int64)
        for level in range(view.levels)
    ]


def visible_points_in_torch(
    clouds: Float[Tensor, "batch points columns"], view: CameraView
) -> list[Int[Tensor, "batch _rows _columns"]]:
    """Return the result of `visible_points` by operations on tensors, on any device.

    The bits of positive float32 numbers, read as integers, have the order of the numbers. A 64-bit key consists of the
    bits of the depth and, below them, the index of the point. The smallest key then belongs to the nearest point, and
    to the first of equally near points.
    """
    batch, height, width = len(clouds), view.height, view.width
    numbers = clouds[..., : len(COLUMNS)].detach()
    position = numbers[..., :3].double()
    depth = position[..., 2]
    # divisors and summands are tensors, because CUDA multiplies by the reciprocal instead of dividing by a number
    focal, middle = view.lens
    across, down = (focal * position[..., axis] / depth + depth.new_tensor(middle[axis]) for axis in (0, 1))
    # compared before any cast, because a cast of NaN or of too large a number is undefined
    nearest, farthest = view.limits
    shown = (depth >= nearest) & (depth < farthest) & numbers[..., 3:].isfinite().all(-1)
    shown &= (across >= 0) & (across < width) & (down >= 0) & (down < height)
    cloud, point = shown.nonzero(as_tuple=True)
    pixel = (cloud * height + down[shown].long()) * width + across[shown].long()
    key = (depth[shown].float().view(torch.int32).long() << 32) | point
    least = key.new_full((batch * height * width,), NOTHING).scatter_reduce(0, pixel, key, "amin")
    least = least.view(batch, height, width)
    indices = []
    for level in range(view.levels):
        if level:
            rows, columns = view.size(level)
            even = key.new_full((batch, 2 * rows, 2 * columns), NOTHING)
            even[:, : least.shape[1], : least.shape[2]] = least
            least = even.view(batch, rows, 2, columns, 2).amin((2, 4))
        indices.append((least & 0xFFFFFFFF).where(least != NOTHING, -1))
    return indices


def gather_images(
    clouds: Float[Tensor, "batch points columns"],
    indices: list[Int[Tensor, "batch _rows _columns"]],
    view: CameraView,
) -> Float[Tensor, "batch channels height width"]:
    """Return the images of `project` from the indices of each level, differentiable in colours and depths."""
    nearest, farthest = view.limits
    span = torch.as_tensor(farthest - nearest, dtype=torch.float64, device=clouds.device)
    levels = []
    for level, index in enumerate(indices):
        image = clouds.new_full((*index.shape, CHANNELS), BACKGROUND)
        cloud, row, column = (index >= 0).nonzero(as_tuple=True)
        points = clouds[cloud, index[cloud, row, column]]
        depth = ((points[:, 2].double() - nearest) / span).to(clouds.dtype)
        numbers = torch.cat([points[:, 3 : len(COLUMNS)], depth[:, None]], 1)
        image = image.index_put((cloud, row, column), numbers).permute(0, 3, 1, 2)
        if level:
            image = image.repeat_interleave(2**level, 2).repeat_interleave(2**level, 3)
        levels.append(image[..., : view.height, : view.width])
    return torch.cat(levels, 1)


class Projection(Encoder):
    """Image of coloured points in the canonical camera (`framework.geometry.camera`).

    The first columns of a cloud are x, y, z in the camera's coordinates, metres (`Camera.to_canonical` converts from
    any camera), then red, green, blue: numbers in [0, 1] as in image files, not linear RGB. Further columns are not
    read. Features are (4 · levels, height, width), with `splat` (5 + 4 · levels, height, width), of the clouds' dtype;
    see `project`.

    Args:
        input_shape: (points, columns) of the largest cloud.
        input_columns: names of the columns, if the data name them.
        height, width: size of the image, pixels.
        nearest, farthest: range of depths, metres. Points in [nearest, farthest) are visible, and their depth channel
            runs from 0 to 1, so that 1 marks the background. In the thesis the channel is in metres; 1 can mark the
            background there too, because the scanner of the thesis sees 0.1 to 0.7 m (§7.3.1).
        levels: number of images, four channels each. Each image has half the size of the previous one and is enlarged
            again by repetition, so that a pixel between sparse points shows a point at some level.
        splat: radius, pixels, of splats that fill the surface between points; 0 for no splats. Splats add five channels
            before the others: red, green, blue and depth of the surface, and the distance to the nearest point. See
            `splats.compute_surface`.

    Raises:
        ConfigError: the input is not a cloud of coloured points, or the range of depths is empty.
    """

    fixed = True
    bibtex = "prokudin2021smplpix"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        input_columns: tuple[str, ...] = (),
        *,
        height: Annotated[int, Field(gt=0, le=16_384)] = 410,
        width: Annotated[int, Field(gt=0, le=16_384)] = 308,
        nearest: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
        farthest: Annotated[float, Field(gt=0, le=1e6)] = 5.0,
        levels: Annotated[int, Field(ge=1, le=8)] = 1,
        splat: Annotated[int, Field(ge=0, le=16)] = 0,
    ) -> None:
        super().__init__()
        named = not input_columns or input_columns[: len(COLUMNS)] == COLUMNS
        if len(input_shape) != 2 or input_shape[1] < len(COLUMNS) or not named:
            columns = f" with columns {', '.join(input_columns)}" if input_columns else ""
            raise ConfigError(
                f"encoder projection got inputs of shape {input_shape}{columns}, but it reads clouds, "
                f"(points, columns), whose first six columns are {', '.join(COLUMNS)}. Choose data of coloured points, "
                "or another encoder."
            )
        if not nearest < farthest:
            raise ConfigError(
                f"encoder projection got nearest={nearest:g} and farthest={farthest:g}, but nearest must be smaller "
                "than farthest. Set both, in metres from the camera, so that the subject is between them."
            )
        self.view = CameraView(height, width, (nearest, farthest), levels)
        self.splat = splat
        self.output_shape = (CHANNELS * levels + (splats.CHANNELS if splat else 0), height, width)

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        """Return the images of the clouds."""
        sizes(inputs)  # raises DataError for inputs that are not clouds
        points = project(inputs, self.view)
        if not self.splat:
            return points
        surface = splats.compute_surface(
            points[:, :CHANNELS], self.view.limits, self.view.lens[0], self.splat
        )
        return torch.cat([surface, points], 1)
