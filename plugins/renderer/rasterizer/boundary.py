"""Gradients of a loss with respect to vertices and camera that come from moving edges; compiled functions.

Arrays are described in `raster`. When an edge moves, the integral of the image changes by the difference of the colours
on the two sides of the edge, times the area that the edge sweeps (Li et al. 2018, eq. 4). If two neighbouring pixels
show surfaces of different depth, the edge at which the nearer surface ends lies between them (`find_edge`). Two pixels
of a row give the gradient with respect to motion of this edge along the row; two pixels of a column, along the column.
"""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.interior import cross
from plugins.renderer.rasterizer.raster import SUBPIXELS, compiled
from plugins.renderer.rasterizer.shading import fill_color, weights_in_space

MOST_FACES = 1000
"""Largest number of faces that `find_edge` follows between two neighbouring pixels."""


def find_adjacent_faces(faces):
    """Return the index of the neighbouring face at each edge of each face, (faces, 3).

    Edge i of a face runs from corner i to the next corner. The entry is -1 if an edge has no neighbouring face, or more
    than one.
    """
    start, end = faces.astype(np.int64), np.roll(faces, -1, 1).astype(np.int64)
    key = (np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)).ravel()
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    same = np.concatenate([[False], ordered[1:] == ordered[:-1], [False]])
    # edges that occur exactly twice
    first = np.flatnonzero(same[1:-1] & ~same[:-2] & ~same[2:])
    adjacent = np.full(len(key), -1, np.int64)
    adjacent[order[first]] = order[first + 1] // 3
    adjacent[order[first + 1]] = order[first] // 3
    return adjacent.reshape(-1, 3)


@compiled
@no_type_check
def boundary(
    camera_points,
    screen,
    faces,
    adjacent,
    colors,
    texture,
    lens,
    face,
    depth,
    box,
    single_sample,
    grad_image,
    grad_points,
    grad_lens,
):
    """Add to `grad_points` and `grad_lens` the gradient that comes from moving edges.

    `adjacent` is the result of `find_adjacent_faces`. `single_sample` is True if a pixel is one sample, and False if it
    is the mean of several. `grad_image` is the gradient of the loss with respect to the image, (height, width,
    channels). `colors` holds the channels of each vertex, `texture` a `textures.TextureArrays` or None, and `lens` fx,
    fy, cx, cy. The other arrays are described in `raster`.
    """
    height, width = face.shape
    top, bottom = max(box[0] - 1, 0), min(box[1] + 1, height)
    left, right = max(box[2] - 1, 0), min(box[3] + 1, width)
    footprint = 1.0 / min(lens[0], lens[1])
    edge_colors = np.empty((1, 2, grad_image.shape[2]))
    for row in range(top, bottom):
        for column in range(left, right):
            for down in range(2):
                other_row, other_column = row + down, column + 1 - down
                if other_row >= bottom or other_column >= right:
                    continue
                if face[other_row, other_column] == face[row, column]:
                    continue
                depth_here, other_depth = depth[row, column], depth[other_row, other_column]
                if not are_separate(depth_here, other_depth, footprint):
                    continue
                pixels = (row, column, other_row, other_column)
                if other_depth < depth_here:  # the pixel of the nearer surface comes first
                    pixels = (other_row, other_column, row, column)
                goal = face[pixels[2], pixels[3]]
                end = find_edge(screen, faces, adjacent, face[pixels[0], pixels[1]], goal, pixels)
                if end[0] >= 0:
                    surfaces = (camera_points, screen, faces, colors, texture, lens)
                    image = (face, depth, single_sample, grad_image)
                    add_edge_gradient(pixels, end, surfaces, image, grad_points, grad_lens, edge_colors)


@compiled
@no_type_check
def are_separate(depth, other_depth, footprint):
    """Return whether two neighbouring pixels may show separate surfaces.

    The surfaces may be separate if their depths differ by more than the width of a pixel at the farther of the two
    depths, or if one pixel shows the background.

    Args:
        depth: depth at one pixel, metres; infinite for background.
        other_depth: depth at the other pixel.
        footprint: width of a pixel, in metres per metre of depth.
    """
    return (
        abs(depth - other_depth) > footprint * max(depth, other_depth)
        or depth == np.inf
        or other_depth == np.inf
    )


