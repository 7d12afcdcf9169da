"""Measure the classes of points in tiles of real laser-scan objects (DALES), with local features and a global code.

    python -m benchmarks.clouds.tiles --make /path/to/dales500.npz outputs/tiles
    python -m framework -m \\
        experiment=labelled_points/mlp data.root=outputs/tiles data.points=1024 \\
        data.classes=[ground,building,car,fence,pole,tree] data.surrounding_points=0 data.neighbours=0,16 \\
        data.basis_points=0,128 seed=0,1 \\
        threads=1 hydra.launcher.jobs=1 pictures=false logger=none hydra.sweep.dir=outputs/sweeps/tiles
    python -m framework -m \\
        experiment=labelled_points/mlp data.root=outputs/tiles data.points=1024 \\
        data.classes=[ground,building,car,fence,pole,tree] data.surrounding_points=64 data.basis_points=0,128 \\
        seed=0,1 threads=1 hydra.launcher.jobs=1 pictures=false logger=none hydra.sweep.dir=outputs/sweeps/tiles_around
    python -m framework -m \\
        experiment=labelled_points/mlp data.root=outputs/tiles data.points=1024 \\
        data.classes=[ground,building,car,fence,pole,tree] data.surrounding_points=64 data.neighbours=0 \\
        data.basis_points=0 seed=0,1 \\
        threads=1 hydra.launcher.jobs=1 pictures=false logger=none hydra.sweep.dir=outputs/sweeps/tiles_only
    python -m benchmarks.clouds.tiles outputs/tiles \\
        outputs/sweeps/tiles outputs/sweeps/tiles_around outputs/sweeps/tiles_only

The last command writes tiles.md and tiles.png into the folder of this file.
"""

import json
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from torch import Tensor

from benchmarks.pages import machine, publish
from benchmarks.sweeps import Run, read_runs
from framework.configuration.loading import load_with_description
from framework.configuration.schema import build, resolve
from framework.datasets.fields import fetch
from framework.datasets.shares import hold_out
from framework.figures.style import COLOURS, MARKERS, titled_figure
from framework.geometry.meshes import stream
from framework.reports.table import markdown
from plugins.data.labelled_clouds.archive import read_archive
from plugins.metric.segmentation.metric import shares

SIDE, WIDEST = 40.0, 30.0
"""Side of a tile, and largest width of an object, metres."""
SHARE = 0.2
"""Share of the points of an object that is kept, so that tiles have about ten points per square metre."""
DENSITY = 10.0
"""Points of the ground per square metre: the density of the roofs of the objects after thinning."""
TILES = {"train": 80, "validation": 10, "test": 12}
PER_CLASS = 2
"""Number of objects of each class in a tile, if they find a place."""
TRIES = 200
"""Number of random places that are tried for an object."""
BLOCK = 4096
"""Number of points that are predicted at once."""

PALETTE = ("#c9c2b5", "#d1495b", "#3066be", "#f2a541", "#111111", "#3b8f4a")
"""Colours of the classes: ground, building, car, fence, pole, tree."""
ALONE, LOCAL = "position", "position, 16 neighbours"
AROUND = f"{LOCAL}, 64 distances around it"
PAIRS = (
    (ALONE, f"{ALONE}, code of the tile"),
    (ALONE, LOCAL),
    (LOCAL, f"{LOCAL}, code of the tile"),
    (LOCAL, AROUND),
    (f"{ALONE}, 64 distances around it", AROUND),
    (AROUND, f"{AROUND}, code of the tile"),
)
"""Pairs of inputs whose results are compared on the same tiles."""


class Tile(NamedTuple):
    """A tile: coordinates in metres, and the class of each point."""

    points: Float[np.ndarray, "points 3"]
    labels: Int[np.ndarray, " points"]


