"""Make Tables 2.1, 3.1 to 3.3, 6.1 to 6.4 and Figures 3.7 and 3.8 of the thesis with one command.

    python -m reproduction.thesis_tables [2.1 3.3 ...] [--seeds 5] [--jobs 2] [--bfloat16]

Without numbers, the command makes all tables. Runs that are complete in outputs/thesis_tables are not repeated, so that
the same command continues after an interruption. The script of each table writes its page; thesis_tables.md lists what
ran and for how long.
"""

import argparse
import datetime
import itertools
import math
import os
import re
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import environment, machine
from benchmarks.sweeps import processor_seconds, record, wall_seconds
from framework.reports.table import NOT_AVAILABLE, format_number

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/thesis_tables"
COMMON_OVERRIDES = ("pictures=false", "logger=none")
FIGURES = "| 3.7-3.8 |"
AT_ONCE = 2
"""Number of runs at the same time for which the page states the minutes.

The processor time of all runs is divided by this number.
"""
RUNS, MINUTES, PAGES = 3, 4, 5
"""Indices of the columns for runs, minutes and page times in the page's table, which the script reads again."""
BFLOAT16 = "trainer.precision=bf16-mixed"
"""Override of `--bfloat16`, for convolutional networks; it saves time on processors with avx512_bf16."""
CLASSES = (
    *("aeroplane", "bicycle", "boat", "bottle", "bus", "car", "chair", "diningtable", "motorbike", "sofa"),
    *("train", "tvmonitor"),
)
"""Classes of Table 3.3."""
THREE_SEED_CLASSES = ("bottle", "car", "diningtable")
"""Classes with every method and three seeds: one that looks the same from every side, one that looks different from
every side, one that looks the same after a rotation by 180°. The other classes have three methods and one seed."""
BY_HAND = ("bps_conv3d_ensemble", "pointnet2")
"""Two rows of Table 6.2 that take two to three hours of one core each: ten convolutional networks, and PointNet++ with
balls of three sizes. This script does not run them, but `modelnet40.py` accepts their runs."""
MODELNET = sorted(
    path.stem
    for path in (ROOT / "conf/experiment/modelnet40").glob("*.yaml")
    if path.stem not in ("base", *BY_HAND)
)
ONE_SEED_METHODS = (
    *("pointnet2_single", "bps_conv3d_delta", "bps_conv3d", "bps_conv3d_unpadded"),
    *("pointnet", "deepsets", "pointnet_vanilla"),
)
"""Rows of Tables 6.1 to 6.3 that take more than five minutes of a core. They have one seed, the others three. The
longest runs come first, so that both cores finish at about the same time."""


class Table(NamedTuple):
    """The runs of a table and the script that writes its page.

    Attributes:
        about: Description of the table and its data.
        sweeps: Overrides of each sweep, by its folder.
        script: Module of reproduction. It receives the folders of the sweeps, or of the single runs if `alone`.
        seeds: Largest number of seeds of a sweep that does not name its seeds.
        alone: Whether each sweep has one run, with as many threads as other tables have runs at the same time.
        convolves: Whether `--bfloat16` applies to the table.
        also: Further scripts that write a page from the same runs.
    """

    about: str
    sweeps: dict[str, tuple[str, ...]]
    script: str
    seeds: int = 5
    alone: bool = False
    convolves: bool = False
    also: tuple[str, ...] = ()


def methods(group: str, *names: str) -> str:
    return "experiment=" + ",".join(f"{group}/{name}" for name in names)


SMALL = "data.image_size=50"
"""Override that reduces the IDIAP images to the size of the other two sets; `preset=thesis` keeps 75 pixels."""
HEADS = (methods("idiap", "fixed_kappa", "von_mises", "cvae"), "data.angles=[pan],[tilt],[roll]", SMALL)
SHORT, SHORTER = "trainer.max_epochs=20", "trainer.max_epochs=15"
"""Two thirds and half of the epochs of the experiments, so that two cores need four hours for everything."""

