"""Report the five-fold cross-validation of cloud encoders on objects of airborne laser scans (DALES, real data).

    python -m framework -m \\
        experiment=dales/bps_mlp,dales/point_nn,dales/deepsets_micro,dales/pointnet_vanilla,dales/dgcnn_small \\
        data.root=/path/to/dales500.npz data.fold=0,1,2,3,4 threads=1 hydra.launcher.jobs=1 \\
        pictures=false logger=none hydra.sweep.dir=outputs/sweeps/dales
    python -m benchmarks.clouds.dales outputs/sweeps/dales /path/to/dales500.npz
    python -m framework -m \\
        experiment=dales/bps_mlp encoder.bps.basis=ball_uniform,selected encoder.bps.points=128,512 \\
        data.root=/path/to/dales500.npz data.fold=0,1,2,3,4 threads=1 hydra.launcher.jobs=1 \\
        pictures=false logger=none hydra.sweep.dir=outputs/sweeps/dales_bases
    python -m framework -m \\
        experiment=dales/bps_mlp encoder.bps.learned=true encoder.bps.points=128,512 \\
        data.root=/path/to/dales500.npz data.fold=0,1,2,3,4 threads=1 hydra.launcher.jobs=1 \\
        pictures=false logger=none hydra.sweep.dir=outputs/sweeps/dales_bases
    python -m benchmarks.clouds.dales --bases outputs/sweeps/dales_bases /path/to/dales500.npz

The second command writes dales.md and dales.png into the folder of this file. The last one writes a section of
dales.md.
"""

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import machine, publish, replace_section
from benchmarks.sweeps import Run, read_runs
from benchmarks.timing import Rounds, time_interleaved
from framework.configuration.loading import load_with_description
from framework.configuration.schema import build, resolve
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.reports.table import markdown
from framework.training.batches import Batches

NAMES = {
    "dales/bps_mlp": "basis points, MLP",
    "dales/point_nn": "Point-NN, MLP",
    "dales/deepsets_micro": "Deep Sets, 100 points",
    "dales/pointnet_vanilla": "PointNet, 512 points",
    "dales/dgcnn_small": "DGCNN, small, 128 points",
}
"""Names of the methods, by experiment; the first one is compared with the others."""
CLASSIFICATION = {"method": "method", "accuracy": "accuracy", "nll": "NLL (nats)", "ece": "ECE"}
COLUMNS = {
    **CLASSIFICATION,
    "accuracy_spread": "spread over folds",
    "mflop": "MFLOP",
    "times": "ms per cloud",
}
BASES = "## Selected and learned basis points"
"""Heading of the section about other choices of basis points, which are measured in a run of their own."""
BATCH = 16
"""Number of clouds that are predicted together where the time is measured."""


def runs_by_method(names: Iterable[str], *sweeps: str) -> dict[str, list[Run]]:
    """Return the runs of each experiment, in the order of `names`; experiments that were not run are left out."""
    runs = read_runs(*sweeps)
    lists = {name: [run for run in runs if run.results["experiment"] == name] for name in names}
    return {name: members for name, members in lists.items() if members}


def measure_times(runs: Mapping[str, Path], **data_settings: object) -> dict[str, Rounds]:
    """Return the processor time in ms per cloud of predictions on one thread, with the encoding.

    Args:
        runs: folder of a run, by name of the method.
        data_settings: settings of the data that replace those of the runs.
    """
    torch.set_num_threads(1)
    calls: dict[str, Callable[[], object]] = {}
    for name, run in runs.items():
        model, description = load_with_description(run)
        data = build("data", resolve("data", {**description.config["data"], **data_settings}))
        data.prepare()
        clouds = next(iter(Batches(data, batch_size=BATCH, workers=0, seed=0).test_dataloader()))["input"]
        calls[name] = partial(predict, model, clouds)
    times = time_interleaved(calls, rounds=7)
    return {name: Rounds(tuple(each / BATCH for each in times[name].milliseconds)) for name in runs}


@torch.inference_mode()
def predict(model: Callable[[torch.Tensor], Any], clouds: torch.Tensor) -> torch.Tensor:
    """Return the most probable classes."""
    return model(clouds).mode