def make(archive_file: str, folder: Path) -> None:
    """Write the tiles of all splits into folders of splits, and a file with their numbers."""
    archive = read_archive(archive_file)
    objects = [
        archive.points[archive.offset[i] : archive.offset[i + 1]].astype(np.float64)
        for i in range(len(archive.label))
    ]
    narrow = np.array([np.ptp(cloud[:, :2], axis=0).max() <= WIDEST for cloud in objects])
    splits = np.where(narrow, "train", "").astype("<U10")
    random = stream(0, "objects")
    hold_out(splits, archive.label, 0.25, random, "test")
    hold_out(splits, archive.label, 0.15, random, "validation")
    used: dict[str, int] = {}
    for split, count in TILES.items():
        (folder / split).mkdir(parents=True, exist_ok=True)
        supply = {
            label: _deal(np.flatnonzero((splits == split) & (archive.label == label)), random)
            for label in range(len(archive.classes))
        }
        placed: list[int] = []
        for number in range(count):
            chosen = [next(supply[label]) for label in supply for _ in range(PER_CLASS)]
            tile, indices = compose([objects[i] for i in chosen], archive.label[chosen], random)
            placed += [chosen[i] for i in indices]
            np.savez(
                folder / split / f"tile_{number:03d}.npz",
                points=tile.points.astype(np.float32),
                label=tile.labels.astype(np.int32),
            )
        used[f"{split}_placed"], used[f"{split}_objects"] = len(placed), len(set(placed))
    numbers = {"classes": ["ground", *archive.classes], "too_wide": int((~narrow).sum()), **used}
    (folder / "numbers.json").write_text(json.dumps(numbers), encoding="utf-8")
    sys.stdout.write(f"{numbers}\n")


def _deal(indices: Int[np.ndarray, " objects"], random: np.random.Generator) -> Iterator[int]:
    """Yield the objects in random order; only after the last one, they begin again in a new order."""
    while True:
        yield from random.permutation(indices).tolist()


