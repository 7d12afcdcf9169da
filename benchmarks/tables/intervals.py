"""Compare intervals of 90 %, with and without conformal prediction, by error against run time, on UCI tables.

    python -m benchmarks.tables.intervals measure /path/to/uci concrete     # 3 splits; likewise yacht
    python -m benchmarks.tables.intervals page                              # writes intervals.md and its figure

The files of the sets are those of `plugins/data/tabular` (data=uci). `measure` trains all methods as
`benchmarks.tables.uncertainty` does, and writes one line for each method and split into intervals_runs.csv.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from benchmarks.pages import environment, publish, read_rows
from benchmarks.tables.uncertainty import BATCH, DECAY, RATE, STEPS, WIDTH, load_data, train
from framework.figures.style import COLOURS, GREY, MARKERS, save_figure, titled_figure
from framework.reports.table import write_csv

SETS = ("concrete", "yacht")
SPLITS = (0, 1, 2)
MISCOVERAGE = 0.1
FOLDS = 10
ENDS = {"conformal": {"score": "quantiles"}}
METHODS: dict[str, dict[str, Any]] = {
    "gaussian": {},
    "gaussian, conformal": {"uncertainty": ["conformal"], **ENDS},
    "student_t": {"head": {"name": "student_t"}},
    "student_t, conformal": {"head": {"name": "student_t"}, "uncertainty": ["conformal"], **ENDS},
    "quantiles": {"head": {"name": "quantiles"}},
    "quantiles, conformal (CQR)": {"head": {"name": "quantiles"}, "uncertainty": ["conformal"], **ENDS},
    "ensemble": {"uncertainty": ["ensemble"]},
    "ensemble, conformal": {"uncertainty": ["ensemble", "conformal"], **ENDS},
    "folds": {"uncertainty": ["folds"]},
    "folds, conformal (CV+)": {
        "uncertainty": ["folds", "conformal"],
        "conformal": {"score": "cv_plus"},
    },
}
"""Methods by name: wrappers, innermost first, and what differs from one Gaussian network."""
ROWS, ROUNDS, SECONDS = 1000, 5, 0.05
"""Rows of a timed prediction, rounds, and processor time of a method in a round."""
TABLE = Path(__file__).with_name("intervals_runs.csv")
FIGURE = Path(__file__).with_name("intervals.png")


def train_folds(data: Any, batches: dict[str, Any], method: dict[str, Any], seed: int) -> Any:
    """Return the trained and calibrated predictor of a method with the wrapper `folds`.

    Each of its models is trained as those of the other methods, but without one fold of training and validation rows.
    """
    import torch

    from framework.configuration.assembly import build_predictor
    from framework.configuration.schema import resolve
    from framework.uncertainty import self_training

    folds = {"folds": FOLDS, "dropout": [None], "weight_decay": [DECAY]}
    settings = {"folds": {**folds, "learning_rate": RATE, "steps": STEPS, "epochs": 1}, **method}
    names = method["uncertainty"]
    parts = {
        "encoder": [resolve("encoder", {"name": "mlp", "widths": [WIDTH], "dropout": 0.0})],
        "density_head": resolve("density_head", "gaussian"),
        "uncertainty": [resolve("uncertainty", {"name": name, **settings.get(name, {})}) for name in names],
    }
    predictor = build_predictor(parts, data.target, data.input_shape, seed)
    inputs, target = (
        torch.cat([batches[split][field] for split in ("train", "validation")])
        for field in ("input", "target")
    )
    wrapper = self_training(predictor)
    assert wrapper is not None
    wrapper.train_models(inputs, target, seed=seed, batch_size=BATCH)
    predictor.eval()
    predictor.calibrate([{"input": inputs, "target": target, "row": torch.arange(len(inputs))}])
    return predictor


def interval(predictor: Any, inputs: Any) -> tuple[Any, Any]:
    """Return the ends of the intervals of rows, (row,) each: those of a prediction set, or else central intervals."""
    import torch

    from framework.distributions.intervals import central_interval
    from framework.distributions.protocol import value_set

    with torch.no_grad():
        density = predictor(inputs)
        sets: Any = value_set(density)
        if sets is None:
            ends = central_interval(density, 1 - MISCOVERAGE)
            return ends.low.squeeze(-1), ends.high.squeeze(-1)
        found = torch.tensor([parts[0] for parts in sets.intervals()], dtype=torch.float64)
        return found[:, 0], found[:, 1]


def interval_score(low: Any, high: Any, value: Any) -> Any:
    """Return the interval score of each row, in the unit of the target (Gneiting & Raftery 2007, eq. 43).

    It is the width, plus 2/α times the distance of the target from the interval, where α = MISCOVERAGE. Its expectation
    is smallest for the true quantiles.
    """
    outside = (low - value).clamp(min=0) + (value - high).clamp(min=0)
    return high - low + 2 / MISCOVERAGE * outside


def measure(root: Path, name: str) -> None:
    """Record the results of every method on each split of a set, in place of old records."""
    import torch

    from benchmarks.timing import time_interleaved

    torch.set_num_threads(1)
    old = read_rows(TABLE) if TABLE.exists() else []
    rows: list[dict[str, Any]] = []
    predictors: dict[str, Any] = {}
    test: dict[str, Any] = {}
    for split in SPLITS:
        data, batches = load_data(root, name, split)
        test = batches["test"]
        target = test["target"].double().squeeze(-1)
        for label, method in METHODS.items():
            fit = train_folds if "folds" in method.get("uncertainty", []) else train
            predictor = predictors[label] = fit(data, batches, method, split)
            low, high = interval(predictor, test["input"])
            rows.append(
                {
                    "data": name,
                    "method": label,
                    "split": split,
                    "coverage": ((low <= target) & (target <= high)).double().mean().item(),
                    "width": (high - low).mean().item(),
                    "score": interval_score(low, high, target).mean().item(),
                }
            )
    repeats = ROWS // len(test["input"]) + 1
    inputs = test["input"].repeat(repeats, 1)[:ROWS]
    calls = {label: partial(interval, predictor, inputs) for label, predictor in predictors.items()}
    times = time_interleaved(calls, rounds=ROUNDS, seconds=SECONDS)
    for row in rows:
        row["microseconds"] = 1000 * times[row["method"]].median / ROWS
        row["environment"] = environment("torch")
    write_csv([*(row for row in old if row["data"] != name), *rows], None, TABLE)


def page() -> None:
    """Write the page and its figure from the recorded runs."""
    rows: list[dict[str, Any]] = read_rows(TABLE)
    draw(rows)
    measured = [name for name in SETS if any(row["data"] == name for row in rows)]
    lines = [
        "# Intervals of 90 %",
        "",
        f"This page compares intervals of {1 - MISCOVERAGE:.0%} for the target of a table, with and without conformal "
        f"prediction, on the *real* UCI tables {' and '.join(measured)} (standard splits "
        f"{', '.join(map(str, SPLITS))}). All methods train one layer of {WIDTH} units for {STEPS} steps of {BATCH} "
        f"rows by AdamW (learning rate {RATE:g}, weight decay {DECAY:g}, cosine schedule). `gaussian`, `student_t` and "
        "`quantiles` are density heads, whose central intervals are used. The others have the head `gaussian`: "
        f"`ensemble` is the mixture of five networks, and `folds` that of {FOLDS} networks that each leave out a part "
        "of the training and validation rows. A conformal method moves both ends of an interval by the same distance "
        "for all rows (`uncertainty.conformal.score=quantiles`); with the head `quantiles`, this is conformalised "
        "quantile regression (CQR; Romano et al. 2019). CV+ (Barber et al. 2021) is computed from the residuals of "
        f"rows that a network left out (`uncertainty.conformal.score=cv_plus`). It is the jackknife+ for as many "
        f"folds as rows, and an approximation of it for {FOLDS} folds. No setting was tuned.",
        "",
        "The interval score is the width plus 20 times the distance of the target from the interval, as a mean over "
        "the test rows (Gneiting & Raftery 2007, eq. 43, for 90 %); lower is better. It is smallest for the true "
        "quantiles.",
        "",
        "![Interval score against processor time](intervals.png)",
        "",
        "*Interval score against the time of density and interval of a row (real data). Bars are standard errors over "
        "the splits. The grey line is the best result of all methods that are at least as fast.*",
        "",
        "**Which method wins at which run time.** Each line of the list is for one data set. It names the methods in "
        "the order of their run time per row, from the fastest on. A method is named only if its score is better than "
        "that of every faster method by more than the standard error of the difference, paired by split. The score is "
        "in brackets. Times that differ by less than a tenth are equal within their noise.",
        "",
        *(f"- {name}: {winners([row for row in rows if row['data'] == name])}." for name in measured),
        "",
        f"The conformal methods cover {coverages(rows, True)} of the test rows, and the other methods "
        f"{coverages(rows, False)}, as means over the splits of a set. The guarantee of the conformal methods costs "
        "width here, because only half of the few validation rows determine the distance by which the ends move; CV+ "
        "uses all rows.",
    ]
    for name in measured:
        own = [row for row in rows if row["data"] == name]
        lines += ["", f"## {name} (real)", "", *table(own)]
    lines += [
        "",
        f"± is the standard error over the {len(SPLITS)} splits, which share many rows. Width and score are in the "
        f"unit of the target. Times are processor times of a row in a batch of {ROWS} rows on one thread, as medians "
        f"of {ROUNDS} interleaved rounds.",
        "",
        f"Measured on {rows[0]['environment']} Commands: the lines at the top of `benchmarks/tables/intervals.py`. "
        "Other programs used the machine at the same time.",
        "",
    ]
    publish(__file__, "\n".join(lines))


def values(rows: Sequence[dict[str, Any]], method: str, key: str) -> list[float]:
    """Return a quantity of a method for each split, in ascending order of the splits."""
    own = [row for row in rows if row["method"] == method]
    return [row[key] for row in sorted(own, key=lambda row: row["split"])]


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the lines of the table of a set, the lowest score first."""
    lines = ["| method | interval score | width | coverage, % | µs / row |", "|---|---:|---:|---:|---:|"]
    for method in sorted(METHODS, key=lambda method: mean(values(rows, method, "score"))):
        score, width, coverage = (values(rows, method, key) for key in ("score", "width", "coverage"))
        cells = [
            with_error(score, 2),
            with_error(width, 2),
            with_error([100 * share for share in coverage], 1),
            f"{mean(values(rows, method, 'microseconds')):.3g}",
        ]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return lines


