"""Compare the encoders unet and slim: run time, training, and errors by the crop and by bfloat16.

    python -m benchmarks.rendering.smplpix_networks [--only frames]

The script first trains the networks that outputs/smplpix_networks does not hold yet, which takes half an hour of one
core. `--only frames` writes only the section with the run time of an image. The page is written beside this file.
"""

import json
import math
import resource
import sys
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, replace_section, write_page
from benchmarks.rendering.builders import build_encoder
from benchmarks.rendering.rasterizer import figure
from benchmarks.timing import ROUNDS, Rounds, milliseconds, require_idle, time_interleaved
from framework.configuration.loading import load_with_description, reader
from framework.encoder import Encoder
from framework.geometry.camera import look_from
from framework.storage.processor import fast_bfloat16

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/smplpix_networks"
SIZES = ((410, 308), (256, 192))
DISTANCE = 2.5  # metres
FRONT = (0.4, 0.15, 0.05)
"""Azimuth, elevation and tilt of the camera, radians; at DISTANCE the body covers a quarter of the frame."""
SPLAT = 5
"""Radius of the splats, pixels, as in experiment=smplpix/quick."""
TRAININGS = {
    "unet": ("experiment=smplpix/unet", "trainer.max_epochs=1", "+trainer.limit_train_batches=120"),
    "slim": ("experiment=smplpix/quick", "trainer.max_epochs=10"),
}
"""Arguments of the training runs: half an epoch and ten epochs, about a quarter of an hour each."""
MARGINS = (0, 8, 16, 24, 32, 48, 64)
SHOWN = {"unet": 12, "slim": 96}
"""Number of test images, the first ones, on which crop and bfloat16 are compared."""
LEAST_RATIO, MOST_FLOAT32, MOST_BFLOAT16, LEAST_GAIN, MOST_BELOW = 6.0, 60.0, 20.0, 1.5, 0.3


class Trained(NamedTuple):
    """A network after its training.

    Attributes:
        encoder: the network.
        numbers: results of its run on the test split.
        points: (image, point, 6), inputs of the test split.
        minutes: processor time of the whole run.
    """

    encoder: Encoder
    numbers: dict[str, Any]
    points: Tensor
    minutes: float


def body() -> Tensor:
    """Return the points of a body, (1, points, 6), 1.7 m tall, coloured by position, in camera coordinates."""
    vertices = torch.tensor(figure()[0])
    camera = look_from(*FRONT, DISTANCE, 2 * math.atan(410 / 2 / 600), SIZES[0])
    low, high = vertices.min(0).values, vertices.max(0).values
    return torch.cat([camera.to_canonical(vertices), (vertices - low) / (high - low)], 1).float()[None]


def build_projection(size: tuple[int, int], splat: int = SPLAT) -> Encoder:
    """Return a projection to an image of a size (height, width)."""
    return build_encoder("projection", (1, 6), height=size[0], width=size[1], splat=splat)


def copy_network(network: Encoder, name: str, channels: int, size: tuple[int, int], **config: Any) -> Encoder:
    """Return a network with the same weights and other settings."""
    other = build_encoder(name, (channels, *size), residual=True, **config)
    other.load_state_dict(network.state_dict())
    return other


