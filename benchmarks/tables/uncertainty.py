"""Compare wrappers and heads for uncertainty by error against run time, on UCI tables and on moons with outliers.

    python -m benchmarks.tables.uncertainty measure /path/to/uci concrete     # 3 splits; likewise yacht and moons
    python -m benchmarks.tables.uncertainty page                              # writes uncertainty.md and its figure

The files of the sets are those of `plugins/data/tabular` (data=uci). `measure` trains all methods by one short loop,
and writes one line for each run and value of the method's knob into uncertainty_runs.csv. Measure on an idle machine.
"""

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

from benchmarks.pages import machine, publish, read_rows
from framework.reports.table import write_csv

SETS = ("concrete", "yacht", "moons")
"""Sets; the first two are real, with standard splits, and the moons are generated."""
RUNS = (0, 1, 2)
"""Standard splits of the real sets, and seeds of the moons."""
STEPS, BATCH, RATE, DECAY, WIDTH = 1000, 32, 5e-3, 1e-4, 50
METHODS: dict[str, dict[str, Any]] = {
    "one model": {},
    "mc_dropout": {"uncertainty": ["mc_dropout"], "dropout": 0.05},
    "ensemble": {"uncertainty": ["ensemble"]},
    "batch_ensemble": {"uncertainty": ["batch_ensemble"]},
    "laplace": {"uncertainty": ["laplace"]},
    "laplace, validation": {"uncertainty": ["laplace"], "laplace": {"prior_precision": "validation"}},
    "laplace in ensemble": {"uncertainty": ["laplace", "ensemble"]},
    "swag": {"uncertainty": ["swag"], "constant": True},
    "temperature": {"uncertainty": ["temperature"]},
    "platt": {"uncertainty": ["platt"]},
    "balance 0.5": {"head": {"name": "gaussian", "balance": 0.5}},
    "evidential": {"head": {"name": "evidential"}},
    "student_t": {"head": {"name": "student_t"}},
    "quantiles": {"head": {"name": "quantiles"}},
    "distilled": {"teacher": "ensemble"},
}
"""Methods by name: wrappers, innermost first, and what differs from one Gaussian network (`train`)."""
CLASSES_ONLY = ("platt",)
"""Methods that are for classes only."""
COVERAGE = 0.8
"""Share of the most confident test samples whose error is in the tables."""
TEACHER_WEIGHT, TEACHER_DRAWS = 9.0, 16
"""Weight of the divergence from the teacher, and number of its draws, as in objective=[distillation]."""
KNOBS = {
    "mc_dropout": ("samples", (1, 3, 10, 30)),
    "laplace": ("samples", (1, 3, 10, 30)),
    "laplace, validation": ("samples", (1, 3, 10, 30)),
    "swag": ("samples", (1, 3, 10, 30)),
    "ensemble": ("members", (1, 2, 3, 5)),
    "batch_ensemble": ("members", (1, 2, 3, 5)),
    "laplace in ensemble": ("members", (1, 2, 3, 5)),
}
"""Knob of each method, and the values that are measured."""
ROWS, ROUNDS = 1000, 5
"""Number of rows of a timed prediction, and how often it is repeated."""
TABLE = Path(__file__).with_name("uncertainty_runs.csv")
FIGURE = Path(__file__).with_name("uncertainty.png")


def load_data(root: Path, name: str, run: int) -> tuple[Any, dict[str, Any]]:
    """Return a data set, prepared, and one batch with all samples of each of its splits and of the outliers."""
    from framework.configuration.schema import build, resolve
    from framework.datasets.fields import fetch

    real = {"name": "uci", "root": str(root), "set": name, "split": run}
    chosen = {"name": "moons", "data_seed": run, "test": 2000} if name == "moons" else real
    data = build("data", resolve("data", chosen))
    data.prepare()
    splits = data.splits()
    batches = {part: fetch(samples, range(len(samples))) for part, samples in splits._asdict().items()}
    if name == "moons":
        outliers = build("data", resolve("data", {"name": "moons_outliers", "data_seed": run}))
        outliers.prepare()
        samples = outliers.splits().test
        batches["outliers"] = fetch(samples, range(len(samples)))
    return data, batches


