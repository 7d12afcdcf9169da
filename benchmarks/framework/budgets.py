"""Choose the setting of five models for limits of run time and error, and measure anew whether it meets them.

    python -m benchmarks.framework.budgets [--runs FOLDER] [--train] [--only MODEL ...]

The models are trained by commands of the framework, in FOLDER if it is named; runs that are already there are used.
`--train` only trains; `--only` measures the named models, and the page is written when all have been measured in this
FOLDER. For each model, `framework.load(run, budget=...)` chooses a setting for a limit of the run time
and for one of the error. The script then measures run time and error of the chosen setting with code of its own: the
time in five interleaved rounds, the error with other random numbers and also on the test split. Writes budgets.md into
the folder of this file.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

import framework
from benchmarks.commands import carry_out
from benchmarks.pages import machine, publish
from benchmarks.timing import Rounds, require_idle, time_interleaved
from framework.configuration.assembly import build_metrics
from framework.configuration.description import Description
from framework.configuration.loading import load_with_description, reader
from framework.data import Batch
from framework.datasets.fields import fetch
from framework.evaluation.budget import Knobs, Measure
from framework.evaluation.splits import BLOCK, evaluate, silence
from framework.model import Predictor
from framework.prediction import Prediction

MODELS: Mapping[str, tuple[str, ...]] = {
    "moons/ensemble": ("experiment=moons/ensemble", "metric=[nll]"),
    "pascal3d_outliers/mc_dropout": (
        *("experiment=pascal3d_outliers/mc_dropout", "trainer.max_epochs=4"),
        *("metric=[angular_deviation]",),
    ),
    "pascal3d/scvae": ("experiment=pascal3d/scvae", "trainer.max_epochs=4", "metric=[nll]"),
    "modelnet40/bps_extra_trees": (
        *("experiment=modelnet40/bps_extra_trees", "encoder.bps.points=512", "density_head.trees=300"),
        *("metric=[nll]",),
    ),
    "cest/refined": ("experiment=cest/refined", "trainer.max_epochs=40", "metric=[mae]"),
}
"""Overrides of the command that trains each model."""
QUIET = ("pictures=false", "logger=none", "threads=1")
SAMPLES, SEED = 640, 1000
"""Number of samples of a split with which the error is measured anew, and the seed of its random numbers."""
MEASURED = "measured.json"
"""Name of the file, in the folder of a run, with the rows of the table for its model."""
ALLOWED = 1.1
"""Largest factor by which a new measurement may exceed its limit."""


class Model:
    """A trained model whose knobs can be set, and the batches with which it is measured.

    Args:
        run: folder of the run.
    """

    def __init__(self, run: Path) -> None:
        loaded: tuple[Predictor, Description] = load_with_description(run)
        self.predictor, self.description = loaded
        self.data = reader(self.description)
        self.data.prepare()
        self.knobs = Knobs.of(self.predictor)
        self.metrics = build_metrics(self.description.config, self.description.target)
        self.measure = Measure.of(self.metrics, None)
        self.samples = int(self.description.settings["samples"])
        self.batch = fetch(self.data.splits().validation, range(BLOCK))

    @torch.no_grad()
    def predict(self, setting: tuple[int, ...]) -> None:
        """Compute the densities, the point predictions and the error of a batch."""
        self.knobs.set(setting)
        prediction = Prediction(self.predictor(self.batch["input"]), self.batch, self.samples)
        _ = prediction.point
        metric = self.measure.metric.clone()
        metric.update(prediction)  # type: ignore[operator]

    def error(self, setting: tuple[int, ...], split: str) -> float:
        """Return the error on a split, with random numbers that the choice of a setting did not use."""
        self.knobs.set(setting)
        samples = getattr(self.data.splits(), split)
        count = min(SAMPLES, len(samples))
        batches: list[Batch] = [
            fetch(samples, range(start, min(start + BLOCK, count))) for start in range(0, count, BLOCK)
        ]
        results = evaluate(
            self.predictor,
            batches,
            [self.measure.metric],
            groups=("all",),
            samples=self.samples,
            seed=SEED,
            device=torch.device("cpu"),
        )
        return results.total[self.measure.key]

    def times(self, *settings: tuple[int, ...]) -> list[Rounds]:
        """Return the wall time of a batch at each setting, ms, in interleaved rounds."""
        calls: dict[str, Callable[[], object]] = {
            self.knobs.text(setting): partial(self.predict, setting) for setting in settings
        }
        return list(time_interleaved(calls, clock=time.perf_counter, seconds=0.2).values())


def chosen_setting(run: Path, budget: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the setting that `framework.load` chooses for a budget."""
    return Knobs.of(framework.load(run, budget=budget)).current


