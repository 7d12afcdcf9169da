"""Compare the time of the exact search for nearest points with public libraries, on one core.

    python -m benchmarks.clouds.nearest [--stream | --floor]

Writes nearest.md into the folder of this file. The clouds are synthetic except for `scan`, which resamples the points
of a real scan with jitter (REAL_DATA_ROOT/clouds/demo_scan.ply; left out if that file is missing). Every method builds
its search structure for each cloud and returns distances and difference vectors. `--stream` reads 1e8 generated points
in chunks instead and writes nearest_stream.md. `--floor` measures only the last section of nearest.md, and replaces it.
"""

import argparse
import math
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

os.environ["OMP_NUM_THREADS"] = "1"  # before pykdtree is imported

import numpy as np
import pynanoflann  # pyright: ignore[reportMissingImports]
import torch
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree  # pyright: ignore[reportMissingImports]
from scipy.spatial import cKDTree  # type: ignore[reportAttributeAccessIssue]
from sklearn.neighbors import NearestNeighbors

from benchmarks.pages import machine, publish, replace_section
from benchmarks.timing import cores_used_by_others, first_calls, median_and_range, time_interleaved
from framework.geometry.nearest import Queries, nearest, prepare
from framework.geometry.nearest.processor import packed_once
from framework.geometry.nearest.streamed import Middle, Reach, Stream, normalise_chunk

Array = NDArray[np.floating]
ROWS = ((2048, 512, 24, 12), (10_000, 1000, 12, 8), (100_000, 1000, 3, 5), (1_000_000, 4096, 3, 2))
"""Sizes of the comparison: points, basis points, clouds, rounds."""
TARGETS = {2048: (15, 3.5), 10_000: (10, 2.5), 100_000: (18, 4), 1_000_000: (18, 5)}
"""Required speed-up over the ball tree, and over the fastest other method, by the number of points."""
THREAD_SIZES = (
    (64, 2048, 512),
    (16, 10_000, 1000),
    (8, 100_000, 1000),
    (1, 1_000_000, 4096),
    (1, 10_000, 32_768),
)
"""Sizes of the comparison of one and two threads: clouds, points, basis points."""
FLOOR_SIZES = ((100_000, 1000, 8, 0.8), (1_000_000, 4096, 1, 8.0))
"""Sizes of the comparison with reading the points: points, basis points, clouds of two threads, wanted milliseconds."""
FLOOR_HEADING = "## Search and reading of the points"
ONE_PER_CALL = "ours, one cloud per call"
FIRST_CALL = """
import time, torch
from framework.geometry.nearest import nearest
clouds, queries = torch.rand(1, 5000, 3), torch.rand(500, 3)
wall, cpu = time.perf_counter(), time.process_time()
nearest(clouds, queries)
print(time.process_time() - cpu)
"""


def ball(count: int, generator: np.random.Generator) -> Array:
    """Return points that are uniform in the unit ball (eq. 6.3)."""
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return (direction * generator.uniform(size=(count, 1)) ** (1 / 3)).astype(np.float32)


def torus(count: int, generator: np.random.Generator) -> Array:
    """Return points on the surface of a torus."""
    a, b = generator.uniform(0, 2 * math.pi, (2, count))
    radius = 1 + 0.35 * np.cos(b)
    return np.stack([radius * np.cos(a), radius * np.sin(a), 0.35 * np.sin(b)], 1)


def chair(count: int, generator: np.random.Generator) -> Array:
    """Return points on the surfaces of a seat, a back and four legs."""
    boxes = [((-0.5, -0.5, 0.45), (0.5, 0.5, 0.55)), ((-0.5, 0.4, 0.55), (0.5, 0.5, 1.3))]
    boxes += [((x, y, 0.0), (x + 0.1, y + 0.1, 0.45)) for x in (-0.5, 0.4) for y in (-0.5, 0.4)]
    low, high = (np.array(sides) for sides in zip(*boxes, strict=True))
    size = high - low
    areas = np.stack([size[:, (axis + 1) % 3] * size[:, (axis + 2) % 3] for axis in range(3)], 1)
    box, axis = np.divmod(generator.choice(areas.size, count, p=areas.ravel() / areas.sum()), 3)
    inside = generator.uniform(size=(count, 3))
    inside[np.arange(count), axis] = generator.integers(0, 2, count)
    return low[box] + inside * size[box]


