"""Gradients of a loss in vertices and camera that come from moving edges; compiled functions.

Arrays are those of `raster`. Where an edge moves, an image of areas gains the difference of the two surfaces
beside the edge, times the distance that the edge moves, along its whole length (Li et al. 2018, eq. 4). Between two
neighbouring pixels that show surfaces of different depth the edge is crossed once. A pair of pixels in a row measures
motion along the row, and a pair in a column measures motion along the column.
"""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.interior import cross
from plugins.renderer.rasterizer.raster import SUBPIXELS, compiled
from plugins.renderer.rasterizer.shading import light, weights_in_space

MOST_FACES = 1000
"""Largest number of faces that may lie between two neighbouring pixels."""


def neighbours(faces):
    """Return the face beyond each edge of each face, (faces, 3), with edge i from corner i to the next.

    The entry is -1 where there is no such face, or more than one.
    """
    start, end = faces.astype(np.int64), np.roll(faces, -1, 1).astype(np.int64)
    key = (np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)).ravel()
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    same = np.concatenate([[False], ordered[1:] == ordered[:-1], [False]])
    # keys that occur exactly twice
    first = np.flatnonzero(same[1:-1] & ~same[:-2] & ~same[2:])
    beside = np.full(len(key), -1, np.int64)
    beside[order[first]] = order[first + 1] // 3
    beside[order[first + 1]] = order[first] // 3
    return beside.reshape(-1, 3)


@compiled
@no_type_check
def boundary(
    seen, screen, faces, beside, colors, laid, lens, face, depth, box, once, along_color, of_seen, of_lens
):
    """Add to `of_seen` and `of_lens` the gradient that comes from moving edges.

    `beside` is the result of `neighbours`. `once` says that a pixel is one sample, and not the mean of several.
    `along_color` is the gradient of the loss in the image, (height, width, channels). `colors`, `laid` and `lens` are
    as in `shading`.
    """
    height, width = face.shape
    top, bottom = max(box[0] - 1, 0), min(box[1] + 1, height)
    left, right = max(box[2] - 1, 0), min(box[3] + 1, width)
    footprint = 1.0 / min(lens[0], lens[1])
    steps = np.empty((1, 2, along_color.shape[2]))
    for row in range(top, bottom):
        for column in range(left, right):
            for down in range(2):
                other_row, other_column = row + down, column + 1 - down
                if other_row >= bottom or other_column >= right:
                    continue
                if face[other_row, other_column] == face[row, column]:
                    continue
                one, other = depth[row, column], depth[other_row, other_column]
                if not parted(one, other, footprint):
                    continue
                pixels = (row, column, other_row, other_column)
                if other < one:  # the pixel of the nearer surface comes first
                    pixels = (other_row, other_column, row, column)
                goal = face[pixels[2], pixels[3]]
                end = walk(screen, faces, beside, face[pixels[0], pixels[1]], goal, pixels)
                if end[0] >= 0:
                    surfaces = (seen, screen, faces, colors, laid, lens)
                    picture = (face, depth, once, along_color)
                    hand_over(pixels, end, surfaces, picture, of_seen, of_lens, steps)


@compiled
@no_type_check
def parted(depth, other, footprint):
    """Return whether neighbouring pixels may show separate surfaces, whose depths differ by a pixel's width or more.

    The width is that of a pixel at the distance of the farther surface.
    """
    return abs(depth - other) > footprint * max(depth, other) or depth == np.inf or other == np.inf


@compiled
@no_type_check
def walk(screen, faces, beside, index, goal, pixels):
    """Go from one pixel towards another, face by face, to the place where the nearer surface ends or turns away.

    The other pixel shows the face `goal`.

    Returns:
        The last face, or -1 if there is no such place; the number of the edge where the surface ends; the share of the
        way at that edge.
    """
    row, column, other_row, other_column = pixels
    facing = turn(screen, faces, index)
    for _ in range(MOST_FACES):
        corner, share = leaves(screen, faces, index, facing, row, column, other_row, other_column)
        if corner < 0 or share >= 1:
            break
        following = beside[index, corner]
        if following < 0 or turn(screen, faces, following) * facing <= 0:
            return index, corner, share
        if following == goal:
            break
        index = following
    return -1, -1, 0.0