def rows(name: str, run: Path) -> tuple[list[str], float]:
    """Return the rows of the table for one model, and the largest quotient of a new measurement and its limit."""
    model = Model(run)
    stored, cheapest = model.knobs.current, model.knobs.settings()[0]
    time_now = sum(rounds.median for rounds in model.times(stored, cheapest)) / 2 / BLOCK
    stored_error, cheap_error = (model.error(setting, "validation") for setting in (stored, cheapest))
    limits = {
        "milliseconds": float(f"{time_now:.2g}"),
        "error": float(f"{(stored_error + cheap_error) / 2:.4g}"),
    }
    lines, worst = [], 0.0
    for kind, limit in limits.items():
        setting = chosen_setting(run, {kind: limit, "batch_size": BLOCK})
        before, after = model.times(stored, setting)
        milliseconds = Rounds(tuple(value / BLOCK for value in after.milliseconds))
        error, test, stored_test = (
            model.error(setting, "validation"),
            model.error(setting, "test"),
            model.error(stored, "test"),
        )
        excess = milliseconds.median / limit if kind == "milliseconds" else 1 + (error - limit) / abs(limit)
        worst = max(worst, excess)
        lines.append(
            f"| `{name}` | {model.measure.key} | {kind}={limit:g} | {model.knobs.text(stored)} → "
            f"{model.knobs.text(setting)} | {milliseconds.text()} | {error:.4g} | {excess:.2f} | "
            f"{after.times_faster(before)} | {stored_test:.4g} → {test:.4g} |"
        )
    return lines, worst


def main() -> None:
    """Train the models, measure them and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=Path, help="folder of the trained models")
    parser.add_argument("--train", action="store_true", help="only train")
    parser.add_argument(
        "--only", nargs="+", choices=list(MODELS), help="models to measure now; all by default"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.runs or Path(temporary)).resolve()
        for name, overrides in MODELS.items():
            if not (folder / name / "checkpoints").is_dir():
                run = f"hydra.run.dir={folder / name}"
                carry_out([sys.executable, "-m", "framework", *overrides, *QUIET, run])
        if options.train:
            return
        torch.set_num_threads(1)
        for name in options.only or MODELS:
            require_idle()
            with silence():  # metrics warn of single samples
                (folder / name / MEASURED).write_text(json.dumps(rows(name, folder / name)))
        missing = [name for name in MODELS if not (folder / name / MEASURED).is_file()]
        if missing:
            sys.exit(
                f"Not measured yet: {', '.join(missing)}. Measure them with --only, which then writes the page."
            )
        results = [json.loads((folder / name / MEASURED).read_text()) for name in MODELS]
    table = "\n".join(line for lines, _ in results for line in lines)
    worst = max(excess for _, excess in results)
    page = PAGE.format(table=table, worst=worst, machine=machine("torch"), batch=BLOCK, samples=SAMPLES)
    publish(__file__, page)
    if worst > ALLOWED:
        sys.exit(f"A limit was exceeded by a factor of {worst:.2f}, but at most {ALLOWED} is wanted.")


PAGE = """# Budgets

This page tests whether the setting that `framework.load(run, budget=...)` chooses meets its limit of run time or error
if it is measured anew. The command of the page is:

    python -m benchmarks.framework.budgets

Each model is trained for a short time on synthetic data. A setting is chosen for each of two limits: a limit of the run
time, halfway between the run times of the stored setting and of the cheapest one, and a limit of the error, halfway
between their errors. The run time (`milliseconds`) is the time of the density, the point prediction and the error
measure for one sample, in a batch of {batch} on one thread.

After the choice, this script measures run time and error again with code of its own. Times are medians over five
interleaved rounds (least to largest round). Errors are means over at most {samples} validation samples, with random
numbers that the choice did not use. The columns of the table are:
- *new / limit*: the new measurement divided by the limit. If errors can be negative, it is 1 plus the excess over the
  limit, as a share of the limit. A value of at most 1 meets the limit; the largest value is {worst:.2f};
- *faster*: how many times as fast the chosen setting is as the stored one, in the same rounds;
- *test error*: the error of the stored and of the chosen setting on the test split.

| model | measure | limit | stored → chosen | ms per sample | validation error | new / limit | faster | test error |
|---|---|---|---|---|---|---|---|---|
{table}

A choice depends on the machine and its load, because run times do. Another run of this script may choose a neighbouring
setting.

{machine}
"""
"""Page of the results."""


if __name__ == "__main__":
    main()