def train(data: Any, batches: dict[str, Any], method: dict[str, Any], seed: int) -> Any:
    """Return the trained and calibrated predictor of a method.

    All methods train a network of one layer by AdamW, for the same number of steps, with a cosine schedule or a
    constant rate, and keep the last weights.
    """
    import torch

    from framework.configuration.assembly import build_predictor
    from framework.configuration.schema import resolve
    from framework.uncertainty import FollowsTraining, reading_training
    from plugins.objective.distillation.divergence import from_teacher

    teacher = train(data, batches, METHODS[method["teacher"]], seed) if "teacher" in method else None
    default = {"name": "bernoulli" if data.target.kind == "class" else "gaussian"}
    encoder = {"name": "mlp", "widths": [WIDTH], "dropout": method.get("dropout", 0.0)}
    wrappers = [{"name": name, **method.get(name, {})} for name in method.get("uncertainty", [])]
    parts = {
        "encoder": [resolve("encoder", encoder)],
        "density_head": resolve("density_head", method.get("head", default)),
        "uncertainty": [resolve("uncertainty", wrapper) for wrapper in wrappers],
    }
    predictor = build_predictor(parts, data.target, data.input_shape, seed)
    followers = [module for module in predictor.modules() if isinstance(module, FollowsTraining)]
    optimizer = torch.optim.AdamW(predictor.parameters(), lr=RATE, weight_decay=DECAY, fused=True)
    inputs, target = batches["train"]["input"], batches["train"]["target"]
    size = min(BATCH, len(inputs))
    epoch_steps = len(inputs) // size
    epochs = math.ceil(STEPS / epoch_steps)
    predictor.train()
    for epoch in range(epochs):
        order = torch.randperm(len(inputs))
        for step in range(epoch_steps):
            share = (epoch * epoch_steps + step) / (epochs * epoch_steps)
            rate = RATE if method.get("constant") else RATE * (1 + math.cos(math.pi * share)) / 2
            optimizer.param_groups[0]["lr"] = rate
            rows = order[step * size : (step + 1) * size]
            optimizer.zero_grad()
            loss = predictor.loss(inputs[rows], target[rows]).mean()
            if teacher is not None:
                with torch.no_grad():
                    taught = teacher(inputs[rows])
                student = predictor.training_densities(inputs[rows])
                loss = loss + TEACHER_WEIGHT * from_teacher(taught, student, TEACHER_DRAWS).mean()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(predictor.parameters(), 1.0)
            optimizer.step()
        for follower in followers:
            follower.after_epoch(epoch, epochs)
    predictor.eval()
    with reading_training(predictor, [batches["train"]]):
        predictor.calibrate([batches["validation"]])
    return predictor


def measure(root: Path, name: str, runs: Sequence[int], methods: Sequence[str]) -> None:
    """Record error and processor time of methods on a set, for each value of the knob, in place of old records."""
    import torch

    torch.set_num_threads(1)
    old = read_rows(TABLE) if TABLE.exists() else []
    rows: list[dict[str, Any]] = [
        row for row in old if row["data"] != name or row["run"] not in runs or row["method"] not in methods
    ]
    for run in runs:
        data, batches = load_data(root, name, run)
        for label in methods:
            if (name == "moons" and "head" in METHODS[label]) or (name != "moons" and label in CLASSES_ONLY):
                continue  # the heads are for real numbers
            predictor = train(data, batches, METHODS[label], run)
            rows += [
                {"data": name, "method": label, "run": run, **row} for row in test(predictor, batches, label)
            ]
    write_csv(rows, None, TABLE)


