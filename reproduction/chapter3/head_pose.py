"""Make Tables 3.1 and 3.2 on generated head poses (synthetic).

    python -m reproduction.thesis_tables 3.1-3.2

To evaluate sweeps that have already run: `python -m reproduction.chapter3.head_pose <folders of the sweeps>`. The
script writes head_pose.md beside this file.
"""

import sys
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import machine, publish
from benchmarks.sweeps import Run, milliseconds_per_sample, processor_seconds, read_runs, record, settings
from framework.reports.table import Better, aggregate, markdown
from framework.training.batches import Batches

HERE = Path(__file__).resolve()
METHODS = {
    "fixed_kappa": "fixed κ",
    "von_mises": "single von Mises",
    "mixture": "finite mixture",
    "cvae": "CVAE",
    "cvae_each": "CVAE, three backbones",
}
COLUMNS = {
    "data": "layout",
    "angle": "angle",
    "method": "method",
    "n": "seeds",
    "maad_deg": "MAAD °",
    "log_likelihood": "log-likelihood (nats)",
    "milliseconds_per_sample": "ms / image",
    "minutes": "processor minutes per run",
    "thesis": "thesis: MAAD °, log-likelihood (its own data)",
}
BETTER: Better = {"maad_deg": "lower", "log_likelihood": "higher"}
THESIS = {
    ("idiap", "pan", "fixed_kappa"): "5.8 ± 0.1, 0.37 ± 0.01",
    ("idiap", "pan", "von_mises"): "6.3 ± 0.1, 0.56 ± 0.01",
    ("idiap", "pan", "cvae"): "6.4 ± 0.1, 0.52 ± 0.02",
    ("idiap", "pan", "cvae_each"): "6.4 ± 0.1, 0.52 ± 0.02",
    ("idiap", "tilt", "fixed_kappa"): "2.4 ± 0.1, 1.31 ± 0.01",
    ("idiap", "tilt", "von_mises"): "2.3 ± 0.1, 1.56 ± 0.01",
    ("idiap", "tilt", "cvae"): "2.9 ± 0.1, 1.35 ± 0.01",
    ("idiap", "roll", "fixed_kappa"): "3.1 ± 0.1, 1.13 ± 0.01",
    ("idiap", "roll", "von_mises"): "3.4 ± 0.1, 1.13 ± 0.01",
    ("idiap", "roll", "cvae"): "3.5 ± 0.1, 1.05 ± 0.02",
    ("caviar", "pan", "fixed_kappa"): "5.74 ± 0.13, 0.262 ± 0.031",
    ("caviar", "pan", "von_mises"): "5.53 ± 0.13, 0.700 ± 0.043",
    ("caviar", "pan", "mixture"): "4.21 ± 0.16, 1.87 ± 0.04",
    ("towncentre", "pan", "fixed_kappa"): "22.8 ± 1.0, −0.89 ± 0.06",
    ("towncentre", "pan", "von_mises"): "22.9 ± 1.1, −0.57 ± 0.05",
    ("towncentre", "pan", "mixture"): "23.5 ± 1.1, −0.50 ± 0.04",
}
"""MAAD and log-likelihood of the thesis with standard errors over test images; its CVAE has three backbones
(§3.6.1)."""


def read_results(runs: list[Run]) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    loaders: dict[str, Batches] = {}
    rows = []
    for run, numbers in runs:
        job = record(run)
        data, _, method = numbers["experiment"].partition("/")
        if "density_head.backbones=each" in job["overrides"]:
            method += "_each"
        angles = [word for word in job["overrides"] if word.startswith("data.angles=")]
        angle = angles[0].partition("=")[2].strip("[]") if angles else "pan"
        costs = {
            "milliseconds_per_sample": milliseconds_per_sample(run, loaders),
            "minutes": processor_seconds(job) / 60,
        }
        rows.append(numbers | {"data": data, "angle": angle, "method": method} | costs)
    order, places = list(METHODS), [key[:2] for key in THESIS]
    return sorted(
        rows,
        key=lambda row: (places.index((row["data"], row["angle"])), order.index(row["method"]), row["seed"]),
    )


