"""Time exact nearest neighbours of a basis in clouds against public libraries, on one core.

    python -m benchmarks.clouds.nearest [--stream]

Writes nearest.md beside this file. Clouds are synthetic but for `scan`, points of a real scan drawn again with jitter
(REAL_DATA_ROOT/clouds/demo_scan.ply; left out where that is missing). Every method builds its structure for each cloud
and returns distances and difference vectors. `--stream` instead reads 1e8 generated points in chunks and writes
nearest_stream.md.
"""

import argparse
import math
import os
import resource
import sys
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

from benchmarks.pages import machine, write_page
from benchmarks.timing import first_calls
from framework.geometry.nearest import Queries, nearest, prepare
from framework.geometry.nearest.streamed import Middle, Reach, Stream, normalise_chunk

Array = NDArray[np.floating]
ROWS = ((2048, 512, 24, 12), (10_000, 1000, 12, 8), (100_000, 1000, 3, 5), (1_000_000, 4096, 3, 2))
"""Points, basis points, clouds, rounds."""
TARGETS = {2048: (15, 3.5), 10_000: (10, 2.5), 100_000: (18, 4), 1_000_000: (18, 5)}
"""Times faster than the ball tree, and than the best of the others."""
FIRST_CALL = """
import time, torch
from framework.geometry.nearest import nearest
clouds, queries = torch.rand(1, 5000, 3), torch.rand(500, 3)
wall, cpu = time.perf_counter(), time.process_time()
nearest(clouds, queries)
print(time.process_time() - cpu)
"""


def ball(count: int, generator: np.random.Generator) -> Array:
    """Uniform in the unit ball (eq. 6.3)."""
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return (direction * generator.uniform(size=(count, 1)) ** (1 / 3)).astype(np.float32)


def torus(count: int, generator: np.random.Generator) -> Array:
    a, b = generator.uniform(0, 2 * math.pi, (2, count))
    radius = 1 + 0.35 * np.cos(b)
    return np.stack([radius * np.cos(a), radius * np.sin(a), 0.35 * np.sin(b)], 1)


def chair(count: int, generator: np.random.Generator) -> Array:
    """The surface of a seat, a back and four legs."""
    boxes = [((-0.5, -0.5, 0.45), (0.5, 0.5, 0.55)), ((-0.5, 0.4, 0.55), (0.5, 0.5, 1.3))]
    boxes += [((x, y, 0.0), (x + 0.1, y + 0.1, 0.45)) for x in (-0.5, 0.4) for y in (-0.5, 0.4)]
    low, high = (np.array(sides) for sides in zip(*boxes, strict=True))
    size = high - low
    areas = np.stack([size[:, (axis + 1) % 3] * size[:, (axis + 2) % 3] for axis in range(3)], 1)
    box, axis = np.divmod(generator.choice(areas.size, count, p=areas.ravel() / areas.sum()), 3)
    inside = generator.uniform(size=(count, 3))
    inside[np.arange(count), axis] = generator.integers(0, 2, count)
    return low[box] + inside * size[box]


def shapes() -> dict[str, Callable[[int, np.random.Generator], Array]]:
    found: dict[str, Callable[[int, np.random.Generator], Array]] = {"torus": torus, "chair": chair}
    path = Path(os.environ.get("REAL_DATA_ROOT", "")) / "clouds" / "demo_scan.ply"
    if path.is_file():
        import trimesh

        points = np.asarray(trimesh.load(path).vertices)  # type: ignore[reportAttributeAccessIssue]
        spacing = median(cKDTree(points).query(points, 2)[0][:, 1])

        def scan(count: int, generator: np.random.Generator) -> Array:
            return points[generator.integers(0, len(points), count)] + generator.normal(
                scale=spacing, size=(count, 3)
            )

        found["scan"] = scan
    return found


def clouds(points: int, count: int) -> list[Array]:
    """Of every shape as many, in the unit ball (eq. 6.2); no two alike, so that no branch is learnt by heart."""
    makers = list(shapes().values())
    made = []
    for i in range(count):
        cloud = makers[i % len(makers)](points, np.random.default_rng(i))
        cloud = cloud - cloud.mean(0)
        made.append((cloud / np.linalg.norm(cloud, axis=1).max()).astype(np.float32))
    return made


# each: cloud (n, 3), basis (k, 3) → distances (k,), differences (k, 3)
def ball_tree(cloud: Array, basis: Array) -> tuple[Array, Array]:
    """The kernel of the package that came with the paper, re-created from its description."""
    tree = NearestNeighbors(n_neighbors=1, leaf_size=1, algorithm="ball_tree").fit(cloud)
    distance, index = tree.kneighbors(basis)
    return distance[:, 0], cloud[index[:, 0]] - basis


def sklearn_kd(cloud: Array, basis: Array) -> tuple[Array, Array]:
    distance, index = NearestNeighbors(n_neighbors=1, algorithm="kd_tree").fit(cloud).kneighbors(basis)
    return distance[:, 0], cloud[index[:, 0]] - basis


