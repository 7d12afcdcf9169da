"""Compiled functions on NumPy arrays that find which point of a cloud each pixel shows, on one CPU core.

Arrays:
    cloud: (points, columns) float32 or float64: x, y, z in the canonical camera's coordinates, metres; red, green,
        blue.
    depth: (height, width) float32, metres; infinite where no point is seen.
    index: (height, width) int32: the point that is seen; -1 where no point is seen.
    picture: (channels, height, width) of the cloud's type.
"""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

KERNELS = ("compiled",)
"""Names of the compiled files whose functions call each other."""
compiled = compiler(kernel_cache("projection", [Path(__file__)]))


@compiled
@no_type_check
def project(cloud, focal, middle, nearest, farthest, depth, index, picture):
    """Fill `depth`, and either `index` or `picture`; the other one is None, and its branch is compiled away.

    All decisions equal those of `encoder.project` and are made in float64. A NaN fails every comparison, so that its
    point is left out.

    Args:
        cloud: see the module.
        focal: focal length, pixels.
        middle: (column, row) of the principal point, pixels, counted from the upper left corner of the image. It is
            half a pixel more than counted from the centre of the first pixel.
        nearest: smallest depth that is seen, metres.
        farthest: depth from which points are not seen, metres.
        depth: see the module.
        index: see the module; None if the image is filled.
        picture: see the module; None if the index is filled.
    """
    height, width = depth.shape
    depth[:] = np.inf
    if index is not None:
        index[:] = -1
    if picture is not None:
        picture[:] = 1.0
    span = farthest - nearest
    for point in range(cloud.shape[0]):
        z = np.float64(cloud[point, 2])
        if not (z >= nearest and z < farthest):
            continue
        across = focal * np.float64(cloud[point, 0]) / z + middle[0]
        down = focal * np.float64(cloud[point, 1]) / z + middle[1]
        if not (across >= 0 and across < width and down >= 0 and down < height):
            continue
        red, green, blue = cloud[point, 3], cloud[point, 4], cloud[point, 5]
        if not (np.isfinite(red) and np.isfinite(green) and np.isfinite(blue)):
            continue
        column, row = np.int64(across), np.int64(down)  # equals floor, since neither is negative
        distance = np.float32(z)
        if distance < depth[row, column]:  # of equally near points the first stays
            depth[row, column] = distance
            if index is not None:
                index[row, column] = point
            if picture is not None:
                picture[0, row, column] = red
                picture[1, row, column] = green
                picture[2, row, column] = blue
                picture[3, row, column] = (z - nearest) / span


@compiled
@no_type_check
def halve(depth, index, coarse_depth, coarse_index):
    """Fill depth and index of an image of half the size; each pixel shows the nearest point of its four pixels."""
    coarse_depth[:] = np.inf
    coarse_index[:] = -1
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            there, half_row, half_column = depth[row, column], row >> 1, column >> 1
            least = coarse_depth[half_row, half_column]
            point = index[row, column]
            if there < least or (there == least and point < coarse_index[half_row, half_column]):
                coarse_depth[half_row, half_column] = there
                coarse_index[half_row, half_column] = point


@compiled
@no_type_check
def paint(cloud, index, level, nearest, farthest, picture):
    """Fill the four channels of `picture` from an index in which each pixel covers 2^level × 2^level pixels of it."""
    span = farthest - nearest
    picture[:] = 1.0
    for row in range(picture.shape[1]):
        for column in range(picture.shape[2]):
            point = index[row >> level, column >> level]
            if point >= 0:
                for channel in range(3):
                    picture[channel, row, column] = cloud[point, 3 + channel]
                picture[3, row, column] = (np.float64(cloud[point, 2]) - nearest) / span


