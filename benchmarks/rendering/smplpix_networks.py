"""Milliseconds of the encoders unet and slim and of their training, what each makes of as much training time, and what
crop and bfloat16 cost.

    python -m benchmarks.rendering.smplpix_networks [--only frames]

First trains what outputs/smplpix_networks does not hold yet, half an hour of one core. `--only frames` writes the
section of the milliseconds a frame alone. Results lie beside this file.
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
from benchmarks.rendering.rasterizer import figure
from benchmarks.timing import ROUNDS, Rounds, milliseconds, require_idle, time_interleaved
from framework.configuration.loading import load_with_description, reader
from framework.configuration.schema import build, resolve
from framework.encoder import Encoder
from framework.geometry.camera import look_from
from plugins.encoder.unets.canvas import fast_bfloat16

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/smplpix_networks"
SIZES = ((410, 308), (256, 192))
DISTANCE = 2.5  # metres
FRONT = (0.4, 0.15, 0.05)
"""Azimuth, elevation and tilt, radians, from which the body covers a quarter of the frame there."""
SPLAT = 5
"""Pixels, as smplpix/quick has it."""
TRAININGS = {
    "unet": ("experiment=smplpix/unet", "trainer.max_epochs=1", "+trainer.limit_train_batches=120"),
    "slim": ("experiment=smplpix/quick", "trainer.max_epochs=10"),
}
"""Arguments of runs of about a quarter of an hour: half an epoch, and ten."""
MARGINS = (0, 8, 16, 24, 32, 48, 64)
SHOWN = {"unet": 12, "slim": 96}
"""Test images on which crop and bfloat16 are compared: the first of them."""
LEAST_RATIO, MOST_FLOAT32, MOST_BFLOAT16, LEAST_GAIN, MOST_BELOW = 6.0, 60.0, 20.0, 1.5, 0.3


class Trained(NamedTuple):
    """A network after its training.

    Attributes:
        encoder: the network.
        numbers: of its run's test.
        points: (image, point, 6), the inputs of the test split.
        minutes: of processor time, the whole run.
    """

    encoder: Encoder
    numbers: dict[str, Any]
    points: Tensor
    minutes: float


def body() -> Tensor:
    """(1, points, 6): a body 1.7 m tall, coloured by place, before the canonical camera."""
    vertices = torch.tensor(figure()[0])
    camera = look_from(*FRONT, DISTANCE, 2 * math.atan(410 / 2 / 600), SIZES[0])
    low, high = vertices.min(0).values, vertices.max(0).values
    return torch.cat([camera.to_canonical(vertices), (vertices - low) / (high - low)], 1).float()[None]


def encoder(name: str, shape: tuple[int, ...], **config: Any) -> Encoder:
    torch.manual_seed(0)
    return build(
        "encoder", resolve("encoder", {"name": name, **config}), input_shape=shape, input_columns=()
    ).eval()


def projection(size: tuple[int, int], splat: int = SPLAT) -> Encoder:
    return encoder("projection", (1, 6), height=size[0], width=size[1], splat=splat)


def like(made: Encoder, name: str, channels: int, size: tuple[int, int], **config: Any) -> Encoder:
    """The same weights with other parameters."""
    other = encoder(name, (channels, *size), residual=True, **config)
    other.load_state_dict(made.state_dict())
    return other


def frames() -> tuple[list[str], dict[tuple, Rounds], list[float]]:
    """A line for each network, size, precision and crop; their milliseconds; the share of pixels that are covered."""
    lines, found, covered = [], {}, []
    for size in SIZES:
        calls: dict[tuple, tuple[Encoder, Tensor]] = {
            ("projection", splat): (projection(size, splat), body()) for splat in (0, SPLAT)
        }
        with torch.inference_mode():
            source = calls["projection", SPLAT][0](body())
        covered.append(float((source[0, 3] < 1).float().mean()))
        keys = list(product(("unet", "slim"), kinds(), (None, "default")))
        for name, precision, crop in keys:
            config = {"crop": None} if crop is None else {}
            made = encoder(name, tuple(source.shape[1:]), precision=precision, residual=True, **config)
            calls[name, precision, crop] = made, source
        with torch.inference_mode():
            times = time_interleaved({str(key): partial(call, given) for key, (call, given) in calls.items()})
        found |= {(size, *key): times[str(key)] for key in calls}
        for splat in (0, SPLAT):
            what = f"splats of {splat} pixels" if splat else "no splats"
            took = found[size, "projection", splat]
            lines.append(
                f"| {size[0]} × {size[1]} | projection | float32 | {what} | {took.text()} | – | – | – |"
            )
        for key in keys:
            made: Any = calls[key][0]
            with torch.inference_mode(), FlopCounterMode(display=False) as counter:
                made(source)
            part = made.report.computed / math.prod(size) if made.report else 1.0
            count = sum(parameter.numel() for parameter in made.parameters())
            lines.append(
                f"| {size[0]} × {size[1]} | {key[0]} | {key[1]} | {'whole frame' if key[2] is None else 'box'} | "
                f"{found[size, *key].text()} | {counter.get_total_flops() / 1e9:.2f} | {part:.0%} | {count / 1e6:.2f} |"
            )
    return lines, found, covered


def steps() -> list[str]:
    """Milliseconds of a training step of four images, forwards and backwards, without the optimiser."""
    lines = []
    with torch.no_grad():
        batch = projection(SIZES[1])(body()).expand(4, -1, -1, -1)
    for name in ("unet", "slim"):
        made = encoder(name, tuple(batch.shape[1:])).train()
        took = milliseconds(lambda: made(batch).mean().backward(), 3 if name == "unet" else 10, warm_up=1)  # noqa: B023 - called here
        lines.append(f"| {name} | {took:.0f} |")
    return lines


def trained(name: str) -> Trained:
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
    """Of the processes that this one has started and that have ended."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def equal_time(found: dict[str, Trained]) -> list[str]:
    return [
        f"| {name} | `{' '.join(TRAININGS[name])}` | {one.minutes:.0f} | {one.numbers['psnr_db']:.2f} | "
        f"{one.numbers['psnr_masked_db']:.2f} | {one.numbers['ssim']:.4f} | {one.numbers['ssim_masked']:.3f} |"
        for name, one in found.items()
    ]


