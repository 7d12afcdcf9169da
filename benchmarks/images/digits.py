"""Predict classes and turns of real handwritten digits, with ambiguity and with corrupted test images.

    python -m benchmarks.images.digits train /path/to/digits     # trains 36 + 1 models, and tests 20 corruptions
    python -m benchmarks.images.digits page /path/to/digits      # writes digits.md and its figures

`page --section turns`, `page --section cue` and `page --section mass` write only one section again; `cue` needs no
trained model.

The folder holds test images of MNIST as idx files (`t10k-images-idx3-ubyte.gz` and `t10k-labels-idx1-ubyte.gz`). They
are split at random into training, validation and test. Runs are in outputs/sweeps/digits_*.
"""

import argparse
import itertools
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from torch import Tensor

import framework
from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, publish, replace_section
from benchmarks.sweeps import Run, read_runs
from framework.configuration.schema import build, resolve
from framework.datasets.fields import fetch
from framework.distributions.circular import angular_distance
from plugins.data.image_folder.data import find_centres, turn

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
TURNS = 36
"""Number of angles by which an image is turned to look for the most similar image."""
TURNS_HEADING = "## Turns of 0, 1 and 8"
CUE_HEADING = "## What reveals the angle of these images"
MASS_HEADING = "## Turns about the centre of mass"
CENTRES = {"image": "middle of the image", "mass": "centre of mass"}
"""Points about which images are turned, with their names."""
SUFFIXES = {"image": "", "mass": "_mass"}
"""Suffixes of the names of the sweeps for each of these points."""
SWEEPS = ROOT / "outputs" / "sweeps"
IMAGES = ("data.image_size=32", "data.grayscale=true", "threads=1", "logger=none")


def train(root: Path) -> None:
    """Train all models, and test the classifier on corrupted images; interrupted sweeps are continued."""
    turned = itertools.product(CENTRES, (("ambiguous", AMBIGUOUS), ("pair", PAIR)))
    for centre, (name, digits) in turned:
        chosen = ",".join(f"'{digit}'" for digit in digits)
        heads = ",".join(f"images/turned_{head}" for head in HEADS)
        varied = (f"experiment={heads}", f"seed={','.join(map(str, SEEDS))}")
        settings = (f"data.classes=[{chosen}]", f"data.centre={centre}")
        _run("-m", *varied, *settings, *_place(root, name + SUFFIXES[centre]))
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


class Readings(NamedTuple):
    """Findings of two simple rules in turned images of the validation and test splits.

    Attributes:
        place_error: distance of the angle that the centre of mass indicates from the true angle, (image,), radians.
        neighbour_error: distance of the angle of the most similar other image from the true angle, (image,), radians.
        wrong_digit: whether the most similar other image is another digit, (image,).
    """

    place_error: Tensor
    neighbour_error: Tensor
    wrong_digit: Tensor


def simple_readings(root: Path, digits: Sequence[str], centre: str) -> Readings:
    """Return the findings of two rules without a trained model in images that are turned about `centre`.

    The first rule takes the direction from the middle of the image to its centre of mass, minus the mean of this
    direction in upright training images. The second rule looks for the most similar image, with the smallest sum of
    squared differences of pixels, among all other images, each turned by TURNS angles.
    """
    settings = {"root": str(root), "image_size": 32, "grayscale": True, "classes": list(digits)}
    data: Any = build("data", resolve("data", {"name": "turned_images", "centre": centre, **settings}))
    data.prepare()
    parts = [fetch(split, range(len(split))) for split in data.splits()]
    images = torch.cat([part["input"] for part in parts]).float()
    angle = torch.cat([part["target"] for part in parts])[:, 0]
    digit = torch.cat([part["group"] for part in parts])
    first = len(parts[0]["input"])
    centres: Any = find_centres(images, "mass")
    x, y = centres.unbind(1)
    direction = torch.atan2(-y, x) - angle
    usual = torch.atan2(direction[:first].sin().mean(), direction[:first].cos().mean())
    queries = images[first:].flatten(1)
    nearest = torch.full((len(queries),), math.inf)
    neighbour, neighbour_angle = torch.empty(len(queries), dtype=torch.int64), torch.empty(len(queries))
    for step in range(TURNS):
        turn_by = 2 * math.pi * step / TURNS
        turned = turn(images, torch.full((len(images),), turn_by)).flatten(1)
        distance = torch.cdist(queries, turned)
        distance[:, first:].fill_diagonal_(math.inf)
        least, index = distance.min(1)
        closer = least < nearest
        nearest[closer], neighbour[closer] = least[closer], index[closer]
        neighbour_angle[closer] = angle[index[closer]] + turn_by
    return Readings(
        angular_distance(direction[first:], usual),
        angular_distance(neighbour_angle, angle[first:]),
        digit[neighbour] != digit[first:],
    )


