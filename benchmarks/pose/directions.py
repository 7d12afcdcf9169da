"""Compare densities of one direction, and wrappers around them, by error against run time on real images.

    python -m benchmarks.pose.directions train /path/to/COIL20 0     # seed 0; likewise 1 and 2
    python -m benchmarks.pose.directions measure /path/to/COIL20
    python -m benchmarks.pose.directions page

`train` trains all heads with one seed, and stores the models in outputs/directions. `measure` tests the models, also in
ensembles, with a temperature and with other numbers of samples, and writes directions.csv. `page` writes directions.md
and directions.png from this table.
"""

import argparse
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any, NamedTuple

from benchmarks.commands import ROOT
from benchmarks.pages import environment, publish, read_rows
from framework.figures.style import COLOURS, save_figure, titled_figure
from framework.reports.table import write_csv

HEADS = ("von_mises", "projected_normal", "mixture", "scvae", "cvae")
KINDS = {"one model": "o", "temperature": "^", "ensemble": "s"}
"""Wrappers, with their markers in the figure."""
SAMPLES = (5, 20, 100, 500)
"""Numbers of samples of the latent vector with which `scvae` and `cvae` are tested."""
MEASURES = {
    "log_likelihood": ("log_prob_ms", "log-likelihood, nats (higher is better)", 1),
    "maad_deg": ("point_ms", "MAAD, degrees (lower is better)", -1),
}
"""Quantities, each with its run time, its label, and its sign: 1 if higher values are better."""
SEEDS = (0, 1, 2)
ROUNDS, SECONDS = 5, 0.05
WIDTH, STEPS, TRAINING_BATCH, RATE, DECAY = 512, 2400, 48, 2e-3, 1e-4
"""Training: width of the hidden layer, steps, images of a batch, first learning rate, and weight decay."""
STORE = ROOT / "outputs" / "directions"
BATCH = 64
"""Number of images of the batch whose run time is measured."""
GRID = 3600
"""Number of angles among which the best point of a density is searched, to compare point predictions with it."""
LOWEST = -0.5
"""Lower end of the axis of log-likelihoods; values below it are written at the edge of the figure."""
TABLE = Path(__file__).with_suffix(".csv")


class Method(NamedTuple):
    """A way to predict a density: a head, a wrapper (one of KINDS), and the number of samples (0 if it has none)."""

    head: str
    kind: str
    samples: int

    @property
    def name(self) -> str:
        """Name in the table and the text."""
        wrapper = "" if self.kind == "one model" else f", {self.kind}"
        return f"{self.head}{wrapper}" + (f", S = {self.samples}" if self.samples else "")


def load_data(root: Path) -> Any:
    """Return the data set COIL-20, prepared."""
    from framework.configuration.schema import build, resolve

    data = build("data", resolve("data", {"name": "coil20", "root": str(root)}))
    data.prepare()
    return data


def build_model(head: str, data: Any, seed: int) -> Any:
    """Return the untrained model with a head; it has one hidden layer."""
    from framework.configuration.assembly import build_predictor
    from framework.configuration.schema import resolve

    encoder = resolve("encoder", {"name": "mlp", "widths": [WIDTH]})
    parts = {"encoder": [encoder], "density_head": resolve("density_head", {"name": head}), "uncertainty": []}
    return build_predictor(parts, data.target, data.input_shape, seed)


def train(root: Path, seed: int) -> None:
    """Train every head with this seed, all on the same batches, and store the weights after the last step."""
    import torch

    from framework.datasets.fields import fetch

    torch.set_num_threads(1)
    data = load_data(root)
    samples = data.splits().train
    models = {head: build_model(head, data, seed).train() for head in HEADS}
    optimizers = [
        torch.optim.AdamW(model.parameters(), lr=RATE, weight_decay=DECAY) for model in models.values()
    ]
    torch.manual_seed(seed)
    for step in range(STEPS):
        chosen = torch.randint(len(samples), (TRAINING_BATCH,)).tolist()
        batch = data.augment(fetch(samples, chosen))
        for model, optimizer in zip(models.values(), optimizers, strict=True):
            optimizer.param_groups[0]["lr"] = RATE * (1 + math.cos(math.pi * step / STEPS)) / 2
            optimizer.zero_grad()
            model.loss(batch["input"], batch["target"]).mean().backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
    for head, model in models.items():
        STORE.mkdir(parents=True, exist_ok=True)
        torch.save(model.state_dict(), STORE / f"{head}_{seed}.pt")


