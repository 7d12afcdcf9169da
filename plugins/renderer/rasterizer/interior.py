"""Gradients of a loss inside of faces, in colours, textures, vertices and camera; compiled functions on arrays.

Arrays are those of `raster`. In camera coordinates a pixel's ray is r = ((column - cx) / fx, (row - cy) / fy, 1), and
the barycentric weights of a face A, B, C under it are m_i / Σ m with m_0 = r·(B×C), m_1 = r·(C×A), m_2 = r·(A×B)
(homogeneous edge functions, Olano & Greer 1997): linear in every corner, and right for corners behind the camera. For
a pixel beside its face, r is the ray to the place that `shading` shows there, and this ray is taken as constant.
"""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import compiled
from plugins.renderer.rasterizer.shading import weights_at
from plugins.renderer.rasterizer.textures import among_texels, mixed, mixed_slopes, uv_at

FLATTEST = 1e-12
"""Least Σ m, relative to its terms; a flatter face is seen edge-on, and the gradient in its position is meaningless."""


@compiled
@no_type_check
def cross(a0, a1, a2, b0, b1, b2):
    """Return the cross product of two vectors."""
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@compiled
@no_type_check
def add(to, vertex, scale, x, y, z):
    """Add a scaled vector to a row of `to`."""
    to[vertex, 0] += scale * x
    to[vertex, 1] += scale * y
    to[vertex, 2] += scale * z


@compiled
@no_type_check
def interior(
    seen,
    screen,
    faces,
    colors,
    laid,
    lens,
    face,
    box,
    scratch,
    along_color,
    along_depth,
    of_seen,
    of_lens,
    of_colors,
    of_texels,
    of_uv,
):
    """Add to `of_*`, float64, the gradients through weights, colours and depths inside of the faces.

    Gradients that are None are not computed; `of_seen` and `of_lens` are both given, or both None. `colors`, `laid`,
    `lens` and `face` are as in `shading`. `scratch` holds (faces) int32 of -1, and (faces or pixels, 20) and (faces or
    pixels) with any content, with one row for each face in view. `along_color` and `along_depth` are gradients of the
    loss in the image, (height, width, channels) and (height, width), or None.
    """
    top, bottom, left, right = box
    places, sums, owners = scratch
    count = 0
    for row in range(top, bottom):
        ray_y = (row - lens[3]) / lens[1]
        for column in range(left, right):
            index = face[row, column]
            if index < 0:
                continue
            ray_x = (column - lens[2]) / lens[0]
            place = places[index]
            if place < 0:
                place = count
                places[index], owners[place] = place, index
                count += 1
                begin(seen, faces, index, sums, place)
            m0 = ray_x * sums[place, 0] + ray_y * sums[place, 1] + sums[place, 2]
            m1 = ray_x * sums[place, 3] + ray_y * sums[place, 4] + sums[place, 5]
            m2 = ray_x * sums[place, 6] + ray_y * sums[place, 7] + sums[place, 8]
            total = m0 + m1 + m2
            inverse = 1.0 / total if abs(total) > FLATTEST * (abs(m0) + abs(m1) + abs(m2)) else 0.0
            w0, w1, w2 = m0 * inverse, m1 * inverse, m2 * inverse
            at_x, at_y = ray_x, ray_y
            if inverse == 0 or min(w0, w1, w2) < 0:
                w0, w1, w2 = weights_at(seen, screen, faces, lens, index, row, column)
                at_x, at_y, inverse = beside(seen, faces, index, sums, place, w0, w1, w2, inverse)
            d0 = d1 = d2 = 0.0
            if along_color is not None:
                textured = False
                if laid is not None and laid.shown[index] >= 0:
                    textured = True
                    pixel = (along_color, row, column)
                    where = (index, w0, w1, w2)
                    d0, d1, d2 = into_texture(faces, colors, laid, where, pixel, of_colors, of_texels, of_uv)
                if colors is not None and not textured:
                    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
                    for channel in range(along_color.shape[2]):
                        slope = np.float64(along_color[row, column, channel])
                        if of_colors is not None:
                            of_colors[a, channel] += slope * w0
                            of_colors[b, channel] += slope * w1
                            of_colors[c, channel] += slope * w2
                        d0 += slope * colors[a, channel]
                        d1 += slope * colors[b, channel]
                        d2 += slope * colors[c, channel]
                mean = w0 * d0 + w1 * d1 + w2 * d2
                d0, d1, d2 = (d0 - mean) * inverse, (d1 - mean) * inverse, (d2 - mean) * inverse
            if of_seen is None:
                continue
            if along_depth is not None:
                # depth = A·(B×C) / Σ m
                slope = np.float64(along_depth[row, column]) * inverse
                sums[place, 18] += slope
                down = slope * sums[place, 19] * inverse
                d0, d1, d2 = d0 - down, d1 - down, d2 - down
            sums[place, 9] += d0 * at_x
            sums[place, 10] += d0 * at_y
            sums[place, 11] += d0
            sums[place, 12] += d1 * at_x
            sums[place, 13] += d1 * at_y
            sums[place, 14] += d1
            sums[place, 15] += d2 * at_x
            sums[place, 16] += d2 * at_y
            sums[place, 17] += d2
    for place in range(count):
        index = owners[place]
        places[index] = -1
        if of_seen is not None:
            settle(seen, faces, index, sums, place, lens, of_seen, of_lens)


