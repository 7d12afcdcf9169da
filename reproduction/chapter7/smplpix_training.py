"""Measure what rendering networks gain with training time, and compare them with rasterised meshes.

    python -m reproduction.chapter7.smplpix_training [--skins <folder>]

The script trains the runs that outputs/smplpix_training does not hold yet, which takes up to five hours of one core,
and continues after an interruption. With `--there` it trains nothing. A row of smplpix_training.csv whose runs do not
exist stays unchanged.
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
from benchmarks.pages import environment, write_page
from framework.configuration.loading import load, load_with_description, reader
from framework.figures.style import GREEN, GREY, RED, titled_figure
from reproduction.chapter7 import smplpix_table as table

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/smplpix_training"
RECORD = HERE.with_suffix(".csv")
SKINS = "People with skins that are not in the training data"
SKINS_PREFIX = "skins, "
"""Prefix of the names of methods that are tested on people with skins."""


@dataclass(frozen=True)
class Method:
    """A mesh or a network of the table.

    Attributes:
        folder: Beginning of the names of its run folders.
        words: Overrides of its runs.
        seeds: Seeds by number of epochs, each a training with its own schedule; {0: (0,)} if nothing is trained.
    """

    folder: str
    words: tuple[str, ...]
    seeds: Mapping[int, tuple[int, ...]] = field(default_factory=lambda: {0: (0,)})

    def place(self, epochs: int, seed: int) -> Path:
        return FOLDER / (f"{self.folder}_{epochs}_{seed}" if epochs else self.folder)


@dataclass(frozen=True)
class Row:
    """A row of the record: the trainings of one method with one number of epochs.

    Attributes:
        seeds: Number of seeds that ran.
        minutes: Minutes of a training: the number of epochs times the duration of the shortest epoch of all runs. The
            shortest is taken because the machine also did other work.
        means: Means over seeds, by key of `COLUMNS`.
        spreads: Standard deviations over seeds, by key of `COLUMNS`; NaN for one seed.
        measured: Machine and date.
    """

    seeds: int
    minutes: float
    means: Mapping[str, float]
    spreads: Mapping[str, float]
    measured: str


Record = dict[tuple[str, int], Row]
"""Rows by method and number of epochs."""


def overrides_of(experiment: str, *more: str) -> tuple[str, ...]:
    return (f"experiment=smplpix/{experiment}", *more)


BUDGETS = {2: (0,), 6: (0,), 20: (0, 1, 2)}
METHODS = {
    "mesh, 7k": Method("rasterised_7k", overrides_of("rasterised")),
    "mesh, 7k, one sample a pixel": Method(
        "rasterised_7k_plain", overrides_of("rasterised", "encoder.rasterised.renderer.supersampling=1")
    ),
    "mesh, 27k": Method("rasterised_27k", overrides_of("rasterised", "data.topology=27k")),
    "points alone, 7k": Method("quick_7k", overrides_of("quick"), {**BUDGETS, 60: (0,)}),
    "points alone, 7k, no splats": Method(
        "bare_7k",
        overrides_of("quick", "encoder.projection.splat=0", "encoder.slim.residual=false"),
        {20: (0,)},
    ),
    "points alone, 27k": Method("quick_27k", overrides_of("quick", "data.topology=27k"), {20: (0,)}),
    "over the mesh, 7k": Method("hybrid_7k", overrides_of("hybrid"), BUDGETS),
    "over the mesh, 27k": Method("hybrid_27k", overrides_of("hybrid", "data.topology=27k"), {20: (0,)}),
}
DRAWN = {"points alone, 7k": RED, "over the mesh, 7k": GREEN}
LINES = {"mesh, 7k": "-", "mesh, 27k": "--"}
BASELINE = "mesh, 7k"
COLUMNS = {key: heading for key, heading in table.COLUMNS.items() if not key.startswith("lpips")}


def read_record() -> Record:
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


def write_record(rows: Record) -> None:
    names = [*COLUMNS, *(f"{key}_sd" for key in COLUMNS)]
    with RECORD.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["method", "epochs", "seeds", "minutes", *names, "measured"])
        for (name, epochs), row in rows.items():
            numbers = [row.means[key] for key in COLUMNS] + [row.spreads[key] for key in COLUMNS]
            formatted = [f"{number:.6g}" for number in numbers]
            writer.writerow([name, epochs, row.seeds, f"{row.minutes:.2f}", *formatted, row.measured])


def is_same_run(row: Row, known: Row) -> bool:
    """Return whether a new row holds the same runs as the recorded row `known`.

    The recorded minutes, machine and date are then kept.
    """
    same = all(math.isclose(row.means[key], known.means[key], rel_tol=1e-5) for key in COLUMNS)
    return same and row.seeds == known.seeds


def run_training(method: Method, epochs: int, seed: int) -> None:
    words = [*method.words, f"seed={seed}", "threads=1", "logger=none"]
    words += [f"hydra.run.dir={method.place(epochs, seed)}"]
    words += [f"trainer.max_epochs={epochs}"] if epochs else []
    carry_out([sys.executable, "-m", "framework", *words])


def read_runs(method: Method, epochs: int) -> Row | None:
    """Return the row of a method trained for `epochs` epochs, from its run folders; None if no run has finished."""
    folders = [method.place(epochs, seed) for seed in method.seeds[epochs]]
    finished = [folder for folder in folders if (folder / "results.json").is_file()]
    if not finished:
        return None
    results = [json.loads((folder / "results.json").read_text()) for folder in finished]
    values = {key: [result[key] for result in results] for key in COLUMNS}
    return Row(
        len(finished),
        epochs * epoch_minutes(method) if epochs else 0.0,
        {key: float(np.mean(numbers)) for key, numbers in values.items()},
        {
            key: float(np.std(numbers, ddof=1)) if len(numbers) > 1 else float("nan")
            for key, numbers in values.items()
        },
        environment("torch", "numpy"),
    )


def epoch_minutes(method: Method) -> float:
    """Return the minutes of the shortest epoch of all runs of a method on one core."""
    durations = []
    for place in FOLDER.glob(f"{method.folder}_*"):
        lines = [json.loads(line) for line in (place / "journal.jsonl").read_text().splitlines()]
        ends = [line["time"] for line in lines if "validation/loss" in line.get("values", {})]
        durations += [after - before for before, after in pairwise(ends)]
    return min(durations) / 60


def crossing(minutes: Sequence[float], values: Sequence[float], level: float) -> str:
    """Return in words after how many minutes a curve rises above a level.

    The curve is interpolated linearly in the logarithm of time.

    Args:
        minutes: Times of the points of the curve, ascending.
        values: Values of the points.
        level: The level.
    """
    for first, (before, after) in enumerate(pairwise(values)):
        if before <= level < after:
            share = (level - before) / (after - before)
            return f"after {np.exp(np.interp(share, [0, 1], np.log(minutes[first : first + 2]))):.0f} minutes"
    return (
        f"already after {minutes[0]:.0f} minutes"
        if values[0] > level
        else f"at no time within {minutes[-1]:.0f} minutes"
    )


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--skins", help="folder of skins in the default body's texture layout")
    arguments.add_argument("--there", action="store_true", help="train nothing, report the runs that exist")
    options = arguments.parse_args()
    methods = dict(METHODS)
    if options.skins:
        worn = f"data.skins={options.skins}"
        methods |= {
            f"{SKINS_PREFIX}{BASELINE}": Method("skins_rasterised_7k", overrides_of("rasterised", worn)),
            f"{SKINS_PREFIX}over the mesh, 7k": Method(
                "skins_hybrid_7k", overrides_of("hybrid", worn), {20: (0,)}
            ),
        }
    before, rows = read_record(), {}
    for name, method in methods.items():
        for epochs, seeds in method.seeds.items():
            for seed in () if options.there else seeds:
                if not (method.place(epochs, seed) / "results.json").is_file():
                    run_training(method, epochs, seed)
            row, known = read_runs(method, epochs), before.get((name, epochs))
            if known and (row is None or is_same_run(row, known)):
                row = known
            if row is not None:
                rows[name, epochs] = row
    rows |= {key: row for key, row in before.items() if key not in rows}
    write_record(rows)
    draw_curves(rows, HERE.with_suffix(".png"))
    draw_people(HERE.with_name(HERE.stem + "_people.png"))
    write_page(HERE, report(rows))


def report(rows: Record) -> str:
    def lines(worn: bool) -> list[str]:
        table_lines = []
        for (name, epochs), row in rows.items():
            if name.startswith(SKINS_PREFIX) is not worn:
                continue
            cells = []
            for key, (_, decimals) in COLUMNS.items():
                spread = "" if math.isnan(row.spreads[key]) else f" ± {row.spreads[key]:.{decimals}f}"
                cells.append(f"{row.means[key]:.{decimals}f}{spread}")
            trained = f"{epochs} | {row.minutes:.0f} | {row.seeds}" if epochs else "– | – | –"
            table_lines.append(f"| {name.removeprefix(SKINS_PREFIX)} | {trained} | {' | '.join(cells)} |")
        return table_lines

    header = [
        f"| method | epochs | minutes | seeds | {' | '.join(heading for heading, _ in COLUMNS.values())} |",
        f"|---|{'---:|' * (3 + len(COLUMNS))}",
    ]
    crossings = []
    for name in DRAWN:
        budgets = rows_of(rows, name)
        for key, heading in (
            ("psnr_db", "PSNR"),
            ("psnr_masked_db", "PSNR inside"),
            ("ssim_masked", "SSIM inside"),
        ):
            values = [row.means[key] for row in budgets]
            when = crossing([row.minutes for row in budgets], values, rows[BASELINE, 0].means[key])
            crossings.append(
                f"- {name[0].upper()}{name[1:]}: the {heading} is higher than that of the mesh with 7k vertices {when}."
            )
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
    usual_machine = max(machines, key=lambda machine_line: len(machines[machine_line]))
    other_machines = [
        f"{'; '.join(names)}: {machine_line}"
        for machine_line, names in machines.items()
        if machine_line != usual_machine
    ]
    return "\n".join(
        [
            "# Rendering networks against meshes, by training time (synthetic people)",
            "",
            "This page measures how the images of rendering networks improve with training time, and after which "
            'time they are better than a drawn mesh. "Points alone" networks (SMPLpix) draw a person from '
            'projected vertices. "No splats" draws each vertex into one pixel only, without filling the surface '
            'between the vertices. "Over the mesh" networks improve the drawn mesh.',
            "",
            "The people are generated (`human_scans`), not real: 160 are for training and 16 for the test, with 96 "
            "views of 256 × 192 pixels. A mesh has about 7,000 (7k) or 27,000 (27k) coloured vertices and is drawn "
            "with 4 × 4 samples per pixel unless the row says otherwise. The columns of the table compare the images "
            "with photographs over the whole frame, or inside, that is over the pixels of the subject. ± is the "
            "standard deviation over seeds, if there are several.",
            "",
            "Every number of epochs is a separate training run of the network, because the learning rate falls to 0 at "
            "the end of a training. The minutes are the number of epochs multiplied by the time of the shortest epoch, "
            "on one core.",
            "",
            f"![Quality against minutes of training]({HERE.stem}.png)",
            "",
            *header,
            *lines(worn=False),
            "",
            "The following list says after how many minutes of training the images of a network are better than a "
            "drawn mesh:",
            *crossings,
            "",
            f"![Photographs, images and errors]({HERE.stem}_people.png)",
            "",
            "The figure shows people who are not in the training data. Its columns are, from the left: the "
            "photograph, the drawn mesh, the network on points alone and the network over the mesh (20 epochs each), "
            "and then the error of these three images.",
            "",
            *([f"## {SKINS}", "", *header, *skins, ""] if skins else []),
            *([f"These combinations were not run: {'; '.join(missing)}.", ""] if missing else []),
            *(
                [
                    "These rows of the tables were measured on another machine or another day: "
                    f"{' '.join(other_machines)}",
                    "",
                ]
                if other_machines
                else []
            ),
            f"Measured on {usual_machine} Command: `python -m reproduction.chapter7.smplpix_training"
            f"{' --skins <folder>' if skins else ''}{' --there' if missing else ''}`.",
            "",
        ]
    )


def rows_of(rows: Record, name: str) -> list[Row]:
    """Return the rows of a method, ordered by number of epochs."""
    return [row for (which, _), row in sorted(rows.items()) if which == name]


def draw_curves(rows: Record, place: Path) -> None:
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
            budgets = rows_of(rows, name)
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
def draw_people(place: Path, chosen: Sequence[int] = (0, 20, 44, 75)) -> None:
    """Draw photographs of unseen people, their images and the errors; keep the old figure if a run does not exist.

    Args:
        place: Path of the figure.
        chosen: Indices of the test images to draw.
    """
    names = {BASELINE: 0, "points alone, 7k": 20, "over the mesh, 7k": 20}
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
