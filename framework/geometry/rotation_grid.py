"""Grid of rotations with cells of equal volume: HEALPix pixels of directions, times arcs of a circle.

A rotation is described by azimuth a, elevation e and tilt t (`framework.geometry.rotation.viewpoint_rotation`). The
invariant measure of rotations is cos e da de dt / 8π². Directions (sin e, t) are divided into HEALPix pixels of equal
area (Górski et al. 2005), and the third coordinate into arcs of equal length, as Yershova et al. 2010 do.

The third coordinate is ψ = a - sin e · (t - tᵢ), where tᵢ is the tilt at the centre of the pixel. The shift of a does
not change volumes. Without it, cells at the poles would be long: at e = π/2 only t - a determines the rotation, and at
e = -π/2 only t + a.
"""

import math
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.geometry import quaternions

SMALLEST = 72
"""Number of cells of the coarsest grid: 12 HEALPix pixels of directions times 6 arcs of a circle."""
OFFSET = 0.05
"""Angle by which the grid is turned in azimuth and tilt, radians.

Without it, angles of 0° and 90°, which many data contain, would lie on borders of cells.
"""
FINER = 16
"""Least number of cells, for each of the rotations that are chosen far from one another."""
FIRST = 2
"""Index of the first of these rotations.

From the cell with index 0, the order of the grid leads to rotations of which some are nearer to one another.
"""
DIGITS = 9
"""Number of decimals in which distances are compared, so that rounding decides between no equal distances.

The grid has many symmetries, and the last bits of a product of matrices depend on the processor.
"""
SUBDIVISION = 32
"""Number of parts into which each side of a pixel is divided to compute the mean of log cos e over the pixel."""


def level_of(cells: int) -> int:
    """Return the level n, from 0 to 5, of the grid with `cells` = 72 · 8ⁿ cells.

    Raises:
        ValueError: no level has this number of cells.
    """
    for level in range(6):
        if cells == SMALLEST * 8**level:
            return level
    sizes = ", ".join(str(SMALLEST * 8**level) for level in range(6))
    raise ValueError(f"Got a grid of {cells} rotations, but grids have {sizes} cells. Choose one of them.")


@cache
def centres(cells: int) -> Float[Tensor, "cells 3"]:
    """Return azimuth, elevation and tilt of each cell's centre in the grid with `cells` cells, radians, float64."""
    index = torch.arange(cells)
    half = torch.full((cells,), 0.5, dtype=torch.float64)
    return points_in(index, half, half, half, cells)


def distant_rotations(count: int) -> Float[Tensor, "count 4"]:
    """Return `count` rotations that are far from one another, as unit quaternions, float64.

    They are cells' centres of the coarsest grid with at least FINER cells for each rotation. Each is as far as possible
    from the rotations before it (farthest-point order, Eldar et al. 1997); a smaller `count` gives the first ones of a
    larger `count` on the same grid.

    Raises:
        ValueError: no grid is fine enough.
    """
    sizes = [SMALLEST * 8**level for level in range(6)]
    cells = next((size for size in sizes if size >= FINER * count), None)
    if cells is None:
        raise ValueError(
            f"Got {count} rotations, but at most {sizes[-1] // FINER} can be spread. Ask for fewer."
        )
    turns = quaternions.of_viewpoint(centres(cells))
    chosen = [FIRST]
    nearest = (turns @ turns[FIRST]).abs()  # cosine of half the angle to the nearest chosen rotation
    for _ in range(count - 1):
        chosen.append(int(nearest.round(decimals=DIGITS).argmin()))  # the first one of several
        nearest = torch.maximum(nearest, (turns @ turns[chosen[-1]]).abs())
    return turns[chosen]


def points_in(index: Int[Tensor, "..."], x: Tensor, y: Tensor, along: Tensor, cells: int) -> Tensor:
    """Return a point in each given cell of the grid: azimuth, elevation and tilt, radians, (..., 3) float64.

    A cell is a HEALPix pixel of the sphere of directions times an arc of the circle of the third coordinate.

    Args:
        index: number of the cell, from 0 to `cells` - 1.
        x: position of the point along the first side of the pixel, from 0 to 1.
        y: position of the point along the second side of the pixel, from 0 to 1.
        along: position of the point along the arc, from 0 to 1.
        cells: number of cells of the grid.
    """
    side, arcs = 2 ** level_of(cells), 6 * 2 ** level_of(cells)
    pixel, arc = index // arcs, index % arcs
    height, tilt = _direction(pixel, x.double(), y.double(), side)
    half = torch.full_like(x, 0.5, dtype=torch.float64)
    _, middle = _direction(pixel, half, half, side)
    azimuth = 2 * math.pi * (arc + along.double()) / arcs + height * _wrap(tilt - middle)
    elevation = torch.asin(height.clamp(-1, 1))
    return torch.stack([_wrap(azimuth + OFFSET), elevation, _wrap(tilt + OFFSET)], -1)