def measure(root: Path) -> None:
    """Test the stored models, and write one row for each method and test (each seed, or the ensemble of all)."""
    import torch

    from benchmarks.timing import time_interleaved
    from framework.datasets.fields import fetch

    torch.set_num_threads(1)
    data = load_data(root)
    models: dict[str, dict[int, Any]] = {head: {} for head in HEADS}
    for head, seed in itertools.product(HEADS, SEEDS):
        model = build_model(head, data, seed).eval()
        model.load_state_dict(torch.load(STORE / f"{head}_{seed}.pt", weights_only=True))
        models[head][seed] = model
    splits = data.splits()
    test, validation, training = (
        fetch(part, range(len(part))) for part in (splits.test, splits.validation, splits.train)
    )
    rows: list[dict[str, Any]] = []
    predictors: dict[Method, Any] = {}
    for head, of_seeds in models.items():
        for method, seed, predictor in wrap(head, of_seeds, validation):
            row = {**method._asdict(), "seed": seed, **scores(predictor, method, test)}
            if method.kind == "one model" and method.samples in (0, SAMPLES[-1]):
                row["training_maad_deg"] = deviations(predictor, method, training).mean().item()
                row |= best_points(predictor, method, test)
            rows.append(row)
            predictors.setdefault(method, predictor)
    small = {key: values[:BATCH] for key, values in test.items()}
    for column, predict in (("log_prob_ms", log_prob), ("point_ms", point)):
        calls: dict[str, Callable[[], object]] = {
            method.name: partial(predict, predictor, method, small)
            for method, predictor in predictors.items()
        }
        times = time_interleaved(calls, rounds=ROUNDS, seconds=SECONDS)
        for row in rows:
            method = Method(row["head"], row["kind"], row["samples"])
            row[column] = times[method.name].median / BATCH
    write_csv([{**row, "environment": environment("torch", "numpy")} for row in rows], None, TABLE)


def wrap(head: str, models: dict[int, Any], validation: Any) -> Iterator[tuple[Method, int, Any]]:
    """Yield every method with this head, with its seed and its predictor; the seed of an ensemble is -1.

    The members of the ensemble are the models of all seeds. Temperatures are fitted to the validation images.
    """
    from plugins.uncertainty.members.ensemble import Ensemble
    from plugins.uncertainty.scaling.temperature import Temperature

    most = SAMPLES[-1] if head in ("scvae", "cvae") else 0
    for seed, model in models.items():
        for samples in SAMPLES if most else (0,):
            yield Method(head, "one model", samples), seed, model
        set_samples(model, most)
        scaled = Temperature(lambda model=model: model)
        scaled.calibrate([validation])
        yield Method(head, "temperature", most), seed, scaled
    members = iter(models.values())
    ensemble = Ensemble(lambda: next(members), members=len(models)).eval()
    yield Method(head, "ensemble", most), -1, ensemble


def set_samples(predictor: Any, samples: int) -> None:
    """Set the number of samples of the latent vector in all heads of a predictor that have one."""
    for module in predictor.modules() if samples else ():
        if "samples" in getattr(module, "knobs", ()):
            module.samples = samples


def log_prob(predictor: Any, method: Method, batch: Any) -> Any:
    """Return the log-likelihood of each target, (batch,), nats."""
    import torch

    set_samples(predictor, method.samples)
    with torch.no_grad():
        torch.manual_seed(0)
        return predictor(batch["input"]).log_prob(batch["target"])


def point(predictor: Any, method: Method, batch: Any) -> Any:
    """Return the point predictions, (batch, 1), radians."""
    import torch

    from framework.prediction import Prediction

    set_samples(predictor, method.samples)
    with torch.no_grad():
        torch.manual_seed(0)
        return Prediction(predictor(batch["input"]), batch).point


def deviations(predictor: Any, method: Method, batch: Any) -> Any:
    """Return the absolute angular deviations of the point predictions, (batch,), degrees, float64."""
    from framework.distributions.circular import angular_distance

    return angular_distance(point(predictor, method, batch), batch["target"]).double().rad2deg().flatten()