def measure_frames() -> tuple[list[str], dict[tuple, Rounds], list[float]]:
    """Measure the run time of an image.

    Returns:
        Table rows; times by size, network, number format and crop; share of pixels that the body covers, for each size.
    """
    lines, times_by_key, covered = [], {}, []
    for size in SIZES:
        calls: dict[tuple, tuple[Encoder, Tensor]] = {
            ("projection", splat): (build_projection(size, splat), body()) for splat in (0, SPLAT)
        }
        with torch.inference_mode():
            source = calls["projection", SPLAT][0](body())
        covered.append(float((source[0, 3] < 1).float().mean()))
        keys = list(product(("unet", "slim"), number_formats(), (None, "default")))
        for name, precision, crop in keys:
            config = {"crop": None} if crop is None else {}
            network = build_encoder(
                name, tuple(source.shape[1:]), precision=precision, residual=True, **config
            )
            calls[name, precision, crop] = network, source
        with torch.inference_mode():
            times = time_interleaved(
                {str(key): partial(call, inputs) for key, (call, inputs) in calls.items()}
            )
        times_by_key |= {(size, *key): times[str(key)] for key in calls}
        for splat in (0, SPLAT):
            splats = f"splats of {splat} pixels" if splat else "no splats"
            rounds = times_by_key[size, "projection", splat]
            lines.append(
                f"| {size[0]} × {size[1]} | projection | float32 | {splats} | {rounds.text()} | – | – | – |"
            )
        for key in keys:
            network: Any = calls[key][0]
            with torch.inference_mode(), FlopCounterMode(display=False) as counter:
                network(source)
            part = network.report.computed / math.prod(size) if network.report else 1.0
            count = sum(parameter.numel() for parameter in network.parameters())
            lines.append(
                f"| {size[0]} × {size[1]} | {key[0]} | {key[1]} | {'whole frame' if key[2] is None else 'box'} | "
                f"{times_by_key[size, *key].text()} | {counter.get_total_flops() / 1e9:.2f} | {part:.0%} | "
                f"{count / 1e6:.2f} |"
            )
    return lines, times_by_key, covered


def measure_steps() -> list[str]:
    """Return table rows with the time of a training step of four images, without the optimiser."""
    lines = []
    with torch.no_grad():
        batch = build_projection(SIZES[1])(body()).expand(4, -1, -1, -1)
    for name in ("unet", "slim"):
        network = build_encoder(name, tuple(batch.shape[1:])).train()
        repeats = 3 if name == "unet" else 10
        time_ms = milliseconds(lambda net=network: net(batch).mean().backward(), repeats, warm_up=1)
        lines.append(f"| {name} | {time_ms:.0f} |")
    return lines


def train_network(name: str) -> Trained:
    """Return a trained network; train it if its run is not stored yet."""
    folder = FOLDER / name
    clock = folder / "minutes.txt"
    if not clock.is_file():
        words = [*TRAININGS[name], "seed=0", "threads=1", "logger=none", "pictures=false"]
        words += [f"hydra.run.dir={folder}"]
        before = processor_seconds()
        carry_out([sys.executable, "-m", "framework", *words])
        clock.write_text(f"{(processor_seconds() - before) / 60:.2f}\n")
    numbers = json.loads((folder / "results.json").read_text())
    predictor, description = load_with_description(folder)
    network = next(part for part in predictor.modules() if isinstance(part, Encoder) and not part.fixed)
    data = reader(description)
    data.prepare()
    test = data.splits().test
    points = torch.stack([test[row]["input"] for row in range(min(SHOWN[name], len(test)))])  # type: ignore[arg-type]
    return Trained(network, numbers, points, float(clock.read_text()))


