"""Measure each method's log-likelihood of the pan angle under blur (thesis Figures 3.7 and 3.8).

    python -m reproduction.thesis_tables 3.7-3.8 [--seeds 3]
    python -m reproduction.chapter3.blur <folders of the sweeps> [--root <folder of the real IDIAP set>]
    python -m reproduction.chapter3.blur --draw

Every model that was trained for the pan angle alone predicts blurred images of the test split. The script writes
blur.md, blur.csv, blur.png (the curves) and blur_strip.png (the densities of one head) beside this file. `--draw` draws
blur.png again from blur.csv.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes

from benchmarks.pages import machine, publish, read_rows
from benchmarks.sweeps import read_runs
from framework.configuration.loading import load_with_description
from framework.configuration.schema import build
from framework.datasets.images import blur, to_rgb8
from framework.distributions.density import circular_grid
from framework.distributions.protocol import marginal
from framework.figures.style import COLOURS, GREY, MARKERS, save_figure, titled_figure
from framework.model import Predictor
from framework.reports.table import aggregate, markdown, write_csv

HERE = Path(__file__).resolve()
METHODS = {
    "fixed_kappa": "von Mises, fixed concentration",
    "von_mises": "von Mises",
    "mixture": "mixture of von Mises",
    "cvae": "CVAE",
    "scvae": "sCVAE",
}
"""Names of the experiments and of their curves in the figures."""
UNIFORM = -math.log(2 * math.pi)
CUT = -3.0
"""Log-likelihood in nats below which the vertical axis of the curves is compressed."""
DEVIATIONS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Standard deviations of the blur, in pixels of an image of SIDE pixels; other sizes are blurred in proportion."""
SIDE = 75
IMAGES = 1000
COLUMNS = {"method": "method", "n": "seeds"} | {f"blur_{d:g}": f"σ = {d:g}" for d in DEVIATIONS}


def blur_images(images: torch.Tensor, deviation: float) -> torch.Tensor:
    return blur(images, deviation * images.shape[-1] / SIDE)


@torch.no_grad()
def log_likelihoods(model: Predictor, images: torch.Tensor, pan: torch.Tensor) -> dict[str, float]:
    """Return the mean log-likelihood of the pan angle in nats for each blur."""
    likelihoods = {}
    for deviation in DEVIATIONS:
        torch.manual_seed(0)
        parts = [
            marginal(model(blur_images(block, deviation)), 0).log_prob(angle)
            for block, angle in zip(images.split(100), pan.split(100), strict=True)
        ]
        likelihoods[f"blur_{deviation:g}"] = torch.cat(parts).double().mean().item()
    return likelihoods


def method_key(row: dict[str, object]) -> str:
    """Return the key in `METHODS` of a row."""
    return str(row["method"]).rpartition("/")[2]