@compiled
@no_type_check
def beside(seen, faces, index, sums, place, w0, w1, w2, inverse):
    """Return the ray to the place of a face at barycentric weights, and 1 / Σ m there.

    `sums` and `place` are as in `begin`. `inverse` is 1 / Σ m at a pixel beside the face; it is 0 where the face is
    seen edge-on, and then all results are 0.
    """
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    x = w0 * seen[a, 0] + w1 * seen[b, 0] + w2 * seen[c, 0]
    y = w0 * seen[a, 1] + w1 * seen[b, 1] + w2 * seen[c, 1]
    z = w0 * seen[a, 2] + w1 * seen[b, 2] + w2 * seen[c, 2]
    if inverse == 0 or not z > 0:
        return 0.0, 0.0, 0.0
    x, y = x / z, y / z
    total = terms = 0.0
    for corner in range(3):
        along_x, along_y, ahead = (
            x * sums[place, 3 * corner],
            y * sums[place, 3 * corner + 1],
            sums[place, 3 * corner + 2],
        )
        total += along_x + along_y + ahead
        terms += abs(along_x) + abs(along_y) + abs(ahead)
    return x, y, 1.0 / total if abs(total) > FLATTEST * terms else 0.0


@compiled
@no_type_check
def begin(seen, faces, index, sums, place):
    """Start the row of sums of a face.

    The row holds B×C, C×A, A×B; Σ d r of the gradients d in m_0, m_1 and m_2; Σ of gradients over Σ m in depths; and
    A·(B×C).
    """
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    ax, ay, az = seen[a, 0], seen[a, 1], seen[a, 2]
    bx, by, bz = seen[b, 0], seen[b, 1], seen[b, 2]
    cx, cy, cz = seen[c, 0], seen[c, 1], seen[c, 2]
    sums[place, 0], sums[place, 1], sums[place, 2] = cross(bx, by, bz, cx, cy, cz)
    sums[place, 3], sums[place, 4], sums[place, 5] = cross(cx, cy, cz, ax, ay, az)
    sums[place, 6], sums[place, 7], sums[place, 8] = cross(ax, ay, az, bx, by, bz)
    for column in range(9, 19):
        sums[place, column] = 0.0
    sums[place, 19] = ax * sums[place, 0] + ay * sums[place, 1] + az * sums[place, 2]