def best_points(predictor: Any, method: Method, test: Any) -> dict[str, float]:
    """Compare the point predictions with the best of GRID angles for each predicted density.

    The best angle has the smallest expected deviation. The density of `cvae` is here the mixture of its components at S
    points of the latent space, from which its point prediction is computed too.

    Returns:
        `expected_deg`: mean expected deviation at the point prediction, degrees.
        `best_expected_deg`: the same at the best angle.
        `best_maad_deg`: mean absolute deviation of the target from the best angle, degrees.
    """
    import torch

    from framework.distributions.circular import angular_distance, grid

    angles = grid(GRID, dtype=torch.float64)
    kernel = torch.fft.rfft(angular_distance(angles, angles[:1]))
    points = point(predictor, method, test).double().flatten()
    columns: list[Any] = []
    set_samples(predictor, method.samples)
    for rows in torch.arange(len(points)).split(48):
        with torch.no_grad():
            torch.manual_seed(0)
            density = predictor(test["input"][rows])
            density = getattr(density, "mixture", density)
            shape = (-1, len(rows), 1)
            parts = [part.float().view(-1, 1, 1).expand(*shape) for part in angles.split(120)]
            mass = torch.cat([density.log_prob(part).double().exp() for part in parts])
        mass = mass / mass.sum(0)
        expected = torch.fft.irfft(torch.fft.rfft(mass, dim=0) * kernel[:, None], n=GRID, dim=0)
        own = (mass * angular_distance(angles[:, None], points[rows])).sum(0)
        best = angular_distance(angles[expected.argmin(0)], test["target"][rows].double().flatten())
        columns.append(torch.stack([own, expected.amin(0), best]))
    means = torch.cat(columns, -1).mean(-1).rad2deg().tolist()
    return dict(zip(("expected_deg", "best_expected_deg", "best_maad_deg"), means, strict=True))


def scores(predictor: Any, method: Method, test: Any) -> dict[str, float]:
    """Return the results of a predictor on all test images, with their standard errors over these images."""
    distance = deviations(predictor, method, test)
    values = {"log_likelihood": log_prob(predictor, method, test).double(), "maad_deg": distance}
    results = {key: column.mean().item() for key, column in values.items()}
    groups = {"unique_deg": 0, "alike_deg": 1}
    results |= {key: distance[test["group"] == group].mean().item() for key, group in groups.items()}
    errors = {f"{key}_sem": column.std().item() / len(column) ** 0.5 for key, column in values.items()}
    return {**results, **errors}


def results_by_method(rows: Sequence[dict[str, Any]]) -> dict[Method, list[dict[str, Any]]]:
    """Return the rows of each method."""
    methods: dict[Method, list[dict[str, Any]]] = {}
    for row in rows:
        methods.setdefault(Method(row["head"], row["kind"], row["samples"]), []).append(row)
    return methods


def average(rows: Sequence[dict[str, Any]], key: str) -> float:
    """Return the mean of a column."""
    return mean(row[key] for row in rows)


def cells(rows: Sequence[dict[str, Any]], key: str) -> list[str]:
    """Return the mean of a column, its standard deviation over seeds, its error over images, and its run time."""
    deviation = f"{stdev(row[key] for row in rows):.2f}" if len(rows) > 1 else ""
    error, duration = average(rows, f"{key}_sem"), average(rows, MEASURES[key][0])
    return [f"{average(rows, key):.2f}", deviation, f"{error:.2f}", f"{duration:.2g}"]


def winners(methods: dict[Method, list[dict[str, Any]]], key: str, unit: str) -> str:
    """Return the methods that are clearly better than every faster one, from the fastest on, with their results.

    A method is clearly better if the difference is larger than both standard deviations over the seeds. For the only
    ensemble, that of a single model with the same head counts.
    """
    cost, _, sign = MEASURES[key]
    best, noise, parts = -math.inf, 0.0, []
    for method in sorted(methods, key=lambda method: average(methods[method], cost)):
        rows = methods[method]
        several = methods[method._replace(kind="one model")] if method.kind == "ensemble" else rows
        value, deviation = average(rows, key), stdev(row[key] for row in several)
        if sign * value > best + max(deviation, noise):
            best, noise = sign * value, deviation
            parts.append(f"{average(rows, cost):.2g} ms, {method.name} ({value:.2f} {unit})")
    return "; ".join(parts)