def cue_text(root: Path) -> str:
    """Return the section about the cues that reveal the angles of these images."""
    lines = [
        "| digits | turned about | place of the digit: angle within 45° | most similar image: opposite angle | "
        "most similar image: wrong digit |",
        "|---|---|---:|---:|---:|",
    ]
    wrong: dict[str, Tensor] = {}
    for digits in (AMBIGUOUS, PAIR):
        for centre, name in CENTRES.items():
            readings = simple_readings(root, digits, centre)
            columns = [
                readings.place_error <= NEAR,
                readings.neighbour_error >= math.pi - NEAR,
                readings.wrong_digit,
            ]
            lines.append(
                f"| {', '.join(digits)} | {name} | {' | '.join(share(column) for column in columns)} |"
            )
            wrong[centre] = readings.wrong_digit.double()  # of PAIR in the end
    error, spread = float(wrong["image"].mean()), float(wrong["image"].std() / len(wrong["image"]) ** 0.5)
    table = "\n".join(lines)
    verdict = "cannot reach" if 2 * (error + 2 * spread) < READING else "may reach"
    return f"""The digits of MNIST are placed by their centre of mass, which lies about half a pixel to the right of
the middle of the image and below it. Each image is turned about its middle (`data.centre=image`), so the place of the
digit turns with it. Two rules without a trained model show that this small offset reveals the angle. The first rule
takes only the direction from the middle to the centre of mass. The second rule takes the angle and the digit of the
most similar other image, after each of them is turned by {TURNS} angles. If images are turned about their centres of
mass (`data.centre=mass`), little of this cue is left. The table gives shares of the validation and test images, and ±
is their standard error.

{table}

An angle is within 45° by chance in 25 % of the images.

The share of wrong digits limits the mass of the other reading of a 6 or 9. If an image is a 6 with probability p and a
9 with probability 1 - p, the other reading has the mean mass 2 p (1 - p) under the exact density. This is at most twice
the smallest error of any rule, min(p, 1 - p), and so at most twice the error of this rule. With very many images, the
error of this rule itself tends to 2 p (1 - p) (Cover & Hart 1967). For images that are turned about their middle, the
mass of the other reading is thus at most {2 * error:.3f} ± {2 * spread:.3f}. For such images, a calibrated
density {verdict} the aim of {READING} as a mean over the images. The reason is the offset, and not the shape
of the digits.

{machine("torch", "numpy")}
Command: `python -m benchmarks.images.digits page --section cue <folder>`."""


def share(is_true: Tensor) -> str:
    """Return the share of images for which a statement is true, with its standard error, in percent."""
    values = 100 * is_true.double()
    return f"{float(values.mean()):.1f} ± {float(values.std()) / len(values) ** 0.5:.1f} %"


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


def likelihood_table(sweep: str) -> tuple[list[str], str]:
    """Return the table of log-likelihoods on ambiguous digits, and sentences about run time and the aim."""
    runs = runs_by_head(sweep)
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
    aim = f"The aim was a gain of {LEAST_GAIN} nats. {' and '.join(words)}.{''.join(undecided)}"
    return lines, f"{winners(runs)}\n\n{aim}"


def winners(runs: Mapping[str, Sequence[Run]]) -> str:
    """Return the sentence that says which density head has the highest log-likelihood at which run time."""
    best, parts = -math.inf, []
    costs = {head: mean(results["milliseconds_per_sample"] for _, results in runs[head]) for head in HEADS}
    for head in sorted(HEADS, key=lambda head: costs[head]):
        value = mean(results["log_likelihood"] for _, results in runs[head])
        if value > best:
            best = value
            parts.append(f"{costs[head]:.1f} ms, `{head}` ({value:.2f} nats)")
    return (
        "**Which head wins at which run time:** if a prediction may take at least the following time per image, the "
        f"head with the highest log-likelihood is: {'; '.join(parts)}."
    )


def turns_text() -> str:
    """Return the section about turns of 0, 1 and 8."""
    lines, gain = likelihood_table("ambiguous")
    table = "\n".join(lines)
    return f"""Each image is turned by a random angle, and the model predicts this angle (`data=turned_images`). A 0, 1
or 8 looks nearly the same after half a turn. The table gives mean log-likelihoods of the angle, for all test images and
for each digit; higher is better. They are means over {len(SEEDS)} seeds of the training, with their standard deviation.

{table}

{gain}"""


def masses_by_head(sweep: str) -> dict[str, list[np.ndarray]]:
    """Return the masses of the true and the other reading of each test image, (image, 2), for each run by head."""
    masses: dict[str, list[np.ndarray]] = {}
    for head, runs in runs_by_head(sweep).items():
        tests = [(run, test_images(run)) for run, _ in runs]
        masses[head] = [
            reading_masses(*densities_on_circle(run, test["input"]), test["target"][:, 0].numpy())
            for run, test in tests
        ]
    return masses


