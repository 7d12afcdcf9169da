"""Compare encoders of point clouds of at most 50 million operations on generated CAD models (synthetic data).

    python -m benchmarks.clouds.small_encoders train outputs/small                    # all methods, about an hour
    python -m benchmarks.clouds.small_encoders train outputs/small bps --seeds 3 4   # or some
    python -m benchmarks.clouds.small_encoders page outputs/small

Writes small_encoders.md and small_encoders.png into the folder of this file.
"""

import argparse
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clouds.dales import BATCH, CLASSIFICATION, draw, measure_times, row
from benchmarks.commands import carry_out
from benchmarks.pages import machine, publish
from benchmarks.sweeps import Run, processor_seconds, read_runs, record
from framework.reports.table import markdown


class Method(NamedTuple):
    """A row of the table: its name, and the settings of its runs.

    Attributes:
        name: name in the table and in the figure.
        settings: settings of the command that trains the method; {folder} and {seed} are replaced.
        basis_points: whether the method reads the features of basis points.
    """

    name: str
    settings: tuple[str, ...]
    basis_points: bool = False


MLP = ("encoder.mlp.widths=[400,400]",)
METHODS = {
    **{
        key: Method(name, ("experiment=modelnet40/bps_mlp", *settings, *MLP), True)
        for key, name, settings in (
            ("bps", "basis points, MLP", ()),
            ("bps_128", "128 basis points, MLP", ("encoder.bps.points=128",)),
            ("selected", "selected basis points, MLP", ("encoder.bps.basis=selected",)),
            (
                "selected_128",
                "128 selected basis points, MLP",
                ("encoder.bps.basis=selected", "encoder.bps.points=128"),
            ),
            ("learned", "learned basis points, MLP", ("encoder.bps.learned=true",)),
            (
                "learned_128",
                "128 learned basis points, MLP",
                ("encoder.bps.learned=true", "encoder.bps.points=128"),
            ),
        )
    },
    "ten": Method(
        "128 selected basis points, ten MLPs",
        (
            "experiment=modelnet40/bps_mlp",
            "encoder.bps.basis=selected",
            "encoder.bps.points=128",
            *MLP,
            "uncertainty=[ensemble]",
            "uncertainty.ensemble.members=10",
        ),
        True,
    ),
    "student": Method(
        "128 selected basis points, MLP, distilled",
        (
            "experiment=modelnet40/bps_mlp",
            "encoder.bps.basis=selected",
            "encoder.bps.points=128",
            *MLP,
            "objective=[distillation]",
            "objective.distillation.teacher={folder}/ten_{seed}/0",
        ),
        True,
    ),
    "four": Method(
        "4 × 128 learned basis points, four MLPs",
        (
            "experiment=modelnet40/bps_mlp",
            "encoder.bps.learned=true",
            "encoder.bps.points=128",
            "encoder.mlp.widths=[200,200]",
            "encoder.mlp.dropout=0.3",
            "uncertainty=[ensemble]",
            "uncertainty.ensemble.members=4",
        ),
        True,
    ),
    "tdf": Method("truncated distances, MLP", ("experiment=modelnet40/tdf_mlp_8", *MLP)),
    "occupancy": Method("occupancy, MLP", ("experiment=modelnet40/occ_mlp_8", *MLP)),
    "pointnet_tiny": Method(
        "PointNet, 64 points",
        (
            "experiment=modelnet40/pointnet_vanilla",
            "encoder.pointnet.points=64",
            "encoder.pointnet.point_widths=[16,16,16,32,128]",
            "encoder.pointnet.widths=[64,32]",
            "trainer.max_epochs=60",
        ),
    ),
    "deepsets_tiny": Method(
        "Deep Sets, 50 points",
        (
            "experiment=modelnet40/deepsets_micro",
            "encoder.deepsets.points=50",
            "encoder.deepsets.channels=[64,64,64]",
            "encoder.deepsets.widths=[64]",
            "trainer.max_epochs=60",
        ),
    ),
    "dgcnn": Method(
        "DGCNN, 128 points",
        ("experiment=modelnet40/dgcnn_small", "trainer.max_epochs=40", "trainer.check_val_every_n_epoch=5"),
    ),
    "deepsets": Method("Deep Sets, 100 points", ("experiment=modelnet40/deepsets_micro",)),
    "pointnet": Method(
        "PointNet, 128 points",
        (
            "experiment=modelnet40/pointnet_vanilla",
            "encoder.pointnet.points=128",
        ),
    ),
}
"""Methods of the table, by the name of their folder."""
TRIALS = (
    "Further forms of basis points were tried on the same test clouds, in short trials that no command repeats: the "
    "centres of k-means of the training points, a residual network, and four networks on four different random or "
    "selected bases of 128 points. They are left out of the table, because none had a higher accuracy than learned "
    "points had in these trials."
)
"""Text on forms of basis points that are not in the table."""
SMALL = 1.0
"""Number of operations up to which a method is small, MFLOP."""
COLUMNS = {
    **CLASSIFICATION,
    "mflop": "MFLOP",
    "parameters": "parameters",
    "times": "ms per cloud",
    "epochs": "epochs",
    "seconds": "training, s",
    "seeds": "seeds",
}


