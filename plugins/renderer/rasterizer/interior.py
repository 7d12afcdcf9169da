"""Compiled functions for the part of a loss's gradient that comes from pixels inside of faces.

The gradients are with respect to colours, textures, vertices and camera. Arrays are described in `raster`; an array
`grad_x` is the gradient of the loss with respect to x. In camera coordinates a pixel's ray is r = ((column - cx) / fx,
(row - cy) / fy, 1). Where it meets a face with the corners A, B, C, the barycentric weights are m_i / Σ m with m_0 =
r·(B×C), m_1 = r·(C×A), m_2 = r·(A×B) (homogeneous edge functions, Olano & Greer 1997). Each m_i is linear in every
corner, and corners behind the camera are allowed. For a pixel beside its face, r is the ray to the point of the face
that `shading` shows there; the gradient treats this ray as constant.
"""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import compiled
from plugins.renderer.rasterizer.shading import weights_at
from plugins.renderer.rasterizer.textures import (
    find_texels,
    interpolate,
    interpolate_uv,
    interpolation_derivatives,
)

FLATTEST = 1e-12
"""Smallest |Σ m| as a share of the sum of the absolute values of its terms.

A face with a smaller share is seen edge-on, and its gradient with respect to positions is meaningless. Σ m is defined
in the module's docstring.
"""


@compiled
@no_type_check
def cross(a0, a1, a2, b0, b1, b2):
    """Return the cross product of two vectors."""
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@compiled
@no_type_check
def add_scaled(to, vertex, scale, x, y, z):
    """Add the vector (x, y, z), multiplied by `scale`, to row `vertex` of the array `to`."""
    to[vertex, 0] += scale * x
    to[vertex, 1] += scale * y
    to[vertex, 2] += scale * z