def cell_of(angles: Float[Tensor, "... 3"], cells: int) -> Int[Tensor, "..."]:
    """Return the number of the cell, in the grid with `cells` cells, that contains each rotation.

    `angles` are azimuth, elevation and tilt of the rotations, radians.
    """
    azimuth, elevation, tilt = quaternions.to_viewpoint(quaternions.of_viewpoint(angles.double())).unbind(-1)
    azimuth, tilt = azimuth - OFFSET, tilt - OFFSET
    side, arcs = 2 ** level_of(cells), 6 * 2 ** level_of(cells)
    height = torch.sin(elevation)
    pixel = _pixel(height, tilt, side)
    half = torch.full_like(height, 0.5)
    _, middle = _direction(pixel, half, half, side)
    turn = torch.remainder(azimuth - height * _wrap(tilt - middle), 2 * math.pi)
    arc = (turn * (arcs / (2 * math.pi))).long().clamp(0, arcs - 1)
    return pixel * arcs + arc


@cache
def mean_log_cosine(cells: int) -> Float[Tensor, "cells"]:
    """Return the mean of log cos(elevation) over each cell of the grid with `cells` cells, with an error below 1e-4."""
    side, arcs = 2 ** level_of(cells), 6 * 2 ** level_of(cells)
    place = (torch.arange(SUBDIVISION, dtype=torch.float64) + 0.5) / SUBDIVISION
    x, y = torch.meshgrid(place, place, indexing="ij")
    pixel = torch.arange(12 * side**2)
    height, _ = _direction(pixel[:, None], x.flatten(), y.flatten(), side)
    return (torch.log1p(-height.square()) / 2).mean(-1).repeat_interleave(arcs)


def _wrap(angle: Tensor) -> Tensor:
    """Return the equivalent angle in [-π, π], radians."""
    return angle - 2 * math.pi * torch.round(angle / (2 * math.pi))


# The formulas below are those of Górski et al. 2005, §4 and §5. A face is a square with the sides x (to the north-east)
# and y (to the north-west). Near the poles, a line of constant latitude at the distance r from the pole, in pixels,
# has 4r pixels; between the polar caps it has four times `side`.


def _direction(pixel: Tensor, x: Tensor, y: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Return sin e and the tilt, radians, of a point in each HEALPix pixel.

    Args:
        pixel: number of the pixel.
        x: position of the point along the first side of the pixel, from 0 to 1.
        y: position of the point along the second side of the pixel, from 0 to 1.
        side: number of pixels along a side of each of the 12 faces of the sphere.
    """
    face, inside = pixel // side**2, pixel % side**2
    column, row = inside // side + x, inside % side + y
    band, quarter = face // 4, face % 4
    ring = (band + 2) * side - column - row  # from the north pole
    length = torch.minimum(torch.minimum(ring, 4 * side - ring), torch.full_like(ring, side))
    cap = 1 - length.square() / (3 * side**2)
    height = torch.where(
        ring < side, cap, torch.where(ring > 3 * side, -cap, (2 * side - ring) * 2 / (3 * side))
    )
    east = 2 * quarter + (band != 1)
    tilt = math.pi / 4 * (east + (column - row) / length.clamp(min=1e-12))
    return height, tilt


def _pixel(height: Tensor, tilt: Tensor, side: int) -> Tensor:
    """Return the number of the HEALPix pixel that contains each direction.

    Args:
        height: sin e of the direction.
        tilt: tilt of the direction, radians.
        side: number of pixels along a side of each of the 12 faces of the sphere.
    """
    quarter = torch.remainder(tilt, 2 * math.pi) / (math.pi / 2)
    quarter = torch.where(quarter >= 4, 0.0, quarter)
    # between the polar caps, two families of lines divide the faces
    rising = (side * (0.5 + quarter - 0.75 * height)).floor()
    falling = (side * (0.5 + quarter + 0.75 * height)).floor()
    of_rising, of_falling = rising // side, falling // side
    equator = of_rising == of_falling
    face = torch.where(
        equator, 4 + of_rising % 4, torch.where(of_rising < of_falling, of_rising % 4, 8 + of_falling % 4)
    )
    column, row = falling % side, side - rising % side - 1
    # in a polar cap, a face is a quarter
    number = quarter.floor()
    share, radius = quarter - number, side * (3 * (1 - height.abs()).clamp(min=0)).sqrt()
    first = (share * radius).floor().clamp(max=side - 1)
    second = ((1 - share) * radius).floor().clamp(max=side - 1)
    north = height > 0
    polar = height.abs() > 2 / 3
    face = torch.where(polar, torch.where(north, number, 8 + number), face)
    column = torch.where(polar, torch.where(north, side - second - 1, first), column)
    row = torch.where(polar, torch.where(north, side - first - 1, second), row)
    return (face * side**2 + column * side + row).long()
