"""Fit a body's pose to an image by gradient descent through the rasteriser, with three gradients and 100 images each.

    OMP_NUM_THREADS=1 python -m benchmarks.pose.fit_pose                 # all three gradients, about 50 minutes
    OMP_NUM_THREADS=1 python -m benchmarks.pose.fit_pose measure soft    # one gradient; results are stored in outputs/
    python -m benchmarks.pose.fit_pose report                            # table and figure of the stored results

The script writes fit_pose.md and fit_pose.png beside this file.
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
from benchmarks.rendering.builders import build_renderer
from framework.configuration.schema import build, resolve
from framework.figures.style import COLOURS, GREY, titled_figure
from framework.geometry.srgb import bytes_from_linear
from framework.heads.posed_body import scene_of
from plugins.data.pose_from_image.data import PoseFromImage
from plugins.density_head.fit_pose.descent import Descent
from plugins.metric.pose_error.metric import place_errors

HERE = Path(__file__)
STARTS = 100
STORED = Path("outputs/benchmarks/fit_pose")
GRADIENTS: dict[str, dict[str, Any]] = {
    "boundary": {"gradient": "boundary", "supersampling": 4},
    "nmr": {"gradient": "nmr", "supersampling": 4},
    "soft": {"gradient": "soft", "supersampling": 2},
}
"""Settings of the renderer by gradient. `soft` has fewer samples a pixel, because its image is smooth already and would
take four times as long with 4 × 4 samples."""
OPTIONS: dict[str, Any] = {"steps": 30, "restarts": 1, "enough": 0.003}
"""Default settings of the density head."""


def load_data() -> PoseFromImage:
    """Return the data set with the test images of this benchmark."""
    renderer_config = {"name": "rasterizer", "supersampling": 8}
    pose_data = build(
        "data", resolve("data", {"name": "pose_from_image", "renderer": renderer_config, "test": STARTS})
    )
    pose_data.prepare()
    return pose_data


def measure(gradient: str) -> None:
    """Fit the pose to every test image with one gradient, and store each result that is not stored yet."""
    torch.set_num_threads(1)
    source = load_data()
    test = source.splits().test
    descent = Descent(
        source.body_model,
        build_renderer("rasterizer", **GRADIENTS[gradient]),
        source.body_model.camera(*source.input_shape[1:]),
        **OPTIONS,
    )
    folder = STORED / gradient
    folder.mkdir(parents=True, exist_ok=True)
    descent(test[0]["input"].movedim(0, -1))  # compiles the functions, so that no measured fit has to
    for number in range(STARTS):
        file = folder / f"{number:03}.npz"
        if file.exists():
            continue
        sample = test[number]
        start_time = time.process_time()
        fit = descent(sample["input"].movedim(0, -1))
        seconds = time.process_time() - start_time
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


def read_results(gradient: str) -> list[dict[str, np.ndarray]]:
    """Return the stored results of a gradient, in the order of the test images."""
    return [dict(np.load(file)) for file in sorted((STORED / gradient).glob("*.npz"))]


def errors_by_step(sample: dict[str, np.ndarray]) -> tuple[Tensor, Tensor]:
    """Return the rotation error (degrees) and the translation error (cm) at the start and after each step."""
    path = torch.from_numpy(sample["path"])[:, 2:]
    numbers = torch.cat([path[:1] * 0, path])
    return place_errors(numbers, torch.from_numpy(sample["target"]).expand_as(numbers))


def final_errors(samples: list[dict[str, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rotation error (degrees), translation error (cm) and run time (s) at the end of every fit."""
    numbers, target = (
        torch.from_numpy(np.stack([sample[name] for sample in samples])) for name in ("numbers", "target")
    )
    degrees, centimetres = place_errors(numbers, target)
    return degrees.numpy(), centimetres.numpy(), np.array([float(sample["seconds"]) for sample in samples])


