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
BACKGROUND = 1.0
NOTHING = torch.iinfo(torch.int64).max


@dataclass(frozen=True)
class View:
    """The view of points that the canonical camera has for images of this size.

    Attributes:
        height, width: pixels.
        limits: nearest and farthest depth, metres: points whose depth is in [nearest, farthest) are seen.
        levels: number of images; each has half the size of the previous one, rounded up.
    """

    height: int
    width: int
    limits: tuple[float, float]
    levels: int = 1

    @cached_property
    def lens(self) -> tuple[float, tuple[float, float]]:
        """Focal length, and (column, row) of the principal point from the upper left corner of the image, pixels.

        The camera counts from the centre of the first pixel, which lies half a pixel from that corner.
        """
        camera = canonical_camera(self.height, self.width)
        across, down = camera.principal
        return float(camera.focal[0]), (float(across) + 0.5, float(down) + 0.5)

    def size(self, level: int) -> tuple[int, int]:
        """Return height and width of a level's image, pixels."""
        return -(-self.height >> level), -(-self.width >> level)


def project(
    clouds: Float[Tensor, "batch points columns"], view: View
) -> Float[Tensor, "batch channels height width"]:
    """Return red, green, blue and depth of the point that each pixel shows, four channels a level; 1 if it shows none.

    A point is seen at the pixel whose centre is nearest, floor(u + 0.5). Of several points the nearest is seen, of
    equally near points the first. Depth is (z - nearest) / (farthest - nearest). A point is left out if it is not in
    the image, is not in [nearest, farthest), or has a coordinate or colour that is not finite. At level l the camera is
    scaled with its image: a position u becomes (u + 0.5) / 2^l - 0.5. Each pixel of that level then shows the nearest
    of the points that 2^l × 2^l pixels of the full image show. The pixels are repeated to the size of the full image.

    The function is compiled on the CPU, in one pass if no gradient is wanted. It is differentiable in the colours and
    depths of the points that are seen, not in where they are seen. All ways give the same bits: pixels are decided in
    float64 for any input type, depths are compared as float32, and the channels have the clouds' type.

    Raises:
        DataError: the points have no colours.
    """
    if clouds.shape[2] < len(COLUMNS):
        raise DataError(
            f"A batch of clouds of shape {tuple(clouds.shape)}; wanted (batch, points, columns) whose first six "
            f"columns are {', '.join(COLUMNS)}. Check what `data` yields."
        )
    if clouds.device.type != "cpu":
        return gathered(clouds, seen_in_torch(clouds, view), view)
    given = clouds.detach().contiguous()
    if clouds.requires_grad and torch.is_grad_enabled():
        return gathered(clouds, seen(given, view), view)
    picture = clouds.new_empty(len(clouds), CHANNELS * view.levels, view.height, view.width)
    arrays, pictures = given.numpy(), picture.numpy()

    def draw(number: int) -> None:
        if view.levels == 1:
            depth = np.empty(view.size(0), np.float32)
            compiled.project(arrays[number], *view.lens, *view.limits, depth, None, pictures[number])
            return
        for level, index in enumerate(pyramid(arrays[number], view)):
            channels = pictures[number, CHANNELS * level : CHANNELS * (level + 1)]
            compiled.paint(arrays[number], index, level, *view.limits, channels)

    POOL.share(draw, len(clouds), torch.get_num_threads())
    return picture


def pyramid(cloud: np.ndarray, view: View) -> list[np.ndarray]:
    """Return which point each pixel of each level shows, -1 where it shows none."""
    depth, index = np.empty(view.size(0), np.float32), np.empty(view.size(0), np.int32)
    compiled.project(cloud, *view.lens, *view.limits, depth, index, None)
    found = [index]
    for level in range(1, view.levels):
        coarse = np.empty(view.size(level), np.float32), np.empty(view.size(level), np.int32)
        compiled.halve(depth, index, *coarse)
        depth, index = coarse
        found.append(index)
    return found


def seen(
    clouds: Float[Tensor, "batch points columns"], view: View
) -> list[Int[Tensor, "batch _rows _columns"]]:
    """Return for each level which point each pixel shows, -1 where it shows none, for contiguous clouds on the CPU."""
    arrays = clouds.numpy()
    each = [pyramid(array, view) for array in arrays]
    return [
        torch.from_numpy(np.stack([found[level] for found in each])).long()
        if each
        else torch.zeros(0, *view.size(level), dtype=torch.int64)
        for level in range(view.levels)
    ]