def over_folds(folds: Sequence[Run], key: str) -> tuple[float, float]:
    """Return the mean of a metric over the folds, and its standard error over the test objects of all folds."""
    values, errors = ([fold.results[name] for fold in folds] for name in (key, f"{key}_sem"))
    return float(np.mean(values)), math.sqrt(sum(error**2 for error in errors)) / len(folds)


def row(
    method: str,
    runs: Sequence[Run],
    times: Rounds,
    average: Callable[[Sequence[Run], str], tuple[float, float]],
) -> dict[str, object]:
    """Return the row of a method, without the columns that only one of the pages has.

    Args:
        method: name of the method.
        runs: runs of the method.
        times: run times of a prediction.
        average: function of runs and of a metric's key that returns the mean of the metric and its standard error.
    """
    accuracy, nll = average(runs, "accuracy"), average(runs, "nll")
    return {
        "method": method,
        "accuracy": accuracy[0],
        "accuracy_sem": accuracy[1],
        "nll": nll[0],
        "nll_sem": nll[1],
        "ece": float(np.mean([run.results["ece"] for run in runs])),
        "mflop": runs[0].results["flops_per_sample"] / 1e6,
        "milliseconds": times.median,
        "times": times.text(),
    }


def draw(rows: Sequence[Mapping[str, Any]], title: str, path: Path, *, synthetic: bool) -> None:
    """Draw the accuracy of each method against its operations and its run time, into a file beside `path`."""
    lines_of_legend = math.ceil(len(rows) / 3)
    figure = titled_figure((8.4, 3.8 + 0.2 * lines_of_legend), title, synthetic=synthetic)
    panels = figure.subplots(1, 2, sharey=True)
    labels = {"mflop": "MFLOP per cloud (matrix products)", "milliseconds": "ms per cloud (one thread)"}
    for axes, (key, label) in zip(panels, labels.items(), strict=True):
        for number, result in enumerate(rows):
            axes.errorbar(
                result[key],
                result["accuracy"],
                yerr=result["accuracy_sem"],
                marker=MARKERS[number % len(MARKERS)],
                color=COLOURS[number % len(COLOURS)],
                capsize=3,
                linestyle="none",
                label=result["method"],
            )
        axes.set_xscale("log")
        ticks = [digit * 10.0**power for power in range(-3, 6) for digit in (1, 2, 5)]
        low, high = (choose(result[key] for result in rows) for choose in (min, max))
        axes.set_xlim(low / 1.6, high * 1.6)
        axes.set_xticks([tick for tick in ticks if low / 1.5 <= tick <= high * 1.5])
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
        axes.set_xlabel(label)
    panels[0].set_ylabel("accuracy")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    save_figure(figure, path.with_suffix(""), True)


