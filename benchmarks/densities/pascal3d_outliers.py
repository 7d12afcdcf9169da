"""Compare how well uncertainty wrappers on viewpoints recognise objects of another class (synthetic).

    python -m framework -m trainer.max_epochs=20 threads=1 hydra.sweep.dir=outputs/sweeps/outliers \\
        experiment=pascal3d_outliers/plain,...   (all of conf/experiment/pascal3d_outliers but base)
    (and once more experiment=pascal3d_outliers/outlier_exposure objective.outlier_exposure.weight=1)
    python -m benchmarks.densities.pascal3d_outliers outputs/sweeps/outliers

Writes pascal3d_outliers.md beside this file.
"""

import json
import sys
from pathlib import Path

import yaml

from benchmarks.pages import machine, write_page
from framework.reports.table import markdown

COLUMNS = {
    "method": "method",
    "log_likelihood": "log-likelihood (nats)",
    "maad_deg": "MAAD °",
    "coverage_90": "coverage of 90 % regions",
    "entropy_test": "entropy, cars (nats)",
    "ood_entropy": "entropy, bottles (nats)",
    "auroc": "AUROC",
    "fpr95": "FPR95",
    "milliseconds_per_sample": "ms / image",
}


def main() -> None:
    rows = []
    for path in sorted(Path(sys.argv[1]).glob("*/results.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        kept = {key: value for key, value in found.items() if key.removesuffix("_sem") in COLUMNS}
        config = yaml.safe_load((path.parent / "config.yaml").read_text(encoding="utf-8"))
        weight = (config.get("objective") or {}).get("outlier_exposure", {}).get("weight")
        if weight is not None:
            kept["method"] = f"outlier_exposure, λ = {weight:g}"
        rows.append({**kept, "synthetic": found["synthetic"]})
    text = (
        "# Viewpoints of cars, with bottles as outliers (synthetic data)\n\n"
        "Mixtures of von Mises densities, `biternion_vgg`, 20 epochs, one seed: small differences mean nothing. "
        "Trained on cars; outliers of the test are bottles, those of `outlier_exposure`'s training sofas. AUROC by the "
        "entropy of the joint density of three angles. ± is the standard error over test images. Commands in "
        "`pascal3d_outliers.py`.\n\n"
        f"{markdown(rows, COLUMNS, better={'log_likelihood': 'higher', 'auroc': 'higher', 'fpr95': 'lower'})}\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
