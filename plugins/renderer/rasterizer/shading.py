"""Colours, depths, texture places and normals of the visible face at each pixel; compiled functions.

Arrays are those of `raster`. Corners are at their projected places, not rounded. A pixel that a face covers only by the
rounding of its corners, and which lies less than 1/256 pixel beside it, shows the nearest place of the face.

Args:
    colors: (vertices, channels), or None for white vertices.
    laid: `textures.Laid`, or None.
    lens: fx, fy, cx, cy, pixels.
    face: (height, width) int32, the face that each pixel of `box` shows; -1: none.
"""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import SUBPIXELS, compiled, edges, to_edge
from plugins.renderer.rasterizer.textures import among_texels, mixed, uv_at


@compiled
@no_type_check
def weights(ax, ay, near0, bx, by, near1, cx, cy, near2, row, column):
    """Return perspective-correct barycentric weights of a face at a pixel that shows it: (w / z) / Σ (w / z).

    `ax`, `ay` and `near0` are column and row of the first corner in 1/256 pixel, not rounded, and its 1 / depth; the
    other corners follow in the same way.
    """
    edge0, edge1, edge2 = edges(ax, ay, bx, by, cx, cy, row, column)
    part0, part1, part2 = edge0 * near0, edge1 * near1, edge2 * near2
    scale = 1.0 / (part0 + part1 + part2)
    part0, part1, part2 = part0 * scale, part1 * scale, part2 * scale
    if not (part0 >= 0 and part1 >= 0 and part2 >= 0):
        part0, part1, part2 = weights_beside(ax, ay, near0, bx, by, near1, cx, cy, near2, row, column)
    return part0, part1, part2


@compiled
@no_type_check
def weights_beside(ax, ay, near0, bx, by, near1, cx, cy, near2, row, column):
    """Return the weights of the place of a face that is nearest, on the screen, to a pixel beside it."""
    x, y = column * SUBPIXELS, row * SUBPIXELS
    to_ab, part_ab = to_edge(ax, ay, bx, by, x, y)
    to_bc, part_bc = to_edge(bx, by, cx, cy, x, y)
    to_ca, part_ca = to_edge(cx, cy, ax, ay, x, y)
    if to_ab <= to_bc and to_ab <= to_ca:
        part0, part1, part2 = (1 - part_ab) * near0, part_ab * near1, 0.0
    elif to_bc <= to_ca:
        part0, part1, part2 = 0.0, (1 - part_bc) * near1, part_bc * near2
    else:
        part0, part1, part2 = part_ca * near0, 0.0, (1 - part_ca) * near2
    scale = 1.0 / (part0 + part1 + part2)
    return part0 * scale, part1 * scale, part2 * scale


@compiled
@no_type_check
def weights_in_space(seen, a, b, c, ray_x, ray_y):
    """Return barycentric weights of a face that may have corners behind the camera.

    The weights are r·(b × c) and so on over their sum (Olano & Greer 1997).
    """
    part0 = volume(seen, b, c, ray_x, ray_y)
    part1 = volume(seen, c, a, ray_x, ray_y)
    part2 = volume(seen, a, b, ray_x, ray_y)
    turn = 1.0 if part0 + part1 + part2 > 0 else -1.0
    # rounding of corners may leave the pixel a little outside of the face
    part0, part1, part2 = max(turn * part0, 0.0), max(turn * part1, 0.0), max(turn * part2, 0.0)
    total = part0 + part1 + part2
    if not (total > 0 and total < np.inf):  # seen edge-on
        return 1.0 / 3, 1.0 / 3, 1.0 / 3
    return part0 / total, part1 / total, part2 / total


@compiled
@no_type_check
def volume(seen, a, b, ray_x, ray_y):
    """Return r · (a × b) of two vertices and a ray (ray_x, ray_y, 1)."""
    ax, ay, az = seen[a, 0], seen[a, 1], seen[a, 2]
    bx, by, bz = seen[b, 0], seen[b, 1], seen[b, 2]
    return ray_x * (ay * bz - az * by) + ray_y * (az * bx - ax * bz) + (ax * by - ay * bx)


@compiled
@no_type_check
def weights_at(seen, screen, faces, lens, index, row, column):
    """Return barycentric weights of a face at a pixel that shows it."""
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    if screen[a, 2] != 0 and screen[b, 2] != 0 and screen[c, 2] != 0:
        near0, near1, near2 = screen[a, 2], screen[b, 2], screen[c, 2]
        ax, ay, bx, by = screen[a, 3], screen[a, 4], screen[b, 3], screen[b, 4]
        return weights(ax, ay, near0, bx, by, near1, screen[c, 3], screen[c, 4], near2, row, column)
    return weights_in_space(seen, a, b, c, (column - lens[2]) / lens[0], (row - lens[3]) / lens[1])


