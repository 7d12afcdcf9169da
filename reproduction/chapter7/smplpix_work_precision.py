"""Measure the quality of a person's image against its run time, for meshes with several samples per pixel and networks.

    python -m reproduction.chapter7.smplpix_work_precision <run> …

The runs are of smplpix/quick, smplpix/hybrid or similar experiments, all on the same data. The script writes
smplpix_work_precision.md, .csv and .png beside this file. `--draw` draws the figure again from the table.
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import machine, read_rows, run_or_draw, write_page
from framework.configuration.assembly import build_predictor
from framework.configuration.description import Description
from framework.configuration.loading import read_stored, rebuild
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.figures.style import save_figure
from framework.model import Predictor
from framework.reports.table import Row, write_csv
from framework.reports.tradeoff_picture import error_against_run_time
from framework.training.batches import Batches
from reproduction.chapter7.smplpix_table import Evaluation, by_subject, describe_data, evaluate_images

HERE = Path(__file__).resolve()
TOPOLOGIES = ("7k", "27k")
SAMPLES = (1, 2, 3, 4)
"""Samples per pixel along each axis."""
SHOWN = {
    "psnr_db": "PSNR of the frame (dB)",
    "ssim_masked": "SSIM about the subject",
    "features": "distance in random features",
}
BETTER: Mapping[str, Any] = {"psnr_db": "higher", "ssim_masked": "higher", "features": "lower"}


def prepare_data(description: Description, topology: str) -> Data:
    part = {**description.config["data"], "topology": topology}
    data: Data = build("data", resolve("data", part))
    data.prepare()
    return data


def meshes(description: Description) -> Iterator[tuple[str, int, Predictor, Data]]:
    """Yield name, samples, predictor and data of the registered mesh, with vertex colours and with textures."""
    for topology, painted in product(TOPOLOGIES, ("vertex colours", "texture")):
        data = prepare_data(description, topology)
        part = description.config["data"]
        height, width = data.target.size
        for samples in SAMPLES:
            encoder = {
                "name": "rasterised",
                "height": height,
                "width": width,
                "topology": topology,
                "root": part["root"],
                "body": part["body"],
                "renderer": {"name": "rasterizer", "supersampling": samples},
                "textures": part if painted == "texture" else None,
            }
            resolved = {
                "encoder": [resolve("encoder", encoder)],
                "density_head": resolve("density_head", "laplace_image"),
                "uncertainty": [],
            }
            predictor = build_predictor(resolved, data.target, data.input_shape, 0, data.columns).eval()
            yield f"mesh {topology}, {painted}", samples, predictor, data


def networks(run: str) -> Iterator[tuple[str, Predictor, Data]]:
    """Yield name, predictor and data for four settings of a run's network.

    The settings are float32 and bfloat16, each for the subject's box alone and for the whole image.
    """
    description, state = read_stored(run)
    data = prepare_data(description, description.config["data"]["topology"])
    name = f"{description.method} {description.config['data']['topology']}"
    for precision, crop in product(("float32", "bfloat16"), ("box", "frame")):
        description, state = read_stored(run)
        for part in description.config["encoder"]:
            if "precision" in part:
                part["precision"] = precision
                part["crop"] = None if crop == "frame" else part["crop"]
        yield f"{name}, {precision}, {crop}", rebuild(description, state), data


def feature_distance(predictor: Predictor, data: Data) -> float:
    """Return the mean of the objective `random_features` over the test images; its network is untrained."""
    objective = build("objective", resolve("objective", {"name": "random_features", "cache": 0}))
    total, count = 0.0, 0
    with torch.no_grad():
        for batch in Batches(data, batch_size=8, workers=0, seed=0).test_dataloader():
            total += float(objective(predictor, batch)) * len(batch["input"])
            count += len(batch["input"])
    return total / max(1, count)


def numbers_of(evaluation: Evaluation, distance: float) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "features": distance,
        "milliseconds_per_sample": evaluation.drawing + evaluation.network,
    }
    for key in ("psnr_db", "psnr_masked_db", "ssim", "ssim_masked"):
        subject_means = by_subject(evaluation.numbers[key], evaluation.subjects)
        numbers |= {
            key: float(subject_means.mean()),
            f"{key}_sem": float(subject_means.std(ddof=1) / math.sqrt(len(subject_means))),
        }
    return numbers | {"drawing": evaluation.drawing, "network": evaluation.network}


def table_line(method: str, row: Mapping[str, Any]) -> str:
    samples = str(row["value"]) if "value" in row else "–"
    return (
        f"| {method} | {samples} | {row['psnr_db']:.2f} | {row['psnr_masked_db']:.2f} | {row['ssim']:.4f} | "
        f"{row['ssim_masked']:.3f} | {row['features']:.4f} | {row['drawing']:.1f} | {row['network']:.1f} |"
    )


def main(runs: list[str]) -> None:
    if not runs:
        sys.exit("No run was given. Give the folders of trained runs of smplpix/quick or smplpix/hybrid.")
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    description, _ = read_stored(runs[0])
    about = ""
    for method, samples, predictor, data in meshes(description):
        numbers = numbers_of(evaluate_images(predictor, data, None), feature_distance(predictor, data))
        rows.append({"method": method, "knob": "samples", "value": samples, **numbers})
        about = describe_data(data)
        sys.stdout.write(table_line(method, rows[-1]) + "\n")
    for run in runs:
        for method, predictor, data in networks(run):
            if describe_data(data) != about:
                sys.exit(
                    f"{run} has other data than the meshes. The run: {describe_data(data)} The meshes: {about} Give "
                    "runs on the same data."
                )
            rows.append(
                {
                    "method": method,
                    **numbers_of(evaluate_images(predictor, data, None), feature_distance(predictor, data)),
                }
            )
            sys.stdout.write(table_line(method, rows[-1]) + "\n")
    write_csv([{**row, "synthetic": True} for row in rows], None, HERE.with_suffix(".csv"))
    draw_figure(rows)
    text = [
        "# Quality of an image against its run time (synthetic people)",
        "",
        "This page shows how the quality of an image of an unseen person depends on its run time. Meshes are drawn "
        "with one to four samples per pixel along each axis, and the network that improves a drawn mesh (`hybrid`) "
        "computes in float32 or bfloat16. The quality is measured against photographs as a mean over subjects. "
        f"{about} The terms in the table mean:",
        "- **Samples** is the number of samples per pixel along each axis with which a mesh is drawn.",
        "- **Inside** means that only the pixels of the subject count; the other columns are over the whole frame.",
        "- **Distance in random features** is the distance between the features of the drawn image and of the "
        "photograph in an untrained network (objective `random_features`); lower is better. It replaces LPIPS, whose "
        "weights are not available.",
        "- **Drawing** is the processor time in milliseconds to draw the mesh or to project its vertices, **network** "
        "that of the network, for one image on one thread.",
        "- `box` networks compute only the bounding box of the subject, `frame` networks the whole image.",
        "",
        "| method | samples | PSNR, dB | PSNR inside, dB | SSIM | SSIM inside | distance in random features | drawing, "
        "ms | network, ms |",
        f"|---|{'---:|' * 8}",
        *(table_line(row["method"], row) for row in rows),
        "",
        f"![Quality against milliseconds]({HERE.with_suffix('.png').name})",
        "",
        f"{machine('torch', 'numpy')} Command: `python -m reproduction.chapter7.smplpix_work_precision <runs>`; runs: "
        f"{'; '.join(describe_run(run) for run in runs)}.",
        "",
    ]
    write_page(HERE, text)


def draw_figure(rows: Sequence[Row]) -> None:
    figure = error_against_run_time(
        rows,
        SHOWN,
        BETTER,
        title="Images of unseen people against the time of one image",
        synthetic=True,
        machine="one core, processor time",
        note="Bars: standard error over subjects. Numbers beside points: samples of a pixel along each axis.",
    )
    save_figure(figure, HERE.with_suffix(""), True)


def describe_run(run: str) -> str:
    """Return the method and the seed of a run."""
    description, _ = read_stored(run)
    settings = description.settings
    return f"{description.method}, seed {settings.get('seed', '?')}"


if __name__ == "__main__":
    run_or_draw(lambda: main(sys.argv[1:]), lambda: draw_figure(read_rows(HERE.with_suffix(".csv"))))
