"""Exact search for the nearest point of a packed cloud to each of many queries.

The queries are packed too (`pack`). Sixteen neighbouring queries, a leaf of the packed queries, walk through the
cloud's tree together. Each query has a smallest distance so far. A node is opened if the distance from its box to the
box of the sixteen queries is at most the largest of these sixteen distances. Then the boxes of its children are
compared with each query. If only a few of the sixteen queries need a child, each of these queries continues alone, and
is compared with sixteen boxes or points at a time. The first guesses are the nearest points of the previous sixteen
queries, or points found by `descend` in a large cloud.

No tolerance is needed. A box's squared distance is computed by the same operations as a point's, and each of these
rounds monotonically. So the rounded distance of a box is not larger than the rounded distance of any point in the box.

Of points at the same distance, the one with the lowest id is returned. If a query meets its smallest squared distance a
second time, at a point or a box, it searches all points at this distance (`lowest_id`).
"""

from typing import no_type_check

import numpy as np

from framework.geometry.lanes import (
    LANES,
    bits,
    first,
    fma,
    highest,
    how_many,
    lane,
    least,
    load,
    load_triples,
    lowest,
    mask,
    most,
    splat,
    store,
    take,
    where,
)
from framework.geometry.nearest.compiled import compiled, inlined

ALONE = 3
"""Largest number of queries, of the sixteen in a packet, that search a node one after the other.

If more of the sixteen queries need the node, they search it together. ALONE_IN_LEAF is the same number for leaves. Both
numbers were found by measurement.
"""
ALONE_IN_LEAF = 8
HIGH = 3
"""Smallest topmost level of a cloud's tree at which the first guess of a query comes from `descend`.

In a cloud with a lower tree, `descend` takes longer than it saves. There the first guesses of a packet are the nearest
points of the packet before.
"""


@inlined
@no_type_check
def squared_length(x, y, z):
    """Return x² + y² + z²."""
    return fma(z, z, fma(y, y, x * x))


@inlined
@no_type_check
def interval_distance(low, high, query_low, query_high, zero):
    """Return the distance between two intervals in each lane, 0 where they overlap.

    Args:
        low: lower ends of the first intervals.
        high: upper ends of the first intervals.
        query_low: lower ends of the second intervals.
        query_high: upper ends of the second intervals.
        zero: 0 in all lanes.
    """
    return most(zero, most(low - query_high, query_low - high))


@inlined
@no_type_check
def to_boxes(box, nodes, start, low, high, zero):
    """Return the squared distances of the boxes of 16 nodes from one box.

    Args:
        box: boxes of all nodes (`Packed.box`).
        nodes: number of all nodes.
        start: index of the first of the 16 nodes.
        low: lowest x, y, z of the one box, each in all lanes.
        high: highest x, y, z of the one box, each in all lanes.
        zero: 0 in all lanes.
    """
    return squared_length(
        interval_distance(load(box, start), load(box, 3 * nodes + start), low[0], high[0], zero),
        interval_distance(load(box, nodes + start), load(box, 4 * nodes + start), low[1], high[1], zero),
        interval_distance(load(box, 2 * nodes + start), load(box, 5 * nodes + start), low[2], high[2], zero),
    )


@inlined
@no_type_check
def to_box(box, nodes, node, query, zero):
    """Return the squared distances of the box of one node from 16 queries.

    Args:
        box: boxes of all nodes (`Packed.box`).
        nodes: number of all nodes.
        node: index of the node.
        query: vectors x, y, z of the 16 queries.
        zero: 0 in all lanes.
    """
    return squared_length(
        interval_distance(
            splat(take(box, node)), splat(take(box, 3 * nodes + node)), query[0], query[0], zero
        ),
        interval_distance(
            splat(take(box, nodes + node)), splat(take(box, 4 * nodes + node)), query[1], query[1], zero
        ),
        interval_distance(
            splat(take(box, 2 * nodes + node)), splat(take(box, 5 * nodes + node)), query[2], query[2], zero
        ),
    )


@inlined
@no_type_check
def to_point(points, at, query):
    """Return the squared distances of 16 queries from one point of a leaf.

    Args:
        points: the leaves (`Packed.points`).
        at: index in `points` of the x of the point.
        query: vectors x, y, z of the 16 queries.
    """
    return squared_length(
        splat(take(points, at)) - query[0],
        splat(take(points, at + 16)) - query[1],
        splat(take(points, at + 32)) - query[2],
    )


@inlined
@no_type_check
def to_leaf(points, leaf, x, y, z):
    """Return the squared distances of the 16 points of a leaf from one query x, y, z."""
    at = 64 * leaf
    return squared_length(load(points, at) - x, load(points, at + 16) - y, load(points, at + 32) - z)