@torch.inference_mode()
def costs(found: dict[str, Trained]) -> list[str]:
    """What crop and bfloat16 change of a trained network's images."""
    lines = []
    kinds: list[tuple[str, dict[str, Any]]] = [(f"margin {margin}", {"crop": margin}) for margin in MARGINS]
    kinds += [("bfloat16, whole frame", {"crop": None, "precision": "bfloat16"})]
    for name, one in found.items():
        cells: dict[str, list[str]] = {what: [] for what, _ in kinds}
        for size in SIZES[::-1]:
            largest, total, count = ({what: 0.0 for what, _ in kinds} for _ in range(3))
            project = projection(size)
            for cloud in one.points:
                source = project(cloud[None])
                channels = source.shape[1]
                exact = like(one.encoder, name, channels, size, crop=None)(source)
                for what, config in kinds:
                    change = (like(one.encoder, name, channels, size, **config)(source) - exact).abs() * 255
                    largest[what] = max(largest[what], float(change.max()))
                    total[what] += float(change.mean())
                    count[what] += 1
            for what in cells:
                cells[what].append(f"{largest[what]:.3f} ({total[what] / count[what]:.4f})")
        lines += [f"| {name} | {what} | {' | '.join(row)} |" for what, row in cells.items()]
    return lines


def judged(found: dict[tuple, Rounds]) -> list[str]:
    """The figures beside what is wanted of them, each in float32 and, where the processor has it, in bfloat16."""
    size, rows = SIZES[0], []
    for kind in kinds():
        unet, slim = (found[size, name, kind, None] for name in ("unet", "slim"))
        limit = {"float32": MOST_FLOAT32, "bfloat16": MOST_BFLOAT16}[kind]
        box = found[size, "slim", kind, "default"]
        faster, gain = slim.speedup(unet), box.speedup(slim)
        rows.append(
            (f"slim faster than unet, {kind}", faster, f"≥ {LEAST_RATIO:g}", faster.median >= LEAST_RATIO)
        )
        for splat, said in ((SPLAT, f"with splats of {SPLAT} pixels"), (0, "without splats")):
            drawing = found[size, "projection", splat].milliseconds
            whole = Rounds(tuple(a + b for a, b in zip(drawing, slim.milliseconds, strict=True)))
            what = f"projection {said} and slim, a whole frame, {kind}, ms"
            rows.append((what, whole, f"≤ {limit:g}", whole.median <= limit))
        what = f"slim, the box alone, times as fast, {kind}"
        rows.append((what, gain, f"≥ {LEAST_GAIN:g}", gain.median >= LEAST_GAIN))
    lines = [
        f"| {what} | {value.text()} | {wanted} | {'holds' if holds else '**missed**'} |"
        for what, value, wanted, holds in rows
    ]
    if "bfloat16" not in kinds():
        lines.append(
            f"| a whole frame, bfloat16, ms | not available: emulated by this processor | ≤ {MOST_BFLOAT16:g} | |"
        )
    return lines


