"""Colours, depths, texture coordinates and normals of the visible face at each pixel; compiled functions.

Arrays are described in `raster`. The visible faces were found with corners rounded to 1/256 pixel; here the corners are
not rounded. A pixel may therefore lie up to 1/256 pixel beside the face that it shows. It then has the colour of the
nearest point of the face.

Args:
    colors: (vertices, channels), or None for white vertices.
    texture: `textures.TextureArrays`, or None.
    lens: fx, fy, cx, cy, pixels.
    face: (height, width) int32, index of the face that each pixel shows, -1 for background.
"""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import SUBPIXELS, compiled, edges, to_edge
from plugins.renderer.rasterizer.textures import find_texels, interpolate, interpolate_uv


@compiled
@no_type_check
def pixel_weights(ax, ay, near0, bx, by, near1, cx, cy, near2, row, column):
    """Return perspective-correct barycentric weights of a face at a pixel that shows it: (w / z) / Σ (w / z).

    w are the barycentric weights of the pixel in the triangle on the screen, and z the depths of the corners. For a
    pixel beside the triangle, the result is that of `weights_beside`.

    Args:
        ax: column of the first corner in 1/256 pixel, not rounded.
        ay: row of the first corner in 1/256 pixel, not rounded.
        near0: 1 / depth of the first corner, 1/metre.
        bx: column of the second corner.
        by: row of the second corner.
        near1: 1 / depth of the second corner.
        cx: column of the third corner.
        cy: row of the third corner.
        near2: 1 / depth of the third corner.
        row: row of the pixel.
        column: column of the pixel.
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
    """Return the barycentric weights of the point of a face that is nearest, on the screen, to a pixel beside the face.

    The arguments are those of `pixel_weights`: column, row and 1 / depth of each corner, then row and column of the
    pixel.
    """
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
def weights_in_space(camera_points, a, b, c, ray_x, ray_y):
    """Return barycentric weights of a face that may have corners behind the camera, for a ray r = (ray_x, ray_y, 1).

    For the corners A, B, C in camera coordinates, the weights are r·(B × C), r·(C × A), r·(A × B) over their sum (Olano
    & Greer 1997). `a`, `b` and `c` are the indices of the corners in `camera_points`.
    """
    part0 = scalar_triple_product(camera_points, b, c, ray_x, ray_y)
    part1 = scalar_triple_product(camera_points, c, a, ray_x, ray_y)
    part2 = scalar_triple_product(camera_points, a, b, ray_x, ray_y)
    sign = 1.0 if part0 + part1 + part2 > 0 else -1.0
    # rounding of corners may leave the pixel a little outside of the face
    part0, part1, part2 = max(sign * part0, 0.0), max(sign * part1, 0.0), max(sign * part2, 0.0)
    total = part0 + part1 + part2
    if not (total > 0 and total < np.inf):  # seen edge-on
        return 1.0 / 3, 1.0 / 3, 1.0 / 3
    return part0 / total, part1 / total, part2 / total


@compiled
@no_type_check
def scalar_triple_product(camera_points, a, b, ray_x, ray_y):
    """Return r · (A × B) for a ray r = (ray_x, ray_y, 1) and two vertices A and B in camera coordinates.

    `a` and `b` are the indices of the vertices in `camera_points`.
    """
    ax, ay, az = camera_points[a, 0], camera_points[a, 1], camera_points[a, 2]
    bx, by, bz = camera_points[b, 0], camera_points[b, 1], camera_points[b, 2]
    return ray_x * (ay * bz - az * by) + ray_y * (az * bx - ax * bz) + (ax * by - ay * bx)


@compiled
@no_type_check
def weights_at(camera_points, screen, faces, lens, index, row, column):
    """Return barycentric weights of face `index` at the pixel (row, column), which shows this face."""
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    if screen[a, 2] != 0 and screen[b, 2] != 0 and screen[c, 2] != 0:
        near0, near1, near2 = screen[a, 2], screen[b, 2], screen[c, 2]
        ax, ay, bx, by = screen[a, 3], screen[a, 4], screen[b, 3], screen[b, 4]
        return pixel_weights(ax, ay, near0, bx, by, near1, screen[c, 3], screen[c, 4], near2, row, column)
    return weights_in_space(camera_points, a, b, c, (column - lens[2]) / lens[0], (row - lens[3]) / lens[1])


@compiled
@no_type_check
def fill_color(faces, colors, texture, index, w0, w1, w2, image, row, column):
    """Fill the pixel (row, column) of an image with the colour of face `index` at the barycentric weights w0, w1, w2.

    `image` has the shape (height, width, channels).
    """
    if colors is None:
        for channel in range(image.shape[2]):
            image[row, column, channel] = 1.0
    else:
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        for channel in range(image.shape[2]):
            image[row, column, channel] = (
                w0 * colors[a, channel] + w1 * colors[b, channel] + w2 * colors[c, channel]
            )
    if texture is not None:
        multiply_by_texture(texture, index, w0, w1, w2, image, row, column)


@compiled
@no_type_check
def multiply_by_texture(texture, index, w0, w1, w2, image, row, column):
    """Multiply the pixel (row, column) of an image by the texture of face `index` at barycentric weights w0, w1, w2.

    If the face has no texture, do nothing.
    """
    if texture.shown[index] < 0:
        return
    u, v = interpolate_uv(texture, index, w0, w1, w2)
    texels = find_texels(texture, texture.shown[index], u, v)
    for channel in range(image.shape[2]):
        image[row, column, channel] *= interpolate(texture, texels, channel)


@compiled
@no_type_check
def shade(camera_points, screen, faces, colors, texture, lens, near, face, box, color, depth):
    """Fill `color` (height, width, channels) and `depth` (height, width), or one of them, at pixels that show a face.

    Depths are clamped to at least `near`, the distance of the near plane in metres. The docstrings of this module and
    of `raster` describe the other arrays.
    """
    top, bottom, left, right = box
    for row in range(top, bottom):
        for column in range(left, right):
            index = face[row, column]
            if index < 0:
                continue
            # inlined copy of `weights_at` and `fill_color`: a call per pixel would count references to every array
            a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
            near0, near1, near2 = screen[a, 2], screen[b, 2], screen[c, 2]
            if near0 != 0 and near1 != 0 and near2 != 0:
                ax, ay, bx, by = screen[a, 3], screen[a, 4], screen[b, 3], screen[b, 4]
                cx, cy = screen[c, 3], screen[c, 4]
                w0, w1, w2 = pixel_weights(ax, ay, near0, bx, by, near1, cx, cy, near2, row, column)
            else:
                ray_x, ray_y = (column - lens[2]) / lens[0], (row - lens[3]) / lens[1]
                w0, w1, w2 = weights_in_space(camera_points, a, b, c, ray_x, ray_y)
            if depth is not None:
                depth[row, column] = max(
                    w0 * camera_points[a, 2] + w1 * camera_points[b, 2] + w2 * camera_points[c, 2], near
                )
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
            if texture is not None:
                multiply_by_texture(texture, index, w0, w1, w2, color, row, column)


@compiled
@no_type_check
def fill_surface_channels(
    camera_points, screen, vertices, faces, texture, lens, face, box, normal, barycentric, uv
):
    """Fill `normal`, `barycentric` and `uv`, (height, width, 3 or 2), at pixels that show a face; any may be None.

    The docstrings of this module and of `raster` describe the other arrays.
    """
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
            w0, w1, w2 = weights_at(camera_points, screen, faces, lens, index, row, column)
            if barycentric is not None:
                barycentric[row, column, 0] = w0
                barycentric[row, column, 1] = w1
                barycentric[row, column, 2] = w2
            if uv is not None and texture is not None and texture.shown[index] >= 0:
                uv[row, column, 0], uv[row, column, 1] = interpolate_uv(texture, index, w0, w1, w2)


@compiled
@no_type_check
def normal_of(vertices, faces, index):
    """Return the unit normal of a face on the side from which its corners are counter-clockwise; 0 without area."""
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
