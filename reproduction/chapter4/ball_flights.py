"""Compare physics, TVAE, LSTM and hybrid on simulated and recorded ball flights (thesis Figure 4.3).

    python -m reproduction.chapter4.ball_flights <folder of the laboratory's *.mat files>
    python -m reproduction.chapter4.ball_flights --draw

The script trains the models that are not yet in outputs/ball_flights, which takes about ten minutes per method on one
core. It writes ball_flights.md, .csv, .png and ball_flights_bundle.png beside this file. `--draw` draws
ball_flights.png again from the table. For recorded flights the networks start from the weights that were trained on
simulated flights. The split is by flight, not by window, and depends on the seed.
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
from benchmarks.pages import machine, read_rows, run_or_draw, write_page
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
FINE_TUNING = (
    "optimizer.learning_rate=0.001",
    "optimizer.warmup_steps=20",
    "trainer.check_val_every_n_epoch=10",
)
EPOCHS = {"tvae": 600, "lstm": 150, "hybrid": 150}
"""Number of epochs of the training on recorded flights; an epoch has three steps.

The TVAE has more epochs, because its validation loss falls for longer.
"""
MOST_WINDOWS = 1000
"""Largest number of windows of a split that are evaluated."""
BUNDLES = (0, 3, 5)
"""Numbers of the windows that are drawn, among those that `FlightError` keeps for its figure."""
TABLE_FRAMES = (1, 5, 10, 20, 35)
"""Predicted frames, 16 ms apart, that have a column in the table."""
Model = Any


class FlightErrors(NamedTuple):
    """Results of a method on the test split.

    Attributes:
        growth: mean error at each predicted frame, cm.
        numbers: results of `FlightError`.
        before: coverage of the 90 % intervals before calibration.
        after: coverage of the 90 % intervals after calibration.
        metric: the metric, which holds the flights for the figures.
    """

    growth: np.ndarray
    numbers: dict[str, float]
    before: float
    after: float
    metric: FlightError


def train(method: str, root: str | None, seed: int) -> Path:
    """Return the folder of a run; train it first if the folder holds no results."""
    folder = RUNS / (f"{method}" if root is None else f"{method}_recorded_{seed}")
    if not (folder / "results.json").exists():
        further = [f"seed={seed}"]
        if root is not None:
            further += [f"data.root={root}", f"data.data_seed={seed}"]
            if method != "ballistic":
                further += [
                    f"checkpoint={RUNS / method}",
                    f"trainer.max_epochs={EPOCHS[method]}",
                    *FINE_TUNING,
                ]
        command = [sys.executable, "-m", "framework", f"experiment=table_tennis/{method}", "threads=1"]
        command += ["logger=none", "pictures=false", f"hydra.run.dir={folder}", *further]
        carry_out(command)
    return folder


def select_windows(data: Data, name: str) -> dict[str, torch.Tensor]:
    """Return at most `MOST_WINDOWS` windows of a split, evenly spaced."""
    fields = getattr(data.splits(), name).fields
    rows = torch.linspace(0, len(fields["input"]) - 1, min(MOST_WINDOWS, len(fields["input"]))).round().long()
    return {key: value[rows] for key, value in fields.items()}


@torch.no_grad()
def draw_ranks(model: Model, batch: dict[str, torch.Tensor]) -> tuple[Prediction, torch.Tensor]:
    """Return the prediction, and the share of its samples below each recorded coordinate, (window, coordinate)."""
    density = model(batch["input"])
    prediction = Prediction(density, batch, samples=200)
    draws = density.sample((DRAWS,))
    return prediction, (draws < batch["target"]).sum(0) / (DRAWS + 1)


def evaluate_flights(model: Model, data: Data) -> FlightErrors:
    """Evaluate a model on the test split, with intervals that are calibrated on the validation split.

    For each coordinate and frame, the calibrated interval is a central range of the samples. Its share of the samples
    is such that it holds the true value in 90 % of the validation windows (distributional conformal prediction:
    Chernozhukov, Wüthrich & Zhu 2021). It has the same coverage on the test split if windows are exchangeable.
    """
    torch.manual_seed(0)
    metric = FlightError(data.target)
    _, validation_ranks = draw_ranks(model, select_windows(data, "validation"))
    prediction, test_ranks = draw_ranks(model, select_windows(data, "test"))
    metric.update(prediction)
    deviation = (validation_ranks - 0.5).abs()
    rank = min(len(deviation), int(np.ceil(0.9 * (len(deviation) + 1)))) - 1
    half_width = deviation.sort(0).values[rank]
    after = float(((test_ranks - 0.5).abs() <= half_width).double().mean())
    numbers = {key: float(value) for key, value in metric.compute().items()}
    return FlightErrors(metric.growth.numpy(), numbers, numbers["interval_90"], after, metric)


def measure_latency(folder: Path, data: Data) -> str:
    """Return three cells of a table about one prediction with 30 samples.

    The cells are the median time, ms, of the frozen model (`framework.freeze`); the median time, ms, of the original
    model; and the largest relative difference of the medians that both predict.
    """
    model, frozen = framework.load(folder), framework.freeze(folder)
    inputs = select_windows(data, "test")["input"]
    extreme = torch.cat(
        [inputs[:20], 1e3 * torch.randn(20, inputs.shape[1]), torch.zeros(2, inputs.shape[1])]
    )
    points = []
    for predictor in (frozen.density, model):
        torch.manual_seed(0)
        with torch.no_grad():
            points.append(median(predictor(extreme), 30))
    difference = float(((points[0] - points[1]).abs() / (1 + points[1].abs())).max())
    first_input = inputs[:1]
    medians = {}
    for name, predictor in {"torch": model, "frozen": frozen.density}.items():
        times = []
        for _ in range(60):
            began = time.perf_counter()
            with torch.no_grad():
                predictor(first_input).sample((30,))
            times.append(1e3 * (time.perf_counter() - began))
        medians[name] = statistics.median(times[10:])
    return f"{medians['frozen']:.2f} | {medians['torch']:.2f} | {difference:.0e}"


def prepare_data(root: str | None, seed: int = 0) -> Data:
    changes = SIMULATED if root is None else {"root": root, "stride": 2, "data_seed": seed}
    data = build("data", resolve("data", {"name": "table_tennis", **changes}))
    data.prepare()
    return data


def nearest_window_errors(data: Data) -> np.ndarray:
    """Return the errors of a simple baseline that needs no training: the mean error at each predicted frame, cm.

    The baseline finds the five training windows that are nearest to a test window, and predicts the mean of their
    futures. Windows are compared by the last position of the ball and by the eight last positions relative to it.
    """

    def window_features(fields: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        frames = fields["input"].unflatten(1, (-1, len(PARTS)))
        train_last = frames[:, -1:, 1:4]
        path = torch.where(frames[:, -8:, 4:] > 0.5, frames[:, -8:, 1:4] - train_last, 0.0)
        return train_last, torch.cat([train_last.flatten(1), 3 * path.flatten(1)], 1)

    train_fields, test_fields = (getattr(data.splits(), name).fields for name in ("train", "test"))
    (train_last, train_features), (test_last, test_features) = (
        window_features(train_fields),
        window_features(test_fields),
    )
    nearest = torch.cdist(test_features, train_features).topk(5, largest=False).indices
    ahead = train_fields["target"].unflatten(1, (-1, 3)) - train_last
    error = test_last + ahead[nearest].mean(1) - test_fields["target"].unflatten(1, (-1, 3))
    return 100 * error.norm(dim=-1).mean(0).numpy()


def bounce_share(data: Data) -> float:
    """Return the share of test windows whose future has a bounce, which is a local minimum of the height."""
    rise = getattr(data.splits(), "test").fields["target"].unflatten(1, (-1, 3))[..., 2].diff(dim=1)  # noqa: B009
    return float(((rise[:, :-1] < 0) & (rise[:, 1:] > 0)).any(1).double().mean())


def error_table(results: dict[str, list[FlightErrors]]) -> list[str]:
    moments = " | ".join(f"error at {16 * frame} ms, cm" for frame in TABLE_FRAMES)
    lines = [
        f"| method | {moments} | mean error, cm | coverage before, % | coverage after, % | landing CRPS, cm | "
        "landing coverage, % |",
        "|---|" + "---|" * (len(TABLE_FRAMES) + 5),
    ]
    for method, several in results.items():
        growth = np.mean([result.growth for result in several], 0)
        numbers = {key: np.nanmean([result.numbers[key] for result in several]) for key in several[0].numbers}
        cells = [f"{growth[frame - 1]:.2f}" for frame in TABLE_FRAMES] + [f"{growth.mean():.2f}"]
        cells += [
            f"{100 * np.mean([getattr(result, key) for result in several]):.1f}"
            for key in ("before", "after")
        ]
        cells += [f"{numbers['landing_crps_cm']:.2f}", f"{100 * numbers['landing_cover_90']:.1f}"]
        lines.append(f"| {METHODS[method]} | " + " | ".join(cells) + " |")
    return lines


def error_rows(flights: str, results: dict[str, list[FlightErrors]]) -> Iterator[dict[str, object]]:
    """Yield the rows of the CSV file: the mean error of each method and seed at each frame.

    Args:
        flights: Kind of the flights, for the column of this name.
        results: Results of each method, one for each seed.
    """
    for method, several in results.items():
        for seed, result in zip(SEEDS, several, strict=False):
            for frame, error in enumerate(result.growth.tolist(), 1):
                yield {
                    "flights": flights,
                    "method": METHODS[method],
                    "seed": seed,
                    "milliseconds_ahead": 16 * frame,
                    "error_cm": error,
                }


def draw_errors(rows: Sequence[Row]) -> None:
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


def draw_bundles(results: dict[str, FlightErrors]) -> None:
    """Draw the same windows for each method: sampled flights in space, and landing places in the same colours."""
    title = "30 drawn flights of three windows, and where all draws come down"
    figure = titled_figure((4 * len(results), 7.6), title, True)
    first = None
    for place, (method, result) in enumerate(results.items(), 1):
        space: Any = figure.add_subplot(2, len(results), place, projection="3d")
        shown: list[ShownFlight] = [result.metric.shown[number] for number in BUNDLES]
        for flight, color in zip(shown, COLOURS, strict=False):
            draw_flight(space, flight, color)
        space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        space.set_box_aspect((1, 2.2, 0.9), zoom=0.95)
        space.set(xlim=(-0.2, 1.0), ylim=(-4, 0.2), zlim=(-1.1, -0.2), xticks=[0, 0.8], yticks=[-3, -1])
        space.view_init(elev=18, azim=-35)
        space.set_title(f"{METHODS[method]}: seen (dots), true (black), drawn (thin)", fontsize=9)
        axes = figure.add_subplot(2, len(results), len(results) + place, sharex=first, sharey=first)
        first = first or axes
        draw_landing_places(axes, shown, result.metric.height)
        axes.set_aspect("equal", adjustable="box")
    figure.savefig(HERE.with_name("ball_flights_bundle.png"), dpi=110)


def main(root: str | None) -> None:
    torch.set_num_threads(1)
    data = prepare_data(None)
    simulated = {
        method: [evaluate_flights(framework.load(train(method, None, 0)), data)] for method in METHODS
    }
    recorded: dict[str, list[FlightErrors]] = {}
    nearest_text = ""
    if root is not None:
        datasets = [prepare_data(root, seed) for seed in SEEDS]
        growth = np.mean([nearest_window_errors(dataset) for dataset in datasets], 0)
        nearest_text = (
            f"In {100 * np.mean([bounce_share(dataset) for dataset in datasets]):.0f} % of the recorded test windows "
            f"and "
            f"in {100 * bounce_share(data):.0f} % of the simulated ones, the ball bounces after the last observed "
            f"frame. "
            "The recorded flights are "
            "similar to each other. This is shown by a simple prediction, the mean future of the five training windows "
            "nearest to a test window: its error is "
            + ", ".join(f"{growth[frame - 1]:.1f} cm at {16 * frame} ms" for frame in TABLE_FRAMES)
            + ". A network that reads positions can memorise such flights. The physical model and the methods that "
            "predict relative to a parabola must infer from the observed frames where and how each ball bounces."
        )
        recorded = {
            method: [
                evaluate_flights(framework.load(train(method, root, seed)), dataset)
                for seed, dataset in zip(SEEDS, datasets, strict=True)
            ]
            for method in METHODS
        }
    latencies = [
        f"| {METHODS[method]} | {measure_latency(train(method, None, 0), data)} |" for method in METHODS
    ]
    write_results(simulated, recorded, latencies, nearest_text)


def write_results(
    simulated: dict[str, list[FlightErrors]],
    recorded: dict[str, list[FlightErrors]],
    latencies: list[str],
    nearest_text: str,
) -> None:
    """Write the page, the CSV file and both figures.

    Args:
        simulated: Results of each method on simulated flights.
        recorded: Results of each method on recorded flights, one for each seed.
        latencies: Rows of the table of run times.
        nearest_text: Text about the errors of `nearest_window_errors`.
    """
    text = [
        "# Predicted ball flights: error against time", "",
        "This page repeats Figure 4.3 of the thesis: four methods observe a table-tennis ball for some frames and "
        "predict its further flight. They are a physical model, a trajectory variational autoencoder (TVAE), a "
        "recurrent network (LSTM) and a hybrid of physics and network. The flights are either simulated or recorded "
        "with the cameras of a laboratory.", "",
        "![Error against time](ball_flights.png)", "",
        "The columns of the tables of predicted ball flights are:",
        "- **Error at 16 ms** and so on is the mean distance in cm between the predicted and the true position of "
        "the ball, 16 ms (and so on) after the last observed frame. **Mean error** averages over all predicted frames.",
        "- **Coverage before** and **coverage after** are the share in % of recorded coordinates that lie within the "
        "predicted 90 % intervals, before and after the intervals are calibrated on the validation windows. 90 is "
        "right.",
        "- **Landing CRPS** is the continuous ranked probability score of the landing place in cm; lower is better.",
        "- **Landing coverage** is the share in % of true landing places within the ellipse that holds 90 % of the "
        "sampled ones.", "",
        "## Simulated flights (synthetic)", "",
        "The data are 4,000 simulated flights. Each method is trained with one seed and tested on "
        f"{MOST_WINDOWS:,} windows.", "",
        *error_table(simulated), "",
        "For simulated flights, the error of a predicted flight is measured against the simulated flight without "
        "noise. The physical model has the form of the simulator, and its constants are estimated from the training "
        "windows. The TVAE contains no physics; it falls behind the physical model most where the ball has just "
        "bounced.", "",
        "For simulated flights, the error of the TVAE divided by the error of the physical model is "
        f"{error_ratios(simulated, 'tvae')}.", "",
        "For simulated flights, the error of the hybrid divided by the error of the physical model is "
        f"{error_ratios(simulated, 'hybrid')}.", "",
        "The next figure shows 30 sampled flights for each of three windows, and the places where all sampled flights "
        "land.", "",
        "![Sampled flights and landing places](ball_flights_bundle.png)", "",
        "For the landing place, a predicted flight begins at the last observed position of the ball, so it may land "
        "before the first predicted frame. The ellipses that hold 90 % of the sampled landing places of TVAE, LSTM "
        "and hybrid contain fewer than 90 % of the true landing places.", "",
    ]  # fmt: skip
    if recorded:
        text += [
            "## Recorded flights", "",
            "Of 82 recorded flights of a table-tennis ball, 40 are long enough: 28 are for training, 4 for "
            f"validation and 8 for the test. Each method is trained with {len(SEEDS)} seeds, and the seed also "
            "determines the split.", "",
            *error_table(recorded), "",
            "On recorded flights, the training of the networks starts from the weights that were trained on "
            f"simulated flights. The LSTM and the hybrid are then trained for {EPOCHS['lstm']} epochs of three steps, "
            f"and the TVAE for {EPOCHS['tvae']} such epochs. The physical model estimates its constants from the "
            "training windows. The error is measured against the recorded positions, which contain noise.", "",
            nearest_text, "",
        ]  # fmt: skip
    text += [
        "## Latency", "",
        "The table shows the median time of one prediction of a flight with 30 sampled flights, on one core, for the "
        "frozen model and for the model in torch. The last column is the largest relative difference between the "
        "point predictions of the two forms; the inputs include extreme values.", "",
        "| method | frozen, ms | torch, ms | largest relative difference |", "|---|---|---|---|", *latencies, "",
        f"{machine('torch', 'numpy')} One thread. Command: `python -m reproduction.chapter4.ball_flights <folder>`.",
    ]  # fmt: skip
    write_page(HERE, text)
    rows = [
        row
        for kind, results in (
            ("simulated flights (synthetic)", simulated),
            ("recorded flights (WAM laboratory)", recorded),
        )
        for row in error_rows(kind, results)
    ]
    write_csv(rows, None, HERE.with_suffix(".csv"))
    draw_errors(rows)
    draw_bundles({method: several[0] for method, several in simulated.items()})


def error_ratios(results: dict[str, list[FlightErrors]], method: str) -> str:
    """Return a text with the error of a method divided by the error of physics, at several predicted frames.

    The text ends with the largest ratio over all frames.
    """
    ratio = results[method][0].growth / results["ballistic"][0].growth
    frames = sorted({1, 2, 3, 4, *TABLE_FRAMES})
    text = ", ".join(f"{ratio[frame - 1]:.2f} at {16 * frame} ms" for frame in frames)
    return f"{text}. The largest ratio is {ratio.max():.2f}, at {16 * (int(ratio.argmax()) + 1)} ms"


if __name__ == "__main__":
    run_or_draw(
        lambda: main(sys.argv[1] if len(sys.argv) > 1 else None),
        lambda: draw_errors(read_rows(HERE.with_suffix(".csv"))),
    )