def coverages(rows: Sequence[dict[str, Any]], conformal: bool) -> str:
    """Return the range of the mean coverage of all conformal methods, or of all others, over both sets, as text."""
    shares = [
        100 * mean(values([row for row in rows if row["data"] == name], method, "coverage"))
        for name in SETS
        for method in METHODS
        if ("conformal" in method) is conformal
    ]
    return f"{min(shares):.0f} to {max(shares):.0f} %"


def with_error(numbers: Sequence[float], digits: int) -> str:
    """Return the mean and its standard error."""
    return f"{mean(numbers):.{digits}f} ± {standard_error(numbers):.{digits}f}"


def standard_error(numbers: Sequence[float]) -> float:
    """Return the standard error of the mean."""
    return stdev(numbers) / len(numbers) ** 0.5


def winners(rows: Sequence[dict[str, Any]]) -> str:
    """Return the methods that are better than every faster one, from the fastest on, with their scores."""
    ranked = sorted(METHODS, key=lambda method: values(rows, method, "microseconds")[0])
    named = ranked[:1]
    for method in ranked[1:]:
        pairs = zip(values(rows, named[-1], "score"), values(rows, method, "score"), strict=True)
        gains = [best - own for best, own in pairs]
        if mean(gains) > standard_error(gains):
            named.append(method)
    parts = [
        f"from {values(rows, method, 'microseconds')[0]:.3g} µs {method} ({mean(values(rows, method, 'score')):.2f})"
        for method in named
    ]
    return ", ".join(parts)