def samplers() -> dict[str, Callable[[int, np.random.Generator], Array]]:
    """Return the function that samples points of each shape, by name."""
    functions: dict[str, Callable[[int, np.random.Generator], Array]] = {"torus": torus, "chair": chair}
    path = Path(os.environ.get("REAL_DATA_ROOT", "")) / "clouds" / "demo_scan.ply"
    if path.is_file():
        import trimesh

        points = np.asarray(trimesh.load(path).vertices)  # type: ignore[reportAttributeAccessIssue]
        spacing = median(cKDTree(points).query(points, 2)[0][:, 1])

        def scan(count: int, generator: np.random.Generator) -> Array:
            return points[generator.integers(0, len(points), count)] + generator.normal(
                scale=spacing, size=(count, 3)
            )

        functions["scan"] = scan
    return functions


def clouds(points: int, count: int) -> list[Array]:
    """Return clouds in the unit ball (eq. 6.2), whose shapes are those of `samplers` in turn.

    All clouds differ, so that the processor cannot learn the branches of one cloud.
    """
    functions = list(samplers().values())
    normalised = []
    for i in range(count):
        cloud = functions[i % len(functions)](points, np.random.default_rng(i))
        cloud = cloud - cloud.mean(0)
        normalised.append((cloud / np.linalg.norm(cloud, axis=1).max()).astype(np.float32))
    return normalised


# Each of the following methods gets a cloud (n, 3) and basis points (k, 3), and returns distances (k,) and difference
# vectors (k, 3).
def ball_tree(cloud: Array, basis: Array) -> tuple[Array, Array]:
    """Search by the ball tree of the paper's package, re-created from its description."""
    tree = NearestNeighbors(n_neighbors=1, leaf_size=1, algorithm="ball_tree").fit(cloud)
    distance, index = tree.kneighbors(basis)
    return distance[:, 0], cloud[index[:, 0]] - basis


def sklearn_kd(cloud: Array, basis: Array) -> tuple[Array, Array]:
    distance, index = NearestNeighbors(n_neighbors=1, algorithm="kd_tree").fit(cloud).kneighbors(basis)
    return distance[:, 0], cloud[index[:, 0]] - basis


def scipy_kd(cloud: Array, basis: Array) -> tuple[Array, Array]:
    tree = cKDTree(cloud, balanced_tree=False, compact_nodes=False)  # the faster settings
    distance, index = tree.query(basis)
    return distance, cloud[index] - basis


def pykdtree(cloud: Array, basis: Array) -> tuple[Array, Array]:
    distance, index = KDTree(cloud).query(basis)
    return distance, cloud[index] - basis


def nanoflann(cloud: Array, basis: Array) -> tuple[Array, Array]:
    tree = pynanoflann.KDTree(n_neighbors=1, metric="L2", leaf_size=10)
    tree.fit(cloud)
    distance, index = tree.kneighbors(basis)
    return distance[:, 0], cloud[index[:, 0]] - basis


LIBRARIES = (ball_tree, sklearn_kd, scipy_kd, pykdtree, nanoflann)


def ours(batch: torch.Tensor, queries: Queries) -> tuple[torch.Tensor, torch.Tensor]:
    distance, index = nearest(batch, queries)
    return distance, batch.gather(1, index[..., None].expand(-1, -1, 3)) - queries.points


