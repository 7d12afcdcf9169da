"""Milliseconds of the encoders unet and slim and of their training; what crop and bfloat16 cost in accuracy. Written
beside this file: `python benchmarks/smplpix_networks.py`."""

import math
import sys
import time
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks.machine import machine, milliseconds
from benchmarks.rasterizer import figure
from framework.configuration.schema import build, resolve
from framework.encoder import Encoder
from framework.geometry.camera import look_from
from framework.renderer import Scene

SIZES = ((410, 308), (256, 192))
SMALL = (128, 96)
"""Rows and columns of the pictures to train on."""
DISTANCE = 2.5  # metres
FRONT = (0.4, 0.15, 0.05)
"""Azimuth, elevation and tilt, radians, from which the body covers a quarter of the frame there."""
ROUNDS = 3
REPEATS = {"unet": 3, "slim": 40}
TRAINED = 40  # seconds of processor time
MARGINS = (0, 8, 16, 24, 32, 48, 64)
LEAST_RATIO, MOST_FLOAT32, MOST_BFLOAT16, LEAST_GAIN = 6.0, 55.0, 19.0, 1.5


def encoder(name: str, size: tuple[int, int], **config: Any) -> Encoder:
    torch.manual_seed(0)
    return build("encoder", resolve("encoder", {"name": name, **config}), input_shape=(4, *size)).eval()


def pair(
    size: tuple[int, int], seed: int, distance: float, points: int = 82, seen_from: tuple | None = None
) -> tuple[Tensor, Tensor]:
    """A body of random colours: its coloured points with depths on a ground of 1, and its picture on white."""
    random = np.random.default_rng(seed)
    first, second = random.uniform(0.05, 0.9, (2, 3))
    rises, turns = random.uniform(5, 60), random.integers(-4, 5)

    def colored(vertices: np.ndarray) -> Tensor:
        around = np.arctan2(vertices[:, 1], vertices[:, 0])
        share = 0.5 + 0.5 * np.sin(rises * vertices[:, 2:] + turns * around[:, None])
        return torch.tensor(first * share + second * (1 - share), dtype=torch.float32)

    angles = seen_from or random.uniform((0, -0.2, -0.1), (2 * math.pi, 0.2, 0.1))
    camera = look_from(*angles, distance, 2 * math.atan(410 / 2 / 600), size)
    (vertices, faces), (sparse, _) = figure(), figure(points, points + 2)
    drawing = build("renderer", resolve("renderer", {"name": "rasterizer", "cull": True, "supersampling": 2}))
    both = torch.cat([colored(vertices), torch.ones(len(vertices), 1)], 1)
    drawn = drawing(Scene(torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces), both, camera))[
        "color"
    ]
    target = drawn[..., :3] + 1 - drawn[..., 3:]
    at, depth = camera.projected(torch.tensor(sparse, dtype=torch.float32))
    values = torch.cat([colored(sparse), depth[:, None] / 4], 1)
    far_to_near = depth.argsort(descending=True)
    at, values = at.round().long()[far_to_near], values[far_to_near]
    inside = ((at >= 0) & (at < torch.tensor(size[::-1]))).all(1)
    source = np.ones((*size, 4), np.float32)
    source[at[inside, 1].numpy(), at[inside, 0].numpy()] = values[
        inside
    ].numpy()  # in NumPy the last one stays
    return torch.from_numpy(source).permute(2, 0, 1).contiguous(), target.permute(2, 0, 1).contiguous()


def pairs(size: tuple[int, int], seeds: range, points: int) -> tuple[Tensor, Tensor]:
    sources, targets = zip(*(pair(size, seed, 2.3 + 0.1 * (seed % 8), points) for seed in seeds), strict=True)
    return torch.stack(sources), torch.stack(targets)


