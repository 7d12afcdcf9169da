"""Make Table 3.3: five density heads on the classes of a generated PASCAL3D+ (synthetic).

    python -m reproduction.thesis_tables 3.3

Or of sweeps that have run: `python -m reproduction.chapter3.pascal3d <their folders>`.

The run time of one prediction is measured again by this script, every model alone on the machine: in a sweep the jobs
disturb each other. Writes pascal3d.md beside this file.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import machine, write_page
from benchmarks.sweeps import milliseconds_per_sample, settings
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
    "azimuth_entropy": "azimuth entropy",
    "mode_mass_min": "least mode mass",
    "uniform_gap": "gap to uniform",
    "milliseconds_per_sample": "ms / image",
    "parameters": "parameters",
}

PAIRS = (("scvae", "von_mises"),)
"""Compared too, class by class."""
THESIS = {
    "fixed_kappa": "−0.07 ± 0.15, 0.81, 12.6",
    "von_mises": "1.17 ± 0.07, 0.84, 10.7",
    "scvae": "1.15 ± 0.07, 0.84, 12.2",
}
"""Table 3.3's last column, of its own data."""


def over_classes(rows: list[dict[str, Any]]) -> str:
    """Of each method that was trained on every class: the mean of the classes, each the mean of its seeds, and its
    standard error over classes of the difference from the fixed concentration."""
    classes = sorted({row["data"] for row in rows})
    found: dict[str, np.ndarray] = {}
    for method in METHODS:
        own = [[row for row in rows if (row["method"], row["data"]) == (method, name)] for name in classes]
        if all(own):
            keys = ("log_likelihood", "acc_pi_6", "mederr_deg")
            found[method] = np.array([[np.mean([row[key] for row in some]) for key in keys] for some in own])
    lines = [
        f"## Mean of {len(classes)} classes",
        "",
        "In brackets the difference from fixed_kappa, class by class, ± its standard error over classes.",
        "",
        "| method | log-likelihood (nats) | Acc π/6 | MedErr ° | thesis: the same of its own data |",
        "|---|---:|---:|---:|---|",
    ]
    for method, values in found.items():
        cells = []
        for place, figures in enumerate((2, 3, 1)):
            cell = f"{values[:, place].mean():.{figures}f}"
            if method != "fixed_kappa" and "fixed_kappa" in found:
                gap = values[:, place] - found["fixed_kappa"][:, place]
                error = gap.std(ddof=1) / len(gap) ** 0.5
                cell += f" ({gap.mean():+.{figures}f} ± {error:.{figures}f})"
            cells.append(cell)
        lines.append(f"| {method} | {' | '.join(cells)} | {THESIS.get(method, '–')} |")
    for one, other in PAIRS:
        if one in found and other in found:
            gap = (found[one] - found[other])[:, 0]
            error = gap.std(ddof=1) / len(gap) ** 0.5
            lines += [
                "",
                f"{one} − {other}: {gap.mean():+.2f} ± {error:.2f} nats, above 0 in {(gap > 0).sum()} classes.",
            ]
    return "\n".join(lines)


def main() -> None:
    torch.set_num_threads(1)
    loaders: dict[str, Batches] = {}
    rows = []
    paths = [path for folder in sys.argv[1:] for path in Path(folder).glob("*/results.json")]
    size, epochs, batch = settings(
        [path.parent for path in paths], "data.image_size", "trainer.max_epochs", "batch_size"
    )
    for path in paths:
        row = json.loads(path.read_text(encoding="utf-8"))
        name = row["data"].removeprefix("pascal3d ")
        rows.append(
            {**row, "data": name, "milliseconds_per_sample": milliseconds_per_sample(path.parent, loaders)}
        )
    rows.sort(key=lambda row: (row["data"], METHODS.index(row["method"]), row["seed"]))
    compared = aggregate(rows, by=["data", "method"])
    threads = " or ".join(
        f"{count} CPU thread{'s' * (count > 1)}" for count in sorted({row["threads"] for row in rows})
    )
    text = (
        "# Table 3.3: five density heads on synthetic PASCAL3D+\n\n"
        f"Generated objects in crops of {size} pixels, `biternion_vgg`, {epochs} epochs, batches of {batch}; the "
        "commands are in `pascal3d.py`. ± is the standard deviation over seeds, or the standard error over the test "
        "set where there is one seed. `diningtable` looks the same after a rotation by 180°: its column is the least "
        "probability that a density gives to one of the two true azimuths, within 45°. `bottle` looks the same from "
        "everywhere: its column is the gap between its azimuth entropy and log 2π.\n\n"
        f"{markdown(compared, COLUMNS)}\n\n{over_classes(rows)}\n\n"
        f"{len(rows)} runs, {threads} each. {machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