def time_on_one_core(
    points: int, basis_points: int, count: int, rounds: int
) -> dict[str, tuple[float, float]]:
    """Return for each method the least milliseconds per cloud over the rounds, and the largest error of a distance."""
    basis = ball(basis_points, np.random.default_rng(99))
    queries = prepare(torch.from_numpy(basis))
    arrays = clouds(points, count)
    batches = [torch.from_numpy(cloud)[None] for cloud in arrays]
    together = torch.cat(batches)
    exact = [cKDTree(cloud.astype(float)).query(basis.astype(float))[0] for cloud in arrays]

    def run(method: Callable[[Array, Array], tuple[Array, Array]]) -> list[Array]:
        return [method(cloud, basis)[0] for cloud in arrays]

    work: dict[str, Callable[[], list[Array]]] = {
        "ours": lambda: list(ours(together, queries)[0].numpy()),
        ONE_PER_CALL: lambda: [ours(batch, queries)[0][0].numpy() for batch in batches],
    }
    work |= {method.__name__: lambda method=method: run(method) for method in LIBRARIES}
    least = dict.fromkeys(work, math.inf)
    errors = dict.fromkeys(work, 0.0)
    for turn in range(
        rounds + 1
    ):  # interleaved, so that other load affects all methods; the first round warms up
        for name, call in work.items():
            start = time.process_time()
            distances = call()
            spent = time.process_time() - start
            if turn == 0:
                errors[name] = max(float(abs(a - b).max()) for a, b in zip(distances, exact, strict=True))
            else:
                least[name] = min(least[name], 1e3 * spent / count)
    return {name: (least[name], errors[name]) for name in work}


def time_hard_clouds(points: int = 100_000, basis_points: int = 1000) -> str:
    """Return a table of the times of our search and of pykdtree for clouds that are difficult for grids and trees."""
    generator = np.random.default_rng(7)
    plain = torus(points, generator)
    nested = 100.0 ** -generator.integers(0, 10, points)[:, None] * generator.normal(size=(points, 3))
    side = round(points ** (1 / 3))
    kinds = {
        "torus": plain,
        "uniform in the unit ball": ball(points, generator),
        "torus with one outlier, 1e6 times as far away": np.concatenate([plain[1:], [[1e6, 0, 0]]]),
        "ten nested clusters, each 100 times smaller than the one before": nested,
        "20 different points, each repeated many times": ball(20, generator)[
            generator.integers(0, 20, points)
        ],
        "all points equal": np.full((points, 3), 0.25),
        "regular lattice, with many equal distances": np.stack(
            np.meshgrid(*[np.linspace(-1, 1, side)] * 3), -1
        ).reshape(-1, 3),
        "unit sphere around all basis points": plain / np.linalg.norm(plain, axis=1, keepdims=True),
    }
    basis = ball(basis_points, generator)
    queries = prepare(torch.from_numpy(basis))
    lines = ["| cloud | ours, ms | pykdtree, ms | largest error of ours |", "|---|---|---|---|"]
    for name, kind in kinds.items():
        cloud = (kind / np.linalg.norm(kind, axis=1).max()).astype(np.float32)
        batch = torch.from_numpy(cloud)[None]
        spent = [math.inf, math.inf]
        for turn in range(8):
            start = time.process_time()
            if turn % 2:
                pykdtree(cloud, basis)
            else:
                ours(batch, queries)
            spent[turn % 2] = min(spent[turn % 2], 1e3 * (time.process_time() - start))
        exact = cKDTree(cloud.astype(float)).query(basis.astype(float))[0]
        error = float(abs(ours(batch, queries)[0][0].numpy() - exact).max())
        lines.append(f"| {name} | {spent[0]:.2f} | {spent[1]:.2f} | {error:.0e} |")
    return "\n".join(lines)


