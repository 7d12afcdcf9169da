"""Measure what rendering networks gain with training time, against meshes.

    python -m reproduction.chapter7.smplpix_training [--skins <folder>]

Runs what outputs/smplpix_training does not hold yet, five hours of one core, and goes on where it was stopped;
`--there` runs nothing. Every row of smplpix_training.csv stays until its own runs are there again.
"""

import argparse
import csv
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, write_page
from framework.configuration.loading import load, load_with_description, reader
from framework.figures.style import GREEN, GREY, RED, titled_figure
from reproduction.chapter7 import smplpix_table as table

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/smplpix_training"
RECORD = HERE.with_suffix(".csv")
SKINS = "Skins nobody wore in training"
WORN = "skins, "
"""What names of methods begin with whose people wear skins."""


@dataclass(frozen=True)
class Method:
    """
    Attributes:
        folder: what the folders of its runs begin with.
        words: arguments of its runs.
        seeds: of trainings by their epochs, each with a schedule of its own; {0: (0,)} where nothing is trained.
    """

    folder: str
    words: tuple[str, ...]
    seeds: Mapping[int, tuple[int, ...]] = field(default_factory=lambda: {0: (0,)})

    def place(self, epochs: int, seed: int) -> Path:
        return FOLDER / (f"{self.folder}_{epochs}_{seed}" if epochs else self.folder)


@dataclass(frozen=True)
class Row:
    """What the record holds of a method's trainings of as many epochs.

    Attributes:
        seeds: that ran.
        minutes: epochs times the shortest one of all runs, since the machine did other work too.
        means, spreads: by key of `COLUMNS`, over seeds; the standard deviation is NaN of one.
        measured: machine and date.
    """

    seeds: int
    minutes: float
    means: Mapping[str, float]
    spreads: Mapping[str, float]
    measured: str


Record = dict[tuple[str, int], Row]
"""By method and epochs."""


def over(experiment: str, *more: str) -> tuple[str, ...]:
    return (f"experiment=smplpix/{experiment}", *more)


BUDGETS = {2: (0,), 6: (0,), 20: (0, 1, 2)}
METHODS = {
    "mesh, 7k": Method("rasterised_7k", over("rasterised")),
    "mesh, 7k, one sample a pixel": Method(
        "rasterised_7k_plain", over("rasterised", "encoder.rasterised.renderer.supersampling=1")
    ),
    "mesh, 27k": Method("rasterised_27k", over("rasterised", "data.topology=27k")),
    "points alone, 7k": Method("quick_7k", over("quick"), {**BUDGETS, 60: (0,)}),
    "points alone, 7k, no splats": Method(
        "bare_7k", over("quick", "encoder.projection.splat=0", "encoder.slim.residual=false"), {20: (0,)}
    ),
    "points alone, 27k": Method("quick_27k", over("quick", "data.topology=27k"), {20: (0,)}),
    "over the mesh, 7k": Method("hybrid_7k", over("hybrid"), BUDGETS),
    "over the mesh, 27k": Method("hybrid_27k", over("hybrid", "data.topology=27k"), {20: (0,)}),
}
DRAWN = {"points alone, 7k": RED, "over the mesh, 7k": GREEN}
LINES = {"mesh, 7k": "-", "mesh, 27k": "--"}
RIVAL = "mesh, 7k"
COLUMNS = {key: told for key, told in table.COLUMNS.items() if not key.startswith("lpips")}


def recorded() -> Record:
    if not RECORD.is_file():
        return {}
    with RECORD.open(encoding="utf-8", newline="") as file:
        return {
            (line["method"], int(line["epochs"])): Row(
                int(line["seeds"]),
                float(line["minutes"]),
                {key: float(line[key]) for key in COLUMNS},
                {key: float(line[f"{key}_sd"]) for key in COLUMNS},
                line["measured"],
            )
            for line in csv.DictReader(file)
        }


def record(rows: Record) -> None:
    names = [*COLUMNS, *(f"{key}_sd" for key in COLUMNS)]
    with RECORD.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["method", "epochs", "seeds", "minutes", *names, "measured"])
        for (name, epochs), row in rows.items():
            numbers = [row.means[key] for key in COLUMNS] + [row.spreads[key] for key in COLUMNS]
            told = [f"{number:.6g}" for number in numbers]
            writer.writerow([name, epochs, row.seeds, f"{row.minutes:.2f}", *told, row.measured])


def recorded_already(row: Row, known: Row) -> bool:
    """Whether they are of the same runs, so that minutes, machine and date stay."""
    same = all(math.isclose(row.means[key], known.means[key], rel_tol=1e-5) for key in COLUMNS)
    return same and row.seeds == known.seeds


