"""Report predictions of the angle of real objects on a turntable, for views between the training views.

    python -m framework -m experiment=coil20/von_mises,coil20/mixture data.root=/path/to/COIL20 seed=0,1,2 threads=1 \\
        hydra.sweep.dir=outputs/sweeps/coil20
    python -m benchmarks.densities.coil20 outputs/sweeps/coil20

Writes coil20.md into the folder of this file.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from benchmarks.pages import machine, publish
from benchmarks.sweeps import read_runs
from framework.reports.table import aggregate, markdown

COLUMNS = {
    "objects": "objects",
    "method": "density head",
    "n": "seeds",
    "log_likelihood": "log-likelihood (nats)",
    "maad_deg": "MAAD (degrees)",
    "median_deviation_deg": "median deviation (degrees)",
    "milliseconds_per_sample": "ms per image",
    "parameters": "parameters",
}


def main() -> None:
    rows = []
    for _, results in read_runs(sys.argv[1]):
        shared_keys = ("method", "seed", "synthetic", "milliseconds_per_sample", "parameters")
        shared = {key: results[key] for key in shared_keys}
        for objects, numbers in {"all": results, **results["groups"]}.items():
            columns = {key: value for key, value in numbers.items() if key in COLUMNS or key.endswith("_sem")}
            rows.append({**shared, **columns, "objects": objects})
    order = ("all", "unique", "look-alikes")
    rows.sort(key=lambda row: (order.index(row["objects"]), row["method"] != "von_mises", row["seed"]))
    compared = aggregate(rows, by=["objects", "method"])
    sentence = winners([row for row in rows if row["objects"] == "all"])
    text = (
        "# COIL-20: real views between the training views\n\n"
        "This page shows how accurately the azimuth of real objects on a turntable is predicted from images that lie "
        "between the training views. It compares a single von Mises density (`von_mises`) with a mixture of von Mises "
        "densities (`mixture`).\n\n"
        "The data set COIL-20 has 20 objects. Each object has 18 training views, one every 20°, and 36 test views, "
        "which are 5° from the nearest training view. Images have 32 × 32 pixels. The encoder is `biternion_vgg`, "
        "trained for 200 epochs on views that a periodic cubic spline interpolates between the training views. The "
        "text at the top of `coil20.py` lists the commands that train the models.\n\n"
        "Results are also given for two groups of objects of COIL-20. `look-alikes` are the 8 objects that look "
        "alike from opposite sides: their training views 180° apart are on average more similar than neighbouring "
        "training views (`plugins/data/coil20`). `unique` are the other 12 objects.\n\n"
        "Each row of the table is the mean result of a density head over seeds, and ± is the standard deviation over "
        "seeds. The log-likelihood of the azimuth, in nats, is a mean over the test views; higher is better. MAAD is "
        "the mean absolute angular deviation of the point prediction, and the median deviation is the median of the "
        "same deviations. The time per image is the time of a prediction in a batch. The last column is the number "
        "of parameters of the model.\n\n"
        f"{markdown(compared, COLUMNS)}\n\n{sentence}\n\n{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


def winners(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the sentence that says which density head has the highest log-likelihood at which run time."""
    best, parts = -math.inf, []
    results = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        results.append(
            (
                *(mean(row[key] for row in own) for key in ("milliseconds_per_sample", "log_likelihood")),
                method,
            )
        )
    for duration, value, method in sorted(results):
        if value > best:
            best = value
            parts.append(f"{duration:.1g} ms, `{method}` ({value:.2f} nats)")
    return (
        "**Which head wins at which run time:** if a prediction may take at least the following time per image, the "
        f"head with the highest log-likelihood over all objects is: {'; '.join(parts)}."
    )


if __name__ == "__main__":
    main()