@inlined
@no_type_check
def children(level, node, levels):
    """Return the index of the first child of a node, and an int64 with a bit set for each child that exists.

    Args:
        level: level of the children.
        node: index of the node within the level above.
        levels: first node and number of nodes of each level (`Packed.levels`).
    """
    return levels[level] + 16 * node, (1 << min(16, levels[8 + level] - 16 * node)) - 1


@inlined
@no_type_check
def nearest_bit(open_, gaps, at):
    """Return the index of the nearest child whose bit is set in `open_`, and its distance.

    Args:
        open_: int64 with a bit for each of 16 children.
        gaps: array with the 16 distances of the children, from index `at` on.
        at: index of the first distance.
    """
    gap = where(mask(open_), load(gaps, at), splat(gaps.dtype.type(np.inf)))
    nearest = lowest(gap)
    return first(bits(gap == splat(nearest)) & open_), nearest


@compiled
@no_type_check
def search_alone(packed, level, node, query, best, leaf, opened, gaps):
    """Search the nodes below one node for one query.

    Args:
        packed: the cloud.
        level: level of the node's children.
        node: index of the node within the level above.
        query: coordinates x, y, z of the query.
        best: smallest squared distance so far.
        leaf: leaf in which the point at this distance was found.
        opened: working memory for the children of each level that must still be searched.
        gaps: working memory for the distances of the children of each level.

    Returns:
        The smallest squared distance, its leaf, and true if another point may be at this distance.
    """
    points, _, box, _, levels = packed
    nodes = box.shape[0] // 6
    zero = splat(box.dtype.type(0))
    x, y, z = splat(query[0]), splat(query[1]), splat(query[2])
    top = level
    tie = False
    while True:
        if level < 0:
            distance = to_leaf(points, node, x, y, z)
            if bits(distance < splat(best)) != 0:
                best, leaf, tie = lowest(distance), node, False
            elif bits(distance == splat(best)) != 0 and leaf != node:
                tie = True
            level = 0
        else:
            start, valid = children(level, node, levels)
            gap = to_boxes(box, nodes, start, (x, y, z), (x, y, z), zero)
            store(gaps, 16 * level, gap)
            opened[2 * level] = bits(gap <= splat(best)) & valid
            opened[2 * level + 1] = 16 * node
        while True:
            if opened[2 * level] == 0:
                level += 1
                if level > top:
                    return best, leaf, tie
                continue
            child, gap = nearest_bit(opened[2 * level], gaps, 16 * level)
            if gap < best:
                opened[2 * level] &= ~(1 << child)
                node = opened[2 * level + 1] + child
                level -= 1
                break
            tie = tie or gap == best
            opened[2 * level] = 0


@compiled
@no_type_check
def lowest_id(packed, x, y, z, best, number):
    """Return the lowest id of the points whose squared distance is `best`, the smallest one.

    Args:
        packed: the cloud.
        x: x of the query.
        y: y of the query.
        z: z of the query.
        best: smallest squared distance.
        number: a known id at this distance; the result is not higher.
    """
    points, ids, box, low, levels = packed
    nodes = box.shape[0] // 6
    zero = splat(box.dtype.type(0))
    qx, qy, qz = splat(x), splat(y), splat(z)
    stack = np.empty((8 * LANES, 2), np.int64)  # a level pushes 16 at most, and pops one
    stack[0, 0], stack[0, 1] = levels[16], 0
    height = 1
    while height > 0:
        height -= 1
        level, node = stack[height, 0], stack[height, 1]
        if level < 0:
            open_bits = bits(to_leaf(points, node, qx, qy, qz) == splat(best))
            while open_bits != 0:
                number = min(number, np.int64(take(ids, 64 * node + 48 + first(open_bits))))
                open_bits &= open_bits - 1
            continue
        start, valid = children(level, node, levels)
        open_bits = bits(to_boxes(box, nodes, start, (qx, qy, qz), (qx, qy, qz), zero) <= splat(best)) & valid
        while open_bits != 0:
            child = first(open_bits)
            open_bits &= open_bits - 1
            if low[start + child] < number:
                stack[height, 0], stack[height, 1] = level - 1, 16 * node + child
                height += 1
    return number


@compiled
@no_type_check
def descend(packed, x, y, z):
    """Return the position of a point near a query, found by following the nearest box of each level.

    The position is 16 times the index of the leaf, plus the index of the point in the leaf.

    Args:
        packed: the cloud.
        x: x of the query.
        y: y of the query.
        z: z of the query.
    """
    points, _, box, _, levels = packed
    nodes = box.shape[0] // 6
    zero, infinite = splat(box.dtype.type(0)), splat(box.dtype.type(np.inf))
    qx, qy, qz = splat(x), splat(y), splat(z)
    node = np.int64(0)
    for level in range(levels[16], -1, -1):
        start, valid = children(level, node, levels)
        gap = to_boxes(box, nodes, start, (qx, qy, qz), (qx, qy, qz), zero)
        gap = where(mask(valid), gap, infinite)
        node = 16 * node + first(bits(gap == splat(lowest(gap))))
    distance = to_leaf(points, node, qx, qy, qz)
    return 16 * node + first(bits(distance == splat(lowest(distance))))


