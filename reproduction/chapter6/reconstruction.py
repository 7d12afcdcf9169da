"""Measure what an encoding keeps of a cloud (thesis Figure 6.4) and how long encoding takes (Figure 6.7).

    python -m reproduction.chapter6.reconstruction
    python -m reproduction.chapter6.reconstruction --draw

The script takes half a minute on one core. It writes reconstruction.csv, reconstruction_time.csv, reconstruction.png
and reconstruction.md beside this file. `--draw` draws the figure again from both tables. The shapes are the generated
CAD models of data=modelnet40.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import math
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np
import torch
from matplotlib.ticker import NullFormatter
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

from benchmarks.clouds.shapes import shapes
from benchmarks.pages import machine, publish, read_rows, run_or_draw
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.geometry.clouds import NormalisedClouds, sizes
from framework.geometry.nearest import chamfer
from framework.reports.table import markdown, write_csv
from plugins.encoder.bps.basis import Strategy, basis
from plugins.encoder.bps.encoding import decode, encode, prepare_basis
from plugins.encoder.grids.occupancy import decode as centres
from plugins.encoder.grids.occupancy import occupancy
from plugins.encoder.points.subset import choose_points

HERE = Path(__file__).resolve()
POINTS = 10_000
"""Number of points of a cloud (§6.4.1)."""
EDGES = (2, 3, 4, 5, 6, 8, 10, 12, 15, 18, 21)
"""Basis points along an edge of the grid; every basis has edge³ points, so that its deltas are N = 3 · edge³
numbers."""
SIDES = (3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 22, 25, 28, 31)
"""Cells along a side of an occupancy grid of N = side³ cells."""
STRATEGIES: tuple[Strategy, ...] = ("ball_uniform", "hexagonal", "ball_grid", "grid")
METHODS = {
    "raw points": "raw points",
    "occupancy": "occupancy grid",
    "bps ball_uniform": "basis points, random in the ball",
    "bps hexagonal": "basis points, hexagonal packing",
    "bps ball_grid": "basis points, grid in the ball",
    "bps grid": "basis points, grid in the cube",
}
"""Keys of the encodings and their names in the figure."""
ENCODER, BALL_TREE = "bps", "scikit-learn ball tree"
CLOUD_SIZES = (10, 100, 1000, 2048, 10_000, 100_000)
BASIS_SIZES = (100, 512, 4096, 32_768)
TIMED_TREES = (512, 4096)
"""Sizes of the basis at which the ball tree is also timed."""


def sample_points(clouds: Tensor, count: int) -> Tensor:
    """Return `count` random points of each cloud."""
    index = choose_points(clouds, sizes(clouds), count, "random", 13)
    return clouds.gather(1, index[..., None].expand(-1, -1, 3))


def decode_occupancy(clouds: Tensor, side: int) -> Tensor:
    """Return the centres of the cells that each cloud occupies."""
    origin = torch.zeros(len(clouds), 3, dtype=torch.float64)
    return centres(
        occupancy(clouds, side), side, NormalisedClouds(clouds, origin, torch.ones_like(origin[:, 0]))
    )


def decode_deltas(clouds: Tensor, strategy: Strategy, count: int) -> Tensor:
    """Encode clouds by deltas from `count` basis points and decode them as basis point plus delta (thesis eq. 6.5)."""
    basis_points = prepare_basis(basis(strategy, count, 1.0, 13).float())
    return decode(encode(clouds, basis_points, ["delta"], "none"))


def measure_errors(clouds: Tensor) -> list[dict[str, object]]:
    """Measure the mean Chamfer distance (thesis eq. 6.6) over the shapes for every method and encoding length."""
    rows = []

    def measure(method: str, length: int, back: Tensor) -> None:
        distances = chamfer(clouds, back, sizes(clouds), sizes(back)).double()
        rows.append(
            {
                "method": method,
                "length": length,
                "chamfer": distances.mean().item(),
                "chamfer_sem": (distances.std() / math.sqrt(len(distances))).item(),
                "shapes": len(distances),
            }
        )

    for edge in EDGES:
        measure("raw points", 3 * edge**3, sample_points(clouds, edge**3))
        for strategy in STRATEGIES:
            measure(f"bps {strategy}", 3 * edge**3, decode_deltas(clouds, strategy, edge**3))
    for side in SIDES:
        measure("occupancy", side**3, decode_occupancy(clouds, side))
    return sorted(rows, key=lambda row: list(METHODS).index(str(row["method"])))


def curve(rows: list[dict[str, object]], method: str) -> np.ndarray:
    return np.array([[row["length"], row["chamfer"]] for row in rows if row["method"] == method]).T


def error_ratio(rows: list[dict[str, object]], method: str, other: str, length: int) -> float:
    """Return the error of `method` divided by the error of `other`, for encodings of `length` numbers.

    Errors between measured lengths are interpolated on logarithmic scales.
    """
    values = [np.interp(math.log(length), *np.log(curve(rows, name))) for name in (method, other)]
    return math.exp(values[0] - values[1])


def least_time(call: Callable[[], object], least: int = 5, seconds: float = 0.5) -> float:
    """Return the smallest processor time of several calls of a function, in ms.

    Args:
        call: the function.
        least: smallest number of timed calls.
        seconds: processor time after which no further call begins.
    """
    call()
    times, begun = [], process_time()
    while len(times) < least or (process_time() - begun < seconds and len(times) < 200):
        start = process_time()
        call()
        times.append(process_time() - start)
    return 1e3 * min(times)


def search_ball_tree(cloud: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distance of each of `points` to its nearest point of the cloud, by the ball tree of thesis §6.5.4.

    The tree is built in each call, so that the measured time includes its construction.
    """
    return (
        NearestNeighbors(n_neighbors=1, leaf_size=1, algorithm="ball_tree").fit(cloud).kneighbors(points)[0]
    )


