"""Compare errors and run times of whole runs of the main job, `experiment=pascal3d/scvae`, over seeds.

    python -m benchmarks.framework.main_job_seeds --seeds 0,1,2

Each seed is run in float32 and in bfloat16, with this version of the framework and with an older one. A run takes one
to four minutes. The script also runs beside other work: that changes the times, but not the errors. Each run is written
to main_job_seeds.csv as soon as it ends, and runs that the table already contains are not repeated.
"""

import argparse
import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.framework.main_job import BEFORE, run_command, source
from benchmarks.pages import machine, publish, read_rows
from benchmarks.timing import cores_used_by_others, median_and_range
from framework.reports.table import write_csv

TABLE = Path(__file__).with_suffix(".csv")
RUNS = tuple(
    (version, precision) for version in ("before", "after") for precision in ("32-true", "bf16-mixed")
)
"""Versions of the framework and their precisions, in the order of the runs of a seed."""
ERRORS = {"log_likelihood": "log-likelihood, nats", "maad_deg": "MAAD, °"}
TIMES = {"wall": "wall time, s", "processor": "processor time, s"}
KEY = ("version", "precision", "seed")
Row = dict[str, Any]


def measure(version: str, precision: str, seed: int, commit: str) -> Row:
    """Run the main job once, without figures and without a tracking store; `commit` is the older version."""
    settings = [
        "experiment=pascal3d/scvae",
        f"seed={seed}",
        f"trainer.precision={precision}",
        "pictures=false",
        "logger=none",
    ]
    others = cores_used_by_others()
    with source(commit if version == "before" else None) as tree:
        done = run_command(tree, settings)
    errors = {key: done.results[key] for name in ERRORS for key in (name, f"{name}_sem")}
    key = {"version": version, "precision": precision, "seed": seed}
    return key | errors | {"wall": done.wall, "processor": done.processor, "others": others}


def paired(rows: Sequence[Row], first: tuple[str, str], second: tuple[str, str], error: str) -> list[float]:
    """Return the error of the second kind of run minus that of the first, for each seed that both have."""
    by_run = {tuple(row[name] for name in KEY): row[error] for row in rows}
    seeds = [seed for version, precision, seed in by_run if (version, precision) == first]
    pairs = [(by_run[*first, seed], by_run.get((*second, seed))) for seed in seeds]
    return [after - before for before, after in pairs if after is not None]


def mean_and_error(numbers: Sequence[float]) -> str:
    """Return the mean and, for several numbers, its standard error as text."""
    if len(numbers) == 1:
        return f"{numbers[0]:.3f}"
    return f"{statistics.mean(numbers):.3f} ± {statistics.stdev(numbers) / math.sqrt(len(numbers)):.3f}"


def page(rows: Sequence[Row], commit: str) -> str:
    """Return the text of the page; `commit` is the older version."""
    titles = " | ".join((*ERRORS.values(), *TIMES.values()))
    lines = [
        "# The main job in float32 and bfloat16: errors and run times of whole runs over seeds",
        "",
        "The main job is `python -m framework experiment=pascal3d/scvae`. Here it runs with all its 30 epochs on its "
        "generated images (synthetic), for each seed with `trainer.precision=32-true` and with "
        "`trainer.precision=bf16-mixed`. "
        f"`before` is the version of commit `{commit}`, and `after` is the version at the date of this page. Both use "
        "all cores. The runs draw no figures and use no tracking store (`pictures=false logger=none`). Errors are "
        "those of the 381 test images.",
        "",
        "Errors are means over the seeds with their standard errors. Times are those of the whole command with all its "
        "processes: the median over the seeds (least to largest).",
        "",
        f"| version | precision | seeds | {titles} |",
        f"|---|---|---:|{'---:|' * (len(ERRORS) + len(TIMES))}",
    ]
    for run in RUNS:
        group = [row for row in rows if (row["version"], row["precision"]) == run]
        cells = [mean_and_error([row[name] for row in group]) for name in ERRORS]
        cells += [median_and_range([row[name] for row in group]) for name in TIMES]
        lines.append(f"| {' | '.join(run)} | {len(group)} | {' | '.join(cells)} |")
    lines += [
        "",
        "Differences between two runs of the same seed, as means over the seeds with their standard errors:",
        "",
        f"| difference | seeds | {' | '.join(ERRORS.values())} |",
        f"|---|---:|{'---:|' * len(ERRORS)}",
    ]
    for first, second in ((RUNS[2], RUNS[3]), (RUNS[0], RUNS[2])):
        differences = [paired(rows, first, second, name) for name in ERRORS]
        name = f"{', '.join(second)} minus {', '.join(first)}"
        lines.append(
            f"| {name} | {len(differences[0])} | {' | '.join(mean_and_error(numbers) for numbers in differences)} |"
        )
    lines += [
        "",
        "The default of the experiment stays `32-true`, so that errors do not depend on whether a processor multiplies "
        "bfloat16 numbers fast. `trainer.precision=auto` chooses bfloat16 on a processor that multiplies bfloat16 "
        "numbers fast.",
        "",
        "Each run, with the standard errors over the test images:",
        "",
        f"| version | precision | seed | {titles} |",
        f"|---|---|---:|{'---:|' * (len(ERRORS) + len(TIMES))}",
    ]
    for row in sorted(rows, key=lambda row: (RUNS.index((row["version"], row["precision"])), row["seed"])):
        cells = [f"{row[name]:.3f} ± {row[f'{name}_sem']:.3f}" for name in ERRORS]
        cells += [f"{row[name]:.0f}" for name in TIMES]
        lines.append(f"| {' | '.join(str(row[name]) for name in KEY)} | {' | '.join(cells)} |")
    lines += [
        "",
        f"Before the runs, other processes used {median_and_range([row['others'] for row in rows])} of the cores. Such "
        "work multiplies wall times, and lengthens processor times less.",
        "",
        f"{machine('torch', 'pytorch-lightning')} Command: `python -m benchmarks.framework.main_job_seeds --seeds "
        f"{','.join(map(str, sorted({row['seed'] for row in rows})))}`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", default="0,1,2,3,4", type=lambda text: [int(seed) for seed in text.split(",")]
    )
    parser.add_argument("--before", default=BEFORE, help="commit of the older version")
    parser.add_argument(
        "--versions", default="before,after", help="before, after or both", type=lambda text: text.split(",")
    )
    chosen = parser.parse_args()
    rows: list[Row] = read_rows(TABLE) if TABLE.exists() else []
    wanted = [run for run in RUNS if run[0] in chosen.versions]
    for run in ((version, precision, seed) for seed in chosen.seeds for version, precision in wanted):
        if not any(tuple(row[name] for name in KEY) == run for row in rows):
            rows.append(measure(*run, chosen.before))
            write_csv(rows, None, TABLE)
    publish(__file__, page(rows, chosen.before))


if __name__ == "__main__":
    main()
