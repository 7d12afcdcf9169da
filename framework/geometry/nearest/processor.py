"""Nearest neighbours on the CPU: choice of the kernel for each cloud, and of the number of threads.

Queries are packed too (`pack`). A packet is a leaf of the packed queries, with sixteen neighbouring queries.
"""

from functools import lru_cache
from threading import local
from typing import NamedTuple, no_type_check

import numpy as np
import torch
from numpy.typing import NDArray

from framework.geometry.lanes import LANES
from framework.geometry.nearest.compiled import compiled, fetch_and_add
from framework.geometry.nearest.pack import (
    BITS,
    MODERATE,
    Bench,
    Packed,
    bench,
    box_leaves,
    box_nodes,
    cell_bits,
    curve,
    extent,
    histogram,
    pack,
    places,
    room,
    scatter,
    sort_crowded,
)
from framework.geometry.nearest.search import search, search_all
from framework.storage.threads import POOL

Array = NDArray[np.floating]
FINE, BAD_CLOUD, BAD_QUERIES, IMMODERATE = 0, 1, 2, 3
"""Outcomes of the search in a cloud.

FINE: the nearest points were found. BAD_CLOUD: a point is not finite. BAD_QUERIES: a query is not finite. IMMODERATE:
the coordinates are so large or so small that the cloud and its queries must be scaled before a search.
"""
QUERY_COUNT = 17
"""Index in `levels` of packed queries at which their number is stored."""
LARGE = 2**15
"""Number of points or queries from which several threads work on one cloud."""
TURNS = 16
"""Number of parts into which the work of each thread is divided, so that all threads end at about the same time."""
AT_ONCE = 2**24
"""Number of points and queries of one call of compiled code, which takes some tenths of a second.

Signals, such as an interruption by the user, are handled between two calls.
"""


class Problem(NamedTuple):
    """A batch of clouds and their queries, in the form that the kernels read.

    Attributes:
        clouds: coordinates of the points, (batch, 3 · points).
        sizes: number of points of each cloud, (batch,).
        queries: coordinates of the queries of each cloud, (batch, 3 · queries); empty if all clouds share `packets`.
        query_sizes: number of queries of each cloud, (batch,); empty if all clouds share `packets`.
        packets: packed queries that all clouds share.
        moderate: bounds of the largest coordinate (`pack.MODERATE`).
        largest: largest coordinate of shared queries.
        distance: filled with the distance of the nearest point to each query.
        index: filled with the row of this point in the cloud.
        outcome: filled with FINE, BAD_CLOUD, BAD_QUERIES or IMMODERATE for each cloud.
    """

    clouds: Array
    sizes: NDArray[np.int64]
    queries: Array
    query_sizes: NDArray[np.int64]
    packets: Packed
    moderate: tuple[float, float]
    largest: float
    distance: Array
    index: NDArray[np.int64]
    outcome: NDArray[np.int64]


@compiled
@no_type_check
def worth_packing(size, packets):
    """Return true if a cloud should be packed before the search, because this is faster in total.

    The numbers were measured: packing a cloud takes as long as comparing all its points with three packets. The search
    in a packed cloud for one packet takes as long as comparing this packet with a few hundred points.

    Args:
        size: number of points of the cloud.
        packets: number of packets of queries.
    """
    return packets > 3 and size * packets > 8192


@compiled
@no_type_check
def largest_of(box):
    """Return the largest magnitude among the six numbers of a box."""
    largest = abs(box[0])
    for i in range(1, 6):
        largest = max(largest, abs(box[i]))
    return largest


@compiled
@no_type_check
def search_clouds(problem, begin, end, cells, work, packed, own):
    """Search clouds begin…end of a batch, one after the other, and write distance, index and outcome of each.

    Args:
        problem: the batch of clouds and queries.
        begin: index of the first cloud.
        end: index after the last cloud.
        cells: table from `pack.curve`, the cells of each grid in the order of the Hilbert curve.
        work: working memory of packing.
        packed: memory for a packed cloud.
        own: memory for the packed queries of a cloud.
    """
    shared = problem.query_sizes.shape[0] == 0
    box = np.empty(6, problem.clouds.dtype)
    for i in range(begin, end):
        cloud, size = problem.clouds[i], problem.sizes[i]
        if not extent(cloud, size, box):
            problem.outcome[i] = BAD_CLOUD
            continue
        largest = np.float64(largest_of(box))
        packets, number = problem.packets, problem.packets.levels[8]
        if shared:
            largest = max(largest, problem.largest)
        else:
            query_size = problem.query_sizes[i]
            query_box = np.empty(6, problem.clouds.dtype)
            if not extent(problem.queries[i], query_size, query_box):
                problem.outcome[i] = BAD_QUERIES
                continue
            largest = max(largest, np.float64(largest_of(query_box)))
        if largest != 0 and not problem.moderate[0] <= largest <= problem.moderate[1]:
            problem.outcome[i] = IMMODERATE
            continue
        if not shared:
            pack(problem.queries[i], query_size, query_box, cells, work, own)
            packets, number = own, own.levels[8]
        if worth_packing(size, number):
            pack(cloud, size, box, cells, work, packed)
            search(packed, packets, 0, number, problem.distance[i], problem.index[i])
        else:
            search_all(cloud, size, packets, 0, number, problem.distance[i], problem.index[i])
        problem.outcome[i] = FINE