def scipy_kd(cloud: Array, basis: Array) -> tuple[Array, Array]:
    distance, index = cKDTree(cloud, balanced_tree=False, compact_nodes=False).query(
        basis
    )  # its faster settings
    return distance, cloud[index] - basis


def pykdtree(cloud: Array, basis: Array) -> tuple[Array, Array]:
    distance, index = KDTree(cloud).query(basis)
    return distance, cloud[index] - basis


def nanoflann(cloud: Array, basis: Array) -> tuple[Array, Array]:
    tree = pynanoflann.KDTree(n_neighbors=1, metric="L2", leaf_size=10)
    tree.fit(cloud)
    distance, index = tree.kneighbors(basis)
    return distance[:, 0], cloud[index[:, 0]] - basis


RIVALS = (ball_tree, sklearn_kd, scipy_kd, pykdtree, nanoflann)


def ours(batch: torch.Tensor, queries: Queries) -> tuple[torch.Tensor, torch.Tensor]:
    distance, index = nearest(batch, queries)
    return distance, batch.gather(1, index[..., None].expand(-1, -1, 3)) - queries.points


def one_core(points: int, basis_points: int, count: int, rounds: int) -> dict[str, tuple[float, float]]:
    """Method → milliseconds of processor time a cloud, least of the rounds; and largest error of a distance."""
    basis = ball(basis_points, np.random.default_rng(99))
    queries = prepare(torch.from_numpy(basis))
    made = clouds(points, count)
    batches = [torch.from_numpy(cloud)[None] for cloud in made]
    together = torch.cat(batches)
    exact = [cKDTree(cloud.astype(float)).query(basis.astype(float))[0] for cloud in made]

    def run(method: Callable[[Array, Array], tuple[Array, Array]]) -> list[Array]:
        return [method(cloud, basis)[0] for cloud in made]

    work: dict[str, Callable[[], list[Array]]] = {
        "ours": lambda: list(ours(together, queries)[0].numpy()),
        "ours, a call a cloud": lambda: [ours(batch, queries)[0][0].numpy() for batch in batches],
    }
    work |= {rival.__name__: lambda rival=rival: run(rival) for rival in RIVALS}
    least = dict.fromkeys(work, math.inf)
    errors = dict.fromkeys(work, 0.0)
    for turn in range(rounds + 1):  # in turns, so that a busy machine is busy for all; the first warms up
        for name, call in work.items():
            start = time.process_time()
            found = call()
            spent = time.process_time() - start
            if turn == 0:
                errors[name] = max(float(abs(a - b).max()) for a, b in zip(found, exact, strict=True))
            else:
                least[name] = min(least[name], 1e3 * spent / count)
    return {name: (least[name], errors[name]) for name in work}


def hard_clouds(points: int = 100_000, basis_points: int = 1000) -> str:
    """Milliseconds of clouds that spoil grids and trees, ours and the best of the others: a table row each."""
    generator = np.random.default_rng(7)
    plain = torus(points, generator)
    nested = 100.0 ** -generator.integers(0, 10, points)[:, None] * generator.normal(size=(points, 3))
    side = round(points ** (1 / 3))
    kinds = {
        "torus": plain,
        "volume: uniform in the ball": ball(points, generator),
        "one outlier, 1e6 times as far": np.concatenate([plain[1:], [[1e6, 0, 0]]]),
        "ten nested clusters, each 100 times smaller": nested,
        "20 places, each point many times": ball(20, generator)[generator.integers(0, 20, points)],
        "all points in one place": np.full((points, 3), 0.25),
        "lattice: many ties": np.stack(np.meshgrid(*[np.linspace(-1, 1, side)] * 3), -1).reshape(-1, 3),
        "sphere about the origin, seen from inside": plain / np.linalg.norm(plain, axis=1, keepdims=True),
    }
    basis = ball(basis_points, generator)
    queries = prepare(torch.from_numpy(basis))
    lines = ["| cloud | ours | pykdtree | error |", "|---|---|---|---|"]
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


def two_cores(points: int, basis_points: int, count: int, seconds: float = 12.0) -> tuple[float, float]:
    """How many times faster two threads are than one: by least wall time, in turns; and by least processor time,
    2 t₁ / t₂, which is what two cores give that nobody else uses, if both are busy to the end."""
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