def draw(rows: Sequence[dict[str, Any]]) -> None:
    """Draw the interval score of each method against its run time, with one panel for each set."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FuncFormatter

    figure = titled_figure((12, 4.4), "Intervals of 90 %: interval score against run time (real)", False)
    styles: dict[str, tuple[str, str, Any]] = {
        method: (MARKERS[n], COLOURS[n // 2 % len(COLOURS)], "full" if n % 2 else "none")
        for n, method in enumerate(METHODS)
    }
    panels = figure.subplots(1, len(SETS))
    for axes, name in zip(panels, SETS, strict=True):
        own = [row for row in rows if row["data"] == name]
        if not own:
            continue
        ranked = []
        for method, (marker, colour, fill) in styles.items():
            scores, duration = values(own, method, "score"), values(own, method, "microseconds")[0]
            ranked.append((duration, mean(scores)))
            axes.errorbar(
                duration,
                mean(scores),
                standard_error(scores),
                marker=marker,
                color=colour,
                fillstyle=fill,
                ls="",
            )
        ranked.sort()
        times = [time for time, _ in ranked]
        best = [min(score for _, score in ranked[: end + 1]) for end in range(len(ranked))]
        axes.step([*times, 2 * times[-1]], [*best, best[-1]], where="post", color=GREY, zorder=0, lw=1)
        limits = (times[0] / 1.5, 1.5 * times[-1])
        axes.set(xscale="log", title=f"{name} (real)", xlabel="processor time per row, µs", xlim=limits)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_ylim(0, None)
    panels[0].set_ylabel("interval score (lower is better)")
    handles = [
        Line2D([], [], color=colour, ls="", marker=marker, fillstyle=fill, label=method)
        for method, (marker, colour, fill) in styles.items()
    ]
    handles.append(Line2D([], [], color=GREY, label="best so far"))
    figure.legend(handles=handles, loc="outside right center", fontsize=9)
    save_figure(figure, FIGURE.with_suffix(""), True)


def main() -> None:
    """Run the step that the command line names."""
    parser = argparse.ArgumentParser(description="Compare intervals with and without conformal prediction.")
    parser.add_argument("step", choices=("measure", "page"))
    parser.add_argument("root", type=Path, nargs="?", help="folder of the UCI sets")
    parser.add_argument("set", choices=SETS, nargs="?")
    options = parser.parse_args()
    if options.step == "page":
        page()
    else:
        measure(options.root, options.set)


if __name__ == "__main__":
    main()
