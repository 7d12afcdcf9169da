"""Packing of a cloud for search: its points along a space-filling curve, and the bounding boxes of groups of 16.

A packed cloud is a tree without pointers. Its leaves hold 16 points that follow each other along a Hilbert curve
through a grid (counting sort, two passes over the points). If a cell holds too many points, since an outlier has
stretched the grid or a cluster is dense, its points are sorted again with a grid of their own. Every 16 leaves form a
node, every 16 nodes form a node of the next level, up to a level with at most 16 nodes.

Clouds are flat arrays x y z x y z …, finite, of moderate size (`MODERATE`); `bits` means 2^bits cells along each axis.
The `id` of a point is its row in the cloud.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from numpy.typing import NDArray

from framework.geometry.lanes import (
    LANES,
    fma,
    highest,
    lane,
    least,
    load,
    load4,
    load_quadruples,
    load_triples,
    lowest,
    most,
    splat,
    store,
    take,
    total,
    whole,
    with_id,
)
from framework.geometry.nearest.compiled import compiled, inlined

MODERATE = {4: (2.0**-40, 2.0**60), 8: (2.0**-40, 2.0**500)}
"""Smallest and largest accepted magnitude of the largest coordinate, by the number of bytes of a number.

Squares between these bounds neither overflow nor lose precision.
"""
BITS = 6
"""Largest value of `bits`: 2^18 cells, whose counts fit in the processor's second-level cache."""
CROWD = 256
"""Number of points above which the points of a cell are sorted again with a grid of their own (a crowded cell)."""
FLAT = 1e-30
"""Extent of a set of points below which they count as one position, because its inverse would overflow in float32."""


class Packed(NamedTuple):
    """A packed cloud of at least one point: a tree whose leaves hold 16 points each.

    Attributes:
        points: the leaves in order, each as 16 x, 16 y, 16 z and 16 ids; the last point is repeated to fill the last
            leaf.
        ids: the memory of `points` read as integers, int32 for float32 and int64 for float64. An id is a row of the
            cloud.
        box: lowest x, y, z and highest x, y, z of each node, as six concatenated arrays; nodes are ordered by level.
        low: lowest id in each node.
        levels: index of the first node of each level in elements 0…7, number of nodes of each level in 8…15, and the
            topmost level in 16. Element 17 holds the number of queries if the cloud consists of queries.
    """

    points: NDArray[np.floating]
    ids: NDArray[np.integer]
    box: NDArray[np.floating]
    low: NDArray[np.integer]
    levels: NDArray[np.int64]


class Bench(NamedTuple):
    """Working memory for packing a cloud.

    Attributes:
        key: cell of each point.
        count: number of points in each cell, one row for each thread.
        crowded: for each cell with more than CROWD points, begin and end of its points among the sorted points.
    """

    key: NDArray[np.int32]
    count: NDArray[np.int32]
    crowded: NDArray[np.int64]


