"""Measure each method's log-likelihood of the pan angle under blur (thesis Figures 3.7 and 3.8).

    python -m reproduction.thesis_tables 3.7-3.8 [--seeds 3]
    python -m reproduction.chapter3.blur <sweeps of idiap experiments> [--root <the real set>]
    python -m reproduction.chapter3.blur --draw

Every trained model of the pan alone sees its own test split under Gaussian blurs. Writes blur.md, blur.csv, blur.png
(the curves) and blur_strip.png (one head's densities) beside this file; `--draw` draws blur.png again from blur.csv.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np
import torch
import yaml
from matplotlib.axes import Axes

from benchmarks.pages import machine, read_rows, write_page
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
"""The experiments, and what the figures call them."""
UNIFORM = -math.log(2 * math.pi)
CUT = -3.0
"""Nats: below, the axis of the curves is compressed."""
DEVIATIONS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Of the Gaussian, in pixels of a crop of SIDE; images of another size are blurred by the same share of theirs."""
SIDE = 75
IMAGES = 1000
COLUMNS = {"method": "method", "n": "seeds"} | {f"blur_{d:g}": f"σ = {d:g}" for d in DEVIATIONS}


def seen(images: torch.Tensor, deviation: float) -> torch.Tensor:
    return blur(images, deviation * images.shape[-1] / SIDE)


@torch.no_grad()
def log_likelihoods(model: Predictor, images: torch.Tensor, pan: torch.Tensor) -> dict[str, float]:
    """Mean log-likelihood of the pan, nats, under every blur."""
    found = {}
    for deviation in DEVIATIONS:
        torch.manual_seed(0)
        parts = [
            marginal(model(seen(some, deviation)), 0).log_prob(angle)
            for some, angle in zip(images.split(100), pan.split(100), strict=True)
        ]
        found[f"blur_{deviation:g}"] = torch.cat(parts).double().mean().item()
    return found


def method(row: dict[str, object]) -> str:
    """The name of the row's experiment in its folder."""
    return str(row["method"]).rpartition("/")[2]


