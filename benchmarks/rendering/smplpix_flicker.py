"""Measure the temporal stability (flicker) of images of walking people: mesh, trained network, photographs.

    python -m framework experiment=smplpix/quick
    python -m benchmarks.rendering.smplpix_flicker <run> <walk.bvh>

The people are generated and not in the training data of the run. Each image is moved to the next one by the flow of the
registered mesh, which is known exactly, and compared with it at pixels whose point is visible in both images. The
script writes smplpix_flicker.md and .png beside this file.
"""

import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

import framework
from benchmarks.pages import machine, write_page
from benchmarks.rendering.builders import build_renderer
from framework.configuration.loading import find_checkpoint, read_stored, training_data
from framework.figures.style import titled_figure
from framework.geometry.srgb import bytes_from_linear, srgb_from_linear
from framework.renderer import Scene
from plugins.data.human_scans import flow
from plugins.data.human_scans.animate import SPEED, follow_motion, generated_person
from plugins.data.human_scans.animation import on_white, orbit, photograph

SUBJECTS = ("test_0000", "test_0003", "test_0005")
FRAMES, START, AZIMUTH = 20, 0.5, math.radians(35)
SHOWN = 8
"""Index of the frame that the figure shows."""
LOOPS = 60
BRIGHT = 60.0
"""Difference, of 255, that is drawn in the brightest colour."""
Images = dict[str, list[Tensor]]


def walk(run: str, file: Path, subject: str) -> tuple[Images, list[Scene]]:
    """Return the images of a walking subject, 0 to 255, for each way to draw them, and the scenes that they show."""
    description, _ = read_stored(run)
    data = training_data(description, "human_scans")
    height, width = description.target.size
    who, moments = follow_motion(generated_person(data, subject), file, FRAMES, START)
    cameras = orbit(moments, [AZIMUTH] * FRAMES, (height, width))
    ways = {
        "mesh, 1 sample": build_renderer("rasterizer"),
        "mesh, 4 × 4 samples": build_renderer("rasterizer", supersampling=4),
        "SMPLpix": build_renderer("smplpix", checkpoint=run, precision="trained"),
    }
    images: Images = {name: [] for name in (*ways, "photograph")}
    scenes = [who.scene(moment, camera) for moment, camera in zip(moments, cameras, strict=True)]
    for moment, scene in zip(moments, scenes, strict=True):
        for name, renderer in ways.items():
            images[name].append(torch.from_numpy(on_white(renderer, scene)).double())
        assert moment.scan is not None
        images["photograph"].append(
            torch.from_numpy(photograph(data.renderer, moment.scan, scene.camera)).double()
        )
    return images, scenes


def differences(images: Images, scenes: list[Scene]) -> tuple[dict[str, list[Tensor]], list[Tensor]]:
    """Compare each image with the next one.

    Returns:
        For each way to draw, the difference of each pair of images, (height, width), NaN at pixels that cannot be
        compared; and for each pair the mask of the pixels that can, because their point is visible in both images.
    """
    renderer = build_renderer("rasterizer")
    rendered_channels = [renderer(scene, flow.CHANNELS) for scene in scenes]
    changes: dict[str, list[Tensor]] = {name: [] for name in images}
    masks = []
    for number, (first, second) in enumerate(pairwise(range(len(scenes)))):
        place, visible = flow.flow(
            scenes[first], scenes[second], rendered_channels[first], rendered_channels[second]
        )
        masks.append(visible)
        for name, frames in images.items():
            change = (frames[second] - flow.warp(frames[first], place)).abs().mean(-1)
            changes[name].append(change.where(visible, math.nan))
        assert visible.any(), f"No point is visible in both images of pair {number}."
    return changes, masks


def summarise(per_subject: list[dict[str, list[Tensor]]]) -> dict[str, dict[str, float]]:
    """Return mean, 95th percentile and the mean's standard deviation over subjects, for each way to draw."""
    rows = {}
    for name in per_subject[0]:
        by_subject = [
            torch.cat([change[~change.isnan()] for change in changes[name]]) for changes in per_subject
        ]
        all_pixels = torch.cat(by_subject)
        rows[name] = {
            "mean": all_pixels.mean().item(),
            "high": np.quantile(all_pixels.numpy(), 0.95).item(),
            "spread": statistics.stdev(values.mean().item() for values in by_subject),
        }
    return rows


def draw_figure(images: Images, changes: dict[str, list[Tensor]]) -> Figure:
    """Return the figure of image SHOWN for each way to draw, and of its difference from the image before it."""
    figure = titled_figure((9.5, 6.5), "A walk, and how much of each image flickers", True)
    axes = figure.subplots(2, len(images))
    for column, name in enumerate(images):
        axes[0, column].imshow(images[name][SHOWN].byte().numpy())
        axes[0, column].set_title(name, fontsize=9)
        change = changes[name][SHOWN - 1].nan_to_num(0.0)
        color_map = axes[1, column].imshow(change.numpy(), cmap="magma", vmin=0, vmax=BRIGHT)
        for axis in axes[:, column]:
            axis.set_axis_off()
    bar = figure.colorbar(color_map, ax=axes[1], extend="max")
    bar.set_label("|difference| to the next image\nafter the flow (of 255)")
    return figure


