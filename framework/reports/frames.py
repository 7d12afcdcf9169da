"""Report at the end of a run that draws scenes: the result table, results.json, and figures of frames."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8
from rich.console import Console
from torch import Tensor

from framework.errors import count_of
from framework.evaluation.cost import Cost
from framework.evaluation.rendering import Frame
from framework.evaluation.splits import Evaluation
from framework.geometry.srgb import bytes_from_linear
from framework.renderer import Report
from framework.reports.report import (
    print_last_lines,
    record_results,
    report_command,
    results_of,
    save_metric_figures,
    save_picture,
)
from framework.reports.table import COST_BETTER, COST_COLUMNS, Better, results_table
from framework.runs.run import Run

MOST_SHOWN = 6
"""Largest number of frames in the figure of frames."""
HEADINGS = {
    key: heading.replace("sample", "frame") for key, heading in COST_COLUMNS.items() if "sample" in heading
}
"""Headings of costs in a table of frames, which say "frame" in place of "sample"."""
Rendered = tuple[str, UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "_height _width 3"] | None]
"""A frame for the figure: its name, the drawn image, and the true image or None, in 8-bit sRGB."""


@dataclass
class Shown:
    """Frames that are kept for the figure: at most `MOST_SHOWN`, at equal steps.

    Attributes:
        count: number of frames of the run.
        frames: frames that are kept.
    """

    count: int
    frames: list[Rendered] = field(default_factory=list)

    def keep(self, index: int, frame: Frame, channels: Mapping[str, Tensor]) -> None:
        """Keep a frame if the figure shows it; `index` is the number of the frame in the run, from 0."""
        step = max(1, math.ceil(self.count / MOST_SHOWN))
        if index % step or "color" not in channels:
            return
        true = frame.truth.get("color")
        self.frames.append(
            (
                frame.name,
                bytes_from_linear(channels["color"].float()).numpy(),
                None if true is None else bytes_from_linear(true[0].float()).numpy(),
            )
        )


@dataclass(frozen=True)
class RenderResults:
    """Results of a run that draws scenes.

    Attributes:
        method: name of the renderer in tables.
        data: name of the scenes in tables.
        synthetic: whether the scenes were generated.
        evaluation: values of the metrics.
        cost: cost of a frame.
        shown: frames for the figure.
        report: the renderer's own report on the last frame; None if it keeps none.
    """

    method: str
    data: str
    synthetic: bool
    evaluation: Evaluation
    cost: Cost
    shown: Shown
    report: Report | None


def report_frames(run: Run, rendered: RenderResults, files: Sequence[str], console: Console) -> None:
    """Print the table, write results.json and the figures, and log the numbers.

    Args:
        run: the run, whose folder and tracker receive the results.
        rendered: the results.
        files: names of further files and folders in the run folder.
        console: console to print on.
    """
    metrics = rendered.evaluation.metrics
    columns = {key: heading for metric in metrics for key, heading in metric.columns.items()} | HEADINGS
    better: Better = {**{key: way for metric in metrics for key, way in metric.better.items()}, **COST_BETTER}
    results = results_of(
        run, rendered.method, rendered.data, rendered.evaluation, rendered.cost, columns, better
    )
    results |= {"synthetic": rendered.synthetic, "test_samples": rendered.shown.count}
    if rendered.report is not None:
        results["last_frame"] = _describe(rendered.report)
    record_results(run, results, rendered.evaluation, rendered.cost)
    rows = [
        results,
        *(
            {**results, **values, "method": f"  {name}"}
            for name, values in rendered.evaluation.groups.items()
        ),
    ]
    title = f"{rendered.data} · {rendered.method}"
    frames = count_of(rendered.shown.count, "frame")
    headings = {"method": "renderer", **columns, **COST_COLUMNS, **HEADINGS}
    console.print(results_table(rows, headings, title=f"{title}, {frames}"))
    if run.settings.pictures:
        if rendered.shown.frames:
            from framework.reports.frames_picture import frames_figure

            save_picture(
                run, frames_figure(rendered.shown.frames, title, synthetic=rendered.synthetic), "frames"
            )
        save_metric_figures(run, rendered.evaluation, title, synthetic=rendered.synthetic)
    existing = [
        name for name in ("figures", *files, "results.json", "citations.bib") if (run.folder / name).exists()
    ]
    left_out = [] if rendered.report is None else [f"last frame:    {_describe(rendered.report)['summary']}"]
    commands = [report_command(run), "and other renderers, true images, sweeps: docs/how_to/render.md"]
    print_last_lines(run, rendered.cost, existing, left_out, commands, console, unit="frame")


def _describe(report: Report) -> dict[str, Any]:
    """Return the renderer's report on an image as plain values."""
    left = ", ".join(f"{count} {reason}" for reason, count in report.left_out.items()) or "none"
    return {
        "faces": report.faces,
        "drawn_faces": report.drawn_faces,
        "left_out": dict(report.left_out),
        "summary": f"{report.drawn_faces} of {report.faces} faces drawn; left out: {left}",
    }