def test(predictor: Any, batches: dict[str, Any], label: str) -> Iterator[dict[str, float]]:
    """Yield log-likelihood, processor time and, with outliers, AUROCs for each value of the method's knob."""
    import torch

    from framework.distributions.model_mixtures import expected_entropy
    from framework.prediction import Prediction
    from plugins.metric.out_of_distribution.metric import ranking
    from plugins.metric.risk_coverage.functional import at_coverage
    from plugins.metric.risk_coverage.functional import curve as risk_curve

    knob, values = KNOBS.get(label, ("", (0,)))
    owner = next((module for module in predictor.modules() if knob and hasattr(module, knob)), None)
    batch = batches["test"]
    inputs = batch["input"].repeat(ROWS // len(batch["input"]) + 1, 1)[:ROWS]
    for value in values:
        if owner is not None:
            setattr(owner, knob, value)
        with torch.no_grad():
            torch.manual_seed(0)
            density = predictor(batch["input"])
            row = {"knob": value, "log_likelihood": density.log_prob(batch["target"]).mean().item()}
            prediction = Prediction(density, batch)
            if "outliers" in batches:
                risk = (prediction.point != batch["target"]).double()
            else:
                risk = (prediction.point - batch["target"]).abs().mean(-1)
            row["selected_risk"] = at_coverage(risk_curve(-prediction.entropy, risk), COVERAGE).item()
            row["risk"] = risk.mean().item()
            if "outliers" in batches:
                parts = [predictor(batches["outliers"]["input"]), density]
                entropies = [part.entropy().double() for part in parts]
                row["auroc"] = ranking(*entropies)["auroc"].item()
                if value > 1:  # several models
                    expected = [expected_entropy(part).double() for part in parts]
                    shared = [entropy - part for entropy, part in zip(entropies, expected, strict=True)]
                    row["mutual_information_auroc"] = ranking(*shared)["auroc"].item()
            labels = batch["target"].repeat(
                ROWS // len(batch["input"]) + 1, *[1] * (batch["target"].dim() - 1)
            )[:ROWS]
            times = []
            for _ in range(ROUNDS):
                start = time.process_time()
                predictor(inputs).log_prob(labels)
                times.append((time.process_time() - start) / ROWS * 1e6)
        yield {**row, "microseconds": median(times)}


def page() -> None:
    """Write the page and its figure from the recorded runs."""
    rows = read_rows(TABLE)
    draw_figure(rows)
    lines = [
        "# Wrappers and heads for uncertainty",
        "",
        "This page compares uncertainty wrappers and heads of this project by error against run time, on the *real* "
        f"UCI tables concrete and yacht (standard splits {', '.join(map(str, RUNS))}) and on the *synthetic* moons "
        f"with outliers (seeds {', '.join(map(str, RUNS))}). All methods train one layer of {WIDTH} units for {STEPS} "
        f"steps of {BATCH} samples by AdamW (learning rate {RATE:g}, weight decay {DECAY:g}), with a cosine schedule; "
        f"only swag has a constant learning rate, because it needs one. The weights after the last step are "
        "tested. For the tables, the density head is `gaussian`, unless the method is itself a head: `evidential`, "
        "`student_t`, `quantiles`, or `balance 0.5`, which is `gaussian` trained by the β-NLL with β = 0.5. For the "
        "moons, the head is `bernoulli`. `distilled` is one network that learns from the five networks of `ensemble`, "
        "with the divergence of `objective=[distillation]` and its default weight. No setting was tuned for any "
        "method. `platt` is for classes only. With three runs, differences below two standard errors mean nothing.",
        "",
        "![Log-likelihood against processor time](uncertainty.png)",
        "",
        "The figure shows the gain of each method, as a mean over the runs: its log-likelihood minus that of one model "
        "without any method in the same run. The tables give standard errors. A method has one point for each value of "
        "its knob: the number of draws of the weights or of dropout masks (1, 3, 10, 30), or of members (1, 2, 3, 5). "
        "Times are processor times of the density and the log-likelihood of a "
        f"row, in a batch of {ROWS} rows on one thread, as the median of {ROUNDS} repetitions; differences below "
        "a factor of two between methods without a knob are noise. Frozen and exported models are faster.",
        "",
        "## Which method wins at which run time",
        "",
        "Each line of the list is for one data set. It names the methods in the order of their run time per row, from "
        "the fastest on. A method is named only if its log-likelihood is higher than that of every faster method, and "
        "its gain over one model is larger than two of its standard errors. The gain, in nats, is in brackets, for the "
        "smallest and the largest value of the knob that is better than all faster methods.",
        "",
        *[winners(rows, name) for name in SETS],
    ]
    for name in SETS:
        lines += [
            "",
            f"## {name} ({'synthetic' if name == 'moons' else 'real'})",
            "",
            *table_of_set(rows, name),
        ]
    lines += [
        "",
        f"The last error of a row is that of selective prediction: the {1 - COVERAGE:.0%} of the test samples with the "
        "largest predictive entropy are left out. A method whose entropy orders its mistakes well has a lower error "
        "there. It is a mean absolute error in the unit of the table, or for the moons the share of wrong classes.",
        "",
        "The outliers of the moons lie far from both classes, on one side. AUROC is that of the entropy or of the "
        "mutual information of class and model as a score, where there are several models; 0.5 is chance, and 0 says "
        "that the outliers are predicted more confidently than the test samples.",
        "",
        f"{machine('torch')} Command: the lines at the top of `benchmarks/tables/uncertainty.py`. Other programs used "
        "the machine at the same time.",
        "",
    ]
    publish(__file__, "\n".join(lines))


def curve(rows: list[dict[str, Any]], name: str, method: str) -> list[dict[str, float]]:
    """Return means of a method on a set for each knob value, in ascending order of the value.

    Each holds the log-likelihood and its standard error, the gain over one model and the standard error of this paired
    difference, the time, and the AUROC of entropy and mutual information (NaN without outliers or for one model).
    """
    plain = (name, "one model")
    base = {row["run"]: row["log_likelihood"] for row in rows if (row["data"], row["method"]) == plain}
    own = [row for row in rows if (row["data"], row["method"]) == (name, method)]
    points = []
    for value in sorted({row["knob"] for row in own}):
        part = [row for row in own if row["knob"] == value]
        values = [row["log_likelihood"] for row in part]
        gains = [row["log_likelihood"] - base[row["run"]] for row in part]
        root = len(part) ** 0.5
        points.append(
            {
                "value": mean(values),
                "error": stdev(values) / root,
                "gain": mean(gains),
                "gain_error": stdev(gains) / root,
                "time": mean(row["microseconds"] for row in part),
                "auroc": mean(row.get("auroc", math.nan) for row in part),
                "shared": mean(row.get("mutual_information_auroc", math.nan) for row in part),
                "risk": mean(row["risk"] for row in part),
                "selected": mean(row["selected_risk"] for row in part),
                "selected_error": stdev(row["selected_risk"] for row in part) / root,
            }
        )
    return points


def table_of_set(rows: list[dict[str, Any]], name: str) -> list[str]:
    """Return the lines of the table of a set: each method at the largest value of its knob, the best first."""
    lines: list[tuple[float, str]] = []
    for method in METHODS:
        points = curve(rows, name, method)
        if not points:
            continue
        last = points[-1]
        gain = f"{last['gain']:+.3f} ± {last['gain_error']:.3f}" if method != "one model" else ""
        cells = [method, f"{last['value']:.3f} ± {last['error']:.3f}", gain, f"{last['time']:.2f}"]
        cells += [f"{last['risk']:.3f}", f"{last['selected']:.3f} ± {last['selected_error']:.3f}"]
        if name == "moons":
            cells += [f"{last['auroc']:.3f}", "" if math.isnan(last["shared"]) else f"{last['shared']:.3f}"]
        lines.append((last["value"], f"| {' | '.join(cells)} |"))
    columns = ["method", "log-likelihood, nats", "gain over one model, paired", "µs / row"]
    risk = "error rate" if name == "moons" else "absolute error"
    columns += [risk, f"{risk}, most confident {COVERAGE:.0%}"]
    columns += ["AUROC, entropy", "AUROC, mutual information"] if name == "moons" else []
    head = [f"| {' | '.join(columns)} |", f"|---|{'---:|' * (len(columns) - 1)}"]
    return [*head, *(line for _, line in sorted(lines, reverse=True))]


def winners(rows: list[dict[str, Any]], name: str) -> str:
    """Return a sentence on the methods that no faster method beats, and that gain over one model, from the fastest.

    A gain counts if it is larger than two of its standard errors.
    """
    points = [
        (point["time"], point["gain"], method)
        for method in METHODS
        for point in curve(rows, name, method)
        if point["gain"] > 2 * point["gain_error"]
    ]
    best = 0.0
    steps: list[tuple[str, float, float, float, float]] = []  # method, and first and last time and gain
    for duration, gain, method in sorted(points):
        if gain > best:
            best = gain
            if steps and steps[-1][0] == method:
                steps[-1] = (*steps[-1][:3], duration, gain)
            else:
                steps.append((method, duration, gain, duration, gain))
    parts = [
        f"from {first:.2g} µs {method} ({low:+.3f}"
        + (f", and {high:+.3f} from {last:.2g} µs on)" if last > first else ")")
        for method, first, low, last, high in steps
    ]
    return f"- {name}: {', '.join(parts) or 'none'}."


def draw_figure(rows: list[dict[str, Any]]) -> None:
    """Draw the gain in log-likelihood over one model against processor time, with one panel for each set."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FuncFormatter

    from framework.figures.style import COLOURS, MARKERS, save_figure, titled_figure

    title = "Uncertainty: gain in log-likelihood against run time (real: concrete, yacht; synthetic: moons)"
    figure = titled_figure((14, 5), title, False)
    panels = figure.subplots(1, len(SETS))
    handles = []
    for number, method in enumerate(METHODS):
        style: dict[str, Any] = {
            "color": COLOURS[number % len(COLOURS)],
            "marker": MARKERS[number % len(MARKERS)],
            "ls": "-" if number < len(COLOURS) else "--",
        }
        handles.append(Line2D([], [], label=method, **style))
        for panel, name in zip(panels, SETS, strict=True):
            points = curve(rows, name, method)
            panel.plot([point["time"] for point in points], [point["gain"] for point in points], **style)
    for panel, name in zip(panels, SETS, strict=True):
        panel.axhline(0, color="0.7", lw=0.8, zorder=0)
        panel.set(
            xscale="log",
            title=f"{name} ({'synthetic' if name == 'moons' else 'real'})",
            xlabel="processor time per row, µs",
            xlim=(0.15, 40),
        )
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panels[0].set_ylabel("gain in mean test log-likelihood\nover one model, nats (higher is better)")
    figure.legend(handles=handles, loc="outside right center", fontsize=9)
    save_figure(figure, FIGURE.with_suffix(""), True)


def main() -> None:
    """Run the step that the command line names."""
    parser = argparse.ArgumentParser(description="Compare wrappers and heads for uncertainty.")
    parser.add_argument("step", choices=("measure", "page"))
    parser.add_argument("root", type=Path, nargs="?", help="folder of the UCI sets")
    parser.add_argument("set", choices=SETS, nargs="?")
    parser.add_argument("--runs", type=int, nargs="+", default=list(RUNS), help="runs to measure")
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, default=list(METHODS), help="methods to measure"
    )
    options = parser.parse_args()
    if options.step == "page":
        page()
    else:
        measure(options.root, options.set, options.runs, options.methods)


if __name__ == "__main__":
    main()
