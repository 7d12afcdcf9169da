"""Measure the temporal stability (flicker) of images of a walking person: mesh, trained network, photographs.

    python -m framework experiment=smplpix/quick
    python -m benchmarks.rendering.smplpix_flicker <run> <walk.bvh>

Of a generated person that the run never saw. Each image is brought along to the next by the flow of the registered
mesh, which is known exactly, and compared with it where a point is seen in both. Writes smplpix_flicker.md and .png
beside this file.
"""

import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

import framework
from benchmarks.pages import machine, write_page
from framework.configuration.loading import find_checkpoint, read_stored
from framework.configuration.schema import build, resolve
from framework.figures.style import titled_figure
from framework.geometry.srgb import bytes_from_linear, srgb_from_linear
from framework.renderer import Renderer, Scene
from plugins.data.human_scans import flow
from plugins.data.human_scans.animate import SPEED, data_of, follow_motion, generated_person
from plugins.data.human_scans.animation import on_white, orbit, photograph

SUBJECTS = ("test_0000", "test_0003", "test_0005")
FRAMES, START, AZIMUTH = 20, 0.5, math.radians(35)
PAIRS = FRAMES - 1
SHOWN = 8
"""Frame of the image."""
LOOPS = 60
BRIGHT = 60.0
"""Of 255: white in the maps."""
Pictures = dict[str, list[Tensor]]


def rendered(name: str, **config: Any) -> Renderer:
    return build("renderer", resolve("renderer", {"name": name, **config}))


def walk(run: str, file: Path, subject: str) -> tuple[Pictures, list[Scene]]:
    """Images of each way, as files hold them, 0…255; and what they are of."""
    description, _ = read_stored(run)
    data = data_of(description)
    height, width = description.target.size
    who, moments = follow_motion(generated_person(data, subject), file, FRAMES, START)
    cameras = orbit(moments, [AZIMUTH] * FRAMES, (height, width))
    ways = {
        "mesh, 1 sample": rendered("rasterizer"),
        "mesh, 4 × 4 samples": rendered("rasterizer", supersampling=4),
        "SMPLpix": rendered("smplpix", checkpoint=run),
    }
    found: Pictures = {name: [] for name in (*ways, "photograph")}
    scenes = [who.scene(moment, camera) for moment, camera in zip(moments, cameras, strict=True)]
    for moment, scene in zip(moments, scenes, strict=True):
        for name, renderer in ways.items():
            found[name].append(torch.from_numpy(on_white(renderer, scene)).double())
        assert moment.scan is not None
        found["photograph"].append(
            torch.from_numpy(photograph(data.renderer, moment.scan, scene.camera)).double()
        )
    return found, scenes


def differences(pictures: Pictures, scenes: list[Scene]) -> tuple[dict[str, list[Tensor]], list[Tensor]]:
    """Of each way and pair of images the difference, of 255, NaN where a point is not seen in both; and that mask."""
    renderer = rendered("rasterizer")
    drawn = [renderer(scene, flow.CHANNELS) for scene in scenes]
    found: dict[str, list[Tensor]] = {name: [] for name in pictures}
    masks = []
    for number, (one, other) in enumerate(pairwise(range(len(scenes)))):
        place, seen = flow.flow(scenes[one], scenes[other], drawn[one], drawn[other])
        masks.append(seen)
        for name, frames in pictures.items():
            off = (frames[other] - flow.warp(frames[one], place)).abs().mean(-1)
            found[name].append(off.where(seen, math.nan))
        assert seen.any(), f"pair {number}"
    return found, masks


def judged(per_subject: list[dict[str, list[Tensor]]]) -> dict[str, dict[str, float]]:
    """Of each way, over all pixels of all pairs of all subjects: mean, 95th percentile, and mean's SD over subjects."""
    rows = {}
    for name in per_subject[0]:
        each = [torch.cat([off[~off.isnan()] for off in found[name]]) for found in per_subject]
        every = torch.cat(each)
        rows[name] = {
            "mean": every.mean().item(),
            "high": np.quantile(every.numpy(), 0.95).item(),
            "spread": statistics.stdev(one.mean().item() for one in each),
        }
    return rows


def drawing(pictures: Pictures, found: dict[str, list[Tensor]]) -> Figure:
    figure = titled_figure((9.5, 6.5), "A walk, and how much of each image flickers", True)
    axes = figure.subplots(2, len(pictures))
    for column, name in enumerate(pictures):
        axes[0, column].imshow(pictures[name][SHOWN].byte().numpy())
        axes[0, column].set_title(name, fontsize=9)
        off = found[name][SHOWN - 1].nan_to_num(0.0)
        shown = axes[1, column].imshow(off.numpy(), cmap="magma", vmin=0, vmax=BRIGHT)
        for axis in axes[:, column]:
            axis.set_axis_off()
    bar = figure.colorbar(shown, ax=axes[1], extend="max")
    bar.set_label("|difference| to the next image\nafter the flow (of 255)")
    return figure


