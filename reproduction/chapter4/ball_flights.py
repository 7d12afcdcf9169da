"""Compare physics, TVAE, LSTM and hybrid on simulated and recorded ball flights (thesis Figure 4.3).

    python -m reproduction.chapter4.ball_flights <folder of the laboratory's *.mat>
    python -m reproduction.chapter4.ball_flights --draw

Trains what is not yet in outputs/ball_flights, some ten minutes a method on one core, and writes ball_flights.md, .csv,
.png and ball_flights_bundle.png beside this file; `--draw` draws ball_flights.png again from the table. On recorded
flights networks start from the weights of the simulated ones; flights, not windows, are split, by the seed.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import framework
from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, read_rows, write_page
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.distributions.protocol import median
from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure
from framework.flights.frames import PARTS
from framework.prediction import Prediction
from framework.reports.table import Row, write_csv
from plugins.metric.flight_error.figure import draw_flight, draw_landing_places
from plugins.metric.flight_error.landing import ShownFlight
from plugins.metric.flight_error.metric import DRAWS, FlightError

HERE = Path(__file__).resolve()
RUNS = ROOT / "outputs" / "ball_flights"
METHODS = {"ballistic": "physics", "tvae": "TVAE", "lstm": "LSTM", "hybrid": "hybrid"}
SEEDS = (0, 1, 2, 3, 4)
SIMULATED = {"flights": 4000, "stride": 2}
BRIEF = (
    "optimizer.learning_rate=0.001",
    "optimizer.warmup_steps=20",
    "trainer.check_val_every_n_epoch=10",
)
EPOCHS = {"tvae": 600, "lstm": 150, "hybrid": 150}
"""Three steps each; the TVAE's validation loss falls for longer."""
MOST = 1000
"""Test windows that are looked at."""
BUNDLES = (0, 3, 5)
"""Of the windows that `FlightError` keeps for its figure, those drawn."""
AT = (1, 5, 10, 20, 35)
"""Frames of the table."""
Model = Any


class Measured(NamedTuple):
    """Mean error at each time (cm), `FlightError`'s numbers, and coverage of 90 % intervals before and after."""

    growth: np.ndarray
    numbers: dict[str, float]
    before: float
    after: float
    metric: FlightError


def trained(method: str, root: str | None, seed: int) -> Path:
    """The folder of a run, which is made unless it is there."""
    folder = RUNS / (f"{method}" if root is None else f"{method}_recorded_{seed}")
    if not (folder / "results.json").exists():
        further = [f"seed={seed}"]
        if root is not None:
            further += [f"data.root={root}", f"data.data_seed={seed}"]
            if method != "ballistic":
                further += [f"checkpoint={RUNS / method}", f"trainer.max_epochs={EPOCHS[method]}", *BRIEF]
        command = [sys.executable, "-m", "framework", f"experiment=table_tennis/{method}", "threads=1"]
        command += ["logger=none", "pictures=false", f"hydra.run.dir={folder}", *further]
        carry_out(command)
    return folder


def split_of(data: Data, name: str) -> dict[str, torch.Tensor]:
    """Evenly chosen windows."""
    fields = getattr(data.splits(), name).fields
    rows = torch.linspace(0, len(fields["input"]) - 1, min(MOST, len(fields["input"]))).round().long()
    return {key: value[rows] for key, value in fields.items()}


@torch.no_grad()
def ranks(model: Model, batch: dict[str, torch.Tensor]) -> tuple[Prediction, torch.Tensor]:
    """The prediction, and the share of draws below each recorded coordinate, (window, number)."""
    density = model(batch["input"])
    prediction = Prediction(density, batch, samples=200)
    drawn = density.sample((DRAWS,))
    return prediction, (drawn < batch["target"]).sum(0) / (DRAWS + 1)


