"""Compiled functions on NumPy arrays that find which point of a cloud each pixel shows, on one CPU core.

Arrays:
    cloud: (points, columns) float32 or float64: x, y, z in the canonical camera's coordinates, metres; red, green,
        blue.
    depth: (height, width) float32: depth of the point that the pixel shows, metres; infinite if it shows no point.
    index: (height, width) int32: index of the point that the pixel shows; -1 if it shows no point.
    image: (channels, height, width), of the cloud's dtype.
"""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.geometry import lanes
from framework.geometry.lanes import LANES, gather, load, mask, store, where
from framework.geometry.lanes import splat as spread
from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("projection", [Path(__file__), Path(lanes.__file__)]))


@compiled
@no_type_check
def project(cloud, focal, middle, nearest, farthest, depth, index, image):
    """Fill `depth`, and either `index` or `image`, for the points of one cloud that a camera sees.

    The visible points are those that `encoder.visible_points_in_torch` finds; pixels are computed in float64. Points
    with NaN are left out, because a NaN fails every comparison.

    Args:
        cloud: (points, columns): x, y, z in the camera's coordinates, metres; red, green, blue.
        focal: focal length, pixels.
        middle: (column, row) of the principal point, pixels, from the upper left corner of the image. These numbers are
            larger by 0.5 than those from the centre of the first pixel.
        nearest: smallest depth of a visible point, metres.
        farthest: depth from which on points are not visible, metres.
        depth: (height, width), filled with the depth of the point that each pixel shows, metres; infinite without a
            point.
        index: (height, width), filled with the index of this point, or -1 without a point; None if `image` is filled.
        image: (4, height, width), filled with the point's colour and scaled depth, or 1 without a point; None if
            `index` is filled.
    """
    height, width = depth.shape
    depth[:] = np.inf
    if index is not None:
        index[:] = -1
    if image is not None:
        image[:] = 1.0
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
        column, row = np.int64(across), np.int64(down)  # equals floor, because neither number is negative
        distance = np.float32(z)
        if distance < depth[row, column]:  # of equally near points the first one is shown
            depth[row, column] = distance
            if index is not None:
                index[row, column] = point
            if image is not None:
                image[0, row, column] = red
                image[1, row, column] = green
                image[2, row, column] = blue
                image[3, row, column] = (z - nearest) / span


@compiled
@no_type_check
def halve(depth, index, coarse_depth, coarse_index):
    """Fill depth and index of an image of half the size.

    Each pixel shows the nearest of the points that the four pixels at its place show.

    Args:
        depth: (height, width), depth of the point that each pixel shows, metres; infinite if it shows no point.
        index: (height, width), index of the point that each pixel shows; -1 if it shows no point.
        coarse_depth: (rows, columns), filled with the depths of the image of half the size, metres.
        coarse_index: (rows, columns), filled with the indices of the points that the image of half the size shows.
    """
    coarse_depth[:] = np.inf
    coarse_index[:] = -1
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            pixel_depth, half_row, half_column = depth[row, column], row >> 1, column >> 1
            least_depth = coarse_depth[half_row, half_column]
            point = index[row, column]
            if pixel_depth < least_depth or (
                pixel_depth == least_depth and point < coarse_index[half_row, half_column]
            ):
                coarse_depth[half_row, half_column] = pixel_depth
                coarse_index[half_row, half_column] = point


@compiled
@no_type_check
def paint(cloud, index, level, nearest, farthest, image):
    """Fill `image` with the colours and depths of points; pixels without a point are 1 in all channels.

    Args:
        cloud: (points, columns): x, y, z in the canonical camera's coordinates, metres; red, green, blue.
        index: (rows, columns). Entry (i, j) is the row of `cloud` that is visible in square (i, j) of 2^level × 2^level
            pixels of `image`; negative if no point is visible in the square.
        level: base-2 logarithm of the side of a square.
        nearest: depth that becomes 0 in the fourth channel, metres.
        farthest: depth that becomes 1 in the fourth channel, metres.
        image: (4, height, width), filled with red, green, blue and scaled depth.
    """
    span = farthest - nearest
    image[:] = 1.0
    for row in range(image.shape[1]):
        for column in range(image.shape[2]):
            point = index[row >> level, column >> level]
            if point >= 0:
                for channel in range(3):
                    image[channel, row, column] = cloud[point, 3 + channel]
                image[3, row, column] = (np.float64(cloud[point, 2]) - nearest) / span


