"""Measure the parts of the main job, `experiment=pascal3d/scvae`, and its error, before and after a change.

    python -m benchmarks.framework.main_job --before <commit>

The whole measurement takes half an hour. It can be done in pieces, such as `--seeds 0,1`, `--epochs 3`, `--beside` and
`--runs after:32-true`. Each piece replaces its rows in main_job.csv, and the page main_job.md is written from all rows.

    python -m benchmarks.framework.main_job --floor

This command measures instead what a training step cannot save: the convolutions of its network. It replaces
main_job_floor.csv and the last section of the page.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.commands import ROOT
from benchmarks.pages import environment, machine, publish, read_rows, replace_section
from benchmarks.timing import busy_core, cores_used_by_others, median_and_range, milliseconds, require_idle
from framework.reports.table import write_csv

BEFORE = "950f55d"
RUNS = "before:32-true,after:32-true,after:bf16-mixed"
TABLE = Path(__file__).with_suffix(".csv")
FULL = 30
"""Number of epochs of the main job."""
PARTS = {
    "start": "start of the command to the first logged step",
    "training": "training: first to last logged step",
    "curve": "last validation, training curve, calibration and model",
    "test": "test and cost",
    "figures": "figures",
    "end": "closing: waiting for the tracking store, end of the process",
}
STEP = "a step with its share of validations and checkpoints, ms"
FLOOR_TABLE = TABLE.with_stem("main_job_floor")
FLOOR_HEADING = "## What cannot be saved: the convolutions"
FLOOR_ROUNDS = 3
FLOOR_THREADS = (1, 2)
PRECISIONS = ("32-true", "bf16-mixed")
STEPS = 80
"""Number of training steps of an epoch: 1,266 images in batches of 16."""
BATCH = 16
SHARES = {
    "convolutions": "the six convolutions alone, forward and backward",
    "network": "network and loss, forward and backward",
    "loop": "plain PyTorch loop: network, loss, clipping of the gradient, optimiser",
}
"""Parts of a training step; each one contains the parts before it."""
ERRORS = {"log_likelihood": "log-likelihood, nats", "maad_deg": "MAAD, °"}


@contextmanager
def source(commit: str | None) -> Iterator[Path]:
    """Yield the folder of the project at a commit, in a temporary work tree; None: the folder of this script."""
    if commit is None:
        yield ROOT
        return
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", str(tree), commit], check=True, capture_output=True)
        try:
            write_metadata(tree)
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True, capture_output=True)


def write_metadata(tree: Path) -> None:
    """Write the metadata of the package in a work tree, so that Python finds its plugins instead of the installed ones.

    Python reads the entry points of a package from the first folder of its search path that holds its metadata.
    """
    project = tomllib.loads((tree / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    name, version = project["name"], project["version"]
    folder = tree / f"{name.replace('-', '_')}-{version}.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines: list[str] = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{key} = {value}" for key, value in entries.items())]
    (folder / "entry_points.txt").write_text("\n".join(lines) + "\n")


@dataclass(frozen=True)
class Done:
    """A command of the framework that has ended.

    Attributes:
        start: Time at which it started, seconds since 1970.
        wall: Wall time, seconds.
        processor: Processor time of all its processes, seconds.
        lines: Lines of the journal of its run.
        results: Content of results.json.
    """

    start: float
    wall: float
    processor: float
    lines: list[dict[str, Any]]
    results: dict[str, Any]


def run_command(tree: Path, settings: Sequence[str], outputs: Path | None = None) -> Done:
    """Run a command with the version of the framework in the folder `tree`.

    The run and its MLflow store lie in a temporary folder. With `outputs`, the store lies in that folder.
    """
    with tempfile.TemporaryDirectory(dir=outputs) as folder:
        run = Path(folder) / "outputs" / "run" if outputs is None else Path(folder)
        start, clock = time.time(), time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "framework", *settings, f"hydra.run.dir={run}"],
            cwd=tree, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(tree)},
        )  # fmt: skip
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - clock
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, settings)
        lines = [json.loads(line) for line in (run / "journal.jsonl").read_text().splitlines()]
        results = json.loads((run / "results.json").read_text())
    return Done(start, wall, usage.ru_utime + usage.ru_stime, lines, results)


def run_job(tree: Path, seed: int, precision: str, epochs: int) -> dict[str, Any]:
    """Run the main job with the version in a folder, and return its times, in seconds, and its errors."""
    settings = ["experiment=pascal3d/scvae", f"seed={seed}", f"trainer.precision={precision}"]
    done = run_command(tree, [*settings, *[f"trainer.max_epochs={epochs}"] * (epochs != FULL)])
    times = [done.start, *part_ends(done.lines), done.start + done.wall]
    parts = {name: after - before for name, before, after in zip(PARTS, times[:-1], times[1:], strict=True)}
    steps = [line["step"] for line in done.lines if "train/loss" in line.get("values", ())]
    return {
        "wall": done.wall,
        "processor": done.processor,
        **parts,
        "step_milliseconds": 1e3 * parts["training"] / (steps[-1] - steps[0]),
        **{key: done.results[key] for key in ERRORS},
    }


def part_ends(lines: Sequence[dict[str, Any]]) -> list[float]:
    """Return the end of each part of the job except the last, seconds since 1970, from the lines of a journal."""

    def times(fits: Callable[[dict[str, Any]], bool]) -> list[float]:
        return [line["time"] for line in lines if fits(line)]

    steps = times(lambda line: "train/loss" in line.get("values", ()))
    model = times(lambda line: str(line.get("artifact", "")).endswith("model.ckpt"))
    results = times(lambda line: line.get("artifact") == "results.json")
    status = times(lambda line: line.get("status") == "FINISHED")
    return [steps[0], steps[-1], model[-1], results[-1], status[-1]]


def measure(chosen: argparse.Namespace) -> list[dict[str, Any]]:
    """Run the main job once for each seed and each choice of version and precision, seed after seed."""
    rows = []
    with source(chosen.before) as before:
        for seed in chosen.seeds:
            for version, precision in chosen.runs:
                with busy_core(chosen.beside):
                    result = run_job(before if version == "before" else ROOT, seed, precision, chosen.epochs)
                key = {"version": version, "precision": precision, "epochs": chosen.epochs, "seed": seed}
                rows.append({**key, "beside": chosen.beside, **result})
                sys.stderr.write(f"{rows[-1]}\n")
    return rows


def convolution_step(precision: str) -> Callable[[], object]:
    """Return a function that calls the convolutions of the main job's network on one batch, and their gradients.

    Each convolution gets random numbers of the shape that it gets in training, in the same memory format. The first
    one computes no gradient with respect to its input, the images.
    """
    import torch

    convolutions = [layer for layer in main_model().modules() if isinstance(layer, torch.nn.Conv2d)]
    calls, side = [], 48
    for index, layer in enumerate(convolutions):
        inputs = torch.randn(BATCH, layer.in_channels, side, side).contiguous(
            memory_format=torch.channels_last
        )
        side -= 2
        slope = torch.randn(BATCH, layer.out_channels, side, side).contiguous(
            memory_format=torch.channels_last
        )
        side = side // 2 if index in (1, 3) else side  # max-pooling
        calls.append((layer, inputs.requires_grad_(index > 0), slope))

    def step() -> None:
        for layer, inputs, slope in calls:
            with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16-mixed"):
                outputs = layer(inputs)
            inputs.grad = layer.weight.grad = None
            outputs.backward(slope.to(outputs.dtype))

    return step


def network_step(precision: str, trains: bool) -> Callable[[], object]:
    """Return a function that computes the loss of the main job's model for one batch, and its gradient.

    With `trains`, the function also clips the gradient and changes the weights, as a plain training loop does.
    """
    import torch

    model = main_model().train()
    parameters = list(model.parameters())
    optimizer = torch.optim.AdamW(parameters, lr=1e-3, fused=True)
    images = torch.randint(0, 256, (BATCH, 3, 48, 48), dtype=torch.uint8)
    angles = torch.rand(BATCH, 3)

    def step() -> None:
        optimizer.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16-mixed"):
            loss = model.loss(images, angles).mean()
        loss.backward()
        if trains:
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()

    return step


def main_model() -> Any:
    """Return the model of the main job with random weights."""
    from framework.configuration.assembly import assemble, build_predictor
    from framework.configuration.settings import Settings
    from framework.target import Target

    parts = {
        "data": "pascal3d",
        "encoder": {"biternion_vgg": {"name": "biternion_vgg", "convolution_dropout": 0.0, "dropout": 0.1}},
        "density_head": "scvae",
        "metric": {},
    }
    target = Target("angle", ("azimuth", "elevation", "tilt"))
    return build_predictor(assemble(Settings.of(parts)).parts, target, (3, 48, 48), seed=0)


def measure_floor() -> list[dict[str, Any]]:
    """Return the wall milliseconds of each part of a training step on one and on two threads, round after round."""
    import torch

    rows = []
    for threads, precision in product(FLOOR_THREADS, PRECISIONS):
        torch.set_num_threads(threads)
        loops = {
            "convolutions": convolution_step(precision),
            "network": network_step(precision, trains=False),
            "loop": network_step(precision, trains=True),
        }
        for _ in range(FLOOR_ROUNDS):
            key = {"threads": threads, "precision": precision, "others": cores_used_by_others()}
            for name, step in loops.items():
                spent = milliseconds(step, 40, time.perf_counter)
                rows.append({**key, "part": name, "milliseconds": spent})
    return [{**row, "where": environment("torch")} for row in rows]


def floor_section(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the section of the page on the floor of the run time."""
    lines = [
        f"A training of {FULL} epochs has {FULL * STEPS:,} steps on batches of {BATCH} images. The table gives the "
        "wall time of a step, and of the parts that a step consists of; each row contains the rows above it. The "
        "convolutions are those of PyTorch, called with random numbers of the shapes that they get in training. Each "
        f"number is the median of {FLOOR_ROUNDS} rounds (least to largest), in which the parts of a step are measured "
        f"one after the other. The times of all {FULL * STEPS:,} steps follow from these numbers. The command also "
        "needs time for its start, the reading of images, validations, the test and figures.",
        "",
        "| threads | part of a step | 32-true, ms | all steps, s | bf16-mixed, ms | all steps, s |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for threads, (part, name) in product(FLOOR_THREADS, SHARES.items()):
        cells = []
        for precision in PRECISIONS:
            key = (threads, precision, part)
            times = [
                row["milliseconds"] for row in rows if (row["threads"], row["precision"], row["part"]) == key
            ]
            cells += [median_and_range(times), f"{FULL * STEPS * statistics.median(times) / 1e3:.0f}"]
        lines.append(f"| {threads} | {name} | {' | '.join(cells)} |")
    return [
        *lines,
        "",
        "The project wants the main job in 60 s of wall time and 120 s of processor time. In `32-true` a faster "
        "framework cannot reach this on two cores, because a plain loop alone takes longer.",
        "",
        "Before the rounds, other processes used "
        f"{median_and_range([row['others'] for row in rows], 2)} cores.",
        "",
        f"Measured on {rows[0]['where']} Command: `python -m benchmarks.framework.main_job --floor`.",
    ]


def identity(row: dict[str, Any]) -> tuple[object, ...]:
    return tuple(row[key] for key in ("version", "precision", "epochs", "seed", "beside"))


def grouped(rows: Sequence[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Return the rows by version and precision."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["version"], row["precision"]), []).append(row)
    return groups


def parts_table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the table of the parts' times, with a column for each version and precision."""
    groups = grouped(rows)
    columns = {"wall": "whole command, wall time, s", **{key: f"{name}, s" for key, name in PARTS.items()}}
    columns |= {"processor": "whole command, processor time, s", "step_milliseconds": STEP}
    return [
        f"| part | {' | '.join(f'{version}, {precision}' for version, precision in groups)} |",
        f"|---|{'---:|' * len(groups)}",
        *(
            f"| {name} | {' | '.join(median_and_range([row[key] for row in group]) for group in groups.values())} |"
            for key, name in columns.items()
        ),
    ]


def error_table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the table of errors beside run times, over the seeds."""
    lines = [
        f"| version | precision | seeds | {' | '.join(ERRORS.values())} | wall time, s | processor time, s |",
        f"|---|---|---:|{'---:|' * (len(ERRORS) + 2)}",
    ]
    for (version, precision), group in grouped(rows).items():
        errors = [mean_and_deviation([row[key] for row in group]) for key in ERRORS]
        times = [median_and_range([row[key] for row in group]) for key in ("wall", "processor")]
        lines.append(f"| {' | '.join([version, precision, str(len(group)), *errors, *times])} |")
    return lines


def mean_and_deviation(numbers: Sequence[float]) -> str:
    """Return the mean and, for several numbers, their standard deviation as text."""
    text = f"{statistics.mean(numbers):.3f}"
    return f"{text} ± {statistics.stdev(numbers):.3f}" if len(numbers) > 1 else text


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return the text of the page."""
    lines = [
        "# The main job: run time of its parts, and its error",
        "",
        "The main job is `python -m framework experiment=pascal3d/scvae` with all its default settings: it trains an "
        "sCVAE on generated images of cars, tests it, draws its figures and sends the run to MLflow. This page says "
        "how long each part takes, and whether a faster run has the same error. `before` is the version of commit "
        f"`{BEFORE}`, which trains in float32 (`32-true`). `after` is the version at the date of "
        "this page, which trains in float32 by default and in bfloat16 with "
        "`trainer.precision=bf16-mixed`. The value `auto` means `bf16-mixed` on a processor that multiplies bfloat16 "
        "numbers fast.",
        "",
        "Wall time and processor time in the table include the whole command with all its processes. The times of "
        "the parts are differences of times in the journal of the run. There is one round for each seed, in which "
        "the versions run one after the other. Each cell is the median over the seeds (least to largest). Errors "
        "are the mean over the seeds ± their standard deviation.",
    ]
    for epochs in sorted({row["epochs"] for row in rows}, reverse=True):
        form = (
            "full form" if epochs == FULL else f"shortened to {epochs} epochs (`trainer.max_epochs={epochs}`)"
        )
        for beside in (False, True):
            chosen = [row for row in rows if row["epochs"] == epochs and row["beside"] is beside]
            where = ", beside a process that keeps one core busy" if beside else ""
            if chosen:
                lines += ["", f"## {form[0].upper()}{form[1:]}{where}", "", *parts_table(chosen)]
                lines += ["", *error_table(chosen)]
    command = f"`python -m benchmarks.framework.main_job --before {BEFORE}`"
    lines += ["", f"{machine('torch', 'pytorch-lightning', 'mlflow')} Command: {command}."]
    if FLOOR_TABLE.exists():
        lines += ["", FLOOR_HEADING, "", *floor_section(read_rows(FLOOR_TABLE))]
    lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", default=BEFORE, help="commit to compare with")
    parser.add_argument(
        "--seeds", default="0,1,2,3,4", type=lambda text: [int(seed) for seed in text.split(",")]
    )
    parser.add_argument(
        "--runs",
        default=RUNS,
        help="versions and precisions",
        type=lambda text: [run.split(":") for run in text.split(",")],
    )
    parser.add_argument("--epochs", default=FULL, type=int)
    parser.add_argument("--beside", action="store_true", help="run beside a process that keeps one core busy")
    parser.add_argument("--write", action="store_true", help="only write the page from main_job.csv again")
    parser.add_argument("--floor", action="store_true", help="measure only the parts of a training step")
    chosen = parser.parse_args()
    if chosen.floor:
        write_csv(measure_floor(), None, FLOOR_TABLE)
        text = "\n".join(floor_section(read_rows(FLOOR_TABLE)))
        replace_section(Path(__file__).with_suffix(".md"), FLOOR_HEADING, text)
        return
    rows = {identity(row): row for row in (read_rows(TABLE) if TABLE.exists() else [])}
    if not chosen.write:
        require_idle()
        rows |= {identity(row): row for row in measure(chosen)}
        write_csv(list(rows.values()), None, TABLE)
    publish(__file__, page(list(rows.values())))


if __name__ == "__main__":
    main()
