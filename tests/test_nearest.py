"""Exact nearest neighbours and Chamfer distances, compared with brute force in float64."""

import math
import os
import re
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from framework.errors import DataError
from framework.geometry.nearest import Queries, chamfer, nearest, prepare
from framework.geometry.nearest.device import nearest_of
from framework.geometry.nearest.streamed import Middle, Reach, Stream, normalise_chunk

DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
EXACT = {torch.float32: 2.5e-7, torch.float64: 1e-15}
"""Tolerance by type, relative to the largest coordinate or distance."""
THREADS = torch.get_num_threads()


def in_torch(clouds, queries, sizes=None, query_sizes=None, pairs=20_000):
    queries = queries.points if isinstance(queries, Queries) else queries
    return nearest_of(clouds, queries, sizes, query_sizes, pairs)


WAYS = pytest.mark.parametrize("way", [nearest, in_torch], ids=["compiled", "torch"])


def ball(count, generator=None):
    generator = generator or np.random.default_rng(0)
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * generator.uniform(size=(count, 1)) ** (1 / 3)


def torus(count, generator):
    a, b = generator.uniform(0, 2 * np.pi, (2, count))
    return np.stack(
        [(1 + 0.3 * np.cos(b)) * np.cos(a), (1 + 0.3 * np.cos(b)) * np.sin(a), 0.3 * np.sin(b)], 1
    )


def lattice(count, _):
    side = math.ceil(count ** (1 / 3))
    return np.stack(np.meshgrid(*[np.linspace(-1, 1, side)] * 3), -1).reshape(-1, 3)[:count]


def clusters(count, generator):
    """Return points of ten nested clusters, each a hundred times smaller than the previous one."""
    scale = 100.0 ** -generator.integers(0, 10, count)
    return 0.5 + scale[:, None] * generator.normal(size=(count, 3))


KINDS = {
    "torus": torus,
    "ball": lambda n, g: ball(n, g),
    "lattice": lattice,
    "clusters": clusters,
    "one place": lambda n, g: np.full((n, 3), 0.3),
    "two places": lambda n, g: np.where(g.uniform(size=(n, 1)) < 0.5, 0.1, 0.2) * np.ones(3),
    "duplicates": lambda n, g: ball(20, g)[g.integers(0, 20, n)],
    "line": lambda n, g: g.uniform(-1, 1, (n, 1)) * np.array([1.0, 2.0, 0.0]),
    "plane": lambda n, g: torus(n, g) * np.array([1.0, 1.0, 0.0]),
    "far outlier": lambda n, g: np.concatenate([torus(n - 1, g), [[1e6, 0, 0]]]) if n > 1 else torus(1, g),
    "axis": lambda n, g: np.stack([np.sort(g.normal(size=n)), np.zeros(n), np.zeros(n)], 1),
    "rounded": lambda n, g: np.round(ball(n, g) * 8) / 8,
    "large offset": lambda n, g: torus(n, g) + 1e4,
}


