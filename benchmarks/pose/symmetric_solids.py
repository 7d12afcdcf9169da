"""Compare densities of rotations of symmetric solids with the exact density.

    python -m benchmarks.pose.symmetric_solids train     # trains every method that has no run yet, one after another
    python -m benchmarks.pose.symmetric_solids page      # writes symmetric_solids.md and its figure

Runs are in outputs/sweeps/symmetric_solids/<method>_seed<seed>.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import numpy as np
import torch
import yaml
from matplotlib.ticker import FixedLocator, NullFormatter
from torch import Tensor

import framework
from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, publish
from benchmarks.timing import time_interleaved
from framework.configuration.schema import build, resolve
from framework.datasets.fields import fetch
from framework.figures.style import COLOURS, GREY, MARKERS, save_figure, titled_figure
from framework.geometry import quaternions
from framework.geometry.rotation_grid import centres, points_in
from framework.geometry.symmetry import GROUPS, log_blurred

METHODS = (
    *("von_mises", "projected_normal", "matrix_fisher", "rotation_laplace"),
    *("mixture", "scvae", "implicit_pdf"),
)
NAMES = {
    "von_mises": "von Mises angles",
    "projected_normal": "projected normal angles",
    "matrix_fisher": "matrix Fisher",
    "rotation_laplace": "rotation Laplace",
    "mixture": "mixture of 72 matrix Fisher",
    "scvae": "sCVAE of von Mises",
    "implicit_pdf": "implicit PDF",
}
SOLIDS = ("tetrahedron", "cube", "cone", "cylinder")
SEEDS = (0, 1, 2)
BATCH = 64
"""Number of test images of the batch whose run time is measured."""
NEAR = 0.3
"""Largest distance from the optimum at which the aim is reached, nats."""
RUNS = ROOT / "outputs" / "sweeps" / "symmetric_solids"
CELLS = 36864
"""Number of rotations at which the densities of the figure are evaluated."""
LARGEST_DOT = 9.0
"""Area of the dot of the highest density in a panel of the figure, points²."""


def train(methods: tuple[str, ...], seeds: tuple[int, ...]) -> None:
    """Train and test every method that has no results yet."""
    for seed in seeds:
        for method in methods:
            folder = RUNS / f"{method}_seed{seed}"
            if not (folder / "results.json").exists():
                carry_out(
                    [
                        sys.executable,
                        "-m",
                        "framework",
                        f"experiment=symmetric_solids/{method}",
                        f"seed={seed}",
                        "threads=1",
                        "pictures=false",
                        f"hydra.run.dir={folder}",
                    ]
                )


def read_runs() -> dict[str, list[tuple[Path, Mapping[str, Any]]]]:
    """Return the runs of every method that has any, with their results, by method."""
    runs: dict[str, list[tuple[Path, Mapping[str, Any]]]] = {}
    for method in METHODS:
        for seed in SEEDS:
            folder = RUNS / f"{method}_seed{seed}"
            if (folder / "results.json").exists():
                results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
                runs.setdefault(method, []).append((folder, results))
    return runs


@torch.no_grad()
def measure_costs(runs: Mapping[str, list[tuple[Path, Mapping[str, Any]]]]) -> dict[str, float]:
    """Return the processor time of a density and its log-density for each method, ms per image, on one thread.

    The methods are timed in interleaved rounds, so that other work on the machine affects all of them.
    """
    torch.set_num_threads(1)
    first = next(iter(runs.values()))[0][0]
    config = yaml.safe_load((first / "config.yaml").read_text(encoding="utf-8"))
    data = build("data", resolve("data", config["data"]))
    data.prepare()
    batch = fetch(data.splits().test, range(BATCH))
    models = {method: framework.load(str(chosen[0][0])) for method, chosen in runs.items()}

    def predict(method: str) -> object:
        return models[method](batch["input"]).log_prob(batch["target"])

    calls = {method: partial(predict, method) for method in runs}
    return {method: rounds.median / BATCH for method, rounds in time_interleaved(calls, seconds=0.1).items()}


def winners(runs: Mapping[str, list[tuple[Path, Mapping[str, Any]]]], costs: Mapping[str, float]) -> str:
    """Return the sentence that says which method is nearest to the exact density at which run time."""
    gaps = {method: mean(results["optimum_gap"] for _, results in chosen) for method, chosen in runs.items()}
    best, parts = math.inf, []
    for method in sorted(runs, key=lambda method: costs[method]):
        if gaps[method] < best:
            best = gaps[method]
            parts.append(f"{costs[method]:.2g} ms, {NAMES[method]} (distance {best:.2f} nats)")
    beaten = [NAMES[method] for method in runs if not any(NAMES[method] in part for part in parts)]
    return (
        "if a prediction may take at least the following time per image, the method that is nearest to the exact "
        f"density is: {'; '.join(parts)}. Each of the other methods ("
        f"{', '.join(beaten)}) is slower than one of these and not nearer."
    )


def with_error(values: list[float], errors: list[float]) -> str:
    """Return the mean over seeds with the standard deviation, or for one seed with its standard error over images."""
    spread = stdev(values) if len(values) > 1 else errors[0]
    return f"{mean(values):.2f} ± {spread:.2f}"


def result_cells(runs: list[tuple[Path, Mapping[str, Any]]], key: str) -> list[str]:
    """Return the cells of a result: over all solids, and of each solid."""
    parts = [[results for _, results in runs]]
    parts += [[results["groups"][solid] for _, results in runs] for solid in SOLIDS]
    return [
        with_error([results[key] for results in part], [results[f"{key}_sem"] for results in part])
        for part in parts
    ]


def minutes(folder: Path) -> float:
    """Return the time from the start of a run to its results, minutes."""
    started = json.loads((folder / "run.json").read_text(encoding="utf-8"))["started"]
    return ((folder / "results.json").stat().st_mtime - started) / 60


def tables(
    runs: Mapping[str, list[tuple[Path, Mapping[str, Any]]]], costs: Mapping[str, float]
) -> tuple[list[str], list[str]]:
    """Return the tables of log-likelihoods and of spreads."""
    head = f"| method | seeds | all | {' | '.join(SOLIDS)} |"
    rule = "|---|---:|" + "---:|" * (1 + len(SOLIDS))
    likelihood = [head + " ms / image | minutes |", rule + "---:|---:|"]
    spread = [head, rule]
    for method, chosen in runs.items():
        cells = result_cells(chosen, "rotation_log_likelihood")
        cost = costs[method]
        time = mean(minutes(folder) for folder, _ in chosen)
        likelihood.append(
            f"| {NAMES[method]} | {len(chosen)} | {' | '.join(cells)} | {cost:.1f} | {time:.0f} |"
        )
        spread.append(
            f"| {NAMES[method]} | {len(chosen)} | {' | '.join(result_cells(chosen, 'spread_deg'))} |"
        )
    first = next(iter(runs.values()))[:1]
    likelihood.append(f"| **exact density** | | {' | '.join(result_cells(first, 'optimum'))} | | |")
    spread.append(f"| **exact density** | | {' | '.join(result_cells(first, 'least_spread_deg'))} |")
    uniform = f"{-math.log(math.pi**2):.2f}"
    likelihood.append(f"| uniform density | | {' | '.join([uniform] * (1 + len(SOLIDS)))} | | |")
    return likelihood, spread


def conclusion(runs: Mapping[str, list[tuple[Path, Mapping[str, Any]]]], costs: Mapping[str, float]) -> str:
    """Return the sentences about the best method, its distance from the optimum, and its cost."""
    gaps = {method: mean(results["optimum_gap"] for _, results in chosen) for method, chosen in runs.items()}
    ranked = sorted(gaps, key=lambda method: gaps[method])
    best, fastest = ranked[0], min(ranked, key=lambda method: costs[method])
    by_solid = {
        solid: mean(results["groups"][solid]["optimum_gap"] for _, results in runs[best]) for solid in SOLIDS
    }
    values = [results["optimum_gap"] for _, results in runs[best]]
    error = stdev(values) if len(values) > 1 else runs[best][0][1]["optimum_gap_sem"]
    distances = ", ".join(f"{NAMES[method]} {gaps[method]:.2f}" for method in ranked)
    parts = ", ".join(f"{gap:.2f} ({solid})" for solid, gap in by_solid.items())
    cheapest = (
        f"It is also the fastest, with {costs[best]:.1f} ms per image."
        if fastest == best
        else f"It takes {costs[best]:.1f} ms per image. The fastest method, {NAMES[fastest]}, takes "
        f"{costs[fastest]:.1f} ms per image, and its distance is larger by {gaps[fastest] - gaps[best]:.2f} nats."
    )
    return (
        "The distance of a method from the exact density is the mean log-likelihood of the exact density minus "
        f"that of the method; lower is better. Over all test images, it is (in nats): {distances}. The aim was a "
        f"distance of at most {NEAR} nats with the best method; it is "
        f"{'reached' if gaps[best] <= NEAR else 'not reached'}. The best method is {NAMES[best]}, with the distance "
        f"{gaps[best]:.3f} ± {error:.3f} over all images, and {parts}. {cheapest}"
    )


@torch.no_grad()
def densities_on_grid(run: Path, inputs: Tensor) -> np.ndarray:
    """Return the density of each image's rotation at the centres of the grid, relative to the uniform density."""
    model = framework.load(str(run))
    angles = centres(CELLS)
    columns = []
    for image in inputs:
        torch.manual_seed(0)
        density = model(image[None])
        log_prob = torch.cat([density.log_prob(part[:, None].float()) for part in angles.split(2048)])[:, 0]
        relative = log_prob.double() - angles[:, 1].cos().log() + math.log(8 * math.pi**2)
        if getattr(density.support, "ranges", None) is None:  # two triples of angles describe a rotation
            other = torch.tensor([math.pi] * 3).double() + torch.tensor([1.0, -1.0, 1.0]).double() * angles
            twin = torch.cat([density.log_prob(part[:, None].float()) for part in other.split(2048)])[:, 0]
            relative = torch.logaddexp(
                relative, twin.double() - angles[:, 1].cos().log() + math.log(8 * math.pi**2)
            )
        columns.append(relative.exp())
    return torch.stack(columns).numpy()