@compiled
@no_type_check
def interior(
    camera_points,
    screen,
    faces,
    colors,
    texture,
    lens,
    face,
    box,
    scratch,
    grad_image,
    grad_depth,
    grad_points,
    grad_lens,
    grad_colors,
    grad_texels,
    grad_uv,
):
    """Add the gradients through weights, colours and depths inside of faces to the float64 arrays `grad_*`.

    Gradients that are None are not computed; `grad_points` and `grad_lens` must both be given, or both be None.
    `colors` holds the channels of each vertex, `texture` a `textures.TextureArrays` or None, `lens` fx, fy, cx, cy, and
    `face` the index of the face that each pixel shows. `scratch` holds three working arrays: int32 (faces,) filled with
    -1, and two with any content, (n, 20) and int32 (n,), where n is at least the number of faces in view. `grad_image`
    and `grad_depth` are the gradients of the loss with respect to the colours, (height, width, channels), and the
    depths, (height, width), or None.
    """
    top, bottom, left, right = box
    slots, sums, owners = scratch
    count = 0
    for row in range(top, bottom):
        ray_y = (row - lens[3]) / lens[1]
        for column in range(left, right):
            index = face[row, column]
            if index < 0:
                continue
            ray_x = (column - lens[2]) / lens[0]
            slot = slots[index]
            if slot < 0:
                slot = count
                slots[index], owners[slot] = slot, index
                count += 1
                start_sums(camera_points, faces, index, sums, slot)
            m0 = ray_x * sums[slot, 0] + ray_y * sums[slot, 1] + sums[slot, 2]
            m1 = ray_x * sums[slot, 3] + ray_y * sums[slot, 4] + sums[slot, 5]
            m2 = ray_x * sums[slot, 6] + ray_y * sums[slot, 7] + sums[slot, 8]
            total = m0 + m1 + m2
            inverse = 1.0 / total if abs(total) > FLATTEST * (abs(m0) + abs(m1) + abs(m2)) else 0.0
            w0, w1, w2 = m0 * inverse, m1 * inverse, m2 * inverse
            at_x, at_y = ray_x, ray_y
            if inverse == 0 or min(w0, w1, w2) < 0:
                w0, w1, w2 = weights_at(camera_points, screen, faces, lens, index, row, column)
                at_x, at_y, inverse = ray_beside(camera_points, faces, index, sums, slot, w0, w1, w2, inverse)
            d0 = d1 = d2 = 0.0
            if grad_image is not None:
                textured = False
                if texture is not None and texture.shown[index] >= 0:
                    textured = True
                    pixel = (grad_image, row, column)
                    face_weights = (index, w0, w1, w2)
                    d0, d1, d2 = add_texture_gradient(
                        faces, colors, texture, face_weights, pixel, grad_colors, grad_texels, grad_uv
                    )
                if colors is not None and not textured:
                    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
                    for channel in range(grad_image.shape[2]):
                        slope = np.float64(grad_image[row, column, channel])
                        if grad_colors is not None:
                            grad_colors[a, channel] += slope * w0
                            grad_colors[b, channel] += slope * w1
                            grad_colors[c, channel] += slope * w2
                        d0 += slope * colors[a, channel]
                        d1 += slope * colors[b, channel]
                        d2 += slope * colors[c, channel]
                mean = w0 * d0 + w1 * d1 + w2 * d2
                d0, d1, d2 = (d0 - mean) * inverse, (d1 - mean) * inverse, (d2 - mean) * inverse
            if grad_points is None:
                continue
            if grad_depth is not None:
                # depth = A·(B×C) / Σ m
                slope = np.float64(grad_depth[row, column]) * inverse
                sums[slot, 18] += slope
                down = slope * sums[slot, 19] * inverse
                d0, d1, d2 = d0 - down, d1 - down, d2 - down
            sums[slot, 9] += d0 * at_x
            sums[slot, 10] += d0 * at_y
            sums[slot, 11] += d0
            sums[slot, 12] += d1 * at_x
            sums[slot, 13] += d1 * at_y
            sums[slot, 14] += d1
            sums[slot, 15] += d2 * at_x
            sums[slot, 16] += d2 * at_y
            sums[slot, 17] += d2
    for slot in range(count):
        index = owners[slot]
        slots[index] = -1
        if grad_points is not None:
            add_face_gradient(camera_points, faces, index, sums, slot, lens, grad_points, grad_lens)


@compiled
@no_type_check
def ray_beside(camera_points, faces, index, sums, slot, w0, w1, w2, inverse):
    """Return x and y of the ray (x, y, 1) to the point of a face with weights w0, w1, w2, and 1 / Σ m for this ray.

    Row `slot` of `sums` belongs to the face (`start_sums`). `inverse` is 1 / Σ m for the ray through the pixel beside
    the face. If the face is seen edge-on, `inverse` and all three returned numbers are 0.
    """
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    x = w0 * camera_points[a, 0] + w1 * camera_points[b, 0] + w2 * camera_points[c, 0]
    y = w0 * camera_points[a, 1] + w1 * camera_points[b, 1] + w2 * camera_points[c, 1]
    z = w0 * camera_points[a, 2] + w1 * camera_points[b, 2] + w2 * camera_points[c, 2]
    if inverse == 0 or not z > 0:
        return 0.0, 0.0, 0.0
    x, y = x / z, y / z
    total = terms = 0.0
    for corner in range(3):
        along_x, along_y, ahead = (
            x * sums[slot, 3 * corner],
            y * sums[slot, 3 * corner + 1],
            sums[slot, 3 * corner + 2],
        )
        total += along_x + along_y + ahead
        terms += abs(along_x) + abs(along_y) + abs(ahead)
    return x, y, 1.0 / total if abs(total) > FLATTEST * terms else 0.0