def processor_seconds() -> float:
    """Return the processor time of all child processes that have ended, seconds."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def result_rows(networks: dict[str, Trained]) -> list[str]:
    """Return table rows with the test results of the trained networks."""
    return [
        f"| {name} | `{' '.join(TRAININGS[name])}` | {network.minutes:.0f} | {network.numbers['psnr_db']:.2f} | "
        f"{network.numbers['psnr_masked_db']:.2f} | {network.numbers['ssim']:.4f} | "
        f"{network.numbers['ssim_masked']:.3f} |"
        for name, network in networks.items()
    ]


@torch.inference_mode()
def error_rows(networks: dict[str, Trained]) -> list[str]:
    """Return table rows: by how much crop and bfloat16 change the images of the trained networks."""
    lines = []
    kinds: list[tuple[str, dict[str, Any]]] = [(f"margin {margin}", {"crop": margin}) for margin in MARGINS]
    kinds += [("bfloat16, whole frame", {"crop": None, "precision": "bfloat16"})]
    for name, network in networks.items():
        cells: dict[str, list[str]] = {change_name: [] for change_name, _ in kinds}
        for size in SIZES[::-1]:
            largest, total, count = ({change_name: 0.0 for change_name, _ in kinds} for _ in range(3))
            project = build_projection(size)
            for cloud in network.points:
                source = project(cloud[None])
                channels = source.shape[1]
                exact = copy_network(network.encoder, name, channels, size, crop=None)(source)
                for change_name, config in kinds:
                    change = (
                        copy_network(network.encoder, name, channels, size, **config)(source) - exact
                    ).abs() * 255
                    largest[change_name] = max(largest[change_name], float(change.max()))
                    total[change_name] += float(change.mean())
                    count[change_name] += 1
            for change_name in cells:
                cells[change_name].append(
                    f"{largest[change_name]:.3f} ({total[change_name] / count[change_name]:.4f})"
                )
        lines += [f"| {name} | {change_name} | {' | '.join(row)} |" for change_name, row in cells.items()]
    return lines


def requirement_rows(times: dict[tuple, Rounds]) -> list[str]:
    """Return table rows that compare times with the requirements, for each number format of the processor."""
    size, rows = SIZES[0], []
    for kind in number_formats():
        unet, slim = (times[size, name, kind, None] for name in ("unet", "slim"))
        limit = {"float32": MOST_FLOAT32, "bfloat16": MOST_BFLOAT16}[kind]
        box = times[size, "slim", kind, "default"]
        faster, gain = slim.speedup(unet), box.speedup(slim)
        rows.append(
            (
                f"speed ratio of slim to unet, {kind}",
                faster,
                f"≥ {LEAST_RATIO:g}",
                faster.median >= LEAST_RATIO,
            )
        )
        for splat, splats in ((SPLAT, f"with splats of {SPLAT} pixels"), (0, "without splats")):
            drawing = times[size, "projection", splat].milliseconds
            whole = Rounds(tuple(a + b for a, b in zip(drawing, slim.milliseconds, strict=True)))
            quantity = f"time of projection {splats} and slim, whole frame, {kind}, ms"
            rows.append((quantity, whole, f"≤ {limit:g}", whole.median <= limit))
        quantity = f"speed ratio of the box to the whole frame, slim, {kind}"
        rows.append((quantity, gain, f"≥ {LEAST_GAIN:g}", gain.median >= LEAST_GAIN))
    lines = [
        f"| {quantity} | {value.text()} | {requirement} | {'met' if holds else '**not met**'} |"
        for quantity, value, requirement, holds in rows
    ]
    if "bfloat16" not in number_formats():
        lines.append(
            "| time of a whole frame, bfloat16, ms | not measured: this processor emulates bfloat16 | "
            f"≤ {MOST_BFLOAT16:g} | |"
        )
    return lines


def number_formats() -> tuple[str, ...]:
    """Return the number formats that the processor does not emulate."""
    return ("float32", "bfloat16") if fast_bfloat16(torch.device("cpu")) else ("float32",)


FRAMES = "## Run time of an image"


def frames_section() -> str:
    """Measure the run time of an image, and return the section of the page."""
    torch.set_num_threads(1)
    require_idle()
    lines, times, cover = measure_frames()
    return "\n".join(
        [
            f"The images for the run times show a synthetic body of {body().shape[1]:,} points. The points are "
            f"projected with splats, which are discs around the points with a radius of {SPLAT} pixels, as in "
            f"`experiment=smplpix/quick`. The body covers {cover[0]:.0%} of the larger image ({SIZES[0][0]} × "
            f"{SIZES[0][1]} pixels) and {cover[1]:.0%} of the smaller image ({SIZES[1][0]} × {SIZES[1][1]} pixels).",
            "",
            f"A run time of a network is the processor time of one thread: the median of {ROUNDS} rounds, with the "
            "smallest and largest time in brackets. The networks are measured in turn. In the rows `projection` only "
            "the projection is measured, without or with splats. In the other rows `computed area` says whether the "
            "network computes the whole frame or only the box around the body. `computed pixels` is the number of "
            "these pixels, including those beyond the border, divided by the number of pixels of the image. `GFLOP` "
            "counts each multiplication and each addition of the convolutions.",
            "",
            "| image, pixels | network | number format | computed area | time, ms | GFLOP | computed pixels | million "
            "parameters |",
            "|---|---|---|---|---:|---:|---:|---:|",
            *lines,
            "",
            "The project requires the following run times of the networks `unet` and `slim`. A speed ratio is the "
            "time of the slower way to compute an image divided by the time of the faster way.",
            "",
            f"| quantity at {SIZES[0][0]} × {SIZES[0][1]} pixels | measured | requirement | result |",
            "|---|---|---|---|",
            *requirement_rows(times),
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_networks --only frames`.",
        ]
    )


def report() -> str:
    """Train the networks, measure, and return the page without the section of the run time."""
    networks = {name: train_network(name) for name in TRAININGS}
    torch.set_num_threads(1)
    below = networks["unet"].numbers["psnr_db"] - networks["slim"].numbers["psnr_db"]
    return "\n".join(
        [
            "# unet and slim: run time and accuracy (synthetic people)",
            "",
            "This page compares `unet` and `slim`, two neural networks that draw an image of a person from projected "
            "points. It measures their run time, their training, and the errors of two ways to save time: the crop to "
            "the subject and the number format bfloat16. All people are synthetic.",
            "",
            FRAMES,
            "",
            "## Training",
            "",
            "The table holds the time of the forward and backward pass of each network for four images of "
            f"{SIZES[1][0]} × {SIZES[1][1]} pixels in float32, without the optimiser.",
            "",
            "| network | time, ms |",
            "|---|---:|",
            *measure_steps(),
            "",
            "Both networks, `unet` and `slim`, were trained for about the same time, with seed 0. They were tested "
            "on 96 images of 256 × 192 pixels, which show 16 generated people who are not in the training data. "
            "`processor time` is the time of the whole run on one core. The columns `inside` count only the pixels of "
            "the subject.",
            "",
            "| network | arguments of the training | processor time, minutes | PSNR, dB | PSNR inside, dB | SSIM | "
            "SSIM inside |",
            "|---|---:|---:|---:|---:|---:|---:|",
            *result_rows(networks),
            "",
            f"On the test images, the PSNR (peak signal-to-noise ratio) of unet minus the PSNR of slim is {below:.1f} "
            f"dB. The project requires that this difference is at most {MOST_BELOW:g} dB. A negative difference means "
            "that the images of slim are better.",
            "",
            "## Errors by the crop and by bfloat16",
            "",
            f"The trained networks draw images of the test split (slim: {SHOWN['slim']} images, unet: {SHOWN['unet']} "
            "images) with a crop or with bfloat16. Each cell holds the largest difference of a colour value from the "
            "image that is computed as a whole in float32, on a scale of 0 to 255, and in brackets the mean "
            "difference. `margin` is the number of pixels around the box of the subject that the network computes as "
            "well. The headings of the last two columns are the sizes of the images in pixels.",
            "",
            "| network | setting | "
            + " | ".join(f"{height} × {width}" for height, width in SIZES[::-1])
            + " |",
            "|---|---|---:|---:|",
            *error_rows(networks),
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_networks`.",
            "",
        ]
    )


if __name__ == "__main__":
    section = frames_section()  # this comes first, because it exits if the machine is not idle
    if sys.argv[1:] != ["--only", "frames"]:
        write_page(HERE, report())
    replace_section(HERE.with_suffix(".md"), FRAMES, section)