def kinds() -> tuple[str, ...]:
    """Of numbers, those that the processor computes with by itself."""
    return ("float32", "bfloat16") if fast_bfloat16(torch.device("cpu")) else ("float32",)


FRAMES = "## A frame"


def of_frames() -> str:
    """The section with the milliseconds of a frame."""
    torch.set_num_threads(1)
    require_idle()
    lines, found, cover = frames()
    return "\n".join(
        [
            f"A synthetic body of {body().shape[1]:,} points, projected with splats of {SPLAT} pixels as "
            f"`smplpix/quick` has it; it covers {cover[0]:.0%} of the larger, {cover[1]:.0%} of the smaller image. "
            f"One thread, processor time, all in turn: median of {ROUNDS} rounds (least to largest). GFLOP: "
            "multiply-adds of convolutions, times two. Pixels: those computed, beyond the border too, of those of the "
            "picture.",
            "",
            "| size | network | numbers | computed | ms | GFLOP | pixels | million parameters |",
            "|---|---|---|---|---:|---:|---:|---:|",
            *lines,
            "",
            f"| at {SIZES[0][0]} × {SIZES[0][1]} | measured | wanted | |",
            "|---|---|---|---|",
            *judged(found),
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_networks --only frames`.",
        ]
    )


def report() -> str:
    networks = {name: trained(name) for name in TRAININGS}
    torch.set_num_threads(1)
    below = networks["unet"].numbers["psnr_db"] - networks["slim"].numbers["psnr_db"]
    return "\n".join(
        [
            "# unet and slim: milliseconds an image (synthetic people)",
            "",
            FRAMES,
            "",
            "## Training",
            "",
            f"Four images of {SIZES[1][0]} × {SIZES[1][1]} in float32, forwards and backwards:",
            "",
            "| network | ms |",
            "|---|---:|",
            *steps(),
            "",
            "What each makes of about as much time: seed 0, 96 test images of 16 unseen generated people, 256 × 192. "
            "Minutes of processor time, the whole run on one core.",
            "",
            "| network | training | minutes | PSNR, dB | inside | SSIM | inside |",
            "|---|---:|---:|---:|---:|---:|---:|",
            *equal_time(networks),
            "",
            f"PSNR of slim below unet's: {below:.1f} dB (wanted ≤ {MOST_BELOW:g}).",
            "",
            "## What crop and bfloat16 cost",
            "",
            f"The networks of that training on inputs of the test split (slim: {SHOWN['slim']} images, unet: "
            f"{SHOWN['unet']}). Largest difference of a colour from the whole frame in float32, of 255; mean in "
            "brackets:",
            "",
            "| network | | " + " | ".join(f"{height} × {width}" for height, width in SIZES[::-1]) + " |",
            "|---|---|---:|---:|",
            *costs(networks),
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_networks`.",
            "",
        ]
    )


if __name__ == "__main__":
    section = of_frames()  # first: it ends where the machine is not idle
    if sys.argv[1:] != ["--only", "frames"]:
        write_page(HERE, report())
    replace_section(HERE.with_suffix(".md"), FRAMES, section)