def rates(run: str, scene: Scene) -> list[str]:
    """Milliseconds of processor time an image in plain loops of one thread, beside what the run measured of itself."""
    results = json.loads((find_checkpoint(run).parent.parent / "results.json").read_text())
    assert scene.colors is not None
    points = torch.cat(
        [scene.camera.to_canonical(scene.vertices), srgb_from_linear(scene.colors)], 1
    ).numpy()[None]
    loaded, frozen = framework.load(run), framework.freeze(run)
    drawn = rendered("smplpix", checkpoint=run)

    @torch.no_grad()
    def predicted() -> object:
        return loaded(points).mean

    # on one frozen sample the mean of the image is what the renderer paints, but as files hold it
    apart = np.abs(bytes_from_linear(drawn(scene)["color"]).numpy() - (frozen(points)[0] * 255).round()).max()
    calls: dict[str, Callable[[], object]] = {
        "`framework.freeze(run)(points)`": lambda: frozen(points),
        "`framework.load(run)(points)`": predicted,
        "`renderer=smplpix`, scene to light": lambda: drawn(scene),
    }
    took: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(LOOPS + 5):
        for name, call in calls.items():  # in turn, so that a busy machine slows all of them
            start = time.process_time()
            call()
            took[name].append(1e3 * (time.process_time() - start))
    lines = [
        f"| {name} | {statistics.median(times[5:]):.1f} | {min(times[5:]):.1f} |"
        for name, times in took.items()
    ]
    return [
        "| plain loop, processor time | median ms | least ms |",
        "|---|---|---|",
        *lines,
        f"| the run of itself, one sample alone, wall clock | {results['latency_milliseconds']:.1f} | |",
        "",
        f"Frozen and drawn images differ by {apart:g} of 255 at most.",
    ]


def training(run: str) -> str:
    """What the network is and how it was trained, in a sentence."""
    description, _ = read_stored(run)
    results = json.loads((find_checkpoint(run).parent.parent / "results.json").read_text())
    journal = (find_checkpoint(run).parent.parent / "journal.jsonl").read_text().splitlines()
    epochs = 1 + max(json.loads(line).get("epoch") or 0 for line in journal)
    names = " + ".join(part["name"] for part in description.config["encoder"])
    return (
        f"{names}, {epochs} epochs of {results['experiment']}; on unseen subjects PSNR {results['psnr_db']:.1f} dB, "
        f"{results['psnr_masked_db']:.1f} dB inside the subject."
    )


def report(run: str, file: Path) -> str:
    torch.set_num_threads(1)
    per_subject, covered = [], []
    for subject in SUBJECTS:
        pictures, scenes = walk(run, file, subject)
        found, masks = differences(pictures, scenes)
        per_subject.append(found)
        covered += [mask.float().mean().item() for mask in masks]
        if subject == SUBJECTS[0]:
            drawing(pictures, found).savefig(Path(__file__).with_suffix(".png"), dpi=110)
    rows = judged(per_subject)
    floor = rows["photograph"]["mean"]
    rate = rates(run, scenes[0])
    return "\n".join(
        [
            "# Temporal stability (flicker) of a walking person (synthetic people)",
            "",
            f"The network: {training(run)}",
            "",
            f"{len(SUBJECTS)} generated test subjects walk as `{file.name}` says, {FRAMES} images each at {SPEED} a "
            f"second, {scenes[0].camera.height} × {scenes[0].camera.width} pixels. Each image is brought to the next "
            "by the flow of the registered mesh (visible face and barycentric weights, exact), bilinear; the "
            "difference of sRGB numbers, of 255, mean of the channels, is taken where a point is seen in both images "
            f"and no outline is near: {statistics.mean(covered):.1%} of a frame. Photographs say what a true image "
            "has of it: fine patterns that interpolation blurs, cloth that moves beside the registered body, light "
            "that changes as the body turns. A mesh with fixed colours of its vertices has less of all three, and may "
            "be below.",
            "",
            "| | mean | SD over subjects | 95th percentile | mean over that of photographs |",
            "|---|---|---|---|---|",
            *(
                f"| {name} | {row['mean']:.2f} | {row['spread']:.2f} | {row['high']:.1f} | {row['mean'] / floor:.2f} |"
                for name, row in rows.items()
            ),
            "",
            "![](smplpix_flicker.png)",
            "",
            "## Rate of the trained network alone",
            "",
            *rate,
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_flicker <run> {file.name}`.",
            "",
        ]
    )


if __name__ == "__main__":
    write_page(__file__, report(sys.argv[1], Path(sys.argv[2])))