def trained(name: str) -> tuple[Encoder, Tensor, Tensor, float, int]:
    """A network after `TRAINED`, unseen pictures, PSNR there inside of the subjects, dB, and steps."""
    sources, targets = pairs(SMALL, range(160), 33)
    unseen, truth = pairs(SMALL, range(1000, 1024), 33)
    made = encoder(name, SMALL, crop=None).train()
    optimizer = torch.optim.Adam(made.parameters(), lr=2e-3)
    generator = torch.Generator().manual_seed(0)
    start, steps, spent = time.process_time(), 0, 0.0
    while spent < TRAINED:
        optimizer.param_groups[0]["lr"] = 2e-3 * max(0.02, 1 - spent / TRAINED)
        chosen = torch.randint(0, len(sources), (4,), generator=generator)
        weight = 1 + 4 * (targets[chosen] < 0.999).any(1, keepdim=True)
        optimizer.zero_grad()
        ((made(sources[chosen]) - targets[chosen]).abs() * weight).mean().backward()
        optimizer.step()
        steps, spent = steps + 1, time.process_time() - start
    with torch.no_grad():
        return made, unseen, truth, inside(made.eval()(unseen), truth), steps


def like(made: Encoder, name: str, size: tuple[int, int], **config: Any) -> Encoder:
    """The same weights with other parameters."""
    other = encoder(name, size, **config)
    other.load_state_dict(made.state_dict())
    return other


def frames() -> tuple[list[str], dict[tuple, float]]:
    """A line for each network, size, precision and crop; and the milliseconds."""
    lines, found = [], {}
    for size in SIZES:
        source = pair(size, 3, DISTANCE, seen_from=FRONT)[0][None]
        keys = list(product(("unet", "slim"), ("float32", "bfloat16"), (None, "default")))
        calls = {}
        for name, precision, crop in keys:
            config = {"crop": None} if crop is None else {}
            made = encoder(name, size, precision=precision, **config)
            with torch.inference_mode(), FlopCounterMode(display=False) as counter:
                made(source)
            part = made.report.computed / math.prod(size) if made.report else 1.0
            calls[name, precision, crop] = (made, counter.get_total_flops(), part)
        for _ in range(ROUNDS):
            for key in keys:
                with torch.inference_mode():
                    took = milliseconds(partial(calls[key][0], source), REPEATS[key[0]], warm_up=1)
                found[size, *key] = min(took, found.get((size, *key), math.inf))
        for key in keys:
            made, operations, part = calls[key]
            count = sum(parameter.numel() for parameter in made.parameters())
            lines.append(
                f"| {size[0]} × {size[1]} | {key[0]} | {key[1]} | {'whole frame' if key[2] is None else 'box'} | "
                f"{found[size, *key]:.1f} | {operations / 1e9:.2f} | {part:.0%} | {count / 1e6:.2f} |"
            )
    return lines, found


def steps() -> list[str]:
    """Milliseconds of a training step of four pictures, forwards and backwards, without the optimiser."""
    lines = []
    for name in ("unet", "slim"):
        made = encoder(name, SIZES[1]).train()
        batch = pair(SIZES[1], 3, DISTANCE)[0].expand(4, -1, -1, -1)
        took = milliseconds(lambda: made(batch).mean().backward(), 3 if name == "unet" else 10, warm_up=1)  # noqa: B023 - called here
        lines.append(f"| {name} | {took:.0f} |")
    return lines


def accuracy() -> list[str]:
    (other, unseen, truth, reference, few), (made, *_, quality, count) = map(trained, ("unet", "slim"))
    large = torch.stack([pair(SIZES[0], seed, DISTANCE)[0] for seed in range(1000, 1006)])
    lines = [
        f"{TRAINED} s of training each, four pictures of {SMALL[0]} × {SMALL[1]} a step, synthetic bodies of 1,124 "
        "points. "
        f"PSNR inside of unseen ones: slim {quality:.1f} dB after {count} steps, unet {reference:.1f} dB after {few}. "
        "Neither is near its best then. Largest difference of a colour from the whole frame in float32, of 255, over "
        f"{len(unseen)} such pictures and over six of {SIZES[0][0]} × {SIZES[0][1]} of 6,890 points (unet: two); mean "
        "in brackets:",
        "",
        "| network | | " + " | ".join(f"{height} × {width}" for height, width in (SMALL, SIZES[0])) + " |",
        "|---|---|---|---|",
    ]
    kinds: list[tuple[str, dict[str, Any]]] = [(f"margin {margin}", {"crop": margin}) for margin in MARGINS]
    kinds += [("bfloat16, whole frame", {"crop": None, "precision": "bfloat16"})]
    for name, network in (("slim", made), ("unet", other)):
        cells: dict[str, list[str]] = {what: [] for what, _ in kinds}
        for pictures in (unseen, large if name == "slim" else large[:2]):
            size = (pictures.shape[2], pictures.shape[3])
            with torch.inference_mode():
                exact = like(network, name, size, crop=None)(pictures)
                for what, config in kinds:
                    change = (like(network, name, size, **config)(pictures) - exact).abs() * 255
                    cells[what].append(f"{change.max():.3f} ({change.mean():.4f})")
        lines += [f"| {name} | {what} | {' | '.join(found)} |" for what, found in cells.items()]
    with torch.inference_mode():
        rough = like(made, "slim", SMALL, crop=None, precision="bfloat16")(unseen)
    lines += ["", f"PSNR of slim: {inside(rough, truth):.2f} dB in bfloat16, {quality:.2f} dB in float32."]
    return lines


