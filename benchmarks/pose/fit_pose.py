"""Fit a body's pose to an image by gradient descent through the rasteriser, with three gradients and 100 starts each.

    OMP_NUM_THREADS=1 python -m benchmarks.pose.fit_pose                 # all three, some 50 minutes
    OMP_NUM_THREADS=1 python -m benchmarks.pose.fit_pose measure soft    # one of them; what is done is kept in outputs/
    python -m benchmarks.pose.fit_pose report                            # the table and the figure of what is there

Writes fit_pose.md and fit_pose.png beside this file.
"""

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.lines import Line2D
from torch import Tensor

from benchmarks.pages import machine, write_page
from framework.configuration.schema import build, resolve
from framework.figures.style import COLOURS, GREY, titled_figure
from framework.geometry.srgb import bytes_from_linear
from framework.heads.posed_body import scene_of
from framework.renderer import Renderer
from plugins.data.pose_from_image.data import PoseFromImage
from plugins.density_head.fit_pose.descent import Descent
from plugins.metric.pose_error.metric import place_errors

HERE = Path(__file__)
STARTS = 100
KEPT = Path("outputs/benchmarks/fit_pose")
GRADIENTS: dict[str, dict[str, Any]] = {
    "boundary": {"gradient": "boundary", "supersampling": 4},
    "nmr": {"gradient": "nmr", "supersampling": 4},
    "soft": {"gradient": "soft", "supersampling": 2},
}
"""An image of `soft` is smooth already; with 4 × 4 samples a pixel it takes four times as long."""
OPTIONS: dict[str, Any] = {"steps": 30, "restarts": 1, "enough": 0.003}
"""The head's own."""


def renderer(**config: object) -> Renderer:
    return build("renderer", resolve("renderer", {"name": "rasterizer", **config}))


def data() -> PoseFromImage:
    drawn_by = {"name": "rasterizer", "supersampling": 8}
    found = build("data", resolve("data", {"name": "pose_from_image", "renderer": drawn_by, "test": STARTS}))
    found.prepare()
    return found


def measure(gradient: str) -> None:
    torch.set_num_threads(1)
    source = data()
    test = source.splits().test
    descent = Descent(
        source.body_model,
        renderer(**GRADIENTS[gradient]),
        source.body_model.camera(*source.input_shape[1:]),
        **OPTIONS,
    )
    folder = KEPT / gradient
    folder.mkdir(parents=True, exist_ok=True)
    descent(test[0]["input"].movedim(0, -1))  # compiles what has to be
    for number in range(STARTS):
        file = folder / f"{number:03}.npz"
        if file.exists():
            continue
        sample = test[number]
        began = time.process_time()
        fit = descent(sample["input"].movedim(0, -1))
        seconds = time.process_time() - began
        np.savez(
            file,
            numbers=fit.parameters,
            path=fit.path,
            target=sample["target"],
            difference=fit.difference,
            seconds=seconds,
        )
        degrees, centimetres = place_errors(fit.parameters, sample["target"])
        sys.stdout.write(f"{gradient} {number}: {degrees:.2f}°, {centimetres:.2f} cm, {seconds:.1f} s\n")
        sys.stdout.flush()


def kept(gradient: str) -> list[dict[str, np.ndarray]]:
    """What was measured, in the order of the starts."""
    return [dict(np.load(file)) for file in sorted((KEPT / gradient).glob("*.npz"))]


def of_place(sample: dict[str, np.ndarray]) -> tuple[Tensor, Tensor]:
    """Degrees and centimetres after each step, the start first."""
    path = torch.from_numpy(sample["path"])[:, 2:]
    numbers = torch.cat([path[:1] * 0, path])
    return place_errors(numbers, torch.from_numpy(sample["target"]).expand_as(numbers))


