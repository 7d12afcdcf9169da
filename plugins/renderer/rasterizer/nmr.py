"""The approximate gradient of Kato, Ushiku & Harada, "Neural 3D Mesh Renderer" (CVPR 2018, section 3); compiled.

When a moving edge arrives at a pixel j, the colour of j changes by the step δ_j^I. The paper replaces this step at the
distance δ_i^x by a linear ramp, so that pixel j attracts vertex i from any distance:

    ∂I_j/∂x_i = δ_j^I / δ_i^x  if δ_j^P δ_j^I < 0 (the loss falls; δ_j^P is its derivative in I_j), else 0

For a pixel outside of the face, δ_j^I is the change to the colour just inside of the edge. A pixel of the face itself
has one term for the edge on either side, with the change to the colour just outside of that edge. An edge has no effect
on outside pixels if its own face is hidden next to the edge. Details that the paper leaves open follow its published
kernel: these colours are taken from the two pixels beside the edge; faces seen from behind (clockwise) are ignored;
1e-4 is added to every distance, in units in which the image is 2 wide. Barycentric weights inside of a face contribute
no gradient with respect to positions; colours have their exact gradient.

Pixels without a gradient have no effect, so each line stores only the other pixels. Arrays are described in `raster`. A
line is a row of pixels, or a column if the arrays are transposed. A position is the index of a pixel in its line.
"""

from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler
from plugins.renderer.rasterizer.boundary import add_screen_gradient
from plugins.renderer.rasterizer.raster import KEPT_IN, SUBPIXELS, compiled

LEAST_DISTANCE = 1e-4  # added to distances; unit: half the image's side in the direction of the edge's motion

# allows reordering of sums, so that the processor adds several terms at once
reordered = compiler(KEPT_IN, fastmath={"reassoc", "contract", "nsz"})


def add_edge_gradients(
    camera_points: np.ndarray,
    screen: np.ndarray,
    faces: np.ndarray,
    lens: np.ndarray,
    face: np.ndarray,
    color: np.ndarray,
    grad_image: np.ndarray,
    grad_points: np.ndarray,
    grad_lens: np.ndarray,
) -> None:
    """Add the gradient that comes from moving edges to `grad_points` and `grad_lens`.

    All pairs of a pixel and an edge contribute, along the rows and along the columns of the image. `color` and
    `grad_image` are (height, width, channels). The other arrays are described in `raster`.
    """
    for axis in (0, 1):
        if axis == 1:
            face = np.ascontiguousarray(face.T)
            color = np.ascontiguousarray(color.transpose(1, 0, 2))
            grad_image = np.ascontiguousarray(grad_image.transpose(1, 0, 2))
        gradient_pixels = collect_gradient_pixels(face, color, grad_image)
        grad_position = np.zeros(len(camera_points))
        sum_line_gradients(axis, screen, faces, face, color, *gradient_pixels, grad_position)
        add_to_camera(camera_points, axis, grad_position, lens, grad_points, grad_lens)


@compiled
@no_type_check
def collect_gradient_pixels(face, color, grad_image):
    """Return the pixels at which the gradient of the loss with respect to the colour is not 0, line by line.

    These are the stored pixels. A line is a row of the image, or a column if the arrays are transposed. I is the colour
    of a pixel, and g is the gradient of the loss with respect to this colour.

    Args:
        face: (lines, length), index of the face that each pixel shows; -1 for none.
        color: (lines, length, channels), I.
        grad_image: (lines, length, channels), g.

    Returns:
        before: (lines, length + 1), number of stored pixels before each pixel and before the end of each line, counted
            from the first pixel of the first line.
        pixel_positions, owner, value: for each stored pixel its position in its line, the face that it shows, and
            I · g, the sum over the channels.
        slopes: (channels, stored pixels), g.
    """
    lines, length = face.shape
    channels = color.shape[2]
    before = np.empty((lines, length + 1), np.int64)
    count = 0
    for line in range(lines):
        for position in range(length):
            before[line, position] = count
            for channel in range(channels):
                if grad_image[line, position, channel] != 0:
                    count += 1
                    break
        before[line, length] = count
    pixel_positions, value = np.empty(count), np.zeros(count)
    owner = np.empty(count, np.int64)
    slopes = np.empty((channels, count))
    for line in range(lines):
        for position in range(length):
            slot = before[line, position]
            if slot < before[line, position + 1]:
                pixel_positions[slot] = position
                owner[slot] = face[line, position]
                for channel in range(channels):
                    slope = np.float64(grad_image[line, position, channel])
                    slopes[channel, slot] = slope
                    value[slot] += slope * color[line, position, channel]
    return before, pixel_positions, owner, value, slopes