@compiled
@no_type_check
def hand_over(pixels, end, surfaces, picture, of_seen, of_lens, steps):
    """Add the gradient that one pair of neighbouring pixels contributes, for the edge between them from `walk`."""
    row, column, other_row, other_column = pixels
    index, corner, share = end
    seen, screen, faces, colors, laid, lens = surfaces
    face, depth, once, along_color = picture
    first, second = faces[index, corner], faces[index, (corner + 1) % 3]
    in_row = other_row == row
    axis = 0 if in_row else 1
    # share of the crossing between the edge's ends, along the other axis
    start, end = screen[first, 1 - axis], screen[second, 1 - axis]
    if start == end:
        return
    part = min(max(((row if in_row else column) * SUBPIXELS - start) / (end - start), 0.0), 1.0)
    of_first, of_second = (1 - part) * screen[first, 2], part * screen[second, 2]
    near = 1.0 / (of_first + of_second)
    behind = face[other_row, other_column]
    ray_x = (column + share * (other_column - column) - lens[2]) / lens[0]
    ray_y = (row + share * (other_row - row) - lens[3]) / lens[1]
    if behind >= 0:
        # a surface that continues has no edge here: the farther surface must lie behind the crossing by more than
        # its own slope explains
        far = np.float64(depth[other_row, other_column])
        beyond = depth_at(seen, faces, behind, ray_x, ray_y)
        if not far - near > 2 * abs(far - beyond) + far / min(lens[0], lens[1]):
            return
        a, b, c = faces[behind, 0], faces[behind, 1], faces[behind, 2]
        w0, w1, w2 = weights_in_space(seen, a, b, c, ray_x, ray_y)
        light(faces, colors, laid, behind, w0, w1, w2, steps, 0, 1)
    else:
        steps[0, 1] = 0.0
    # colours are taken at the edge, since they change fast towards it on a surface that turns away
    of_first, of_second = near * of_first, near * of_second
    if corner == 0:
        light(faces, colors, laid, index, of_first, of_second, 0.0, steps, 0, 0)
    elif corner == 1:
        light(faces, colors, laid, index, 0.0, of_first, of_second, steps, 0, 0)
    else:
        light(faces, colors, laid, index, of_second, 0.0, of_first, steps, 0, 0)
    # The area that changes colour is part of the pixel in which the edge lies. With one sample per pixel, the gradient
    # of this pixel alone would jump when the edge passes the border; the mean of both pixels' gradients does not.
    inside = 1.0 if share < 0.5 else 0.0
    if once or share == 0.5:
        inside = 0.5
    handed = 0.0
    for channel in range(steps.shape[2]):
        step = steps[0, 0, channel] - steps[0, 1, channel]
        here, there = along_color[row, column, channel], along_color[other_row, other_column, channel]
        handed += (inside * here + (1 - inside) * there) * step
    outwards = handed * ((other_column - column) + (other_row - row))
    along(seen, first, axis, outwards * (1 - part), lens, of_seen, of_lens)
    along(seen, second, axis, outwards * part, lens, of_seen, of_lens)


@compiled
@no_type_check
def turn(screen, faces, index):
    """Return twice the area of a face on the screen; 0 for a face that the near plane cuts.

    The area is above 0 where the inside of the face is on the positive side of its edges (`side`).
    """
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    if screen[a, 2] == 0 or screen[b, 2] == 0 or screen[c, 2] == 0:
        return 0.0
    return (screen[b, 0] - screen[a, 0]) * (screen[c, 1] - screen[a, 1]) - (screen[c, 0] - screen[a, 0]) * (
        screen[b, 1] - screen[a, 1]
    )


@compiled
@no_type_check
def leaves(screen, faces, index, facing, row, column, other_row, other_column):
    """Return by which edge the way from a pixel to another leaves a face, or -1, and at which share of the way."""
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
    """Return on which side of an edge's line a pixel lies, and how far: twice the area of their triangle."""
    x, y = column * SUBPIXELS, row * SUBPIXELS
    return (screen[a, 0] - x) * (screen[b, 1] - y) - (screen[b, 0] - x) * (screen[a, 1] - y)


@compiled
@no_type_check
def depth_at(seen, faces, index, ray_x, ray_y):
    """Return the depth of a face's plane along a ray, metres."""
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    bc0, bc1, bc2 = cross(seen[b, 0], seen[b, 1], seen[b, 2], seen[c, 0], seen[c, 1], seen[c, 2])
    ca0, ca1, ca2 = cross(seen[c, 0], seen[c, 1], seen[c, 2], seen[a, 0], seen[a, 1], seen[a, 2])
    ab0, ab1, ab2 = cross(seen[a, 0], seen[a, 1], seen[a, 2], seen[b, 0], seen[b, 1], seen[b, 2])
    total = ray_x * (bc0 + ca0 + ab0) + ray_y * (bc1 + ca1 + ab1) + bc2 + ca2 + ab2
    return (seen[a, 0] * bc0 + seen[a, 1] * bc1 + seen[a, 2] * bc2) / total


@compiled
@no_type_check
def along(seen, vertex, axis, slope, lens, of_seen, of_lens):
    """Add the gradient of a vertex's place f x / z + c along the screen's `axis`, given per pixel as `slope`."""
    focal, inverse = lens[axis], 1.0 / seen[vertex, 2]
    place = seen[vertex, axis] * inverse
    of_seen[vertex, axis] += slope * focal * inverse
    of_seen[vertex, 2] -= slope * focal * place * inverse
    of_lens[axis] += slope * place
    of_lens[2 + axis] += slope