def compared(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Means and standard deviations over seeds, in the order of METHODS."""
    return sorted(aggregate(rows, by=["method"]), key=lambda row: list(METHODS).index(method(row)))


def curves(rows: list[dict[str, object]], path: Path) -> None:
    """The upper panel shows what separates the methods, the lower how far those fall that are sure of themselves."""
    figure = titled_figure(
        (7.5, 6), "Log-likelihood of the pan angle under blur, IDIAP", bool(rows[0]["synthetic"])
    )
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
    lowest = CUT
    for row in compared(rows):
        place = list(METHODS).index(method(row))
        mean, spread = (
            np.array([row.get(f"blur_{d:g}{suffix}", math.nan) for d in DEVIATIONS], dtype=float)
            for suffix in ("", "_std")
        )
        lowest = min(lowest, np.nanmin([mean, mean - spread]))
        for axes in (upper, lower):
            axes.plot(
                DEVIATIONS,
                mean,
                color=COLOURS[place],
                marker=MARKERS[place],
                markersize=4,
                label=METHODS[method(row)],
            )
            axes.fill_between(
                DEVIATIONS, mean - spread, mean + spread, color=COLOURS[place], alpha=0.18, linewidth=0
            )
    upper.axhline(UNIFORM, color=GREY, linestyle=":", label="uniform density")
    upper.set_ylim(CUT, None)
    lower.set_ylim(lowest - 1.5, CUT)
    broken(upper, lower)
    seeds = sorted({int(str(row["seed"])) for row in rows})
    several = (
        f"mean of {len(seeds)} seeds, band: standard deviation" if len(seeds) > 1 else "one seed, so no band"
    )
    upper.set_title(f"{several}; the axis is compressed below {CUT:g}".replace("-", "−"), fontsize=9)
    lower.set_xlabel(f"standard deviation of the Gaussian blur (pixels of {SIDE})")
    figure.supylabel("mean log-likelihood of the pan angle (nats)", fontsize=10)
    upper.legend(fontsize=9, frameon=False)
    save_figure(figure, path.with_suffix(""), True)


def broken(upper: Axes, lower: Axes) -> None:
    """Marks where the scale of the vertical axis changes between two panels."""
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
def strip(models: dict[str, Predictor], image: torch.Tensor, pan: float, path: Path, synthetic: bool) -> None:
    shown = DEVIATIONS[::2]
    figure = titled_figure(
        (2.1 * len(shown), 4.8), "Densities of the pan angle of one head under blur, IDIAP", synthetic
    )
    grid = figure.subplots(2, len(shown), height_ratios=(1, 1.2))
    for column, deviation in enumerate(shown):
        one = seen(image, deviation)
        grid[0, column].imshow(to_rgb8(one))
        grid[0, column].set_axis_off()
        grid[0, column].set_title(f"blur of {deviation:g} px")
        axes = grid[1, column]
        for name, model in models.items():
            torch.manual_seed(0)
            angles, log_density = circular_grid(marginal(model(one[None]), 0))
            colour = COLOURS[list(METHODS).index(name)]
            axes.plot(
                angles.rad2deg(), log_density[:, 0].exp(), color=colour, label=METHODS[name], linewidth=1.2
            )
        axes.axvline(math.degrees(pan), color="black", linestyle=":", linewidth=1, label="true pan angle")
        axes.set_xticks((-180, -90, 0, 90, 180))
        axes.set_xlabel("pan angle (°)")
    # without blur densities are several times as high
    for axes in grid[1, 2:]:
        axes.sharey(grid[1, 1])
        axes.tick_params(labelleft=False)
    grid[1, 0].set_ylabel("density (1 / rad)")
    handles, labels = grid[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    save_figure(figure, path.with_suffix(""), True)


def pans(sweeps: list[Path]) -> list[Path]:
    """Results of the runs that predict the pan alone."""
    found = []
    for path in (path for sweep in sweeps for path in sorted(sweep.glob("*/results.json"))):
        angles = yaml.safe_load((path.parent / "config.yaml").read_text(encoding="utf-8"))["data"]["angles"]
        if list(angles) == ["pan"]:
            found.append(path)
    return found


def main(sweeps: list[Path], root: str | None) -> None:
    rows, first = [], {}
    fields: dict[str, torch.Tensor] = {}
    for result in pans(sweeps):
        row = json.loads(result.read_text(encoding="utf-8"))
        model, description = load_with_description(result.parent)
        if not fields:
            real = {} if root is None else {"root": root}
            data = build("data", description.config["data"] | real)
            data.prepare()
            batch = data.splits().test.__getitems__(range(min(IMAGES, len(data.splits().test))))
            fields = {"input": batch["input"], "target": batch["target"]}
        found = log_likelihoods(model, fields["input"], fields["target"][:, :1])
        rows.append({"method": row["method"], "seed": row["seed"], "synthetic": row["synthetic"], **found})
        if row["seed"] == 0:
            first[method(row)] = model
    label = "synthetic IDIAP" if rows[0]["synthetic"] else "IDIAP"
    write_csv(rows, {"method": "method", "seed": "seed", **COLUMNS}, HERE.with_suffix(".csv"))
    curves(rows, HERE.with_suffix(".png"))
    # a head in half profile, which blur makes doubtful step by step
    index = int((fields["target"][:, 0].abs() - math.radians(50)).abs().argmin())
    chosen = {name: first[name] for name in METHODS if name in first}
    strip(
        chosen,
        fields["input"][index],
        fields["target"][index, 0].item(),
        HERE.with_name("blur_strip.png"),
        bool(rows[0]["synthetic"]),
    )
    named = [{**row, "method": METHODS[method(row)]} for row in compared(rows)]
    text = (
        f"# Log-likelihood of the pan under Gaussian blur: {label}\n\n"
        f"Nats, {len(fields['target'])} test images of {fields['input'].shape[-1]} pixels, models trained "
        f"without blur; σ is the Gaussian's in pixels of an image of {SIDE}; ± is the standard "
        f"deviation over seeds. The uniform density has {UNIFORM:.2f}. Commands in `blur.py`, figures "
        f"`blur.png` (Figure 3.7) and `blur_strip.png` (Figure 3.8).\n\n{markdown(named, COLUMNS)}\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("sweeps", nargs="*", type=Path)
    arguments.add_argument("--root", help="the real data set, where runs were trained on a generated one")
    arguments.add_argument("--draw", action="store_true", help="draw blur.png again from blur.csv")
    given = arguments.parse_args()
    if given.draw:
        curves(read_rows(HERE.with_suffix(".csv")), HERE.with_suffix(".png"))
    else:
        main(given.sweeps, given.root)