def measured(model: Model, data: Data) -> Measured:
    """On the test split; intervals are calibrated on the validation split, for each coordinate and time by itself.

    The middle m of the draws holds 90 % of the validation windows' truths (distributional conformal prediction:
    Chernozhukov, Wüthrich & Zhu 2021), and so of the test's as far as windows are exchangeable.
    """
    torch.manual_seed(0)
    metric = FlightError(data.target)
    _, held = ranks(model, split_of(data, "validation"))
    prediction, found = ranks(model, split_of(data, "test"))
    metric.update(prediction)
    off = (held - 0.5).abs()
    rank = min(len(off), int(np.ceil(0.9 * (len(off) + 1)))) - 1
    reach = off.sort(0).values[rank]
    after = float(((found - 0.5).abs() <= reach).double().mean())
    numbers = {key: float(value) for key, value in metric.compute().items()}
    return Measured(metric.growth.numpy(), numbers, numbers["interval_90"], after, metric)


def latency(folder: Path, data: Data) -> str:
    """Median ms of one prediction with 30 draws in frozen form and in torch; the largest difference of the two."""
    model, form = framework.load(folder), framework.freeze(folder)
    inputs = split_of(data, "test")["input"]
    extreme = torch.cat(
        [inputs[:20], 1e3 * torch.randn(20, inputs.shape[1]), torch.zeros(2, inputs.shape[1])]
    )
    points = []
    for asked in (form.density, model):
        torch.manual_seed(0)
        with torch.no_grad():
            points.append(median(asked(extreme), 30))
    apart = float(((points[0] - points[1]).abs() / (1 + points[1].abs())).max())
    one = inputs[:1]
    taken = {}
    for name, asked in {"torch": model, "frozen": form.density}.items():
        times = []
        for _ in range(60):
            began = time.perf_counter()
            with torch.no_grad():
                asked(one).sample((30,))
            times.append(1e3 * (time.perf_counter() - began))
        taken[name] = statistics.median(times[10:])
    return f"{taken['frozen']:.2f} | {taken['torch']:.2f} | {apart:.0e}"


def prepared(root: str | None, seed: int = 0) -> Data:
    changes = SIMULATED if root is None else {"root": root, "stride": 2, "data_seed": seed}
    data = build("data", resolve("data", {"name": "table_tennis", **changes}))
    data.prepare()
    return data