TABLES = {
    "2.1": Table(
        "uncertainty on two moons",
        {
            "moons": (
                methods(
                    "moons",
                    *("vanilla_128", "vanilla_512", "temperature", "platt", "mc_dropout", "ensemble"),
                    *("outlier_exposure", "adversarial", "everything"),
                ),
            ),
            "moons_rates": (methods("moons", "mc_dropout"), "encoder.mlp.dropout=0.1,0.3"),
            "moons_both": (methods("moons", "ensemble"), "objective=[adversarial]"),
        },
        "chapter2.moons",
    ),
    "3.1-3.2": Table(
        "head poses of synthetic people in the layouts of IDIAP, CAVIAR and TownCentre",
        {
            "idiap": HEADS,
            "idiap_backbones": (
                methods("idiap", "cvae"),
                "data.angles=[pan]",
                SMALL,
                "density_head.backbones=each",
                "seed=0,1,2",
            ),
            "caviar": (methods("caviar", "fixed_kappa", "von_mises", "mixture"), SHORTER),
            "towncentre": (methods("towncentre", "fixed_kappa", "von_mises", "mixture"), SHORTER),
        },
        "chapter3.head_pose",
        convolves=True,
    ),
    "3.7-3.8": Table(
        "the pan angle of the generated IDIAP heads under blur, with the runs of Table 3.1",
        {
            "idiap": HEADS,
            "idiap_more": (methods("idiap", "mixture", "scvae"), "data.angles=[pan]", SMALL),
        },
        "chapter3.blur",
        convolves=True,
    ),
    "3.3": Table(
        "viewpoints of generated objects in PASCAL3D+'s layout",
        {
            "pascal3d": (
                methods("pascal3d", "fixed_kappa", "von_mises", "mixture", "cvae", "scvae"),
                f"data.category={','.join(THREE_SEED_CLASSES)}",
                SHORT,
            ),
            "pascal3d_classes": (
                methods("pascal3d", "fixed_kappa", "von_mises", "scvae"),
                f"data.category={','.join(name for name in CLASSES if name not in THREE_SEED_CLASSES)}",
                SHORT,
                "seed=0",
            ),
        },
        "chapter3.pascal3d",
        seeds=3,
        convolves=True,
        also=("chapter3.azimuths",),
    ),
    "6.1-6.3": Table(
        "classes of generated CAD models",
        {
            "modelnet40_quick": (
                methods("modelnet40", *(name for name in MODELNET if name not in ONE_SEED_METHODS)),
            ),
            "modelnet40_turned": (methods("modelnet40", "bps_mlp"), "data.rotations=4"),
            "modelnet40_slow": (methods("modelnet40", *ONE_SEED_METHODS), "seed=0"),
        },
        "chapter6.modelnet40",
        seeds=3,
        convolves=True,
    ),
    "6.4": Table(
        "registration of generated scans, and correspondences of people generated in FAUST's layout",
        {"registration": ("experiment=registration/quick",), "faust": ("experiment=faust/registration",)},
        "chapter6.registration",
        seeds=1,
        alone=True,
    ),
}


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument(
        "tables", nargs="*", metavar="TABLE", help=f"tables to make: {', '.join(TABLES)} (default: all)"
    )
    arguments.add_argument("--seeds", type=int, default=5, help="largest number of seeds of each table")
    arguments.add_argument("--jobs", type=int, default=2, help="number of runs at the same time")
    arguments.add_argument("--bfloat16", action="store_true", help="train convolutions in mixed precision")
    arguments.add_argument("--tell", action="store_true", help="print the commands, run nothing")
    options = arguments.parse_args()
    unknown = [name for name in options.tables if name not in TABLES]
    if unknown:
        arguments.error(f"There is no table {', '.join(unknown)}. Choose from {', '.join(TABLES)}.")
    for name in options.tables or TABLES:
        sweeps, pages = commands(name, options.seeds, options.jobs, options.bfloat16)
        if not options.tell:
            for sweep, words in TABLES[name].sweeps.items():
                put_aside(
                    FOLDER / sweep, (*words, *common_overrides(TABLES[name], options.jobs, options.bfloat16))
                )
        run_commands(sweeps, run=not options.tell)
        began = time.perf_counter()
        run_commands(pages, run=not options.tell)
        if not options.tell:  # after each table, so that an interruption loses nothing
            page = HERE.with_suffix(".md")
            written = {name: (time.perf_counter() - began) / 60}
            page.write_text(report(page.read_text(encoding="utf-8"), written), encoding="utf-8")


def run_commands(commands: Sequence[Sequence[str]], *, run: bool) -> None:
    for command in commands:
        sys.stdout.write(" ".join(command[1:]) + "\n")
        sys.stdout.flush()
        if run:
            carry_out(command)