def speedup_of_two_threads(
    points: int, basis_points: int, count: int, seconds: float = 12.0
) -> tuple[float, float]:
    """Return the speed-up of two threads over one in wall time, and 2 t₁ / t₂ for the processor times t.

    Both use the least time of interleaved calls. The second is the speed-up on two cores without other load, if both
    threads are busy to the end.
    """
    queries = prepare(torch.from_numpy(ball(basis_points, np.random.default_rng(99))))
    batch = torch.from_numpy(np.stack(clouds(points, count)))
    wall, processor = {1: math.inf, 2: math.inf}, {1: math.inf, 2: math.inf}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        for threads in wall:
            torch.set_num_threads(threads)
            start, spent = time.perf_counter(), time.process_time()
            nearest(batch, queries)
            wall[threads] = min(wall[threads], time.perf_counter() - start)
            processor[threads] = min(processor[threads], time.process_time() - spent)
    torch.set_num_threads(1)
    return wall[1] / wall[2], 2 * processor[1] / processor[2]


def floor_section() -> str:
    """Measure the search beside a sum of all coordinates, and return the text of the section."""
    torch.set_num_threads(1)
    loads, lines = [cores_used_by_others()], []
    for points, basis_points, count, wanted in FLOOR_SIZES:
        queries = prepare(torch.from_numpy(ball(basis_points, np.random.default_rng(99))))
        batch = torch.from_numpy(np.stack(clouds(points, 3)))
        times = time_interleaved(
            {
                "search": lambda batch=batch, queries=queries: ours(batch, queries),
                "sort": lambda batch=batch: [packed_once(cloud.numpy()) for cloud in batch],
                "read": batch.sum,
            }
        )
        search, sort, read = ([ms / len(batch) for ms in times[name].milliseconds] for name in times)
        wall, processor = speedup_of_two_threads(points, basis_points, count, seconds=6.0)
        cells = (
            median_and_range(search),
            f"{wanted:g}",
            median_and_range(sort),
            median_and_range(read),
            f"{processor:.2f} ({wall:.2f})",
        )
        lines.append(f"| {points:,} | {basis_points:,} | {' | '.join(cells)} |")
    loads.append(cores_used_by_others())
    return "\n".join(
        [
            "No search can be faster than reading all points once, and this search also sorts them: it packs a cloud "
            "into groups of 16 points along a space-filling curve, and then compares the basis points with the boxes "
            "of these groups. This table compares the whole search with the packing alone (`packed_once`) and with a "
            "sum of all coordinates, which only reads them (`torch.Tensor.sum`), in the same run. Times are processor "
            "milliseconds per cloud on one core: the median of 5 interleaved rounds (least to largest), with three "
            "clouds in a call. The last column is the speed-up of two threads over one, as in the section "
            "`Two threads`: by processor time, and in brackets by wall time. The numbers called *wanted* are the aims "
            "for the search.",
            "",
            "| points | basis points | search, ms | wanted, ms | packing alone, ms | reading alone, ms | two threads "
            "(wanted: 1.9) |",
            "|---:|---:|---:|---:|---:|---:|---:|",
            *lines,
            "",
            f"Other processes used {loads[0]:.1f} cores before and {loads[1]:.1f} cores after the measurement. Such "
            "work lengthens processor times, and makes the speed-up by wall time meaningless.",
            "",
            f"{machine('numba', 'torch')} Command: `python -m benchmarks.clouds.nearest --floor`.",
        ]
    )