@inlined
@no_type_check
def open_node(box, nodes, start, valid, low, high, query, best, worst, near, at):
    """Return an int64 with a bit set for each child of a node that at least one of the sixteen queries must search.

    Args:
        box: boxes of all nodes (`Packed.box`).
        nodes: number of all nodes.
        start: index of the first child.
        valid: int64 with a bit set for each child that exists.
        low: lowest x, y, z of the sixteen queries.
        high: highest x, y, z of the sixteen queries.
        query: vectors x, y, z of the queries.
        best: smallest squared distance of each query so far.
        worst: largest of these distances.
        near: filled with the squared distances of the children from each query, from index `at` on.
        at: index in `near` of the first distance.
    """
    zero = splat(box.dtype.type(0))
    close = bits(to_boxes(box, nodes, start, low, high, zero) <= splat(worst)) & valid
    needed = 0
    while close != 0:
        child = first(close)
        close &= close - 1
        gap = to_box(box, nodes, start + child, query, zero)
        store(near, at + 16 * child, gap)
        needed |= np.int64(bits(gap <= best) != 0) << child
    return needed


@compiled
@no_type_check
def search(packed, packets, begin, end, distance, index):
    """Write distance and index of the nearest point for each query in the packets begin…end.

    Args:
        packed: the cloud.
        packets: packed queries; a packet holds sixteen neighbouring queries.
        begin: index of the first packet.
        end: index after the last packet.
        distance: filled with the distance for each query, at the id of the query.
        index: filled with the row of the nearest point for each query, at the id of the query.
    """
    points, ids, box, _, levels = packed
    real = box.dtype.type
    nodes = box.shape[0] // 6
    queries = packets.points
    sides = packets.box.shape[0] // 6
    zero, infinite, nothing = splat(real(0)), splat(real(np.inf)), splat(np.int32(0))
    bests, leaves = np.empty(16, box.dtype), np.empty(16, np.int32)
    # squared distances of a node's 16 children from 16 queries, at each level
    near = np.empty(8 * 256, box.dtype)
    opened, opened_alone = np.empty(16, np.int64), np.empty(16, np.int64)
    gaps = np.empty(8 * LANES, box.dtype)
    guess = np.zeros(16, np.int64)  # positions of the nearest points of the previous packet
    for packet in range(begin, end):
        packet_start = 64 * packet
        query = (
            load(queries, packet_start),
            load(queries, packet_start + 16),
            load(queries, packet_start + 32),
        )
        low = (
            splat(take(packets.box, packet)),
            splat(take(packets.box, sides + packet)),
            splat(take(packets.box, 2 * sides + packet)),
        )
        high = (
            splat(take(packets.box, 3 * sides + packet)),
            splat(take(packets.box, 4 * sides + packet)),
            splat(take(packets.box, 5 * sides + packet)),
        )
        best, leaf = infinite, nothing
        if levels[16] >= HIGH:
            for i in range(16):
                guess[i] = descend(
                    packed,
                    take(queries, packet_start + i),
                    take(queries, packet_start + i + 16),
                    take(queries, packet_start + i + 32),
                )
        for i in range(16):
            gap = to_point(points, (guess[i] >> 4) * 64 + (guess[i] & 15), query)
            leaf = where(gap < best, splat(np.int32(guess[i] >> 4)), leaf)
            best = least(gap, best)
        tie = best < zero  # False in every lane
        ties = 0
        worst = highest(best)
        level = top = levels[16]
        start, valid = children(level, 0, levels)
        opened[2 * level] = open_node(
            box, nodes, start, valid, low, high, query, best, worst, near, 256 * level
        )
        opened[2 * level + 1] = 0
        while True:
            if opened[2 * level] == 0:
                level += 1
                if level > top:
                    break
                continue
            child = first(opened[2 * level])
            opened[2 * level] &= opened[2 * level] - 1
            node = opened[2 * level + 1] + child
            gap = load(near, 256 * level + 16 * child)
            busy = bits(gap < best)
            tie = tie | (gap == best)
            if busy == 0:
                continue
            if level > 0:
                if how_many(busy) > ALONE:
                    level -= 1
                    start, valid = children(level, node, levels)
                    opened[2 * level] = open_node(
                        box, nodes, start, valid, low, high, query, best, worst, near, 256 * level
                    )
                    opened[2 * level + 1] = 16 * node
                    continue
                store(bests, 0, best)
                store(leaves, 0, leaf)
                while busy != 0:
                    i = first(busy)
                    busy &= busy - 1
                    lane_query = (
                        take(queries, packet_start + i),
                        take(queries, packet_start + i + 16),
                        take(queries, packet_start + i + 32),
                    )
                    bests[i], leaves[i], again = search_alone(
                        packed, level - 1, node, lane_query, bests[i], np.int64(leaves[i]), opened_alone, gaps
                    )
                    ties |= np.int64(again) << i
                best, leaf = load(bests, 0), load(leaves, 0)
            else:
                if how_many(busy) > ALONE_IN_LEAF:
                    gap = to_point(points, 64 * node, query)
                    for i in range(1, 16):
                        gap = least(to_point(points, 64 * node + i, query), gap)
                else:
                    gap = infinite
                    while busy != 0:
                        i = first(busy)
                        busy &= busy - 1
                        x, y, z = (
                            take(queries, packet_start + i),
                            take(queries, packet_start + i + 16),
                            take(queries, packet_start + i + 32),
                        )
                        leaf_distance = lowest(to_leaf(points, node, splat(x), splat(y), splat(z)))
                        gap = where(mask(np.int64(1) << i), splat(leaf_distance), gap)
                this = splat(np.int32(node))
                tie = tie | ((gap == best) & (leaf != this))
                leaf = where(gap < best, this, leaf)  # no branch, since it could not be predicted
                best = least(gap, best)
            worst = highest(best)
        ties |= bits(tie)
        store(bests, 0, best)
        store(leaves, 0, leaf)
        for i in range(16):
            node = np.int64(leaves[i])
            x, y, z = (
                take(queries, packet_start + i),
                take(queries, packet_start + i + 16),
                take(queries, packet_start + i + 32),
            )
            nearest_bits = bits(to_leaf(points, node, splat(x), splat(y), splat(z)) == splat(bests[i]))
            guess[i] = 16 * node + first(nearest_bits)
            number = np.int64(take(ids, 64 * node + 48 + first(nearest_bits)))
            if nearest_bits & (nearest_bits - 1) != 0 or (ties >> i) & 1 != 0:
                number = lowest_id(packed, x, y, z, bests[i], number)
            place = take(packets.ids, packet_start + 48 + i)
            distance[place] = np.sqrt(bests[i])
            index[place] = number


