"""From the slope of a loss in an image to its slopes in colours, vertices and camera; compiled functions on arrays.

Arrays are those of `raster`. In camera coordinates a pixel's ray is r = ((column - cx) / fx, (row - cy) / fy, 1), and
the barycentric weights of a face A, B, C under it are m_i / Σ m with m_0 = r·(B×C), m_1 = r·(C×A), m_2 = r·(A×B)
(homogeneous edge functions, Olano & Greer 1997): linear in every corner, and right for corners behind the camera.

What an image of areas gains where an edge moves is the difference of the two surfaces beside it, times how far it
moves, along its whole length (Li et al. 2018, eq. 4). Between two neighbouring pixels that show surfaces of different
depth the edge is crossed once; the pair in a row sees what moves along the row, the pair in a column the rest.
"""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import SUBPIXELS, compiled, weights_in_space

MOST_FACES = 1000
"""That lie between two neighbouring pixels, at most."""
FLATTEST = 1e-12
"""Of Σ m, relative to its terms: what is flatter is seen edge-on, and has no slope that says anything."""


def neighbours(faces):
    """The face beyond each edge of each face, (faces, 3), edge i from corner i to the next; -1 where there is none, or
    more than one."""
    start, end = faces.astype(np.int64), np.roll(faces, -1, 1).astype(np.int64)
    key = (np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)).ravel()
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    same = np.concatenate([[False], ordered[1:] == ordered[:-1], [False]])
    # exactly two alike in a row
    first = np.flatnonzero(same[1:-1] & ~same[:-2] & ~same[2:])
    beside = np.full(len(key), -1, np.int64)
    beside[order[first]] = order[first + 1] // 3
    beside[order[first + 1]] = order[first] // 3
    return beside.reshape(-1, 3)


@compiled
@no_type_check
def cross(a0, a1, a2, b0, b1, b2):
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@compiled
@no_type_check
def add(to, vertex, scale, x, y, z):
    to[vertex, 0] += scale * x
    to[vertex, 1] += scale * y
    to[vertex, 2] += scale * z


@compiled
@no_type_check
def interior(seen, faces, colors, lens, face, box, along_color, along_depth, of_seen, of_colors, of_lens):
    """Add to `of_*` what weights and depths change within the faces.

    Args:
        lens: fx, fy, cx, cy, pixels.
        along_color, along_depth: slopes of the loss, (height, width, channels) and (height, width); size 0: none.
        of_seen, of_colors, of_lens: the sums, float64.
    """
    top, bottom, left, right = box
    shaded, deep = along_color.size > 0, along_depth.size > 0
    channels = colors.shape[1]
    last = a = b = c = -1
    ax = ay = az = bx = by = bz = cx = cy = cz = 0.0
    bc0 = bc1 = bc2 = ca0 = ca1 = ca2 = ab0 = ab1 = ab2 = 0.0
    for row in range(top, bottom):
        ray_y = (row - lens[3]) / lens[1]
        for column in range(left, right):
            index = face[row, column]
            if index < 0:
                continue
            ray_x = (column - lens[2]) / lens[0]
            if index != last:
                last = index
                a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
                ax, ay, az = seen[a, 0], seen[a, 1], seen[a, 2]
                bx, by, bz = seen[b, 0], seen[b, 1], seen[b, 2]
                cx, cy, cz = seen[c, 0], seen[c, 1], seen[c, 2]
                bc0, bc1, bc2 = cross(bx, by, bz, cx, cy, cz)
                ca0, ca1, ca2 = cross(cx, cy, cz, ax, ay, az)
                ab0, ab1, ab2 = cross(ax, ay, az, bx, by, bz)
            m0 = ray_x * bc0 + ray_y * bc1 + bc2
            m1 = ray_x * ca0 + ray_y * ca1 + ca2
            m2 = ray_x * ab0 + ray_y * ab1 + ab2
            total = m0 + m1 + m2
            if not abs(total) > FLATTEST * (abs(m0) + abs(m1) + abs(m2)):
                continue
            inverse = 1.0 / total
            d0 = d1 = d2 = 0.0
            if shaded:
                # rounding of corners may leave the pixel a little outside of the face
                w0, w1, w2 = max(m0 * inverse, 0.0), max(m1 * inverse, 0.0), max(m2 * inverse, 0.0)
                scale = 1.0 / (w0 + w1 + w2)
                w0, w1, w2 = w0 * scale, w1 * scale, w2 * scale
                for channel in range(channels):
                    slope = np.float64(along_color[row, column, channel])
                    if slope != 0:
                        of_colors[a, channel] += slope * w0
                        of_colors[b, channel] += slope * w1
                        of_colors[c, channel] += slope * w2
                        d0 += slope * colors[a, channel]
                        d1 += slope * colors[b, channel]
                        d2 += slope * colors[c, channel]
                mean = w0 * d0 + w1 * d1 + w2 * d2
                d0, d1, d2 = (d0 - mean) * inverse, (d1 - mean) * inverse, (d2 - mean) * inverse
            if deep and along_depth[row, column] != 0:
                # depth = A·(B×C) / Σ m
                slope = np.float64(along_depth[row, column]) * inverse
                add(of_seen, a, slope, bc0, bc1, bc2)
                add(of_seen, b, slope, ca0, ca1, ca2)
                add(of_seen, c, slope, ab0, ab1, ab2)
                down = slope * (ax * bc0 + ay * bc1 + az * bc2) * inverse
                d0, d1, d2 = d0 - down, d1 - down, d2 - down
            if d0 == 0 and d1 == 0 and d2 == 0:
                continue
            ra0, ra1, ra2 = cross(ray_x, ray_y, 1.0, ax, ay, az)
            rb0, rb1, rb2 = cross(ray_x, ray_y, 1.0, bx, by, bz)
            rc0, rc1, rc2 = cross(ray_x, ray_y, 1.0, cx, cy, cz)
            add(of_seen, a, 1.0, d1 * rc0 - d2 * rb0, d1 * rc1 - d2 * rb1, d1 * rc2 - d2 * rb2)
            add(of_seen, b, 1.0, d2 * ra0 - d0 * rc0, d2 * ra1 - d0 * rc1, d2 * ra2 - d0 * rc2)
            add(of_seen, c, 1.0, d0 * rb0 - d1 * ra0, d0 * rb1 - d1 * ra1, d0 * rb2 - d1 * ra2)
            slope_x = (d0 * bc0 + d1 * ca0 + d2 * ab0) / lens[0]
            slope_y = (d0 * bc1 + d1 * ca1 + d2 * ab1) / lens[1]
            of_lens[0] -= slope_x * ray_x
            of_lens[1] -= slope_y * ray_y
            of_lens[2] -= slope_x
            of_lens[3] -= slope_y


