"""Compare the recommended start for tables with gradient boosting on five tables that come with scikit-learn.

    python -m benchmarks.tables.public run diabetes wine breast_cancer digits housing   # likewise one table at a time
    python -m benchmarks.tables.public page

`run` writes each table as a CSV file to outputs/tables, runs the command of docs/tables.md on it without any setting
but the seed of the split, and records the results in public_splits.csv. `page` writes public.md from them.
"""

import argparse
import shutil
import sys
from pathlib import Path
from typing import Any

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, publish, read_rows
from benchmarks.sweeps import read_runs
from benchmarks.tables.uci import with_error
from framework.reports.table import write_csv

SEEDS = 5
FOLDER = ROOT / "outputs" / "tables"
TABLE = Path(__file__).with_name("public_splits.csv")
TABLES = {
    "diabetes": ("regression", "real: progression of diabetes after a year, 442 patients, 10 columns"),
    "housing": (
        "regression",
        "synthetic: 3,000 rows, skewed columns, one column of words, noise that depends on them",
    ),
    "wine": ("classification", "real: 3 cultivars from 13 chemical measurements of 178 wines"),
    "breast_cancer": ("classification", "real: 2 classes of 569 tumours from 30 columns"),
    "digits": ("classification", "real: 1,797 images of 8 × 8 pixels, 10 classes"),
}


def write_table(name: str) -> Path:
    """Write a table as a CSV file with the target in the column `target`, and return the file."""
    import numpy as np
    import pandas as pd
    from sklearn import datasets

    if name == "housing":
        generator = np.random.default_rng(0)
        count = 3000
        frame = pd.DataFrame(
            {
                "income": generator.lognormal(1.2, 0.5, count),
                "rooms": generator.gamma(5, 1.0, count),
                "age": generator.integers(1, 53, count),
                "distance": generator.exponential(20, count),
                "kind": generator.choice(["flat", "house", "farm", "villa"], count, p=[0.5, 0.35, 0.1, 0.05]),
            }
        )
        effects = {"flat": 0.0, "house": 0.3, "farm": -0.2, "villa": 1.0}
        kind = np.array([effects[word] for word in frame["kind"]])
        level = (
            0.5 * np.log(frame["income"])
            + 0.1 * frame["rooms"]
            + kind
            - 0.3 * np.tanh(frame["distance"] / 15)
        )
        spread = 0.05 + 0.1 * frame["age"] / 52
        noise = generator.standard_t(4, count)
        frame["target"] = np.exp(level + spread * noise)
    else:
        loaded = getattr(datasets, f"load_{name}")(as_frame=True)
        frame = loaded.frame.copy()
        if TABLES[name][0] == "classification":
            frame["target"] = [str(loaded.target_names[label]) for label in frame["target"]]
    FOLDER.mkdir(parents=True, exist_ok=True)
    file = FOLDER / f"{name}.csv"
    frame.to_csv(file, index=False)
    return file


def run(name: str, jobs: int) -> None:
    """Run the recommended start on a table, fit gradient boosting to the same rows, and record both."""
    file, task = write_table(name), TABLES[name][0]
    folder = ROOT / "outputs" / "sweeps" / f"table_{name}"
    shutil.rmtree(folder, ignore_errors=True)
    seeds = ",".join(map(str, range(SEEDS)))
    command = [sys.executable, "-m", "framework", "-m", f"experiment=tabular/{task}", f"data.path={file}"]
    command += ["data.target=target", f"data.data_seed={seeds}", "logger=none", "pictures=false", "threads=1"]
    carry_out([*command, f"hydra.sweep.dir={folder}", f"hydra.launcher.jobs={jobs}"])
    rows = []
    for run, results in sorted(read_runs(folder), key=lambda run: int(run.folder.name)):
        seed = int(run.name)
        covered = results.get("coverage_90", results.get("set_coverage"))
        line = {"table": name, "method": "recommended start", "seed": seed, "covered": covered}
        rows.append({**line, "log_likelihood": results["log_likelihood"]})
        rows.append({"table": name, "method": "gradient boosting", "seed": seed, **boost(file, task, seed)})
    stored = read_rows(TABLE) if TABLE.exists() else []
    lines = [dict(row) for row in stored if row["table"] != name] + rows
    write_csv(lines, None, TABLE)


