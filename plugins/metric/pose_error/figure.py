"""Figures of fitted poses: images at the start, at the target and at the end of a fit, and curves of the errors."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from framework.figures.style import COLOURS, GREY, titled_figure
from framework.geometry.srgb import bytes_from_linear
from plugins.metric.pose_error.errors import FittedImage


def draw_descents(samples: Mapping[str, FittedImage], title: str, *, synthetic: bool) -> Figure:
    """Return a figure with a row for each sample: images of start, target and end, a difference, and error curves.

    The difference image shows the absolute difference of end and target. The curves show the errors against steps.
    """
    figure = titled_figure((11.0, 3.2 * len(samples)), title, synthetic)
    axes = figure.subplots(len(samples), 5, squeeze=False, width_ratios=(1, 1, 1, 1, 2.2))
    for row, (name, sample) in zip(axes, samples.items(), strict=True):
        gap = (sample.end - sample.target).abs()
        images = {"start": sample.start, "target": sample.target, "end": sample.end, "|end - target|": gap}
        for axis, (label, image) in zip(row, images.items(), strict=False):
            axis.imshow(bytes_from_linear(image).numpy())
            axis.set_title(label)
            axis.set_axis_off()
        row[0].set_title(f"{name}: start")
        row[2].set_title(f"end: {sample.degrees:.2g}°, {sample.centimetres:.2g} cm")
        draw_error_curves(row[4], sample.path)
    return figure


def draw_error_curves(axis: Axes, path: Float[Tensor, "step 4"]) -> None:
    """Plot the errors in degrees and centimetres after each step; `path` is that of a `FittedImage`."""
    for column, (name, colour, near) in enumerate(
        (("rotation, degrees", COLOURS[0], 2.0), ("translation, cm", COLOURS[1], 1.0)), start=2
    ):
        axis.plot(np.arange(1, len(path) + 1), path[:, column].clamp(min=1e-3), color=colour, label=name)
        axis.axhline(near, color=colour, linestyle=":", linewidth=1)
    axis.set_yscale("log")
    axis.set_xlabel("steps")
    axis.set_title("error" + (f"; {path[-1, 1]:.1f} s" if len(path) else ""))
    axis.legend(loc="upper right", fontsize=8)
    axis.grid(color=GREY, alpha=0.2)


def draw_errors(degrees_and_centimetres: Float[Tensor, "sample 2"], title: str, *, synthetic: bool) -> Figure:
    """Return a figure of the rotation error and the translation error of every sample.

    The figure is for predictions that do not store the steps of their fit.
    """
    figure = titled_figure((5.0, 4.2), title, synthetic)
    axis = figure.subplots()
    degrees, centimetres = degrees_and_centimetres.clamp(min=1e-3).T
    axis.loglog(degrees, centimetres, "o", color=COLOURS[0], alpha=0.6)
    axis.set_xlabel("rotation, degrees")
    axis.set_ylabel("translation, cm")
    axis.axvline(2.0, color=GREY, linestyle=":")
    axis.axhline(1.0, color=GREY, linestyle=":")
    return figure