def compose(
    objects: Sequence[Float[np.ndarray, "_p 3"]],
    labels: Int[np.ndarray, " objects"],
    random: np.random.Generator,
) -> tuple[Tile, list[int]]:
    """Return a tile with objects on a wavy ground, and the indices of the objects that have found a place.

    Each object is turned about the vertical axis and thinned. The largest objects are placed first; the boxes of
    objects keep a distance of 0.5 m. The ground has no points below the class 0, buildings, because a roof hides it.
    """
    waves = random.uniform(0.02, 0.12, (4, 2)) * random.choice([-1, 1], (4, 2))
    phase, height = random.uniform(0, 2 * np.pi, 4), random.uniform(0.1, 0.4, 4)

    def ground(xy: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, " p"]:
        return (height * np.sin(xy @ waves.T + phase)).sum(1)

    boxes: list[Float[np.ndarray, "2 2"]] = []
    parts, classes, indices = [], [], []
    turned = []
    for cloud in objects:
        angle = random.uniform(0, 2 * np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        cloud = np.column_stack([cloud[:, :2] @ turn.T, cloud[:, 2]])
        turned.append(cloud - [*cloud[:, :2].min(0), cloud[:, 2].min()])
    for number in sorted(range(len(turned)), key=lambda i: -float(np.prod(turned[i][:, :2].max(0)))):
        cloud = turned[number]
        width = cloud[:, :2].max(0)
        if (width > SIDE).any():
            continue
        for _ in range(TRIES):
            corner = random.uniform(0, SIDE - width)
            box = np.stack([corner - 0.25, corner + width + 0.25])
            if all((box[0] > other[1]).any() or (box[1] < other[0]).any() for other in boxes):
                thinned = cloud[random.random(len(cloud)) < SHARE]
                level = ground((corner + width / 2)[None])[0]
                parts.append(thinned + np.array([*corner, level]))
                classes.append(np.full(len(thinned), labels[number] + 1))
                boxes.append(box)
                indices.append(number)
                break
    soil = random.uniform(0, SIDE, (round(DENSITY * SIDE**2), 2))
    cells = np.zeros((int(SIDE) + 1, int(SIDE) + 1), bool)
    for part, label in zip(parts, classes, strict=True):
        if len(label) and label[0] == 1:
            cells[tuple(part[:, :2].clip(0, SIDE).astype(int).T)] = True
    soil = soil[~cells[tuple(soil.astype(int).T)]]
    noise = random.normal(0, 0.03, len(soil))
    parts.append(np.column_stack([soil, ground(soil) + noise]))
    classes.append(np.zeros(len(soil), np.int64))
    return Tile(np.concatenate(parts), np.concatenate(classes)), indices


def name(run: Run) -> str:
    """Return the name of the features that a run reads."""
    data = run.config()["data"]
    parts = ["position"]
    parts += [f"{data['neighbours']} neighbours"] * bool(data["neighbours"])
    parts += [f"{data['surrounding_points']} distances around it"] * bool(data["surrounding_points"])
    parts += ["code of the tile"] * bool(data["basis_points"])
    return ", ".join(parts)


class Predicted(NamedTuple):
    """Predictions of a run for the test tiles.

    Attributes:
        labels: Predicted class of each point, for each tile.
        counts: Number of points of each tile by true and predicted class.
        seconds: Processor time of each tile in seconds: reading, features and network.
    """

    labels: list[Tensor]
    counts: Float64[Tensor, "tiles class class"]
    seconds: list[float]


@torch.inference_mode()
def predict(run: Run, files: Sequence[Path], classes: int) -> Predicted:
    """Predict the classes of all points of the tiles, as `mode=predict` does."""
    model, description = load_with_description(run.folder)
    data = build("data", resolve("data", description.config["data"]))
    data.load_state_dict(description.data_state)
    labels, counts, seconds = [], [], []
    for file in (
        files[0],
        *files,
    ):  # the first tile twice; its first time, with the start of libraries, is left out
        start = process_time()
        dataset = data.read([file])
        blocks = [range(first, min(first + BLOCK, len(dataset))) for first in range(0, len(dataset), BLOCK)]  # type: ignore[arg-type]
        guess = torch.cat([model(fetch(dataset, block)["input"]).probs.argmax(-1) for block in blocks])
        seconds.append(process_time() - start)
        truth = torch.from_numpy(np.load(file)["label"]).long()
        cells = torch.bincount(truth * classes + guess, minlength=classes**2)
        labels.append(guess)
        counts.append(cells.view(classes, classes).double())
    return Predicted(labels[1:], torch.stack(counts[1:]), seconds[1:])


def jackknife(predictions: Sequence[Predicted]) -> tuple[Tensor, Tensor]:
    """Return the mean of `shares` over runs with other seeds, and the same without each test tile in turn."""
    totals = [run.counts.sum(0) for run in predictions]
    whole = torch.stack([shares(total[None])[0] for total in totals]).mean(0)
    left_out = [shares(total - run.counts) for total, run in zip(totals, predictions, strict=True)]
    return whole, torch.stack(left_out).mean(0)


def standard_error(left_out: Tensor) -> Tensor:
    """Return the jackknife's standard error over tiles, the first dimension (Efron & Tibshirani 1993, eq. 11.5)."""
    count = len(left_out)
    return ((left_out - left_out.mean(0)).square().sum(0) * ((count - 1) / count)).sqrt()


def conclusion(rows: Sequence[Mapping[str, Any]], left_out: Mapping[str, Tensor]) -> str:
    """Return a sentence on the fastest of the inputs whose mean IoU is not clearly below the highest.

    An input is clearly below if the difference exceeds two of its standard errors on the same tiles.
    """
    best = max(rows, key=lambda row: row["iou"])
    near = [
        row
        for row in rows
        if row is best
        or best["iou"] - row["iou"] <= 2 * standard_error(left_out[best["input"]] - left_out[row["input"]])[1]
    ]
    fastest = min(near, key=lambda row: row["milliseconds"])
    if fastest is best:
        return f"*{best['input']}* has the highest mean IoU; no faster input is within two standard errors of it."
    return (
        f"*{best['input']}* has the highest mean IoU. *{fastest['input']}* is the fastest of the inputs within two "
        "standard errors of it on the same tiles."
    )


def draw(
    files: Sequence[Path],
    predictions: Mapping[str, Sequence[Predicted]],
    rows: Sequence[Mapping[str, Any]],
    classes: Sequence[str],
) -> None:
    """Draw two tiles from above with true and predicted classes, and the mean IoU against the time per tile."""
    shown = [ALONE, LOCAL, AROUND]
    figure = titled_figure(
        (12.0, 9.4), "Classes of points: real objects on a generated ground", synthetic=False
    )
    grid = figure.add_gridspec(3, 4, height_ratios=(3, 3, 2.2))
    for line, number in enumerate((1, 2)):
        tile = np.load(files[number])
        # the highest points are drawn last, because they are seen from above
        order = tile["points"][:, 2].argsort()
        panels = {"true classes": tile["label"]} | {
            heading: predictions[heading][0].labels[number].numpy() for heading in shown
        }
        for column, (heading, labels) in enumerate(panels.items()):
            axes = figure.add_subplot(grid[line, column])
            x, y, _ = tile["points"][order].T
            axes.scatter(
                x, y, s=1.2, c=labels[order], cmap=ListedColormap(PALETTE), vmin=-0.5, vmax=5.5, lw=0
            )
            axes.set(xticks=[], yticks=[], aspect="equal")
            if line == 0:
                axes.set_title(heading.replace(", 64", ",\n64"), fontsize=10)
    axes = figure.add_subplot(grid[2, :])
    for number, row in enumerate(rows):
        style: dict[str, Any] = {
            "marker": MARKERS[number % len(MARKERS)],
            "color": COLOURS[number % len(COLOURS)],
        }
        axes.errorbar(
            row["milliseconds"], row["iou"], row["iou_sem"], capsize=3, ls="none", label=row["input"], **style
        )
    axes.set(xlabel="ms per tile (one thread), with all features", ylabel="mean IoU")
    axes.set_xscale("log")
    ticks = [
        tick
        for tick in (20, 30, 50, 70, 100, 150, 200, 300, 500, 1000)
        if axes.get_xlim()[0] < tick < axes.get_xlim()[1]
    ]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.legend(loc="lower right", fontsize=9, frameon=False)
    handles = [Patch(color=colour, label=word) for colour, word in zip(PALETTE, classes, strict=True)]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=10, frameon=False)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=80)  # many points: half the size of other figures


