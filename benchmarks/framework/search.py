"""Compare the Pareto front of a search with NSGA-II with the fronts of grids of the same number of trials.

    python -m benchmarks.framework.search [--space small|wide] [--folder FOLDER] [--runs NUMBER]

The searches and the grids are commands of the framework, and their sweeps are in the folder, by default
outputs/benchmarks/search or search_wide. A sweep that is there already is continued, not repeated; so the script can be
run in parts of `--runs` sweeps. When all sweeps have ended, the script writes search.md or search_wide.md beside this
file. The table is that of the
UCI set concrete (REAL_DATA_ROOT/uci/concrete.csv).
"""

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.commands import carry_out
from benchmarks.pages import machine, write_page
from framework.evaluation.pareto import TIME_NOISE, front

TRIALS, SEEDS = 24, 3
QUIET = ("logger=none", "pictures=false", "threads=1", "hydra.launcher.jobs=2")
WIDTHS = ("[16]", "[64]", "[256]", "[1024]", "[16,16]", "[64,64]", "[256,256]", "[1024,1024]")


@dataclass(frozen=True)
class Space:
    """A search space, and grids of `TRIALS` points in it.

    Attributes:
        page: name of the page that compares the searches with the grids.
        sweeps: values of each key for the searches, in Hydra's grammar.
        grids: name of each grid, and the values of the keys that it varies; other keys keep their defaults.
        settings: description of the settings that differ between trials.
        grid_values: description of the grids.
        remark: paragraph about the comparison.
    """

    page: str
    sweeps: Mapping[str, str]
    grids: Mapping[str, Mapping[str, str]]
    settings: str
    grid_values: str
    remark: str


WIDTH, RATE, DROPOUT = "encoder.mlp.widths", "optimizer.learning_rate", "encoder.mlp.dropout"
DECAY, BATCH = "optimizer.weight_decay", "batch_size"
RATES = "1e-3,5e-3,2.5e-2"
SPACES = {
    "small": Space(
        "search",
        {WIDTH: ",".join(WIDTHS), RATE: "tag(log,interval(1e-3,2.5e-2))", DROPOUT: "interval(0.0,0.5)"},
        {
            "grid of 8 × 3 × 1": {WIDTH: ",".join(WIDTHS), RATE: RATES, DROPOUT: "0.0"},
            "grid of 4 × 3 × 2": {WIDTH: ",".join(WIDTHS[::2]), RATE: RATES, DROPOUT: "0.0,0.25"},
        },
        "the widths of its layers, the learning rate and the dropout rate",
        "The grids have 8 or 4 widths, 3 learning rates and one or two dropout rates (0; 0 and 0.25).",
        "A grid contains the ends of the intervals, which a search hardly ever draws. A grid therefore has an "
        "advantage where the best settings are at an end, as a learning rate of 0.025 and a dropout rate of 0 are "
        "on moons. [search_wide](search_wide.md) has more settings, of which a grid can try only few values each.",
    ),
    "wide": Space(
        "search_wide",
        {
            WIDTH: ",".join(WIDTHS),
            RATE: "tag(log,interval(3e-4,3e-2))",
            DROPOUT: "interval(0.0,0.5)",
            DECAY: "tag(log,interval(1e-6,1e-1))",
            BATCH: "16,32,64,128",
        },
        {
            "grid of 6 × 2 × 1 × 2 × 1": {
                WIDTH: "[16],[64],[256],[64,64],[256,256],[1024,1024]",
                RATE: "1e-3,1e-2",
                DECAY: "1e-4,1e-2",
            },
            "grid of 3 × 2 × 2 × 1 × 2": {
                WIDTH: "[64],[256],[256,256]",
                RATE: "1e-3,1e-2",
                DROPOUT: "0.0,0.25",
                BATCH: "32,128",
            },
        },
        "the widths of its layers, the learning rate, the dropout rate, the weight decay and the batch size",
        "The names of the grids count the values of these settings in this order; a setting with one value keeps its "
        "default. The learning rates of the grids are 1e-3 and 1e-2, their dropout rates 0 and 0.25, their weight "
        "decays 1e-4 and 1e-2, and their batch sizes 32 and 128.",
        "[search](search.md) has the same comparison in a smaller space, in which the grids dominate the searches on "
        "moons. That result was known before this space was chosen.",
    ),
}
"""Compared search spaces by name."""
Points = list[tuple[float, float]]
"""Validation loss in nats and milliseconds per sample of each trial."""