@compiled
@no_type_check
def start_sums(camera_points, faces, index, sums, slot):
    """Initialise row `slot` of `sums`, in which the terms of all pixels of the face `index` are added up.

    Columns 0 to 8 hold B×C, C×A, A×B, where A, B, C are the corners of the face. Columns 9 to 17 are for Σ d r over the
    pixels, where d is the gradient of the loss with respect to m_0, m_1 or m_2, and r is the pixel's ray. Column 18 is
    for the sum over the pixels of (gradient with respect to depth) / Σ m. Column 19 holds A·(B×C). Columns 9 to 18
    begin at 0.
    """
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    ax, ay, az = camera_points[a, 0], camera_points[a, 1], camera_points[a, 2]
    bx, by, bz = camera_points[b, 0], camera_points[b, 1], camera_points[b, 2]
    cx, cy, cz = camera_points[c, 0], camera_points[c, 1], camera_points[c, 2]
    sums[slot, 0], sums[slot, 1], sums[slot, 2] = cross(bx, by, bz, cx, cy, cz)
    sums[slot, 3], sums[slot, 4], sums[slot, 5] = cross(cx, cy, cz, ax, ay, az)
    sums[slot, 6], sums[slot, 7], sums[slot, 8] = cross(ax, ay, az, bx, by, bz)
    for column in range(9, 19):
        sums[slot, column] = 0.0
    sums[slot, 19] = ax * sums[slot, 0] + ay * sums[slot, 1] + az * sums[slot, 2]


@compiled
@no_type_check
def add_face_gradient(camera_points, faces, index, sums, slot, lens, grad_points, grad_lens):
    """Add the gradient of a face, computed from its row of `sums`, to `grad_points` and `grad_lens`.

    The derivatives are ∂m_0/∂B = C×r, ∂m_0/∂C = r×B, and likewise for m_1 and m_2. Row `slot` of `sums` belongs to the
    face (`start_sums`).
    """
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    ax, ay, az = camera_points[a, 0], camera_points[a, 1], camera_points[a, 2]
    bx, by, bz = camera_points[b, 0], camera_points[b, 1], camera_points[b, 2]
    cx, cy, cz = camera_points[c, 0], camera_points[c, 1], camera_points[c, 2]
    x0, y0, z0 = sums[slot, 9], sums[slot, 10], sums[slot, 11]
    x1, y1, z1 = sums[slot, 12], sums[slot, 13], sums[slot, 14]
    x2, y2, z2 = sums[slot, 15], sums[slot, 16], sums[slot, 17]
    add_scaled(grad_points, a, 1.0, *cross(x1, y1, z1, cx, cy, cz))
    add_scaled(grad_points, a, -1.0, *cross(x2, y2, z2, bx, by, bz))
    add_scaled(grad_points, b, 1.0, *cross(x2, y2, z2, ax, ay, az))
    add_scaled(grad_points, b, -1.0, *cross(x0, y0, z0, cx, cy, cz))
    add_scaled(grad_points, c, 1.0, *cross(x0, y0, z0, bx, by, bz))
    add_scaled(grad_points, c, -1.0, *cross(x1, y1, z1, ax, ay, az))
    bc0, bc1, bc2, ca0, ca1, ca2 = (
        sums[slot, 0],
        sums[slot, 1],
        sums[slot, 2],
        sums[slot, 3],
        sums[slot, 4],
        sums[slot, 5],
    )
    ab0, ab1, ab2, deep = sums[slot, 6], sums[slot, 7], sums[slot, 8], sums[slot, 18]
    if deep != 0:
        add_scaled(grad_points, a, deep, bc0, bc1, bc2)
        add_scaled(grad_points, b, deep, ca0, ca1, ca2)
        add_scaled(grad_points, c, deep, ab0, ab1, ab2)
    grad_lens[0] -= (x0 * bc0 + x1 * ca0 + x2 * ab0) / lens[0]
    grad_lens[1] -= (y0 * bc1 + y1 * ca1 + y2 * ab1) / lens[1]
    grad_lens[2] -= (z0 * bc0 + z1 * ca0 + z2 * ab0) / lens[0]
    grad_lens[3] -= (z0 * bc1 + z1 * ca1 + z2 * ab1) / lens[1]