def run(method: Method, epochs: int, seed: int) -> None:
    words = [*method.words, f"seed={seed}", "threads=1", "logger=none"]
    words += [f"hydra.run.dir={method.place(epochs, seed)}"]
    words += [f"trainer.max_epochs={epochs}"] if epochs else []
    carry_out([sys.executable, "-m", "framework", *words])


def measured(method: Method, epochs: int) -> Row | None:
    """What the folders of its runs say; None where none has ended."""
    places = [method.place(epochs, seed) for seed in method.seeds[epochs]]
    there = [place for place in places if (place / "results.json").is_file()]
    if not there:
        return None
    results = [json.loads((place / "results.json").read_text()) for place in there]
    values = {key: [result[key] for result in results] for key in COLUMNS}
    return Row(
        len(there),
        epochs * epoch_minutes(method) if epochs else 0.0,
        {key: float(np.mean(some)) for key, some in values.items()},
        {key: float(np.std(some, ddof=1)) if len(some) > 1 else float("nan") for key, some in values.items()},
        machine("torch", "numpy"),
    )


def epoch_minutes(method: Method) -> float:
    """Of an epoch on one core, the shortest of all runs."""
    found = []
    for place in FOLDER.glob(f"{method.folder}_*"):
        lines = [json.loads(line) for line in (place / "journal.jsonl").read_text().splitlines()]
        ends = [line["time"] for line in lines if "validation/loss" in line.get("values", {})]
        found += [after - before for before, after in pairwise(ends)]
    return min(found) / 60


def crossing(minutes: Sequence[float], values: Sequence[float], level: float) -> str:
    """When a curve rises above a level, straight between trainings in the logarithm of time."""
    for first, (before, after) in enumerate(pairwise(values)):
        if before <= level < after:
            share = (level - before) / (after - before)
            return f"after {np.exp(np.interp(share, [0, 1], np.log(minutes[first : first + 2]))):.0f} minutes"
    return (
        f"before {minutes[0]:.0f} minutes" if values[0] > level else f"not within {minutes[-1]:.0f} minutes"
    )


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--skins", help="folder of skins in the default body's texture layout")
    arguments.add_argument("--there", action="store_true", help="run nothing, report what is there")
    given = arguments.parse_args()
    methods = dict(METHODS)
    if given.skins:
        worn = f"data.skins={given.skins}"
        methods |= {
            f"{WORN}{RIVAL}": Method("skins_rasterised_7k", over("rasterised", worn)),
            f"{WORN}over the mesh, 7k": Method("skins_hybrid_7k", over("hybrid", worn), {20: (0,)}),
        }
    before, found = recorded(), {}
    for name, method in methods.items():
        for epochs, seeds in method.seeds.items():
            for seed in () if given.there else seeds:
                if not (method.place(epochs, seed) / "results.json").is_file():
                    run(method, epochs, seed)
            row, known = measured(method, epochs), before.get((name, epochs))
            if known and (row is None or recorded_already(row, known)):
                row = known
            if row is not None:
                found[name, epochs] = row
    found |= {key: row for key, row in before.items() if key not in found}
    record(found)
    draw(found, HERE.with_suffix(".png"))
    sheet(HERE.with_name(HERE.stem + "_people.png"))
    write_page(HERE, report(found))


