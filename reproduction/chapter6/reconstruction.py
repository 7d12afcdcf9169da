"""Measure what an encoding keeps of a cloud (thesis Figure 6.4) and how long encoding takes (Figure 6.7).

    python -m reproduction.chapter6.reconstruction
    python -m reproduction.chapter6.reconstruction --draw

Writes reconstruction.csv, reconstruction_time.csv, reconstruction.png and reconstruction.md beside this file; half a
minute on one core. `--draw` draws the figure again from both tables. Shapes are the generated CAD models of
data=modelnet40.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import math
import sys
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np
import torch
from matplotlib.ticker import NullFormatter
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

from benchmarks.clouds.shapes import shapes
from benchmarks.pages import machine, read_rows, write_page
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.geometry.clouds import NormalisedClouds, sizes
from framework.geometry.nearest import chamfer
from framework.reports.table import markdown, write_csv
from plugins.encoder.bps.basis import Strategy, basis
from plugins.encoder.bps.encoding import decode, encode, prepared
from plugins.encoder.grids.occupancy import decode as centres
from plugins.encoder.grids.occupancy import occupancy
from plugins.encoder.points.subset import chosen

HERE = Path(__file__).resolve()
POINTS = 10_000
"""Of a cloud (§6.4.1)."""
EDGES = (2, 3, 4, 5, 6, 8, 10, 12, 15, 18, 21)
"""Of the grid basis; every basis has as many points, N = 3 · edge³ numbers are its deltas."""
SIDES = (3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 22, 25, 28, 31)
"""Cells along an occupancy grid of N = side³ cells."""
STRATEGIES: tuple[Strategy, ...] = ("ball_uniform", "hexagonal", "ball_grid", "grid")
METHODS = {
    "raw points": "raw points",
    "occupancy": "occupancy grid",
    "bps ball_uniform": "basis points, random in the ball",
    "bps hexagonal": "basis points, hexagonal packing",
    "bps ball_grid": "basis points, grid in the ball",
    "bps grid": "basis points, grid in the cube",
}
"""The encodings, and what the figure calls them."""
ENCODER, BALL_TREE = "bps", "scikit-learn ball tree"
CLOUD_SIZES = (10, 100, 1000, 2048, 10_000, 100_000)
BASIS_SIZES = (100, 512, 4096, 32_768)
TIMED_TREES = (512, 4096)
"""Sizes of the basis at which the ball tree is timed too."""


def raw(clouds: Tensor, count: int) -> Tensor:
    """Some of a cloud's points."""
    index = chosen(clouds, sizes(clouds), count, "random", 13)
    return clouds.gather(1, index[..., None].expand(-1, -1, 3))


def cells(clouds: Tensor, side: int) -> Tensor:
    """Centres of the cells a cloud occupies."""
    origin = torch.zeros(len(clouds), 3, dtype=torch.float64)
    return centres(
        occupancy(clouds, side), side, NormalisedClouds(clouds, origin, torch.ones_like(origin[:, 0]))
    )


def nearest_points(clouds: Tensor, strategy: Strategy, count: int) -> Tensor:
    """Deltas and basis added (eq. 6.5)."""
    made = prepared(basis(strategy, count, 1.0, 13).float())
    return decode(encode(clouds, made, ["delta"], "none"))


def errors(clouds: Tensor) -> list[dict[str, object]]:
    """The Chamfer distance (eq. 6.6) of every method at every length, over the shapes."""
    rows = []

    def measure(method: str, length: int, back: Tensor) -> None:
        found = chamfer(clouds, back, sizes(clouds), sizes(back)).double()
        rows.append(
            {
                "method": method,
                "length": length,
                "chamfer": found.mean().item(),
                "chamfer_sem": (found.std() / math.sqrt(len(found))).item(),
                "shapes": len(found),
            }
        )

    for edge in EDGES:
        measure("raw points", 3 * edge**3, raw(clouds, edge**3))
        for strategy in STRATEGIES:
            measure(f"bps {strategy}", 3 * edge**3, nearest_points(clouds, strategy, edge**3))
    for side in SIDES:
        measure("occupancy", side**3, cells(clouds, side))
    return sorted(rows, key=lambda row: list(METHODS).index(str(row["method"])))


def curve(rows: list[dict[str, object]], method: str) -> np.ndarray:
    return np.array([[row["length"], row["chamfer"]] for row in rows if row["method"] == method]).T


def ratio(rows: list[dict[str, object]], method: str, other: str, length: int) -> float:
    """Of two methods' errors at a length, both interpolated between logarithms."""
    values = [np.interp(math.log(length), *np.log(curve(rows, name))) for name in (method, other)]
    return math.exp(values[0] - values[1])


def quickest(call: Callable[[], object], least: int = 5, seconds: float = 0.5) -> float:
    """Least processor time of a call, ms."""
    call()
    times, begun = [], process_time()
    while len(times) < least or (process_time() - begun < seconds and len(times) < 200):
        start = process_time()
        call()
        times.append(process_time() - start)
    return 1e3 * min(times)


