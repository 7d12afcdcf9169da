"""Measure how much faster log-likelihoods are if the number of points is decided for each sample, at the same error.

    python -m benchmarks.densities.per_sample                        # measures all heads, then writes the page
    python -m benchmarks.densities.per_sample --only "scvae, 1 latent"   # measures one head, then writes the page

The heads `cvae` and `scvae` estimate an integral over a latent variable from a fixed number of points for all samples,
or they double the points of each sample until its estimated error is below a tolerance. Writes per_sample.csv,
per_sample.md and per_sample.png into the folder of this file, in about three minutes on an idle core.
"""

import argparse
import csv
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.ticker import NullFormatter
from torch import nn

from benchmarks.densities.latent import HEADS, integral, sample, set_knob, train
from benchmarks.pages import machine, publish
from framework.density_head import DensityHead
from framework.distributions.protocol import estimate
from framework.figures.style import BLUE, GREEN, save_figure, titled_figure

HERE = Path(__file__)
ITEMS, SEEDS, ROUNDS = 128, 5, 3
POINTS = (256, 512, 1024, 2048, 4096, 8192)
"""Fixed numbers of points; lattices are most accurate at powers of two."""
TOLERANCES = (0.03, 0.01, 0.003, 0.001, 0.0003)


class Row(NamedTuple):
    """Result of one head at one value of a knob.

    Attributes:
        method: head.
        knob: "samples", a fixed number of points, or "tolerance", nats.
        value: value of the knob.
        error: root mean square error of a log-likelihood over samples and seeds, nats.
        milliseconds: processor time per sample.
        points: mean number of points per sample.
    """

    method: str
    knob: str
    value: float
    error: float
    milliseconds: float
    points: float


def median_seconds(calls: Sequence[Callable[[], object]]) -> list[float]:
    """Return the median processor time of each call over interleaved rounds."""
    for call in calls:
        call()
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(ROUNDS):
        for number, call in enumerate(calls):
            start = time.process_time()
            call()
            times[number].append(time.process_time() - start)
    return [median(durations) for durations in times]


def cost_at(error: float, errors: Sequence[float], costs: Sequence[float]) -> float:
    """Return the cost at which a fixed number of points would reach an error, by interpolation of logarithms.

    It is NaN if the error is outside of the measured `errors`.
    """
    order = np.argsort(errors)
    known, cost = np.log(np.asarray(errors)[order]), np.log(np.asarray(costs)[order])
    if not known[0] <= math.log(error) <= known[-1]:
        return math.nan
    return float(np.exp(np.interp(math.log(error), known, cost)))


@torch.no_grad()
def measure_head(method: str, encoder: nn.Module, head: DensityHead) -> list[Row]:
    """Return the results of one head at all values of both knobs."""
    x, value = sample(ITEMS, 2)
    raw = encoder(x)
    double = head.double()
    truth = integral(double, raw.double(), value.double())
    head.float()
    rows: list[Row] = []
    settings = [("samples", float(points)) for points in POINTS] + [
        ("tolerance", tolerance) for tolerance in TOLERANCES
    ]

    def call(knob: str, setting: float) -> Callable[[], object]:
        def run() -> object:
            set_knob(head, knob, setting)
            return head(raw).log_prob(value)

        return run

    seconds = median_seconds([call(knob, setting) for knob, setting in settings])
    for (knob, setting), duration in zip(settings, seconds, strict=True):
        set_knob(head, knob, setting)
        errors, points = [], []
        for seed in range(SEEDS):
            torch.manual_seed(seed)
            result = estimate(head(raw), value)
            log_prob, _, _, samples, _ = result
            errors.append(log_prob.double() - truth)
            points.append(float(samples.double().mean()))
        rms = float(torch.stack(errors).square().mean().sqrt())
        rows.append(Row(method, knob, setting, rms, 1e3 * duration / ITEMS, float(np.mean(points))))
    return rows


def read_rows() -> list[Row]:
    """Return the results in per_sample.csv; none if the file does not exist."""
    path = HERE.with_suffix(".csv")
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [
            Row(line["method"], line["knob"], *(float(line[key]) for key in Row._fields[2:]))
            for line in csv.DictReader(file)
        ]