def report() -> str:
    torch.set_num_threads(1)
    names = ["ours", "ours, a call a cloud", *(rival.__name__ for rival in RIVALS)]
    lines = [f"| n | k | {' | '.join(names)} | × ball_tree | × best other |", "|---" * (len(names) + 4) + "|"]
    errors = dict.fromkeys(names, 0.0)
    for points, basis_points, count, rounds in ROWS:
        found = one_core(points, basis_points, count, rounds)
        for name in names:
            errors[name] = max(errors[name], found[name][1])
        cells = [f"{found[name][0]:.3f}" for name in names]
        best = min(found[rival.__name__][0] for rival in RIVALS)
        alone = found["ours, a call a cloud"][0]
        ratios = []
        for rival, target in zip((found["ball_tree"][0], best), TARGETS[points], strict=True):
            ratios.append(f"**{rival / found['ours'][0]:.1f}** ({rival / alone:.1f}; ≥ {target})")
        lines.append(f"| {points:,} | {basis_points:,} | {' | '.join(cells)} | {' | '.join(ratios)} |")
    hard = hard_clouds()
    scaling = {
        "64 clouds, 2,048 and 512": two_cores(2048, 512, 64),
        "16 clouds, 10,000 and 1,000": two_cores(10_000, 1000, 16),
        "8 clouds, 100,000 and 1,000": two_cores(100_000, 1000, 8),
        "one cloud, 1,000,000 and 4,096": two_cores(1_000_000, 4096, 1),
        "one cloud, 10,000 and 32,768": two_cores(10_000, 32_768, 1),
    }
    load = os.getloadavg()[0]
    cold, warm = first_calls(FIRST_CALL, FRAMEWORK_CACHE="{}", NUMBA_CACHE_DIR="")
    return "\n".join(
        [
            "# Nearest neighbours of a basis: milliseconds a cloud on one core",
            "",
            f"`python -m benchmarks.clouds.nearest`: n points of {', '.join(shapes())} (`scan` is a real scan drawn "
            "again with jitter, the others are synthetic), float32, k basis points uniform in the unit ball; "
            "structure, distances and difference vectors of every cloud. Least processor time of several rounds "
            "over different clouds, methods in turns. `ours` gets all clouds in one call, the others one at a time. "
            "Ratios: one call (a call a cloud; target).",
            "",
            *lines,
            "",
            "Largest difference of a distance from SciPy in float64: "
            + ", ".join(f"{name} {error:.0e}" for name, error in errors.items())
            + ".",
            "",
            "Clouds of 100,000 points that spoil grids and trees, 1,000 basis points:",
            "",
            hard,
            "",
            "Two threads against one (≥ 1.8 wanted), by wall time and by processor time, 2 t₁ / t₂; load of the "
            f"machine meanwhile {load:.1f}, of which about 1.5 are this benchmark (wall time says something where "
            "others leave both cores free): "
            + "; ".join(f"{name}: {wall:.2f}, **{spent:.2f}**" for name, (wall, spent) in scaling.items())
            + ".",
            "",
            f"First call of a process, processor time: {cold:.1f} s where everything is compiled, {warm:.2f} s where "
            "machine code is read from the cache; once for each of float32 and float64.",
            "",
            machine("numba", "torch", "scipy", "scikit-learn", "pykdtree", "pynanoflann"),
            "",
        ]
    )


def streaming(total: int = 10**8, size: int = 10**6, basis_points: int = 1000) -> str:
    """Three readings of a generated cloud, in chunks: mean, largest norm, nearest points."""
    torch.set_num_threads(1)
    basis = prepare(torch.from_numpy(ball(basis_points, np.random.default_rng(99))))

    def chunk(number: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(number)
        a, b = 2 * math.pi * torch.rand(2, size, generator=generator)
        radius = 5 + 1.7 * torch.cos(b)
        return torch.stack([radius * torch.cos(a) + 100, radius * torch.sin(a), 1.7 * torch.sin(b)], 1)

    nearest(chunk(0)[None], basis)  # compiled before
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    middle = Middle()
    spent = {"generating": 0.0, "mean": 0.0, "largest norm": 0.0, "nearest": 0.0}

    def read(name: str, use: Callable[[torch.Tensor], None]) -> None:
        for number in range(total // size):
            start = time.process_time()
            points = chunk(number)
            between = time.process_time()
            use(points)
            spent["generating"] += between - start
            spent[name] += time.process_time() - between

    read("mean", middle.add)
    reach = Reach(middle.mean)
    read("largest norm", reach.add)
    stream = Stream(basis)
    read("nearest", lambda points: stream.add(normalise_chunk(points, middle.mean, reach.norm)))
    found = stream.result()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in spent.items())
    return (
        f"# A cloud of {total:,} points in chunks of {size:,}\n\n`python -m benchmarks.clouds.nearest --stream`: a "
        f"synthetic torus, {basis_points:,} basis points, one core. Processor time: {times}. Peak memory "
        f"{peak / 2**10:.0f} MiB, of which {base / 2**10:.0f} MiB before the first chunk was read (libraries and one "
        f"chunk); all points would be {12 * total / 2**20:.0f} MiB. Centre "
        f"{[round(x, 4) for x in middle.mean.tolist()]}, largest norm "
        f"{reach.norm:.4f}, mean distance {float(found.distance.mean()):.6f}.\n\n{machine('numba', 'torch')}\n"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stream", action="store_true", help="1e8 points in chunks; takes some minutes")
    if parser.parse_args().stream:
        text, name = streaming(), "nearest_stream"
    else:
        text, name = report(), "nearest"
    write_page(__file__, text, name)
    sys.stdout.write(text)