def common_overrides(table: Table, jobs: int, bfloat16: bool) -> tuple[str, ...]:
    """Return the overrides that all runs of a table have.

    Args:
        table: The table.
        jobs: Number of runs at the same time; a table whose sweeps have one run each uses as many threads instead.
        bfloat16: Whether convolutional networks are trained in bfloat16.
    """
    precision = (BFLOAT16,) if bfloat16 and table.convolves else ()
    return (*precision, *COMMON_OVERRIDES, f"threads={jobs if table.alone else 1}")


def commands(name: str, seeds: int, jobs: int, bfloat16: bool) -> tuple[list[list[str]], list[list[str]]]:
    """Return the commands of the sweeps of a table, and the commands that write its pages.

    Args:
        name: Number of the table, such as "2.1".
        seeds: Largest number of seeds of a sweep.
        jobs: Number of runs at the same time.
        bfloat16: Whether convolutional networks are trained in bfloat16.
    """
    table = TABLES[name]
    sweep_commands = [
        [
            *(sys.executable, "-m", "framework", "-m", *with_seeds(words, seeds, table.seeds)),
            *common_overrides(table, jobs, bfloat16),
            *(f"hydra.launcher.jobs={jobs}", f"hydra.sweep.dir={folder_of(sweep)}"),
        ]
        for sweep, words in table.sweeps.items()
    ]
    folders = [folder_of(sweep) + ("/0" if table.alone else "") for sweep in table.sweeps]
    pages = [
        [sys.executable, "-m", f"reproduction.{script}", *folders] for script in (table.script, *table.also)
    ]
    return sweep_commands, pages


def with_seeds(words: Sequence[str], seeds: int, most: int) -> list[str]:
    """Return the overrides of a sweep with at most `seeds` seeds: of those that it names, or of 0 to `most` - 1."""
    named = [word for word in words if word.startswith("seed=")]
    values = split_values(named[0].partition("=")[2]) if named else [str(seed) for seed in range(most)]
    return [*(word for word in words if word not in named), f"seed={','.join(values[:seeds])}"]


def put_aside(sweep: Path, words: Sequence[str]) -> None:
    """Move the runs that do not belong to the present definition of a sweep to the folder aside, which no page reads.

    Args:
        sweep: Folder of the sweep.
        words: Present overrides of the sweep. If they name no seed, runs with any seed belong to the sweep.
    """
    wanted = {key: split_values(values) for key, _, values in (word.partition("=") for word in words)}
    for path in sorted(sweep.glob("*/job.json")):
        job = record(path.parent)
        overrides = dict(word.split("=", 1) for word in job["overrides"])
        if "seed" not in wanted:
            overrides.pop("seed", None)
        if job["status"] == "running" or (
            overrides.keys() == wanted.keys()
            and all({value, value.lower()} & {*wanted[key]} for key, value in overrides.items())
        ):
            continue
        for number in itertools.count():
            aside = sweep.parent / "aside" / f"{sweep.name}_{path.parent.name}_{number}"
            if not aside.exists():
                break
        aside.parent.mkdir(exist_ok=True)
        path.parent.rename(aside)
        sys.stdout.write(
            f"The run {sweep.name}/{path.parent.name} has other overrides than the sweep has now. It was moved to "
            f"{aside}.\n"
        )


def folder_of(sweep: str) -> str:
    return os.path.relpath(FOLDER / sweep, ROOT)


