"""Make Table 7.1 on generated people, with spreads over seeds and over subjects.

    python -m reproduction.chapter7.smplpix_table

The script runs `SWEEPS` into outputs/smplpix_table, or continues them, and then evaluates every test image again. With
`<folders of sweeps> [--lpips <alexnet.pth>]` it only evaluates. It writes smplpix_table.md beside this file.
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
"""Folders and overrides of the sweeps: meshes, networks, and meshes without anti-aliasing. Networks have a quarter of
the epochs of their experiments, so that everything takes two hours of one core."""
METRICS = ("psnr", "ssim", "ms_ssim", "lpips")
NAMES = {
    "rasterised": "mesh, vertex colours",
    "textured": "mesh, texture",
    "quick": "SMPLpix",
    "hybrid": "network over the mesh",
}
"""Names of rows by experiment; other experiments keep their own name."""
UNNAMED_OVERRIDES = (
    *("experiment", "data.topology", "seed", "trainer.max_epochs"),
    *("metric", "pictures", "logger", "threads", "workers"),
)
"""Overrides that the name of a row leaves out.

They are shown in a column of their own, are the same in all runs, or have no influence on the images.
"""
BASELINE = "rasterised"
COLUMNS = {
    "psnr_db": ("PSNR, dB", 2),
    "psnr_masked_db": ("PSNR inside, dB", 2),
    "ssim": ("SSIM", 4),
    "ssim_masked": ("SSIM inside", 3),
    "ms_ssim": ("MS-SSIM", 4),
    "lpips": ("LPIPS", 4),
    "lpips_masked": ("LPIPS inside", 4),
}
"""Headings and decimals of the quality columns, by the key of the result."""
GAINS = ("psnr_masked_db", "ssim_masked", "psnr_db")


class Row(NamedTuple):
    """A row of the table.

    Attributes:
        method: Name of an experiment.
        topology: Number of vertices: 7k or 27k.
        change: Overrides that the other runs do not have.
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
class Evaluation:
    """Results of one model on every test image.

    Attributes:
        numbers: Result of each image by key, NaN where an image has none.
        subjects: Subject of each image.
        drawing: Milliseconds per image of the encoders that are fixed.
        network: Milliseconds per image of the encoders that are trained.
        learns: Whether the model has trained parameters.
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
        "folders",
        nargs="*",
        type=Path,
        help="folders of sweeps that have run; without any, the sweeps are run first",
    )
    arguments.add_argument("--lpips", help="file of torchvision's AlexNet trained on ImageNet")
    options = arguments.parse_args()
    for name, words in [] if options.folders else SWEEPS.items():
        command = [sys.executable, "-m", "framework", "-m", *words, f"hydra.sweep.dir={FOLDER / name}"]
        carry_out(command)
    torch.set_num_threads(1)
    text = report(options.folders or [FOLDER / name for name in SWEEPS], options.lpips)
    write_page(HERE, text)


def report(folders: Sequence[Path], lpips: str | None) -> str:
    runs = group_by_row([result for folder in folders for result in read_completed(folder)])
    sweep_commands = " and ".join(f"`python -m framework -m {' '.join(words)}`" for words in SWEEPS.values())
    rows: dict[Row, list[Evaluation]] = {}
    data_text = ""
    for row, results in runs.items():
        # a model without training gives equal numbers for all seeds, so one run is enough
        chosen = results[:1] if have_equal_numbers(results) else results
        rows[row] = []
        for result in chosen:
            evaluation, data = evaluate_run(Path(result["folder"]), lpips)
            rows[row].append(evaluation)
            if data_text not in ("", describe_data(data)):
                sys.exit(
                    f"The row {row} has other data than the rows before. This row: {describe_data(data)} Rows before: "
                    f"{data_text} Give sweeps that use the same data."
                )
            data_text = describe_data(data)
    return "\n".join(
        [
            "# Table 7.1 on synthetic people",
            "",
            "This page repeats Table 7.1 of the thesis: images of unseen people are drawn either as a mesh, or by a "
            "neural network from projected vertices (SMPLpix) or from the drawn mesh. The table compares the images "
            f"with photographs, and gives the run time. {data_text}",
            "",
            "In the table, a cell of a quality column (PSNR, SSIM and others) holds the mean over test images ± the "
            "standard deviation over seeds ± the standard deviation over subjects. The value of a subject is the "
            "mean over its images and seeds. A dash stands for the standard deviation over seeds of methods that are "
            "not trained, because all seeds give the same numbers. "
            "The terms in the table mean:",
            "- **Vertices** is the number of vertices of the mesh: 6,890 (7k) or about 27,000 (27k).",
            "- **Inside** means that only the pixels of the subject count. The other columns are over the whole frame, "
            "most of which is white.",
            "- **Drawing** is the processor time in milliseconds to draw the mesh, or to project its vertices, for one "
            'image on one thread. A mesh is drawn with 4 × 4 samples per pixel; "supersampling 1" has one sample. '
            "**Network** is the processor time of the network.",
            "",
            "The rendering networks are trained for a quarter of the epochs of the experiments. "
            "[smplpix_training.md](smplpix_training.md) shows what longer training brings. The sweeps are "
            f"{sweep_commands}.{unfinished_note(runs)}",
            "",
            f"| method | vertices | seeds | {' | '.join(heading for heading, _ in COLUMNS.values())} | drawing, ms | "
            "network, ms |",
            f"|---|---|{'---:|' * (len(COLUMNS) + 3)}",
            *(table_line(row, evaluation, len(runs[row])) for row, evaluation in rows.items()),
            "",
            "## Difference from the mesh with vertex colours",
            "",
            "Each row of this table compares a rendering method with the drawn mesh that has the same number of "
            "vertices and colours at its vertices. The difference of the image quality is taken image by image and "
            "averaged for each subject. A cell holds the mean difference ± the standard deviation over subjects; "
            "positive numbers mean better images. The last column counts the subjects whose PSNR inside improves.",
            "",
            f"| method | vertices | {' | '.join(COLUMNS[key][0] for key in GAINS)} | subjects with a gain |",
            f"|---|---|{'---:|' * (len(GAINS) + 1)}",
            *gain_lines(rows),
            "",
            "## Table 7.1 as printed in the thesis",
            "",
            "For Table 7.1, the thesis used other data: photographs of 68 unseen real people in a scanner, with 410 "
            "× 308 pixels, which are not public. Its mesh renderer (Kato et al. 2018, without anti-aliasing), its "
            "network and its machine were also different. Only the order of the rows can therefore be compared with "
            "the table above, not the numbers.",
            "",
            "| method | vertices | PSNR, dB | LPIPS | run time, ms |",
            "|---|---|---:|---:|---:|",
            *(f"| {row} | {psnr} | {distance} | {took} |" for row, (psnr, distance, took) in THESIS.items()),
            "",
            f"{machine('torch', 'numpy')} Command: `python -m reproduction.chapter7.smplpix_table`.",
            "",
        ]
    )


def unfinished_note(runs: Mapping[Row, list[dict[str, Any]]]) -> str:
    """Return a warning if trained rows have different numbers of seeds, else an empty text."""
    counts = {len(results) for results in runs.values() if results[0]["parameters"]}
    return " **Sweeps were stopped before all seeds had run.**" if len(counts) > 1 else ""


def read_completed(folder: Path) -> list[dict[str, Any]]:
    """Return the results of the completed jobs of a sweep, ordered by job number."""
    jobs = []
    for path in sorted(folder.glob("*/results.json"), key=lambda path: (len(path.parent.name), path)):
        record = json.loads((path.parent / RECORD).read_text())
        if record["status"] == "completed":
            results = json.loads(path.read_text())
            jobs.append({**results, "overrides": record["overrides"], "folder": str(path.parent)})
    if not jobs:
        sys.exit(
            f"{folder} holds no results of a sweep. Give the folder of a sweep that has run, or no folder to run the "
            "sweeps."
        )
    return jobs


def group_by_row(results: Sequence[dict[str, Any]]) -> dict[Row, list[dict[str, Any]]]:
    """Group the results that differ only in their seed, ordered by method."""
    rows: dict[Row, list[dict[str, Any]]] = {}
    override_sets = [set(result["overrides"]) for result in results]
    for result in results:
        differing = [
            word for word in result["overrides"] if not all(word in words for words in override_sets)
        ]
        change_words = [word for word in differing if word.partition("=")[0] not in UNNAMED_OVERRIDES]
        _, description = load_with_description(result["folder"])
        change = ", ".join(
            word.partition("=")[0].rpartition(".")[2] + " " + word.partition("=")[2] for word in change_words
        )
        row = Row(result["method"], description.config["data"]["topology"], change)
        rows.setdefault(row, []).append(result)
    for row, runs in rows.items():
        if len({result["seed"] for result in runs}) < len(runs):
            sys.exit(
                f"Two results of {row} have the same seed. Give sweeps in which every combination of method, topology "
                "and seed occurs once."
            )
    order = {method: place for place, method in enumerate(NAMES)}

    def sort_key(row: Row) -> tuple[int, str, int]:
        return order.get(row.method, len(order)), row.change, int(row.topology.removesuffix("k"))

    return {row: rows[row] for row in sorted(rows, key=sort_key)}


def have_equal_numbers(results: Sequence[dict[str, Any]]) -> bool:
    """Return whether nothing was trained and all runs have exactly equal results."""
    keys = [key for key in COLUMNS if key in results[0]]
    return not results[0]["parameters"] and all(
        [result[key] for key in keys] == [results[0][key] for key in keys] for result in results
    )


def evaluate_run(folder: Path, lpips: str | None) -> tuple[Evaluation, Data]:
    predictor, description = load_with_description(folder)
    data = reader(description)
    data.prepare()
    return evaluate_images(predictor, data, lpips), data


def evaluate_images(predictor: Predictor, data: Data, lpips: str | None) -> Evaluation:
    metrics = []
    for name in METRICS:
        weights = {"weights": lpips} if name == "lpips" else {}
        metrics.append(build("metric", resolve("metric", {"name": name, **weights}), target=data.target))
    subjects: list[Tensor] = []

    def subject_batches() -> Iterator[Batch]:
        for batch in Batches(data, batch_size=BLOCK, workers=0, seed=0).test_dataloader():
            subjects.append(batch["subject"])
            yield batch

    cpu = torch.device("cpu")
    evaluation = evaluate(
        predictor, subject_batches(), metrics, groups=["all"], samples=1, seed=0, device=cpu
    )
    numbers: dict[str, np.ndarray] = {}
    for metric in evaluation.metrics:
        image_metric: Any = metric  # the metrics derived from PerImage keep the numbers of each image
        numbers |= dict(zip(image_metric.keys, dim_zero_cat(image_metric.numbers).numpy().T, strict=True))
    sample = data.splits().test[0]["input"][None]
    encoders = [part for part in predictor.modules() if isinstance(part, Encoder)]
    milliseconds_by_fixed = {True: 0.0, False: 0.0}
    with torch.inference_mode():
        inputs = [sample]
        for encoder in encoders:
            inputs.append(encoder(inputs[-1]))
        for encoder, (before, _) in zip(encoders, pairwise(inputs), strict=True):
            milliseconds_by_fixed[encoder.fixed] += milliseconds(partial(encoder, before), 30, warm_up=3)
    learns = any(True for encoder in encoders for _ in encoder.parameters())
    return Evaluation(
        numbers,
        torch.cat(subjects).numpy(),
        milliseconds_by_fixed[True],
        milliseconds_by_fixed[False],
        learns,
    )


def describe_data(data: Data) -> str:
    splits = data.splits()
    counts = [len({number for number, _ in split.of}) for split in splits]  # type: ignore[attr-defined]
    height, width = data.target.size or (0, 0)
    origin = (
        "The people are generated (`human_scans`), not real"
        if data.synthetic
        else "The people are read from a folder"
    )
    return (
        f"{origin}: {counts[0]} subjects are for training, {counts[1]} for validation and {counts[2]} for the test. "
        f"The test split has {len(splits.test)} views of {height} × {width} pixels."  # type: ignore[arg-type]
    )


def by_subject(values: np.ndarray, subjects: np.ndarray) -> np.ndarray:
    """Return the mean of each subject over its images, without NaN."""
    return np.array([np.nanmean(values[subjects == subject]) for subject in np.unique(subjects)])


def spread(values: Sequence[float] | np.ndarray) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def table_line(row: Row, evaluations: Sequence[Evaluation], seeds: int) -> str:
    cells = []
    for key, (_, decimals) in COLUMNS.items():
        values = [evaluation.numbers[key] for evaluation in evaluations]
        if np.isnan(values).all():
            cells.append(NOT_AVAILABLE)
            continue
        means = [float(np.nanmean(value)) for value in values]
        over_seeds = (
            f"{spread(means):.{decimals}f}"
            if len(means) > 1
            else "–"
            if not evaluations[0].learns
            else "one seed"
        )
        over_subjects = spread(by_subject(np.mean(values, 0), evaluations[0].subjects))
        cells.append(f"{np.mean(means):.{decimals}f} ± {over_seeds} ± {over_subjects:.{decimals}f}")
    drawing, network = (
        float(np.median([getattr(evaluation, name) for evaluation in evaluations]))
        for name in ("drawing", "network")
    )
    times = f"{drawing:.1f} | {f'{network:.1f}' if network else '–'}"
    return f"| {row} | {seeds} | {' | '.join(cells)} | {times} |"


def gain_lines(rows: Mapping[Row, Sequence[Evaluation]]) -> list[str]:
    lines = []
    for row, evaluations in rows.items():
        baseline = rows.get(Row(BASELINE, row.topology))
        if baseline is None or baseline is evaluations:
            continue
        cells, share = [], ""
        for key in GAINS:
            ours, theirs = (
                np.mean([evaluation.numbers[key] for evaluation in group], 0)
                for group in (evaluations, baseline)
            )
            differences = by_subject(ours - theirs, evaluations[0].subjects)
            decimals = COLUMNS[key][1]
            cells.append(f"{differences.mean():+.{decimals}f} ± {spread(differences):.{decimals}f}")
            share = share or f"{int((differences > 0).sum())} of {len(differences)}"
        lines.append(f"| {row} | {' | '.join(cells)} | {share} |")
    return lines


if __name__ == "__main__":
    main()