def room(points: int, dtype: np.dtype) -> Packed:
    """Return uninitialised memory for a packed cloud of up to `points` points of the type `dtype`."""
    leaves = -(-points // LANES)
    nodes, level = 0, leaves
    while True:
        nodes += -(-level // LANES) * LANES
        if level <= LANES:
            break
        level = -(-level // LANES)
    records = np.empty(leaves * 4 * LANES, dtype)
    integer = np.dtype(f"int{8 * dtype.itemsize}")
    box, low = np.empty(6 * nodes, dtype), np.empty(nodes, integer)
    return Packed(records, records.view(integer), box, low, np.zeros(18, np.int64))


def bench(points: int, threads: int = 1) -> Bench:
    """Return working memory with which `threads` threads pack up to `points` points."""
    cells = 8 ** cell_bits(points)
    return Bench(
        np.empty(points, np.int32),
        np.empty((threads, cells), np.int32),
        np.empty(2 * (points // CROWD + 1), np.int64),
    )


@compiled
@no_type_check
def cell_bits(points):
    """Return the largest b, from 1 to BITS, for which a grid with 2^b cells along each axis has at most `points` cells.

    With fewer than 8 points, b is 1. If the points lie on a surface, most cells are empty, and the other cells hold
    several points.
    """
    bits = 1
    while bits < BITS and 8 ** (bits + 1) <= points:
        bits += 1
    return bits


@compiled
@no_type_check
def curve(bits):
    """Return the cells of several grids, each in the order of its Hilbert curve: grids with b = 1…`bits`, concatenated.

    The cells of the grid with 2^b cells along each axis begin at index (8^b - 8) / 7. A cell has the number (x 2^b + y)
    2^b + z. Source: Skilling, Programming the Hilbert curve, 2004: the bits of the transposed index of a cell give its
    position along the curve.
    """
    cells = np.empty((8 ** (bits + 1) - 8) // 7, np.int32)
    start = 0
    axes = np.empty(3, np.int64)
    for b in range(1, bits + 1):
        for cell in range(8**b):
            axes[0], axes[1], axes[2] = cell >> (2 * b), (cell >> b) & (2**b - 1), cell & (2**b - 1)
            bit = 2 ** (b - 1)
            while bit > 1:
                for axis in range(3):
                    if axes[axis] & bit:
                        axes[0] ^= bit - 1
                    else:
                        swapped = (axes[0] ^ axes[axis]) & (bit - 1)
                        axes[0] ^= swapped
                        axes[axis] ^= swapped
                bit >>= 1
            axes[1] ^= axes[0]
            axes[2] ^= axes[1]
            turned = 0
            bit = 2 ** (b - 1)
            while bit > 1:
                if axes[2] & bit:
                    turned ^= bit - 1
                bit >>= 1
            place = 0
            for position in range(b - 1, -1, -1):
                for axis in range(3):
                    place = 2 * place + (((axes[axis] ^ turned) >> position) & 1)
            cells[start + place] = cell
        start += 8**b
    return cells


@compiled
@no_type_check
def extent(cloud, size, box):
    """Write the lowest and highest x, y, z of a cloud to `box` (6,); return false if a number is NaN or infinite.

    Args:
        cloud: coordinates of the points, x y z x y z …, (3 · points,).
        size: number of points.
        box: filled with the lowest x, y, z and then the highest x, y, z.
    """
    real = cloud.dtype.type
    low0 = splat(real(np.inf))
    low1, low2 = low0, low0
    high0 = splat(real(-np.inf))
    high1, high2 = high0, high0
    zero = splat(real(0))
    nothing = zero  # stays 0 if all numbers are finite: 0·∞ and 0·NaN are NaN
    blocks = size // LANES
    for block in range(blocks):
        a = load(cloud, 48 * block)  # stored as x y z x …, so lane i of a, b, c is always the same axis
        b = load(cloud, 48 * block + 16)
        c = load(cloud, 48 * block + 32)
        low0, low1, low2 = least(a, low0), least(b, low1), least(c, low2)
        high0, high1, high2 = most(a, high0), most(b, high1), most(c, high2)
        nothing = fma(a, zero, nothing)
        nothing = fma(b, zero, nothing)
        nothing = fma(c, zero, nothing)
    for axis in range(3):
        box[axis] = np.inf
        box[3 + axis] = -np.inf
    bad = total(nothing)
    for i in range(16):
        for part in range(3):
            axis = (16 * part + i) % 3
            low = lane(low0, i) if part == 0 else lane(low1, i) if part == 1 else lane(low2, i)
            high = lane(high0, i) if part == 0 else lane(high1, i) if part == 1 else lane(high2, i)
            box[axis] = min(box[axis], low)
            box[3 + axis] = max(box[3 + axis], high)
    for i in range(48 * blocks, 3 * size):
        number = cloud[i]
        bad += number * real(0)
        box[i % 3] = min(box[i % 3], number)
        box[3 + i % 3] = max(box[3 + i % 3], number)
    return bad == 0


@inlined
@no_type_check
def cells_per_unit(size, grid, real):
    """Return the number of cells per unit of length, chosen so that the highest coordinate is in the last cell.

    If the extent is at most FLAT, the number is 0, and all points are in one cell.

    Args:
        size: extent of the points along the longest axis.
        grid: number of cells along an axis.
        real: type of the result.
    """
    return real(grid * 0.9999) / size if size > FLAT else real(0)


@compiled
@no_type_check
def histogram(cloud, box, bits, begin, end, key, count):
    """Write the cells of the points begin…end to `key`, and the number of these points in each cell to `count`.

    Args:
        cloud: coordinates of the points, x y z x y z …, (3 · points,).
        box: lowest and highest coordinates of the whole cloud.
        bits: the grid has 2^bits cells along each axis.
        begin: index of the first point, a multiple of 16.
        end: index after the last point.
        key: filled with the number of the cell of each point (see `curve`).
        count: filled with the number of points in each cell.
    """
    grid = np.int32(1 << bits)
    scale = cells_per_unit(max(box[3] - box[0], box[4] - box[1], box[5] - box[2]), grid, box.dtype.type)
    x0, y0, z0 = splat(box[0]), splat(box[1]), splat(box[2])
    scales, grids = splat(scale), splat(grid)
    last = begin + (end - begin) // LANES * LANES
    for i in range(begin, last, LANES):
        x, y, z = load_triples(cloud, 3 * i)
        x, y, z = whole((x - x0) * scales), whole((y - y0) * scales), whole((z - z0) * scales)
        store(key, i, (x * grids + y) * grids + z)
    for i in range(last, end):
        x = np.int32((cloud[3 * i] - box[0]) * scale)
        y = np.int32((cloud[3 * i + 1] - box[1]) * scale)
        z = np.int32((cloud[3 * i + 2] - box[2]) * scale)
        key[i] = (x * grid + y) * grid + z
    for cell in range(8**bits):
        count[cell] = 0
    for i in range(begin, end):
        count[take(key, i)] += 1


@compiled
@no_type_check
def places(count, bits, cells, crowded):
    """Compute at which position of the sorted points each thread stores its first point of each cell.

    Args:
        count: number of points that each thread counted in each cell, (threads, cells); replaced by the positions.
        bits: the grid has 2^bits cells along each axis.
        cells: table from `curve`, the cells of each grid in the order of the Hilbert curve.
        crowded: filled with begin and end of each cell with more than CROWD points.

    Returns:
        The number of cells with more than CROWD points.
    """
    start = (8**bits - 8) // 7
    place = np.int32(0)
    crowded_count = 0
    for i in range(8**bits):
        cell = take(cells, start + i)
        before = place
        for thread in range(count.shape[0]):
            points = count[thread, cell]
            count[thread, cell] = place
            place += points
        if place - before > CROWD:
            crowded[2 * crowded_count] = before
            crowded[2 * crowded_count + 1] = place
            crowded_count += 1
    return crowded_count


@compiled
@no_type_check
def scatter(cloud, size, begin, end, key, count, points, ids):
    """Write points begin…end as records x y z id to the positions of their cells; points of a cell keep their order.

    Args:
        cloud: coordinates of the points, x y z x y z …, (3 · points,).
        size: number of points of the cloud.
        begin: index of the first point.
        end: index after the last point.
        key: cell of each point.
        count: position of the next point of each cell; increased.
        points: filled with the records.
        ids: the memory of `points`, read as integers.
    """
    last = min(end, size - 1)
    for i in range(begin, last):
        cell = take(key, i)
        place = np.int64(count[cell])
        count[cell] = place + 1
        store(points, 4 * place, with_id(load4(cloud, 3 * i), i))  # reads one number beyond the point
    for i in range(last, end):
        place = np.int64(count[key[i]])
        for axis in range(3):
            points[4 * place + axis] = cloud[3 * i + axis]
        ids[4 * place + 3] = i


@compiled
@no_type_check
def sort_crowded(points, crowded, crowded_count, cells):
    """Sort the records of each cell with more than CROWD points again, with a grid of its own.

    Cells of this grid with more than CROWD points are sorted in the same way.

    Args:
        points: records x y z id, sorted in place.
        crowded: begin and end of each cell with more than CROWD points; used as a stack.
        crowded_count: number of these cells.
        cells: table from `curve`, the cells of each grid in the order of the Hilbert curve.
    """
    largest = 0
    for i in range(crowded_count):
        largest = max(largest, crowded[2 * i + 1] - crowded[2 * i])
    spare = np.empty(4 * largest, points.dtype)
    key = np.empty(largest, np.int32)
    count = np.empty(8 ** cell_bits(largest), np.int32)
    while crowded_count > 0:  # ranges do not overlap, so that `crowded` has room for all
        crowded_count -= 1
        begin, end = crowded[2 * crowded_count], crowded[2 * crowded_count + 1]
        low = load4(points, 4 * begin)
        high = low
        for i in range(begin + 1, end):
            record = load4(points, 4 * i)
            low, high = least(record, low), most(record, high)
        size = max(lane(high, 0) - lane(low, 0), lane(high, 1) - lane(low, 1), lane(high, 2) - lane(low, 2))
        if not size > FLAT:
            continue  # all at one position
        bits = cell_bits(end - begin)
        grid = np.int32(1 << bits)
        scale = cells_per_unit(size, grid, points.dtype.type)
        count[: 8**bits] = 0
        for i in range(begin, end):
            x = np.int32((take(points, 4 * i) - lane(low, 0)) * scale)
            y = np.int32((take(points, 4 * i + 1) - lane(low, 1)) * scale)
            z = np.int32((take(points, 4 * i + 2) - lane(low, 2)) * scale)
            key[i - begin] = (x * grid + y) * grid + z
            count[key[i - begin]] += 1
            store(spare, 4 * (i - begin), load4(points, 4 * i))
        start = (8**bits - 8) // 7
        place = begin
        for i in range(8**bits):
            cell = cells[start + i]
            number = count[cell]
            count[cell] = place
            if number > CROWD:
                crowded[2 * crowded_count] = place
                crowded[2 * crowded_count + 1] = place + number
                crowded_count += 1
            place += number
        for i in range(end - begin):
            cell = key[i]
            store(points, 4 * np.int64(count[cell]), load4(spare, 4 * i))
            count[cell] += 1


@compiled
@no_type_check
def box_leaves(packed, size, begin, end):
    """Turn the records x y z id of leaves begin…end into 16 x, 16 y, 16 z and 16 ids, and compute the leaves' boxes.

    If the last leaf of the cloud is among these leaves, it is first filled with copies of the last point.

    Args:
        packed: the packed cloud, whose `points` hold records; changed in place.
        size: number of points of the cloud.
        begin: index of the first leaf.
        end: index after the last leaf.
    """
    points, ids, box, low, _ = packed
    nodes = box.shape[0] // 6
    for i in range(size, min(16 * end, (size + 15) // 16 * 16)):
        for axis in range(3):
            points[4 * i + axis] = points[4 * size - 4 + axis]
        ids[4 * i + 3] = ids[4 * size - 1]
    for leaf in range(begin, end):
        at = 64 * leaf
        x, y, z, _ = load_quadruples(points, at)
        _, _, _, number = load_quadruples(ids, at)
        store(points, at, x)
        store(points, at + 16, y)
        store(points, at + 32, z)
        store(ids, at + 48, number)
        box[leaf], box[nodes + leaf], box[2 * nodes + leaf] = lowest(x), lowest(y), lowest(z)
        box[3 * nodes + leaf], box[4 * nodes + leaf] = highest(x), highest(y)
        box[5 * nodes + leaf] = highest(z)
        low[leaf] = lowest(number)


@compiled
@no_type_check
def box_nodes(packed, size):
    """Compute the boxes of all nodes above the leaves, and `levels`, of a packed cloud of `size` points."""
    _, _, box, low, levels = packed
    nodes = box.shape[0] // 6
    levels[0] = 0
    levels[8] = (size + 15) // 16
    top = 0
    while levels[8 + top] > LANES:
        begin, number = levels[top], levels[8 + top]
        above = (number + 15) // 16
        end = begin + 16 * above
        for i in range(begin + number, end):
            for side in range(6):
                box[side * nodes + i] = box[side * nodes + begin + number - 1]
            low[i] = low[begin + number - 1]
        for i in range(above):
            for side in range(3):
                box[side * nodes + end + i] = lowest(load(box, side * nodes + begin + 16 * i))
            for side in range(3, 6):
                box[side * nodes + end + i] = highest(load(box, side * nodes + begin + 16 * i))
            low[end + i] = lowest(load(low, begin + 16 * i))
        top += 1
        levels[top] = end
        levels[8 + top] = above
    levels[16] = top


@compiled
@no_type_check
def pack(cloud, size, box, cells, bench, packed):
    """Pack a cloud in one thread.

    Args:
        cloud: coordinates of the points, x y z x y z …, (3 · points,).
        size: number of points.
        box: lowest and highest coordinates, as computed by `extent`.
        cells: table from `curve`, the cells of each grid in the order of the Hilbert curve.
        bench: working memory.
        packed: filled with the packed cloud.
    """
    bits = cell_bits(size)
    count = bench.count[:1]
    histogram(cloud, box, bits, 0, size, bench.key, count[0])
    crowded_count = places(count, bits, cells, bench.crowded)
    scatter(cloud, size, 0, size, bench.key, count[0], packed.points, packed.ids)
    if crowded_count > 0:
        sort_crowded(packed.points, bench.crowded, crowded_count, cells)
    box_leaves(packed, size, 0, (size + 15) // 16)
    box_nodes(packed, size)