def draw(runs: Mapping[str, list[tuple[Path, Mapping[str, Any]]]]) -> None:
    """Draw for one test image of each solid the exact density and those of the methods, as dots over all rotations.

    A rotation is a place, the direction of the object's z axis as seen from the camera on a map of the sphere
    (Mollweide), and a colour, the rotation about this axis. The area of a dot is proportional to the density.
    """
    first = next(iter(runs.values()))[0][0]
    config = yaml.safe_load((first / "config.yaml").read_text(encoding="utf-8"))
    data = build("data", resolve("data", config["data"]))
    data.prepare()
    test = data.splits().test
    every = fetch(test, range(len(test)))
    rows = [int((every["group"] == group).nonzero()[3]) for group in range(len(SOLIDS))]
    angles = centres(CELLS)
    turns = quaternions.of_viewpoint(angles)
    exact = [
        log_blurred(
            every["true_rotation"][row], turns, GROUPS[int(every["symmetry_group"][row])], data.concentration
        )
        for row in rows
    ]
    columns = [("exact density", torch.stack(exact).exp().numpy())]
    shown = [
        method for method in METHODS if method in runs and method in ("mixture", "scvae", "implicit_pdf")
    ]
    columns += [
        (NAMES[method], densities_on_grid(runs[method][0][0], every["input"][rows])) for method in shown
    ]
    figure = titled_figure(
        (2.6 * len(columns) + 1.0, 1.3 * len(rows) + 0.8),
        "Densities of rotations given one image",
        synthetic=True,
    )
    grid = figure.add_gridspec(len(rows), len(columns) + 1, width_ratios=[0.6] + [1.6] * len(columns))
    # a random place in each cell, so that dots of one pixel do not hide one another
    x, y = torch.rand(2, CELLS, generator=torch.Generator().manual_seed(0)).double()
    drawn = points_in(torch.arange(CELLS), x, y, torch.full((CELLS,), 0.5), CELLS)
    longitude, latitude = drawn[:, 2].numpy(), drawn[:, 1].numpy()
    color = np.remainder(drawn[:, 0].numpy(), 2 * math.pi) / (2 * math.pi)
    for number, row in enumerate(rows):
        picture = figure.add_subplot(grid[number, 0])
        picture.imshow(every["input"][row, 0], cmap="gray", vmin=0, vmax=255)
        picture.axis("off")
        picture.set_title(SOLIDS[number], fontsize=9)
        highest = columns[0][1][number].max()
        for place, (name, values) in enumerate(columns, start=1):
            axes = figure.add_subplot(grid[number, place], projection="mollweide")
            density = values[number]
            visible = density > 0.03 * highest
            order = np.argsort(density[visible])
            axes.scatter(
                longitude[visible][order],
                latitude[visible][order],
                s=LARGEST_DOT * np.minimum(density[visible][order] / highest, 1.5),
                c=color[visible][order],
                cmap="hsv",
                vmin=0,
                vmax=1,
                linewidths=0,
            )
            axes.set(xticks=[], yticks=[])
            if number == 0:
                axes.set_title(name, fontsize=9)
    save_figure(figure, Path(__file__).resolve().with_suffix(""), "png")