@compiled
@no_type_check
def search_clouds_share(problem, counter, step, limit, cells, work, packed, own):
    """Search a part of a batch in one thread, until it has searched `limit` clouds or no cloud is left.

    Args:
        problem: the batch of clouds and queries.
        counter: index of the next cloud, (1,) int64, which all threads share and increase.
        step: number of clouds that a thread takes at a time.
        limit: number of clouds after which this call ends.
        cells: table from `pack.curve`, the cells of each grid in the order of the Hilbert curve.
        work: working memory of packing.
        packed: memory for a packed cloud.
        own: memory for the packed queries of a cloud.
    """
    batch = problem.sizes.shape[0]
    searched = 0
    while searched < limit:
        begin = fetch_and_add(counter, step)
        if begin >= batch:
            return
        search_clouds(problem, begin, min(batch, begin + step), cells, work, packed, own)
        searched += step


@compiled
@no_type_check
def search_share(packed, packets, counter, step, distance, index):
    """Find the nearest points to a part of the packets in one thread, until no packet is left.

    Args:
        packed: the cloud.
        packets: packed queries; a packet holds sixteen neighbouring queries.
        counter: index of the next packet, (1,) int64, which all threads share and increase.
        step: number of packets that a thread takes at a time.
        distance: filled with the distance of the nearest point to each query, at the row of the query.
        index: filled with the row of this point in the cloud, at the row of the query.
    """
    number = packets.levels[8]
    while True:
        begin = fetch_and_add(counter, step)
        if begin >= number:
            return
        search(packed, packets, begin, min(number, begin + step), distance, index)


@compiled
@no_type_check
def search_all_share(cloud, size, packets, counter, step, distance, index):
    """Find the nearest points to a part of the packets in one thread, in a cloud that is not packed.

    `cloud` holds the coordinates of `size` points as x y z x y z …, (3 · points,). The other arguments are those of
    `search_share`.
    """
    number = packets.levels[8]
    while True:
        begin = fetch_and_add(counter, step)
        if begin >= number:
            return
        search_all(cloud, size, packets, begin, min(number, begin + step), distance, index)


@lru_cache(maxsize=BITS)
def curves(bits: int) -> NDArray[np.int32]:
    """Return the cells in the order of the Hilbert curve, the table of `pack.curve`; a cache keeps the table."""
    return curve(bits)


def packed_once(points: Array) -> Packed:
    """Pack queries (query, 3) that are used once, as fast as possible: the packets follow the Hilbert curve (`pack`).

    Queries with coordinates that are not finite or of extreme magnitude are packed by `packed_well`.
    """
    size, box = len(points), np.empty(6, points.dtype)
    low, high = MODERATE[points.itemsize]
    flat = points.reshape(-1)
    if not extent(flat, size, box) or not low <= float(largest_of(box)) <= high:
        return packed_well(points)
    packed = room(size, points.dtype)
    pack(flat, size, box, curves(cell_bits(size)), bench(size), packed)
    packed.levels[QUERY_COUNT] = size
    return packed