def reading_table(masses: Mapping[str, Sequence[np.ndarray]]) -> tuple[list[str], str]:
    """Return the table of the probabilities of both readings of a turned 6 or 9, and a sentence about the aim.

    Args:
        masses: result of `masses_by_head`.
    """
    lines = [
        f"| density head | mass at the true reading | mass at the other reading | images where both hold {READING} |",
        "|---|---:|---:|---:|",
    ]
    shares: dict[str, float] = {}
    for head, runs in masses.items():
        means = [[*image_masses.mean(0), (image_masses >= READING).all(1).mean()] for image_masses in runs]
        columns = list(zip(*means, strict=True))
        shares[head] = min(mean(columns[0]), mean(columns[1]))
        lines.append(f"| `{head}` | {' | '.join(with_spread(column) for column in columns)} |")
    reached = [f"`{head}`" for head, share in shares.items() if share >= READING]
    if reached:
        return (
            lines,
            f"Each of the two readings holds {READING} of the mass, as a mean over the images, with "
            f"{' and '.join(reached)}. This was the aim.",
        )
    nearest = max(shares, key=lambda head: shares[head])
    return lines, (
        f"The aim was that each of the two readings holds {READING} of the mass, as a mean over the images. No head "
        f"reaches it. `{nearest}` comes nearest, with {shares[nearest]:.2f} at the less likely reading."
    )


def reading_errors(masses: Mapping[str, Sequence[np.ndarray]]) -> str:
    """Return sentences that compare the mass of the less likely reading with how often that reading is the true one."""
    clauses = []
    for head, runs in masses.items():
        other = np.mean([image_masses[:, 1] for image_masses in runs], axis=0)
        less = np.mean([image_masses.min(1) for image_masses in runs])
        wrong = np.mean([image_masses[:, 0] < image_masses[:, 1] for image_masses in runs], axis=0)
        error, chance = other.std(ddof=1) / len(other) ** 0.5, wrong.std(ddof=1) / len(wrong) ** 0.5
        close = abs(other.mean() - READING) < 2 * error
        clauses.append(
            f"- `{head}`: mass at the other reading {other.mean():.3f} ± {error:.3f}"
            f"{f', which differs from {READING} by less than two standard errors' if close else ''}; mass at the less "
            f"likely reading {less:.3f}; share of images where the less likely reading is the true one "
            f"{wrong.mean():.3f} ± {chance:.3f}."
        )
    count = len(next(iter(masses.values()))[0])
    return f"""In this list, ± is the standard error over the {count} test images. If a density is calibrated, the
mean mass of the less likely reading equals the share of images where this reading is the true one:

{chr(10).join(clauses)}"""


def mass_text() -> str:
    """Return the section about images that are turned about their centres of mass."""
    likelihoods, gain = likelihood_table("ambiguous_mass")
    masses = masses_by_head("pair_mass")
    readings, both = reading_table(masses)
    newline = "\n"
    return f"""The same models were also trained and tested on images that are turned about their centres of mass
(`data.centre=mass`), so that little of the cue of the last section is left. All other settings are as above: the same
density heads, epochs, split and seeds. The tables have the same columns as those above, and ± is the standard deviation
over {len(SEEDS)} seeds.

Turns of {", ".join(AMBIGUOUS[:-1])} and {AMBIGUOUS[-1]}:

{newline.join(likelihoods)}

{gain}

Turns of {" and ".join(PAIR)} whose digit is not given:

{newline.join(readings)}

{both}

{reading_errors(masses)}

{machine("torch", "numpy")} Other programs used the machine at the same time.
Commands: `python -m benchmarks.images.digits train <folder>`, then
`python -m benchmarks.images.digits page --section mass <folder>`."""


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


def page(root: Path) -> None:
    """Write the page and its figures from the runs, and from the images in the folder `root`."""
    page_folder = Path(__file__).resolve().parent
    rows = corruption_rows()
    draw_corruptions(rows, page_folder / "digits_corrupted.png")
    draw_densities(page_folder / "digits_turned.png")
    readings, both = reading_table(masses_by_head("pair"))
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

{TURNS_HEADING}

{turns_text()}

## Turns of 6 and 9 whose digit is not given

A turned 6 looks like a 9. The model sees only the image, and not the digit. The table shows the mass of the predicted
density within 45° of the true angle, and within 45° of the opposite angle (the two readings of the image).

{newline.join(readings)}

{both} The next sections show the reason.

![Densities of the angle for turned digits](digits_turned.png)

*Densities of the angle for the first test image of each digit (real images, first seed).*

{CUE_HEADING}

{cue_text(root)}

{MASS_HEADING}

{mass_text()}

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
    parser.add_argument(
        "--section", choices=("turns", "cue", "mass"), help="section that `page` writes again"
    )
    arguments = parser.parse_args()
    if arguments.task == "train":
        train(arguments.root.resolve())
    elif arguments.section:
        sections = {
            "turns": (TURNS_HEADING, turns_text),
            "cue": (CUE_HEADING, lambda: cue_text(arguments.root)),
            "mass": (MASS_HEADING, mass_text),
        }
        heading, text = sections[arguments.section]
        replace_section(Path(__file__).with_suffix(".md"), heading, text())
    else:
        page(arguments.root)


if __name__ == "__main__":
    main()