def ended(samples: list[dict[str, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Degrees, centimetres and seconds of every start."""
    numbers, target = (
        torch.from_numpy(np.stack([one[name] for one in samples])) for name in ("numbers", "target")
    )
    degrees, centimetres = place_errors(numbers, target)
    return degrees.numpy(), centimetres.numpy(), np.array([float(one["seconds"]) for one in samples])


def table(results: dict[str, list[dict[str, np.ndarray]]]) -> list[str]:
    head = ("gradient", "samples a pixel", "starts", "within 2° and 1 cm")
    head += ("median °", "95 % °", "worst °", "median cm", "95 % cm", "worst cm", "median s", "worst s")
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    for gradient, samples in results.items():
        degrees, centimetres, seconds = ended(samples)
        found = int(((degrees <= 2) & (centimetres <= 1)).sum())
        side = GRADIENTS[gradient]["supersampling"]
        cells = [gradient, f"{side} × {side}", str(len(samples)), f"{found} ({found / len(samples):.0%})"]
        for values in (degrees, centimetres):
            cells += [f"{number:.2f}" for number in np.quantile(values, [0.5, 0.95, 1])]
        cells += [f"{number:.1f}" for number in (np.median(seconds), seconds.max())]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def picture(results: dict[str, list[dict[str, np.ndarray]]], number: int) -> None:
    """Above start, target and ends of one start; below the median errors of all, against steps and seconds."""
    source = data()
    camera = source.body_model.camera(*source.input_shape[1:])
    fine = renderer(supersampling=8)

    def drawn(numbers: np.ndarray) -> np.ndarray:
        scene = scene_of(source.body_model, torch.from_numpy(numbers).double(), camera)
        return bytes_from_linear(fine(scene)["color"][..., :3]).numpy()

    figure = titled_figure((13, 8.5), "A body fitted to its image from 30° and 20 cm off", True)
    halves = figure.subfigures(2, 1, height_ratios=(1, 1.05))
    assert isinstance(halves, np.ndarray)
    above, below = halves
    shown = {"start": next(iter(results.values()))[number]["numbers"] * 0}
    shown["target"] = next(iter(results.values()))[number]["target"]
    titles = {"start": "start", "target": "target"}
    for gradient, samples in results.items():
        degrees, centimetres, _ = ended(samples)
        shown[gradient] = samples[number]["numbers"]
        titles[gradient] = f"end, {gradient}\n{degrees[number]:.2f}°, {centimetres[number]:.2f} cm"
    for axis, (name, numbers) in zip(above.subplots(1, len(shown)), shown.items(), strict=True):
        axis.imshow(drawn(numbers))
        axis.set_title(titles[name], fontsize=10)
        axis.set_axis_off()
    axes = below.subplots(1, 4)
    for (gradient, samples), colour in zip(results.items(), COLOURS, strict=False):
        paths = [of_place(one) for one in samples]
        times = [np.concatenate([[0.0], one["path"][:, 1]]) for one in samples]
        for axis, which, against in zip(
            axes, (0, 1, 0, 1), ("steps", "steps", "seconds", "seconds"), strict=True
        ):
            longest = max(len(one) for one in times) if against == "steps" else max(map(max, times))
            at = np.arange(longest) if against == "steps" else np.linspace(0, longest, 400)
            curves = []
            for path, seconds in zip(paths, times, strict=True):
                places = np.arange(len(seconds)) if against == "steps" else seconds
                index = (np.searchsorted(places, at, side="right") - 1).clip(0)
                curves.append(path[which].numpy()[index])
            low, middle, high = np.quantile(np.stack(curves), [0.25, 0.5, 0.75], axis=0)
            axis.plot(at, middle, color=colour, label=f"{gradient}, {len(samples)} starts")
            axis.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
            axis.set_xlabel(against)
            axis.set_ylabel(("rotation error, degrees", "translation error, cm")[which])
            axis.set_yscale("log")
            axis.axhline((2.0, 1.0)[which], color=GREY, linestyle=":")
            axis.grid(color=GREY, alpha=0.2)
    handles, labels = axes[0].get_legend_handles_labels()
    said = "gradient of the rasteriser; lines: medians of the starts, bands: between quartiles"
    handles.append(Line2D([], [], color=GREY, linestyle=":"))
    labels.append("wanted: 2° and 1 cm")
    below.legend(handles, labels, loc="outside lower center", ncols=len(labels), title=said, frameon=False)
    figure.savefig(HERE.with_suffix(".png"), dpi=110)


def report() -> None:
    results = {gradient: found for gradient in GRADIENTS if (found := kept(gradient))}
    degrees, centimetres, _ = ended(results["boundary"][: min(map(len, results.values()))])
    typical = int(np.argsort(np.maximum(degrees / 2, centimetres))[len(degrees) // 2])
    text = [
        "# fit_pose: a body's pose by descent through the rasteriser",
        "",
        "Synthetic images of the default body (13,718 vertices), 128 × 96 pixels, drawn with 8 × 8 samples a pixel: "
        "a person of random shape in a random pose, turned by exactly 30° about a random axis and moved by 20 cm in a "
        "random direction from where every descent starts. 30 numbers are fitted: rotation, translation, 20 movements "
        "of joints, 4 of shape. `density_head=fit_pose`, the same settings for every gradient; at most one restart.",
        "",
        *table(results),
        "",
        "Seconds are processor time of one thread on a machine that others used at the same time, which makes them "
        "longer; compiling is not in them. Where there are fewer than 100 starts they are the first ones.",
        "",
        f"![Start, target and ends of start {typical}; errors against steps and seconds](fit_pose.png)",
        "",
        f"Above: start {typical}, the middle one of `boundary`. Below: medians, and between quartiles, of the errors; "
        "a second try shows as a jump.",
        "",
        f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.pose.fit_pose`.",
        "",
    ]
    write_page(HERE, text)
    picture(results, typical)


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        measure(sys.argv[2])
    elif sys.argv[1:2] == ["report"]:
        report()
    else:
        for name in GRADIENTS:
            measure(name)
        report()