@compiled
@no_type_check
def light(faces, colors, laid, index, w0, w1, w2, picture, row, column):
    """Fill a pixel of an image, (height, width, channels), with the colour of a face at barycentric weights."""
    if colors is None:
        for channel in range(picture.shape[2]):
            picture[row, column, channel] = 1.0
    else:
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        for channel in range(picture.shape[2]):
            picture[row, column, channel] = (
                w0 * colors[a, channel] + w1 * colors[b, channel] + w2 * colors[c, channel]
            )
    if laid is not None:
        tint(laid, index, w0, w1, w2, picture, row, column)


@compiled
@no_type_check
def tint(laid, index, w0, w1, w2, picture, row, column):
    """Multiply a pixel by the colour of the face's texture there, if the face has one."""
    if laid.shown[index] < 0:
        return
    u, v = uv_at(laid, index, w0, w1, w2)
    place = among_texels(laid, laid.shown[index], u, v)
    for channel in range(picture.shape[2]):
        picture[row, column, channel] *= mixed(laid, place, channel)


@compiled
@no_type_check
def shade(seen, screen, faces, colors, laid, lens, near, face, box, color, depth):
    """Fill `color` (height, width, channel) and `depth` (height, width), or one of them, where a face is seen.

    `near` is the distance of the near plane, metres; no depth is smaller.
    """
    top, bottom, left, right = box
    for row in range(top, bottom):
        for column in range(left, right):
            index = face[row, column]
            if index < 0:
                continue
            # same as `weights_at` and `light`, but inlined: a call per pixel would count references to every array
            a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
            near0, near1, near2 = screen[a, 2], screen[b, 2], screen[c, 2]
            if near0 != 0 and near1 != 0 and near2 != 0:
                ax, ay, bx, by = screen[a, 3], screen[a, 4], screen[b, 3], screen[b, 4]
                cx, cy = screen[c, 3], screen[c, 4]
                w0, w1, w2 = weights(ax, ay, near0, bx, by, near1, cx, cy, near2, row, column)
            else:
                ray_x, ray_y = (column - lens[2]) / lens[0], (row - lens[3]) / lens[1]
                w0, w1, w2 = weights_in_space(seen, a, b, c, ray_x, ray_y)
            if depth is not None:
                depth[row, column] = max(w0 * seen[a, 2] + w1 * seen[b, 2] + w2 * seen[c, 2], near)
            if color is None:
                continue
            if colors is None:
                for channel in range(color.shape[2]):
                    color[row, column, channel] = 1.0
            if colors is not None:
                for channel in range(color.shape[2]):
                    color[row, column, channel] = (
                        w0 * colors[a, channel] + w1 * colors[b, channel] + w2 * colors[c, channel]
                    )
            if laid is not None:
                tint(laid, index, w0, w1, w2, color, row, column)


@compiled
@no_type_check
def inform(seen, screen, vertices, faces, laid, lens, face, box, normal, barycentric, uv):
    """Fill `normal`, `barycentric` and `uv`, (height, width, 3 or 2), where a face is seen; None is left out."""
    top, bottom, left, right = box
    last = -1
    x = y = z = 0.0
    for row in range(top, bottom):
        for column in range(left, right):
            index = face[row, column]
            if index < 0:
                continue
            if normal is not None:
                if index != last:
                    x, y, z = normal_of(vertices, faces, index)
                    last = index
                normal[row, column, 0], normal[row, column, 1], normal[row, column, 2] = x, y, z
            w0, w1, w2 = weights_at(seen, screen, faces, lens, index, row, column)
            if barycentric is not None:
                barycentric[row, column, 0] = w0
                barycentric[row, column, 1] = w1
                barycentric[row, column, 2] = w2
            if uv is not None and laid is not None and laid.shown[index] >= 0:
                uv[row, column, 0], uv[row, column, 1] = uv_at(laid, index, w0, w1, w2)


@compiled
@no_type_check
def normal_of(vertices, faces, index):
    """Return the unit normal on the side where a face's corners run counter-clockwise; 0 for a face without area."""
    edge = np.empty((2, 3))
    for which in range(2):
        for axis in range(3):
            start, end = vertices[faces[index, 0], axis], vertices[faces[index, which + 1], axis]
            edge[which, axis] = np.float64(end) - np.float64(start)
        largest = np.abs(edge[which]).max()
        if not (largest > 0 and largest < np.inf):
            return 0.0, 0.0, 0.0
        edge[which] /= largest
    x = edge[0, 1] * edge[1, 2] - edge[0, 2] * edge[1, 1]
    y = edge[0, 2] * edge[1, 0] - edge[0, 0] * edge[1, 2]
    z = edge[0, 0] * edge[1, 1] - edge[0, 1] * edge[1, 0]
    length = np.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length) if length > 0 else (0.0, 0.0, 0.0)