@compiled
@no_type_check
def search_all(cloud, size, packets, begin, end, distance, index):
    """Write the same results as `search`, by comparing every query with every point of a cloud that is not packed.

    This is faster for small clouds or few queries.

    Args:
        cloud: coordinates of the points, x y z x y z …, (3 · points,).
        size: number of points.
        packets: packed queries; a packet holds sixteen neighbouring queries.
        begin: index of the first packet.
        end: index after the last packet.
        distance: filled with the distance for each query, at the id of the query.
        index: filled with the row of the nearest point for each query, at the id of the query.
    """
    queries = packets.points
    blocks = (size + 15) // 16
    tail = np.empty(48, cloud.dtype)  # the last block, filled with its last point
    for i in range(16):
        for axis in range(3):
            tail[3 * i + axis] = cloud[3 * min(16 * (blocks - 1) + i, size - 1) + axis]
    for packet in range(begin, end):
        packet_start = 64 * packet
        x, y, z = (
            load(queries, packet_start),
            load(queries, packet_start + 16),
            load(queries, packet_start + 32),
        )
        best, leaf = splat(cloud.dtype.type(np.inf)), splat(np.int32(0))
        for block in range(blocks):
            from_, at = (cloud, 48 * block) if block < blocks - 1 else (tail, 0)
            gap = best
            for i in range(16):
                gap = least(
                    squared_length(
                        splat(take(from_, at + 3 * i)) - x,
                        splat(take(from_, at + 3 * i + 1)) - y,
                        splat(take(from_, at + 3 * i + 2)) - z,
                    ),
                    gap,
                )
            leaf = where(gap < best, splat(np.int32(block)), leaf)
            best = gap
        for i in range(16):
            block = np.int64(lane(leaf, i))
            from_, at = (cloud, 48 * block) if block < blocks - 1 else (tail, 0)
            a, b, c = load_triples(from_, at)
            qx, qy, qz = (
                take(queries, packet_start + i),
                take(queries, packet_start + i + 16),
                take(queries, packet_start + i + 32),
            )
            gap = squared_length(a - splat(qx), b - splat(qy), c - splat(qz))
            nearest = lowest(gap)
            place = take(packets.ids, packet_start + 48 + i)
            distance[place] = np.sqrt(nearest)
            index[place] = min(16 * block + first(bits(gap == splat(nearest))), size - 1)
