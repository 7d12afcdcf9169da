"""Compare how well uncertainty methods for viewpoints recognise objects of another class (synthetic data).

    python -m framework -m trainer.max_epochs=20 threads=1 hydra.sweep.dir=outputs/sweeps/outliers \\
        experiment=pascal3d_outliers/plain,...   (every file of conf/experiment/pascal3d_outliers except base)
    (then the same with experiment=pascal3d_outliers/outlier_exposure objective.outlier_exposure.weight=1)
    python -m benchmarks.densities.pascal3d_outliers outputs/sweeps/outliers

Writes pascal3d_outliers.md into the folder of this file.
"""

import sys

from benchmarks.pages import machine, publish
from benchmarks.sweeps import read_runs
from framework.reports.table import markdown

COLUMNS = {
    "method": "method",
    "log_likelihood": "log-likelihood (nats)",
    "maad_deg": "MAAD (degrees)",
    "coverage_90": "coverage of 90 % regions",
    "entropy_test": "entropy, cars (nats)",
    "ood_entropy": "entropy, bottles (nats)",
    "auroc": "AUROC",
    "fpr95": "FPR95",
    "milliseconds_per_sample": "ms per image",
}


def main() -> None:
    rows = []
    for run in read_runs(sys.argv[1]):
        results = run.results
        columns = {key: value for key, value in results.items() if key.removesuffix("_sem") in COLUMNS}
        weight = (run.config().get("objective") or {}).get("outlier_exposure", {}).get("weight")
        if weight is not None:
            columns["method"] = f"outlier_exposure, λ = {weight:g}"
        rows.append({**columns, "synthetic": results["synthetic"]})
    text = (
        "# Viewpoints of cars, with bottles as outliers (synthetic data)\n\n"
        "This page compares how well different uncertainty methods recognise objects of a class that training did not "
        "show. The models predict the viewpoint (three angles) of cars in rendered images. In the test, images of "
        "bottles are the outliers.\n\n"
        "All models predict mixtures of von Mises densities with the encoder `biternion_vgg`. They were trained on "
        "cars for 20 epochs with one seed, so that small differences between rows have no meaning. `plain` has no "
        "uncertainty method. `outlier_exposure` is trained with images of sofas as outliers, and λ is the weight of "
        "its penalty. The text at the top of `pascal3d_outliers.py` lists the commands that train the models.\n\n"
        "The columns of the table are as follows; ± is the standard error over the test images:\n"
        "- log-likelihood: mean log-likelihood of the true viewpoints of the cars; higher is better;\n"
        "- MAAD: mean absolute angular deviation of the point predictions for cars;\n"
        "- coverage of 90 % regions: share of cars whose viewpoint lies in the predicted region of 90 % probability; "
        "0.9 is best;\n"
        "- entropy: mean entropy of the joint density of the three angles, for cars and for bottles;\n"
        "- AUROC: probability that a bottle has a higher entropy than a car; 1 is best;\n"
        "- FPR95: share of cars above the entropy threshold that detects 95 % of the bottles; 0 is best;\n"
        "- ms per image: time of a prediction in a batch.\n\n"
        f"{markdown(rows, COLUMNS, better={'log_likelihood': 'higher', 'auroc': 'higher', 'fpr95': 'lower'})}\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