@compiled
@no_type_check
def splat(picture, nearest, span, focal, thick, around, close, weights, filled):
    """Fill the five channels of `filled` from the four of `picture`, as `splats.splatted` describes.

    Args:
        picture: (4, height, width), as `project` fills it.
        nearest: smallest depth of the fourth channel, metres.
        span: range of depths of the fourth channel, metres.
        focal: focal length, pixels.
        thick: thickness of a surface, pixels.
        around: (places, 2) rows and columns of the offsets in the disc of a splat, row by row.
        close: (places, 2) rows and columns of the offsets in the disc that closes holes, row by row.
        weights: weight of a point, indexed by its squared distance and the squared distance of the nearest point.
        filled: (5, height, width).
    """
    height, width = picture.shape[1:]
    longest, radius = len(weights), around[-1, 0]
    border = max(radius, close[-1, 0] + 1)
    filled[:] = 1.0
    seen = np.empty((height * width, 2), np.int64)
    count, least, most = 0, width, -1
    for row in range(height):
        for column in range(width):
            if picture[3, row, column] < 1:
                seen[count, 0], seen[count, 1] = row, column
                least, most = min(least, column), max(most, column)
                count += 1
    if count == 0:
        return
    # All that follows runs on the bounding box of the points and a border. The border holds their discs and the
    # pixels beside the near ones.
    top, left = seen[0, 0] - border, least - border
    box = (seen[count - 1, 0] + border + 1 - top, most + border + 1 - left)
    away, factor = np.empty(len(around), np.uint64), np.empty(len(around))
    for place in range(len(around)):
        away[place] = around[place, 0] ** 2 + around[place, 1] ** 2
        factor[place] = 1 + np.float64(away[place]) ** 0.5 / focal
    first = np.full(box, np.inf)
    square = np.full(box, longest, np.uint64)
    near = np.zeros(box, np.bool_)
    for point in range(count):
        row, column = seen[point]
        depth = nearest + span * np.float64(picture[3, row, column])
        row, column = row - top, column - left
        for place in range(len(around)):
            # unsigned indices spare the check for negative ones, which count from the end
            down, across = np.uint64(row + around[place, 0]), np.uint64(column + around[place, 1])
            cone = depth * factor[place]
            there = first[down, across]
            if cone <= there and (cone < there or away[place] < square[down, across]):
                first[down, across] = cone
                square[down, across] = away[place]
        for place in range(len(close)):
            near[row + close[place, 0], column + close[place, 1]] = True
    # Erosion: each pixel of the image that no point is near removes its disc. Pixels beside a near one suffice.
    outside = np.zeros(box, np.bool_)
    low, high = max(-top, 0), min(height - top, box[0])
    start, stop = max(-left, 0), min(width - left, box[1])
    for row in range(low, high):
        for column in range(start, stop):
            if not near[row, column] and (
                (row > 0 and near[row - 1, column])
                or (row + 1 < box[0] and near[row + 1, column])
                or (column > 0 and near[row, column - 1])
                or (column + 1 < box[1] and near[row, column + 1])
            ):
                for place in range(len(close)):
                    down, across = row + close[place, 0], column + close[place, 1]
                    if 0 <= down < box[0] and 0 <= across < box[1]:
                        outside[down, across] = True
    behind = np.where(near & ~outside, first * (1 + thick / focal), -np.inf)
    total = np.zeros((*box, 5))
    for point in range(count):
        row, column = seen[point]
        red, green = np.float64(picture[0, row, column]), np.float64(picture[1, row, column])
        blue, far = np.float64(picture[2, row, column]), np.float64(picture[3, row, column])
        depth = nearest + span * far
        row, column = row - top, column - left
        for place in range(len(around)):
            down, across = np.uint64(row + around[place, 0]), np.uint64(column + around[place, 1])
            if depth < behind[down, across]:
                one = weights[away[place], square[down, across]]
                pixel = total[down, across]
                pixel[0] += one * red
                pixel[1] += one * green
                pixel[2] += one * blue
                pixel[3] += one * far
                pixel[4] += one
    for row in range(low, high):
        for column in range(start, stop):
            if square[row, column] < longest:
                distance = np.float64(square[row, column]) ** 0.5
                filled[4, row + top, column + left] = distance / (radius + 1)
            if behind[row, column] > 0:
                for channel in range(4):
                    mean = total[row, column, channel] / total[row, column, 4]
                    filled[channel, row + top, column + left] = mean