def report() -> str:
    """Measure everything but the stream, and return the page."""
    torch.set_num_threads(1)
    names = ["ours", ONE_PER_CALL, *(method.__name__ for method in LIBRARIES)]
    heads = [
        "points n",
        "basis points k",
        *names,
        "speed-up over ball_tree",
        "speed-up over the fastest library",
    ]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    errors = dict.fromkeys(names, 0.0)
    for points, basis_points, count, rounds in ROWS:
        results = time_on_one_core(points, basis_points, count, rounds)
        for name in names:
            errors[name] = max(errors[name], results[name][1])
        cells = [f"{results[name][0]:.3f}" for name in names]
        best = min(results[method.__name__][0] for method in LIBRARIES)
        alone = results[ONE_PER_CALL][0]
        ratios = []
        for library, target in zip((results["ball_tree"][0], best), TARGETS[points], strict=True):
            ratios.append(f"**{library / results['ours'][0]:.1f}** ({library / alone:.1f}; ≥ {target})")
        lines.append(f"| {points:,} | {basis_points:,} | {' | '.join(cells)} | {' | '.join(ratios)} |")
    hard = time_hard_clouds()
    scaling = [
        (count, points, basis_points, *speedup_of_two_threads(points, basis_points, count))
        for count, points, basis_points in THREAD_SIZES
    ]
    load = os.getloadavg()[0]
    cold, warm = first_calls(FIRST_CALL, FRAMEWORK_CACHE="{}", NUMBA_CACHE_DIR="")
    return "\n".join(
        [
            "# Nearest points of a cloud to each basis point: milliseconds per cloud on one core",
            "",
            "Basis points are a fixed set of points. A point cloud is encoded by the distance from each basis point "
            "to the nearest point of the cloud. This page "
            "compares the run time of the project's exact search (`ours`) with five exact searches of public "
            "libraries. It is written by `python -m benchmarks.clouds.nearest`.",
            "",
            "The methods search the nearest points in clouds of n points in float32. The clouds have these "
            f"shapes: {', '.join(samplers())}. The clouds of `scan` are points of a real scan, resampled with "
            "jitter; the other shapes are synthetic. The k basis points are uniform in the unit ball. A measured "
            "call builds the search structure of a cloud and computes the k distances and the k difference "
            "vectors.",
            "",
            "The table gives the processor time, in milliseconds per cloud, to find the nearest point of the cloud "
            "to each basis point on one core. Each number is the shortest time of several rounds; every round calls "
            f"all methods one after the other. `ours` gets all clouds in one call. `{ONE_PER_CALL}` and the libraries "
            "get one cloud per call. `ball_tree` and `sklearn_kd` are the two trees of scikit-learn, and `scipy_kd` "
            "is the tree of SciPy. The last two columns give the speed-up of `ours` over a library: the time of the "
            "library divided by the time of `ours`. The first number in brackets is the speed-up of "
            f"`{ONE_PER_CALL}`, and the second is the speed-up that this project requires.",
            "",
            *lines,
            "",
            "The distance from each basis point to its nearest point was compared between each method and SciPy in "
            "float64. The largest absolute differences, for clouds in the unit ball, are: "
            + ", ".join(f"`{name}` {error:.0e}" for name, error in errors.items())
            + ".",
            "",
            "## Clouds that are difficult for grids and trees",
            "",
            "The table compares the search of this project (`ours`) with the library pykdtree on clouds that are "
            "difficult for search structures. Each cloud has 100,000 points, and there are 1,000 basis points. The "
            "time is the shortest processor time of four calls. The table also gives the largest absolute difference "
            "between a distance that `ours` computes and the distance that SciPy computes in float64.",
            "",
            hard,
            "",
            "## Two threads",
            "",
            "This table gives the speed-up of the project's search for nearest points with two threads over one "
            "thread; the project requires at least 1.8. The speed-up by processor time is 2 t₁ / t₂, where t₁ and t₂ "
            "are the least processor times with one and with two threads. The speed-up by wall time is meaningful "
            f"only if no other process uses the two cores. The load average of the machine was {load:.1f}; this "
            "benchmark alone causes a load of about 1.5.",
            "",
            "| clouds | points | basis points | speed-up by wall time | speed-up by processor time |",
            "|---:|---:|---:|---:|---:|",
            *(
                f"| {count} | {points:,} | {basis_points:,} | {wall:.2f} | **{processor:.2f}** |"
                for count, points, basis_points, wall, processor in scaling
            ),
            "",
            "## First call",
            "",
            "The first search for nearest points in a process also compiles the code of the search, once for float32 "
            f"and once for float64. This first call takes {cold:.1f} s of processor time if everything is compiled, "
            f"and {warm:.2f} s if the machine code is read from the cache.",
            "",
            machine("numba", "torch", "scipy", "scikit-learn", "pykdtree", "pynanoflann"),
            "",
            FLOOR_HEADING,
            "",
            floor_section(),
            "",
        ]
    )