def draw_cost(runs: Mapping[str, list[tuple[Path, Mapping[str, Any]]]], costs: Mapping[str, float]) -> None:
    """Draw the distance from the exact density against the time of a prediction, with a point for each method.

    A line shows the best distance at each run time.
    """
    figure = titled_figure((7.0, 3.4), "Distance from the exact density", synthetic=True)
    axes = figure.add_subplot()
    for number, (method, chosen) in enumerate(runs.items()):
        gaps = [results["optimum_gap"] for _, results in chosen]
        error = stdev(gaps) if len(gaps) > 1 else chosen[0][1]["optimum_gap_sem"]
        axes.errorbar(
            *(costs[method], mean(gaps), error),
            marker=MARKERS[number],
            color=COLOURS[number],
            label=NAMES[method],
            ls="",
        )
    ranked = sorted(
        (costs[method], mean(results["optimum_gap"] for _, results in chosen))
        for method, chosen in runs.items()
    )
    best = np.minimum.accumulate([gap for _, gap in ranked])
    times = [cost for cost, _ in ranked]
    axes.step(
        [*times, 3 * times[-1]], [*best, best[-1]], where="post", color=GREY, zorder=0, label="best so far"
    )
    axes.axhline(NEAR, color=GREY, linestyle=":", label=f"aim: {NEAR} nats")
    axes.set(xscale="log", xlabel="milliseconds per image", ylabel="nats below exact density", ylim=(0, None))
    axes.xaxis.set_major_locator(FixedLocator([0.1, 0.3, 1, 3, 10, 30, 100]))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(times[0] / 2, 2 * times[-1])
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
    save_figure(figure, Path(__file__).resolve().with_name("symmetric_solids_cost"), "png")