def rates(run: str, scene: Scene) -> list[str]:
    """Return the lines with the run time of the trained network: measured here in loops, and by the run itself."""
    results = json.loads((find_checkpoint(run).parent.parent / "results.json").read_text())
    assert scene.colors is not None
    points = torch.cat(
        [scene.camera.to_canonical(scene.vertices), srgb_from_linear(scene.colors)], 1
    ).numpy()[None]
    loaded, frozen = framework.load(run), framework.freeze(run)
    renderer = build_renderer("smplpix", checkpoint=run, precision="trained")

    @torch.no_grad()
    def predicted() -> object:
        return loaded(points).mean

    # the mean of the frozen model's density is the image of the renderer, in sRGB values
    largest_difference = np.abs(
        bytes_from_linear(renderer(scene)["color"]).numpy() - (frozen(points)[0] * 255).round()
    ).max()
    calls: dict[str, Callable[[], object]] = {
        "`framework.freeze(run)(points)`": lambda: frozen(points),
        "`framework.load(run)(points)`": predicted,
        "`renderer=smplpix`, from a scene to linear RGB": lambda: renderer(scene),
    }
    times_by_name: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(LOOPS + 5):
        for name, call in calls.items():  # the calls alternate, so that other processes slow all of them
            start = time.process_time()
            call()
            times_by_name[name].append(1e3 * (time.process_time() - start))
    lines = [
        f"| {name} | {statistics.median(times[5:]):.1f} | {min(times[5:]):.1f} |"
        for name, times in times_by_name.items()
    ]
    return [
        "This table holds the processor time to compute one image in a loop on one thread. The last row of the table "
        "is the wall time of an image that the training run measured at its end.",
        "",
        "| way to predict | median, ms | shortest, ms |",
        "|---|---|---|",
        *lines,
        f"| latency of one sample, measured by the run | {results['latency_milliseconds']:.1f} | |",
        "",
        f"The images of `framework.freeze` and of `renderer=smplpix` differ by at most {largest_difference:g} of 255.",
    ]


def describe_training(run: str) -> str:
    """Return the encoders of a network, how they were trained, and the PSNR; the text continues a sentence."""
    description, _ = read_stored(run)
    results = json.loads((find_checkpoint(run).parent.parent / "results.json").read_text())
    journal = (find_checkpoint(run).parent.parent / "journal.jsonl").read_text().splitlines()
    epochs = 1 + max(json.loads(line).get("epoch") or 0 for line in journal)
    names = " + ".join(part["name"] for part in description.config["encoder"])
    return (
        f"the encoders {names}, trained for {epochs} epochs with `experiment={results['experiment']}`. For subjects "
        f"who are not in the training data, the PSNR is {results['psnr_db']:.1f} dB in the whole image and "
        f"{results['psnr_masked_db']:.1f} dB inside the subject."
    )


def report(run: str, file: Path) -> str:
    """Measure, save the figure, and return the page."""
    torch.set_num_threads(1)
    per_subject, covered = [], []
    for subject in SUBJECTS:
        images, scenes = walk(run, file, subject)
        changes, masks = differences(images, scenes)
        per_subject.append(changes)
        covered += [mask.float().mean().item() for mask in masks]
        if subject == SUBJECTS[0]:
            draw_figure(images, changes).savefig(Path(__file__).with_suffix(".png"), dpi=110)
    rows = summarise(per_subject)
    floor = rows["photograph"]["mean"]
    rate = rates(run, scenes[0])
    return "\n".join(
        [
            "# Temporal stability (flicker) of walking people (synthetic people)",
            "",
            "This page measures the temporal stability (flicker) of images of walking people: how much consecutive "
            "images differ after the known motion is removed. It compares renders of a mesh, images of a neural "
            "network (SMPLpix), and photographs. All people and photographs are synthetic.",
            "",
            f"The network SMPLpix consists of {describe_training(run)}",
            "",
            f"The images show {len(SUBJECTS)} generated people who are not in the training data and who walk; their "
            f"motion is read from the file `{file.name}`. There are {FRAMES} images of each person, at {SPEED} images "
            f"a second, with {scenes[0].camera.height} × {scenes[0].camera.width} pixels. The flicker is computed as "
            "follows. Each image is warped to the next one with bilinear interpolation. The optical flow for this "
            "warp is known exactly, because it is computed from the visible faces and barycentric weights of the "
            "registered mesh. The difference between the warped and the next image is then taken at pixels whose "
            "point is visible in both images and that are not near an outline. These are "
            f"{statistics.mean(covered):.1%} of a frame.",
            "",
            "In the table, `mean difference` is the difference between an image and the warped previous image, on the "
            "scale of 0 to 255 of sRGB values. It is a mean over the pixels that are visible in both images, over all "
            "pairs of images and over all people. `SD over people` shows by how much this mean differs from person to "
            "person. `95th percentile` is over the same pixels as the mean. The last column is the mean divided by the "
            "mean of the photographs. The rows `mesh` are renders of the registered mesh with 1 or 4 × 4 samples a "
            "pixel.",
            "",
            "The photographs show how much of the difference between consecutive images is present in true images. "
            "Interpolation blurs fine patterns, cloth moves differently from the registered body, and the light "
            "changes when the body turns. A mesh whose vertices have fixed colours shows less of all three. Its "
            "difference may therefore be smaller than the difference between photographs.",
            "",
            "| way to draw | mean difference | SD over people | 95th percentile | mean relative to photographs |",
            "|---|---|---|---|---|",
            *(
                f"| {name} | {row['mean']:.2f} | {row['spread']:.2f} | {row['high']:.1f} | {row['mean'] / floor:.2f} |"
                for name, row in rows.items()
            ),
            "",
            "![Images of the walk and their differences to the next image](smplpix_flicker.png)",
            "",
            "## Run time of the trained network",
            "",
            *rate,
            "",
            f"{machine('torch', 'numpy')} Command: `python -m benchmarks.rendering.smplpix_flicker <run> {file.name}`.",
            "",
        ]
    )


if __name__ == "__main__":
    write_page(__file__, report(sys.argv[1], Path(sys.argv[2])))