def difference_table(rows: list[dict[str, Any]]) -> str:
    """Return a table of the differences between each method and the method with fixed κ, on the same data and seed."""
    lines = [
        "| layout, angle | method | gain in log-likelihood, nats | decrease of MAAD, ° | seeds |",
        "|---|---|---:|---:|---:|",
    ]
    for (data, angle), group in groupby(rows, key=lambda row: (row["data"], row["angle"])):
        by_method: dict[str, dict[int, dict[str, Any]]] = {}
        for row in group:
            by_method.setdefault(row["method"], {})[row["seed"]] = row
        baseline = by_method.pop("fixed_kappa", {})
        for method, rows_by_seed in by_method.items():
            seeds = sorted(rows_by_seed.keys() & baseline.keys())
            cells = []
            for key, sign in (("log_likelihood", 1), ("maad_deg", -1)):
                gaps = np.array([sign * (rows_by_seed[seed][key] - baseline[seed][key]) for seed in seeds])
                if len(gaps) > 1:
                    cells.append(f"{gaps.mean():+.2f} ± {gaps.std(ddof=1) / len(gaps) ** 0.5:.2f}")
                else:
                    cells.append(f"{gaps[0]:+.2f}" if len(gaps) else "not available")
            lines.append(f"| {data}, {angle} | {METHODS[method]} | {' | '.join(cells)} | {len(seeds)} |")
    return "\n".join(lines)


def main() -> None:
    runs = read_runs(*sys.argv[1:])
    rows = read_results(runs)
    size, epochs, batch, precision = settings(
        [folder for folder, _ in runs],
        *("data.image_size", "trainer.max_epochs", "batch_size", "trainer.precision"),
    )
    tables = []
    for _, group in groupby(rows, key=lambda row: (row["data"], row["angle"])):
        compared = aggregate(list(group), by=["data", "angle", "method"])
        for row in compared:
            key = (str(row["data"]), str(row["angle"]), str(row["method"]))
            row |= {"thesis": THESIS[key], "method": METHODS[key[2]]}
        tables.append(markdown(compared, COLUMNS, better=BETTER))
    text = (
        "# Tables 3.1 and 3.2: head poses (synthetic data)\n\n"
        "This page repeats Tables 3.1 and 3.2 of the thesis: networks predict the angles of heads from images. The "
        "images are generated in the layouts of the data sets IDIAP, CAVIAR and TownCentre. "
        "The methods are von Mises densities with a fixed or a predicted concentration κ, a finite mixture of "
        "them, and a conditional variational autoencoder (CVAE).\n\n"
        f"For Tables 3.1 and 3.2, one model is trained for each angle of the heads, on images of {size} pixels, for "
        f"{epochs} epochs in batches of {batch}, with precision {precision}. ± is the standard deviation over seeds, "
        "or the standard error over test images if there is one seed. MAAD is the mean absolute angular deviation of "
        "the point prediction. The time of a prediction in milliseconds is measured on one thread. The last column "
        "but one of the tables gives the MAAD and the log-likelihood of the thesis, with standard errors over the "
        "test images of the real data sets. The order of the methods can be compared with ours; absolute numbers "
        "cannot. The command is `python -m reproduction.thesis_tables 3.1-3.2`.\n\n"
        f"{chr(10).join(tables)}\n"
        "## Gain over one fixed concentration\n\n"
        "Each row of the table compares a method for head poses with the von Mises density of fixed concentration κ, "
        "trained on the same images with the same seed. Positive numbers mean that the method of the row is better. "
        '± is the standard error over seeds. "CVAE, three backbones" has one convolutional backbone for each of its '
        "three networks, as in the thesis; the other CVAE shares one.\n\n"
        f"{difference_table(rows)}\n\n{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(HERE, text)


if __name__ == "__main__":
    main()
