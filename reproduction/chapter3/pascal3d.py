"""Make Table 3.3: five density heads on the classes of a generated PASCAL3D+ (synthetic).

    python -m reproduction.thesis_tables 3.3

To evaluate sweeps that have already run: `python -m reproduction.chapter3.pascal3d <folders of the sweeps>`.

The script measures the run time of a prediction again with one model at a time, because the jobs of a sweep disturb
each other. It writes pascal3d.md beside this file.
"""

import sys
from typing import Any

import numpy as np
import torch

from benchmarks.pages import machine, publish
from benchmarks.sweeps import milliseconds_per_sample, read_runs, settings
from framework.reports.table import aggregate, markdown
from framework.training.batches import Batches

METHODS = ("fixed_kappa", "von_mises", "mixture", "cvae", "scvae")
COLUMNS = {
    "data": "class",
    "method": "method",
    "n": "seeds",
    "log_likelihood": "log-likelihood (nats)",
    "maad_deg": "MAAD °",
    "acc_pi_6": "Acc π/6",
    "mederr_deg": "MedErr °",
    "azimuth_entropy": "azimuth entropy (nats)",
    "mode_mass_min": "least mode mass",
    "uniform_gap": "gap to uniform (nats)",
    "milliseconds_per_sample": "ms / image",
    "parameters": "parameters",
}

PAIRS = (("scvae", "von_mises"),)
"""Pairs of methods that are also compared with each other, class by class."""
THESIS = {
    "fixed_kappa": "−0.07 ± 0.15, 0.81, 12.6",
    "von_mises": "1.17 ± 0.07, 0.84, 10.7",
    "scvae": "1.15 ± 0.07, 0.84, 12.2",
}
"""Last column of Table 3.3 in the thesis, on real PASCAL3D+."""


def class_mean_section(rows: list[dict[str, Any]]) -> str:
    """Return a table of the methods that were trained on every class.

    It shows the means over classes, and the differences from the method with fixed κ.
    """
    classes = sorted({row["data"] for row in rows})
    values_by_method: dict[str, np.ndarray] = {}
    for method in METHODS:
        rows_by_class = [
            [row for row in rows if (row["method"], row["data"]) == (method, name)] for name in classes
        ]
        if all(rows_by_class):
            keys = ("log_likelihood", "acc_pi_6", "mederr_deg")
            values_by_method[method] = np.array(
                [[np.mean([row[key] for row in class_rows]) for key in keys] for class_rows in rows_by_class]
            )
    lines = [
        f"## Mean of {len(classes)} classes",
        "",
        "This table holds the density heads that were trained on every class of objects. The numbers are means over "
        "classes. Brackets hold the mean difference from `fixed_kappa` on the same class, ± its standard error over "
        "classes.",
        "",
        "| method | log-likelihood (nats) | Acc π/6 | MedErr ° | thesis, real PASCAL3D+: the same three columns |",
        "|---|---:|---:|---:|---|",
    ]
    for method, values in values_by_method.items():
        cells = []
        for column, decimals in enumerate((2, 3, 1)):
            cell = f"{values[:, column].mean():.{decimals}f}"
            if method != "fixed_kappa" and "fixed_kappa" in values_by_method:
                gap = values[:, column] - values_by_method["fixed_kappa"][:, column]
                error = gap.std(ddof=1) / len(gap) ** 0.5
                cell += f" ({gap.mean():+.{decimals}f} ± {error:.{decimals}f})"
            cells.append(cell)
        lines.append(f"| {method} | {' | '.join(cells)} | {THESIS.get(method, '–')} |")
    for first, second in PAIRS:
        if first in values_by_method and second in values_by_method:
            gap = (values_by_method[first] - values_by_method[second])[:, 0]
            error = gap.std(ddof=1) / len(gap) ** 0.5
            lines += [
                "",
                f"The log-likelihood of `{first}` minus that of `{second}` is {gap.mean():+.2f} ± {error:.2f} nats; it "
                f"is above 0 in {(gap > 0).sum()} of {len(gap)} classes.",
            ]
    return "\n".join(lines)


def main() -> None:
    torch.set_num_threads(1)
    loaders: dict[str, Batches] = {}
    rows = []
    runs = read_runs(*sys.argv[1:])
    size, epochs, batch = settings(
        [folder for folder, _ in runs], "data.image_size", "trainer.max_epochs", "batch_size"
    )
    for folder, row in runs:
        name = row["data"].removeprefix("pascal3d ")
        rows.append(
            {**row, "data": name, "milliseconds_per_sample": milliseconds_per_sample(folder, loaders)}
        )
    rows.sort(key=lambda row: (row["data"], METHODS.index(row["method"]), row["seed"]))
    compared = aggregate(rows, by=["data", "method"])
    threads = " or ".join(
        f"{count} CPU thread{'s' * (count > 1)}" for count in sorted({row["threads"] for row in rows})
    )
    text = (
        "# Table 3.3: five density heads on synthetic PASCAL3D+\n\n"
        "This page repeats Table 3.3 of the thesis: networks predict the viewpoint of an object, that is its azimuth, "
        "elevation and tilt. The images are generated in the layout of PASCAL3D+. Five density heads are compared on "
        "the same encoder.\n\n"
        f"The input images are crops of objects, {size} × {size} pixels in size. The encoder is `biternion_vgg`, "
        f"trained for {epochs} epochs in batches of {batch}. The text at the top of `pascal3d.py` lists the commands "
        "that train the models. In the tables, ± is the standard deviation over seeds, or the standard error over "
        "the test set if there is one seed. The terms in the tables mean:\n"
        "- **Methods**: `fixed_kappa` is a von Mises density with one concentration κ for all images, and "
        "`von_mises` one with a predicted κ. `mixture` is a finite mixture of von Mises densities. `cvae` is a "
        "conditional variational autoencoder, and `scvae` its simplified form, whose latent variable does not "
        "depend on the image.\n"
        "- **MAAD** is the mean absolute angular deviation. **Acc π/6** is the share of predicted rotations less than "
        "30° from the true one. **MedErr** is the median angle between them.\n"
        "- **Azimuth entropy** is the mean entropy of the density of the azimuth, in nats.\n"
        "- **Least mode mass** is for `diningtable`, which looks the same after a rotation by 180° and so has two true "
        "azimuths. It is the smaller of the two probabilities within 45° of a true azimuth; 0.5 is best.\n"
        "- **Gap to uniform** is for `bottle`, which looks the same from every side. It is the difference between "
        "log 2π, the entropy of the uniform density, and the azimuth entropy; 0 is best.\n\n"
        f"{markdown(compared, COLUMNS)}\n\n{class_mean_section(rows)}\n\n"
        f"The tables of this page summarise {len(rows)} runs on {threads} each. "
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
