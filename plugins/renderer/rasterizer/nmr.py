"""The approximate gradient of Kato, Ushiku & Harada, "Neural 3D Mesh Renderer" (CVPR 2018, section 3); compiled.

An edge that moves along a row of pixels recolours a pixel j when it has come as far as j. The paper replaces that step
of height δ_j^I at the distance δ_i^x by a ramp, so that j attracts the vertex i from any distance:

    ∂I_j/∂x_i = δ_j^I / δ_i^x  where δ_j^P δ_j^I < 0 (the loss falls; δ_j^P is its slope in I_j), else 0

For a pixel outside of the face, δ_j^I leads to the colour just inside of the edge. For a pixel of the face itself,
there is one such term for the edge on either side, which leads to the colour just outside of it. An edge has no effect
on pixels outside where its face is hidden beside it. Where the paper is silent, this code follows its published kernel:
these colours are those of the two pixels beside the edge; faces seen from behind (clockwise) have no part; 1e-4 is
added to every distance, in units in which the image is 2 wide. The place of a pixel inside its face has no gradient in
positions; colours have their exact gradient.

Pixels without a gradient have no effect, so for each line only the others are kept. Arrays are those of `raster`; a
line is a row of pixels, or a column where the arrays come transposed, and a place is a pixel's number along the line.
"""

from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler
from plugins.renderer.rasterizer.boundary import along
from plugins.renderer.rasterizer.raster import KEPT_IN, SUBPIXELS, compiled

LEAST_DISTANCE = 1e-4  # added to distances, in half image sides along the direction in which an edge moves

# sums may be reordered, so that a processor adds several terms at once
reordered = compiler(KEPT_IN, fastmath={"reassoc", "contract", "nsz"})


def sweeps(
    seen: np.ndarray,
    screen: np.ndarray,
    faces: np.ndarray,
    lens: np.ndarray,
    face: np.ndarray,
    color: np.ndarray,
    along_color: np.ndarray,
    of_seen: np.ndarray,
    of_lens: np.ndarray,
) -> None:
    """Add to `of_seen` and `of_lens` the gradient from all pixels on all edges, along rows and along columns."""
    for axis in (0, 1):
        if axis == 1:
            face = np.ascontiguousarray(face.T)
            color = np.ascontiguousarray(color.transpose(1, 0, 2))
            along_color = np.ascontiguousarray(along_color.transpose(1, 0, 2))
        kept = pulling(face, color, along_color)
        of_place = np.zeros(len(seen))
        sweep(axis, screen, faces, face, color, *kept, of_place)
        to_camera(seen, axis, of_place, lens, of_seen, of_lens)


@compiled
@no_type_check
def pulling(face, color, along_color):
    """Return the pixels that have a gradient g, line by line.

    Returns:
        before: (lines, length + 1), how many pixels are kept before a pixel.
        place, owner, value: place, face and I · g of each kept pixel.
        slopes: (channels, kept), g.
    """
    lines, length = face.shape
    channels = color.shape[2]
    before = np.empty((lines, length + 1), np.int64)
    count = 0
    for line in range(lines):
        for position in range(length):
            before[line, position] = count
            for channel in range(channels):
                if along_color[line, position, channel] != 0:
                    count += 1
                    break
        before[line, length] = count
    place, value = np.empty(count), np.zeros(count)
    owner = np.empty(count, np.int64)
    slopes = np.empty((channels, count))
    for line in range(lines):
        for position in range(length):
            here = before[line, position]
            if here < before[line, position + 1]:
                place[here] = position
                owner[here] = face[line, position]
                for channel in range(channels):
                    slope = np.float64(along_color[line, position, channel])
                    slopes[channel, here] = slope
                    value[here] += slope * color[line, position, channel]
    return before, place, owner, value, slopes


@compiled
@no_type_check
def sweep(axis, screen, faces, face, color, before, place, owner, value, slopes, of_place):
    """Add to `of_place`, per vertex, the gradient of the loss in the vertex's place along the lines, per pixel."""
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
            one, other, third = (
                faces[index, corner],
                faces[index, (corner + 1) % 3],
                faces[index, (corner + 2) % 3],
            )
            start, end = screen[one, 1 - axis] / SUBPIXELS, screen[other, 1 - axis] / SUBPIXELS
            if start == end:
                continue  # an edge along the lines crosses none of them; the published kernel divides by 0 here
            here = screen[one, axis] / SUBPIXELS
            lean = (screen[other, axis] / SUBPIXELS - here) / (end - start)
            opposite = here + lean * (screen[third, 1 - axis] / SUBPIXELS - start)
            outwards = 1 if opposite > screen[third, axis] / SUBPIXELS else -1
            # clamp before the casts, since an integer cannot hold an end that is 1e30 lines away
            first_line = np.int64(np.ceil(min(max(min(start, end), 0.0), lines)))
            last_line = np.int64(np.floor(max(min(max(start, end), lines - 1.0), -1.0)))
            for line in range(first_line, last_line + 1):
                crossing = here + lean * (line - start)
                inner = np.floor(crossing) if outwards > 0 else np.ceil(crossing)
                outer = inner + outwards
                if not (min(inner, outer) >= 0 and max(inner, outer) <= length - 1):
                    continue
                inside, outside = np.int64(inner), np.int64(outer)
                # A vertex moves the edge by this share of its own way: δ_i^x of the paper is distance / share.
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
                    pulled, pulled_other = pull(
                        first,
                        last,
                        number,
                        painted,
                        crossing,
                        share,
                        least,
                        place,
                        owner,
                        value,
                        slopes,
                        gains,
                    )
                    of_place[one] -= way * pulled
                    of_place[other] -= way * pulled_other


@reordered
@no_type_check
def pull(first, last, number, painted, crossing, share, least, place, owner, value, slopes, gains):
    """Return the gain per pixel of motion of each end of an edge, summed over kept pixels.

    These are the pixels from `first` to before `last` that show the face `number`; -1 stands for all faces.
    """
    count = last - first
    gains = gains[:count]
    gains[:] = value[first:last]
    for channel in range(slopes.shape[0]):
        paint = np.float64(painted[channel])
        slope = slopes[channel, first:last]
        for each in range(count):
            gains[each] -= paint * slope[each]  # -δ_j^I δ_j^P
    if number >= 0:
        owners = owner[first:last]
        for each in range(count):
            gains[each] = gains[each] if owners[each] == number else 0.0
    other_share = 1 - share
    add = share * least if share > 0 else 1.0
    other_add = other_share * least if other_share > 0 else 1.0
    pulled = pulled_other = 0.0
    places = place[first:last]
    for each in range(count):
        distance = abs(places[each] - crossing)
        gain = max(gains[each], 0.0)  # 0 where δ_j^P δ_j^I >= 0; over δ_i^x = distance / share + least
        pulled += gain / (distance + add)
        pulled_other += gain / (distance + other_add)
    return share * pulled, other_share * pulled_other


@compiled
@no_type_check
def to_camera(seen, axis, of_place, lens, of_seen, of_lens):
    """Add gradients in places along one axis of the screen to those in camera coordinates and lens."""
    for vertex in range(of_place.shape[0]):
        if of_place[vertex] != 0:
            along(seen, vertex, axis, of_place[vertex], lens, of_seen, of_lens)