def write_rows(rows: Sequence[Row]) -> None:
    """Write the results to per_sample.csv."""
    with HERE.with_suffix(".csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        writer.writerows([row[0], row[1], *(f"{value:.4g}" for value in row[2:])] for row in rows)


def savings(rows: Sequence[Row], method: str) -> list[tuple[Row, float, float]]:
    """Return each row of a tolerance with the factors by which it saves processor time and points."""
    fixed = [row for row in rows if row.method == method and row.knob == "samples"]
    errors = [row.error for row in fixed]
    return [
        (
            row,
            cost_at(row.error, errors, [other.milliseconds for other in fixed]) / row.milliseconds,
            cost_at(row.error, errors, [other.points for other in fixed]) / row.points,
        )
        for row in rows
        if row.method == method and row.knob == "tolerance"
    ]


def draw(rows: Sequence[Row]) -> None:
    """Draw per_sample.png: error against processor time, with a panel for each head."""
    methods = list(dict.fromkeys(row.method for row in rows))
    figure = titled_figure((1.0 + 3.6 * len(methods), 3.8), "Points for all samples, or for each", True)
    panels = figure.subplots(1, len(methods), squeeze=False, sharey=True)[0]
    labels = {
        "samples": ("the same number of points for all samples", BLUE, "o"),
        "tolerance": ("points of each sample until a tolerance is met", GREEN, "^"),
    }
    for axes, method in zip(panels, methods, strict=True):
        for knob, (label, colour, marker) in labels.items():
            own = [row for row in rows if (row.method, row.knob) == (method, knob)]
            axes.plot(
                [row.milliseconds for row in own],
                [row.error for row in own],
                *(f"{marker}-",),
                color=colour,
                label=label,
            )
        axes.set(xscale="log", yscale="log", title=method, xlabel="ms per sample (processor time)")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("RMS error of a\nlog-likelihood (nats)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", frameon=False)
    save_figure(figure, HERE.with_suffix(""), "png")


def conclusion(rows: Sequence[Row]) -> str:
    """Return the sentences with the largest and the smallest saving of each head."""
    sentences = []
    for method in dict.fromkeys(row.method for row in rows):
        known = [saving for saving in savings(rows, method) if math.isfinite(saving[1])]
        if not known:
            continue
        best, worst = max(known, key=lambda saving: saving[1]), min(known, key=lambda saving: saving[1])
        sentences.append(
            f"For `{method}`, the tolerance is {worst[1]:.1f} to {best[1]:.1f} times as fast as a fixed number of "
            f"points with the same error; it is {best[1]:.1f} times as fast at an error of {best[0].error:.2g} nats."
        )
    return " ".join(sentences)


def compare_points(rows: Sequence[Row]) -> str:
    """Return the text that compares the errors with the fewest fixed points and with the largest tolerance."""
    parts = []
    for method in dict.fromkeys(row.method for row in rows):
        fixed = next(row for row in rows if row.method == method and row.knob == "samples")
        loosest = next(row for row in rows if row.method == method and row.knob == "tolerance")
        parts.append(
            f"the error of `{method}` is {fixed.error:.2g} nats with {fixed.points:.0f} fixed points and "
            f"{loosest.error:.2g} nats with {loosest.points:.0f} points on average and a tolerance"
        )
    return (
        "A tolerance uses other points too, with heavier tails, and a control variate. "
        f"This part of the saving is seen with the fewest points: {'; '.join(parts)}."
    )


def write_page(rows: Sequence[Row]) -> None:
    """Write per_sample.md and its figure."""
    draw(rows)
    lines = []
    for method in dict.fromkeys(row.method for row in rows):
        saved = {row: (f"{time:.1f}", f"{points:.1f}") for row, time, points in savings(rows, method)}
        for row in (row for row in rows if row.method == method):
            time, points = saved.get(row, ("", ""))
            cells = (f"{row.value:g}", f"{row.error:.2g}", f"{row.points:.0f}", f"{row.milliseconds:.3g}")
            lines.append(
                f"| {method} | {row.knob} | {' | '.join(cells)} | {time} | {points} |".replace(
                    "nan", "not known"
                )
            )
    table = "\n".join(lines)
    publish(
        __file__,
        PAGE.format(
            table=table,
            conclusion=f"{conclusion(rows)}\n\n{compare_points(rows)}",
            machine=machine("torch"),
            items=ITEMS,
            seeds=SEEDS,
            rounds=ROUNDS,
        ),
    )


PAGE = """# Effort for each sample

This page shows how much faster log-likelihoods with the same error are computed if the number of points is decided for
each sample.

    python -m benchmarks.densities.per_sample

The heads `cvae` and `scvae` estimate an integral over a latent variable z. They use the same number of points z for all
samples (`samples`), or they double the points of each sample until its estimated error is below `tolerance`. The data
are synthetic: they are the angle with two modes of the page [latent](latent.md). The heads are trained briefly, as on
that page. Errors are root mean squares over {items} test samples and {seeds} seeds of the difference from the integral
by quadrature. Times are processor times of one thread while other work ran on the machine, medians of {rounds}
interleaved rounds, in one batch of all test samples. The fixed numbers are powers of two, at which the points are most
accurate. *Time saved* is the time that a fixed number of points needs for the same error, divided by the time with the
tolerance. *Points saved* is the same quotient of the numbers of points. The results for fixed numbers are interpolated
in logarithms. "not known" stands for an error outside the range of these results.

{conclusion}

![Error against processor time with fixed numbers of points and with tolerances](per_sample.png)

*Error of a log-likelihood against the processor time (synthetic). Both are better if they are lower.*

| head | knob | value | RMS error, nats | points per sample | ms per sample | time saved, × | points saved, × |
|---|---|---:|---:|---:|---:|---:|---:|
{table}

{machine}
"""
"""Page of the results."""


def main() -> None:
    """Measure the heads and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(HEADS)[1:], default=list(HEADS)[1:])
    parser.add_argument("--page", action="store_true", help="only write the page, from per_sample.csv")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for method in () if options.page else options.only:
        others = [row for row in read_rows() if row.method != method]
        write_rows([*others, *measure_head(method, *train(HEADS[method]))])
    write_page(read_rows())


if __name__ == "__main__":
    main()