def streaming(total: int = 10**8, size: int = 10**6, basis_points: int = 1000) -> str:
    """Read a generated cloud three times in chunks, for mean, largest norm and nearest points; return the page."""
    torch.set_num_threads(1)
    basis = prepare(torch.from_numpy(ball(basis_points, np.random.default_rng(99))))

    def chunk(number: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(number)
        a, b = 2 * math.pi * torch.rand(2, size, generator=generator)
        radius = 5 + 1.7 * torch.cos(b)
        return torch.stack([radius * torch.cos(a) + 100, radius * torch.sin(a), 1.7 * torch.sin(b)], 1)

    nearest(chunk(0)[None], basis)  # compiles the search before it is timed
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    middle = Middle()
    seconds_by_step = {"generating": 0.0, "mean": 0.0, "largest norm": 0.0, "nearest": 0.0}

    def read(name: str, use: Callable[[torch.Tensor], None]) -> None:
        for number in range(total // size):
            start = time.process_time()
            points = chunk(number)
            between = time.process_time()
            use(points)
            seconds_by_step["generating"] += between - start
            seconds_by_step[name] += time.process_time() - between

    read("mean", middle.add)
    reach = Reach(middle.mean)
    read("largest norm", reach.add)
    stream = Stream(basis)
    read("nearest", lambda points: stream.add(normalise_chunk(points, middle.mean, reach.norm)))
    result = stream.result()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = seconds_by_step
    return (
        f"# A cloud of {total:,} points in chunks of {size:,}\n\n"
        "This page shows how much time and memory the search for nearest points takes if the cloud is read in chunks "
        "and never held in memory as a whole. It is written by `python -m benchmarks.clouds.nearest --stream`. The "
        "points of a synthetic torus are generated chunk by chunk and read three times on one core. The first pass "
        "computes the mean of the points. The second pass computes the largest distance of a point from the mean, "
        f"which is called the largest norm. The third pass finds, for each of {basis_points:,} basis points, the "
        "nearest point of the cloud.\n\n"
        "The search for the nearest points reads the cloud in three passes. The first pass takes "
        f"{seconds['mean']:.1f} s of processor time, the second {seconds['largest norm']:.1f} s and the third "
        f"{seconds['nearest']:.1f} s. These times do not include the generation of the points, which takes "
        f"{seconds['generating']:.1f} s for the three passes together. The peak memory was {peak / 2**10:.0f} MiB; "
        f"{base / 2**10:.0f} MiB of it were in use before the first chunk was read (libraries and one chunk). All "
        f"points together would take {12 * total / 2**20:.0f} MiB.\n\n"
        "Before the third pass, which finds the nearest point to each basis point, the cloud was normalised with the "
        "mean of its points and the largest norm. The mean of the points is "
        f"{[round(x, 4) for x in middle.mean.tolist()]}, the largest norm is {reach.norm:.4f}, and the mean distance "
        f"from a basis point to its nearest point is {float(result.distance.mean()):.6f}.\n\n"
        f"{machine('numba', 'torch')}\n"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--stream", action="store_true", help="read 1e8 points in chunks instead; takes some minutes"
    )
    parser.add_argument("--floor", action="store_true", help="measure only the last section of the page")
    options = parser.parse_args()
    if options.floor:
        replace_section(Path(__file__).with_suffix(".md"), FLOOR_HEADING, floor_section())
    elif options.stream:
        publish(__file__, streaming(), "nearest_stream")
    else:
        publish(__file__, report(), "nearest")