def boost(file: Path, task: str, seed: int) -> dict[str, Any]:
    """Return the log-likelihood of scikit-learn's gradient boosting on the test rows of a split."""
    import numpy as np
    import pandas as pd
    from scipy import stats
    from sklearn.ensemble import GradientBoostingClassifier, GradientBoostingRegressor
    from sklearn.model_selection import train_test_split

    from framework.configuration.schema import build, resolve

    kind = "real" if task == "regression" else "class"
    config = {"name": "tabular", "path": str(file), "target": "target", "kind": kind, "data_seed": seed}
    data = build("data", resolve("data", config))
    data.prepare()
    frame = pd.read_csv(file)
    inputs = pd.get_dummies(frame.drop(columns="target")).to_numpy(float)
    target = frame["target"].to_numpy()
    train, validation, test = (
        np.array([int(part[index]["line"]) - 2 for index in range(len(part))])
        for part in data.splits()
        if part
    )
    rows = np.concatenate([train, validation])
    if task == "classification":
        model = GradientBoostingClassifier(random_state=0).fit(inputs[rows], target[rows])
        labels = [str(label) for label in np.unique(target[rows])]
        chosen = [labels.index(str(label)) for label in target[test]]
        probability = model.predict_proba(inputs[test])[np.arange(len(test)), chosen]
        return {"log_likelihood": float(np.log(probability.clip(1e-300)).mean())}
    own, held_out = train_test_split(rows, test_size=0.1, random_state=0)
    model = GradientBoostingRegressor(random_state=0).fit(inputs[own], target[own])
    deviation = np.sqrt(np.square(target[held_out] - model.predict(inputs[held_out])).mean())
    log_prob, below = (
        function(target[test], model.predict(inputs[test]), deviation)
        for function in (stats.norm.logpdf, stats.norm.cdf)
    )
    covered = float(((below > 0.05) & (below < 0.95)).mean())
    return {"log_likelihood": float(log_prob.mean()), "covered": covered}


def page() -> None:
    """Write the page from the recorded results."""
    rows: list[Any] = read_rows(TABLE)
    lines = [
        "# Five public tables without any setting",
        "",
        "This page compares the recommended start for tables with gradient boosting of scikit-learn in its default "
        "settings. The recommended start is `python -m framework experiment=tabular/regression` or "
        "`experiment=tabular/classification`, to which only the path of a CSV file and the name of a column are given. "
        "Both see the same rows.",
        "",
        "Log-likelihoods are means over the test rows (15 % of a table), in nats and in the unit of the target; higher "
        f"is better. The table gives their mean over {SEEDS} random splits, with its standard error. The difference is "
        "the result of the recommended start minus that of gradient boosting on the same split. For real targets, the "
        "density of gradient boosting is a normal density around the predicted number, whose standard deviation is "
        "that of the residuals on a tenth of the training rows.",
        "",
        "| table | data | recommended start | gradient boosting | difference | splits won |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for name, (_, about) in TABLES.items():
        ours, other = (
            {
                row["seed"]: row["log_likelihood"]
                for row in rows
                if (row["table"], row["method"]) == (name, method)
            }
            for method in ("recommended start", "gradient boosting")
        )
        if not ours:
            lines.append(f"| {name} | {about} |{' not measured |' * 4}")
            continue
        gaps = [ours[seed] - other[seed] for seed in ours]
        cells = [with_error(list(part)) for part in (ours.values(), other.values(), gaps)]
        lines.append(
            f"| {name} | {about} | {' | '.join(cells)} | {sum(gap > 0 for gap in gaps)} of {len(gaps)} |"
        )
    lines += [
        "",
        "For classes, the recommended start fits a temperature to training rows that its models left out. A prior "
        "keeps the temperature near 1 where the classes of few rows are perfectly separable.",
    ]
    command = "Command: the two lines at the top of `benchmarks/tables/public.py`."
    publish(__file__, "\n".join([*lines, "", f"{machine('torch', 'scikit-learn')} {command}", ""]))


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare the start for tables with gradient boosting.")
    parser.add_argument("step", choices=("run", "page"))
    parser.add_argument("tables", nargs="*", help=f"some of {', '.join(TABLES)}")
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    options = parser.parse_args()
    for name in options.tables:
        run(name, options.jobs)
    if options.step == "page":
        page()


if __name__ == "__main__":
    main()
