"""Rasterisation on one CPU core: which pixels a triangle covers, and which triangle is visible; compiled functions.

Corners are rounded to 1/256 pixel. Edge functions that are exact on these integers (Pineda 1988) and the top-left rule
decide which pixels a triangle covers: a pixel centre on the edge between two triangles belongs to exactly one of them.
Rounded corners also decide which of several triangles is the nearest at a pixel. The colours of the nearest triangle
are interpolated between corners that are not rounded, see `shading`.

Arrays:
    camera_points: (vertices, 3) float64: vertices in camera coordinates, x right, y down, z forward, metres.
    screen: (vertices, 5) float64: column and row in 1/256 pixel, rounded to integers; 1 / depth in 1/metre, or 0 for a
        vertex that cannot be drawn; column and row in 1/256 pixel, not rounded.
    depth, face, mask: (height, width) float32, int32, bool; depths are computed from rounded corners.
    box: first row, last row + 1, first column, last column + 1 of the pixels that may show a face.
    rotation, translation: (3, 3) and (3,), from world to camera coordinates.
    focal, principal: (fx, fy) and (cx, cy), pixels.
    near: distance of the near plane from the camera, metres.

If an argument is None, the code that uses it is not compiled. `no_type_check` prevents the type checker of the tests
from wrapping a kernel before it is compiled.
"""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

SUBPIXELS = 256.0
EXACT = 2.0**25
"""Largest coordinate in 1/256 pixel at which edge functions are exact.

Up to this size their values stay below 2^53, so that int64 and float64 give the same integer.
"""
LARGEST = 1e100  # 1/256 pixel; a product of two coordinates and an inverse depth stays finite in float64
NEAREST = 1e-100  # metres; the same holds for depths above this
FARTHEST = 3e38  # metres; the largest depth that float32 holds
TILE = 8  # pixels
RUN = 128  # faces
DRAWN, BEHIND, FLAT, BACK, OUTSIDE, HIDDEN = range(6)
"""Outcomes of drawing a face, as indices of `counts`."""
REASONS = {BEHIND: "behind", FLAT: "flat", BACK: "back", OUTSIDE: "outside", HIDDEN: "hidden"}

# Without fastmath: products must be rounded before they are subtracted, see `_draw_far`.
KERNELS = "boundary", "canvas", "clipping", "interior", "nmr", "raster", "shading", "soft", "textures"
"""Names of the files whose compiled functions call each other."""
KEPT_IN = kernel_cache("rasterizer", (Path(__file__).with_name(f"{name}.py") for name in KERNELS))
compiled = compiler(KEPT_IN)


@compiled
@no_type_check
def is_out_of_view(vertices, rotation, translation, focal, principal, near, height, width):
    """Return whether the bounding box of all vertices lies completely outside one plane of the view frustum.

    The planes lie one pixel outside of the image, so that rounding loses no visible pixel. Coordinates that are NaN are
    ignored. An infinite coordinate makes the box infinite and the result False. `vertices` are in world coordinates;
    the module describes the arguments of the camera.
    """
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for vertex in range(vertices.shape[0]):
        for axis in range(3):
            value = np.float64(vertices[vertex, axis])
            if value < low[axis]:
                low[axis] = value
            if value > high[axis]:
                high[axis] = value
    for plane in range(5):
        # a plane is given by weights of the camera coordinates (x, y, z) and an offset; visible points give >= 0
        x = y = offset = 0.0
        if plane == 0:
            z, offset = 1.0, -near
        elif plane == 1:
            x, z = focal[0], principal[0] + 1
        elif plane == 2:
            x, z = -focal[0], width - principal[0]
        elif plane == 3:
            y, z = focal[1], principal[1] + 1
        else:
            y, z = -focal[1], height - principal[1]
        most = offset + x * translation[0] + y * translation[1] + z * translation[2]
        size = abs(offset) + abs(x * translation[0]) + abs(y * translation[1]) + abs(z * translation[2])
        for axis in range(3):
            along_x, along_y, along_z = x * rotation[0, axis], y * rotation[1, axis], z * rotation[2, axis]
            slope = along_x + along_y + along_z
            most += max(slope * low[axis], slope * high[axis])
            size += (abs(along_x) + abs(along_y) + abs(along_z)) * max(abs(low[axis]), abs(high[axis]))
        if most < -1e-12 * size:  # far more than the rounding error of these sums
            return True
    return False


