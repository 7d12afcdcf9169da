"""Measure what a density gains by knowing the noise, period and resolution of its target.

    python -m reproduction.chapter2.targets

Trains four heads with five seeds each on a table made here (thesis §2.3.1, §2.5, §3.2), some minutes on two cores; what
has run in outputs/sweeps/targets does not run again. Writes targets.md beside this file.
"""

import csv
import math
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import framework
from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, write_page
from framework.distributions.class_probabilities import class_probabilities
from framework.reports.table import aggregate, markdown

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/sweeps/targets"
ROWS, SEEDS, BINS = 3000, 5, 12
SEAM = 10.0
"""Degrees on either side of ±180°."""
COMMON = (
    *("data=tabular", f"data.path={FOLDER / 'table.csv'}", "encoder=[mlp]", "encoder.mlp.widths=[64,64]"),
    *("metric=[log_likelihood]", "trainer.max_epochs=30", "pictures=false", "logger=none", "threads=1"),
    *("optimizer.learning_rate=3e-3", f"seed={','.join(map(str, range(SEEDS)))}"),
)
HEADS = {
    "noise": ("data.columns=[t]", "data.target=z", "data.kind=real", "density_head=gaussian"),
    "von Mises": ("data.columns=[c,s]", "data.target=a", "data.kind=degrees", "density_head=von_mises"),
    "Gaussian": ("data.columns=[c,s]", "data.target=a", "data.kind=real", "density_head=gaussian"),
    f"{BINS} classes": (
        *("data.columns=[c,s]", "data.target=bin", "data.kind=class", "density_head=categorical"),
    ),
}


def spread(t: np.ndarray) -> np.ndarray:
    """The standard deviation of z, from 0.05 to 0.5."""
    return 0.05 + 0.225 * (t + 1)


def heading(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles in degrees from -180, and a noisy point of the circle at each."""
    draw = np.random.default_rng(seed)
    angle = draw.uniform(-180, 180, count)
    radians = np.radians(angle)
    return angle, np.stack([np.cos(radians), np.sin(radians)], 1) + draw.normal(0, 0.05, (count, 2))


def bins(angle: np.ndarray) -> np.ndarray:
    return ((angle + 180) * BINS // 360).astype(int)


def write_table() -> None:
    draw = np.random.default_rng(0)
    t = draw.uniform(-1, 1, ROWS)
    z = np.sin(3 * t) + spread(t) * draw.normal(size=ROWS)
    angle, point = heading(ROWS, 1)
    FOLDER.mkdir(parents=True, exist_ok=True)
    with (FOLDER / "table.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "z", "c", "s", "a", "bin"])
        names = [f"bin {number:02}" for number in bins(angle)]
        writer.writerows(zip(t, z, *point.T, angle, names, strict=True))


def sweep(name: str) -> Path:
    """Of all seeds, in their order."""
    folder = FOLDER / name.replace(" ", "_")
    command = [sys.executable, "-m", "framework", "-m", *COMMON, *HEADS[name]]
    carry_out([*command, "hydra.launcher.jobs=2", f"hydra.sweep.dir={folder}"])
    return folder


def away(found: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Around the circle, degrees."""
    return np.abs((found - angle + 180) % 360 - 180)


def answered(name: str, folder: Path, point: np.ndarray) -> np.ndarray:
    """A model's angles, degrees."""
    model = framework.load(folder)
    with torch.inference_mode():
        density = model(torch.tensor(point, dtype=torch.float32))
    if name == "von Mises":
        return np.degrees(mode_of(density).numpy())
    if name == "Gaussian":
        return mode_of(density).numpy()
    likeliest = class_probabilities(density).argmax(-1).numpy()  # classes are in the order of their names
    return (likeliest + 0.5) * 360 / BINS - 180


def mode_of(density: torch.distributions.Distribution) -> Tensor:
    mode: Tensor = density.mode
    return mode[..., 0]


def main() -> None:
    torch.set_num_threads(1)
    write_table()
    angle, point = heading(20_000, 2)
    seam = np.abs(angle) > 180 - SEAM
    rows: list[dict[str, object]] = []
    for name in list(HEADS)[1:]:
        folder = sweep(name)
        for seed in range(SEEDS):
            error = away(answered(name, folder / str(seed), point), angle)
            rows.append(
                {"method": name, "seed": seed, "synthetic": True, "seam": error[seam].mean()}
                | {"elsewhere": error[~seam].mean(), "median": np.median(error)}
            )
    t = np.linspace(-0.95, 0.95, 200)
    folder = sweep("noise")
    slopes, errors = [], []
    for seed in range(SEEDS):
        with torch.inference_mode():
            density = framework.load(folder / str(seed))(torch.tensor(t[:, None], dtype=torch.float32))
        told = np.log(density.stddev[..., 0].numpy())
        slopes.append(np.polyfit(np.log(spread(t)), told, 1)[0])
        errors.append(np.abs(told - np.log(spread(t))).mean())
    columns = {
        "method": "head",
        "seam": f"mean error within {SEAM:g}° of ±180°, °",
        "elsewhere": "elsewhere, °",
        "median": "median error, °",
        "n": "seeds",
    }
    best = np.degrees(math.sqrt(2 / math.pi) * 0.05)
    text = (
        "# What a density gains by knowing its target's noise, period and resolution (synthetic data)\n\n"
        f"`python -m reproduction.chapter2.targets`: {ROWS} rows made by it, {SEEDS} seeds of weights, two layers of "
        "64, 30 epochs. ± is the standard deviation over seeds.\n\n"
        f"**Period** (§2.5) and **resolution** (§3.2). The angle of a point near the unit circle (noise 0.05 along "
        f"each axis, hence {best:.1f}° of mean error at best) from -180° to 180°: by a von Mises density, by a "
        f"Gaussian of the number of degrees, by {BINS} classes of {360 // BINS}°, whose middle is taken. 20,000 "
        "new points.\n\n"
        f"{markdown(aggregate(rows, by=['method']), columns)}\n\n"
        "**Noise** (§2.3.1, eq. 2.8). z = sin 3t with a standard deviation that grows from 0.05 to 0.5 with t; a "
        f"Gaussian head predicts it. The slope of its logarithm against the true one's is {np.mean(slopes):.3f} ± "
        f"{np.std(slopes, ddof=1):.3f} (1 is right, 0 would be one noise for all inputs), the mean difference of "
        f"logarithms {np.mean(errors):.3f} ± {np.std(errors, ddof=1):.3f}.\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
