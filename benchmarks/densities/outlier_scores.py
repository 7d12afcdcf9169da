"""Compare scores that recognise outliers: of the density, and of the features in front of the final layer.

    python -m benchmarks.densities.outlier_scores measure moons
    python -m benchmarks.densities.outlier_scores measure digits /path/to/digits /path/to/COIL20
    python -m benchmarks.densities.outlier_scores page           # writes outlier_scores.md and its figure

The digits are idx files as for `benchmarks.images.digits`, and COIL-20 is in the form of data=coil20. `measure` trains
one model for each seed, and writes one line for each score and set of outliers into outlier_scores_runs.csv.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

from benchmarks.pages import machine, publish, read_rows
from framework.reports.table import write_csv

SEEDS = (0, 1, 2)
KNOWN, UNKNOWN = tuple("01234567"), ("8", "9")
"""Digits that train the model, and digits that are outliers."""
SCORES: dict[str, dict[str, Any] | None] = {
    "entropy": None,
    "confidence": None,
    "energy": {"method": "energy"},
    "Mahalanobis": {},
    "Mahalanobis, normalised": {"normalise": True},
    "relative Mahalanobis": {"method": "relative_mahalanobis"},
    "nearest neighbours": {"method": "knn"},
    "nearest neighbours, not normalised": {"method": "knn", "normalise": False},
}
"""Scores by name: settings of `feature_score`, or None for scores of the density."""
REMARKS = {
    "moons": "`relative Mahalanobis` is the difference of two distances, whose covariances differ only along the line "
    "that separates the class means. For two classes it therefore reads one direction of the features only. With seed "
    "2, the outliers lie in this direction between -2.7 and 2.1 within-class standard deviations (5th and 95th "
    "percentile), and the test samples between -2.3 and 2.3, so that the score cannot tell them apart. This "
    "happens although the squared distance of the outliers from the class means is 90 times that of the test samples "
    "(no command repeats these two evaluations). "
    "Do not use this score for few classes and outliers that are far away. In an earlier version each of the two "
    "covariances had its own shrinkage. With seed 0, the smallest variances of the two were then 0.0023 and "
    "0.0021. The outliers lie in directions of small variance. Their median score was therefore -355 instead of "
    "3.8, and the AUROC was 2e-7.",
    "digits": "The rows of `relative Mahalanobis` on digits were measured with the earlier version, in which each of "
    "the two covariances had its own shrinkage.",
}
"""Explanations under the tables."""
MOONS_EPOCHS, DIGITS_EPOCHS = 100, 3
ROUNDS = 5
"""Number of repetitions of a timed prediction."""
TABLE = Path(__file__).with_name("outlier_scores_runs.csv")
FIGURE = Path(__file__).with_name("outlier_scores.png")
KINDS = {
    "far from both moons": "moons (synthetic)",
    "digits 8 and 9": "digits 8 and 9 (real)",
    "objects": "objects among digits (real)",
}
"""Panels of the figure: kinds of outliers, with their titles."""
Batches = dict[str, Any]


def load_moons(seed: int) -> tuple[Any, dict[str, Batches], dict[str, Any]]:
    """Return data, one batch with all samples of each split, and inputs of outliers by name."""
    data = prepared({"name": "moons", "data_seed": seed})
    outliers = prepared({"name": "moons_outliers", "data_seed": seed})
    return data, batches_of(data), {"far from both moons": batches_of(outliers)["test"]["input"]}


def load_digits(seed: int, digits: Path, objects: Path) -> tuple[Any, dict[str, Batches], dict[str, Any]]:
    """Return data, one batch with all samples of each split, and inputs of outliers by name."""
    folder = {
        "name": "image_folder",
        "root": str(digits),
        "image_size": 32,
        "grayscale": True,
        "data_seed": seed,
    }
    data = prepared({**folder, "classes": list(KNOWN)})
    others = prepared({**folder, "classes": list(UNKNOWN)})
    coil20 = prepared({"name": "coil20", "root": str(objects)})
    outliers = {"digits 8 and 9": batches_of(others)["test"]["input"]}
    return data, batches_of(data), {**outliers, "objects": batches_of(coil20)["test"]["input"]}


def prepared(config: dict[str, Any]) -> Any:
    """Return a prepared data set."""
    from framework.configuration.schema import build, resolve

    data = build("data", resolve("data", config))
    data.prepare()
    return data


def batches_of(data: Any) -> dict[str, Batches]:
    """Return one batch with all samples of each split."""
    from framework.datasets.fields import fetch

    return {name: fetch(part, range(len(part))) for name, part in data.splits()._asdict().items()}


def train(data: Any, batches: dict[str, Batches], seed: int, encoder: dict[str, Any], epochs: int) -> Any:
    """Return a model, trained by Adam with batches of 64 samples and half a cosine of the learning rate."""
    import torch

    from framework.configuration.assembly import build_predictor
    from framework.configuration.schema import resolve

    parts = {
        "encoder": [resolve("encoder", encoder)],
        "density_head": resolve("density_head", "categorical"),
        "uncertainty": [],
    }
    model = build_predictor(parts, data.target, data.input_shape, seed).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3)
    inputs, target = batches["train"]["input"], batches["train"]["target"]
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs * -(-len(inputs) // 64))
    for _ in range(epochs):
        for rows in torch.randperm(len(inputs)).split(64):
            optimizer.zero_grad()
            model.loss(inputs[rows], target[rows]).mean().backward()
            optimizer.step()
            schedule.step()
    return model.eval()


def measure(name: str, load: Callable[[int], Any], encoder: dict[str, Any], epochs: int) -> None:
    """Record the AUROC of each score, with the accuracy of the model and processor times, in place of old records."""
    import torch

    torch.set_num_threads(1)
    old = read_rows(TABLE) if TABLE.exists() else []
    rows: list[dict[str, Any]] = [row for row in old if row["data"] != name]
    for seed in SEEDS:
        data, batches, outliers = load(seed)
        model = train(data, batches, seed, encoder, epochs)
        for row in test(model, data, batches, outliers):
            rows.append({"data": name, "seed": seed, **row})
    write_csv(rows, None, TABLE)


def test(
    model: Any, data: Any, batches: dict[str, Batches], outliers: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Yield the results of each score on each set of outliers."""
    import torch

    from framework.configuration.schema import build, resolve
    from framework.distributions.unchanged import outlier_score
    from framework.uncertainty import reading_training
    from plugins.metric.out_of_distribution.metric import ranking, uncertainty_score

    known, label = batches["test"]["input"], batches["test"]["target"]
    with torch.no_grad():
        accuracy = (model(known).mode == label).double().mean().item()
    for name, config in SCORES.items():
        predictor = model
        if config is not None:
            part = resolve("uncertainty", {"name": "feature_score", **config})
            predictor = build("uncertainty", part, model=lambda: model, target=data.target).eval()
            with reading_training(predictor, [batches["train"]]):
                predictor.calibrate([batches["validation"]])

        @torch.no_grad()
        def score(inputs: Any, predictor: Any = predictor, name: str = name) -> Any:
            density = predictor(inputs)
            if name == "entropy":
                return density.entropy().double()
            return uncertainty_score(density) if name == "confidence" else outlier_score(density)

        times = []
        for _ in range(ROUNDS):
            start = time.process_time()
            of_known = score(known)
            times.append((time.process_time() - start) / len(known) * 1e6)
        for kind, inputs in outliers.items():
            ranks = ranking(score(inputs), of_known)
            numbers = {key: ranks[key].item() for key in ("auroc", "fpr95")}
            cost = {"microseconds": median(times), "accuracy": accuracy}
            yield {"score": name, "outliers": kind, **numbers, **cost}


