"""Measure the quality of a person's image against its run time: meshes with several samples, and trained networks.

    python -m reproduction.chapter7.smplpix_work_precision <run> …

With runs of smplpix/quick, hybrid or their like, all on the same data; writes smplpix_work_precision.md, .csv
and .png beside this file. `--draw` draws the figure again from the table.
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import machine, read_rows, write_page
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
from reproduction.chapter7.smplpix_table import Judged, by_subject, described, examined

HERE = Path(__file__).resolve()
TOPOLOGIES = ("7k", "27k")
SAMPLES = (1, 2, 3, 4)
"""Of a pixel along each axis."""
SHOWN = {
    "psnr_db": "PSNR of the frame (dB)",
    "ssim_masked": "SSIM about the subject",
    "features": "distance in random features",
}
BETTER: Mapping[str, Any] = {"psnr_db": "higher", "ssim_masked": "higher", "features": "lower"}


def prepared(description: Description, topology: str) -> Data:
    part = {**description.config["data"], "topology": topology}
    data: Data = build("data", resolve("data", part))
    data.prepare()
    return data


def meshes(description: Description) -> Iterator[tuple[str, int, Predictor, Data]]:
    """The registered mesh, with its vertices' colours and with textures: name, samples, predictor and data."""
    for topology, painted in product(TOPOLOGIES, ("vertex colours", "texture")):
        data = prepared(description, topology)
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
            made = build_predictor(resolved, data.target, data.input_shape, 0, data.columns).eval()
            yield f"mesh {topology}, {painted}", samples, made, data


def networks(run: str) -> Iterator[tuple[str, Predictor, Data]]:
    """A run with float32 and bfloat16, its box alone and whole frames."""
    description, state = read_stored(run)
    data = prepared(description, description.config["data"]["topology"])
    first = f"{description.method} {description.config['data']['topology']}"
    for precision, crop in product(("float32", "bfloat16"), ("box", "frame")):
        description, state = read_stored(run)
        for part in description.config["encoder"]:
            if "precision" in part:
                part["precision"] = precision
                part["crop"] = None if crop == "frame" else part["crop"]
        yield f"{first}, {precision}, {crop}", rebuild(description, state), data


def feature_distance(predictor: Predictor, data: Data) -> float:
    """Mean over the test images of the objective `random_features`, whose network knows nothing about images."""
    objective = build("objective", resolve("objective", {"name": "random_features", "cache": 0}))
    total, count = 0.0, 0
    with torch.no_grad():
        for batch in Batches(data, batch_size=8, workers=0, seed=0).test_dataloader():
            total += float(objective(predictor, batch)) * len(batch["input"])
            count += len(batch["input"])
    return total / max(1, count)


def row(found: Judged, distance: float) -> dict[str, Any]:
    numbers: dict[str, Any] = {"features": distance, "milliseconds_per_sample": found.drawing + found.network}
    for key in ("psnr_db", "psnr_masked_db", "ssim", "ssim_masked"):
        each = by_subject(found.numbers[key], found.subjects)
        numbers |= {key: float(each.mean()), f"{key}_sem": float(each.std(ddof=1) / math.sqrt(len(each)))}
    return numbers | {"drawing": found.drawing, "network": found.network}


def line(method: str, one: Mapping[str, Any]) -> str:
    samples = str(one["value"]) if "value" in one else "–"
    return (
        f"| {method} | {samples} | {one['psnr_db']:.2f} | {one['psnr_masked_db']:.2f} | {one['ssim']:.4f} | "
        f"{one['ssim_masked']:.3f} | {one['features']:.4f} | {one['drawing']:.1f} | {one['network']:.1f} |"
    )


def main(runs: list[str]) -> None:
    if not runs:
        sys.exit("No run was given; wanted folders of trained runs of smplpix/quick or its like.")
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    description, _ = read_stored(runs[0])
    about = ""
    for method, samples, predictor, data in meshes(description):
        numbers = row(examined(predictor, data, None), feature_distance(predictor, data))
        rows.append({"method": method, "knob": "samples", "value": samples, **numbers})
        about = described(data)
        sys.stdout.write(line(method, rows[-1]) + "\n")
    for run in runs:
        for method, predictor, data in networks(run):
            if described(data) != about:
                sys.exit(f"{run} has other data: {described(data)} The meshes: {about}")
            rows.append(
                {"method": method, **row(examined(predictor, data, None), feature_distance(predictor, data))}
            )
            sys.stdout.write(line(method, rows[-1]) + "\n")
    write_csv([{**one, "synthetic": True} for one in rows], None, HERE.with_suffix(".csv"))
    drawn(rows)
    text = [
        "# Quality of an image against its run time (synthetic people)",
        "",
        f"{about} Means over subjects. Milliseconds of processor time, one image alone on one thread: of drawing the "
        "mesh or projecting its vertices, and of the network. Networks compute the subject's box or the whole frame. "
        "The distance in random features is that of an untrained network (objective `random_features`), not LPIPS, "
        "whose weights are not available.",
        "",
        "| | samples | PSNR, dB | inside | SSIM | inside | random features | drawing, ms | network, ms |",
        f"|---|{'---:|' * 8}",
        *(line(one["method"], one) for one in rows),
        "",
        f"![Quality against milliseconds]({HERE.with_suffix('.png').name})",
        "",
        f"{machine('torch', 'numpy')} Command: `python -m reproduction.chapter7.smplpix_work_precision <runs>`; runs: "
        f"{'; '.join(trained(run) for run in runs)}.",
        "",
    ]
    write_page(HERE, text)


def drawn(rows: Sequence[Row]) -> None:
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


def trained(run: str) -> str:
    """What a run was, in a few words."""
    description, _ = read_stored(run)
    settings = description.settings
    return f"{description.method}, seed {settings.get('seed', '?')}"


if __name__ == "__main__":
    if sys.argv[1:] == ["--draw"]:
        drawn(read_rows(HERE.with_suffix(".csv")))
    else:
        main(sys.argv[1:])
