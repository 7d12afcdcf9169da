"""Make Table 7.1 on generated people, with spreads over seeds and over subjects.

    python -m reproduction.chapter7.smplpix_table

Runs SWEEPS into outputs/smplpix_table, or goes on with them, then judges every test image again; `… <folders of
sweeps> [--lpips <alexnet.pth>]` only judges. Writes smplpix_table.md beside it.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, write_page
from benchmarks.timing import milliseconds
from framework.configuration.loading import load_with_description, reader
from framework.configuration.schema import build, resolve
from framework.data import Batch, Data
from framework.encoder import Encoder
from framework.evaluation.splits import BLOCK, evaluate
from framework.model import Predictor
from framework.reports.table import NOT_AVAILABLE
from framework.runs.job import RECORD
from framework.training.batches import Batches

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/smplpix_table"
SWEEPS = {
    "meshes": ("experiment=smplpix/rasterised,smplpix/textured", "data.topology=7k,27k", "seed=1"),
    "networks": (
        "experiment=smplpix/quick,smplpix/hybrid",
        "data.topology=7k,27k",
        "seed=1,2,3",
        "trainer.max_epochs=5",
    ),
    "plain": (
        "experiment=smplpix/rasterised,smplpix/textured",
        "data.topology=7k,27k",
        "encoder.rasterised.renderer.supersampling=1",
        "seed=1",
    ),
}
"""Folders and arguments: the table's six rows, what a network over the mesh adds, meshes without anti-aliasing. Epochs
are a quarter of the experiments', so that all of it takes two hours of one core."""
METRICS = ("psnr", "ssim", "ms_ssim", "lpips")
NAMES = {
    "rasterised": "mesh, vertex colours",
    "textured": "mesh, texture",
    "quick": "SMPLpix",
    "hybrid": "network over the mesh",
}
"""Of rows, by the experiments' names; any other stands for itself."""
SAID = (
    *("experiment", "data.topology", "seed", "trainer.max_epochs"),
    *("metric", "pictures", "logger", "threads", "workers"),
)
"""Arguments that a row says already, or that all have, or that change no image."""
RIVAL = "rasterised"
COLUMNS = {
    "psnr_db": ("PSNR, dB", 2),
    "psnr_masked_db": ("inside", 2),
    "ssim": ("SSIM", 4),
    "ssim_masked": ("inside", 3),
    "ms_ssim": ("MS-SSIM", 4),
    "lpips": ("LPIPS", 4),
    "lpips_masked": ("inside", 4),
}
"""Keys of numbers, their headings and decimals."""
GAINS = ("psnr_masked_db", "ssim_masked", "psnr_db")


class Row(NamedTuple):
    """What a line of the table is of.

    Attributes:
        method: an experiment's name.
        topology: of the vertices.
        change: arguments that other runs were not given.
    """

    method: str
    topology: str
    change: str = ""

    def __str__(self) -> str:
        name = NAMES.get(self.method, self.method)
        return f"{name}{self.change and f', {self.change}'} | {self.topology}"


THESIS = {
    Row("rasterised", "7k"): (23.2, 0.072, 13),
    Row("rasterised", "27k"): (23.5, 0.064, 48),
    Row("textured", "7k"): (23.4, 0.049, 14),
    Row("textured", "27k"): (23.6, 0.047, 50),
    Row("quick", "7k"): (24.2, 0.051, 16),
    Row("quick", "27k"): (24.6, 0.045, 17),
}
"""PSNR (dB), LPIPS and milliseconds of the thesis's Table 7.1."""


@dataclass(frozen=True)
class Judged:
    """One trained model on every test image.

    Attributes:
        numbers: of each image by key, NaN where it has none.
        subjects: of each image.
        drawing, network: milliseconds of an image, of encoders that are fixed and of those that learn.
        learns: whether anything was trained.
    """

    numbers: Mapping[str, np.ndarray]
    subjects: np.ndarray
    drawing: float
    network: float
    learns: bool


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument(
        "folders", nargs="*", type=Path, help="of sweeps that have run; none: they are run now"
    )
    arguments.add_argument("--lpips", help="file of torchvision's AlexNet trained on ImageNet")
    given = arguments.parse_args()
    for name, words in [] if given.folders else SWEEPS.items():
        command = [sys.executable, "-m", "framework", "-m", *words, f"hydra.sweep.dir={FOLDER / name}"]
        carry_out(command)
    torch.set_num_threads(1)
    text = report(given.folders or [FOLDER / name for name in SWEEPS], given.lpips)
    write_page(HERE, text)


