"""Predict classes and turns of real handwritten digits, with ambiguity and with corrupted test images.

    python -m benchmarks.images.digits train /path/to/digits     # trains 18 + 1 models, and tests 20 corruptions
    python -m benchmarks.images.digits page /path/to/digits      # writes digits.md and its figures

The folder holds test images of MNIST as idx files (`t10k-images-idx3-ubyte.gz` and `t10k-labels-idx1-ubyte.gz`). They
are split at random into training, validation and test. Runs are in outputs/sweeps/digits_*.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

import framework
from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, publish
from benchmarks.sweeps import Run, read_runs
from framework.configuration.schema import build, resolve
from framework.datasets.fields import fetch

HEADS = ("von_mises", "mixture", "scvae")
AMBIGUOUS, PAIR = ("0", "1", "8"), ("6", "9")
"""Digits that look the same after half a turn, and digits that turn into each other."""
CORRUPTIONS, STRENGTHS = ("noise", "blur", "contrast", "jpeg"), (1, 2, 3, 4, 5)
SEEDS = (0, 1, 2)
NODES = 360
"""Number of angles at which a density is evaluated."""
NEAR = math.pi / 4
"""Largest distance from the angle of a reading at which probability counts as that of the reading, radians.

A turned 6 can also be read as a 9, and the reverse. The two readings are the true angle and the opposite angle.
"""
READING, LEAST_GAIN = 0.1, 0.3
"""Probability that each reading of a turned 6 or 9 shall have, and aim of the gain over `von_mises`, nats."""
SWEEPS = ROOT / "outputs" / "sweeps"
IMAGES = ("data.image_size=32", "data.grayscale=true", "threads=1", "logger=none")


def train(root: Path) -> None:
    """Train all models, and test the classifier on corrupted images; interrupted sweeps are continued."""
    for name, digits in (("ambiguous", AMBIGUOUS), ("pair", PAIR)):
        chosen = ",".join(f"'{digit}'" for digit in digits)
        heads = ",".join(f"images/turned_{head}" for head in HEADS)
        seeds = ",".join(map(str, SEEDS))
        _run("-m", f"experiment={heads}", f"seed={seeds}", f"data.classes=[{chosen}]", *_place(root, name))
    if not (SWEEPS / "digits_classes" / "results.json").exists():
        _run(
            "experiment=images/classification",
            "uncertainty.temperature.prior=null",
            f"data.root={root}",
            *IMAGES,
            f"hydra.run.dir={_folder('classes')}",
        )
    kinds, strengths = ",".join(CORRUPTIONS), ",".join(map(str, STRENGTHS))
    corrupted = (
        f"data.corruption={kinds}",
        f"data.strength={strengths}",
        f"hydra.sweep.dir={_folder('corrupted')}",
    )
    _run(
        "-m",
        "mode=test",
        f"checkpoint={_folder('classes')}",
        f"data.root={root}",
        *corrupted,
        "threads=1",
        "logger=none",
    )


def _folder(name: str) -> Path:
    return SWEEPS / f"digits_{name}"


def _place(root: Path, name: str) -> tuple[str, ...]:
    return (f"data.root={root}", *IMAGES, f"hydra.sweep.dir={_folder(name)}")


def _run(*words: str) -> None:
    carry_out([sys.executable, "-m", "framework", *words])


def runs_by_head(name: str) -> dict[str, list[Run]]:
    """Return the runs of a sweep, with their results, by density head."""
    runs: dict[str, list[Run]] = {head: [] for head in HEADS}
    for run in read_runs(_folder(name)):
        runs[run.config()["density_head"]["name"]].append(run)
    return runs


def test_images(run: Path) -> Mapping[str, Tensor]:
    """Return all test images of a run with their targets and groups."""
    config = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    data = build("data", resolve("data", config["data"]))
    data.prepare()
    test = data.splits().test
    return fetch(test, range(len(test)))


@torch.no_grad()
def densities_on_circle(run: Path, inputs: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return angles (NODES,), radians, and the density of each image there, (image, NODES)."""
    model = framework.load(str(run))
    angles = (torch.arange(NODES) + 0.5) * (2 * math.pi / NODES) - math.pi
    columns = []
    for part in inputs.split(128):
        torch.manual_seed(0)
        density = model(part)
        values = angles[:, None, None].expand(-1, len(part), 1)
        columns.append(density.log_prob(values).double().exp().T)
    return angles.numpy(), torch.cat(columns).numpy()


