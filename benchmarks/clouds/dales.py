"""Report the five-fold cross-validation of BPS-MLP on objects of airborne laser scans (DALES, real data).

    python -m framework -m experiment=dales/bps_mlp data.root=/path/to/dales500.npz data.fold=0,1,2,3,4 \\
        pictures=false logger=none hydra.sweep.dir=outputs/sweeps/dales
    python -m benchmarks.clouds.dales outputs/sweeps/dales

Writes dales.md into the folder of this file.
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml

from benchmarks.pages import machine, publish
from framework.reports.table import markdown

COLUMNS = {"fold": "fold", "accuracy": "accuracy", "nll": "NLL (nats)", "ece": "ECE"}


def main() -> None:
    rows = []
    for path in sorted(Path(sys.argv[1]).glob("*/results.json")):
        numbers = json.loads(path.read_text(encoding="utf-8"))
        config = yaml.safe_load((path.parent / "config.yaml").read_text(encoding="utf-8"))
        columns = {key: value for key, value in numbers.items() if key.removesuffix("_sem") in COLUMNS}
        rows.append({"fold": str(config["data"]["fold"]), **columns})
    accuracy = np.array([row["accuracy"] for row in rows])
    text = (
        "# Objects of airborne laser scans (DALES, real data)\n\n"
        "This page shows how accurately real objects from airborne laser scans are classified. The model encodes the "
        "point cloud of an object by its distances from 512 basis points and has two hidden layers of 400 units "
        "(BPS-MLP). The data set has 499 objects of five classes, with 101 to 28,100 points per object. It is divided "
        f"into {len(rows)} folds, and each fold is the test split of one run. **The mean accuracy over the folds is "
        f"{accuracy.mean():.4f}** (standard deviation over folds {accuracy.std(ddof=1):.4f}). The text at the top "
        "of `dales.py` lists the commands that train the models.\n\n"
        "Each row of the table is the result of BPS-MLP on one test split (fold) of DALES. Accuracy is the share of "
        "objects that are classified correctly. NLL is the mean negative log-likelihood of the true class; lower is "
        "better. ECE is the expected calibration error; 0 is best. ± is the standard error over the test objects of "
        "a fold.\n\n"
        f"{markdown(rows, COLUMNS)}\n\n{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