def report(folders: Sequence[Path], lpips: str | None) -> str:
    runs = grouped([result for folder in folders for result in completed(folder)])
    told = " and ".join(f"`python -m framework -m {' '.join(words)}`" for words in SWEEPS.values())
    rows: dict[Row, list[Judged]] = {}
    about = ""
    for row, results in runs.items():
        # what is not trained is the same whatever the seed: the runs' own numbers say so
        chosen = results[:1] if same(results) else results
        rows[row] = []
        for result in chosen:
            found, data = judged(Path(result["folder"]), lpips)
            rows[row].append(found)
            if about not in ("", described(data)):
                sys.exit(f"{row} has other data: {described(data)} The rows before it: {about}")
            about = described(data)
    return "\n".join(
        [
            "# Table 7.1 on synthetic people",
            "",
            f"{about} Sweeps: {told}. Means over "
            "test images; behind ± the standard deviation over seeds, then that over subjects (of the means of each "
            "one's images and seeds). A dash: nothing is trained, all seeds give the same numbers. Inside: over "
            "the subject's pixels; the others over the frame, most of which is white. Milliseconds of "
            "processor time, one image alone on one thread: drawing the mesh, 4 × 4 samples a pixel unless said, or "
            "projecting its vertices; then the network. Networks are trained for a quarter of the experiments' epochs; "
            "what longer training brings: [smplpix_training.md](smplpix_training.md)." + unfinished(runs),
            "",
            f"| | vertices | seeds | {' | '.join(heading for heading, _ in COLUMNS.values())} | drawing, ms | "
            "network, ms |",
            f"|---|---|{'---:|' * (len(COLUMNS) + 3)}",
            *(line(row, found, len(runs[row])) for row, found in rows.items()),
            "",
            "## Against the mesh with the same vertices' colours",
            "",
            "Image by image, then the mean of each subject: mean difference ± standard deviation over subjects.",
            "",
            f"| | vertices | {' | '.join(gain_heading(key) for key in GAINS)} | subjects who gain inside |",
            f"|---|---|{'---:|' * (len(GAINS) + 1)}",
            *gains(rows),
            "",
            "## The thesis's own numbers",
            "",
            "**Other data**: photographs of 68 unseen subjects, real people in a scanner, 410 × 308 pixels, not "
            "public; another renderer of meshes (Kato et al. 2018, no anti-aliasing), another network, another "
            "machine. No number here compares with one above; what can be compared is how the rows are ordered.",
            "",
            "| | vertices | PSNR, dB | LPIPS | ms |",
            "|---|---|---:|---:|---:|",
            *(f"| {row} | {psnr} | {distance} | {took} |" for row, (psnr, distance, took) in THESIS.items()),
            "",
            f"{machine('torch', 'numpy')} Command: `python -m reproduction.chapter7.smplpix_table`.",
            "",
        ]
    )


def unfinished(runs: Mapping[Row, list[dict[str, Any]]]) -> str:
    """A sentence where trained rows have different numbers of seeds."""
    counts = {len(results) for results in runs.values() if results[0]["parameters"]}
    return " **Sweeps were stopped before all seeds had run.**" if len(counts) > 1 else ""


def completed(folder: Path) -> list[dict[str, Any]]:
    """Results of the jobs of a sweep, by their numbers."""
    found = []
    for path in sorted(folder.glob("*/results.json"), key=lambda path: (len(path.parent.name), path)):
        record = json.loads((path.parent / RECORD).read_text())
        if record["status"] == "completed":
            results = json.loads(path.read_text())
            found.append({**results, "overrides": record["overrides"], "folder": str(path.parent)})
    if not found:
        sys.exit(f"{folder} holds no results of a sweep. Give the folder of one, or none to run it.")
    return found


def grouped(results: Sequence[dict[str, Any]]) -> dict[Row, list[dict[str, Any]]]:
    """Results that differ in their seeds alone, method after method."""
    found: dict[Row, list[dict[str, Any]]] = {}
    told = [set(result["overrides"]) for result in results]
    for result in results:
        given = [word for word in result["overrides"] if not all(word in words for words in told)]
        own = [word for word in given if word.partition("=")[0] not in SAID]
        _, description = load_with_description(result["folder"])
        change = ", ".join(
            word.partition("=")[0].rpartition(".")[2] + " " + word.partition("=")[2] for word in own
        )
        row = Row(result["method"], description.config["data"]["topology"], change)
        found.setdefault(row, []).append(result)
    for row, some in found.items():
        if len({result["seed"] for result in some}) < len(some):
            sys.exit(f"Two results of {row} have one seed; wanted sweeps over methods, topologies and seeds.")
    order = {method: place for place, method in enumerate(NAMES)}

    def place(row: Row) -> tuple[int, str, int]:
        return order.get(row.method, len(order)), row.change, int(row.topology.removesuffix("k"))

    return {row: found[row] for row in sorted(found, key=place)}