def table(results: dict[str, list[dict[str, np.ndarray]]]) -> list[str]:
    """Return the lines of the table."""
    head = ["gradient", "samples a pixel", "images", "fits within 2° and 1 cm"]
    head += [f"rotation error, {statistic}, °" for statistic in ("median", "95 %", "largest")]
    head += [f"translation error, {statistic}, cm" for statistic in ("median", "95 %", "largest")]
    head += ["median time, s", "longest time, s"]
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    for gradient, samples in results.items():
        degrees, centimetres, seconds = final_errors(samples)
        successes = int(((degrees <= 2) & (centimetres <= 1)).sum())
        side = GRADIENTS[gradient]["supersampling"]
        cells = [
            gradient,
            f"{side} × {side}",
            str(len(samples)),
            f"{successes} ({successes / len(samples):.0%})",
        ]
        for values in (degrees, centimetres):
            cells += [f"{number:.2f}" for number in np.quantile(values, [0.5, 0.95, 1])]
        cells += [f"{number:.1f}" for number in (np.median(seconds), seconds.max())]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def draw_figure(results: dict[str, list[dict[str, np.ndarray]]], start_index: int) -> None:
    """Save the figure.

    Its upper half shows the renders at the start, at the target and at the end of the fits to one image. Its lower half
    shows the median errors of all fits against steps and run time.
    """
    source = load_data()
    camera = source.body_model.camera(*source.input_shape[1:])
    fine = build_renderer("rasterizer", supersampling=8)

    def draw(numbers: np.ndarray) -> np.ndarray:
        scene = scene_of(source.body_model, torch.from_numpy(numbers).double(), camera)
        return bytes_from_linear(fine(scene)["color"][..., :3]).numpy()

    figure = titled_figure((13, 8.5), "A body fitted to its image from 30° and 20 cm off", True)
    halves = figure.subfigures(2, 1, height_ratios=(1, 1.05))
    assert isinstance(halves, np.ndarray)
    above, below = halves
    parameters_of = {"start": next(iter(results.values()))[start_index]["numbers"] * 0}
    parameters_of["target"] = next(iter(results.values()))[start_index]["target"]
    titles = {"start": "start", "target": "target"}
    for gradient, samples in results.items():
        degrees, centimetres, _ = final_errors(samples)
        parameters_of[gradient] = samples[start_index]["numbers"]
        titles[gradient] = f"end, {gradient}\n{degrees[start_index]:.2f}°, {centimetres[start_index]:.2f} cm"
    for axis, (name, numbers) in zip(
        above.subplots(1, len(parameters_of)), parameters_of.items(), strict=True
    ):
        axis.imshow(draw(numbers))
        axis.set_title(titles[name], fontsize=10)
        axis.set_axis_off()
    axes = below.subplots(1, 4)
    for (gradient, samples), colour in zip(results.items(), COLOURS, strict=False):
        paths = [errors_by_step(sample) for sample in samples]
        times = [np.concatenate([[0.0], sample["path"][:, 1]]) for sample in samples]
        for axis, error_index, x_axis in zip(
            axes, (0, 1, 0, 1), ("steps", "steps", "seconds", "seconds"), strict=True
        ):
            longest = max(len(sample) for sample in times) if x_axis == "steps" else max(map(max, times))
            x_values = np.arange(longest) if x_axis == "steps" else np.linspace(0, longest, 400)
            curves = []
            for path, seconds in zip(paths, times, strict=True):
                positions = np.arange(len(seconds)) if x_axis == "steps" else seconds
                index = (np.searchsorted(positions, x_values, side="right") - 1).clip(0)
                curves.append(path[error_index].numpy()[index])
            low, middle, high = np.quantile(np.stack(curves), [0.25, 0.5, 0.75], axis=0)
            axis.plot(x_values, middle, color=colour, label=f"{gradient}, {len(samples)} starts")
            axis.fill_between(x_values, low, high, color=colour, alpha=0.15, linewidth=0)
            axis.set_xlabel(x_axis)
            axis.set_ylabel(("rotation error, degrees", "translation error, cm")[error_index])
            axis.set_yscale("log")
            axis.axhline((2.0, 1.0)[error_index], color=GREY, linestyle=":")
            axis.grid(color=GREY, alpha=0.2)
    handles, labels = axes[0].get_legend_handles_labels()
    legend_title = "gradient of the rasteriser; lines: medians of the starts, bands: between quartiles"
    handles.append(Line2D([], [], color=GREY, linestyle=":"))
    labels.append("wanted: 2° and 1 cm")
    below.legend(
        handles, labels, loc="outside lower center", ncols=len(labels), title=legend_title, frameon=False
    )
    figure.savefig(HERE.with_suffix(".png"), dpi=110)


def report() -> None:
    results = {gradient: samples for gradient in GRADIENTS if (samples := read_results(gradient))}
    degrees, centimetres, _ = final_errors(results["boundary"][: min(map(len, results.values()))])
    typical = int(np.argsort(np.maximum(degrees / 2, centimetres))[len(degrees) // 2])
    text = [
        "# fit_pose: a body's pose by gradient descent through the rasteriser",
        "",
        "This page shows how well the pose of a body can be found from one image by gradient descent through a "
        "renderer. It compares three methods to compute the gradient of the rendered image. `boundary` includes the "
        "movement of the edges of faces (Li et al. 2018), `nmr` is an approximation (Kato et al. 2018), and `soft` "
        "is the exact gradient of a blurred image (Liu et al. 2019).",
        "",
        "The bodies are fitted to synthetic images. Each image shows the default body (13,718 vertices) with a "
        "random shape and a random pose, 128 × 96 pixels, with 8 × 8 samples a pixel. Every descent starts from the "
        "same nominal position. The true body is rotated from there by exactly 30° about a random axis and moved by "
        "20 cm in a random direction. The descent fits 30 parameters: rotation, translation, 20 movements of joints "
        "and 4 parameters of the shape. It is the gradient descent that the density head `fit_pose` uses. Its "
        "settings are the same for the three methods to compute the gradient (`boundary`, `nmr` and `soft`), and a "
        "descent may restart at most once.",
        "",
        "In the table, `samples a pixel` is the number of samples with which the descent renders its images. "
        "`images` is the number of images to which the body was fitted. There are 100 images; if the number is "
        "smaller, the first of these images were used. `fits within 2° and 1 cm` counts the fits whose rotation "
        "error is at most 2° and whose translation error is at most 1 cm. The following columns hold the median, the "
        "95 % quantile and the largest value of both errors. The last two columns hold the processor time of a fit.",
        "",
        *table(results),
        "",
        "The processor times of a fit, in seconds, were measured on one thread while other processes used the "
        "machine, which makes them longer. They do not include the compilation of the renderer.",
        "",
        f"![Start, target and end of the fits to image {typical}; errors against steps and time](fit_pose.png)",
        "",
        f"The upper half of the figure shows the fits of a body to image {typical}, whose error with the gradient "
        "`boundary` is the median of all images. The lower half shows the errors of the fitted pose during the "
        "descent: the medians as lines, and the range between the quartiles as bands. A restart appears as a jump.",
        "",
        f"{machine('torch', 'numba', 'numpy')} Command: `python -m benchmarks.pose.fit_pose`.",
        "",
    ]
    write_page(HERE, text)
    draw_figure(results, typical)


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        measure(sys.argv[2])
    elif sys.argv[1:2] == ["report"]:
        report()
    else:
        for name in GRADIENTS:
            measure(name)
        report()
