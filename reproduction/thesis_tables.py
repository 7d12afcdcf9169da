"""Make Tables 2.1, 3.1 to 3.3, 6.1 to 6.4 and Figures 3.7 and 3.8 of the thesis with one command.

    python -m reproduction.thesis_tables [2.1 3.3 ...] [--seeds 5] [--jobs 2] [--bfloat16]

Without numbers all of them. What has run in outputs/thesis_tables does not run again, so that the same command goes on
where it was stopped. Each table's own script writes its page; thesis_tables.md says what ran and for how long.
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
from benchmarks.pages import machine
from benchmarks.sweeps import processor_seconds, record, wall_seconds
from framework.reports.table import NOT_AVAILABLE, format_number

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/thesis_tables"
SAID = ("pictures=false", "logger=none")
FIGURES = "| 3.7-3.8 |"
AT_ONCE = 2
"""Runs, for the minutes that the page says."""
RUNS, MINUTES, PAGES = 3, 4, 5
"""Columns of the page."""
BFLOAT16 = "trainer.precision=bf16-mixed"
"""For convolutions, where asked for: it pays on a processor that has avx512_bf16."""
CLASSES = (
    *("aeroplane", "bicycle", "boat", "bottle", "bus", "car", "chair", "diningtable", "motorbike", "sofa"),
    *("train", "tvmonitor"),
)
"""Table 3.3's."""
SOME = ("bottle", "car", "diningtable")
"""One that looks alike from everywhere, one from nowhere, one after half a turn: every method, three seeds. Of the
other classes three methods, one seed."""
BY_HAND = ("bps_conv3d_ensemble", "pointnet2")
"""Two rows of Table 6.2, ten convolutional networks and PointNet++ of three sizes of balls, that take two to three
hours of one core each: not in what is run here, but `modelnet40.py` takes their runs."""
MODELNET = sorted(
    path.stem
    for path in (ROOT / "conf/experiment/modelnet40").glob("*.yaml")
    if path.stem not in ("base", *BY_HAND)
)
SLOW = (
    *("pointnet2_single", "bps_conv3d_delta", "bps_conv3d", "bps_conv3d_unpadded"),
    *("pointnet", "deepsets", "pointnet_vanilla"),
)
"""Rows of Tables 6.1 to 6.3 that take more than five minutes of a core: one seed, three of the others. The longest
first, so that no core waits long for the last of them."""