def packed_well(points: Array) -> Packed:
    """Pack queries (query, 3) that are used often: the packets come from repeated halving at the median.

    This takes longer than `packed_once`, but the boxes of the packets are smaller.
    """
    packets: list[NDArray[np.int64]] = []
    waiting = [np.arange(len(points))]
    while waiting:
        these = waiting.pop()
        if len(these) <= LANES:
            packets.append(np.concatenate([these, np.repeat(these[-1:], LANES - len(these))]))
            continue
        with np.errstate(over="ignore"):
            axis = int(np.ptp(points[these], axis=0).argmax())
        these = these[np.argsort(points[these, axis], kind="stable")]
        half = max(LANES, (len(these) // 2 + LANES // 2) // LANES * LANES)  # whole packets
        waiting += [these[half:], these[:half]]
    order = np.stack(packets)
    packed = room(order.size, points.dtype)
    blocks = packed.points.reshape(len(order), 4, LANES)
    blocks[:, :3] = points[order].swapaxes(1, 2)
    packed.ids.reshape(blocks.shape)[:, 3] = order
    box = packed.box.reshape(6, -1)
    box[:3, : len(order)] = blocks[:, :3].min(2).T
    box[3:, : len(order)] = blocks[:, :3].max(2).T
    packed.levels[8], packed.levels[QUERY_COUNT] = len(order), len(points)
    return packed


UNUSED = {dtype.itemsize: room(1, dtype) for dtype in (np.dtype(np.float32), np.dtype(np.float64))}


KEPT = 2**20
"""Largest number of points or queries for which working memory is kept between searches, 25 MB for each thread."""


class Desks(local):
    """Working memory of each thread, kept between searches, since its allocation takes long compared to a search."""

    def __init__(self) -> None:
        self.cached: dict[tuple[int, int, np.dtype, int], tuple[Bench, Packed, Packed]] = {}

    def of(
        self, points: int, queries: int, dtype: np.dtype, threads: int = 1
    ) -> tuple[Bench, Packed, Packed]:
        """Return working memory of packing, memory for a packed cloud, and memory for its packed queries.

        Args:
            points: largest number of points of a cloud.
            queries: largest number of queries of a cloud; 0 if all clouds share their queries.
            dtype: type of the coordinates.
            threads: number of threads that pack a cloud.
        """
        key = points, queries, dtype, threads
        if key in self.cached:
            return self.cached[key]
        own = room(queries, dtype) if queries else UNUSED[dtype.itemsize]
        memory = bench(max(points, queries), threads), room(points, dtype), own
        if max(points, queries) <= KEPT:
            self.cached = {key: memory}  # at most one entry
        return memory


DESKS = Desks()


class Results(NamedTuple):
    """Result of the search in a batch of clouds.

    Attributes:
        distance: distance from each query to the nearest point of its cloud, (batch, queries); NaN after the last
            query of a cloud, if the clouds have different numbers of queries.
        index: row of this point in the cloud, (batch, queries); 0 where `distance` is NaN.
        outcome: for each cloud, (batch,), FINE if it was searched; otherwise the reason why it was not: BAD_CLOUD (a
            point is not finite), BAD_QUERIES (a query is not finite) or IMMODERATE (coordinates are so large or so
            small that they must be scaled before a search). Distances and indices of this cloud are then undefined.
    """

    distance: Array
    index: NDArray[np.int64]
    outcome: NDArray[np.int64]


def search_batch(
    clouds: Array,
    sizes: NDArray[np.int64] | None,
    queries: Array | Packed,
    query_sizes: NDArray[np.int64] | None,
    largest: float,
) -> Results:
    """Return the nearest points of clouds for packed queries, which all clouds share, or for separate queries.

    Args:
        clouds: (batch, points, 3), contiguous.
        sizes: number of points of each cloud; None if all rows are points.
        queries: packed queries, or queries (batch, queries, 3), contiguous.
        query_sizes: number of queries of each cloud; None if all rows are queries.
        largest: largest coordinate of packed queries.
    """
    batch, points, _ = clouds.shape
    shared = isinstance(queries, Packed)
    query_count = int(queries.levels[QUERY_COUNT]) if isinstance(queries, Packed) else queries.shape[1]
    distance = np.empty((batch, query_count), clouds.dtype)
    index = np.empty((batch, query_count), np.int64)
    if query_sizes is not None:
        distance.fill(np.nan)
        index.fill(0)
    results = Results(distance, index, np.zeros(batch, np.int64))
    all_points, all_queries = np.empty(batch, np.int64), np.empty(0 if shared else batch, np.int64)
    all_points.fill(points)
    all_queries.fill(query_count)
    nothing = np.empty((0, 0), clouds.dtype)
    problem = Problem(
        clouds=clouds.reshape(batch, 3 * points),
        sizes=all_points if sizes is None else sizes,
        queries=nothing if isinstance(queries, Packed) else queries.reshape(batch, 3 * query_count),
        query_sizes=all_queries if query_sizes is None else query_sizes,
        packets=queries if isinstance(queries, Packed) else UNUSED[clouds.itemsize],
        moderate=MODERATE[clouds.itemsize],
        largest=largest,
        distance=results.distance,
        index=results.index,
        outcome=results.outcome,
    )
    threads = torch.get_num_threads()
    widest = max(points, 1 if shared else query_count)
    cells = curves(cell_bits(widest))
    if batch < threads and max(points, query_count) >= LARGE and shared:
        for i in range(batch):
            solve_one(problem, i, cells, threads)
        return results
    threads = (
        1 if points * query_count * batch < 2**20 else min(threads, batch)
    )  # starting a thread takes as long as the search of fewer pairs
    limit = max(1, AT_ONCE // (points + query_count))
    step = min(limit, max(1, batch // (TURNS * threads)))
    counter = np.zeros(1, np.int64)

    def share(_: int) -> None:
        own_memory = DESKS.of(points, 0 if shared else query_count, clouds.dtype)
        while counter[0] < batch:
            search_clouds_share(problem, counter, step, limit, cells, *own_memory)

    try:
        POOL.run(share, threads)
    finally:
        counter[0] = batch  # if this thread was interrupted, the others stop too
    return results


def solve_one(problem: Problem, i: int, cells: NDArray[np.int32], threads: int) -> None:
    """Search one cloud, which is large or has many queries, in several threads; one thread gives the same numbers.

    Args:
        problem: the batch, with packed queries; its distances, indices and outcome of cloud i are filled.
        i: index of the cloud in the batch.
        cells: table from `pack.curve`, the cells of each grid in the order of the Hilbert curve.
        threads: number of threads.
    """
    cloud, size = problem.clouds[i], int(problem.sizes[i])
    box = extent_together(cloud, size, threads)
    if box is None:
        problem.outcome[i] = BAD_CLOUD
        return
    largest = max(float(largest_of(box)), problem.largest)
    if largest != 0 and not problem.moderate[0] <= largest <= problem.moderate[1]:
        problem.outcome[i] = IMMODERATE
        return
    number = int(problem.packets.levels[8])
    packing = worth_packing(size, number)
    packed = None
    if packing:
        packers = max(1, min(threads, size // LARGE))
        work, packed, _ = DESKS.of(size, 0, cloud.dtype, packers)
        pack_together(cloud, size, box, cells, work, packed, packers)
    step = max(1, number // (TURNS * threads))
    counter = np.zeros(1, np.int64)

    def share(_: int) -> None:
        if packed is None:
            search_all_share(
                cloud, size, problem.packets, counter, step, problem.distance[i], problem.index[i]
            )
        else:
            search_share(packed, problem.packets, counter, step, problem.distance[i], problem.index[i])

    POOL.run(share, threads)
    problem.outcome[i] = FINE


def extent_together(cloud: Array, size: int, threads: int) -> Array | None:
    """Return the box that `pack.extent` computes, with several threads; None if a number is not finite.

    Args:
        cloud: coordinates of the points, x y z x y z …, (3 · points,).
        size: number of points.
        threads: number of threads.
    """
    threads = max(1, min(threads, size // LARGE))
    cuts = [size * thread // threads for thread in range(threads + 1)]
    boxes, finite = np.empty((threads, 6), cloud.dtype), [False] * threads

    def look(thread: int) -> None:
        begin, end = cuts[thread], cuts[thread + 1]
        finite[thread] = extent(cloud[3 * begin : 3 * end], end - begin, boxes[thread])

    POOL.run(look, threads)
    return np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)]) if all(finite) else None


def pack_together(
    cloud: Array, size: int, box: Array, cells: NDArray[np.int32], work: Bench, packed: Packed, threads: int
) -> None:
    """Pack a cloud in several threads; each thread counts, and then stores, its share of the points.

    Args:
        cloud: coordinates of the points, x y z x y z …, (3 · points,).
        size: number of points.
        box: lowest and highest coordinates, as computed by `extent`.
        cells: table from `pack.curve`, the cells of each grid in the order of the Hilbert curve.
        work: working memory for as many threads.
        packed: filled with the packed cloud.
        threads: number of threads.
    """
    bits = cell_bits(size)
    leaves = -(-size // LANES)
    cuts = [leaves * thread // threads for thread in range(threads + 1)]

    def shares(thread: int) -> tuple[int, int]:
        return LANES * cuts[thread], min(size, LANES * cuts[thread + 1])

    POOL.run(lambda t: histogram(cloud, box, bits, *shares(t), work.key, work.count[t]), threads)
    crowded_count = places(work.count, bits, cells, work.crowded)
    POOL.run(
        lambda t: scatter(cloud, size, *shares(t), work.key, work.count[t], packed.points, packed.ids),
        threads,
    )
    if crowded_count > 0:
        sort_crowded(packed.points, work.crowded, crowded_count, cells)
    POOL.run(lambda t: box_leaves(packed, size, cuts[t], cuts[t + 1]), threads)
    box_nodes(packed, size)