def brute(cloud, queries):
    """Return the smallest distances in float64, computed from the unrounded coordinates."""
    cloud, queries = cloud.double().numpy(), queries.double().numpy()
    scale = max(np.abs(cloud).max(), np.abs(queries).max()) or 1.0
    found = [
        np.sqrt((((cloud / scale)[None] - part[:, None] / scale) ** 2).sum(-1).min(1)) * scale
        for part in np.array_split(queries, max(1, len(cloud) * len(queries) // 2**22))
    ]
    wanted = torch.tensor(np.concatenate(found))
    return wanted, max(scale, float(wanted.max()))


def check(cloud, queries, found, i=0):
    """Check distances and neighbours of one cloud; of equal points, the lowest index is returned."""
    dtype = cloud.dtype
    wanted, scale = brute(cloud, queries)
    assert found[0].dtype == dtype and found[1].dtype == torch.int64
    distance, index = found[0][i, : len(queries)], found[1][i, : len(queries)]
    allowed = (
        EXACT[dtype] * scale + torch.finfo(dtype).tiny * torch.finfo(dtype).eps
    )  # what the result is rounded to
    assert float((distance.double() - wanted).abs().max()) <= allowed
    chosen = ((cloud[index].double() / scale - queries.double() / scale) ** 2).sum(1).sqrt() * scale
    assert float((chosen - wanted).abs().max()) <= EXACT[dtype] * scale
    _, first, place = np.unique(cloud.numpy(), axis=0, return_index=True, return_inverse=True)
    assert np.array_equal(first[place.ravel()][index.numpy()], index.numpy())


@WAYS
@DTYPES
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("points, queries", [(1, 1), (7, 40), (300, 100), (3000, 150)])
def test_all_kinds_of_clouds_agree_with_comparing_all_points(kind, points, queries, dtype, way):
    generator = np.random.default_rng(points)
    cloud = torch.tensor(KINDS[kind](points, generator), dtype=dtype)
    asked = torch.tensor(ball(queries, generator), dtype=dtype)
    check(cloud, asked, way(cloud[None], asked))
    check(
        cloud, cloud[:queries], way(cloud[None], cloud[:queries].clone())
    )  # distance 0, and ties where points agree


@DTYPES
@pytest.mark.parametrize("kind", ["torus", "ball", "clusters", "far outlier", "lattice"])
def test_large_clouds_agree_with_scipys_tree(kind, dtype):
    cloud = torch.tensor(KINDS[kind](60_000, np.random.default_rng(1)), dtype=dtype)
    asked = torch.tensor(ball(500), dtype=dtype)
    found = nearest(cloud[None], asked)
    wanted, _ = cKDTree(cloud.double().numpy()).query(asked.double().numpy())
    scale = max(1.0, float(cloud.abs().max()))
    assert float((found.distance[0].double() - torch.tensor(wanted)).abs().max()) <= EXACT[dtype] * scale


@WAYS
@DTYPES
@pytest.mark.parametrize("exponent", [-300, -38, -30, -8, 8, 30, 38, 300])
def test_coordinates_of_every_magnitude(exponent, dtype, way):
    scale = 10.0**exponent
    if not torch.finfo(dtype).tiny < scale < torch.finfo(dtype).max / 4:
        scale = float(torch.finfo(dtype).tiny) if exponent < 0 else float(torch.finfo(dtype).max) / 8
    cloud = torch.tensor(torus(1000, np.random.default_rng(2)), dtype=torch.float64).mul(scale).to(dtype)
    asked = torch.tensor(ball(64), dtype=torch.float64).mul(scale).to(dtype)
    check(cloud, asked, way(cloud[None], asked))


def test_a_distance_that_no_number_holds_is_refused():
    cloud = torch.full((1, 3, 3), 3e38)
    with pytest.raises(DataError, match=r"Cloud 0 .* cannot hold the distance\. Use float64"):
        nearest(cloud, -cloud[0])


number = st.floats(-1, 1, width=32) | st.sampled_from([0.0, -0.0, 1e-40, 0.5, -0.5, 1e-20])


@settings(max_examples=150, deadline=None)
@given(
    cloud=st.integers(1, 400).flatmap(lambda n: arrays(np.float32, (n, 3), elements=number, fill=number)),
    queries=st.integers(1, 90).flatmap(lambda k: arrays(np.float32, (k, 3), elements=number, fill=number)),
    scale=st.sampled_from([1.0, 1e8, 1e-8, 2.0**70, 2.0**-60]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_any_cloud_agrees_with_comparing_all_points(cloud, queries, scale, dtype):
    cloud, queries = (torch.tensor(a * np.float32(scale)).to(dtype) for a in (cloud, queries))
    check(cloud, queries, nearest(cloud[None], queries))


@DTYPES
@pytest.mark.parametrize("kind", KINDS)
def test_search_finds_what_comparing_with_all_finds_to_the_bit(kind, dtype):
    from framework.geometry.nearest.pack import bench, cell_bits, curve, extent, pack, room
    from framework.geometry.nearest.processor import packed_well
    from framework.geometry.nearest.search import search, search_all

    generator = np.random.default_rng(3)
    queries = ball(700, generator).astype(str(dtype).removeprefix("torch."))
    cloud = KINDS[kind](4000, generator).astype(queries.dtype)
    packets, packed, box = packed_well(queries), room(len(cloud), cloud.dtype), np.empty(6, cloud.dtype)
    assert extent(cloud.ravel(), len(cloud), box)
    assert np.array_equal(box, np.concatenate([cloud.min(0), cloud.max(0)]))
    pack(cloud.ravel(), len(cloud), box, curve(cell_bits(len(cloud))), bench(len(cloud)), packed)
    found = []
    for compare in (partial(search, packed), partial(search_all, cloud.ravel(), len(cloud))):
        distance, index = np.empty(700, cloud.dtype), np.empty(700, np.int64)
        compare(packets, 0, int(packets.levels[8]), distance, index)
        found.append((distance, index))
    assert np.array_equal(found[0][0], found[1][0])
    assert np.array_equal(found[0][1], found[1][1])


@pytest.mark.parametrize("bits", [1, 2, 3, 4, 5, 6])
def test_the_curve_visits_every_cell_and_steps_to_neighbours(bits):
    from framework.geometry.nearest.pack import curve

    cells = curve(bits)[(8**bits - 8) // 7 :]
    assert np.array_equal(np.sort(cells), np.arange(8**bits))
    axes = np.stack([cells >> (2 * bits), (cells >> bits) & (2**bits - 1), cells & (2**bits - 1)], 1)
    assert (np.abs(np.diff(axes, axis=0)).sum(1) == 1).all()


@WAYS
@DTYPES
def test_clouds_and_queries_of_different_sizes(dtype, way):
    generator = np.random.default_rng(4)
    sizes, query_sizes = torch.tensor([1, 900, 40, 2000, 16]), torch.tensor([3, 200, 1, 17, 128])
    clouds = torch.full((5, 2000, 3), math.nan, dtype=dtype)
    queries = torch.full((5, 200, 3), math.nan, dtype=dtype)
    for i in range(5):
        clouds[i, : sizes[i]] = torch.tensor(torus(int(sizes[i]), generator), dtype=dtype)
        queries[i, : query_sizes[i]] = torch.tensor(ball(int(query_sizes[i]), generator), dtype=dtype)
    shared = torch.tensor(ball(100, generator), dtype=dtype)
    own, same = way(clouds, queries, sizes, query_sizes), way(clouds, prepare(shared), sizes)
    for i in range(5):
        check(clouds[i, : sizes[i]], queries[i, : query_sizes[i]], own, i)
        check(clouds[i, : sizes[i]], shared, same, i)
        assert own[0][i, query_sizes[i] :].isnan().all() and (own[1][i, query_sizes[i] :] == 0).all()
        assert not own[0][i, : query_sizes[i]].isnan().any()


@DTYPES
def test_columns_of_a_wider_table_and_gradients_are_left_alone(dtype):
    clouds = torch.tensor(ball(300), dtype=dtype).reshape(2, 75, 6).requires_grad_()
    found = nearest(clouds[..., :3], clouds[0, :9, 3:])
    assert not found.distance.requires_grad
    check(clouds.detach()[1, :, :3], clouds.detach()[0, :9, 3:], found, 1)


def test_threads_change_nothing():
    generator = np.random.default_rng(5)
    many = torch.tensor(np.stack([torus(3000, generator) for _ in range(20)]), dtype=torch.float32)
    large = torch.tensor(clusters(150_000, generator), dtype=torch.float32)[None]
    queries = prepare(torch.tensor(ball(600, generator), dtype=torch.float32))
    dense = prepare(torch.tensor(ball(33_000, generator), dtype=torch.float32))
    asked = [(many, queries), (large, queries), (many[:1], dense), (many[:1, :200], dense)]
    try:
        torch.set_num_threads(1)
        one = [nearest(*these) for these in asked]
        torch.set_num_threads(3)
        three = [nearest(*these) for these in asked]
    finally:
        torch.set_num_threads(THREADS)
    for a, b in zip(one, three, strict=True):
        assert torch.equal(a.distance, b.distance) and torch.equal(a.index, b.index)


@pytest.mark.parametrize("place", [0, 70_000, 149_999])
def test_a_bad_number_is_named_whichever_thread_reads_it(place):
    cloud = torch.rand(1, 150_000, 3)
    cloud[0, place, 2] = torch.nan
    try:
        torch.set_num_threads(3)
        with pytest.raises(DataError, match=rf"point {place} of entry 0"):
            nearest(cloud, torch.rand(1000, 3))
    finally:
        torch.set_num_threads(THREADS)


def test_after_a_fork_the_child_has_threads_of_its_own():
    code = """
import os, sys, torch
from framework.geometry.nearest import nearest
torch.set_num_threads(2)
clouds, queries = torch.rand(16, 2000, 3), torch.rand(300, 3)
here = nearest(clouds, queries)
child = os.fork()
if child == 0:
    there = nearest(clouds, queries)
    os._exit(0 if torch.equal(here.index, there.index) else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], timeout=120, check=False)
    assert done.returncode == 0


def test_numba_is_imported_when_first_needed_and_code_kept_in_the_cache():
    code = """
import sys, torch
from framework.geometry.nearest import nearest, prepare
queries = prepare(torch.rand(3, 3))
assert "numba" not in sys.modules
nearest(torch.rand(1, 5, 3), queries)
from pathlib import Path
from framework.storage.cache import folder
from framework.geometry.nearest.compiled import KEPT_IN
assert Path(KEPT_IN).is_relative_to(folder("numba"))
assert list(Path(KEPT_IN).glob("**/processor.search_clouds-*.nbi"))
from numba import config
assert not config.CACHE_DIR
"""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    subprocess.run([sys.executable, "-c", code], timeout=300, check=True, env=environment)


BAD = [
    ({"clouds": torch.full((2, 4, 3), math.nan)}, r"clouds: point 0 of entry 0 .* \[nan, nan, nan\]"),
    ({"clouds": torch.zeros(2, 4, 3).index_fill(1, torch.tensor(2), math.inf)}, "point 2 of entry 0"),
    ({"queries": torch.tensor([[0, 0, math.inf]])}, "queries: point 0"),
    ({"queries": torch.full((2, 3, 3), math.nan)}, "queries: point 0 of entry 0"),
    ({"clouds": torch.zeros(2, 0, 3)}, "hold no point"),
    ({"queries": torch.zeros(0, 3)}, "hold no point"),
    ({"clouds": torch.zeros(2, 4, 6)}, "first three columns"),
    ({"clouds": torch.zeros(2, 4, 3).half()}, r"float16; .* \.float\(\)"),
    ({"queries": torch.zeros(3, 3).double()}, "same type and device"),
    ({"queries": torch.zeros(3, 2, 3)}, "as many sets of queries as clouds"),
    (
        {"sizes": torch.tensor([0, 4])},
        "entry 0 has the size 0; expected one size for each entry, from 1 to 4",
    ),
    ({"sizes": torch.tensor([4, 5])}, "entry 1 has the size 5"),
    ({"sizes": torch.tensor([4])}, "there are 1 sizes"),
    ({"query_sizes": torch.tensor([1, 1])}, "Leave query_sizes out"),
]


@pytest.mark.parametrize("given_, message", BAD, ids=[message for _, message in BAD])
def test_what_cannot_be_asked_gets_a_sentence(given_, message):
    asked = {"clouds": torch.zeros(2, 4, 3), "queries": torch.zeros(3, 3)} | given_
    with pytest.raises(DataError, match=message):
        nearest(**asked)


def test_no_cloud_is_no_answer():
    found = nearest(torch.zeros(0, 4, 3), torch.zeros(5, 3))
    assert found.distance.shape == found.index.shape == (0, 5)


@DTYPES
def test_chamfer_is_the_formula(dtype):
    """Compare with eq. 6.6 in NumPy, with and without padding, and with finite differences."""
    generator = np.random.default_rng(6)
    a, b = torus(400, generator), ball(300, generator)
    square = ((a[:, None] - b) ** 2).sum(-1)
    wanted = square.min(1).mean() + square.min(0).mean()
    ta, tb = torch.tensor(a, dtype=dtype)[None], torch.tensor(b, dtype=dtype)[None]
    eps = 1e-6 if dtype == torch.float32 else 1e-14
    assert float(chamfer(ta, tb)[0]) == pytest.approx(wanted, rel=eps)
    padded = torch.cat([tb, torch.full((1, 50, 3), math.nan, dtype=dtype)], 1)
    assert float(chamfer(ta, padded, None, torch.tensor([300]))[0]) == pytest.approx(wanted, rel=eps)
    assert float(chamfer(ta, ta)[0]) == 0


def test_chamfer_has_gradients():
    generator = np.random.default_rng(7)
    a = torch.tensor(ball(9, generator))[None].requires_grad_()
    b = torch.cat([torch.tensor(ball(12, generator)), torch.full((2, 3), math.nan).double()])[None]
    sizes = torch.tensor([12])
    assert torch.autograd.gradcheck(lambda x: chamfer(x, b, None, sizes), (a,))
    left = b.clone().requires_grad_()
    chamfer(a.detach(), left, None, sizes).sum().backward()
    assert left.grad is not None and left.grad[:, :12].isfinite().all() and (left.grad[:, 12:] == 0).all()


LONG = np.longdouble
"""Squares of float64 numbers within its range."""


def by_loops(a, b):
    """Return eq. 6.6 in extended precision, and its derivatives with respect to both clouds."""
    a, b = a.astype(LONG), b.astype(LONG)
    slopes = [np.zeros_like(a), np.zeros_like(b)]
    total = LONG(0)
    for one, other, here, there in ((a, b, *slopes), (b, a, *slopes[::-1])):
        nearest_point = ((one[:, None] - other) ** 2).sum(-1).argmin(1)
        offset = one - other[nearest_point]
        total += (offset**2).sum(-1).mean()
        here += 2 * offset / len(one)
        np.add.at(there, nearest_point, -2 * offset / len(one))
    return total, slopes


@DTYPES
@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("share", [1.0, 1e-3])
@pytest.mark.parametrize(
    "exponent", [-310, -200, -160, -45, -40, -30, -23, -19, -15, 0, 15, 18, 19, 20, 30, 38, 150, 160, 300]
)
def test_chamfer_is_right_wherever_a_number_can_hold_it(exponent, share, padded, dtype):
    """An extreme pair beside an ordinary pair gets the right distance, or an error, but never infinity or 0."""
    limit = torch.finfo(dtype)
    if not limit.tiny * limit.eps < 10.0**exponent < limit.max / 10:
        return
    generator = np.random.default_rng(9)
    clouds = []
    for count, most in ((40, 60), (30, 35)):
        extreme = torch.tensor(ball(count, generator)).to(dtype) * 10.0**exponent
        extreme[: count // 2] *= share
        plain = torch.tensor(ball(most, generator)).to(dtype)
        whole = torch.full((2, most, 3), math.nan, dtype=dtype)
        whole[0], whole[1, :count] = plain, extreme
        clouds.append(whole if padded else extreme[None])
    sizes = [torch.tensor([60, 40]), torch.tensor([35, 30])] if padded else [None, None]
    wanted, slopes = by_loops(
        *(cloud[-1, :count].numpy() for cloud, count in zip(clouds, (40, 30), strict=True))
    )
    a, b = (cloud.clone().requires_grad_() for cloud in clouds)
    if not limit.tiny <= wanted <= limit.max / 1.01:
        try:
            found = float(chamfer(a, b, *sizes)[-1].detach())
        except DataError as error:
            side = "near each other .* smaller unit" if wanted < 1 else "far from each other .* larger unit"
            assert re.search(side, str(error)) and f"Clouds {len(clouds[0]) - 1} of" in str(error)
        else:  # with fewer digits
            assert 0 < found < limit.tiny * 1.01 and abs(found - wanted) <= 3 * limit.tiny * limit.eps
        return
    found = chamfer(a, b, *sizes)[-1]
    assert float(found.detach()) == pytest.approx(float(wanted), rel=20 * limit.eps)
    found.backward()
    for cloud, slope in ((a, slopes[0]), (b, slopes[1])):
        assert cloud.grad is not None and cloud.grad.isfinite().all()
        own = cloud.grad[-1, : len(slope)].numpy().astype(LONG)
        assert np.abs(own - slope).max() <= 20 * limit.eps * np.abs(slope).max() + limit.tiny * limit.eps
        assert (cloud.grad[-1, len(slope) :] == 0).all()


@DTYPES
def test_chamfer_of_equal_clouds_is_0_at_every_scale(dtype):
    for exponent in (-300, -40, -23, 0, 20, 37, 300):
        if torch.finfo(dtype).tiny < 10.0**exponent < torch.finfo(dtype).max:
            cloud = (torch.tensor(ball(20)).to(dtype) * 10.0**exponent)[None].requires_grad_()
            found = chamfer(cloud, cloud.flip(1))
            assert found.item() == 0
            found.backward()
            assert cloud.grad is not None and (cloud.grad == 0).all()


def test_chamfer_has_second_derivatives():
    generator = np.random.default_rng(7)
    a = torch.tensor(ball(5, generator))[None].requires_grad_()
    b = torch.tensor(ball(6, generator))[None].requires_grad_()
    sizes = torch.tensor([4]), torch.tensor([6])
    assert torch.autograd.gradgradcheck(lambda x, y: chamfer(x, y, *sizes), (a, b))


@DTYPES
@pytest.mark.parametrize("kind", ["torus", "rounded", "duplicates", "one place", "clusters"])
@pytest.mark.parametrize("size", [1, 97, 5000])
def test_a_stream_of_chunks_finds_what_one_pass_finds_to_the_bit(kind, size, dtype):
    generator = np.random.default_rng(8)
    count = 300 if size == 1 else 10_000
    cloud = torch.tensor(KINDS[kind](count, generator), dtype=dtype)
    cloud = torch.cat([cloud, torch.tensor(generator.uniform(size=(count, 2)), dtype=dtype)], 1)
    queries = torch.tensor(np.round(ball(200, generator) * 16) / 16, dtype=dtype)
    stream = Stream(queries)
    for chunk in [cloud[:0], *cloud.split(size)]:
        stream.add(chunk)
    found, wanted = stream.result(), nearest(cloud[None, :, :3], queries)
    assert torch.equal(found.distance, wanted.distance[0])
    assert torch.equal(found.index, wanted.index[0])
    assert torch.equal(found.point, cloud[found.index])


def test_points_whose_distances_round_to_the_same_root_are_told_apart_by_their_squares():
    shell = ball(2000)
    shell = torch.tensor(shell / np.linalg.norm(shell, axis=1, keepdims=True), dtype=torch.float32)
    query = torch.zeros(1, 3)
    distance = nearest(shell[:, None], query).distance[:, 0]
    pairs = torch.stack([shell, shell.roll(1, 0)], 1)[distance == distance.roll(1, 0)]
    pairs = pairs[nearest(pairs, query).index[:, 0] == 1]
    assert len(pairs) > 0
    for pair in pairs:
        stream = Stream(query)
        for point in pair:
            stream.add(point[None])
        assert stream.result().index.item() == 1


def test_two_readings_of_the_chunks_normalise_as_the_formula():
    """Compare with eq. 6.2 in float64 NumPy, for a cloud whose distance is a million times its size."""
    generator = np.random.default_rng(10)
    cloud = torus(3001, generator) + 1e6
    chunks = torch.tensor(cloud).split(100)
    middle = Middle()
    for chunk in chunks:
        middle.add(chunk)
    reach = Reach(middle.mean)
    for chunk in chunks:
        reach.add(chunk)
    local = (cloud - cloud[0]) - (cloud - cloud[0]).mean(0)
    assert reach.norm == pytest.approx(np.linalg.norm(local, axis=1).max(), rel=1e-9)
    found = torch.cat([normalise_chunk(chunk, middle.mean, reach.norm) for chunk in chunks])
    wanted = local / np.linalg.norm(local, axis=1).max()
    assert float((found - torch.tensor(wanted)).abs().max()) < 1e-9


@DTYPES
@pytest.mark.parametrize("columns", [3, 5])
@pytest.mark.parametrize("size", [1, 10, 100])
def test_one_buffer_may_bring_all_chunks(size, columns, dtype):
    """The buffer is filled again for each chunk, as by a reader of large files; queries and centre share a buffer,
    too."""
    generator = np.random.default_rng(11)
    cloud = torch.tensor(generator.normal(size=(100, columns)), dtype=dtype) + 3
    queries, centre = torch.tensor(ball(20, generator), dtype=dtype), torch.tensor([1.0, 2, 3]).double()

    def read(chunks, asked, centre):
        parts = Middle(), Reach(centre), Stream(asked)
        asked.mul_(0), centre.mul_(0)
        for chunk in chunks:
            for part in parts:
                part.add(chunk)
        middle, reach, stream = parts
        return [middle.mean, torch.tensor(reach.norm), *stream.result()]

    def filled_again():
        buffer = torch.empty(size, columns, dtype=dtype)
        for chunk in cloud.split(size):
            yield buffer.copy_(chunk)
        buffer.fill_(math.nan)

    again = read(filled_again(), queries.clone(), centre.clone())
    wanted = nearest(cloud[None, :, :3], queries)
    torch.testing.assert_close(again[0], cloud[:, :3].double().mean(0), rtol=1e-12, atol=0)
    assert float(again[1]) == pytest.approx(
        float((cloud[:, :3].double() - centre).norm(dim=1).max()), rel=1e-6
    )
    assert torch.equal(again[2], wanted.distance[0]) and torch.equal(again[3], wanted.index[0])
    assert torch.equal(again[4], cloud[wanted.index[0]])


def test_a_stream_refuses_what_is_empty_bad_or_other():
    stream = Stream(torch.zeros(2, 3))
    with pytest.raises(DataError, match="held no point"):
        stream.result()
    stream.add(torch.ones(3, 4))
    before = stream.result()
    with pytest.raises(DataError, match="chunk of 3 columns follows chunks of 4"):
        stream.add(torch.ones(3, 3))
    with pytest.raises(DataError, match="clouds: point 1"):
        stream.add(torch.tensor([[0.0, 0, 0, 1], [math.nan, 0, 0, 1]]))
    assert all(torch.equal(a, b) for a, b in zip(before, stream.result(), strict=True))
    with pytest.raises(DataError, match="Point 0 of a chunk of 1"):
        Middle().add(torch.full((1, 3), math.inf))
    assert Reach(torch.zeros(3)).norm == 1.0