@compiled
@no_type_check
def project(vertices, rotation, translation, focal, principal, near, camera_points, screen):
    """Fill `camera_points` and `screen` from the world coordinates `vertices`, (vertices, 3), metres.

    Return the number of finite vertices that the near plane cuts off. The module describes the other arguments.
    """
    hidden = 0
    for vertex in range(vertices.shape[0]):
        a = np.float64(vertices[vertex, 0])
        b = np.float64(vertices[vertex, 1])
        c = np.float64(vertices[vertex, 2])
        x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + translation[0]
        y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + translation[1]
        z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + translation[2]
        camera_points[vertex, 0], camera_points[vertex, 1], camera_points[vertex, 2] = x, y, z
        on_screen(x, y, z, focal, principal, near, screen[vertex])
        if screen[vertex, 2] == 0 and z < near and abs(x) <= LARGEST and abs(y) <= LARGEST and z >= -LARGEST:
            hidden += 1
    return hidden


@compiled
@no_type_check
def on_screen(x, y, z, focal, principal, near, row_of_screen):
    """Fill a row of `screen` from the camera coordinates x, y, z of a vertex.

    The docstring of the module describes `screen`, `focal`, `principal` and `near`.

    The row is 0 if the vertex cannot be drawn: if it is nearer than `near`, too far away, or not finite.
    """
    inverse = 1.0 / z
    column = (focal[0] * x * inverse + principal[0]) * SUBPIXELS
    row = (focal[1] * y * inverse + principal[1]) * SUBPIXELS
    # compared as floats, before any cast to integers; every comparison with NaN is false
    if z >= near and z <= FARTHEST and abs(column) <= LARGEST and abs(row) <= LARGEST:
        row_of_screen[0], row_of_screen[1], row_of_screen[2] = np.rint(column), np.rint(row), inverse
        row_of_screen[3], row_of_screen[4] = column, row
    else:
        row_of_screen[:] = 0.0


@compiled
@no_type_check
def owns_edge(along_column, along_row):
    """Return whether a pixel centre that lies exactly on an edge belongs to the edge's triangle (top-left rule).

    Args:
        along_column: derivative of the edge function with respect to the column.
        along_row: derivative of the edge function with respect to the row.
    """
    return along_column > 0 or (along_column == 0 and along_row > 0)


@compiled
@no_type_check
def comes_before(x, y, other_x, other_y):
    """Return whether the point (x, y) precedes the point (other_x, other_y) in row-major order."""
    return y < other_y or (y == other_y and x < other_x)