@compiled
@no_type_check
def add_texture_gradient(faces, colors, texture, face_weights, pixel, grad_colors, grad_texels, grad_uv):
    """Add a pixel's gradients to `grad_colors`, `grad_texels` and `grad_uv`; return the gradients of its weights.

    The returned numbers are the gradients of the loss with respect to the pixel's three barycentric weights.

    `face_weights` holds the index of the face and its barycentric weights. `pixel` holds the gradient of the loss with
    respect to the image, (height, width, channels), and the row and column of the pixel.
    """
    index, w0, w1, w2 = face_weights
    slopes, row, column = pixel
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    d0 = d1 = d2 = 0.0
    image = texture.shown[index]
    u, v = interpolate_uv(texture, index, w0, w1, w2)
    texels = find_texels(texture, image, u, v)
    grad_u = grad_v = 0.0
    for channel in range(slopes.shape[2]):
        slope, base = np.float64(slopes[row, column, channel]), 1.0
        if colors is not None:
            base = w0 * colors[a, channel] + w1 * colors[b, channel] + w2 * colors[c, channel]
            shown = slope * interpolate(texture, texels, channel)
            if grad_colors is not None:
                grad_colors[a, channel] += shown * w0
                grad_colors[b, channel] += shown * w1
                grad_colors[c, channel] += shown * w2
            d0 += shown * colors[a, channel]
            d1 += shown * colors[b, channel]
            d2 += shown * colors[c, channel]
        along_u, along_v = interpolation_derivatives(texture, image, texels, channel)
        grad_u += slope * base * along_u
        grad_v += slope * base * along_v
        if grad_texels is not None:
            first, second, third, fourth, right, down = texels
            grad_texels[first, channel] += slope * base * (1 - right) * (1 - down)
            grad_texels[second, channel] += slope * base * right * (1 - down)
            grad_texels[third, channel] += slope * base * (1 - right) * down
            grad_texels[fourth, channel] += slope * base * right * down
    uv = texture.uv
    i, j, k = texture.corners[index, 0], texture.corners[index, 1], texture.corners[index, 2]
    if grad_uv is not None:
        for corner, weight in ((i, w0), (j, w1), (k, w2)):
            grad_uv[corner, 0] += weight * grad_u
            grad_uv[corner, 1] += weight * grad_v
    d0 += grad_u * uv[i, 0] + grad_v * uv[i, 1]
    d1 += grad_u * uv[j, 0] + grad_v * uv[j, 1]
    d2 += grad_u * uv[k, 0] + grad_v * uv[k, 1]
    return d0, d1, d2


@compiled
@no_type_check
def transform_to_world(vertices, rotation, grad_points, grad_vertices, grad_rotation, grad_translation):
    """Convert gradients with respect to camera coordinates x = R X + t into gradients with respect to X, R and t.

    Args:
        vertices: X.
        rotation: R.
        grad_points: gradient with respect to x.
        grad_vertices: filled with the gradient with respect to X where it is not 0.
        grad_rotation: the gradient with respect to R is added.
        grad_translation: the gradient with respect to t is added.
    """
    for vertex in range(vertices.shape[0]):
        x, y, z = grad_points[vertex, 0], grad_points[vertex, 1], grad_points[vertex, 2]
        if x == 0 and y == 0 and z == 0:
            continue
        for axis in range(3):
            grad_vertices[vertex, axis] = (
                rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis] * z
            )
            coordinate = np.float64(vertices[vertex, axis])
            grad_rotation[0, axis] += x * coordinate
            grad_rotation[1, axis] += y * coordinate
            grad_rotation[2, axis] += z * coordinate
        grad_translation[0] += x
        grad_translation[1] += y
        grad_translation[2] += z