def train(folder: Path, names: Iterable[str], seeds: Iterable[int]) -> None:
    """Train methods with each of the seeds, into `folder`/NAME_SEED; runs that are finished are not repeated."""
    shared = ("threads=1", "hydra.launcher.jobs=1", "pictures=false", "logger=none")
    for seed in seeds:
        for name in names:
            place = f"hydra.sweep.dir={folder.absolute() / f'{name}_{seed}'}"
            settings = (part.format(folder=folder.absolute(), seed=seed) for part in METHODS[name].settings)
            words = (*settings, f"seed={seed}", *shared, place)
            carry_out([sys.executable, "-m", "framework", "-m", *words])


def over_seeds(runs: Sequence[Run], key: str) -> tuple[float, float]:
    """Return the mean of a metric over seeds and its standard error for new test clouds and new seeds.

    All seeds have the same test clouds, so the variance that the choice of clouds causes does not fall with more seeds.
    """
    values = [run.results[key] for run in runs]
    clouds = float(np.mean([run.results[f"{key}_sem"] ** 2 for run in runs]))
    seeds = float(np.var(values, ddof=1)) / len(runs) if len(runs) > 1 else 0.0
    return float(np.mean(values)), math.sqrt(clouds + seeds)


def page(folder: Path) -> None:
    """Write the page and the figure from the runs in `folder`."""
    folders = sorted(folder.iterdir())
    runs = {
        name: read_runs(*(place for place in folders if re.fullmatch(rf"{name}_\d+", place.name)))
        for name in METHODS
    }
    runs = {name: members for name, members in runs.items() if members}
    times = measure_times({name: members[0].folder for name, members in runs.items()})
    rows = [
        {
            **row(METHODS[name].name, members, times[name], over_seeds),
            "basis_points": METHODS[name].basis_points,
            "parameters": members[0].results["parameters"],
            "epochs": members[0].config()["trainer"]["max_epochs"],
            "seconds": float(np.median([processor_seconds(record(run.folder)) for run in members])),
            "seeds": len(members),
            "synthetic": True,
        }
        for name, members in runs.items()
    ]
    draw(rows, "Cloud encoders: accuracy, operations and run time", Path(__file__), synthetic=True)
    tested = sorted({run.results["test_samples"] for members in runs.values() for run in members})
    missing = [method.name for name, method in METHODS.items() if name not in runs]
    not_run = f"The following methods were not run: {'; '.join(missing)}. " if missing else ""
    text = (
        "# Cloud encoders of at most 50 million operations (synthetic data)\n\n"
        "This page compares encoders of point clouds whose classifiers need at most 50 million operations per cloud. "
        "The data are the generated CAD models of `data=modelnet40` (generator 2; 40 classes; 2040 clouds for training "
        f"and validation, {' and '.join(map(str, tested))} for the test). The real ModelNet40 was not available. The "
        f"text at the top of `small_encoders.py` lists the commands. {not_run}"
        "[modelnet40](../../reproduction/chapter6/modelnet40.md) compares larger networks on the same data.\n\n"
        "- *Basis points* (`bps`) describe a cloud by the distance from each basis point to the nearest point of the "
        "cloud. Basis points are drawn at random from the unit ball. *Selected* basis points are chosen for the "
        "training clouds, without their classes, by a QR factorisation with column pivoting "
        "(`encoder.bps.basis=selected`). *Learned* basis points are trained with the network "
        "(`encoder.bps.learned=true`). There are 512 basis points if the name states no other number, and two layers "
        "of 400 units follow (*MLP*).\n"
        "- *ten MLPs* is an ensemble of ten such networks. *distilled* is one network that learns the predictions of "
        "these ten (`objective=[distillation]`). *4 × 128* is an ensemble of four networks of two layers of 200 units, "
        "each with a learned basis of its own.\n"
        "- *Truncated distances* and *occupancy* describe the 8³ cells of a grid (`tdf`, `occupancy`); two layers of "
        "400 units follow.\n"
        "- *PointNet* (without the matrices that transform points and features), *Deep Sets* and *DGCNN* are trained "
        "networks that read the first points of a cloud. DGCNN has three edge convolutions of 32, 32 and 64 "
        "outputs over 10 neighbours. The published networks read more points and are wider.\n\n"
        "The column *training* shows the processor time of a whole run on one thread (median over seeds). The weights "
        "of the epoch with the smallest validation loss are kept. For DGCNN this is epoch 35 of 40. "
        "Each method had one setting, except *basis points, MLP*: its network "
        "without batch norm was tried too and had an accuracy of 0.71.\n\n"
        f"{TRIALS}\n\n"
        "Accuracy is the share of test clouds that are classified correctly. NLL is the mean negative log-likelihood "
        "of the true class; lower is better. ECE is the expected calibration error; 0 is best. The square of the "
        "number after ± is the sum of two variances: one for the choice of test clouds, and the variance between seeds "
        "divided by the number of seeds, which is missing for a method with one seed. MFLOP counts the operations of "
        "matrix products and convolutions. For DGCNN these include the distances of all pairs of points. The search "
        "for the points that are nearest to the basis points is not counted. ms per cloud is the processor time of one "
        "thread for a prediction of "
        f"{BATCH} clouds, divided by {BATCH}: the median of seven rounds (smallest to largest). It includes the "
        "encoding. Other processes ran on the machine at the same time.\n\n"
        f"{markdown(rows, COLUMNS)}\n"
        f"{small_methods(rows)}\n\n{all_methods(rows)}\n\n"
        "![Accuracy against operations and run time](small_encoders.png)\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


def small_methods(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a text on whether another method dominates basis points below SMALL million operations.

    A method dominates another one if it needs no more operations, and its accuracy is higher by more than two standard
    errors of the difference.
    """
    small = [row for row in rows if row["mflop"] < SMALL]
    own = [row for row in small if row["basis_points"]]
    rivals = [row for row in small if not row["basis_points"]]
    dominating = [
        f"{rival['method']} dominates {row['method']} by {100 * (rival['accuracy'] - row['accuracy']):.1f} points"
        for row in own
        for rival in rivals
        if rival["mflop"] <= row["mflop"]
        and rival["accuracy"] - row["accuracy"] > 2 * error_of_difference(rival, row)
    ]
    best, best_rival = (max(some, key=lambda row: row["accuracy"]) for some in (own, rivals))
    gain = 100 * (best["accuracy"] - best_rival["accuracy"])
    verdict = "; ".join(dominating) if dominating else "no other method dominates basis points"
    return (
        f"**Below {SMALL:g} MFLOP {verdict}.** A method dominates another one if it needs no more operations and its "
        "accuracy is higher by more than two standard errors of the difference. The most accurate form of basis points "
        f"here is *{best['method']}* ({best['accuracy']:.3f}), and the most accurate other method is "
        f"*{best_rival['method']}* ({best_rival['accuracy']:.3f}); the difference is {gain:.1f} ± "
        f"{100 * error_of_difference(best, best_rival):.1f} points."
    )


def all_methods(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a text on the distance of basis points to the most accurate method of the whole table."""
    best = max(rows, key=lambda row: row["accuracy"])
    own = max((row for row in rows if row["basis_points"]), key=lambda row: row["accuracy"])
    small = max(
        (row for row in rows if row["basis_points"] and row["mflop"] < SMALL), key=lambda row: row["accuracy"]
    )
    other = max((row for row in rows if not row["basis_points"]), key=lambda row: row["accuracy"])
    lead = 100 * (own["accuracy"] - other["accuracy"])
    text = (
        f"**At up to 50 MFLOP *{best['method']}* is the most accurate method** ({best['accuracy']:.3f}, "
        f"{best['mflop']:.3g} MFLOP). The best form of basis points, *{own['method']}*, is {abs(lead):.1f} ± "
        f"{100 * error_of_difference(own, other):.1f} points {'above' if lead >= 0 else 'below'} the best other "
        f"method, *{other['method']}* ({other['accuracy']:.3f}, {other['mflop']:.3g} MFLOP)."
    )
    if small is best:
        return text
    gap = 100 * (best["accuracy"] - small["accuracy"])
    return (
        f"{text} The best form of basis points below {SMALL:g} MFLOP, *{small['method']}*, is {gap:.1f} ± "
        f"{100 * error_of_difference(best, small):.1f} points behind the most accurate method."
    )


def error_of_difference(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    """Return the standard error of the difference of two accuracies.

    The test clouds of both methods are the same, which usually makes the true error smaller.
    """
    return math.hypot(first["accuracy_sem"], second["accuracy_sem"])


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare small encoders of point clouds.")
    parser.add_argument("task", choices=("train", "page"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", metavar="name", help=f"{', '.join(METHODS)}; default: all")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(METHODS):
        parser.error(f"unknown methods {', '.join(sorted(unknown))}; expected some of {', '.join(METHODS)}")
    if arguments.task == "train":
        train(arguments.folder, arguments.names or METHODS, arguments.seeds)
    else:
        page(arguments.folder)


if __name__ == "__main__":
    main()
