"""What blur does to each method's log-likelihood of the pan angle (thesis Figures 3.7 and 3.8), as committed pictures.

    python -m framework -m 'data.angles=[pan]' seed=0,1,2 threads=1 hydra.sweep.dir=outputs/sweeps/blur \\
        experiment=idiap/fixed_kappa,idiap/von_mises,idiap/mixture,idiap/cvae,idiap/scvae
    python benchmarks/blur.py outputs/sweeps/blur [data.root of the real set]

Every trained model of the sweep sees its own test split under Gaussian blurs. Writes blur.md, blur.csv, blur.png (the
curves) and blur_strip.png (one head's densities) beside this file.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks.machine import machine
from framework.configuration.loading import load_with_description
from framework.configuration.schema import build
from framework.datasets.images import blurred, picture
from framework.distributions.density import circular_grid
from framework.distributions.protocol import marginal
from framework.model import Predictor
from framework.reports.table import aggregate, csv, markdown

METHODS = ("fixed_kappa", "von_mises", "mixture", "cvae", "scvae")
DEVIATIONS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Of the Gaussian, pixels of the 75-pixel crop."""
IMAGES = 1000
COLUMNS = {"method": "method", "n": "seeds"} | {f"blur_{d:g}": f"σ = {d:g}" for d in DEVIATIONS}


@torch.no_grad()
def log_likelihoods(model: Predictor, images: torch.Tensor, pan: torch.Tensor) -> dict[str, float]:
    """Mean log-likelihood of the pan, nats, under every blur."""
    found = {}
    for deviation in DEVIATIONS:
        torch.manual_seed(0)
        parts = [
            marginal(model(blurred(some, deviation)), 0).log_prob(angle)
            for some, angle in zip(images.split(100), pan.split(100), strict=True)
        ]
        found[f"blur_{deviation:g}"] = torch.cat(parts).double().mean().item()
    return found


def curves(rows: list[dict[str, object]], path: Path, label: str) -> None:
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for row in rows:
        mean = [row[f"blur_{d:g}"] for d in DEVIATIONS]
        axes.plot(DEVIATIONS, mean, marker="o", markersize=3, label=str(row["method"]).rpartition("/")[2])
        spread = np.array([row.get(f"blur_{d:g}_std", math.nan) for d in DEVIATIONS], dtype=float)
        axes.fill_between(DEVIATIONS, np.array(mean) - spread, np.array(mean) + spread, alpha=0.15)
    axes.axhline(-math.log(2 * math.pi), color="grey", linestyle=":", label="uniform density")
    axes.set_xlabel("σ of the blur (pixels of 75)")
    axes.set_ylabel("log-likelihood of the pan (nats)")
    axes.set_ylim(max(axes.get_ylim()[0], -8), None)
    axes.set_title(f"Log-likelihood under blur: {label}")
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=150)


@torch.no_grad()
def strip(models: dict[str, Predictor], image: torch.Tensor, pan: float, path: Path, label: str) -> None:
    shown = DEVIATIONS[::2]
    figure = Figure(figsize=(2.1 * len(shown), 4.4), layout="constrained")
    grid = figure.subplots(2, len(shown), height_ratios=(1, 1.2))
    for column, deviation in enumerate(shown):
        seen = blurred(image, deviation)
        grid[0, column].imshow(picture(seen))
        grid[0, column].set_axis_off()
        grid[0, column].set_title(f"σ = {deviation:g} px")
        axes = grid[1, column]
        for name, model in models.items():
            torch.manual_seed(0)
            angles, log_density = circular_grid(marginal(model(seen[None]), 0))
            axes.plot(angles.rad2deg(), log_density[:, 0].exp(), label=name, linewidth=1.2)
        axes.axvline(math.degrees(pan), color="black", linestyle=":", linewidth=1, label="true pan")
        axes.set_xticks((-180, -90, 0, 90, 180))
        axes.set_xlabel("pan °")
    for axes in grid[1, 1:]:
        axes.sharey(grid[1, 0])
        axes.tick_params(labelleft=False)
    grid[1, 0].set_ylabel("density")
    grid[1, 0].legend(fontsize="x-small")
    figure.suptitle(f"One head, ever more blurred: {label}")
    figure.savefig(path, dpi=150)


def main() -> None:
    here = Path(__file__).resolve()
    rows, first = [], {}
    fields: dict[str, torch.Tensor] = {}
    for result in sorted(Path(sys.argv[1]).glob("*/results.json")):
        row = json.loads(result.read_text(encoding="utf-8"))
        model, description = load_with_description(result.parent)
        if not fields:
            root = {"root": sys.argv[2]} if len(sys.argv) > 2 else {}
            data = build("data", description.config["data"] | root)
            data.prepare()
            batch = data.splits().test.__getitems__(range(min(IMAGES, len(data.splits().test))))
            fields = {"input": batch["input"], "target": batch["target"]}
        found = log_likelihoods(model, fields["input"], fields["target"][:, :1])
        rows.append({"method": row["method"], "seed": row["seed"], "synthetic": row["synthetic"], **found})
        name = row["method"].rpartition("/")[2]
        if row["seed"] == 0:
            first[name] = model
    compared = aggregate(rows, by=["method"])
    compared.sort(key=lambda row: METHODS.index(str(row["method"]).rpartition("/")[2]))
    label = "synthetic IDIAP" if rows[0]["synthetic"] else "IDIAP"
    csv(rows, {"method": "method", "seed": "seed", **COLUMNS}, here.with_suffix(".csv"))
    curves(compared, here.with_suffix(".png"), label)
    # a head in half profile, which blur makes doubtful step by step
    index = int((fields["target"][:, 0].abs() - math.radians(50)).abs().argmin())
    chosen = {name: first[name] for name in METHODS if name in first}
    strip(
        chosen,
        fields["input"][index],
        fields["target"][index, 0].item(),
        here.with_name("blur_strip.png"),
        label,
    )
    text = (
        f"# Log-likelihood of the pan under Gaussian blur: {label}\n\n"
        f"Nats, {len(fields['target'])} test images at 75 pixels, models trained without blur; ± is the standard "
        f"deviation over seeds. The uniform density has {-math.log(2 * math.pi):.2f}. Commands in `blur.py`, pictures "
        f"`blur.png` (Figure 3.7) and `blur_strip.png` (Figure 3.8).\n\n{markdown(compared, COLUMNS)}\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    here.with_suffix(".md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