def seen_in_torch(
    clouds: Float[Tensor, "batch points columns"], view: View
) -> list[Int[Tensor, "batch _rows _columns"]]:
    """Return the result of `seen` by operations on tensors, on any device.

    The bits of positive float32 numbers, read as integers, have the order of the numbers. A 64-bit key holds these bits
    above the index of the point. The smallest key is then the nearest point, and the first of equally near points.
    """
    batch, height, width = len(clouds), view.height, view.width
    numbers = clouds[..., : len(COLUMNS)].detach()
    place = numbers[..., :3].double()
    depth = place[..., 2]
    # divisors and summands are tensors: CUDA multiplies with the reciprocal of a plain number
    focal, middle = view.lens
    across, down = (focal * place[..., axis] / depth + depth.new_tensor(middle[axis]) for axis in (0, 1))
    # compared before any cast, since a cast of NaN or of too large a number is undefined
    nearest, farthest = view.limits
    shown = (depth >= nearest) & (depth < farthest) & numbers[..., 3:].isfinite().all(-1)
    shown &= (across >= 0) & (across < width) & (down >= 0) & (down < height)
    cloud, point = shown.nonzero(as_tuple=True)
    pixel = (cloud * height + down[shown].long()) * width + across[shown].long()
    key = (depth[shown].float().view(torch.int32).long() << 32) | point
    least = key.new_full((batch * height * width,), NOTHING).scatter_reduce(0, pixel, key, "amin")
    least = least.view(batch, height, width)
    found = []
    for level in range(view.levels):
        if level:
            rows, columns = view.size(level)
            even = key.new_full((batch, 2 * rows, 2 * columns), NOTHING)
            even[:, : least.shape[1], : least.shape[2]] = least
            least = even.view(batch, rows, 2, columns, 2).amin((2, 4))
        found.append((least & 0xFFFFFFFF).where(least != NOTHING, -1))
    return found


def gathered(
    clouds: Float[Tensor, "batch points columns"], seen: list[Int[Tensor, "batch _rows _columns"]], view: View
) -> Float[Tensor, "batch channels height width"]:
    """Return the image of the points that the pixels of each level show, with a gradient in colours and depths."""
    nearest, farthest = view.limits
    span = torch.as_tensor(farthest - nearest, dtype=torch.float64, device=clouds.device)
    levels = []
    for level, index in enumerate(seen):
        picture = clouds.new_full((*index.shape, CHANNELS), BACKGROUND)
        cloud, row, column = (index >= 0).nonzero(as_tuple=True)
        points = clouds[cloud, index[cloud, row, column]]
        depth = ((points[:, 2].double() - nearest) / span).to(clouds.dtype)
        numbers = torch.cat([points[:, 3 : len(COLUMNS)], depth[:, None]], 1)
        picture = picture.index_put((cloud, row, column), numbers).permute(0, 3, 1, 2)
        if level:
            picture = picture.repeat_interleave(2**level, 2).repeat_interleave(2**level, 3)
        levels.append(picture[..., : view.height, : view.width])
    return torch.cat(levels, 1)


class Projection(Encoder):
    """Coloured points as the image that the canonical camera sees (`framework.geometry.camera`).

    Clouds hold x, y, z in that camera's coordinates, metres (`Camera.to_canonical` converts from any camera). Then
    follow red, green, blue: numbers in [0, 1] as files hold them, not linear RGB. Further columns are not read.
    Features are (4 · levels, height, width), five channels more with `splat`, of the clouds' dtype; see `project`.

    Args:
        input_shape: (points, columns) of the largest cloud.
        input_columns: names of the columns, if the data give them.
        height, width: pixels.
        nearest, farthest: metres. Points in [nearest, farthest) are seen, and their depth channel runs from 0 to 1. The
            thesis's scanner sees 0.1 to 0.7 m, so that a value of 1 marks the background (§7.3.1). A depth in metres
            would not mark it where people stand farther away.
        levels: number of images, four channels each. Each has half the size of the previous one and is enlarged again
            by repetition, so that a pixel between sparse points shows a point at some level.
        splat: radius, pixels, of splats that fill the surface between points; 0 for none. They add five channels before
            the others: red, green, blue and depth of the surface, and the distance to the nearest point. See
            `splats.splatted`.

    Raises:
        ConfigError: an input that is no cloud of coloured points, or an empty range of depths.
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
                f"encoder projection got inputs of shape {input_shape}{columns}; wanted clouds, (points, columns), "
                f"whose first six columns are {', '.join(COLUMNS)}. Choose data of coloured points, or another encoder."
            )
        if not nearest < farthest:
            raise ConfigError(
                f"encoder projection got nearest={nearest:g} and farthest={farthest:g}; wanted nearest below farthest, "
                "metres from the camera. Set both around the subject."
            )
        self.view = View(height, width, (nearest, farthest), levels)
        self.splat = splat
        self.output_shape = (CHANNELS * levels + (splats.CHANNELS if splat else 0), height, width)

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        """Return the images of the clouds."""
        sizes(inputs)  # refuses inputs that are no clouds
        points = project(inputs, self.view)
        if not self.splat:
            return points
        surface = splats.splatted(points[:, :CHANNELS], self.view.limits, self.view.lens[0], self.splat)
        return torch.cat([surface, points], 1)