@compiled
@no_type_check
def find_edge(screen, faces, adjacent, index, goal, pixels):
    """Find the edge between two neighbouring pixels at which the nearer surface ends.

    The surface is followed face by face, from the pixel that shows it to the other pixel. It ends at an edge that has
    no neighbouring face, or whose neighbouring face is seen from its other side.

    Args:
        screen: see `raster`.
        faces: (faces, 3), indices of vertices.
        adjacent: result of `find_adjacent_faces`.
        index: face at the pixel that shows the nearer surface.
        goal: face at the other pixel.
        pixels: row and column of the pixel that shows the nearer surface, row and column of the other pixel.

    Returns:
        Index of the last face of the surface, or -1 if the surface does not end between the pixels; number of the edge
        in this face; position of the edge between the two pixels, 0 to 1.
    """
    row, column, other_row, other_column = pixels
    facing = signed_area(screen, faces, index)
    for _ in range(MOST_FACES):
        corner, share = find_exit(screen, faces, index, facing, row, column, other_row, other_column)
        if corner < 0 or share >= 1:
            break
        following = adjacent[index, corner]
        if following < 0 or signed_area(screen, faces, following) * facing <= 0:
            return index, corner, share
        if following == goal:
            break
        index = following
    return -1, -1, 0.0


@compiled
@no_type_check
def add_edge_gradient(pixels, end, surfaces, image, grad_points, grad_lens, edge_colors):
    """Add the contribution of a pair of neighbouring pixels to `grad_points` and `grad_lens`.

    Args:
        pixels: row and column of the pixel that shows the nearer surface, row and column of the other pixel.
        end: edge between the two pixels, as `find_edge` returns it.
        surfaces: camera points, screen, faces, colours, texture and lens.
        image: visible faces, depths, `single_sample` and `grad_image` of `boundary`.
        grad_points: gradient of the loss with respect to the vertices in camera coordinates.
        grad_lens: gradient of the loss with respect to the lens.
        edge_colors: working array, (1, 2, channels).
    """
    row, column, other_row, other_column = pixels
    index, corner, share = end
    camera_points, screen, faces, colors, texture, lens = surfaces
    face, depth, single_sample, grad_image = image
    first, second = faces[index, corner], faces[index, (corner + 1) % 3]
    in_row = other_row == row
    axis = 0 if in_row else 1
    # position of the crossing point on the edge, 0 to 1
    start, end = screen[first, 1 - axis], screen[second, 1 - axis]
    if start == end:
        return
    part = min(max(((row if in_row else column) * SUBPIXELS - start) / (end - start), 0.0), 1.0)
    first_weight, second_weight = (1 - part) * screen[first, 2], part * screen[second, 2]
    near = 1.0 / (first_weight + second_weight)
    behind = face[other_row, other_column]
    ray_x = (column + share * (other_column - column) - lens[2]) / lens[0]
    ray_y = (row + share * (other_row - row) - lens[3]) / lens[1]
    if behind >= 0:
        # no edge if the surface continues: the farther surface must lie behind the crossing point by more than its own
        # slope explains
        far = np.float64(depth[other_row, other_column])
        beyond = depth_at(camera_points, faces, behind, ray_x, ray_y)
        if not far - near > 2 * abs(far - beyond) + far / min(lens[0], lens[1]):
            return
        a, b, c = faces[behind, 0], faces[behind, 1], faces[behind, 2]
        w0, w1, w2 = weights_in_space(camera_points, a, b, c, ray_x, ray_y)
        fill_color(faces, colors, texture, behind, w0, w1, w2, edge_colors, 0, 1)
    else:
        edge_colors[0, 1] = 0.0
    # colours are taken at the edge, because they may change fast near the silhouette of a curved surface
    first_weight, second_weight = near * first_weight, near * second_weight
    if corner == 0:
        fill_color(faces, colors, texture, index, first_weight, second_weight, 0.0, edge_colors, 0, 0)
    elif corner == 1:
        fill_color(faces, colors, texture, index, 0.0, first_weight, second_weight, edge_colors, 0, 0)
    else:
        fill_color(faces, colors, texture, index, second_weight, 0.0, first_weight, edge_colors, 0, 0)
    # The area that changes colour belongs to the pixel in which the edge lies. With one sample per pixel, however, the
    # gradient of this pixel alone would jump when the edge passes a pixel border; the mean of both pixels does not.
    inside = 1.0 if share < 0.5 else 0.0
    if single_sample or share == 0.5:
        inside = 0.5
    gain = 0.0
    for channel in range(edge_colors.shape[2]):
        step = edge_colors[0, 0, channel] - edge_colors[0, 1, channel]
        grad_here, grad_there = grad_image[row, column, channel], grad_image[other_row, other_column, channel]
        gain += (inside * grad_here + (1 - inside) * grad_there) * step
    outwards = gain * ((other_column - column) + (other_row - row))
    add_screen_gradient(camera_points, first, axis, outwards * (1 - part), lens, grad_points, grad_lens)
    add_screen_gradient(camera_points, second, axis, outwards * part, lens, grad_points, grad_lens)