def aggregate_seeds(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Return means and standard deviations over seeds, in the order of `METHODS`."""
    return sorted(aggregate(rows, by=["method"]), key=lambda row: list(METHODS).index(method_key(row)))


def draw_curves(rows: list[dict[str, object]], path: Path) -> None:
    """Draw the log-likelihoods: the upper panel compares the methods, the lower one shows values below `CUT`."""
    figure = titled_figure(
        (7.5, 6), "Log-likelihood of the pan angle under blur, IDIAP", bool(rows[0]["synthetic"])
    )
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
    lowest = CUT
    for row in aggregate_seeds(rows):
        index = list(METHODS).index(method_key(row))
        mean, spread = (
            np.array([row.get(f"blur_{d:g}{suffix}", math.nan) for d in DEVIATIONS], dtype=float)
            for suffix in ("", "_std")
        )
        lowest = min(lowest, np.nanmin([mean, mean - spread]))
        for axes in (upper, lower):
            axes.plot(
                DEVIATIONS,
                mean,
                color=COLOURS[index],
                marker=MARKERS[index],
                markersize=4,
                label=METHODS[method_key(row)],
            )
            axes.fill_between(
                DEVIATIONS, mean - spread, mean + spread, color=COLOURS[index], alpha=0.18, linewidth=0
            )
    upper.axhline(UNIFORM, color=GREY, linestyle=":", label="uniform density")
    upper.set_ylim(CUT, None)
    lower.set_ylim(lowest - 1.5, CUT)
    mark_axis_break(upper, lower)
    seeds = sorted({int(str(row["seed"])) for row in rows})
    several = (
        f"mean of {len(seeds)} seeds, band: standard deviation" if len(seeds) > 1 else "one seed, so no band"
    )
    upper.set_title(f"{several}; the axis is compressed below {CUT:g}".replace("-", "−"), fontsize=9)
    lower.set_xlabel(f"standard deviation σ of the Gaussian blur (1/{SIDE} of the width of an image)")
    figure.supylabel("mean log-likelihood of the pan angle (nats)", fontsize=10)
    upper.legend(fontsize=9, frameon=False)
    save_figure(figure, path.with_suffix(""), True)


def mark_axis_break(upper: Axes, lower: Axes) -> None:
    """Mark where the scale of the vertical axis changes between two panels."""
    for axes, edge, height in ((upper, "bottom", 0), (lower, "top", 1)):
        axes.spines[edge].set_visible(False)
        mark = {
            "marker": [(-1, -0.6), (1, 0.6)],
            "markersize": 10,
            "color": "black",
            "linestyle": "",
            "clip_on": False,
        }
        axes.plot([0, 1], [height, height], transform=axes.transAxes, **mark)
        axes.grid(alpha=0.3)
    upper.tick_params(bottom=False)


@torch.no_grad()
def draw_strip(
    models: dict[str, Predictor], image: torch.Tensor, pan: float, path: Path, synthetic: bool
) -> None:
    deviations = DEVIATIONS[::2]
    figure = titled_figure(
        (2.1 * len(deviations), 4.8), "Densities of the pan angle of one head under blur, IDIAP", synthetic
    )
    grid = figure.subplots(2, len(deviations), height_ratios=(1, 1.2))
    for column, deviation in enumerate(deviations):
        blurred = blur_images(image, deviation)
        grid[0, column].imshow(to_rgb8(blurred))
        grid[0, column].set_axis_off()
        grid[0, column].set_title(f"blur of {deviation:g} px")
        axes = grid[1, column]
        for name, model in models.items():
            torch.manual_seed(0)
            angles, log_density = circular_grid(marginal(model(blurred[None]), 0))
            colour = COLOURS[list(METHODS).index(name)]
            axes.plot(
                angles.rad2deg(), log_density[:, 0].exp(), color=colour, label=METHODS[name], linewidth=1.2
            )
        axes.axvline(math.degrees(pan), color="black", linestyle=":", linewidth=1, label="true pan angle")
        axes.set_xticks((-180, -90, 0, 90, 180))
        axes.set_xlabel("pan angle (°)")
    # the panel without blur has an axis of its own, because its densities are several times as high
    for axes in grid[1, 2:]:
        axes.sharey(grid[1, 1])
        axes.tick_params(labelleft=False)
    grid[1, 0].set_ylabel("density (1 / rad)")
    handles, labels = grid[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    save_figure(figure, path.with_suffix(""), True)


def main(sweeps: list[Path], root: str | None) -> None:
    rows, models = [], {}
    fields: dict[str, torch.Tensor] = {}
    for run in read_runs(*sweeps):
        if list(run.config()["data"]["angles"]) != ["pan"]:
            continue
        row = run.results
        model, description = load_with_description(run.folder)
        if not fields:
            real = {} if root is None else {"root": root}
            data = build("data", description.config["data"] | real)
            data.prepare()
            batch = data.splits().test.__getitems__(range(min(IMAGES, len(data.splits().test))))
            fields = {"input": batch["input"], "target": batch["target"]}
        likelihoods = log_likelihoods(model, fields["input"], fields["target"][:, :1])
        rows.append(
            {"method": row["method"], "seed": row["seed"], "synthetic": row["synthetic"], **likelihoods}
        )
        if row["seed"] == 0:
            models[method_key(row)] = model
    label = "synthetic IDIAP" if rows[0]["synthetic"] else "IDIAP"
    write_csv(rows, {"method": "method", "seed": "seed", **COLUMNS}, HERE.with_suffix(".csv"))
    draw_curves(rows, HERE.with_suffix(".png"))
    # the head whose pan angle is closest to 50°, a half profile, shows the effect of blur gradually
    index = int((fields["target"][:, 0].abs() - math.radians(50)).abs().argmin())
    chosen = {name: models[name] for name in METHODS if name in models}
    draw_strip(
        chosen,
        fields["input"][index],
        fields["target"][index, 0].item(),
        HERE.with_name("blur_strip.png"),
        bool(rows[0]["synthetic"]),
    )
    named = [{**row, "method": METHODS[method_key(row)]} for row in aggregate_seeds(rows)]
    text = (
        f"# Log-likelihood of the pan under Gaussian blur: {label}\n\n"
        "This page measures how the log-likelihood of the pan angle of a head falls when the test images are blurred. "
        "The models are trained without blur. "
        "The methods are von Mises densities with a fixed or a predicted concentration, a finite mixture of them, "
        "and conditional variational autoencoders (CVAE, and sCVAE in simplified form).\n\n"
        f"A number in the table is the mean log-likelihood of the true pan angle over {len(fields['target'])} test "
        f"images, in nats. ± is the standard deviation over seeds. σ is the standard deviation of the Gaussian blur, "
        f"in units of 1/{SIDE} of the width of an image; the test images are {fields['input'].shape[-1]} pixels wide. "
        f"A uniform density has a log-likelihood of {UNIFORM:.2f}. The text at the top of `blur.py` lists the commands "
        "that train the models. The figure `blur.png` shows the same numbers, as in thesis Figure 3.7, and "
        "`blur_strip.png` shows the densities that are predicted for one of the images, as in Figure 3.8; its unit px "
        "is that of σ.\n\n"
        f"{markdown(named, COLUMNS)}\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(HERE, text)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("sweeps", nargs="*", type=Path)
    arguments.add_argument(
        "--root", help="folder of the real data set, if the runs were trained on generated images"
    )
    arguments.add_argument("--draw", action="store_true", help="draw blur.png again from blur.csv")
    options = arguments.parse_args()
    if options.draw:
        draw_curves(read_rows(HERE.with_suffix(".csv")), HERE.with_suffix(".png"))
    else:
        main(options.sweeps, options.root)