def measure_times(cloud: Tensor) -> list[dict[str, object]]:
    """Measure milliseconds per cloud of the whole encoder and of the search by a ball tree alone."""
    rows = []
    with torch.inference_mode():
        for count in BASIS_SIZES:
            basis_points = prepare_basis(basis("ball_uniform", count, 1.0, 13).float())
            for size in CLOUD_SIZES:
                part = cloud[:, :size].contiguous()
                table, points = part[0].numpy(), basis_points.points.numpy()
                for method, call in {
                    ENCODER: lambda part=part, basis_points=basis_points: encode(part, basis_points),
                    BALL_TREE: lambda table=table, points=points: search_ball_tree(table, points),
                }.items():
                    if method == ENCODER or count in TIMED_TREES:
                        spent = least_time(call)
                        rows.append({"method": method, "basis": count, "points": size, "milliseconds": spent})
    return rows


def draw_figures(rows: list[dict[str, object]], spent: list[dict[str, object]]) -> None:
    """Draw both panels: colours show methods, and the markers of the right panel show sizes of the basis."""
    title = "What an encoding keeps of a cloud, and what it costs"
    figure = titled_figure((12, 5.6), title, bool(rows[0]["synthetic"]))
    left, right = figure.subplots(1, 2)
    for (method, name), colour in zip(METHODS.items(), COLOURS, strict=False):
        length, error = curve(rows, method)
        standard_error = np.array(
            [row["chamfer_sem"] for row in rows if row["method"] == method], dtype=float
        )
        left.plot(length, error, color=colour, marker=".", label=name)
        left.fill_between(
            length, error - standard_error, error + standard_error, color=colour, alpha=0.2, linewidth=0
        )
    left.set(
        xlabel="length of the encoding N (numbers)", ylabel="Chamfer distance (squared radii of the ball)"
    )
    left.set_title(
        f"error after decoding (as Figure 6.4); narrow bands: standard error over {rows[0]['shapes']} shapes",
        fontsize=10,
    )
    # the timed encoder has the basis that is random in the ball
    own = COLOURS[list(METHODS).index("bps ball_uniform")]
    for method, counts, colour, style, name in (
        (ENCODER, BASIS_SIZES, own, "-", "this encoder, basis random in the ball"),
        (BALL_TREE, TIMED_TREES, "black", ":", "scikit-learn's ball tree, search alone"),
    ):
        for count in counts:
            points = [row for row in spent if (row["method"], row["basis"]) == (method, count)]
            right.plot(
                [row["points"] for row in points],
                [row["milliseconds"] for row in points],
                color=colour,
                linestyle=style,
                marker=MARKERS[BASIS_SIZES.index(count)],
                markersize=5,
                label=f"{name}, k = {count}",
            )
    right.set(xlabel="points of the cloud n", ylabel="least processor time (ms per cloud, one core)")
    right.set_title("encoding time for k basis points (as Figure 6.7)", fontsize=10)
    for axes in (left, right):
        axes.set(xscale="log", yscale="log")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False)
    save_figure(figure, HERE.with_suffix(""), True)