def report(rows: Record) -> str:
    def lines(worn: bool) -> list[str]:
        told = []
        for (name, epochs), row in rows.items():
            if name.startswith(WORN) is not worn:
                continue
            cells = []
            for key, (_, decimals) in COLUMNS.items():
                spread = "" if math.isnan(row.spreads[key]) else f" ± {row.spreads[key]:.{decimals}f}"
                cells.append(f"{row.means[key]:.{decimals}f}{spread}")
            trained = f"{epochs} | {row.minutes:.0f} | {row.seeds}" if epochs else "– | – | –"
            told.append(f"| {name.removeprefix(WORN)} | {trained} | {' | '.join(cells)} |")
        return told

    header = [
        f"| | epochs | minutes | seeds | {' | '.join(heading for heading, _ in COLUMNS.values())} |",
        f"|---|{'---:|' * (3 + len(COLUMNS))}",
    ]
    crossings = []
    for name in DRAWN:
        budgets = curve(rows, name)
        for key, heading in (
            ("psnr_db", "PSNR"),
            ("psnr_masked_db", "PSNR inside"),
            ("ssim_masked", "SSIM inside"),
        ):
            values = [row.means[key] for row in budgets]
            when = crossing([row.minutes for row in budgets], values, rows[RIVAL, 0].means[key])
            crossings.append(f"- {name}, {heading}: above the mesh of 7k {when}.")
    missing = [
        f"{name}, {epochs} epochs"
        for name, method in METHODS.items()
        for epochs in method.seeds
        if (name, epochs) not in rows
    ]
    skins = lines(worn=True)
    machines: dict[str, list[str]] = {}
    for (name, epochs), row in rows.items():
        machines.setdefault(row.measured, []).append(f"{name}, {epochs} epochs" if epochs else name)
    usual = max(machines, key=lambda one: len(machines[one]))
    others = [f"{'; '.join(names)}: {one}" for one, names in machines.items() if one != usual]
    return "\n".join(
        [
            "# Rendering networks against meshes, by training time (synthetic people)",
            "",
            "Generated people (`human_scans`, not real ones): 160 to train on, 96 views of 16 unseen ones, 256 × 192. "
            "Meshes are drawn with their vertices' colours, 4 × 4 samples a pixel unless said. Inside: over the "
            "subject's pixels. ± is the standard deviation over seeds, where there are several. Each budget is a "
            "training of its own, whose rate falls to 0 at its end. Minutes: epochs times the shortest one, one core.",
            "",
            f"![curves]({HERE.stem}.png)",
            "",
            *header,
            *lines(worn=False),
            "",
            *crossings,
            "",
            f"![people]({HERE.stem}_people.png)",
            "",
            "From the left: photograph, mesh, points alone, network over the mesh (20 epochs); then where each is off.",
            "",
            *([f"## {SKINS}", "", *header, *skins, ""] if skins else []),
            *([f"Not run: {'; '.join(missing)}.", ""] if missing else []),
            *([f"Measured elsewhere or on another day: {' '.join(others)}", ""] if others else []),
            f"{usual} Command: `python -m reproduction.chapter7.smplpix_training"
            f"{' --skins <folder>' if skins else ''}{' --there' if missing else ''}`.",
            "",
        ]
    )


def curve(rows: Record, name: str) -> list[Row]:
    """A method's rows by their epochs."""
    return [row for (which, _), row in sorted(rows.items()) if which == name]


def draw(rows: Record, place: Path) -> None:
    figure = titled_figure(
        (10, 4), "Unseen people, 256 × 192 pixels; bars: standard deviation over seeds", True
    )
    panels = figure.subplots(1, 2)
    for axes, key, label in zip(
        panels,
        ("psnr_db", "ssim_masked"),
        ("PSNR of the frame, dB", "SSIM inside the subject"),
        strict=True,
    ):
        for name, colour in DRAWN.items():
            budgets = curve(rows, name)
            minutes, values = [row.minutes for row in budgets], [row.means[key] for row in budgets]
            spreads = np.nan_to_num([row.spreads[key] for row in budgets])
            axes.errorbar(minutes, values, spreads, color=colour, marker="o", capsize=3, label=name)
        for name, dashes in LINES.items():
            axes.axhline(rows[name, 0].means[key], color=GREY, linestyle=dashes, label=name)
        axes.set(xscale="log", xlabel="minutes of training on one core", ylabel=label)
        ticks = [2, 5, 10, 20, 50]
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
    panels[0].legend(loc="lower right")
    figure.savefig(place)


@torch.inference_mode()
def sheet(place: Path, chosen: Sequence[int] = (0, 20, 44, 75)) -> None:
    """Photographs of unseen people, their images, and where these are off; as it was where a run is not there."""
    names = {RIVAL: 0, "points alone, 7k": 20, "over the mesh, 7k": 20}
    runs = [METHODS[name].place(epochs, 0) for name, epochs in names.items()]
    if not all((run / "results.json").is_file() for run in runs):
        return
    _, description = load_with_description(runs[0])
    data = reader(description)
    data.prepare()
    test = data.splits().test
    inputs = torch.stack([test[row]["input"] for row in chosen])
    truths = torch.stack([test[row]["target"] for row in chosen])
    pictures = [load(run)(inputs).mean.reshape(truths.shape).clamp(0, 1) for run in runs]
    columns = [truths, *pictures, *((1 - 3 * (picture - truths).abs()).clamp(0, 1) for picture in pictures)]
    figure = titled_figure((1.5 * len(columns), 2.0 * len(chosen)), "Unseen people", True)
    titles = [
        "photograph",
        "mesh",
        "points alone",
        "over the mesh",
        *(f"{name}, 3 × error" for name in ("mesh", "points", "over it")),
    ]
    for row, line in enumerate(figure.subplots(len(chosen), len(columns))):
        for axes, column, title in zip(line, columns, titles, strict=True):
            axes.imshow(column[row].numpy())
            axes.set_axis_off()
            if row == 0:
                axes.set_title(title, fontsize=9)
    figure.savefig(place)


if __name__ == "__main__":
    main()