def write(folder: Path, sweeps: Sequence[str]) -> None:
    """Predict the test tiles with all runs of the sweeps, and write the page and the figure."""
    torch.set_num_threads(1)
    numbers = json.loads((folder / "numbers.json").read_text(encoding="utf-8"))
    classes = numbers["classes"]
    files = sorted((folder / "test").glob("*.npz"))
    runs: dict[str, list[Run]] = defaultdict(list)
    for run in read_runs(*sweeps):
        runs[name(run)].append(run)
    names = sorted(runs, key=lambda heading: (heading.count(","), "code" not in heading, heading))
    predictions = {heading: [predict(run, files, len(classes)) for run in runs[heading]] for heading in names}
    rows, by_class, left_out_scores, whole_scores = [], [], {}, {}
    for heading in names:
        whole, left_out = jackknife(predictions[heading])
        whole_scores[heading], left_out_scores[heading] = whole, left_out
        error = standard_error(left_out)
        own = [shares(run.counts.sum(0)[None])[0, 1].item() for run in predictions[heading]]
        for run, value in zip(runs[heading], own, strict=True):
            if abs(run.results["mean_iou"] - value) > 1e-3:
                raise ValueError(
                    f"{run.folder}: mean IoU {run.results['mean_iou']}, but predicted again {value}"
                )
        results = runs[heading][0].results
        rows.append(
            {
                "input": heading,
                "accuracy": whole[0].item(),
                "accuracy_sem": error[0].item(),
                "iou": whole[1].item(),
                "iou_sem": error[1].item(),
                "seeds": f"{min(own):.3f} to {max(own):.3f}",
                "nll": float(np.mean([run.results["nll"] for run in runs[heading]])),
                "kflop": results["flops_per_sample"] / 1e3,
                "milliseconds": 1e3 * float(np.median([run.seconds for run in predictions[heading]])),
            }
        )
        scores = {word: whole[2 + number].item() for number, word in enumerate(classes)}
        errors = {f"{word}_sem": error[2 + number].item() for number, word in enumerate(classes)}
        by_class.append({"input": heading, **scores, **errors})
    draw(files, predictions, rows, classes)
    lines = []
    for first, second in PAIRS:
        if first in whole_scores and second in whole_scores:
            gap = whole_scores[second] - whole_scores[first]
            error = standard_error(left_out_scores[second] - left_out_scores[first])
            lines.append(
                f"- *{second}* minus *{first}*: accuracy {gap[0]:+.4f} ± {error[0]:.4f}, mean IoU {gap[1]:+.3f} ± "
                f"{error[1]:.3f}\n"
            )
    config = next(iter(runs.values()))[0].config()
    sizes = [len(np.load(file)["label"]) for file in files]
    share = float(np.mean(np.concatenate([np.load(file)["label"] for file in files]) == 0))
    columns = {
        "input": "input of the network",
        "accuracy": "accuracy",
        "iou": "mean IoU",
        "seeds": "mean IoU of each seed",
        "nll": "NLL (nats)",
        "kflop": "kFLOP per point",
        "milliseconds": "ms per tile",
    }
    text = (
        "# Classes of points in tiles of real objects (DALES)\n\n"
        "This page compares what a network has to know about a point of a laser scan to recognise its class. The "
        "objects are real: airborne laser scans of buildings, cars, fences, poles and trees from the DALES objects "
        "extract. **Their arrangement and the ground are generated**, because only single objects were at hand: a tile "
        f"has a side of {SIDE:g} m, a gently waved ground with {DENSITY:g} points per square metre and noise of 3 cm, "
        f"and up to {PER_CLASS} objects of each class. Each object is turned about the vertical axis and put at a "
        f"random free place. A share of {SHARE:g} of its points is kept, so that objects and ground are about equally "
        "dense. There are no ground points below buildings. Results on real scans may therefore differ.\n\n"
        f"Of the 499 objects, {numbers['too_wide']} are wider than {WIDEST:g} m and left out. The others are divided "
        f"into splits before tiles are made: {TILES['train']} tiles for training have {numbers['train_objects']} "
        f"different objects, {TILES['validation']} for validation have {numbers['validation_objects']}, and "
        f"{TILES['test']} for the test have {numbers['test_objects']} in {numbers['test_placed']} places. No object of "
        f"the test is in another split. A test tile has {min(sizes)} to {max(sizes)} points; {100 * share:.0f} % of "
        "all test points are ground, which explains the high accuracy of every row.\n\n"
        "The network is the same in all rows: two layers of 256 and 128 units (`experiment=labelled_points/mlp`, "
        f"{config['data']['points']} random points of each training tile, {config['trainer']['max_epochs']} epochs, "
        "seeds 0 and 1). Only its input differs. *position* is x, y and the height above the lowest point. "
        "*neighbours* are the offsets and distances of the nearest points. *distances around it* are the distances "
        "from basis points, uniform in a ball of 4 m around the point, to the nearest point of the tile. *code of the "
        "tile* are the distances from 128 basis points to the tile, the same for all points of a tile (thesis "
        "§8.2). The text at the top of `tiles.py` lists the commands.\n\n"
        "Accuracy is the share of all test points that are classified correctly. IoU is the intersection over union "
        "of a class, with counts over all test points, and mean IoU its mean over the six classes. ± is the standard "
        "error of the jackknife over test tiles, for the mean of the two seeds, since the points of a tile depend on "
        "each other. NLL is the mean negative log-likelihood. kFLOP counts the matrix products of the network. ms per "
        f"tile is the processor time of one thread for all points of a tile (median: {np.median(sizes):.0f} points): "
        "reading the file, features, and network, as the median over test tiles and seeds. Other processes ran on "
        "the machine at the same time.\n\n"
        f"{markdown(rows, columns)}\n"
        f"{conclusion(rows, left_out_scores)}\n\n"
        "Differences on the same test tiles, with the standard error of the difference:\n\n"
        f"{''.join(lines)}\n"
        "IoU of each class:\n\n"
        f"{markdown(by_class, {'input': 'input of the network', **{word: word for word in classes}})}\n"
        "The validation loss, too, is lowest with neighbours and distances around a point and without the code of the "
        "tile; these are the default settings of `data=labelled_points`.\n\n"
        "The figure shows two test tiles from above: the true classes, and the predictions of three networks (seed "
        "0). Below are mean IoU and run time of all rows.\n\n"
        f"![Classes of points in two tiles, and mean IoU against run time](tiles.png)\n\n"
        f"{machine('torch', 'scipy', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


def main() -> None:
    if sys.argv[1] == "--make":
        make(sys.argv[2], Path(sys.argv[3]))
    else:
        write(Path(sys.argv[1]), sys.argv[2:])


if __name__ == "__main__":
    main()