def remembered(data: Data) -> np.ndarray:
    """Mean error at each time, cm, of the mean future of the five training windows that are most alike: where the ball
    was last, and its last frames from there."""

    def alike(fields: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        frames = fields["input"].unflatten(1, (-1, len(PARTS)))
        last = frames[:, -1:, 1:4]
        path = torch.where(frames[:, -8:, 4:] > 0.5, frames[:, -8:, 1:4] - last, 0.0)
        return last, torch.cat([last.flatten(1), 3 * path.flatten(1)], 1)

    known, asked = (getattr(data.splits(), name).fields for name in ("train", "test"))
    (last, place), (now, wanted) = alike(known), alike(asked)
    nearest = torch.cdist(wanted, place).topk(5, largest=False).indices
    ahead = known["target"].unflatten(1, (-1, 3)) - last
    off = now + ahead[nearest].mean(1) - asked["target"].unflatten(1, (-1, 3))
    return 100 * off.norm(dim=-1).mean(0).numpy()


def bouncing(data: Data) -> float:
    """Share of the test windows whose future holds a bounce: a lowest point between two frames."""
    rise = getattr(data.splits(), "test").fields["target"].unflatten(1, (-1, 3))[..., 2].diff(dim=1)  # noqa: B009
    return float(((rise[:, :-1] < 0) & (rise[:, 1:] > 0)).any(1).double().mean())


def table(found: dict[str, list[Measured]]) -> list[str]:
    moments = " | ".join(f"{16 * frame} ms" for frame in AT)
    lines = [
        f"| method | {moments} | mean | 90 % before | after | landing CRPS cm | landing in 90 % |",
        "|---|" + "---|" * (len(AT) + 5),
    ]
    for method, several in found.items():
        growth = np.mean([one.growth for one in several], 0)
        numbers = {key: np.nanmean([one.numbers[key] for one in several]) for key in several[0].numbers}
        cells = [f"{growth[frame - 1]:.2f}" for frame in AT] + [f"{growth.mean():.2f}"]
        cells += [
            f"{100 * np.mean([getattr(one, key) for one in several]):.1f}" for key in ("before", "after")
        ]
        cells += [f"{numbers['landing_crps_cm']:.2f}", f"{100 * numbers['landing_cover_90']:.1f}"]
        lines.append(f"| {METHODS[method]} | " + " | ".join(cells) + " |")
    return lines


def curves(flights: str, found: dict[str, list[Measured]]) -> Iterator[dict[str, object]]:
    """Rows of the table: each method's and seed's mean error at each time."""
    for method, several in found.items():
        for seed, one in zip(SEEDS, several, strict=False):
            for frame, error in enumerate(one.growth.tolist(), 1):
                yield {
                    "flights": flights,
                    "method": METHODS[method],
                    "seed": seed,
                    "milliseconds_ahead": 16 * frame,
                    "error_cm": error,
                }


def drawn(rows: Sequence[Row]) -> None:
    figure = titled_figure((10, 4.6), "Error of predicted flights against time into the future", False)
    flights = list(dict.fromkeys(str(row["flights"]) for row in rows))
    panels = figure.subplots(1, len(flights), squeeze=False)[0]
    for axes, kind in zip(panels, flights, strict=True):
        seeds = {row["seed"] for row in rows if row["flights"] == kind}
        for method, colour, marker in zip(METHODS.values(), COLOURS, MARKERS, strict=False):
            own = [row for row in rows if (row["flights"], row["method"]) == (kind, method)]
            times = sorted({int(str(row["milliseconds_ahead"])) for row in own})
            errors = np.array(
                [
                    [float(str(row["error_cm"])) for row in own if row["seed"] == seed]
                    for seed in SEEDS
                    if seed in seeds
                ]
            )
            mean = errors.mean(0)
            axes.plot(times, mean, color=colour, marker=marker, markevery=4, markersize=4, label=method)
            if len(seeds) > 1:
                spread = errors.std(0, ddof=1)
                axes.fill_between(times, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)
        several = f"mean of {len(seeds)} seeds, band: standard deviation" if len(seeds) > 1 else "one seed"
        axes.set_title(f"{kind}\n{several}", fontsize=10)
        axes.set(xlabel="time into the future (ms)", ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("mean distance from the ball (cm)")
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=len(METHODS),
        fontsize=9,
        frameon=False,
    )
    save_figure(figure, HERE.with_suffix(""), True)


def bundles(found: dict[str, Measured]) -> None:
    """The same windows by each method, in space, and where they land, in the same colours."""
    title = "30 drawn flights of three windows, and where all draws come down"
    figure = titled_figure((4 * len(found), 7.6), title, True)
    first = None
    for place, (method, one) in enumerate(found.items(), 1):
        space: Any = figure.add_subplot(2, len(found), place, projection="3d")
        shown: list[ShownFlight] = [one.metric.shown[number] for number in BUNDLES]
        for flight, color in zip(shown, COLOURS, strict=False):
            draw_flight(space, flight, color)
        space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        space.set_box_aspect((1, 2.2, 0.9), zoom=0.95)
        space.set(xlim=(-0.2, 1.0), ylim=(-4, 0.2), zlim=(-1.1, -0.2), xticks=[0, 0.8], yticks=[-3, -1])
        space.view_init(elev=18, azim=-35)
        space.set_title(f"{METHODS[method]}: seen (dots), true (black), drawn (thin)", fontsize=9)
        axes = figure.add_subplot(2, len(found), len(found) + place, sharex=first, sharey=first)
        first = first or axes
        draw_landing_places(axes, shown, one.metric.height)
        axes.set_aspect("equal", adjustable="box")
    figure.savefig(HERE.with_name("ball_flights_bundle.png"), dpi=110)


def main(root: str | None) -> None:
    torch.set_num_threads(1)
    data = prepared(None)
    simulated = {method: [measured(framework.load(trained(method, None, 0)), data)] for method in METHODS}
    recorded: dict[str, list[Measured]] = {}
    alike = ""
    if root is not None:
        sets = [prepared(root, seed) for seed in SEEDS]
        growth = np.mean([remembered(one) for one in sets], 0)
        alike = (
            f"{100 * np.mean([bouncing(one) for one in sets]):.0f} % of the test windows have a bounce ahead, "
            f"{100 * bouncing(data):.0f} % of the simulated ones. The flights are alike: the mean future of the five "
            "training windows that are nearest is "
            + ", ".join(f"{growth[frame - 1]:.1f} cm off at {16 * frame} ms" for frame in AT)
            + ". A network that reads places can remember them; physics, and what is told relative to a parabola, must "
            "find where each ball bounces, and how, from frames before it."
        )
        recorded = {
            method: [
                measured(framework.load(trained(method, root, seed)), one)
                for seed, one in zip(SEEDS, sets, strict=True)
            ]
            for method in METHODS
        }
    latencies = [f"| {METHODS[method]} | {latency(trained(method, None, 0), data)} |" for method in METHODS]
    write(simulated, recorded, latencies, alike)


def write(
    simulated: dict[str, list[Measured]],
    recorded: dict[str, list[Measured]],
    latencies: list[str],
    alike: str,
) -> None:
    """The page and both figures."""
    text = [
        "# Predicted ball flights: error against time", "",
        "![Error against time](ball_flights.png)", "",
        "The tables show the mean distance (cm) between the point prediction and the ball at several times into the "
        "future; the share (%) of recorded coordinates within 90 % intervals, before and after calibration on the "
        "validation windows; the continuous ranked probability score (CRPS) of the landing place; and the share (%) of "
        "true landing places within the ellipse that holds 90 %.", "",
        f"## Simulated flights (synthetic): 4,000, one seed, {MOST:,} test windows", "", *table(simulated), "",
        "The truth is the flight without noise. Physics is the model that simulated them, its constants found from "
        "training windows. The TVAE knows no physics; it is furthest behind where the ball has just bounced.", "",
        f"TVAE by physics: {ratios(simulated, 'tvae')}.", "",
        f"Hybrid by physics: {ratios(simulated, 'hybrid')}.", "",
        "![Drawn flights](ball_flights_bundle.png)", "",
        "A flight begins where the ball was seen last, and may come down before the first predicted frame. Learned "
        "densities put fewer than 90 % of the true places in their ellipse.", "",
    ]  # fmt: skip
    if recorded:
        text += [
            f"## Recorded flights: 40 long enough of 82, split by flight, {len(SEEDS)} seeds", "", *table(recorded), "",
            "28 flights train, 4 validate, 8 test. Networks start from the weights of the simulated flights and go on "
            f"for {EPOCHS['lstm']} epochs of three steps, the TVAE for {EPOCHS['tvae']}; physics finds its constants. "
            "The truth is the recording itself, noise and all.", "", alike, "",
        ]  # fmt: skip
    text += [
        "## Latency", "", "One prediction with 30 drawn flights on one core, median ms, and the largest relative "
        "difference of the point prediction between the two forms, extreme inputs included:", "",
        "| method | frozen | in torch | apart |", "|---|---|---|---|", *latencies, "",
        f"{machine('torch', 'numpy')} One thread. Command: `python -m reproduction.chapter4.ball_flights <folder>`.",
    ]  # fmt: skip
    write_page(HERE, text)
    rows = [
        row
        for kind, found in (
            ("simulated flights (synthetic)", simulated),
            ("recorded flights (WAM laboratory)", recorded),
        )
        for row in curves(kind, found)
    ]
    write_csv(rows, None, HERE.with_suffix(".csv"))
    drawn(rows)
    bundles({method: several[0] for method, several in simulated.items()})


def ratios(found: dict[str, list[Measured]], method: str) -> str:
    """Of errors, at some times, and the largest."""
    by = found[method][0].growth / found["ballistic"][0].growth
    frames = sorted({1, 2, 3, 4, *AT})
    said = ", ".join(f"{by[frame - 1]:.2f} at {16 * frame} ms" for frame in frames)
    return f"{said}; at most {by.max():.2f}, at {16 * (int(by.argmax()) + 1)} ms"


if __name__ == "__main__":
    if sys.argv[1:] == ["--draw"]:
        drawn(read_rows(HERE.with_suffix(".csv")))
    else:
        main(sys.argv[1] if len(sys.argv) > 1 else None)