def data() -> dict[str, tuple[str, ...]]:
    """Return the overrides that both searches and grids have, by the name of the data set."""
    table = Path(os.environ.get("REAL_DATA_ROOT", "")) / "uci" / "concrete.csv"
    if not table.is_file():
        sys.exit(f"{table} is missing. Set REAL_DATA_ROOT to the folder that has uci/concrete.csv.")
    columns = table.read_text(encoding="utf-8").splitlines()[0].split(",")[:-2]
    return {
        "moons": (
            *("experiment=moons/vanilla_128", "metric=[nll]", "~outliers"),
            *("trainer.max_epochs=20", "trainer.check_val_every_n_epoch=5"),
        ),
        "concrete": (
            *("data=tabular", f"data.path={table}", "data.target=strength", "data.kind=real"),
            *(f"data.columns=[{','.join(columns)}]", "encoder=[mlp]", "density_head=gaussian"),
            *("metric=[rmse]", "trainer.max_epochs=30"),
        ),
    }


def overrides_of(values: Mapping[str, str]) -> list[str]:
    """Return the overrides that set each key."""
    return [f"{key}={value}" for key, value in values.items()]


def commands(folder: Path, space: Space) -> dict[tuple[str, str], tuple[Path, list[str]]]:
    """Return folder and arguments of each sweep, by data set and name of the sweep."""
    sweeps = {}
    for name, overrides in data().items():
        for seed in range(SEEDS):
            place = folder / name / f"nsga2_{seed}"
            search = ("hydra/sweeper=optuna", "hydra.sweeper.sampler=nsga2", f"hydra.sweeper.trials={TRIALS}")
            arguments = [*search, f"hydra.sweeper.seed={seed}", *overrides, *overrides_of(space.sweeps)]
            sweeps[name, f"NSGA-II, seed {seed}"] = place, arguments
        for number, (grid, values) in enumerate(space.grids.items()):
            sweeps[name, grid] = folder / name / f"grid_{number}", [*overrides, *overrides_of(values)]
    return sweeps


@dataclass(frozen=True)
class Trial:
    """One trial of a search or a grid: its validation loss in nats, its milliseconds per sample, and its settings."""

    loss: float
    milliseconds: float
    settings: Mapping[str, str]


def trials_of(folder: Path, space: Space) -> list[Trial]:
    """Return the trials of a sweep that have completed."""
    trials = []
    for path in folder.glob("*/value.json"):
        results = json.loads(path.with_name("results.json").read_text(encoding="utf-8"))
        overrides = json.loads(path.with_name("job.json").read_text(encoding="utf-8"))["overrides"]
        settings = dict(override.split("=", 1) for override in overrides if "=" in override)
        varied = {key.rpartition(".")[2]: settings[key] for key in space.sweeps if key in settings}
        trials.append(Trial(float(json.loads(path.read_text())), results["milliseconds_per_sample"], varied))
    return trials


def run_times(runs: Mapping[str, list[Trial]]) -> dict[str, list[float]]:
    """Return all measured milliseconds per sample by the widths of the network."""
    times: dict[str, list[float]] = {}
    for trials in runs.values():
        for trial in trials:
            times.setdefault(trial.settings["widths"], []).append(trial.milliseconds)
    return times


def points(runs: Mapping[str, list[Trial]]) -> dict[str, Points]:
    """Return the points of each run, with the median run time of all trials whose networks have the same widths.

    Learning rate and dropout rate do not change the time of a prediction, and a single measurement is less exact than
    the difference that counts (`TIME_NOISE`).
    """
    times = run_times(runs)
    return {
        run: [(trial.loss, median(times[trial.settings["widths"]])) for trial in trials]
        for run, trials in runs.items()
    }


def front_of(trials: Points) -> Points:
    """Return the points of the Pareto front."""
    marks = front([error for error, _ in trials], [time for _, time in trials], TIME_NOISE)
    return [point for point, on_front in zip(trials, marks, strict=True) if on_front]


def beaten(some: Points, others: Points) -> int:
    """Return how many points of `some` a point of `others` beats: better in one quantity, not worse in the other."""
    return sum(
        any(
            (error <= own_error and time * (1 + TIME_NOISE) < own_time)
            or (error < own_error and time <= own_time * (1 + TIME_NOISE))
            for error, time in others
        )
        for own_error, own_time in some
    )


def area(trials: Points, corner: tuple[float, float]) -> float:
    """Return the area, in nats times the logarithm of the run time, that a set of points dominates below a corner."""
    total, lowest = 0.0, corner[0]
    for error, time in sorted(trials, key=lambda point: point[1]):
        if error < lowest and time < corner[1]:
            total += (lowest - error) * np.log(corner[1] / time)
            lowest = error
    return total