@compiled
@no_type_check
def sum_line_gradients(
    axis, screen, faces, face, color, before, pixel_positions, owner, value, slopes, grad_position
):
    """Add the gradient of the loss with respect to each vertex's position along the lines to `grad_position`.

    The unit of this gradient is loss per pixel of motion. `axis` is 0 if the lines are rows, and 1 if they are columns.
    The other arguments are those of `add_edge_gradients`, and the results of `collect_gradient_pixels`.
    """
    lines, length = face.shape
    least = LEAST_DISTANCE * length / 2
    shown = np.zeros(faces.shape[0], np.bool_)
    for line in range(lines):
        for position in range(length):
            if face[line, position] >= 0:
                shown[face[line, position]] = True
    gains = np.empty(length)
    for index in range(faces.shape[0]):
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        if not shown[index] or screen[a, 2] == 0 or screen[b, 2] == 0 or screen[c, 2] == 0:
            continue
        ax, ay = screen[a, 0], screen[a, 1]
        if (screen[b, 0] - ax) * (screen[c, 1] - ay) >= (screen[c, 0] - ax) * (screen[b, 1] - ay):
            continue  # seen from behind
        low = min(screen[a, axis], screen[b, axis], screen[c, axis]) / SUBPIXELS
        high = max(screen[a, axis], screen[b, axis], screen[c, axis]) / SUBPIXELS
        first_place = np.int64(max(np.ceil(low), 0.0))
        last_place = np.int64(min(np.floor(high), length - 1.0))
        for corner in range(3):
            start_vertex, end_vertex, third_vertex = (
                faces[index, corner],
                faces[index, (corner + 1) % 3],
                faces[index, (corner + 2) % 3],
            )
            start, end = screen[start_vertex, 1 - axis] / SUBPIXELS, screen[end_vertex, 1 - axis] / SUBPIXELS
            if start == end:
                continue  # an edge parallel to the lines crosses no line; the published kernel divides by 0 here
            start_position = screen[start_vertex, axis] / SUBPIXELS
            lean = (screen[end_vertex, axis] / SUBPIXELS - start_position) / (end - start)
            opposite = start_position + lean * (screen[third_vertex, 1 - axis] / SUBPIXELS - start)
            outwards = 1 if opposite > screen[third_vertex, axis] / SUBPIXELS else -1
            # clamp before the casts: an end may be 1e30 lines away, which no integer holds
            first_line = np.int64(np.ceil(min(max(min(start, end), 0.0), lines)))
            last_line = np.int64(np.floor(max(min(max(start, end), lines - 1.0), -1.0)))
            for line in range(first_line, last_line + 1):
                crossing = start_position + lean * (line - start)
                inner = np.floor(crossing) if outwards > 0 else np.ceil(crossing)
                outer = inner + outwards
                if not (min(inner, outer) >= 0 and max(inner, outer) <= length - 1):
                    continue
                inside, outside = np.int64(inner), np.int64(outer)
                # The edge moves by this share of a vertex's motion: δ_i^x of the paper is distance / share.
                share = (end - line) / (end - start)
                for way in (outwards, -outwards):
                    if way == outwards:
                        if face[line, inside] != index:
                            continue
                        first = before[line, outside if way > 0 else 0]
                        last = before[line, length if way > 0 else outside + 1]
                        number, painted = -1, color[line, inside]
                    else:
                        first = before[line, inside if way > 0 else first_place]
                        last = before[line, (last_place if way > 0 else inside) + 1]
                        number, painted = index, color[line, outside]
                    if first >= last:
                        continue
                    gain_start, gain_end = sum_gains(
                        first,
                        last,
                        number,
                        painted,
                        crossing,
                        share,
                        least,
                        pixel_positions,
                        owner,
                        value,
                        slopes,
                        gains,
                    )
                    grad_position[start_vertex] -= way * gain_start
                    grad_position[end_vertex] -= way * gain_end


@reordered
@no_type_check
def sum_gains(
    first, last, number, painted, crossing, share, least, pixel_positions, owner, value, slopes, gains
):
    """Return the decrease of the loss per pixel of motion of the start and of the end of an edge.

    The decrease is summed over the stored pixels from `first` to `last` - 1 that show the face `number` (-1: any face).

    Args:
        first: index of the first stored pixel.
        last: index after the last stored pixel.
        number: face that the pixels must show, or -1.
        painted: colour that the pixels change to.
        crossing: position at which the edge crosses the line.
        share: motion of the crossing for a motion of 1 of the edge's start; for the edge's end it is 1 - `share`.
        least: distance that is added to every distance, pixels.
        pixel_positions: position of each stored pixel in its line.
        owner: face that each stored pixel shows.
        value: I · g of each stored pixel, for its colour I and the gradient g with respect to it.
        slopes: (channels, stored pixels), g.
        gains: working array.
    """
    count = last - first
    gains = gains[:count]
    gains[:] = value[first:last]
    for channel in range(slopes.shape[0]):
        paint = np.float64(painted[channel])
        slope = slopes[channel, first:last]
        for pixel in range(count):
            gains[pixel] -= paint * slope[pixel]  # -δ_j^I δ_j^P
    if number >= 0:
        owners = owner[first:last]
        for pixel in range(count):
            gains[pixel] = gains[pixel] if owners[pixel] == number else 0.0
    other_share = 1 - share
    add = share * least if share > 0 else 1.0
    other_add = other_share * least if other_share > 0 else 1.0
    gain_start = gain_end = 0.0
    positions = pixel_positions[first:last]
    for pixel in range(count):
        distance = abs(positions[pixel] - crossing)
        gain = max(gains[pixel], 0.0)  # 0 where δ_j^P δ_j^I >= 0; over δ_i^x = distance / share + least
        gain_start += gain / (distance + add)
        gain_end += gain / (distance + other_add)
    return share * gain_start, other_share * gain_end


@compiled
@no_type_check
def add_to_camera(camera_points, axis, grad_position, lens, grad_points, grad_lens):
    """Convert gradients with respect to positions on the screen, and add them to `grad_points` and `grad_lens`.

    `grad_position` is the gradient of the loss with respect to the position of each vertex along one axis of the screen
    (`axis` 0: column, 1: row), per pixel.
    """
    for vertex in range(grad_position.shape[0]):
        if grad_position[vertex] != 0:
            add_screen_gradient(
                camera_points, vertex, axis, grad_position[vertex], lens, grad_points, grad_lens
            )