def page() -> None:
    """Write the page and its figure from the runs."""
    runs = read_runs()
    if not runs:
        sys.exit(
            f"{RUNS} holds no finished run. Run `python -m benchmarks.pose.symmetric_solids train` first."
        )
    draw(runs)
    costs = measure_costs(runs)
    draw_cost(runs, costs)
    likelihood, spread = tables(runs, costs)
    newline = "\n"
    missing = [NAMES[method] for method in METHODS if method not in runs]
    unmeasured = f"\nThese methods were not measured: {', '.join(missing)}.\n" if missing else ""
    publish(
        __file__,
        f"""# Rotations of symmetric solids, and the exact density

This page compares densities of rotations that are predicted from one image of a symmetric solid. The data are
synthetic (`data=symmetric_solids`, 20,000 images of 32 × 32 pixels for training, 2,000 for the test): the solids of
SYMSOL I (Murphy et al. 2021) without the icosahedron. Labels have a noise of 10° about each axis, so that their exact
density given the image is known, and no method can have a higher mean log-likelihood.

## Log-likelihood

The table holds mean log-likelihoods in nats, with respect to the volume in which all rotations measure π², as in Murphy
et al. 2021. Higher is better.

{newline.join(likelihood)}

{conclusion(runs, costs)}

**Which method wins at which run time:** {winners(runs, costs)}
{unmeasured}
± is the standard deviation over seeds of the training, or for a single seed the standard error over the test images.
"ms / image" is the processor time of a prediction and its log-density in batches of {BATCH} on one thread, measured for
all methods in interleaved rounds. "minutes" is the whole command with training and test, on one thread while other work
ran on the machine. Every method has the same network and
the same 8 epochs (2,500 steps); Murphy et al. 2021 train for 100,000 steps. The mixture has three components for each
of the 24 equivalent rotations of a cube. 24 components are not enough: while a cube turns until it looks the same
again, its equivalent rotations change places, so that no 24 continuous functions of the image can follow them. The
number was chosen in short trials on validation images of a cube, which no command repeats.

![Distance from the exact density against milliseconds per image](symmetric_solids_cost.png)

*Distance from the exact density against the time of a prediction (synthetic). Both are better if they are lower.*

## Spread

The table holds the mean angle, in degrees, between a rotation that is drawn from the predicted density and the nearest
rotation that looks like the true one. For the exact density this angle is not 0, because labels are noisy.

{newline.join(spread)}

![Exact and predicted densities of rotations for one image of each solid](symmetric_solids.png)

*Densities for one test image of each solid (synthetic, first seed). A dot is a rotation: its place is elevation and
tilt on a map of the sphere (Mollweide), its colour the azimuth, and its area the density. A peak of a polyhedron's
exact density holds dots of several colours, because several equivalent rotations differ in the azimuth alone.
Densities below 3 % of the highest exact density are not drawn, so that a panel of a nearly uniform density is empty.*

{machine("torch", "numpy")}
Commands: `python -m benchmarks.pose.symmetric_solids train`, then `python -m benchmarks.pose.symmetric_solids page`.
""",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Rotations of symmetric solids.")
    parser.add_argument("task", choices=("train", "page"))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    arguments = parser.parse_args()
    if arguments.task == "train":
        train(tuple(arguments.methods), tuple(arguments.seeds))
    else:
        page()


if __name__ == "__main__":
    main()