def report(page: str, written: Mapping[str, float]) -> str:
    """Return the page with the present runs; it keeps the lines of tables whose runs are not on this machine.

    Args:
        page: Text of the page before.
        written: Minutes that the pages took, by the number of their table; the page keeps the minutes of other tables.
    """
    before = {line.split(" | ")[0].removeprefix("| "): line for line in page.splitlines()}
    lines, counted = [], set[str]()
    for name, table in TABLES.items():
        own_sweeps = [sweep for sweep in table.sweeps if sweep not in counted]
        counted.update(own_sweeps)
        finished = [job for sweep in own_sweeps for job in completed_jobs(FOLDER / sweep)]
        if not finished and name in before:
            lines.append(before[name])
            continue
        planned = sum(count_runs(table.sweeps[sweep], table.seeds) for sweep in own_sweeps)
        links = ", ".join(link(script) for script in (table.script, *table.also))
        seconds = sum(
            wall_seconds(job) if table.alone else processor_seconds(job) / AT_ONCE for job in finished
        )
        on_pages = written.get(name, cell(before.get(name, ""), PAGES))
        minutes = [one_decimal(seconds / 60), one_decimal(on_pages)]
        cells = [
            name,
            table.about,
            links,
            f"{len(finished)} of {planned}",
            *minutes,
            machine_and_day(finished),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(
        [
            "# The thesis's tables, run (synthetic data)",
            "",
            "This page lists which tables and figures of the thesis have been repeated, when, and how long the "
            "training runs took. `python -m reproduction.thesis_tables` makes all of them, and with `--tell` it only "
            "prints the commands. "
            "The columns of the table mean:",
            "- **Runs, complete** is the number of runs that are complete and the number of runs that the table needs. "
            "Runs that several tables share are counted only in the first of their rows.",
            "- **Minutes of runs** is the time that the runs take if two of them run at the same time on one thread "
            "each, which is half of their processor time. The runs of Table 6.4 use two threads each, so that their "
            "elapsed time is given.",
            "- **Minutes of pages** is the elapsed time of the scripts that evaluate the runs and write the pages.",
            "",
            "| table or figure | data | page | runs, complete | minutes of runs | minutes of pages | processor; last "
            "run |",
            "|---|---|---|---:|---:|---:|---|",
            *lines,
            "",
            f"All runs and pages together take {format_number(total_hours(lines))} hours on two cores, and "
            f"{format_number(total_hours([line for line in lines if not line.startswith(FIGURES)]))} hours without "
            f"Figures 3.7 and 3.8. {machine('torch', 'pytorch-lightning')}",
            "",
        ]
    )


def total_hours(lines: Sequence[str]) -> float:
    """Return the hours of all runs and pages, or NaN if the minutes of a table are not known."""
    return sum(run_minutes(line) + cell(line, PAGES) for line in lines) / 60


def run_minutes(line: str) -> float:
    """Estimate the minutes of all runs of a table from the complete ones; return NaN if none is complete."""
    finished, _, planned = line.split(" | ")[RUNS].partition(" of ")
    return cell(line, MINUTES) * int(planned) / int(finished) if int(finished) > 0 else math.nan


def cell(line: str, column: int) -> float:
    """Return the number in a column of a table line, or NaN if it holds no number."""
    cells = line.split(" | ")
    known = len(cells) > column and re.fullmatch(r"[\d.]+", cells[column])
    return float(cells[column]) if known else math.nan


def one_decimal(minutes: float) -> str:
    return NOT_AVAILABLE if math.isnan(minutes) else f"{minutes:.1f}"


def machine_and_day(jobs: Sequence[Mapping[str, Any]]) -> str:
    """Return the processor and the day on which the last job ended."""
    if not jobs:
        return NOT_AVAILABLE
    day = datetime.date.fromtimestamp(max(job["ended"] for job in jobs))
    return f"{environment().partition(';')[0]}; {day.isoformat()}"


def link(script: str) -> str:
    """Return a link to the page of a script, or its name if the page does not exist."""
    page = Path(*script.split(".")).with_suffix(".md")
    return f"[{page.name}]({page.as_posix()})" if (HERE.parent / page).exists() else page.name


def count_runs(words: Sequence[str], seeds: int) -> int:
    """Return the number of runs of a sweep with the overrides `words`; `seeds` counts if these name no seed."""
    return len(expand_sweep(words)) * (1 if any(word.startswith("seed=") for word in words) else seeds)


def expand_sweep(words: Sequence[str]) -> list[list[str]]:
    """Return the overrides of every run of a sweep, in the order of Hydra."""
    choices_by_key = [
        (key, split_values(values)) for key, _, values in (word.partition("=") for word in words)
    ]
    return [
        list(run)
        for run in itertools.product(
            *([f"{key}={value}" for value in values] for key, values in choices_by_key)
        )
    ]


def split_values(text: str) -> list[str]:
    """Split the values of one setting of a sweep: "[a,b],c" gives "[a,b]" and "c"."""
    return re.findall(r"\[[^]]*\]|[^,]+", text)


def completed_jobs(sweep: Path) -> list[dict[str, Any]]:
    """Return the records of the completed jobs of a sweep."""
    jobs = [record(path.parent) for path in sorted(sweep.glob("*/job.json"))]
    return [job for job in jobs if job["status"] == "completed"]


if __name__ == "__main__":
    main()