@compiled
@no_type_check
def boundary(
    seen, screen, faces, beside, colors, lens, face, depth, box, once, along_color, of_seen, of_lens
):
    """Add to `of_seen` and `of_lens` what edges hand over where they move.

    Args:
        beside: as `neighbours` says.
        once: whether a pixel is one sample, and not the mean of several.
    """
    height, width = face.shape
    top, bottom = max(box[0] - 1, 0), min(box[1] + 1, height)
    left, right = max(box[2] - 1, 0), min(box[3] + 1, width)
    footprint = 1.0 / min(lens[0], lens[1])
    for row in range(top, bottom):
        for column in range(left, right):
            here = face[row, column]
            for down, across in ((0, 1), (1, 0)):
                other_row, other_column = row + down, column + across
                if other_row >= bottom or other_column >= right or face[other_row, other_column] == here:
                    continue
                if parted(depth[row, column], depth[other_row, other_column], footprint):
                    pixels = (row, column, other_row, other_column)
                    pair(
                        pixels,
                        seen,
                        screen,
                        faces,
                        beside,
                        colors,
                        lens,
                        face,
                        depth,
                        once,
                        along_color,
                        of_seen,
                        of_lens,
                    )


@compiled
@no_type_check
def parted(depth, other, footprint):
    """Whether neighbouring pixels may show surfaces that are apart: by a pixel's width, at their distance, or more."""
    return abs(depth - other) > footprint * max(depth, other) or depth == np.inf or other == np.inf