class Table(NamedTuple):
    """Runs and the page that is made of them.

    Attributes:
        about: what it is, where other than the thesis's.
        sweeps: arguments of each multirun, by its folder.
        script: module of reproduction; it is given the folders of its sweeps, or of the only run of each where `alone`.
        seeds: most that are run of each sweep that does not name its own.
        alone: whether each sweep has one run, which then has as many threads as others have runs at once.
        convolves: whether `--bfloat16` is for it.
        also: further scripts, each with a page of the same runs.
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
"""IDIAP's heads in half of their pixels, as large as the other two sets'; `preset=thesis` keeps 75."""
HEADS = (methods("idiap", "fixed_kappa", "von_mises", "cvae"), "data.angles=[pan],[tilt],[roll]", SMALL)
SHORT, SHORTER = "trainer.max_epochs=20", "trainer.max_epochs=15"
"""Two thirds of the experiments' epochs and half of them, so that two cores are done in four hours."""

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
        "the pan of those heads of IDIAP under blur; its other runs are Table 3.1's",
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
                f"data.category={','.join(SOME)}",
                SHORT,
            ),
            "pascal3d_classes": (
                methods("pascal3d", "fixed_kappa", "von_mises", "scvae"),
                f"data.category={','.join(name for name in CLASSES if name not in SOME)}",
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
            "modelnet40_quick": (methods("modelnet40", *(name for name in MODELNET if name not in SLOW)),),
            "modelnet40_turned": (methods("modelnet40", "bps_mlp"), "data.rotations=4"),
            "modelnet40_slow": (methods("modelnet40", *SLOW), "seed=0"),
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
    arguments.add_argument("tables", nargs="*", metavar="TABLE", help=f"of {', '.join(TABLES)}; none: all")
    arguments.add_argument("--seeds", type=int, default=5, help="at most, for each table")
    arguments.add_argument("--jobs", type=int, default=2, help="runs at once")
    arguments.add_argument("--bfloat16", action="store_true", help="train convolutions in mixed precision")
    arguments.add_argument("--tell", action="store_true", help="print the commands, run nothing")
    given = arguments.parse_args()
    unknown = [name for name in given.tables if name not in TABLES]
    if unknown:
        arguments.error(f"no table {', '.join(unknown)}; there are {', '.join(TABLES)}")
    for name in given.tables or TABLES:
        sweeps, pages = commands(name, given.seeds, given.jobs, given.bfloat16)
        if not given.tell:
            for sweep, words in TABLES[name].sweeps.items():
                put_aside(FOLDER / sweep, (*words, *said(TABLES[name], given.jobs, given.bfloat16)))
        told(sweeps, run=not given.tell)
        began = time.perf_counter()
        told(pages, run=not given.tell)
        if not given.tell:  # after each: who stops it during the next loses nothing
            page = HERE.with_suffix(".md")
            written = {name: (time.perf_counter() - began) / 60}
            page.write_text(report(page.read_text(encoding="utf-8"), written), encoding="utf-8")


def told(commands: Sequence[Sequence[str]], *, run: bool) -> None:
    for command in commands:
        sys.stdout.write(" ".join(command[1:]) + "\n")
        sys.stdout.flush()
        if run:
            carry_out(command)


def said(table: Table, jobs: int, bfloat16: bool) -> tuple[str, ...]:
    """What every run of a table is told."""
    precision = (BFLOAT16,) if bfloat16 and table.convolves else ()
    return (*precision, *SAID, f"threads={jobs if table.alone else 1}")


def commands(name: str, seeds: int, jobs: int, bfloat16: bool) -> tuple[list[list[str]], list[list[str]]]:
    """Of a table: its sweeps; its pages, which are made of them."""
    table = TABLES[name]
    found = [
        [
            *(sys.executable, "-m", "framework", "-m", *with_seeds(words, seeds, table.seeds)),
            *said(table, jobs, bfloat16),
            *(f"hydra.launcher.jobs={jobs}", f"hydra.sweep.dir={folder_of(sweep)}"),
        ]
        for sweep, words in table.sweeps.items()
    ]
    folders = [folder_of(sweep) + ("/0" if table.alone else "") for sweep in table.sweeps]
    pages = [
        [sys.executable, "-m", f"reproduction.{script}", *folders] for script in (table.script, *table.also)
    ]
    return found, pages


def with_seeds(words: Sequence[str], seeds: int, most: int) -> list[str]:
    """What a multirun is told, its seeds too: of those that it names, or of as many as a table has at most."""
    named = [word for word in words if word.startswith("seed=")]
    drawn = options(named[0].partition("=")[2]) if named else [str(seed) for seed in range(most)]
    return [*(word for word in words if word not in named), f"seed={','.join(drawn[:seeds])}"]


def put_aside(sweep: Path, words: Sequence[str]) -> None:
    """Move what ran under another definition of a sweep to a folder beside, where no page meets it.

    Args:
        sweep: its folder.
        words: what its runs are told now; where they name no seed, of any seed they belong to it.
    """
    asked = {key: options(told) for key, _, told in (word.partition("=") for word in words)}
    for path in sorted(sweep.glob("*/job.json")):
        job = record(path.parent)
        told = dict(word.split("=", 1) for word in job["overrides"])
        if "seed" not in asked:
            told.pop("seed", None)
        if job["status"] == "running" or (
            told.keys() == asked.keys()
            and all({value, value.lower()} & {*asked[key]} for key, value in told.items())
        ):
            continue
        for number in itertools.count():
            aside = sweep.parent / "aside" / f"{sweep.name}_{path.parent.name}_{number}"
            if not aside.exists():
                break
        aside.parent.mkdir(exist_ok=True)
        path.parent.rename(aside)
        sys.stdout.write(
            f"{sweep.name}/{path.parent.name} is of another definition of the sweep: now {aside}\n"
        )


def folder_of(sweep: str) -> str:
    return os.path.relpath(FOLDER / sweep, ROOT)


def report(page: str, written: Mapping[str, float]) -> str:
    """The page anew; of tables whose runs are not on this machine it keeps what it said.

    Args:
        page: what it was.
        written: minutes that the pages of a table took; of others it keeps what it said too.
    """
    before = {line.split(" | ")[0].removeprefix("| "): line for line in page.splitlines()}
    lines, counted = [], set[str]()
    for name, table in TABLES.items():
        own = [sweep for sweep in table.sweeps if sweep not in counted]
        counted.update(own)
        done = [job for sweep in own for job in completed(FOLDER / sweep)]
        if not done and name in before:
            lines.append(before[name])
            continue
        asked = sum(choices(table.sweeps[sweep], table.seeds) for sweep in own)
        shown = ", ".join(link(script) for script in (table.script, *table.also))
        seconds = sum(wall_seconds(job) if table.alone else processor_seconds(job) / AT_ONCE for job in done)
        on_pages = written.get(name, cell(before.get(name, ""), PAGES))
        told = [one_decimal(seconds / 60), one_decimal(on_pages)]
        cells = [name, table.about, shown, f"{len(done)} of {asked}", *told, when(done)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(
        [
            "# The thesis's tables, run (synthetic data)",
            "",
            "Commands: `python -m reproduction.thesis_tables --tell` prints them. Minutes of runs: half of their "
            "processor time, for two run at once, on one thread each; of Table 6.4, whose runs have two threads, by "
            "the clock. Minutes of pages, which a script makes of the runs: by the clock. Each page says of which "
            "runs it is: of a table not yet run whole, of some of these, or of older ones.",
            "",
            "| table | data | page | runs | minutes of runs | of pages | on |",
            "|---|---|---|---:|---:|---:|---|",
            *lines,
            "",
            f"Hours that the whole takes two cores: {format_number(hours(lines))}; without Figures 3.7 and 3.8 "
            f"{format_number(hours([line for line in lines if not line.startswith(FIGURES)]))}. "
            f"{machine('torch', 'pytorch-lightning')}",
            "",
        ]
    )


def hours(lines: Sequence[str]) -> float:
    """Of all runs and pages; NaN where those of a table are not known."""
    return sum(minutes_of(line) + cell(line, PAGES) for line in lines) / 60


def minutes_of(line: str) -> float:
    """What all runs of a table would take, by those that have run; NaN where none has."""
    done, _, asked = line.split(" | ")[RUNS].partition(" of ")
    return cell(line, MINUTES) * int(asked) / int(done) if int(done) > 0 else math.nan


def cell(line: str, column: int) -> float:
    """NaN where there is no number."""
    cells = line.split(" | ")
    known = len(cells) > column and re.fullmatch(r"[\d.]+", cells[column])
    return float(cells[column]) if known else math.nan


def one_decimal(minutes: float) -> str:
    return NOT_AVAILABLE if math.isnan(minutes) else f"{minutes:.1f}"


def when(jobs: Sequence[Mapping[str, Any]]) -> str:
    """Processor, and the day on which the last of them ended."""
    if not jobs:
        return NOT_AVAILABLE
    day = datetime.date.fromtimestamp(max(job["ended"] for job in jobs))
    return f"{machine().partition(';')[0]}; {day.isoformat()}"


def link(script: str) -> str:
    """Return a link to the page of a script, or its name where no page is there."""
    page = Path(*script.split(".")).with_suffix(".md")
    return f"[{page.name}]({page.as_posix()})" if (HERE.parent / page).exists() else page.name


def choices(words: Sequence[str], seeds: int) -> int:
    """How many runs a multirun has."""
    return len(each(words)) * (1 if any(word.startswith("seed=") for word in words) else seeds)


def each(words: Sequence[str]) -> list[list[str]]:
    """What every run of a multirun is told, in Hydra's order."""
    taken = [(key, options(told)) for key, _, told in (word.partition("=") for word in words)]
    return [
        list(run) for run in itertools.product(*([f"{key}={one}" for one in told] for key, told in taken))
    ]


def options(told: str) -> list[str]:
    """What a multirun is told of one setting, taken apart: "[a,b],c" to "[a,b]" and "c"."""
    return re.findall(r"\[[^]]*\]|[^,]+", told)


def completed(sweep: Path) -> list[dict[str, Any]]:
    """Jobs of a sweep."""
    jobs = [record(path.parent) for path in sorted(sweep.glob("*/job.json"))]
    return [job for job in jobs if job["status"] == "completed"]


if __name__ == "__main__":
    main()
