"""Classify objects of airborne laser scans (DALES, real data): five-fold cross-validation of BPS-MLP.

    python -m framework -m experiment=dales/bps_mlp data.root=/path/to/dales500.npz data.fold=0,1,2,3,4 \\
        pictures=false logger=none hydra.sweep.dir=outputs/sweeps/dales
    python -m benchmarks.clouds.dales outputs/sweeps/dales

Writes dales.md beside this file.
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml

from benchmarks.pages import machine, write_page
from framework.reports.table import markdown

COLUMNS = {"fold": "fold", "accuracy": "accuracy", "nll": "NLL (nats)", "ece": "ECE"}


def main() -> None:
    rows = []
    for path in sorted(Path(sys.argv[1]).glob("*/results.json")):
        numbers = json.loads(path.read_text(encoding="utf-8"))
        config = yaml.safe_load((path.parent / "config.yaml").read_text(encoding="utf-8"))
        kept = {key: value for key, value in numbers.items() if key.removesuffix("_sem") in COLUMNS}
        rows.append({"fold": str(config["data"]["fold"]), **kept})
    accuracy = np.array([row["accuracy"] for row in rows])
    text = (
        "# Objects of airborne laser scans (DALES, real data)\n\n"
        f"BPS-MLP: 512 distances, two layers of 400 units, {len(rows)} folds of 499 objects of five classes, 101 to "
        f"28,100 points each. **Mean accuracy {accuracy.mean():.4f}** (standard deviation over folds "
        f"{accuracy.std(ddof=1):.4f}). ± is the standard error over the objects of a fold. Commands in `dales.py`.\n\n"
        f"{markdown(rows, COLUMNS)}\n\n{machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