@compiled
@no_type_check
def splat(image, nearest, span, focal, thick, around, close, weights, filled):
    """Fill the five channels of `filled` from the four of `image`, as `splats.compute_surface` describes.

    Args:
        image: (4, height, width), as `project` fills it.
        nearest: smallest depth of the fourth channel, metres.
        span: range of depths of the fourth channel, metres.
        focal: focal length, pixels.
        thick: thickness of a surface, in widths of a pixel at the surface's depth.
        around: (offsets, 2), row and column of each offset in the disc of a splat, row by row.
        close: (offsets, 2), row and column of each offset in the disc that closes holes, row by row.
        weights: table of the weights of points, as `splats.weights` returns it.
        filled: image of the surface, (5, height, width).
    """
    height, width = image.shape[1:]
    longest, radius = len(weights), around[-1, 0]
    border = max(radius, close[-1, 0] + 1)
    filled[:] = 1.0
    pixels = np.empty((height * width, 2), np.int64)
    count, least, most = 0, width, -1
    for row in range(height):
        for column in range(width):
            if image[3, row, column] < 1:
                pixels[count, 0], pixels[count, 1] = row, column
                least, most = min(least, column), max(most, column)
                count += 1
    if count == 0:
        return
    # The rest of the function runs on the bounding box of the points, widened by a border. The border contains the
    # discs around the points and the pixels beside the `near` pixels. The rows of a disc are vectors of 16 pixels, of
    # which those beyond the disc are left out. The vectors may end beyond the box, so that a row has `line` pixels.
    top, left = pixels[0, 0] - border, least - border
    box = (pixels[count - 1, 0] + border + 1 - top, most + border + 1 - left)
    line = box[1] + LANES
    side = 2 * radius + 1
    vectors = (side + LANES - 1) // LANES
    square_of_offset = np.full(side * vectors * LANES, longest, np.int64)
    factor = np.full(side * vectors * LANES, np.inf)
    inside = np.zeros(side * vectors, np.int64)
    for number in range(len(around)):
        place = (around[number, 0] + radius) * vectors * LANES + around[number, 1] + radius
        square_of_offset[place] = around[number, 0] ** 2 + around[number, 1] ** 2
        factor[place] = 1 + np.float64(square_of_offset[place]) ** 0.5 / focal
        inside[place // LANES] |= 1 << (place % LANES)
    first = np.full(box[0] * line, np.inf)
    square = np.full(box[0] * line, longest, np.int64)
    near = np.zeros(box, np.bool_)
    for point in range(count):
        row, column = pixels[point]
        depth = spread(nearest + span * np.float64(image[3, row, column]))
        row, column = row - top, column - left
        for number in range(side * vectors):
            at = (row + number // vectors - radius) * line + column - radius + number % vectors * LANES
            cone, nearest_cone = depth * load(factor, LANES * number), load(first, at)
            squared, smallest = load(square_of_offset, LANES * number), load(square, at)
            ahead = (cone < nearest_cone) | ((cone == nearest_cone) & (squared < smallest))
            store(first, at, where(ahead, cone, nearest_cone))
            store(square, at, where(ahead, squared, smallest))
        for number in range(len(close)):
            near[row + close[number, 0], column + close[number, 1]] = True
    # Erosion: each pixel of the image that is not `near` removes the disc around itself. Only pixels beside a `near`
    # pixel need to be visited.
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
                for number in range(len(close)):
                    down, across = row + close[number, 0], column + close[number, 1]
                    if 0 <= down < box[0] and 0 <= across < box[1]:
                        outside[down, across] = True
    behind = np.full(box[0] * line, -np.inf)
    for row in range(box[0]):
        for column in range(box[1]):
            if near[row, column] and not outside[row, column]:
                behind[row * line + column] = first[row * line + column] * (1 + thick / focal)
    table, length = weights.reshape(-1), spread(longest)
    sums = np.zeros((5, box[0] * line))
    red, green, blue, far, mass = sums[0], sums[1], sums[2], sums[3], sums[4]
    for point in range(count):
        row, column = pixels[point]
        depth = np.float64(image[3, row, column])
        colors = (
            spread(np.float64(image[0, row, column])),
            spread(np.float64(image[1, row, column])),
            spread(np.float64(image[2, row, column])),
            spread(depth),
        )
        depth = spread(nearest + span * depth)
        row, column = row - top, column - left
        for number in range(side * vectors):
            at = (row + number // vectors - radius) * line + column - radius + number % vectors * LANES
            shown = (depth < load(behind, at)) & mask(inside[number])
            index = load(square_of_offset, LANES * number) * length + load(square, at)
            weight = gather(table, index, shown)
            store(red, at, load(red, at) + weight * colors[0])
            store(green, at, load(green, at) + weight * colors[1])
            store(blue, at, load(blue, at) + weight * colors[2])
            store(far, at, load(far, at) + weight * colors[3])
            store(mass, at, load(mass, at) + weight)
    for row in range(low, high):
        for column in range(start, stop):
            at = row * line + column
            if square[at] < longest:
                filled[4, row + top, column + left] = np.float64(square[at]) ** 0.5 / (radius + 1)
            if behind[at] > 0:
                filled[0, row + top, column + left] = red[at] / mass[at]
                filled[1, row + top, column + left] = green[at] / mass[at]
                filled[2, row + top, column + left] = blue[at] / mass[at]
                filled[3, row + top, column + left] = far[at] / mass[at]
