"""Compare one network, an ensemble, and one network that learns from the ensemble (objective=distillation).

    python -m benchmarks.densities.distillation train /path/to/uci   # trains all models
    python -m benchmarks.densities.distillation page                 # writes distillation.md

`/path/to/uci` holds the files of `plugins/data/tabular` (data=uci). `train` writes its runs to
outputs/sweeps/distillation, leaves out models that are trained already, and records results in distillation_runs.csv.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, publish, read_rows
from framework.reports.table import write_csv

RUNS = (0, 1, 2)
"""Seeds of the moons, and standard splits of the table."""
FOLDER = ROOT / "outputs" / "sweeps" / "distillation"
TABLE = Path(__file__).with_name("distillation_runs.csv")
TEACHER, STUDENT, NOISY, NOISIER = "ensemble", "student", "student, noisy inputs", "student, noisier inputs"
MOONS = {
    "one network": ["experiment=moons/vanilla_512"],
    TEACHER: ["experiment=moons/ensemble"],
    STUDENT: ["experiment=moons/vanilla_512", "objective=[distillation]"],
    NOISY: [
        "experiment=moons/vanilla_512",
        "objective=[distillation]",
        "objective.distillation.noise=0.5",
    ],
}
ALONE = [
    "experiment=uci/folds",
    "uncertainty=[]",
    "trainer.max_epochs=150",
    "trainer.patience=null",
    "optimizer.schedule=cosine",
]
CONCRETE = {
    "one network": ALONE,
    TEACHER: ["experiment=uci/folds", "uncertainty.folds.sharpen=false"],
    STUDENT: [*ALONE, "objective=[distillation]"],
    NOISY: [*ALONE, "objective=[distillation]", "objective.distillation.noise=0.1"],
    NOISIER: [*ALONE, "objective=[distillation]", "objective.distillation.noise=0.5"],
}
SETS: dict[str, dict[str, list[str]]] = {"moons": MOONS, "concrete": CONCRETE}
"""Overrides of the framework's command for each method, by set."""
METRICS = {
    "moons": {"nll": "NLL ↓", "brier": "Brier ↓", "accuracy": "accuracy ↑", "ece": "ECE ↓"},
    "concrete": {"log_likelihood": "log-likelihood ↑", "rmse": "RMSE ↓", "coverage_90": "90 % region covers"},
}
LOWER = ("nll", "log_likelihood")
COSTS = {"parameters": "parameters", "flops_per_sample": "FLOPs", "milliseconds_per_sample": "µs"}
HEADINGS = {"moons": "Moons (synthetic)", "concrete": "Concrete (real, UCI)"}


def train(root: Path) -> None:
    """Train all models that are not trained yet, each as one command on one thread, and record the results."""
    for run in RUNS:
        for name, methods in SETS.items():
            for method, overrides in methods.items():
                folder = place(name, method, run)
                if (folder / "results.json").exists():
                    continue
                data = [f"seed={run}"] if name == "moons" else [f"data.root={root}", f"data.split={run}"]
                teacher = place(name, TEACHER, run)
                extra = [f"objective.distillation.teacher={teacher}"] * (method in (STUDENT, NOISY, NOISIER))
                common = ["logger=none", "pictures=false", "threads=1", f"hydra.run.dir={folder}"]
                carry_out([sys.executable, "-m", "framework", *overrides, *data, *extra, *common])
                record()
    record()


def place(name: str, method: str, run: int) -> Path:
    """Return the run folder of a model."""
    return FOLDER / f"{name}_{method.replace(', ', '_').replace(' ', '_')}_{run}"


def record() -> None:
    """Write the results of all models that are trained into the table."""
    rows = []
    for name, methods in SETS.items():
        for method in methods:
            for run in RUNS:
                path = place(name, method, run) / "results.json"
                if path.exists():
                    results = json.loads(path.read_text(encoding="utf-8"))
                    keys = (*METRICS[name], *COSTS)
                    rows.append(
                        {"set": name, "method": method, "run": run, **{key: results[key] for key in keys}}
                    )
    write_csv(rows, None, TABLE)