def section(name: str, runs: Mapping[str, list[Trial]], space: Space) -> list[str]:
    """Return the lines of a data set's section."""
    results = points(runs)
    everything = [point for trials in results.values() for point in trials]
    corner = (max(error for error, _ in everything), max(time for _, time in everything))
    best = area(everything, corner)
    grids = {grid: results[grid] for grid in space.grids}
    fronts = {run: front_of(trials) for run, trials in results.items()}
    lines = [
        f"## {name}",
        "",
        "| run | trials | lowest loss, nats | its settings | on the front | "
        + " | ".join(f"beaten by the {grid}" for grid in grids) + " | dominated area |",
        "|---|---:|---:|---|---:|" + "---:|" * len(grids) + "---:|",
    ]  # fmt: skip
    for run, trials in results.items():
        own = fronts[run]
        counts = [
            f"{beaten(own, others)} of {len(own)}" if run != grid else "" for grid, others in grids.items()
        ]
        lowest = min(runs[run], key=lambda trial: trial.loss)
        settings = ", ".join(f"{key}={value}" for key, value in lowest.settings.items())
        cells = [
            run,
            len(trials),
            f"{lowest.loss:.3f}",
            settings,
            len(own),
            *counts,
            f"{area(trials, corner) / best:.3f}",
        ]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    searches = [run for run in results if run not in grids]
    dominated = sum(
        beaten(fronts[run], others) == len(fronts[run]) for run in searches for others in grids.values()
    )
    against = [
        f"{sum(beaten(fronts[grid], results[run]) for run in searches) / len(searches):.1f} of the "
        f"{len(fronts[grid])}"
        for grid in grids
    ]
    spreads = [float(np.std(times, ddof=1) / np.mean(times)) for times in run_times(runs).values()]
    return [
        *lines,
        "",
        "A grid dominates the front of a search if the points of the grid beat every point of this front. This "
        f"happened in {dominated} of {len(searches) * len(grids)} comparisons. In the other direction, a search "
        "can beat points on the front of a grid. Averaged over the searches, a search beat "
        + ", and ".join(f"{count} on the front of the {grid}" for count, grid in zip(against, grids, strict=True))
        + ".",
        "",
        "The standard deviation of single measurements of the run time of the same network is "
        f"{100 * median(spreads):.0f} % (median over "
        "the widths).",
        "",
    ]  # fmt: skip


def main() -> None:
    """Run the sweeps that have not ended, and write the page when all have."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--space", choices=SPACES, default="small")
    parser.add_argument("--folder", type=Path, help="by default outputs/benchmarks/<name of the page>")
    parser.add_argument("--runs", type=int, help="number of sweeps to run now; none: all")
    arguments = parser.parse_args()
    space = SPACES[arguments.space]
    folder = arguments.folder or Path("outputs/benchmarks", space.page)
    sweeps = commands(folder.absolute(), space)
    missing = {key: sweep for key, sweep in sweeps.items() if len(trials_of(sweep[0], space)) < TRIALS}
    for _, (place, overrides) in list(missing.items())[: arguments.runs]:
        carry_out([sys.executable, "-m", "framework", "-m", f"hydra.sweep.dir={place}", *QUIET, *overrides])
    left = len(missing) - len(list(missing)[: arguments.runs])
    if left:
        sys.stdout.write(f"{left} sweeps are missing; run the script again.\n")
        return
    lines = []
    for name in data():
        runs = {run: trials_of(place, space) for (of, run), (place, _) in sweeps.items() if of == name}
        lines += section(name, runs, space)
    write_page(__file__, [*introduction(space), *lines, *ending(arguments.space)], space.page)


def introduction(space: Space) -> Sequence[str]:
    """Return the first lines of the page."""
    return [
        f"# Search over {len(space.sweeps)} settings for a Pareto front, compared with grids",
        "",
        "This page shows whether a search over error and run time with NSGA-II (`hydra/sweeper=optuna "
        "hydra.sweeper.sampler=nsga2`) finds a Pareto front that no grid of the same number of trials dominates. "
        f"Each run has {TRIALS} trials of a small network. They differ in {space.settings}. The searches choose them "
        f"from `{' '.join(overrides_of(space.sweeps))}`. {space.grid_values}",
        "",
        "The error is the best validation loss. The run time is the number of milliseconds per sample on one "
        "thread. A single measurement varies by more than 5 %, because another trial runs at the same time. The "
        "run time of a network is therefore the median over all trials of the table whose networks have the same "
        "widths. A point beats another if it is better in one of the two and not worse in the other; run times "
        f"within {100 * TIME_NOISE:g} % count as equal, and losses are compared exactly. The dominated area "
        "measures a whole front: it is the area between the front and the worst point of the table, in nats "
        "times the logarithm of the run time, divided by this area for the front of all trials together. Higher "
        "is better.",
        "",
        space.remark,
        "",
    ]


def ending(space: str) -> Sequence[str]:
    """Return the last lines of the page."""
    return [
        "moons is synthetic. concrete is the UCI set of 1,030 real measurements of the strength of concrete.",
        "",
        f"{machine('torch', 'pytorch-lightning', 'hydra-core', 'optuna')} "
        f"Command: `python -m benchmarks.framework.search{'' if space == 'small' else f' --space {space}'}`.",
    ]


if __name__ == "__main__":
    main()