@compiled
@no_type_check
def signed_area(screen, faces, index):
    """Return twice the signed area of a face on the screen; 0 for a face that the near plane cuts.

    The area is positive if the inside of the face is on the positive side of its edges (`side`).
    """
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    if screen[a, 2] == 0 or screen[b, 2] == 0 or screen[c, 2] == 0:
        return 0.0
    return (screen[b, 0] - screen[a, 0]) * (screen[c, 1] - screen[a, 1]) - (screen[c, 0] - screen[a, 0]) * (
        screen[b, 1] - screen[a, 1]
    )


@compiled
@no_type_check
def find_exit(screen, faces, index, facing, row, column, other_row, other_column):
    """Find the edge through which the line from a pixel to another pixel leaves a face.

    Args:
        screen: see `raster`.
        faces: (faces, 3), indices of vertices.
        index: the face.
        facing: `signed_area` of a face of the same surface; its sign tells on which side of an edge the face lies.
        row: row of the first pixel.
        column: column of the first pixel.
        other_row: row of the other pixel.
        other_column: column of the other pixel.

    Returns:
        Number of the edge in the face, or -1 if the line crosses no edge outwards; and the position of the crossing on
        the line, 0 at the first pixel and 1 at the other pixel.
    """
    share, exit_corner = np.inf, -1
    for corner in range(3):
        a, b = faces[index, corner], faces[index, (corner + 1) % 3]
        inside = side(screen, a, b, row, column)
        outside = side(screen, a, b, other_row, other_column)
        if (inside - outside) * facing > 0 and inside / (inside - outside) < share:
            share, exit_corner = inside / (inside - outside), corner
    return exit_corner, share


@compiled
@no_type_check
def side(screen, a, b, row, column):
    """Return a number whose sign says on which side of the edge from vertex `a` to vertex `b` a pixel lies.

    It is twice the signed area of the triangle of both vertices and the pixel, in squares of 1/256 pixel.
    """
    x, y = column * SUBPIXELS, row * SUBPIXELS
    return (screen[a, 0] - x) * (screen[b, 1] - y) - (screen[b, 0] - x) * (screen[a, 1] - y)


@compiled
@no_type_check
def depth_at(camera_points, faces, index, ray_x, ray_y):
    """Return the depth, metres, at which the ray (ray_x, ray_y, 1) from the camera meets the plane of face `index`."""
    a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
    bc0, bc1, bc2 = cross(
        camera_points[b, 0],
        camera_points[b, 1],
        camera_points[b, 2],
        camera_points[c, 0],
        camera_points[c, 1],
        camera_points[c, 2],
    )
    ca0, ca1, ca2 = cross(
        camera_points[c, 0],
        camera_points[c, 1],
        camera_points[c, 2],
        camera_points[a, 0],
        camera_points[a, 1],
        camera_points[a, 2],
    )
    ab0, ab1, ab2 = cross(
        camera_points[a, 0],
        camera_points[a, 1],
        camera_points[a, 2],
        camera_points[b, 0],
        camera_points[b, 1],
        camera_points[b, 2],
    )
    total = ray_x * (bc0 + ca0 + ab0) + ray_y * (bc1 + ca1 + ab1) + bc2 + ca2 + ab2
    return (camera_points[a, 0] * bc0 + camera_points[a, 1] * bc1 + camera_points[a, 2] * bc2) / total


@compiled
@no_type_check
def add_screen_gradient(camera_points, vertex, axis, slope, lens, grad_points, grad_lens):
    """Add the gradient through the screen coordinate f x / z + c of a vertex.

    f is the focal length and c the principal point along `axis` (0: column, 1: row), pixels; x and z are camera
    coordinates. `slope` is the gradient of the loss with respect to the screen coordinate, per pixel.
    """
    focal, inverse = lens[axis], 1.0 / camera_points[vertex, 2]
    ratio = camera_points[vertex, axis] * inverse
    grad_points[vertex, axis] += slope * focal * inverse
    grad_points[vertex, 2] -= slope * focal * ratio * inverse
    grad_lens[axis] += slope * ratio
    grad_lens[2 + axis] += slope
