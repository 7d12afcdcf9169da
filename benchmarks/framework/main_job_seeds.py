"""Compare errors of whole runs of the main job, `experiment=pascal3d/scvae`, in float32 and in bfloat16 over seeds.

    python -m benchmarks.framework.main_job_seeds --seeds 0,1,2

A run takes two to four minutes of processor time. The script also runs beside other work: that changes the times, but
not the errors. Each run is written to main_job_seeds.csv as soon as it ends, and runs that the table already contains
are not repeated.
"""

import argparse
import math
import statistics
from pathlib import Path
from typing import Any

from benchmarks.commands import ROOT
from benchmarks.framework.main_job import run_command
from benchmarks.pages import machine, publish, read_rows
from benchmarks.timing import median_and_range
from framework.reports.table import write_csv

TABLE = Path(__file__).with_suffix(".csv")
PRECISIONS = ("32-true", "bf16-mixed")
ERRORS = {"log_likelihood": "log-likelihood, nats", "maad_deg": "MAAD, °"}


def row_of(precision: str, seed: int, results: dict[str, Any], processor: float) -> dict[str, Any]:
    """Return the row of a run from its results and its processor time, in seconds."""
    errors = {key: results[key] for name in ERRORS for key in (name, f"{name}_sem")}
    return {"precision": precision, "seed": seed, **errors, "processor": processor}


def measure(precision: str, seed: int) -> dict[str, Any]:
    """Run the main job once, without figures and without a tracking store."""
    settings = [
        "experiment=pascal3d/scvae",
        f"seed={seed}",
        f"trainer.precision={precision}",
        "pictures=false",
        "logger=none",
    ]
    done = run_command(ROOT, settings)
    return row_of(precision, seed, done.results, done.processor)


def paired(rows: list[dict[str, Any]], error: str) -> list[float]:
    """Return an error in bfloat16 minus the error in float32, for each seed that both have."""
    by_run = {(row["precision"], row["seed"]): row[error] for row in rows}
    seeds = [seed for precision, seed in by_run if precision == PRECISIONS[0]]
    pairs = [tuple(by_run.get((precision, seed)) for precision in PRECISIONS) for seed in seeds]
    return [second - first for first, second in pairs if first is not None and second is not None]


def mean_and_error(numbers: list[float]) -> str:
    """Return the mean and, for several numbers, its standard error as text."""
    if len(numbers) == 1:
        return f"{numbers[0]:.3f}"
    return f"{statistics.mean(numbers):.3f} ± {statistics.stdev(numbers) / math.sqrt(len(numbers)):.3f}"


def page(rows: list[dict[str, Any]]) -> str:
    """Return the text of the page."""
    lines = [
        "# The main job in float32 and bfloat16: errors of whole runs over seeds",
        "",
        "The main job is `python -m framework experiment=pascal3d/scvae`. Here it runs with all its 30 epochs on its "
        "generated images (synthetic), for each seed once with `trainer.precision=32-true` and once with "
        "`trainer.precision=bf16-mixed`. The runs draw no figures and use no tracking store (`pictures=false "
        "logger=none`). Errors are those of the 381 test images; the number after ± in the first table is the standard "
        "error over these images.",
        "",
        f"| precision | seed | {' | '.join(ERRORS.values())} | processor time, s |",
        f"|---|---:|{'---:|' * (len(ERRORS) + 1)}",
    ]
    order = sorted(rows, key=lambda row: (PRECISIONS.index(row["precision"]), row["seed"]))
    for row in order:
        errors = [f"{row[name]:.3f} ± {row[f'{name}_sem']:.3f}" for name in ERRORS]
        lines.append(
            f"| {row['precision']} | {row['seed']} | {' | '.join(errors)} | {row['processor']:.0f} |"
        )
    lines += [
        "",
        "The second table has the mean over the seeds and its standard error, and the difference between the two runs "
        "of a seed. Processor times are the median over the seeds (least to largest).",
        "",
        f"| | seeds | {' | '.join(ERRORS.values())} | processor time, s |",
        f"|---|---:|{'---:|' * (len(ERRORS) + 1)}",
    ]
    for precision in PRECISIONS:
        group = [row for row in rows if row["precision"] == precision]
        errors = [mean_and_error([row[name] for row in group]) for name in ERRORS]
        times = median_and_range([row["processor"] for row in group])
        lines.append(f"| {precision} | {len(group)} | {' | '.join(errors)} | {times} |")
    differences = {name: paired(rows, name) for name in ERRORS}
    count = len(differences["log_likelihood"])
    texts = [mean_and_error(differences[name]) for name in ERRORS]
    why = (
        "because fewer than five seeds are compared here"
        if count < 5
        else "so that errors do not depend on whether a processor multiplies bfloat16 numbers fast"
    )
    lines += [
        f"| bf16-mixed minus 32-true | {count} | {' | '.join(texts)} | |",
        "",
        "All runs used one thread, beside other work that kept both cores busy. Such work does not change errors, but "
        "it lengthens processor times; [main_job](main_job.md) has times of a quiet machine. The default of the "
        f"experiment stays `32-true`, {why}. "
        "`trainer.precision=auto` chooses bfloat16 on a processor that multiplies bfloat16 numbers fast.",
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
    chosen = parser.parse_args()
    rows = read_rows(TABLE) if TABLE.exists() else []
    for seed in chosen.seeds:
        for precision in PRECISIONS:
            if not any((row["precision"], row["seed"]) == (precision, seed) for row in rows):
                rows.append(measure(precision, seed))
                write_csv(rows, None, TABLE)
    publish(__file__, page(rows))


if __name__ == "__main__":
    main()