def by_ball_tree(cloud: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The search the thesis's own package is described to make (§6.5.4), building the tree included."""
    return (
        NearestNeighbors(n_neighbors=1, leaf_size=1, algorithm="ball_tree").fit(cloud).kneighbors(points)[0]
    )


def times(cloud: Tensor) -> list[dict[str, object]]:
    """Milliseconds per cloud, one at a time: normalisation and distances, against the search alone of a ball tree."""
    rows = []
    with torch.inference_mode():
        for count in BASIS_SIZES:
            made = prepared(basis("ball_uniform", count, 1.0, 13).float())
            for size in CLOUD_SIZES:
                part = cloud[:, :size].contiguous()
                table, points = part[0].numpy(), made.points.numpy()
                for method, call in {
                    ENCODER: lambda part=part, made=made: encode(part, made),
                    BALL_TREE: lambda table=table, points=points: by_ball_tree(table, points),
                }.items():
                    if method == ENCODER or count in TIMED_TREES:
                        spent = quickest(call)
                        rows.append({"method": method, "basis": count, "points": size, "milliseconds": spent})
    return rows


def pictured(rows: list[dict[str, object]], spent: list[dict[str, object]]) -> None:
    """Colours are methods in both panels; the markers of the right one are sizes of the basis."""
    title = "What an encoding keeps of a cloud, and what it costs"
    figure = titled_figure((12, 5.6), title, bool(rows[0]["synthetic"]))
    left, right = figure.subplots(1, 2)
    for (method, name), colour in zip(METHODS.items(), COLOURS, strict=False):
        length, error = curve(rows, method)
        noise = np.array([row["chamfer_sem"] for row in rows if row["method"] == method], dtype=float)
        left.plot(length, error, color=colour, marker=".", label=name)
        left.fill_between(length, error - noise, error + noise, color=colour, alpha=0.2, linewidth=0)
    left.set(
        xlabel="length of the encoding N (numbers)", ylabel="Chamfer distance (squared radii of the ball)"
    )
    left.set_title(
        f"error after decoding (as Figure 6.4); narrow bands: standard error over {rows[0]['shapes']} shapes",
        fontsize=10,
    )
    # timed is the encoder whose basis is random in the ball
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


def claims(rows: list[dict[str, object]]) -> str:
    """The thesis's sentences on Figure 6.4, and what is measured here."""
    lengths = [3 * edge**3 for edge in EDGES if 3 * edge**3 >= SIDES[0] ** 3]
    compared = [
        {"length": length, "synthetic": rows[0]["synthetic"]}
        | {name: ratio(rows, f"bps {name}", "occupancy", length) for name in STRATEGIES}
        | {f"{name}_raw": ratio(rows, f"bps {name}", "raw points", length) for name in STRATEGIES[:2]}
        for length in lengths
    ]
    headings = {name: f"{name} / occupancy" for name in STRATEGIES}
    headings |= {f"{name}_raw": f"{name} / raw points" for name in STRATEGIES[:2]}
    said = []
    for name in STRATEGIES:
        above = [row["length"] for row in compared if float(row[name]) >= 0.5]
        if len(above) == len(compared):
            said.append(f"{name} at no length")
        elif not above:
            said.append(f"{name} at every length")
        elif above[-1] == lengths[-1]:
            said.append(f"{name} not at N = {above[-1]}")
        else:
            said.append(f"{name} above N = {above[-1]}")
    best = [min(STRATEGIES, key=lambda name, row=row: float(row[name])) for row in compared]
    counts = ", ".join(f"{name} at {best.count(name)} of {len(best)} lengths" for name in sorted(set(best)))
    return (
        f"{markdown(compared, {'length': 'N', **headings})}\n\n"
        f"Less than half of the occupancy grid's error: {'; '.join(said)}. Least error of the four: {counts}."
    )


def main() -> None:
    torch.set_num_threads(1)
    clouds, synthetic = shapes(POINTS, 3)
    rows = [{**row, "synthetic": synthetic} for row in errors(clouds)]
    chair, _ = shapes(CLOUD_SIZES[-1], 1, ["chair", "airplane"])
    spent = [{**row, "synthetic": synthetic} for row in times(chair[:1])]
    columns = {"method": "method", "length": "N", "chamfer": "Chamfer distance", "shapes": "shapes"}
    write_csv(rows, columns, HERE.with_suffix(".csv"))
    timed = {"method": "method", "basis": "k", "points": "n", "milliseconds": "ms"}
    write_csv(spent, timed, HERE.with_name("reconstruction_time.csv"))
    pictured(rows, spent)
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
        f"`python -m reproduction.chapter6.reconstruction`: {rows[0]['shapes']} "
        f"{'synthetic ' if synthetic else ''}CAD shapes, "
        f"{POINTS} points of each surface, in the unit ball. Error: the Chamfer distance (eq. 6.6) between a cloud and "
        "what is decoded from N numbers: N/3 of its points (raw), the centres of occupied cells of a grid of N cells, "
        "or basis points and deltas of N/3 basis points. Values: `reconstruction.csv`, `reconstruction_time.csv`; "
        "figure: `reconstruction.png`.\n\n"
        f"Thesis (Figure 6.4): less than half of the occupancy grid's error up to about N = 1e4; near that of raw "
        "points; random and hexagonal best. Measured (ratios of errors, curves read between their points):\n\n"
        f"{claims(rows)}\n\n"
        "Encoding time (as Figure 6.7), ms per cloud, one at a time on one core: least processor time; `bps` is the "
        "whole encoder with normalisation, basis prepared; the ball tree is the search alone, as §6.5.4 describes it, "
        "tree building included.\n\n"
        f"{markdown(wide, {'method': 'method', **{f'n{size}': f'n = {size}' for size in CLOUD_SIZES}})}\n\n"
        f"{machine('torch', 'numba', 'scikit-learn')}\n"
    )
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    if sys.argv[1:] == ["--draw"]:
        pictured(*(read_rows(HERE.with_name(f"reconstruction{part}.csv")) for part in ("", "_time")))
    else:
        main()