def same(results: Sequence[dict[str, Any]]) -> bool:
    """Whether runs say the same of the test split, to the last bit."""
    keys = [key for key in COLUMNS if key in results[0]]
    return not results[0]["parameters"] and all(
        [result[key] for key in keys] == [results[0][key] for key in keys] for result in results
    )


def judged(folder: Path, lpips: str | None) -> tuple[Judged, Data]:
    predictor, description = load_with_description(folder)
    data = reader(description)
    data.prepare()
    return examined(predictor, data, lpips), data


def examined(predictor: Predictor, data: Data, lpips: str | None) -> Judged:
    metrics = []
    for name in METRICS:
        weights = {"weights": lpips} if name == "lpips" else {}
        metrics.append(build("metric", resolve("metric", {"name": name, **weights}), target=data.target))
    subjects: list[Tensor] = []

    def noted() -> Iterator[Batch]:
        for batch in Batches(data, batch_size=BLOCK, workers=0, seed=0).test_dataloader():
            subjects.append(batch["subject"])
            yield batch

    cpu = torch.device("cpu")
    found = evaluate(predictor, noted(), metrics, groups=["all"], samples=1, seed=0, device=cpu)
    numbers: dict[str, np.ndarray] = {}
    for metric in found.metrics:
        each: Any = metric  # PerImage keeps the numbers of each image
        numbers |= dict(zip(each.keys, dim_zero_cat(each.numbers).numpy().T, strict=True))
    one = data.splits().test[0]["input"][None]
    encoders = [part for part in predictor.modules() if isinstance(part, Encoder)]
    spent = {True: 0.0, False: 0.0}
    with torch.inference_mode():
        inputs = [one]
        for encoder in encoders:
            inputs.append(encoder(inputs[-1]))
        for encoder, (before, _) in zip(encoders, pairwise(inputs), strict=True):
            spent[encoder.fixed] += milliseconds(partial(encoder, before), 30, warm_up=3)
    learns = any(True for encoder in encoders for _ in encoder.parameters())
    return Judged(numbers, torch.cat(subjects).numpy(), spent[True], spent[False], learns)


def described(data: Data) -> str:
    given = data.splits()
    counts = ", ".join(
        f"{len({number for number, _ in split.of})} {name}" for name, split in given._asdict().items()
    )  # type: ignore[attr-defined]
    height, width = data.target.size or (0, 0)
    made = "Generated people (`human_scans`), not real ones" if data.synthetic else "People of a folder"
    return (
        f"{made}: subjects of {counts}; unseen ones in {len(given.test)} views of {height} × {width} pixels."  # type: ignore[arg-type]
    )


def by_subject(values: np.ndarray, subjects: np.ndarray) -> np.ndarray:
    """Means over each subject's images that have a number."""
    return np.array([np.nanmean(values[subjects == one]) for one in np.unique(subjects)])


def spread(values: Sequence[float] | np.ndarray) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def line(row: Row, found: Sequence[Judged], seeds: int) -> str:
    cells = []
    for key, (_, decimals) in COLUMNS.items():
        values = [one.numbers[key] for one in found]
        if np.isnan(values).all():
            cells.append(NOT_AVAILABLE)
            continue
        means = [float(np.nanmean(value)) for value in values]
        over_seeds = (
            f"{spread(means):.{decimals}f}" if len(means) > 1 else "–" if not found[0].learns else "one seed"
        )
        over_subjects = spread(by_subject(np.mean(values, 0), found[0].subjects))
        cells.append(f"{np.mean(means):.{decimals}f} ± {over_seeds} ± {over_subjects:.{decimals}f}")
    drawing, network = (
        float(np.median([getattr(one, name) for one in found])) for name in ("drawing", "network")
    )
    times = f"{drawing:.1f} | {f'{network:.1f}' if network else '–'}"
    return f"| {row} | {seeds} | {' | '.join(cells)} | {times} |"


def gain_heading(key: str) -> str:
    heading, _ = COLUMNS[key]
    whole = COLUMNS[key.replace("_masked", "")][0]
    return f"{whole} {heading}" if heading != whole else f"{whole}, frame"


def gains(rows: Mapping[Row, Sequence[Judged]]) -> list[str]:
    lines = []
    for row, found in rows.items():
        rival = rows.get(Row(RIVAL, row.topology))
        if rival is None or rival is found:
            continue
        cells, share = [], ""
        for key in GAINS:
            ours, theirs = (np.mean([one.numbers[key] for one in some], 0) for some in (found, rival))
            each = by_subject(ours - theirs, found[0].subjects)
            decimals = COLUMNS[key][1]
            cells.append(f"{each.mean():+.{decimals}f} ± {spread(each):.{decimals}f}")
            share = share or f"{int((each > 0).sum())} of {len(each)}"
        lines.append(f"| {row} | {' | '.join(cells)} | {share} |")
    return lines


if __name__ == "__main__":
    main()