def inside(pictures: Tensor, truth: Tensor) -> float:
    """PSNR over the pixels of the subjects, dB."""
    covered = (truth < 0.999).any(1, keepdim=True).expand_as(truth)
    return -10 * math.log10((pictures - truth)[covered].square().mean().item())


def judged(found: dict[tuple, float]) -> list[str]:
    size = SIZES[0]
    ratios = [
        found[size, "unet", kind, None] / found[size, "slim", kind, None] for kind in ("float32", "bfloat16")
    ]
    gains = [
        found[size, "slim", kind, None] / found[size, "slim", kind, "default"]
        for kind in ("float32", "bfloat16")
    ]
    whole = [found[size, "slim", kind, None] for kind in ("float32", "bfloat16")]
    rows = [
        (
            "slim faster than unet, float32 / bfloat16",
            ratios,
            f"≥ {LEAST_RATIO:g}",
            min(ratios) >= LEAST_RATIO,
        ),
        ("slim, whole frame, float32, ms", whole[:1], f"≤ {MOST_FLOAT32:g}", whole[0] <= MOST_FLOAT32),
        ("slim, whole frame, bfloat16, ms", whole[1:], f"≤ {MOST_BFLOAT16:g}", whole[1] <= MOST_BFLOAT16),
        (
            "slim, the box alone, times as fast, float32 / bfloat16",
            gains,
            f"≥ {LEAST_GAIN:g}",
            min(gains) >= LEAST_GAIN,
        ),
    ]
    return [
        f"| {what} | {' / '.join(f'{value:.1f}' for value in values)} | {wanted} | "
        f"{'holds' if holds else '**missed**'} |"
        for what, values, wanted, holds in rows
    ]


def report() -> str:
    torch.set_num_threads(1)
    lines, found = frames()
    cover = [
        (pair(size, 3, DISTANCE, seen_from=FRONT)[1] < 0.999).any(0).float().mean().item() for size in SIZES
    ]
    return "\n".join(
        [
            "# unet and slim: milliseconds a picture",
            "",
            f"Synthetic body of 6,890 points on pictures of 4 channels, of which it covers {cover[0]:.0%} and "
            f"{cover[1]:.0%}; one thread; processor time, the lowest of {ROUNDS} medians, all in turn. GFLOP: "
            "multiply-adds of convolutions, times two. Pixels: those computed, beyond the border too, of those of the "
            "picture.",
            "",
            "| size | network | numbers | computed | ms | GFLOP | pixels | million parameters |",
            "|---|---|---|---|---|---|---|---|",
            *lines,
            "",
            f"| at {SIZES[0][0]} × {SIZES[0][1]} | measured | wanted | |",
            "|---|---|---|---|",
            *judged(found),
            "",
            "## Training",
            "",
            f"Four pictures of {SIZES[1][0]} × {SIZES[1][1]} in float32, forwards and backwards:",
            "",
            "| network | ms |",
            "|---|---|",
            *steps(),
            "",
            "## What crop and bfloat16 cost",
            "",
            *accuracy(),
            "",
            f"{machine('torch', 'numpy')} Command: `python benchmarks/smplpix_networks.py`.",
            "",
        ]
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(report())
