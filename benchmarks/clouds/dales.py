"""Report the five-fold cross-validation of cloud encoders on objects of airborne laser scans (DALES, real data).

    python -m framework -m \\
        experiment=dales/bps_mlp,dales/point_nn,dales/deepsets_micro,dales/pointnet_vanilla \\
        data.root=/path/to/dales500.npz data.fold=0,1,2,3,4 threads=1 hydra.launcher.jobs=1 \\
        pictures=false logger=none hydra.sweep.dir=outputs/sweeps/dales
    python -m benchmarks.clouds.dales outputs/sweeps/dales /path/to/dales500.npz

Writes dales.md and dales.png into the folder of this file.
"""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import machine, publish
from framework.configuration.loading import load_with_description
from framework.configuration.schema import build, resolve
from framework.evaluation.splits import cost
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.reports.table import markdown
from framework.training.batches import Batches

NAMES = {
    "dales/bps_mlp": "basis points, MLP",
    "dales/point_nn": "Point-NN, MLP",
    "dales/deepsets_micro": "Deep Sets, 100 points",
    "dales/pointnet_vanilla": "PointNet, 512 points",
}
"""Names of the methods, by experiment; the first one is compared with the others."""
COLUMNS = {
    "method": "method",
    "accuracy": "accuracy",
    "nll": "NLL (nats)",
    "ece": "ECE",
    "accuracy_spread": "spread over folds",
    "mflop": "MFLOP",
    "milliseconds": "ms per cloud",
}
Fold = Mapping[str, Any]


def read_folds(sweep: Path, archive: Path) -> dict[str, list[Fold]]:
    """Return the results of each method, a list over the folds; run times are measured now, on one thread."""
    folds: dict[str, list[Fold]] = {}
    torch.set_num_threads(1)
    for path in sorted(sweep.glob("*/results.json")):
        results = json.loads(path.read_text(encoding="utf-8"))
        results["milliseconds"] = milliseconds_per_cloud(path.parent, archive)
        folds.setdefault(results["experiment"], []).append(results)
    return {experiment: folds[experiment] for experiment in NAMES if experiment in folds}


def milliseconds_per_cloud(run: Path, archive: Path) -> float:
    """Return the time of density and point prediction per cloud of a fold's test split, in batches of 16."""
    model, description = load_with_description(run)
    data = build("data", resolve("data", {**description.config["data"], "root": str(archive)}))
    data.prepare()
    inputs = next(iter(Batches(data, batch_size=16, workers=0, seed=0).test_dataloader()))
    return cost(model, inputs, samples=1, device=torch.device("cpu")).milliseconds_per_sample


def over_folds(folds: Sequence[Fold], key: str) -> tuple[float, float]:
    """Return the mean of a metric over the folds, and its standard error over the test objects of all folds."""
    values, errors = ([fold[name] for fold in folds] for name in (key, f"{key}_sem"))
    return float(np.mean(values)), math.sqrt(sum(error**2 for error in errors)) / len(folds)


def row(experiment: str, folds: Sequence[Fold]) -> dict[str, object]:
    """Return the row of a method."""
    accuracy, nll = over_folds(folds, "accuracy"), over_folds(folds, "nll")
    return {
        "method": NAMES[experiment],
        "accuracy": accuracy[0],
        "accuracy_sem": accuracy[1],
        "nll": nll[0],
        "nll_sem": nll[1],
        "ece": float(np.mean([fold["ece"] for fold in folds])),
        "accuracy_spread": float(np.std([fold["accuracy"] for fold in folds], ddof=1)),
        "mflop": folds[0]["flops_per_sample"] / 1e6,
        "milliseconds": float(np.median([fold["milliseconds"] for fold in folds])),
    }


def draw(rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the accuracy of each method against its run time."""
    figure = titled_figure((6.4, 4.0), "Real objects of laser scans: accuracy and run time", synthetic=False)
    axes = figure.add_subplot()
    for number, result in enumerate(rows):
        axes.errorbar(
            result["milliseconds"],
            result["accuracy"],
            yerr=result["accuracy_sem"],
            marker=MARKERS[number],
            color=COLOURS[number],
            capsize=3,
            linestyle="none",
            label=result["method"],
        )
    axes.set_xscale("log")
    axes.set_xticks([1, 3, 10, 30])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set_xlabel("ms per cloud (one thread)")
    axes.set_ylabel("accuracy, mean of five folds")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False, fontsize=9)
    save_figure(figure, Path(__file__).with_suffix(""), True)


def conclusion(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence about the methods whose accuracy is within its error of the highest one."""
    best = max(rows, key=lambda row: row["accuracy"])
    near = [
        row
        for row in rows
        if best["accuracy"] - row["accuracy"] <= math.hypot(best["accuracy_sem"], row["accuracy_sem"])
    ]
    fastest = min(near, key=lambda row: row["milliseconds"])
    others = [
        f"{row['method']} ({row['mflop'] / fastest['mflop']:.0f} times the operations, "
        f"{row['milliseconds'] / fastest['milliseconds']:.1f} times the run time)"
        for row in near
        if row is not fastest
    ]
    text = (
        "Of the methods whose accuracy is the highest, or is equal to the highest within the standard error, "
        f"**{fastest['method']}** is the fastest."
    )
    return f"{text} The other methods with such an accuracy are: {', '.join(others)}." if others else text


def main() -> None:
    results = read_folds(Path(sys.argv[1]), Path(sys.argv[2]).absolute())
    rows = [row(experiment, folds) for experiment, folds in results.items()]
    draw(rows)
    count = sum(fold["test_samples"] for fold in next(iter(results.values())))
    epochs = "200 epochs, except PointNet: its epochs take far longer, so it is trained for 40 epochs"
    text = (
        "# Objects of airborne laser scans (DALES, real data)\n\n"
        "This page compares encoders of point clouds on real objects from airborne laser scans. The data set has "
        f"{count} objects of five classes, with 101 to 28,100 points each. It is divided into 5 folds, and each fold "
        "is the test split of one run, so that each object is tested once. The text at the top of `dales.py` lists "
        f"the commands that train the models. Each model is trained for {epochs}.\n\n"
        "*basis points* describes a cloud by the distances from 512 basis points to its nearest points (`bps`). "
        "*Point-NN* describes it by sines and cosines of 512 points, pooled over 40 neighbours (`point_nn`). "
        "Both have no trained parameters; two layers of 400 units follow them. *Deep Sets* and *PointNet* are "
        "trained networks on the points (`deepsets`, and `pointnet` without the matrices that transform points "
        "and features).\n\n"
        "Accuracy is the share of objects that are classified correctly. NLL is the mean negative log-likelihood of "
        "the true class; lower is better. ECE is the expected calibration error; 0 is best. The spread is the standard "
        "deviation of the accuracy over the folds. MFLOP counts the operations of matrix products only; it "
        "leaves out the search for neighbours and the sines. ms per cloud is the time of a whole prediction on "
        "one thread.\n\n"
        f"{markdown(rows, COLUMNS)}\n"
        f"{conclusion(rows)}\n\n"
        "![Accuracy and run time](dales.png)\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
