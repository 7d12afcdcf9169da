"""Predict angles of real objects on a turntable, trained on views every 20° and tested in between.

    python -m framework -m experiment=coil20/von_mises,coil20/mixture data.root=/path/to/COIL20 seed=0,1,2 threads=1 \\
        hydra.sweep.dir=outputs/sweeps/coil20
    python -m benchmarks.densities.coil20 outputs/sweeps/coil20

Writes coil20.md beside this file.
"""

import json
import sys
from pathlib import Path

from benchmarks.pages import machine, write_page
from framework.reports.table import aggregate, markdown

COLUMNS = {
    "objects": "objects",
    "method": "method",
    "n": "seeds",
    "log_likelihood": "log-likelihood (nats)",
    "maad_deg": "MAAD °",
    "median_deviation_deg": "median °",
    "milliseconds_per_sample": "ms / image",
    "parameters": "parameters",
}


def main() -> None:
    rows = []
    for path in sorted(Path(sys.argv[1]).glob("*/results.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        cost = {key: found[key] for key in ("milliseconds_per_sample", "parameters")}
        same = {"method": found["method"], "seed": found["seed"], "synthetic": found["synthetic"], **cost}
        for objects, numbers in {"all": found, **found["groups"]}.items():
            kept = {key: value for key, value in numbers.items() if key in COLUMNS or key.endswith("_sem")}
            rows.append({**same, **kept, "objects": objects})
    order = ("all", "unique", "look-alikes")
    rows.sort(key=lambda row: (order.index(row["objects"]), row["method"] != "von_mises", row["seed"]))
    compared = aggregate(rows, by=["objects", "method"])
    text = (
        "# COIL-20: real views between the training views\n\n"
        "20 objects, 18 training views each (every 20°), 36 test views each, 5° from the nearest learnt one; "
        "32 × 32 pixels, `biternion_vgg`, 200 epochs on views interpolated by a periodic cubic spline. ± is the "
        "standard deviation over seeds. `look-alikes` are the 8 objects whose training views half a turn apart are "
        "nearer to one another than neighbouring ones are (`plugins/data/coil20`). Commands in `coil20.py`.\n\n"
        f"{markdown(compared, COLUMNS)}\n\n{machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
