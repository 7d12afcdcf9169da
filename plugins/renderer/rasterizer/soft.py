"""Soft image of Liu, Li, Chen & Li, "Soft Rasterizer" (ICCV 2019, section 3), and its gradient; compiled functions.

The colour of a pixel is A_O A_S. A_S blends the colours of the faces near the pixel by nearness and coverage. A_O is
the soft silhouette, which the paper returns separately; here it blends A_S with a black background:

    D_j = sigmoid(± d² / σ), with + inside of the face and - outside
    w_j = D_j exp(z_j / γ) / (Σ_k D_k exp(z_k / γ) + exp(ε / γ))
    A_S = Σ_j w_j C_j + w_b 0
    A_O = 1 - Π_j (1 - D_j)

C_j is the colour of face j at the pixel, and w_b = 1 - Σ_j w_j is the weight of the background, whose colour is 0. d is
the distance from the pixel to the face's border, in units in which the image's shorter side is 2; z_j, "normalised
inverse depth", is the depth of the nearest vertex in view over the depth of face j, and ε (`BACKGROUND`) is that of the
background. Outside of a face, its colour and depth use its barycentric weights, clipped at 0 and scaled to the sum 1.
This follows the published kernel, which also ignores a face at pixels with D < 1e-4. In contrast to that kernel,
colours and depths are perspective-correct. Corners are not rounded. A face that the near plane cuts is left out.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.boundary import add_screen_gradient
from plugins.renderer.rasterizer.raster import BACK, BEHIND, DRAWN, FLAT, OUTSIDE, compiled, to_edge

BACKGROUND = 1e-3  # ε, as published
REACH = math.log(1e4 - 1)  # -log(odds) of D = 1e-4
HIDDEN = 40.0  # nats; 1 + e^-40 is 1 in float64
FLATTEST = 1e-12  # area over the square of the longest side


@dataclass
class SoftImage:
    """A soft image and the data that its gradient reads.

    Attributes:
        positions: (vertices, 2) float64, column and row, pixels.
        bounds: (faces, 4) int64, first row, last row + 1, first column, last column + 1 of the pixels near a face.
        nearest: index of the nearest vertex in view, whose depth is the unit of depths; -1 if nothing is in view.
        scales: 1 / σ in 1/pixel², γ, and the result of `blur_margin`, pixels.
        most: (height, width) float64, the largest z_j, or ε if it is larger.
        total: (height, width) float64, Σ_j D_j exp((z_j - most) / γ) plus the background's term exp((ε - most) / γ).
        clear: (height, width) float64, Π_j (1 - D_j).
        mean: (height, width, channels) float64, A_S.
        color: (height, width, channels) float64, A_O A_S.
    """

    positions: np.ndarray
    bounds: np.ndarray
    nearest: int
    scales: tuple[float, float, float]
    most: np.ndarray
    total: np.ndarray
    clear: np.ndarray
    mean: np.ndarray
    color: np.ndarray


def blur_margin(sigma: float, size: tuple[int, int]) -> float:
    """Return the largest distance from a face, in pixels, at which a pixel outside of the face still shows the face.

    `sigma` is σ, the blur of coverage, a squared distance in units in which the image's shorter side is 2. `size` is
    the (height, width) of the image in pixels.
    """
    return math.sqrt(REACH * sigma) * min(size) / 2


def render(
    camera_points: np.ndarray,
    screen: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    lens: np.ndarray,
    cull: bool,
    size: tuple[int, int],
    sigma: float,
    gamma: float,
    counts: np.ndarray,
) -> SoftImage:
    """Return the soft image of the vertices from `raster.project`.

    Args:
        camera_points: (vertices, 3), vertices in camera coordinates, metres.
        screen: (vertices, 5), projected vertices, as `raster` describes them.
        faces: (faces, 3), indices of vertices.
        colors: (vertices, channels).
        lens: fx, fy, cx, cy, pixels.
        cull: whether faces seen from behind are left out.
        size: height and width of the image, pixels.
        sigma: σ, the blur of coverage, a squared distance in units in which the image's shorter side is 2.
        gamma: γ, the blur of depth, in units of the ratio of the nearest depth to a face's depth.
        counts: the number of faces with each outcome is added, as in `raster.rasterise`.
    """
    positions, bounds = np.zeros((len(camera_points), 2)), np.zeros((len(faces), 4), np.int64)
    margin = blur_margin(sigma, size)
    nearest = prepare(camera_points, screen, faces, lens, cull, *size, margin, positions, bounds, counts)
    scales = (4 / (sigma * min(size) ** 2), gamma, margin)
    most, total, clear = np.full(size, BACKGROUND), np.ones(size), np.ones(size)
    mean = np.zeros((*size, colors.shape[1]))
    color = np.zeros(mean.shape)
    if nearest >= 0:
        forward(
            camera_points, faces, colors, positions, bounds, nearest, *scales, most, total, clear, mean, color
        )
    return SoftImage(positions, bounds, nearest, scales, most, total, clear, mean, color)


def add_gradients(
    camera_points: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    lens: np.ndarray,
    blend_data: SoftImage,
    grad_image: np.ndarray,
    grad_points: np.ndarray,
    grad_colors: np.ndarray,
    grad_lens: np.ndarray,
) -> None:
    """Add the gradients of a loss to `grad_points`, `grad_colors` and `grad_lens`.

    `grad_image` is the gradient of the loss with respect to the image, and `blend_data` the result of `render` for the
    same camera points, faces, colours and lens.
    """
    if blend_data.nearest >= 0:
        arrays = (blend_data.positions, blend_data.bounds, blend_data.nearest, *blend_data.scales)
        arrays += (blend_data.most, blend_data.total, blend_data.clear, blend_data.mean)
        backward(
            (camera_points, faces, colors, lens), arrays, grad_image, (grad_points, grad_colors, grad_lens)
        )


@compiled
@no_type_check
def prepare(camera_points, screen, faces, lens, cull, height, width, margin, positions, bounds, counts):
    """Fill `positions` and `bounds` of `SoftImage`, and return the index of the nearest vertex in view, or -1.

    The number of faces with each outcome is added to `counts`, as in `raster.rasterise`. -1 means that no face is in
    view. `margin` is the result of `blur_margin`. With `cull`, faces seen from behind are left out. `raster` describes
    the arrays `camera_points` and `screen`.
    """
    for vertex in range(camera_points.shape[0]):
        if screen[vertex, 2] != 0:
            for axis in range(2):
                positions[vertex, axis] = (
                    lens[axis] * camera_points[vertex, axis] / camera_points[vertex, 2] + lens[2 + axis]
                )
    nearest = -1
    for index in range(faces.shape[0]):
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        if screen[a, 2] == 0 or screen[b, 2] == 0 or screen[c, 2] == 0:
            counts[BEHIND] += 1
            continue
        ux, uy = positions[b, 0] - positions[a, 0], positions[b, 1] - positions[a, 1]
        vx, vy = positions[c, 0] - positions[a, 0], positions[c, 1] - positions[a, 1]
        area = ux * vy - vx * uy
        longest = max(ux * ux + uy * uy, vx * vx + vy * vy)
        if not abs(area) > FLATTEST * longest:
            counts[FLAT] += 1
            continue
        if cull and area > 0:
            counts[BACK] += 1
            continue
        for axis in range(2):
            last = (width if axis == 0 else height) - 1.0
            low = min(positions[a, axis], positions[b, axis], positions[c, axis]) - margin
            high = max(positions[a, axis], positions[b, axis], positions[c, axis]) + margin
            if high >= 0 and low <= last:
                bounds[index, 2 - 2 * axis] = np.int64(np.ceil(max(low, 0.0)))
                bounds[index, 3 - 2 * axis] = np.int64(np.floor(min(high, last))) + 1
        if bounds[index, 0] >= bounds[index, 1] or bounds[index, 2] >= bounds[index, 3]:
            bounds[index] = 0
            counts[OUTSIDE] += 1
            continue
        counts[DRAWN] += 1
        for corner in range(3):
            vertex = faces[index, corner]
            if nearest < 0 or camera_points[vertex, 2] < camera_points[nearest, 2]:
                nearest = vertex
    return nearest


@compiled
@no_type_check
def face_corners(positions, a, b, c):
    """Return column and row, pixels, of the three corners of a face.

    `positions` is that of `SoftImage`; `a`, `b` and `c` are the indices of the face's vertices.
    """
    return (
        positions[a, 0],
        positions[a, 1],
        positions[b, 0],
        positions[b, 1],
        positions[c, 0],
        positions[c, 1],
    )


@compiled
@no_type_check
def screen_weights(ax, ay, bx, by, cx, cy, x, y):
    """Return barycentric weights of the point (x, y) in the triangle (ax, ay), (bx, by), (cx, cy) on the screen."""
    inverse = 1.0 / ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    return (
        ((bx - x) * (cy - y) - (cx - x) * (by - y)) * inverse,
        ((cx - x) * (ay - y) - (ax - x) * (cy - y)) * inverse,
        ((ax - x) * (by - y) - (bx - x) * (ay - y)) * inverse,
    )


@compiled
@no_type_check
def triangle_heights(ax, ay, bx, by, cx, cy):
    """Return the three heights of the triangle (ax, ay), (bx, by), (cx, cy), pixels.

    Height i is the distance of corner i from the line through the opposite edge.
    """
    area = abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    return (
        area / np.hypot(cx - bx, cy - by),
        area / np.hypot(ax - cx, ay - cy),
        area / np.hypot(bx - ax, by - ay),
    )


@compiled
@no_type_check
def distance_to_border(corners, heights, w0, w1, w2, x, y):
    """Return the squared distance from (x, y) to a triangle's border, the side of the point, and the nearest edge.

    The side is 1 for a point inside of the triangle and -1 for one outside. The number of an edge is that of the
    opposite corner. For a point inside, the distance is measured to the lines of all edges; for a point outside, to the
    edges that have the point on their outer side.

    Args:
        corners: column and row of the three corners, as `face_corners` returns them.
        heights: heights of the triangle, as `triangle_heights` returns them.
        w0: barycentric weight of the first corner at the point.
        w1: weight of the second corner.
        w2: weight of the third corner.
        x: column of the point.
        y: row of the point.
    """
    ax, ay, bx, by, cx, cy = corners
    least, edge = np.inf, 0
    if w0 >= 0 and w1 >= 0 and w2 >= 0:
        d0, d1, d2 = w0 * heights[0], w1 * heights[1], w2 * heights[2]
        if d0 <= d1 and d0 <= d2:
            return d0 * d0, 1.0, 0
        return (d1 * d1, 1.0, 1) if d1 <= d2 else (d2 * d2, 1.0, 2)
    if w0 < 0:
        least, _ = to_edge(bx, by, cx, cy, x, y)
    if w1 < 0:
        squared, _ = to_edge(cx, cy, ax, ay, x, y)
        if squared < least:
            least, edge = squared, 1
    if w2 < 0:
        squared, _ = to_edge(ax, ay, bx, by, x, y)
        if squared < least:
            least, edge = squared, 2
    return least, -1.0, edge


@compiled
@no_type_check
def weigh_pixel(corners, heights, low, sharpness, x, y):
    """Return the three barycentric weights, the side, the nearest edge and exp(-d²/σ) of the pixel (x, y).

    d is the distance from the pixel to the triangle's border. The side is 1 inside of the triangle, -1 outside, and 0
    if the pixel is too far away to show the face.

    Args:
        corners: column and row of the three corners, as `face_corners` returns them.
        heights: heights of the triangle, as `triangle_heights` returns them.
        low: limit of each weight; a pixel with a weight below its limit is too far away.
        sharpness: 1 / σ in 1/pixel².
        x: column of the pixel.
        y: row of the pixel.
    """
    w0, w1, w2 = screen_weights(*corners, x, y)
    if w0 < low[0] or w1 < low[1] or w2 < low[2]:
        return w0, w1, w2, 0.0, 0, 0.0
    squared, side, edge = distance_to_border(corners, heights, w0, w1, w2, x, y)
    if side < 0 and squared * sharpness > REACH:
        side = 0.0
    return w0, w1, w2, side, edge, np.exp(-squared * sharpness)


@compiled
@no_type_check
def clip_weights(w0, w1, w2):
    """Return the weights, clipped at 0 and scaled to the sum 1, and their sum before scaling."""
    w0, w1, w2 = max(w0, 0.0), max(w1, 0.0), max(w2, 0.0)
    scale = w0 + w1 + w2
    return w0 / scale, w1 / scale, w2 / scale, scale


@compiled
@no_type_check
def forward(
    camera_points,
    faces,
    colors,
    positions,
    bounds,
    nearest,
    sharpness,
    gamma,
    margin,
    most,
    total,
    clear,
    mean,
    color,
):
    """Fill the arrays `most`, `total`, `clear`, `mean` and `color` of `SoftImage`, face by face.

    The sums `total` and `mean` are relative to exp(most / γ); they are rescaled whenever a face increases `most`.
    `positions`, `bounds` and `nearest` are those of `SoftImage`; `sharpness`, `gamma` and `margin` are the three
    numbers of its `scales`.
    """
    channels = colors.shape[1]
    height, width = most.shape
    unit = camera_points[nearest, 2]
    for index in range(faces.shape[0]):
        top, bottom, left, right = bounds[index]
        if top >= bottom:
            continue
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        corners = face_corners(positions, a, b, c)
        heights = triangle_heights(*corners)
        low = -margin / heights[0], -margin / heights[1], -margin / heights[2]
        near0, near1, near2 = 1.0 / camera_points[a, 2], 1.0 / camera_points[b, 2], 1.0 / camera_points[c, 2]
        for row in range(top, bottom):
            for column in range(left, right):
                w0, w1, w2, side, _, doubt = weigh_pixel(corners, heights, low, sharpness, column, row)
                if side == 0:
                    continue
                covered = (1.0 if side > 0 else doubt) / (1 + doubt)
                clear[row, column] *= (doubt if side > 0 else 1.0) / (1 + doubt)
                q0, q1, q2, _ = clip_weights(w0, w1, w2)
                a0, a1, a2 = q0 * near0, q1 * near1, q2 * near2
                inverse = a0 + a1 + a2
                nearness = unit * inverse
                above = (nearness - most[row, column]) / gamma
                if above < -HIDDEN:
                    continue
                if above > 0:
                    scale = np.exp(-above)
                    most[row, column] = nearness
                    total[row, column] *= scale
                    for channel in range(channels):
                        mean[row, column, channel] *= scale
                    above = 0.0
                weight = np.exp(above) * covered
                total[row, column] += weight
                weight /= inverse
                for channel in range(channels):
                    mean[row, column, channel] += weight * (
                        a0 * colors[a, channel] + a1 * colors[b, channel] + a2 * colors[c, channel]
                    )
    for row in range(height):
        for column in range(width):
            if clear[row, column] < 1:
                opacity = 1 - clear[row, column]  # A_O
                for channel in range(channels):
                    mean[row, column, channel] /= total[row, column]  # A_S
                    color[row, column, channel] = opacity * mean[row, column, channel]


@compiled
@no_type_check
def backward(scene, blend_data, grad_image, sums):
    """Add the gradients of the loss to the arrays in `sums`, face by face.

    The terms of each face and pixel are computed again, because `forward` does not store them.

    Args:
        scene: camera points, faces, colours and lens.
        blend_data: arrays and scales of `SoftImage`.
        grad_image: gradient of the loss with respect to the image, (height, width, channels).
        sums: gradients with respect to camera points, colours and lens.
    """
    camera_points, faces, colors, lens = scene
    positions, bounds, nearest, sharpness, gamma, margin, most, total, clear, mean = blend_data
    grad_points, grad_colors, grad_lens = sums
    channels = colors.shape[1]
    unit = camera_points[nearest, 2]
    height, width = most.shape
    grad_dot_mean = np.zeros((height, width))  # g · A_S
    live = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            if clear[row, column] < 1:
                for channel in range(channels):
                    slope = np.float64(grad_image[row, column, channel])
                    grad_dot_mean[row, column] += slope * mean[row, column, channel]
                    live[row, column] |= slope != 0
    grad_corners = np.empty(6)
    for index in range(faces.shape[0]):
        top, bottom, left, right = bounds[index]
        if top >= bottom:
            continue
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        corners = face_corners(positions, a, b, c)
        heights = triangle_heights(*corners)
        low = -margin / heights[0], -margin / heights[1], -margin / heights[2]
        ax, ay, bx, by, cx, cy = corners
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        near0, near1, near2 = 1.0 / camera_points[a, 2], 1.0 / camera_points[b, 2], 1.0 / camera_points[c, 2]
        grad_corners[:] = 0.0
        grad_near0 = grad_near1 = grad_near2 = grad_unit = 0.0
        for row in range(top, bottom):
            for column in range(left, right):
                if not live[row, column]:
                    continue
                w0, w1, w2, side, edge, doubt = weigh_pixel(corners, heights, low, sharpness, column, row)
                if side == 0:
                    continue
                covered = (1.0 if side > 0 else doubt) / (1 + doubt)
                left_clear = (doubt if side > 0 else 1.0) / (1 + doubt)
                # of A_O: ∂ log(1 - D) = -D
                grad_odds = grad_dot_mean[row, column] * clear[row, column] * covered
                q0, q1, q2, scale = clip_weights(w0, w1, w2)
                a0, a1, a2 = q0 * near0, q1 * near1, q2 * near2
                inverse = a0 + a1 + a2
                above = (unit * inverse - most[row, column]) / gamma
                if above >= -HIDDEN:
                    weight = (1 - clear[row, column]) * covered * np.exp(above) / total[row, column]
                    d0 = d1 = d2 = 0.0
                    for channel in range(channels):
                        slope = weight * grad_image[row, column, channel]
                        grad_colors[a, channel] += slope * a0 / inverse
                        grad_colors[b, channel] += slope * a1 / inverse
                        grad_colors[c, channel] += slope * a2 / inverse
                        d0 += slope * colors[a, channel]
                        d1 += slope * colors[b, channel]
                        d2 += slope * colors[c, channel]
                    own = (a0 * d0 + a1 * d1 + a2 * d2) / inverse
                    gained = own - weight * grad_dot_mean[row, column]  # ∂L / ∂ log(D exp(z / γ))
                    grad_odds += gained * left_clear  # ∂ log D = 1 - D
                    grad_unit += gained / gamma * inverse
                    # through C_j = Σ a c / Σ a and z_j = unit Σ a, with a = q / depth
                    d0 = (d0 - own) / inverse + unit * gained / gamma
                    d1 = (d1 - own) / inverse + unit * gained / gamma
                    d2 = (d2 - own) / inverse + unit * gained / gamma
                    grad_near0 += q0 * d0
                    grad_near1 += q1 * d1
                    grad_near2 += q2 * d2
                    d0, d1, d2 = d0 * near0, d1 * near1, d2 * near2
                    # through q = max(w, 0) / Σ max(w, 0), and w = edge function / area
                    flat = q0 * d0 + q1 * d1 + q2 * d2
                    d0 = (d0 - flat) / scale if w0 > 0 else 0.0
                    d1 = (d1 - flat) / scale if w1 > 0 else 0.0
                    d2 = (d2 - flat) / scale if w2 > 0 else 0.0
                    flat = w0 * d0 + w1 * d1 + w2 * d2
                    d0, d1, d2 = (d0 - flat) / area, (d1 - flat) / area, (d2 - flat) / area
                    grad_corners[0] += d2 * (by - row) - d1 * (cy - row)
                    grad_corners[1] += d1 * (cx - column) - d2 * (bx - column)
                    grad_corners[2] += d0 * (cy - row) - d2 * (ay - row)
                    grad_corners[3] += d2 * (ax - column) - d0 * (cx - column)
                    grad_corners[4] += d1 * (ay - row) - d0 * (by - row)
                    grad_corners[5] += d0 * (bx - column) - d1 * (ax - column)
                # through d² = |p - (1 - t) A - t B|², at the t that makes it least
                first, second = 2 * ((edge + 1) % 3), 2 * ((edge + 2) % 3)
                sx, sy = corners[first], corners[first + 1]
                ex, ey = corners[second], corners[second + 1]
                _, part = to_edge(sx, sy, ex, ey, column, row)
                down = -2 * grad_odds * side * sharpness
                down_x = down * (column - sx - part * (ex - sx))
                down_y = down * (row - sy - part * (ey - sy))
                grad_corners[first] += (1 - part) * down_x
                grad_corners[first + 1] += (1 - part) * down_y
                grad_corners[second] += part * down_x
                grad_corners[second + 1] += part * down_y
        for axis in range(2):
            add_screen_gradient(camera_points, a, axis, grad_corners[axis], lens, grad_points, grad_lens)
            add_screen_gradient(camera_points, b, axis, grad_corners[2 + axis], lens, grad_points, grad_lens)
            add_screen_gradient(camera_points, c, axis, grad_corners[4 + axis], lens, grad_points, grad_lens)
        grad_points[a, 2] -= grad_near0 * near0 * near0
        grad_points[b, 2] -= grad_near1 * near1 * near1
        grad_points[c, 2] -= grad_near2 * near2 * near2
        grad_points[nearest, 2] += grad_unit