def claims_text(rows: list[dict[str, object]]) -> str:
    """Return the table of error ratios and a sentence on the claims of the thesis about Figure 6.4."""
    lengths = [3 * edge**3 for edge in EDGES if 3 * edge**3 >= SIDES[0] ** 3]
    compared = [
        {"length": length, "synthetic": rows[0]["synthetic"]}
        | {name: error_ratio(rows, f"bps {name}", "occupancy", length) for name in STRATEGIES}
        | {f"{name}_raw": error_ratio(rows, f"bps {name}", "raw points", length) for name in STRATEGIES[:2]}
        for length in lengths
    ]
    headings = {name: f"{name} / occupancy" for name in STRATEGIES}
    headings |= {f"{name}_raw": f"{name} / raw points" for name in STRATEGIES[:2]}
    parts = []
    for name in STRATEGIES:
        above = [row["length"] for row in compared if float(row[name]) >= 0.5]
        if len(above) == len(compared):
            parts.append(f"{name} at no length")
        elif not above:
            parts.append(f"{name} at every length")
        elif above[-1] == lengths[-1]:
            parts.append(f"{name} not at N = {above[-1]}")
        else:
            parts.append(f"{name} above N = {above[-1]}")
    best = [min(STRATEGIES, key=lambda name, row=row: float(row[name])) for row in compared]
    counts = ", ".join(f"{name} at {best.count(name)} of {len(best)} lengths" for name in sorted(set(best)))
    return (
        f"{markdown(compared, {'length': 'N', **headings})}\n\n"
        "An arrangement of basis points has less than half of the reconstruction error of the occupancy grid at these "
        f"lengths N: {'; '.join(parts)}. The arrangement with the smallest error is {counts}."
    )


def main() -> None:
    torch.set_num_threads(1)
    clouds, synthetic = shapes(POINTS, 3)
    rows = [{**row, "synthetic": synthetic} for row in measure_errors(clouds)]
    chair, _ = shapes(CLOUD_SIZES[-1], 1, ["chair", "airplane"])
    spent = [{**row, "synthetic": synthetic} for row in measure_times(chair[:1])]
    columns = {"method": "method", "length": "N", "chamfer": "Chamfer distance", "shapes": "shapes"}
    write_csv(rows, columns, HERE.with_suffix(".csv"))
    timed = {"method": "method", "basis": "k", "points": "n", "milliseconds": "ms"}
    write_csv(spent, timed, HERE.with_name("reconstruction_time.csv"))
    draw_figures(rows, spent)
    wide = [
        {"method": f"{method}, k = {count}", "synthetic": synthetic}
        | {
            f"n{row['points']}": row["milliseconds"]
            for row in spent
            if (row["method"], row["basis"]) == (method, count)
        }
        for method, counts in ((ENCODER, BASIS_SIZES), (BALL_TREE, TIMED_TREES))
        for count in counts
    ]
    text = (
        "# What an encoding keeps of a cloud, and what it costs\n\n"
        "This page measures how much of a point cloud an encoding keeps (thesis Figure 6.4) and how long encoding "
        f"takes (Figure 6.7). The clouds are {rows[0]['shapes']} {'synthetic ' if synthetic else ''}CAD shapes, with "
        f"{POINTS} points on each surface, in the unit ball. The command is `python -m "
        "reproduction.chapter6.reconstruction`. All values are in `reconstruction.csv` and `reconstruction_time.csv`, "
        "and the figure is `reconstruction.png`.\n\n"
        "## Error after decoding, as in Figure 6.4\n\n"
        "The error of an encoding is the Chamfer distance (eq. 6.6) between a cloud and the cloud that is decoded "
        "from N numbers. Raw points are N/3 of the points of the cloud. Occupancy is a grid of N cells, decoded as "
        "the centres of the occupied cells. A basis point set has N/3 basis points. Its encoding holds the vector "
        "from each basis point to the nearest point of the cloud, and decoding adds these vectors to the basis "
        "points. The columns are named after the arrangement of the basis points: random in the ball "
        "(`ball_uniform`), hexagonal, a grid trimmed to the ball (`ball_grid`) or a full cubic grid (`grid`).\n\n"
        "The thesis reports that basis point sets have less than half of the error of the occupancy grid up to about "
        "N = 1e4, that their error is close to the error of raw points, and that random and hexagonal arrangements are "
        "best. The table shows ratios of the measured errors (Chamfer distances of reconstructed clouds). Values "
        "between measured lengths N of the encoding are interpolated.\n\n"
        f"{claims_text(rows)}\n\n"
        "## Encoding time, as in Figure 6.7\n\n"
        "The table shows the processor time in milliseconds to encode one cloud of n points on one core. A time is "
        "the shortest of several calls. `bps` is the whole encoder with k basis points, including normalisation; the "
        "basis is prepared in advance. The ball tree is the search of §6.5.4 alone, including the construction of "
        "the tree.\n\n"
        f"{markdown(wide, {'method': 'method', **{f'n{size}': f'ms, n = {size}' for size in CLOUD_SIZES}})}\n\n"
        f"{machine('torch', 'numba', 'scikit-learn')}\n"
    )
    publish(HERE, text)


if __name__ == "__main__":
    tables = [HERE.with_name(f"reconstruction{part}.csv") for part in ("", "_time")]
    run_or_draw(main, lambda: draw_figures(*map(read_rows, tables)))