@compiled
@no_type_check
def rasterise(
    screen, faces, first, numbers, cull, height, width, depth, face, mask, farthest, empty, changed, counts
):
    """Draw faces into `depth` and `face`, or only into `mask`, and return the box of pixels that may show a face.

    Each pixel shows the nearest face; among equal float32 depths, it shows the face with the lowest number. The arrays
    may already show faces of an earlier call.

    Args:
        screen: corners, see the module.
        faces: (faces, 3), indices of rows of `screen`.
        first: number of the first face, if `numbers` is None.
        numbers: (faces), number of each face, or None; faces with the same number are parts of one face.
        cull: whether faces seen from behind are left out.
        height: height of the image, pixels.
        width: width of the image, pixels.
        depth: depths, or None.
        face: visible faces; None if `depth` is None.
        mask: covered pixels, or None.
        farthest: None, or an upper bound of the depths in each tile of `TILE` × `TILE` pixels.
        empty: None, or the number of pixels of each tile that show the background.
        changed: None, or the number of pixels of each tile that were written since `farthest` was computed.
        counts: (6) int64; the number of faces with each outcome (`DRAWN` etc.) is added.
    """
    last_x, last_y = (width - 1) * SUBPIXELS, (height - 1) * SUBPIXELS
    box_top, box_bottom, box_left, box_right = height, 0, width, 0
    behind = flat = back = outside = hidden = drawn_faces = 0
    last_number = -1
    for index in range(faces.shape[0]):
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        near0, near1, near2 = screen[a, 2], screen[b, 2], screen[c, 2]
        if near0 == 0 or near1 == 0 or near2 == 0:
            behind += 1
            continue
        ax, ay = screen[a, 0], screen[a, 1]
        bx, by = screen[b, 0], screen[b, 1]
        cx, cy = screen[c, 0], screen[c, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)  # exact up to EXACT
        # counter-clockwise faces have negative area, because rows run downwards
        if area < 0:
            area = -area
            bx, by, near1, cx, cy, near2 = cx, cy, near2, bx, by, near1
        elif area == 0:
            flat += 1
            continue
        elif cull:
            back += 1
            continue
        left, right = min(ax, bx, cx), max(ax, bx, cx)
        top, bottom = min(ay, by, cy), max(ay, by, cy)
        if right < 0 or bottom < 0 or left > last_x or top > last_y:
            outside += 1
            continue
        # pixel centres in the bounding box; coordinates are clamped as floats, so that the casts are safe
        first_column = (np.int64(max(left, 0.0)) + 255) >> 8
        last_column = np.int64(min(right, last_x)) >> 8
        first_row = (np.int64(max(top, 0.0)) + 255) >> 8
        last_row = np.int64(min(bottom, last_y)) >> 8
        if first_column > last_column or first_row > last_row:
            outside += 1
            continue
        least, most = min(near0, near1, near2), max(near0, near1, near2)
        pixels = (first_row, last_row, first_column, last_column)
        if farthest is not None and is_hidden(farthest, pixels, np.float32(1.0 / most)):
            hidden += 1
            continue
        if numbers is None:
            number = first + index
            drawn_faces += 1
        else:
            number = numbers[index]
            drawn_faces += 1 if number != last_number else 0
            last_number = number
        box_top, box_bottom = min(box_top, first_row), max(box_bottom, last_row + 1)
        box_left, box_right = min(box_left, first_column), max(box_right, last_column + 1)
        if depth is not None:
            # start with the topmost, then leftmost corner: the rounding of a depth then does not depend on the order of
            # the corners, and two faces with the same corners have the same depths
            if comes_before(bx, by, ax, ay) and comes_before(bx, by, cx, cy):
                ax, ay, near0, bx, by, near1, cx, cy, near2 = bx, by, near1, cx, cy, near2, ax, ay, near0
            elif comes_before(cx, cy, ax, ay):
                ax, ay, near0, bx, by, near1, cx, cy, near2 = cx, cy, near2, ax, ay, near0, bx, by, near1
        if left < -EXACT or right > EXACT or top < -EXACT or bottom > EXACT:
            corners = (ax, ay, near0, bx, by, near1, cx, cy, near2)
            _draw_far(corners, pixels, number, depth, face, mask)
            continue
        x0, y0, x1, y1 = np.int64(ax), np.int64(ay), np.int64(bx), np.int64(by)
        x2, y2 = np.int64(cx), np.int64(cy)
        # gradients of the edge functions (Pineda 1988), each of the edge opposite a corner, positive inside
        column0, row0 = y1 - y2, x2 - x1
        column1, row1 = y2 - y0, x0 - x2
        column2, row2 = y0 - y1, x1 - x0
        bias0 = 0 if owns_edge(column0, row0) else 1
        bias1 = 0 if owns_edge(column1, row1) else 1
        bias2 = 0 if owns_edge(column2, row2) else 1
        x, y = first_column << 8, first_row << 8
        start0 = column0 * (x - x1) + row0 * (y - y1) - bias0
        start1 = column1 * (x - x2) + row1 * (y - y2) - bias1
        start2 = column2 * (x - x0) + row2 * (y - y0) - bias2
        column0, column1, column2 = column0 << 8, column1 << 8, column2 << 8
        row0, row1, row2 = row0 << 8, row1 << 8, row2 << 8
        scale0, scale1, scale2 = near0 / area, near1 / area, near2 / area
        written = 0
        for row in range(first_row, last_row + 1):
            edge0, edge1, edge2 = start0, start1, start2
            for column in range(first_column, last_column + 1):
                if mask is not None:
                    mask[row, column] |= (edge0 | edge1 | edge2) >= 0
                if depth is not None and (edge0 | edge1 | edge2) >= 0:
                    # 1 / depth is affine on the screen; it is clamped to the range of the corners
                    inverse = (edge0 + bias0) * scale0 + (edge1 + bias1) * scale1 + (edge2 + bias2) * scale2
                    distance = np.float32(1.0 / min(max(inverse, least), most))
                    shown_depth = depth[row, column]
                    if distance < shown_depth or (distance == shown_depth and number < face[row, column]):
                        depth[row, column] = distance
                        face[row, column] = number
                        if empty is not None:
                            written += 1
                            if shown_depth == np.inf:
                                empty[row // TILE, column // TILE] -= 1
                edge0 += column0
                edge1 += column1
                edge2 += column2
            start0 += row0
            start1 += row1
            start2 += row2
        if farthest is not None and written > 0:
            update_tiles(farthest, empty, changed, pixels, written, depth)
    for outcome, count in ((DRAWN, drawn_faces), (BEHIND, behind), (FLAT, flat), (BACK, back)):
        counts[outcome] += count
    counts[OUTSIDE] += outside
    counts[HIDDEN] += hidden
    return box_top, box_bottom, box_left, box_right


@compiled
@no_type_check
def is_hidden(farthest, pixels, nearest):
    """Return whether every pixel of a box certainly has a depth below `nearest`, by the bounds in `farthest`.

    Args:
        farthest: upper bound of the depths in each tile of `TILE` × `TILE` pixels.
        pixels: first row, last row, first column, last column of the box.
        nearest: smallest depth of the face that would be drawn, metres.
    """
    first_row, last_row, first_column, last_column = pixels
    for row in range(first_row // TILE, last_row // TILE + 1):
        for column in range(first_column // TILE, last_column // TILE + 1):
            if not nearest > farthest[row, column]:
                return False
    return True


@compiled
@no_type_check
def update_tiles(farthest, empty, changed, pixels, written, depth):
    """Record that `written` pixels of the box `pixels` were written, and update `farthest` for the tiles of the box.

    The largest depth of a tile is computed when all pixels of the tile show a face for the first time. The largest
    depth is computed again whenever as many pixels have been written since then as the tile has. The arrays are those
    of `rasterise`.
    """
    first_row, last_row, first_column, last_column = pixels
    for row in range(first_row // TILE, last_row // TILE + 1):
        for column in range(first_column // TILE, last_column // TILE + 1):
            changed[row, column] += written
            if empty[row, column] > 0:
                continue
            if farthest[row, column] < np.inf and changed[row, column] < TILE * TILE:
                continue
            changed[row, column] = 0
            most = np.float32(0)
            for y in range(row * TILE, min((row + 1) * TILE, depth.shape[0])):
                for x in range(column * TILE, min((column + 1) * TILE, depth.shape[1])):
                    most = max(most, depth[y, x])
            farthest[row, column] = most


@compiled
@no_type_check
def front_to_back(screen, faces, cull, height, width, depth, face, farthest, empty, changed, counts):
    """Draw faces like `rasterise`, from near to far, and return the box of pixels that may show a face.

    `RUN` consecutive faces form a run. The runs are sorted by their nearest depth. If the box around a run is
    completely hidden, the run is not drawn, and all its faces are counted as hidden. The arguments are those of
    `rasterise`.
    """
    runs = (faces.shape[0] + RUN - 1) // RUN
    last_x, last_y = (width - 1) * SUBPIXELS, (height - 1) * SUBPIXELS
    nearest, bounds = np.zeros(runs), np.empty((runs, 4), np.int64)
    for run in range(runs):
        left = top = np.inf
        right = bottom = -np.inf
        whole = True
        for index in range(run * RUN, min((run + 1) * RUN, faces.shape[0])):
            for corner in range(3):
                vertex = faces[index, corner]
                x, y, near = screen[vertex, 0], screen[vertex, 1], screen[vertex, 2]
                whole &= near > 0
                nearest[run] = max(nearest[run], near)
                left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        # a run that crosses the near plane or is out of view gets an empty box, so it is never skipped as hidden
        if not whole or right < 0 or bottom < 0 or left > last_x or top > last_y:
            left, right, top, bottom = 0.0, -SUBPIXELS, 0.0, -SUBPIXELS
        bounds[run, 0], bounds[run, 1] = np.int64(max(top, 0.0)) >> 8, np.int64(min(bottom, last_y)) >> 8
        bounds[run, 2], bounds[run, 3] = np.int64(max(left, 0.0)) >> 8, np.int64(min(right, last_x)) >> 8
    top, bottom, left, right = height, 0, width, 0
    for run in np.argsort(-nearest):
        run_faces = faces[run * RUN : (run + 1) * RUN]
        pixels = (bounds[run, 0], bounds[run, 1], bounds[run, 2], bounds[run, 3])
        if bounds[run, 1] >= 0 and is_hidden(farthest, pixels, np.float32(1.0 / nearest[run])):
            counts[HIDDEN] += run_faces.shape[0]
            continue
        tiles = (farthest, empty, changed)
        box = rasterise(
            screen, run_faces, run * RUN, None, cull, height, width, depth, face, None, *tiles, counts
        )
        top, bottom = min(top, box[0]), max(bottom, box[1])
        left, right = min(left, box[2]), max(right, box[3])
    return top, bottom, left, right


@compiled
@no_type_check
def _draw_far(corners, pixels, number, depth, face, mask):
    """Draw a face with coordinates beyond `EXACT`, with float64 edge functions that are computed for each pixel.

    Reversing an edge changes only the sign of its rounded edge function (`edges`), so that neighbouring faces cover no
    pixel twice and leave no gap. For edges between corners within `EXACT`, the values equal the integers of
    `rasterise`.
    """
    ax, ay, near0, bx, by, near1, cx, cy, near2 = corners
    first_row, last_row, first_column, last_column = pixels
    owned0, owned1, owned2 = (
        owns_edge(by - cy, cx - bx),
        owns_edge(cy - ay, ax - cx),
        owns_edge(ay - by, bx - ax),
    )
    least, most = min(near0, near1, near2), max(near0, near1, near2)
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            edge0, edge1, edge2 = edges(ax, ay, bx, by, cx, cy, row, column)
            inside = edge0 > 0 or (edge0 == 0 and owned0)
            inside = inside and (edge1 > 0 or (edge1 == 0 and owned1))
            inside = inside and (edge2 > 0 or (edge2 == 0 and owned2)) and edge0 + edge1 + edge2 > 0
            if not inside:
                continue
            if mask is not None:
                mask[row, column] = True
            if depth is not None:
                inverse = (edge0 * near0 + edge1 * near1 + edge2 * near2) / (edge0 + edge1 + edge2)
                distance = np.float32(1.0 / min(max(inverse, least), most))
                shown_depth = depth[row, column]
                if distance < shown_depth or (distance == shown_depth and number < face[row, column]):
                    depth[row, column] = distance
                    face[row, column] = number


@compiled
@no_type_check
def edges(ax, ay, bx, by, cx, cy, row, column):
    """Return the three edge functions of the triangle (ax, ay), (bx, by), (cx, cy) at a pixel.

    The i-th edge function belongs to the edge opposite corner i. It is x1 y2 - x2 y1 for an edge from (x1, y1) to
    (x2, y2), in coordinates relative to the pixel. All coordinates are in 1/256 pixel, but `row` and `column` of the
    pixel are in pixels.
    """
    x, y = column * SUBPIXELS, row * SUBPIXELS
    ax, ay, bx, by, cx, cy = ax - x, ay - y, bx - x, by - y, cx - x, cy - y
    return bx * cy - cx * by, cx * ay - ax * cy, ax * by - bx * ay


@compiled
@no_type_check
def to_edge(ax, ay, bx, by, x, y):
    """Return the squared distance from (x, y) to the edge from (ax, ay) to (bx, by), and where the nearest point lies.

    The second number is the position of the nearest point on the edge: 0 at (ax, ay), and 1 at (bx, by).
    """
    ux, uy, vx, vy = bx - ax, by - ay, x - ax, y - ay
    length = ux * ux + uy * uy
    part = min(max((ux * vx + uy * vy) / length, 0.0), 1.0) if length > 0 else 0.0
    ox, oy = vx - part * ux, vy - part * uy
    return ox * ox + oy * oy, part
