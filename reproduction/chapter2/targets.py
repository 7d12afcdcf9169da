"""Measure what a density gains by knowing the noise, period and resolution of its target.

    python -m reproduction.chapter2.targets

The script trains four density heads with five seeds each on generated samples (thesis §2.3.1, §2.5, §3.2), which takes
some minutes on two cores. Runs that are complete in outputs/sweeps/targets are not repeated. The script writes
targets.md beside this file.
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
from benchmarks.pages import machine, publish
from framework.distributions.class_probabilities import class_probabilities
from framework.reports.table import aggregate, markdown

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/sweeps/targets"
ROWS, SEEDS, BINS = 3000, 5, 12
SEAM = 10.0
"""Half width, degrees, of the region around ±180° for which the error is also reported separately."""
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


def noise_deviation(t: np.ndarray) -> np.ndarray:
    """Return the standard deviation of z, from 0.05 at t = -1 to 0.5 at t = 1."""
    return 0.05 + 0.225 * (t + 1)


def generate_angles(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return angles in [-180°, 180°), shape (count,), and a noisy point of the unit circle at each, (count, 2)."""
    draw = np.random.default_rng(seed)
    angle = draw.uniform(-180, 180, count)
    radians = np.radians(angle)
    return angle, np.stack([np.cos(radians), np.sin(radians)], 1) + draw.normal(0, 0.05, (count, 2))


def class_numbers(angle: np.ndarray) -> np.ndarray:
    return ((angle + 180) * BINS // 360).astype(int)


def write_table() -> None:
    draw = np.random.default_rng(0)
    t = draw.uniform(-1, 1, ROWS)
    z = np.sin(3 * t) + noise_deviation(t) * draw.normal(size=ROWS)
    angle, point = generate_angles(ROWS, 1)
    FOLDER.mkdir(parents=True, exist_ok=True)
    with (FOLDER / "table.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "z", "c", "s", "a", "bin"])
        names = [f"bin {number:02}" for number in class_numbers(angle)]
        writer.writerows(zip(t, z, *point.T, angle, names, strict=True))


def run_sweep(name: str) -> Path:
    """Train a density head with all seeds and return the folder of the sweep."""
    folder = FOLDER / name.replace(" ", "_")
    command = [sys.executable, "-m", "framework", "-m", *COMMON, *HEADS[name]]
    carry_out([*command, "hydra.launcher.jobs=2", f"hydra.sweep.dir={folder}"])
    return folder


def angular_error(predicted: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the absolute difference of angles around the circle, in degrees."""
    return np.abs((predicted - angle + 180) % 360 - 180)


def predict_angles(name: str, folder: Path, point: np.ndarray) -> np.ndarray:
    """Return the angles in degrees that a trained model predicts for points of the plane."""
    model = framework.load(folder)
    with torch.inference_mode():
        density = model(torch.tensor(point, dtype=torch.float32))
    if name == "von Mises":
        return np.degrees(first_mode(density).numpy())
    if name == "Gaussian":
        return first_mode(density).numpy()
    likeliest = class_probabilities(density).argmax(-1).numpy()  # classes are in the order of their names
    return (likeliest + 0.5) * 360 / BINS - 180


def first_mode(density: torch.distributions.Distribution) -> Tensor:
    mode: Tensor = density.mode
    return mode[..., 0]


def main() -> None:
    torch.set_num_threads(1)
    write_table()
    angle, point = generate_angles(20_000, 2)
    seam = np.abs(angle) > 180 - SEAM
    rows: list[dict[str, object]] = []
    for name in list(HEADS)[1:]:
        folder = run_sweep(name)
        for seed in range(SEEDS):
            error = angular_error(predict_angles(name, folder / str(seed), point), angle)
            rows.append(
                {"method": name, "seed": seed, "synthetic": True, "seam": error[seam].mean()}
                | {"elsewhere": error[~seam].mean(), "median": np.median(error)}
            )
    t = np.linspace(-0.95, 0.95, 200)
    folder = run_sweep("noise")
    slopes, errors = [], []
    for seed in range(SEEDS):
        with torch.inference_mode():
            density = framework.load(folder / str(seed))(torch.tensor(t[:, None], dtype=torch.float32))
        log_deviation = np.log(density.stddev[..., 0].numpy())
        slopes.append(np.polyfit(np.log(noise_deviation(t)), log_deviation, 1)[0])
        errors.append(np.abs(log_deviation - np.log(noise_deviation(t))).mean())
    columns = {
        "method": "head",
        "seam": f"mean error within {SEAM:g}° of ±180°, °",
        "elsewhere": "mean error elsewhere, °",
        "median": "median error, °",
        "n": "seeds",
    }
    least_error = np.degrees(math.sqrt(2 / math.pi) * 0.05)
    text = (
        "# What a density gains by knowing its target's noise, period and resolution (synthetic data)\n\n"
        "This page measures what a density gains when its family fits the target. Small networks (two hidden layers of "
        f"64 units, 30 epochs) are trained on {ROWS} generated samples with {SEEDS} seeds. ± is the standard deviation "
        "over seeds. The command is `python -m reproduction.chapter2.targets`.\n\n"
        "## Period (§2.5) and resolution (§3.2)\n\n"
        "The first task is to predict an angle. The input is a noisy point near the unit circle, and the target is "
        "its angle from -180° to 180°. The noise has a standard deviation of 0.05 along each axis. Because of this "
        f"noise, no method can have a mean error below {least_error:.1f}°. Three density heads predict the angle: a "
        "von Mises density, a Gaussian of the angle as a plain number of degrees, and a categorical density over "
        f"{BINS} classes of {360 // BINS}°, whose point prediction is the centre of the likeliest class. The table "
        "shows the errors on 20,000 new points. The first column of errors is for targets within 10° of ±180°, where "
        "the number of degrees jumps from 180 to -180. The second column is for all other targets, and the median "
        "error is over all points.\n\n"
        f"{markdown(aggregate(rows, by=['method']), columns)}\n\n"
        "## Noise (§2.3.1, eq. 2.8)\n\n"
        "The second task is to predict a number z and its noise from an input t. The target is z = sin 3t plus noise "
        "whose standard deviation grows from 0.05 to 0.5 with t. A Gaussian density head predicts z from t. The "
        "logarithm of the predicted standard deviation, plotted against the logarithm of the true one, has a slope "
        f"of {np.mean(slopes):.3f} ± {np.std(slopes, ddof=1):.3f}. A slope of 1 is right; a slope of 0 would mean the "
        "same predicted noise for all inputs. The mean absolute difference of the two logarithms is "
        f"{np.mean(errors):.3f} ± {np.std(errors, ddof=1):.3f}.\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(HERE, text)


if __name__ == "__main__":
    main()