def conclusion(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a text on the methods whose accuracy equals the highest one within the standard error."""
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
    if not others:
        return text
    return (
        f"{text} The other methods with such an accuracy are (operations and run time relative to the fastest): "
        f"{', '.join(others)}."
    )


def main() -> None:
    if sys.argv[1] == "--bases":
        write_bases(sys.argv[2], Path(sys.argv[3]))
        return
    runs = runs_by_method(NAMES, sys.argv[1])
    first_folders = {experiment: folds[0].folder for experiment, folds in runs.items()}
    times = measure_times(first_folders, root=str(Path(sys.argv[2]).absolute()))
    rows = []
    for experiment, folds in runs.items():
        spread = float(np.std([fold.results["accuracy"] for fold in folds], ddof=1))
        shared = row(NAMES[experiment], folds, times[experiment], over_folds)
        rows.append({**shared, "accuracy_spread": spread})
    title = "Real objects of laser scans: accuracy, operations and run time"
    draw(rows, title, Path(__file__), synthetic=False)
    count = sum(fold.results["test_samples"] for fold in next(iter(runs.values())))
    epochs = "200 epochs, except PointNet (40 epochs) and DGCNN (20 epochs), whose epochs take far longer"
    text = (
        "# Objects of airborne laser scans (DALES, real data)\n\n"
        "This page compares encoders of point clouds on real objects from airborne laser scans. The data set has "
        f"{count} objects of five classes, with 101 to 28,100 points each. It is divided into 5 folds, and each fold "
        "is the test split of one run, so that each object is tested once. The text at the top of `dales.py` lists "
        f"the commands that train the models. Each model is trained for {epochs}.\n\n"
        "*basis points* describes a cloud by the distance from each of 512 basis points to the nearest point of the "
        "cloud (`bps`). *Point-NN* describes a cloud by sines and cosines of 512 points, pooled over 40 "
        "neighbours (`point_nn`). Both have no trained parameters; two layers of 400 units follow them. "
        "*Deep Sets*, *PointNet* and *DGCNN* are trained networks on the points (`deepsets`, `pointnet` without the "
        "matrices that transform points and features, `dgcnn`). DGCNN has three edge convolutions of 32, 32 and 64 "
        "outputs over 10 neighbours. The published DGCNN reads 1024 points and is wider.\n\n"
        "Accuracy is the share of objects that are classified correctly. NLL is the mean negative log-likelihood of "
        "the true class; lower is better. ECE is the expected calibration error; 0 is best. The spread is the standard "
        "deviation of the accuracy over the folds. MFLOP counts the operations of matrix products only. For "
        "DGCNN these include the distances of all pairs of points; not counted are the sines of Point-NN and "
        f"the search for neighbours in the other methods. ms per cloud is the processor time of one thread for a "
        f"prediction of {BATCH} clouds, "
        f"divided by {BATCH}: the median of seven rounds (smallest to largest). It includes the encoding. Other "
        "processes ran on the machine at the same time.\n\n"
        f"{markdown(rows, COLUMNS)}\n"
        f"{conclusion(rows)}\n\n"
        "![Accuracy against operations and run time](dales.png)\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n\n"
        f"{BASES}\n\nNot measured yet; the text at the top of `dales.py` lists the command.\n"
    )
    publish(__file__, text)


def write_bases(sweep: str, root: Path) -> None:
    """Write the section of the page that compares random, selected and learned basis points.

    Args:
        sweep: folder of a sweep of `dales/bps_mlp` over choices and numbers of basis points and over the folds.
        root: archive of the objects.
    """
    names = {"ball_uniform": "random", "selected": "selected"}
    folds: dict[str, list[Run]] = {}
    for run in read_runs(sweep):
        settings = run.config()["encoder"]["bps"]
        kind = "learned" if settings["learned"] else names[settings["basis"]]
        name = f"{settings['points']} {kind} basis points, MLP"
        folds.setdefault(name, []).append(run)
    times = measure_times({name: runs[0].folder for name, runs in folds.items()}, root=str(root.absolute()))
    rows = [
        {
            **row(name, runs, times[name], over_folds),
            "accuracy_spread": float(np.std([run.results["accuracy"] for run in runs], ddof=1)),
        }
        for name, runs in sorted(folds.items(), key=lambda item: _order(item[0]))
    ]
    random = max((line for line in rows if "random" in line["method"]), key=itemgetter("accuracy"))
    other = max((line for line in rows if "random" not in line["method"]), key=itemgetter("accuracy"))
    error = math.hypot(random["accuracy_sem"], other["accuracy_sem"])
    text = (
        "The table compares basis points that are drawn at random, that are chosen for the training clouds of each "
        "fold without their classes (`encoder.bps.basis=selected`), and that are trained with the network "
        "(`encoder.bps.learned=true`). The folds, the network and the columns are those of the table above. The models "
        "were trained in a later run.\n\n"
        f"{markdown(rows, COLUMNS)}\n"
        f"The best row with random points, *{random['method']}*, is "
        f"{100 * (random['accuracy'] - other['accuracy']):.1f} ± {100 * error:.1f} points of accuracy above the best "
        f"other row, *{other['method']}*. ± holds for independent test objects; both rows have the same objects.\n\n"
        f"{machine('torch', 'pytorch-lightning')}"
    )
    replace_section(Path(__file__).with_suffix(".md"), BASES, text)


def _order(name: str) -> tuple[int, int]:
    number, kind = name.split()[:2]
    return int(number), ("random", "selected", "learned").index(kind)


if __name__ == "__main__":
    main()