def points_table(methods: dict[Method, list[dict[str, Any]]]) -> str:
    """Return the table that compares the point predictions of single models with the best points of their densities."""
    keys = ("maad_deg", "best_maad_deg", "expected_deg", "best_expected_deg")
    keys = (*keys, "unique_deg", "alike_deg", "training_maad_deg")
    columns = ("MAAD", "best angle: MAAD", "expected deviation", "best angle: expected deviation")
    columns = (*columns, "unique objects: MAAD", "look-alikes: MAAD", "training images: MAAD")
    lines = [f"| density head | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for method, rows in methods.items():
        if "expected_deg" in rows[0]:
            cells = [f"{average(rows, key):.2f}" for key in keys]
            lines.append(f"| {method.name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def largest_excess(methods: dict[Method, list[dict[str, Any]]]) -> str:
    """Return the largest excess of the expected deviation of a head's point prediction over the best, as text."""
    excess = {
        method.head: average(rows, "expected_deg") - average(rows, "best_expected_deg")
        for method, rows in methods.items()
        if "expected_deg" in rows[0]
    }
    head = max(excess, key=lambda head: excess[head])
    return f"{excess[head]:.3f}° (`{head}`)"


def draw(methods: dict[Method, list[dict[str, Any]]]) -> None:
    """Draw log-likelihood and angular deviation against run time; colours are heads, and markers are wrappers."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FixedLocator, NullFormatter

    figure = titled_figure(
        (11, 4.2),
        "Direction of an object in an image, COIL-20 (real): error against run time",
        synthetic=False,
    )
    for axes, (key, (cost, label, sign)) in zip(figure.subplots(1, 2), MEASURES.items(), strict=True):
        for (head, colour), kind in itertools.product(zip(HEADS, COLOURS, strict=False), KINDS):
            chosen = [method for method in methods if (method.head, method.kind) == (head, kind)]
            points = [(average(methods[method], cost), average(methods[method], key)) for method in chosen]
            if key == "log_likelihood":
                for duration, value in points:
                    if value < LOWEST:
                        axes.text(0.97 * duration, LOWEST + 0.05, f"{value:.1f} ↓", color=colour, ha="right")
            axes.plot(*zip(*points, strict=True), color=colour, marker=KINDS[kind], ls="-", lw=1)
        ranked = sorted((average(rows, cost), average(rows, key)) for rows in methods.values())
        times = [time for time, _ in ranked]
        best = [sign * max(sign * value for _, value in ranked[: end + 1]) for end in range(len(ranked))]
        axes.step([*times, 2 * times[-1]], [*best, best[-1]], where="post", color="0.6", zorder=0, lw=1)
        axes.set(
            xscale="log",
            xlabel="milliseconds per image",
            ylabel=label,
            xlim=(times[0] / 1.5, 1.5 * times[-1]),
        )
        if key == "log_likelihood":
            axes.set_ylim(LOWEST, best[-1] + 0.2)
        axes.xaxis.set_major_locator(FixedLocator([0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50]))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    handles = [Line2D([], [], color=colour, label=head) for head, colour in zip(HEADS, COLOURS, strict=False)]
    handles += [
        Line2D([], [], color="0.3", ls="", marker=marker, label=kind) for kind, marker in KINDS.items()
    ]
    handles.append(Line2D([], [], color="0.6", label="best so far"))
    figure.legend(handles=handles, loc="outside right center")
    save_figure(figure, TABLE.with_suffix(""), True)


def page() -> None:
    """Write the page and its figure from the table of results."""
    rows: list[dict[str, Any]] = read_rows(TABLE)
    methods = results_by_method(rows)
    draw(methods)
    seeds = sorted({row["seed"] for row in rows} - {-1})
    ordered = sorted(methods, key=lambda method: -average(methods[method], "log_likelihood"))
    columns = ("log-likelihood, nats", "MAAD, degrees")
    lines = [
        "| method " + "".join(f"| {column} | ± seeds | ± images | ms / image " for column in columns) + "|",
        f"|---|{'---:|' * 4 * len(columns)}",
    ]
    for method in ordered:
        values = [cell for key in MEASURES for cell in cells(methods[method], key)]
        lines.append(f"| {method.name} | {' | '.join(values)} |")
    table = "\n".join(lines)
    publish(
        __file__,
        f"""# One direction in an image: error against run time

This page compares the density heads of one angle, and wrappers around them, on *real* images: the azimuth of 20
objects on a turntable (COIL-20, `data=coil20`). Each object has 18 training views, one every 20°. The 18 validation
views lie in the middle between them, and the 36 test views are 5° from the nearest training view. Images have 32 × 32
pixels. The network is small, so that the run time of the heads is visible: one hidden layer of {WIDTH} units. All
heads are trained by AdamW for {STEPS} steps of {TRAINING_BATCH} images on the same batches (first learning rate
{RATE:g}, cosine schedule, weight decay {DECAY:g}). The seeds are {", ".join(map(str, seeds))}. After 600 steps, no
head fitted even the training images yet, and the number was raised once for all heads; no command repeats this trial.
No setting was tuned for a single method. A convolutional network that is trained for longer has smaller errors
([coil20](../densities/coil20.md)).

![Log-likelihood and mean absolute angular deviation against milliseconds per image](directions.png)

*Left: mean log-likelihood of the azimuth of the test images against the time of the density and its log-likelihood.
Right: mean absolute angular deviation of the point prediction against the time of the density and the point
prediction. Colours are density heads, and markers are wrappers. A line joins the numbers S of samples of one head
({", ".join(map(str, SAMPLES))}). An arrow marks a value below the axis. The grey line is the best result of all
methods that are at least as fast.*

**Which method wins at which run time:** if a prediction may take at least the following time per image, the method
with the highest log-likelihood is: {winners(methods, "log_likelihood", "nats")}. The method with the lowest MAAD is:
{winners(methods, "maad_deg", "degrees")}. Each of the other methods is slower than one of these, and not better by more
than the standard deviation over the seeds (for an ensemble: over the seeds of its members).

{table}

- The methods: `von_mises` and `projected_normal` are single densities; `mixture` has 5 von Mises components; `scvae`
  and `cvae` are infinite mixtures over a latent vector, of which S samples are drawn.
- temperature: one temperature for all densities, fitted to the validation images, which are farther from the training
  views than the test images. ensemble: the mixture of the densities of the {len(seeds)} models with different seeds,
  in one pass.
- "± seeds" is the standard deviation over the seeds of the training. There is only one ensemble of all seeds, so this
  column is empty for it. "± images" is the standard error over the test images, as if they were independent.
- MAAD is the mean absolute angular deviation of the point prediction, the median of the density.
- Times are processor times per image in a batch of {BATCH} images on one thread, medians of {ROUNDS} interleaved
  rounds.
- Heads of rotations (`matrix_fisher`, `rotation_laplace`, `implicit_pdf`) describe three angles and do not fit a single
  one. They are compared in [symmetric_solids](symmetric_solids.md).

## Are the point predictions the best points of the densities?

MAAD and log-likelihood rank the heads differently. The table says why, for single models (degrees, means over test
images and seeds). The best angle is that of {GRID} equally spaced angles with the smallest expected deviation under the
predicted density. The 8 look-alikes are the objects whose training views 180° apart are more similar than neighbouring
views (`plugins/data/coil20`).

{points_table(methods)}

The expected deviation of a point prediction is at most {largest_excess(methods)} above that of the best angle, as a
mean over the images, so that the high MAAD of some heads is no fault of their point predictions. Nor is it
over-fitting, because their MAAD on training images is as high. Their densities are wide: `scvae` has not learned which
of two opposite views of a look-alike object an image shows, and `projected_normal` has not learned it for most objects.
A density with two opposite peaks has a good log-likelihood, but no point of it is near the target in more than about
half of the cases. With `shape=isotropic`, whose density has one peak, `projected_normal` has a MAAD of 16.0° and a
log-likelihood of -0.08 nats. After three times as many steps, `scvae` has a MAAD of 19.2° (2.8° for unique objects and
43.8° for look-alikes), and then over-fits, with a log-likelihood of -6.16 nats. Both trials have one seed (0), and no
command repeats them.

Measured on {rows[0]["environment"]} Other programs used the machine at the same time.
Commands: `python -m benchmarks.pose.directions train <folder> <seed>` for each seed, then
`python -m benchmarks.pose.directions measure <folder>` and `python -m benchmarks.pose.directions page`.
""",
    )


def main() -> None:
    """Run the step that the command line names."""
    parser = argparse.ArgumentParser(description="Compare densities of one direction.")
    parser.add_argument("step", choices=("train", "measure", "page"))
    parser.add_argument("root", type=Path, nargs="?", help="folder of COIL-20; not for `page`")
    parser.add_argument("seed", type=int, choices=SEEDS, nargs="?", help="seed, for `train`")
    options = parser.parse_args()
    if options.step == "train":
        train(options.root, options.seed)
    elif options.step == "measure":
        measure(options.root)
    else:
        page()


if __name__ == "__main__":
    main()
