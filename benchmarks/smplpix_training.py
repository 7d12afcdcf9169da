"""What networks of neural pixels gain with training time, against meshes; results and pictures lie beside this file.

`python benchmarks/smplpix_training.py [--skins <folder>]` runs what outputs/benchmarks/smplpix_training does not hold
yet, four hours of one core, and goes on where it was stopped; `--there` only reports what is there.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks import smplpix_table as table
from benchmarks.machine import machine
from framework.configuration.loading import load, load_with_description, reader
from framework.figures.style import GREEN, GREY, RED, titled_figure

HERE = Path(__file__).resolve()
ROOT = HERE.parents[1]
FOLDER = ROOT / "outputs/benchmarks/smplpix_training"
SKINS = "Skins nobody wore in training"


@dataclass(frozen=True)
class Method:
    """
    Attributes:
        folder: what the folders of its runs begin with.
        words: arguments of its runs.
        epochs: of trainings, each with its own schedule; none: nothing is trained.
        seeds: of the training of `epochs[-1]`; the shorter ones have the first.
    """

    folder: str
    words: tuple[str, ...]
    epochs: tuple[int, ...] = ()
    seeds: tuple[int, ...] = (0,)

    def runs(self) -> list[tuple[int, int]]:
        """(epochs, seed) of each; (0, 0) where nothing is trained."""
        if not self.epochs:
            return [(0, 0)]
        short = [(epochs, self.seeds[0]) for epochs in self.epochs[:-1]]
        return short + [(self.epochs[-1], seed) for seed in self.seeds]


def over(experiment: str, *more: str) -> tuple[str, ...]:
    return (f"experiment=smplpix/{experiment}", *more)


SEEDS = (0, 1, 2)
METHODS = {
    "mesh, 7k": Method("rasterised_7k", over("rasterised")),
    "mesh, 7k, one sample a pixel": Method(
        "rasterised_7k_plain", over("rasterised", "encoder.rasterised.renderer.supersampling=1")
    ),
    "mesh, 27k": Method("rasterised_27k", over("rasterised", "data.topology=27k")),
    "points alone, 7k": Method("quick_7k", over("quick"), (2, 6, 20), SEEDS),
    "points alone, 7k, no splats": Method(
        "bare_7k", over("quick", "encoder.projection.splat=0", "encoder.slim.residual=false"), (20,)
    ),
    "points alone, 27k": Method("quick_27k", over("quick", "data.topology=27k"), (20,)),
    "points alone, 7k, unet": Method("unet_7k", over("unet"), (1,)),
    "over the mesh, 7k": Method("hybrid_7k", over("hybrid"), (2, 6, 20), SEEDS),
    "over the mesh, 27k": Method("hybrid_27k", over("hybrid", "data.topology=27k"), (20,)),
}
DRAWN = {"points alone, 7k": RED, "over the mesh, 7k": GREEN}
LINES = {"mesh, 7k": "-", "mesh, 27k": "--"}
RIVAL = "mesh, 7k"
COLUMNS = {key: told for key, told in table.COLUMNS.items() if not key.startswith("lpips")}


def folder(method: Method, epochs: int, seed: int) -> Path:
    return FOLDER / (f"{method.folder}_{epochs}_{seed}" if method.epochs else method.folder)


def completed(method: Method, there: bool) -> dict[tuple[int, int], dict[str, float]]:
    """Results of its runs; those that are missing are run first, or left out."""
    found = {}
    for epochs, seed in method.runs():
        place = folder(method, epochs, seed) / "results.json"
        if not place.is_file() and there:
            continue
        if not place.is_file():
            words = [*method.words, f"seed={seed}", "threads=1", "logger=none"]
            words += [f"hydra.run.dir={place.parent}"]
            words += [f"trainer.max_epochs={epochs}"] if epochs else []
            subprocess.run([sys.executable, "-m", "framework", *words], cwd=ROOT, check=True)
        found[epochs, seed] = json.loads(place.read_text())
    return found


def epoch_minutes(method: Method) -> float:
    """Of an epoch on one core: the shortest of all runs, since the machine did other work too."""
    found = []
    for run in FOLDER.glob(f"{method.folder}_*"):
        lines = [json.loads(line) for line in (run / "journal.jsonl").read_text().splitlines()]
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
    arguments.add_argument("--there", action="store_true", help="report what is there")
    given = arguments.parse_args()
    methods = dict(METHODS)
    if given.skins:
        worn = f"data.skins={given.skins}"
        methods |= {
            f"skins, {RIVAL}": Method("skins_rasterised_7k", over("rasterised", worn)),
            "skins, over the mesh, 7k": Method("skins_hybrid_7k", over("hybrid", worn), (20,)),
        }
    results = {name: completed(method, given.there) for name, method in methods.items()}
    results = {name: found for name, found in results.items() if found}
    minutes = {
        name: epoch_minutes(METHODS[name]) for name in results if name in METHODS and METHODS[name].epochs
    }
    draw(results, minutes, HERE.with_suffix(".png"))
    sheet(HERE.with_name(HERE.stem + "_people.png"))
    HERE.with_suffix(".md").write_text(report(results, minutes), encoding="utf-8")


def mean(found: Mapping[tuple[int, int], Mapping[str, float]], epochs: int, key: str) -> tuple[float, float]:
    """Over seeds, with their standard deviation (NaN of one)."""
    values = [result[key] for (trained, _), result in found.items() if trained == epochs]
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def report(
    results: Mapping[str, Mapping[tuple[int, int], dict[str, float]]], an_epoch: Mapping[str, float]
) -> str:
    def minutes(name: str, epochs: int) -> float:
        return epochs * an_epoch[name.removeprefix("skins, ")]

    def rows(chosen: Sequence[str]) -> list[str]:
        lines = []
        for name in chosen:
            found = results[name]
            for epochs in sorted({epochs for epochs, _ in found}):
                cells = []
                for key, (_, decimals) in COLUMNS.items():
                    middle, over_seeds = mean(found, epochs, key)
                    spread = "" if np.isnan(over_seeds) else f" ± {over_seeds:.{decimals}f}"
                    cells.append(f"{middle:.{decimals}f}{spread}")
                seeds = sum(trained == epochs for trained, _ in found)
                trained = f"{epochs} | {minutes(name, epochs):.0f} | {seeds}" if epochs else "– | – | –"
                lines.append(f"| {name.removeprefix('skins, ')} | {trained} | {' | '.join(cells)} |")
        return lines

    header = [
        f"| | epochs | minutes | seeds | {' | '.join(heading for heading, _ in COLUMNS.values())} |",
        f"|---|{'---:|' * (3 + len(COLUMNS))}",
    ]
    crossings = []
    for name in DRAWN:
        budgets = METHODS[name].epochs
        for key, heading in (("psnr_db", "PSNR"), ("ssim_masked", "SSIM inside")):
            curve = [mean(results[name], epochs, key)[0] for epochs in budgets]
            level = mean(results[RIVAL], 0, key)[0]
            found = crossing([minutes(name, epochs) for epochs in budgets], curve, level)
            crossings.append(f"- {name}, {heading}: above the mesh of 7k {found}.")
    skins = [name for name in results if name.startswith("skins, ")]
    missing = []
    for name, method in METHODS.items():
        left = [run for run in method.runs() if run not in results.get(name, {})]
        missing += [f"{name}, {epochs} epochs, seed {seed}" for epochs, seed in left]
    return "\n".join(
        [
            "# Neural pixels against meshes, by training time (synthetic)",
            "",
            "Generated people (`human_scans`, not real ones): 160 to train on, 96 views of 16 unseen ones, 256 × 192. "
            "Meshes are drawn with their vertices' colours, 4 × 4 samples a pixel unless said. Inside: over the "
            "subject's pixels. ± is the standard deviation over seeds, where there are several. Each budget is a "
            "training of its own, whose rate falls to 0 at its end. Minutes: epochs times the shortest one, one core.",
            "",
            f"![curves]({HERE.stem}.png)",
            "",
            *header,
            *rows([name for name in results if name not in skins]),
            "",
            *crossings,
            "",
            f"![people]({HERE.stem}_people.png)",
            "",
            "From the left: photograph, mesh, points alone, network over the mesh (20 epochs); then where each is off.",
            "",
            *([f"## {SKINS}", "", *header, *rows(skins), ""] if skins else []),
            *([f"Not run: {'; '.join(missing)}.", ""] if missing else []),
            f"{machine('torch', 'numpy')} Command: `python benchmarks/smplpix_training.py"
            f"{' --skins <folder>' if skins else ''}{' --there' if missing else ''}`.",
            "",
        ]
    )


def draw(
    results: Mapping[str, Mapping[tuple[int, int], dict[str, float]]],
    an_epoch: Mapping[str, float],
    place: Path,
) -> None:
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
            epochs = METHODS[name].epochs
            minutes = [each * an_epoch[name] for each in epochs]
            values, spreads = zip(*(mean(results[name], each, key) for each in epochs), strict=True)
            axes.errorbar(
                minutes, values, np.nan_to_num(spreads), color=colour, marker="o", capsize=3, label=name
            )
        for name, dashes in LINES.items():
            axes.axhline(mean(results[name], 0, key)[0], color=GREY, linestyle=dashes, label=name)
        axes.set(xscale="log", xlabel="minutes of training on one core", ylabel=label)
        axes.set_xticks([2, 5, 10, 20], ["2", "5", "10", "20"])
        axes.minorticks_off()
    panels[0].legend(loc="lower right")
    figure.savefig(place)


@torch.inference_mode()
def sheet(place: Path, chosen: Sequence[int] = (0, 20, 44, 75)) -> None:
    """Photographs of unseen people, their pictures, and where these are off."""
    methods = [METHODS[name] for name in (RIVAL, "points alone, 7k", "over the mesh, 7k")]
    runs = [folder(method, *method.runs()[-len(method.seeds)]) for method in methods]
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