def page() -> None:
    """Write the page from the recorded runs."""
    rows: list[dict[str, Any]] = read_rows(TABLE)
    draw(rows)
    lines = [
        "# Scores that recognise outliers",
        "",
        "This page compares scores that should be high for inputs unlike the training data. `entropy` and `confidence` "
        "are computed from the predicted density, and all others from the features that the final layer reads "
        "(`uncertainty=[feature_score]`). AUROC is the probability that a random outlier has a higher score than "
        "a random test sample; 1 is best. FPR95 is the share of test samples that a threshold classifies as "
        f"outliers if it detects 95 % of the outliers; 0 is best. The numbers are means over {len(SEEDS)} seeds "
        "of the training and of the data (for digits, of their split), and ± is the standard deviation over "
        "seeds. The settings are the defaults of `feature_score`, except where the name of the score says "
        "otherwise. No setting was tuned.",
        "",
        "![AUROC of outliers against processor time](outlier_scores.png)",
        "",
        "*Share of pairs of an outlier and a test sample that a score orders wrongly (1 - AUROC), against the time of "
        "density and score. Bars are standard deviations over seeds. The grey line is the best result of all scores "
        "that are at least as fast.*",
        "",
        "**Which score wins at which run time.** Each line of the list is for one kind of outliers. It names the "
        "scores in the order of their run time, from the fastest on. A score is named only if its AUROC is higher "
        "than ½ and than that of every faster score, by more than the standard deviations of both over seeds. Times "
        "that differ by less than a tenth are equal within their noise.",
        "",
        *(
            f"- {title}: {winners([row for row in rows if row['outliers'] == kind])}."
            for kind, title in KINDS.items()
        ),
    ]
    for data, heading in (
        ("moons", "Moons (synthetic)"),
        ("digits", f"Handwritten digits {KNOWN[0]} to {KNOWN[-1]} (real)"),
    ):
        own: list[dict[str, Any]] = [row for row in rows if row["data"] == data]
        if not own:
            continue
        accuracies = [row["accuracy"] for row in own if row["score"] == "entropy"]
        texts = {
            "moons": "The outliers lie far from both moons, on one side (`data=moons_outliers`). The network has two "
            f"layers of 512 units, trained for {MOONS_EPOCHS} epochs.",
            "digits": "A small convolutional network (`biternion_vgg`) is trained on the digits 0 to 7 among the "
            f"10,000 test images of MNIST, split at random, for {DIGITS_EPOCHS} epochs. Outliers are digits of the "
            "other two classes, 8 and 9, and images of objects (COIL-20).",
        }
        lines += [
            "",
            f"## {heading}",
            "",
            f"{texts[data]} The accuracy of the classes is {spread(accuracies)}. Times are processor times of density "
            "and score for a row, in a batch with the whole test split, as medians of "
            f"{ROUNDS} repetitions.",
        ]
        for kind in dict.fromkeys(row["outliers"] for row in own):
            lines += ["", f"Outliers: {kind}", "", *table([row for row in own if row["outliers"] == kind])]
        lines += ["", REMARKS[data]]
    lines += [
        "",
        f"{machine('torch')} Commands: the lines at the top of `benchmarks/densities/outlier_scores.py`. Other "
        "programs used the machine at the same time.",
        "",
    ]
    publish(__file__, "\n".join(lines))


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the lines of a table of scores, the best first."""
    lines = []
    for score in SCORES:
        own = [row for row in rows if row["score"] == score]
        auroc, fpr = ([row[key] for row in own] for key in ("auroc", "fpr95"))
        cost = mean(row["microseconds"] for row in own)
        lines.append((mean(auroc), f"| {score} | {spread(auroc)} | {spread(fpr)} | {cost:.3g} |"))
    head = ["| score | AUROC | FPR95 | µs / row |", "|---|---:|---:|---:|"]
    return [*head, *(line for _, line in sorted(lines, key=lambda pair: -pair[0]))]


def result(rows: Sequence[dict[str, Any]], score: str) -> tuple[float, float, float]:
    """Return the mean run time of a score, µs, its mean AUROC, and the standard deviation of the AUROC over seeds."""
    own = [row for row in rows if row["score"] == score]
    areas = [row["auroc"] for row in own]
    return mean(row["microseconds"] for row in own), mean(areas), stdev(areas)


def winners(rows: Sequence[dict[str, Any]]) -> str:
    """Return the scores that are clearly better than every faster one, from the fastest on, with AUROC and time."""
    best, noise, parts = 0.5, 0.0, []
    for (duration, area, deviation), score in sorted((result(rows, score), score) for score in SCORES):
        if area > best + max(deviation, noise):
            best, noise = area, deviation
            parts.append(f"from {duration:.3g} µs {score} ({area:.3f})")
    return ", ".join(parts)


def draw(rows: Sequence[dict[str, Any]]) -> None:
    """Draw 1 - AUROC of each score against its run time, with one panel for each kind of outliers."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FixedLocator, NullFormatter

    from framework.figures.style import COLOURS, GREY, MARKERS, save_figure, titled_figure

    figure = titled_figure(
        (13, 4.2), "Scores that recognise outliers: error against run time", synthetic=False
    )
    panels = figure.subplots(1, len(KINDS))
    styles = {score: (MARKERS[n], COLOURS[n % len(COLOURS)]) for n, score in enumerate(SCORES)}
    for axes, (kind, title) in zip(panels, KINDS.items(), strict=True):
        own = [row for row in rows if row["outliers"] == kind]
        results = {score: result(own, score) for score in SCORES}
        for score, (duration, area, deviation) in results.items():
            marker, colour = styles[score]
            axes.errorbar(duration, 1 - area, deviation, marker=marker, color=colour, ls="")
        ranked = sorted(results.values())
        times = [duration for duration, _, _ in ranked]
        best = [1 - max(area for _, area, _ in ranked[: end + 1]) for end in range(len(ranked))]
        axes.step([*times, 2 * times[-1]], [*best, best[-1]], where="post", color=GREY, zorder=0, lw=1)
        limits = (times[0] / 1.5, 1.5 * times[-1])
        axes.set(xscale="log", title=title, xlabel="processor time per row, µs", xlim=limits)
        axes.xaxis.set_major_locator(FixedLocator([5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000]))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(-0.03 * axes.get_ylim()[1], None)  # so that no marker at 0 is cut off
    panels[0].set_ylabel("1 - AUROC (lower is better)")
    handles = [
        Line2D([], [], color=colour, ls="", marker=marker, label=score)
        for score, (marker, colour) in styles.items()
    ]
    handles.append(Line2D([], [], color=GREY, label="best so far"))
    figure.legend(handles=handles, loc="outside right center")
    save_figure(figure, FIGURE.with_suffix(""), True)


def spread(values: Sequence[float]) -> str:
    """Return the mean and the standard deviation."""
    return f"{mean(values):.3f} ± {stdev(values):.3f}"


def main() -> None:
    """Run the step that the command line names."""
    parser = argparse.ArgumentParser(description="Compare scores that recognise outliers.")
    parser.add_argument("step", choices=("measure", "page"))
    parser.add_argument("set", choices=("moons", "digits"), nargs="?")
    parser.add_argument("folders", type=Path, nargs="*", help="folders of the digits and of COIL-20")
    options = parser.parse_args()
    if options.step == "page":
        page()
    elif options.set == "moons":
        measure("moons", load_moons, {"name": "mlp", "widths": [512, 512]}, MOONS_EPOCHS)
    else:
        encoder = {"name": "biternion_vgg", "convolution_dropout": 0.0, "dropout": 0.1}
        measure("digits", lambda seed: load_digits(seed, *options.folders), encoder, DIGITS_EPOCHS)


if __name__ == "__main__":
    main()