def page() -> None:
    """Write the page from the recorded results."""
    rows: list[dict[str, Any]] = read_rows(TABLE)
    lines = [
        "# Distillation of an ensemble into one network",
        "",
        "This page compares one network, an ensemble, and students: single networks of the same size that were trained "
        "with `objective=[distillation]`, whose teacher is the ensemble. The divergence from the teacher has nine "
        "tenths of the weight in the student's loss (the default), and the loss on the targets has one tenth. Some "
        "students learn from the teacher at inputs with added normal noise.",
        "",
        "A student costs a tenth of the ensemble's FLOPs, as one network does. On neither data set is its "
        "log-likelihood distinguishable from that of one network trained on the targets alone. On the moons the "
        "ensemble itself is not significantly better than one network either. On concrete, the students have a lower "
        "mean log-likelihood than the ensemble. If they learn from the teacher at noisy inputs, their 90 % regions "
        "cover more of the test rows than without noise.",
        "",
        f"All numbers are means over {len(RUNS)} runs, and ± is the standard deviation over the runs. A difference is "
        "that of a method minus one network, paired by run, with its standard error. No setting was tuned, but the "
        "rows with the noise 0.5 on concrete (noisier inputs) were added after the results of the other rows were "
        "known.",
        "",
        "**Which method wins at which run time.** Each line of the list is for one data set. It names the methods in "
        "the order of their run time per row, from the fastest on. A method is named only if its log-likelihood is "
        "higher than that of every faster method by more than two standard errors of the difference, paired by run. "
        "The log-likelihood is in brackets. [uncertainty](../tables/uncertainty.md) compares a student with all other "
        "wrappers.",
        "",
        *(
            f"- {HEADINGS[name]}: {winners(name, [row for row in rows if row['set'] == name])}."
            for name in SETS
        ),
    ]
    texts = {
        "moons": "The seed of a run also determines its data. The network has two layers of 512 units "
        "(`experiment=moons/vanilla_512`), and the ensemble consists of ten such networks "
        "(`experiment=moons/ensemble`). The noise on the inputs has a standard deviation of 0.5.",
        "concrete": "Each run has one of the first three standard splits. The ensemble is the recommended start for "
        "tables (`experiment=uci/folds uncertainty.folds.sharpen=false`, ten networks with two layers of 128 units, "
        "which train on the validation rows too). One network and the students have the same layers and head, and "
        "train for 150 epochs with a cosine schedule. Log-likelihoods are in nats and in the unit of the target. The "
        "noise on the standardised inputs has a standard deviation of 0.1 (noisy inputs) or 0.5 (noisier inputs).",
    }
    for name in SETS:
        own = [row for row in rows if row["set"] == name]
        if own:
            lines += ["", f"## {HEADINGS[name]}", "", texts[name], "", *table(name, own)]
    lines += [
        "",
        "µs is the time of a prediction for one row, in a batch, on one thread, as the runs measured it. Other "
        "programs used the machine at the same time.",
        "",
        f"{machine('torch')} Commands: the lines at the top of `benchmarks/densities/distillation.py`.",
        "",
    ]
    publish(__file__, "\n".join(lines))


def table(name: str, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the lines of the table of a set."""
    metrics, key = METRICS[name], next(metric for metric in METRICS[name] if metric in LOWER)
    titles = ["method", *metrics.values(), f"difference in {metrics[key][:-2]}", *COSTS.values()]
    lines = [f"| {' | '.join(titles)} |", f"|---|{'---:|' * (len(titles) - 1)}"]
    reference = {row["run"]: row[key] for row in rows if row["method"] == "one network"}
    for method in SETS[name]:
        own = [row for row in rows if row["method"] == method]
        if not own:
            continue
        cells = [spread([row[metric] for row in own]) for metric in metrics]
        pairs = [row[key] - reference[row["run"]] for row in own if row["run"] in reference]
        paired = f"{mean(pairs):+.3f} ± {stdev(pairs) / len(pairs) ** 0.5:.3f}" if len(pairs) > 1 else ""
        cells.append("" if method == "one network" else paired)
        cells += [f"{mean(row[cost] for row in own):,.0f}" for cost in ("parameters", "flops_per_sample")]
        cells.append(f"{1000 * mean(row['milliseconds_per_sample'] for row in own):.3g}")
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return lines


def winners(name: str, rows: Sequence[dict[str, Any]]) -> str:
    """Return the methods that are better than every faster one, from the fastest on, with their log-likelihoods."""

    def values(method: str) -> list[float]:
        own = sorted((row for row in rows if row["method"] == method), key=lambda row: row["run"])
        return [row["log_likelihood"] if "log_likelihood" in row else -row["nll"] for row in own]

    costs = {
        method: mean(1000 * row["milliseconds_per_sample"] for row in rows if row["method"] == method)
        for method in SETS[name]
    }
    ranked = sorted(costs, key=lambda method: costs[method])
    named = ranked[:1]
    for method in ranked[1:]:
        gains = [own - best for own, best in zip(values(method), values(named[-1]), strict=True)]
        if mean(gains) > 2 * stdev(gains) / len(gains) ** 0.5:
            named.append(method)
    return ", ".join(
        f"from {costs[method]:.3g} µs {method} ({mean(values(method)):.3f} nats)" for method in named
    )


def spread(values: Sequence[float]) -> str:
    """Return the mean and the standard deviation."""
    return f"{mean(values):.3f} ± {stdev(values):.3f}" if len(values) > 1 else f"{values[0]:.3f}"


def main() -> None:
    """Run the step that the command line names."""
    parser = argparse.ArgumentParser(description="Compare one network, an ensemble and distilled students.")
    parser.add_argument("step", choices=("train", "page"))
    parser.add_argument("root", type=Path, nargs="?", help="folder of the UCI tables")
    options = parser.parse_args()
    if options.step == "page":
        page()
    elif options.root is None:
        parser.error("train needs the folder of the UCI tables")
    else:
        train(options.root)


if __name__ == "__main__":
    main()