def reading_masses(angles: np.ndarray, density: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the probability within NEAR of the true angle and of the opposite angle, (image, 2)."""
    offset = angles - target[:, None]
    masses = []
    for reading in (0.0, math.pi):
        distance = np.abs(np.remainder(offset - reading + math.pi, 2 * math.pi) - math.pi)
        masses.append((density * (distance <= NEAR)).sum(1) * 2 * math.pi / NODES)
    return np.stack(masses, 1)


def with_spread(values: Sequence[float]) -> str:
    """Return the mean of the seeds and their standard deviation."""
    return f"{mean(values):.2f} ± {stdev(values):.2f}"


def likelihood_table() -> tuple[list[str], str]:
    """Return the table of log-likelihoods on ambiguous digits, and a sentence about the target."""
    runs = runs_by_head("ambiguous")
    scores = {head: [result["log_likelihood"] for _, result in runs[head]] for head in HEADS}
    lines = [
        f"| density head | log-likelihood, nats | {' | '.join(f'digit {digit}' for digit in AMBIGUOUS)} | ms / image |",
        f"|---|---:|{'---:|' * len(AMBIGUOUS)}---:|",
    ]
    for head in HEADS:
        results = [result for _, result in runs[head]]
        cells = [with_spread(scores[head])]
        cells += [
            with_spread([result["groups"][digit]["log_likelihood"] for result in results])
            for digit in AMBIGUOUS
        ]
        cells.append(f"{mean(result['milliseconds_per_sample'] for result in results):.1f}")
        lines.append(f"| `{head}` | {' | '.join(cells)} |")
    gains = {head: mean(scores[head]) - mean(scores["von_mises"]) for head in HEADS[1:]}
    words = [
        f"`{head}` gains {gain:.2f} nats over `von_mises` ({'reached' if gain >= LEAST_GAIN else 'not reached'})"
        for head, gain in gains.items()
    ]
    undecided = [
        f" The gain of `{head}` differs from the aim by less than the standard deviation over the seeds, so that "
        f"{len(SEEDS)} seeds do not decide whether it reaches the aim."
        for head, gain in gains.items()
        if abs(gain - LEAST_GAIN) < stdev(scores[head])
    ]
    return lines, f"The aim was a gain of {LEAST_GAIN} nats. {' and '.join(words)}.{''.join(undecided)}"


def reading_table() -> tuple[list[str], str]:
    """Return the table of the probabilities of both readings of a turned 6 or 9, and a sentence about the aim."""
    lines = [
        f"| density head | mass at the true reading | mass at the other reading | images where both hold {READING} |",
        "|---|---:|---:|---:|",
    ]
    shares: dict[str, float] = {}
    runs = runs_by_head("pair")
    for head in HEADS:
        means: list[list[float]] = []
        for run, _ in runs[head]:
            test = test_images(run)
            masses = reading_masses(*densities_on_circle(run, test["input"]), test["target"][:, 0].numpy())
            means.append([*masses.mean(0), (masses >= READING).all(1).mean()])
        columns = list(zip(*means, strict=True))
        shares[head] = min(mean(columns[0]), mean(columns[1]))
        lines.append(f"| `{head}` | {' | '.join(with_spread(column) for column in columns)} |")
    reached = [f"`{head}`" for head, share in shares.items() if share >= READING]
    if reached:
        return (
            lines,
            f"Each of the two readings holds {READING} of the mass, as a mean over the images, with "
            f"{', '.join(reached)}.",
        )
    return lines, (
        f"The aim was that each of the two readings holds {READING} of the mass, as a mean over the images. No head "
        "reaches it: nearly all mass is at the true reading, so in most of these images the pixels themselves tell a "
        "turned 6 from a 9."
    )


def corruption_rows() -> list[dict[str, Any]]:
    """Return one row for each corruption and strength; strength 0 stands for the clean images."""
    clean = json.loads((_folder("classes") / "results.json").read_text(encoding="utf-8"))
    rows = [{"corruption": kind, "strength": 0, **_scores(clean)} for kind in CORRUPTIONS]
    for folder, results in read_runs(_folder("corrupted")):
        words = yaml.safe_load((folder / "overrides.yaml").read_text(encoding="utf-8"))
        overrides = dict(word.removeprefix("+stored.").split("=", 1) for word in words)
        scores = _scores(results)
        rows.append(
            {
                "corruption": overrides["data.corruption"],
                "strength": int(overrides["data.strength"]),
                **scores,
            }
        )
    return sorted(rows, key=lambda row: (CORRUPTIONS.index(row["corruption"]), row["strength"]))


def _scores(results: Mapping[str, Any]) -> dict[str, float]:
    return {
        "error": 100 * (1 - results["accuracy"]),
        "error_sem": 100 * results["accuracy_sem"],
        "nll": -results["log_likelihood"],
        "ece": results["ece"],
    }


def draw_corruptions(rows: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Draw error, negative log-likelihood and calibration error against the strength of each corruption."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3), layout="constrained")
    panels = (("error", "error, %"), ("nll", "NLL, nats"), ("ece", "ECE"))
    for axes, (key, label) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for kind in CORRUPTIONS:
            chosen = [row for row in rows if row["corruption"] == kind]
            axes.plot(
                [row["strength"] for row in chosen], [row[key] for row in chosen], marker="o", label=kind
            )
        axes.set(xlabel="strength (0: clean)", ylabel=label, ylim=(0, None))
    figure.axes[0].legend()
    figure.savefig(file, dpi=150)


def draw_densities(file: Path) -> None:
    """Draw the densities of each head for the first test images of each digit of PAIR and of AMBIGUOUS."""
    from matplotlib.figure import Figure

    columns = [("ambiguous", digit, number) for number, digit in enumerate(AMBIGUOUS)]
    columns += [("pair", digit, number) for number, digit in enumerate(PAIR)]
    figure = Figure(figsize=(9, 4), layout="constrained")
    grid = figure.subplots(2, len(columns), height_ratios=(1, 1.6))
    for column, (name, digit, group) in enumerate(columns):
        runs = {head: chosen[0].folder for head, chosen in runs_by_head(name).items()}
        test = test_images(runs[HEADS[0]])
        index = int((test["group"] == group).nonzero()[0])
        image, target = test["input"][index : index + 1], float(test["target"][index, 0])
        picture, axes = grid[:, column]
        picture.imshow(image[0, 0], cmap="gray", vmin=0, vmax=255)
        picture.set_title(f"a turned {digit}")
        picture.axis("off")
        for head in HEADS:
            angles, density = densities_on_circle(runs[head], image)
            axes.plot(np.degrees(angles), density[0], label=head)
        axes.axvline(math.degrees(target), color="black", linestyle=":", label="true angle")
        axes.set(xlim=(-180, 180), xticks=(-180, 0, 180), xlabel="angle, °", ylim=(0, None))
    grid[1, 0].set_ylabel("density, 1/rad")
    figure.legend(*grid[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(file, dpi=150)


def page() -> None:
    """Write the page and its figures from the runs."""
    page_folder = Path(__file__).resolve().parent
    rows = corruption_rows()
    draw_corruptions(rows, page_folder / "digits_corrupted.png")
    draw_densities(page_folder / "digits_turned.png")
    likelihoods, gain = likelihood_table()
    readings, both = reading_table()
    classes = json.loads((_folder("classes") / "results.json").read_text(encoding="utf-8"))
    lines = ["| corruption | strength | error, % | NLL, nats | ECE |", "|---|---:|---:|---:|---:|"]
    lines += [
        f"| {row['corruption'] if row['strength'] else 'none'} | {row['strength']} | {row['error']:.1f} ± "
        f"{row['error_sem']:.1f} | {row['nll']:.3f} | {row['ece']:.3f} |"
        for row in rows
        if row["strength"] or row["corruption"] == CORRUPTIONS[0]
    ]
    newline = "\n"
    publish(
        __file__,
        f"""# Real handwritten digits: classes, ambiguous turns and corrupted images

This page shows results on real images: 10,000 handwritten digits of 28 × 28 pixels (the test images of MNIST), scaled
to 32 × 32 pixels and split at random into 7,000 for training, 1,500 for validation and 1,500 for the test.

## Turns of 0, 1 and 8

Each image is turned by a random angle, and the model predicts this angle (`data=turned_images`). A 0, 1 or 8 looks
nearly the same after half a turn, so that a density with one peak must be wide or wrong. The table gives mean
log-likelihoods of the angle, for all test images and for each digit; higher is better. They are means over {
            len(SEEDS)
        }
seeds of the training, with their standard deviation.

{newline.join(likelihoods)}

{gain}

## Turns of 6 and 9 whose digit is not given

A turned 6 looks like a 9. The model sees only the image, and not the digit. The table shows the mass of the predicted
density within 45° of the true angle, and within 45° of the opposite angle (the two readings of the image).

{newline.join(readings)}

{both}

![Densities of the angle for turned digits](digits_turned.png)

*Densities of the angle for the first test image of each digit (real images, first seed).*

## Classes

`experiment=images/classification uncertainty.temperature.prior=null` (one seed) classifies {
            classes["test_samples"]
        } test images:

| accuracy, % | negative log-likelihood, nats | expected calibration error | ms / image | minutes |
|---:|---:|---:|---:|---:|
| {100 * classes["accuracy"]:.2f} ± {100 * classes["accuracy_sem"]:.2f} | {-classes["log_likelihood"]:.3f} | {
            classes["ece"]:.4f} | {classes["milliseconds_per_sample"]:.2f} | {_minutes("classes"):.1f} |

± is the standard error over the test images. The time is for the whole command with one thread, while other work ran
on the machine.

## Corrupted test images

The same model is tested on images with the four corruptions of `data=image_folder` in five strengths. It was trained on
clean images only. ± is the standard error over the test images, NLL is the negative log-likelihood, and ECE the
expected calibration error; lower is better.

{newline.join(lines)}

![Error, likelihood and calibration against the strength of four corruptions](digits_corrupted.png)

*Error, negative log-likelihood and calibration error against the strength of four corruptions (real images).*

{machine("torch", "numpy")}
Commands: `python -m benchmarks.images.digits train <folder>`, then `python -m benchmarks.images.digits page <folder>`.
""",
    )


def _minutes(name: str) -> float:
    """Return the time from the start of a run to its results, minutes."""
    started = json.loads((_folder(name) / "run.json").read_text(encoding="utf-8"))["started"]
    return ((_folder(name) / "results.json").stat().st_mtime - started) / 60


def main() -> None:
    parser = argparse.ArgumentParser(description="Results on real handwritten digits.")
    parser.add_argument("task", choices=("train", "page"))
    parser.add_argument("root", type=Path)
    arguments = parser.parse_args()
    if arguments.task == "train":
        train(arguments.root.resolve())
    else:
        page()


if __name__ == "__main__":
    main()