@compiled
@no_type_check
def settle(seen, faces, index, sums, place, lens, of_seen, of_lens):
    """Add the sums over the pixels of a face to its corners and the lens: ∂m_0/∂B = C×r, ∂m_0/∂C = r×B and so on."""
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    ax, ay, az = seen[a, 0], seen[a, 1], seen[a, 2]
    bx, by, bz = seen[b, 0], seen[b, 1], seen[b, 2]
    cx, cy, cz = seen[c, 0], seen[c, 1], seen[c, 2]
    x0, y0, z0 = sums[place, 9], sums[place, 10], sums[place, 11]
    x1, y1, z1 = sums[place, 12], sums[place, 13], sums[place, 14]
    x2, y2, z2 = sums[place, 15], sums[place, 16], sums[place, 17]
    add(of_seen, a, 1.0, *cross(x1, y1, z1, cx, cy, cz))
    add(of_seen, a, -1.0, *cross(x2, y2, z2, bx, by, bz))
    add(of_seen, b, 1.0, *cross(x2, y2, z2, ax, ay, az))
    add(of_seen, b, -1.0, *cross(x0, y0, z0, cx, cy, cz))
    add(of_seen, c, 1.0, *cross(x0, y0, z0, bx, by, bz))
    add(of_seen, c, -1.0, *cross(x1, y1, z1, ax, ay, az))
    bc0, bc1, bc2, ca0, ca1, ca2 = (
        sums[place, 0],
        sums[place, 1],
        sums[place, 2],
        sums[place, 3],
        sums[place, 4],
        sums[place, 5],
    )
    ab0, ab1, ab2, deep = sums[place, 6], sums[place, 7], sums[place, 8], sums[place, 18]
    if deep != 0:
        add(of_seen, a, deep, bc0, bc1, bc2)
        add(of_seen, b, deep, ca0, ca1, ca2)
        add(of_seen, c, deep, ab0, ab1, ab2)
    of_lens[0] -= (x0 * bc0 + x1 * ca0 + x2 * ab0) / lens[0]
    of_lens[1] -= (y0 * bc1 + y1 * ca1 + y2 * ab1) / lens[1]
    of_lens[2] -= (z0 * bc0 + z1 * ca0 + z2 * ab0) / lens[0]
    of_lens[3] -= (z0 * bc1 + z1 * ca1 + z2 * ab1) / lens[1]


@compiled
@no_type_check
def into_texture(faces, colors, laid, where, pixel, of_colors, of_texels, of_uv):
    """Add a pixel's gradients to those of colours, texels and uv; return the gradients in its weights.

    `where` holds the face and the weights; `pixel` holds the gradient of the loss, (height, width, channels), row and
    column.
    """
    index, w0, w1, w2 = where
    slopes, row, column = pixel
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    d0 = d1 = d2 = 0.0
    image = laid.shown[index]
    u, v = uv_at(laid, index, w0, w1, w2)
    place = among_texels(laid, image, u, v)
    of_u = of_v = 0.0
    for channel in range(slopes.shape[2]):
        slope, base = np.float64(slopes[row, column, channel]), 1.0
        if colors is not None:
            base = w0 * colors[a, channel] + w1 * colors[b, channel] + w2 * colors[c, channel]
            shown = slope * mixed(laid, place, channel)
            if of_colors is not None:
                of_colors[a, channel] += shown * w0
                of_colors[b, channel] += shown * w1
                of_colors[c, channel] += shown * w2
            d0 += shown * colors[a, channel]
            d1 += shown * colors[b, channel]
            d2 += shown * colors[c, channel]
        along_u, along_v = mixed_slopes(laid, image, place, channel)
        of_u += slope * base * along_u
        of_v += slope * base * along_v
        if of_texels is not None:
            first, second, third, fourth, right, down = place
            of_texels[first, channel] += slope * base * (1 - right) * (1 - down)
            of_texels[second, channel] += slope * base * right * (1 - down)
            of_texels[third, channel] += slope * base * (1 - right) * down
            of_texels[fourth, channel] += slope * base * right * down
    uv = laid.uv
    i, j, k = laid.corners[index, 0], laid.corners[index, 1], laid.corners[index, 2]
    if of_uv is not None:
        for corner, weight in ((i, w0), (j, w1), (k, w2)):
            of_uv[corner, 0] += weight * of_u
            of_uv[corner, 1] += weight * of_v
    d0 += of_u * uv[i, 0] + of_v * uv[i, 1]
    d1 += of_u * uv[j, 0] + of_v * uv[j, 1]
    d2 += of_u * uv[k, 0] + of_v * uv[k, 1]
    return d0, d1, d2


@compiled
@no_type_check
def of_the_world(vertices, rotation, of_seen, of_vertices, of_rotation, of_translation):
    """Turn gradients in camera coordinates x = R X + t into gradients in X, R and t."""
    for vertex in range(vertices.shape[0]):
        x, y, z = of_seen[vertex, 0], of_seen[vertex, 1], of_seen[vertex, 2]
        if x == 0 and y == 0 and z == 0:
            continue
        for axis in range(3):
            of_vertices[vertex, axis] = rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis] * z
            place = np.float64(vertices[vertex, axis])
            of_rotation[0, axis] += x * place
            of_rotation[1, axis] += y * place
            of_rotation[2, axis] += z * place
        of_translation[0] += x
        of_translation[1] += y
        of_translation[2] += z