@compiled
@no_type_check
def pair(pixels, seen, screen, faces, beside, colors, lens, face, depth, once, along_color, of_seen, of_lens):
    """What one pair of neighbouring pixels sees of the edge between them, if there is one."""
    row, column, other_row, other_column = pixels
    if depth[other_row, other_column] < depth[row, column]:  # the nearer one first
        row, column, other_row, other_column = other_row, other_column, row, column
    # on the way from one pixel to the other, from face to face, to where the nearer surface ends or turns away
    index = face[row, column]
    facing = turn(screen, faces, index)
    corner, share, ended = -1, 0.0, False
    for _ in range(MOST_FACES):
        corner, share = leaves(screen, faces, index, facing, row, column, other_row, other_column)
        if corner < 0 or share >= 1:
            return
        following = beside[index, corner]
        ended = following < 0 or turn(screen, faces, following) * facing <= 0
        if ended:
            break
        index = following
    if not ended:
        return
    first, second = faces[index, corner], faces[index, (corner + 1) % 3]
    in_row = other_row == row
    axis = 0 if in_row else 1
    # the crossing's place between the edge's ends, along the other axis
    start, end = screen[first, 1 - axis], screen[second, 1 - axis]
    if start == end:
        return
    part = min(max(((row if in_row else column) * SUBPIXELS - start) / (end - start), 0.0), 1.0)
    of_first, of_second = (1 - part) * screen[first, 2], part * screen[second, 2]
    near = 1.0 / (of_first + of_second)
    behind = face[other_row, other_column]
    ray_x = (column + share * (other_column - column) - lens[2]) / lens[0]
    ray_y = (row + share * (other_row - row) - lens[3]) / lens[1]
    w0 = w1 = w2 = 0.0
    a = b = c = 0
    if behind >= 0:
        # a surface that goes on is no edge: the farther one must lie behind the crossing by more than it may rise
        far = np.float64(depth[other_row, other_column])
        beyond = depth_at(seen, faces, behind, ray_x, ray_y)
        if not far - near > 2 * abs(far - beyond) + far / min(lens[0], lens[1]):
            return
        a, b, c = faces[behind, 0], faces[behind, 1], faces[behind, 2]
        w0, w1, w2 = weights_in_space(seen, a, b, c, ray_x, ray_y)
    # The area that changes hands is part of the pixel in which the edge lies. Of one sample a pixel the slope there is
    # that of all or nothing, and jumps when the edge passes the border: the mean of both pixels' does not.
    inside = 1.0 if share < 0.5 else 0.0
    if once or share == 0.5:
        inside = 0.5
    handed = 0.0
    for channel in range(colors.shape[1]):
        # colours where the edge is: towards it that of a surface that turns away changes fast
        step = near * (of_first * colors[first, channel] + of_second * colors[second, channel])
        if behind >= 0:
            step -= w0 * colors[a, channel] + w1 * colors[b, channel] + w2 * colors[c, channel]
        here, there = along_color[row, column, channel], along_color[other_row, other_column, channel]
        handed += (inside * here + (1 - inside) * there) * step
    outwards = handed * ((other_column - column) + (other_row - row))
    along(seen, first, axis, outwards * (1 - part), lens, of_seen, of_lens)
    along(seen, second, axis, outwards * part, lens, of_seen, of_lens)


@compiled
@no_type_check
def turn(screen, faces, index):
    """Twice the area of a face on the screen, above 0 where its inside is on the positive side of its edges (`side`);
    0 of one that the near plane cuts."""
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    if screen[a, 2] == 0 or screen[b, 2] == 0 or screen[c, 2] == 0:
        return 0.0
    return (screen[b, 0] - screen[a, 0]) * (screen[c, 1] - screen[a, 1]) - (screen[c, 0] - screen[a, 0]) * (
        screen[b, 1] - screen[a, 1]
    )


@compiled
@no_type_check
def leaves(screen, faces, index, facing, row, column, other_row, other_column):
    """By which edge the way from a pixel to another leaves a face, and at which share of the way; -1 if by none."""
    share, found = np.inf, -1
    for corner in range(3):
        a, b = faces[index, corner], faces[index, (corner + 1) % 3]
        inside = side(screen, a, b, row, column)
        outside = side(screen, a, b, other_row, other_column)
        if (inside - outside) * facing > 0 and inside / (inside - outside) < share:
            share, found = inside / (inside - outside), corner
    return found, share


@compiled
@no_type_check
def side(screen, a, b, row, column):
    """On which side of an edge, extended, a pixel lies, and how far: twice the area of the triangle they make."""
    x, y = column * SUBPIXELS, row * SUBPIXELS
    return (screen[a, 0] - x) * (screen[b, 1] - y) - (screen[b, 0] - x) * (screen[a, 1] - y)


@compiled
@no_type_check
def depth_at(seen, faces, index, ray_x, ray_y):
    """Depth of a face's plane under a ray, metres."""
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    bc0, bc1, bc2 = cross(seen[b, 0], seen[b, 1], seen[b, 2], seen[c, 0], seen[c, 1], seen[c, 2])
    ca0, ca1, ca2 = cross(seen[c, 0], seen[c, 1], seen[c, 2], seen[a, 0], seen[a, 1], seen[a, 2])
    ab0, ab1, ab2 = cross(seen[a, 0], seen[a, 1], seen[a, 2], seen[b, 0], seen[b, 1], seen[b, 2])
    total = ray_x * (bc0 + ca0 + ab0) + ray_y * (bc1 + ca1 + ab1) + bc2 + ca2 + ab2
    return (seen[a, 0] * bc0 + seen[a, 1] * bc1 + seen[a, 2] * bc2) / total


@compiled
@no_type_check
def along(seen, vertex, axis, slope, lens, of_seen, of_lens):
    """Add a slope along the screen's `axis`, per pixel, of a vertex's place f x / z + c."""
    focal, inverse = lens[axis], 1.0 / seen[vertex, 2]
    place = seen[vertex, axis] * inverse
    of_seen[vertex, axis] += slope * focal * inverse
    of_seen[vertex, 2] -= slope * focal * place * inverse
    of_lens[axis] += slope * place
    of_lens[2 + axis] += slope


@compiled
@no_type_check
def of_the_world(vertices, rotation, of_seen, of_vertices, of_rotation, of_translation):
    """From slopes in camera coordinates x = R X + t to those in X, R and t."""
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
