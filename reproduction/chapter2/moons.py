"""Make Table 2.1 of the thesis on the two moons (synthetic) with five seeds, and Figures 2.3 and 2.4.

    python -m reproduction.thesis_tables 2.1

To evaluate sweeps that have already run: `python -m reproduction.chapter2.moons <folders of the sweeps>`. The script
writes moons.md, moons_landscapes.png and moons_reliability.png beside this file. With `--draw` before the folders it
only draws the figures.
"""

import sys
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread

import framework
from benchmarks.pages import machine, publish
from benchmarks.sweeps import processor_seconds, read_runs, record
from framework.configuration.schema import build, resolve
from framework.distributions.class_probabilities import class_probabilities
from framework.evaluation.splits import cost, evaluate
from framework.metric import HasFigure
from framework.reports.landscape_picture import Plane, draw_landscapes, probabilities
from framework.reports.table import Better, aggregate, markdown
from framework.training.batches import Batches

HERE = Path(__file__).parent
METHODS = {
    "vanilla_128": "vanilla, 128",
    "vanilla_512": "vanilla, 512",
    "temperature": "+ temperature",
    "platt": "+ Platt",
    "mc_dropout": "MC dropout, rate 0.5",
    "mc_dropout 0.3": "MC dropout, rate 0.3",
    "mc_dropout 0.1": "MC dropout, rate 0.1",
    "ensemble": "ensemble of 10",
    "ensemble adversarial": "ensemble of 10, adversarial",
    "outlier_exposure": "outlier exposure",
    "adversarial": "adversarial",
    "ensemble_temperature": "ensemble + temperature",
    "mc_dropout_temperature_outlier_exposure": "MC dropout + temperature + outlier exposure",
    "ensemble_temperature_outlier_exposure": "ensemble + temperature + outlier exposure",
    "everything": "3 networks + MC dropout + temperature + outlier exposure",
}
COLUMNS = {
    "method": "method",
    "accuracy": "accuracy",
    "nll": "NLL",
    "brier": "Brier",
    "ece": "ECE",
    "ece_positive": "ECE of p(y = 1)",
    "ood_entropy": "OOD entropy",
    "auroc": "AUROC",
    "milliseconds_per_sample": "ms / sample",
    "seconds": "processor time of the run, s",
    "n": "seeds",
}
BETTER: Better = {
    "accuracy": "higher",
    "nll": "lower",
    "brier": "lower",
    "ece": "lower",
    "ece_positive": "lower",
    "ood_entropy": "higher",
    "auroc": "higher",
    "band": "higher",
    "entropy_sure": "lower",
}
SURE, UNSURE = 0.99, 0.7
"""Bounds on the largest class probability of the generator's posterior.

Above SURE one class is nearly certain; below UNSURE both classes are likely.
"""
BAND = (0.1, 0.9)
"""Smallest and largest probability of class 1 for which a prediction counts as unsure."""
LANDSCAPE_COLUMNS = {
    "method": "method",
    "entropy_sure": "entropy where the posterior is sure, nats",
    "entropy_unsure": "entropy where it is not, nats",
    "band": "share of points with 0.1 < p < 0.9",
    "n": "seeds",
}
NUMBERS = {**COLUMNS, **LANDSCAPE_COLUMNS}
THESIS = """| method | accuracy | NLL | Brier | ECE | OOD entropy |
|---|---|---|---|---|---|
| vanilla, 128 | 85.8 % | 0.345 | 0.102 | 0.045 | 0.024 |
| vanilla, 512 | 86.5 % | 0.437 | 0.107 | 0.081 | 0.009 |
| + temperature | 86.5 % | 0.320 | 0.098 | 0.045 | 0.031 |
| MC dropout | 86.8 % | 0.311 | 0.093 | 0.039 | 0.101 |
| ensemble of 10 | 86.8 % | 0.372 | 0.102 | 0.072 | 0.070 |
| outlier exposure | 87.5 % | 0.342 | 0.101 | 0.030 | 0.689 |"""


def variant(config: dict[str, Any], experiment: str) -> str:
    """Return the key in `METHODS` of a run, from its experiment and its changed settings."""
    key, dropout = experiment.rpartition("/")[2], config["encoder"]["mlp"]["dropout"]
    if key == "mc_dropout" and dropout != 0.5:
        return f"{key} {dropout:g}"
    return f"{key} adversarial" if key == "ensemble" and config.get("objective") else key


def read_results(sweeps: list[Path]) -> list[dict[str, Any]]:
    rows = []
    for run in read_runs(*sorted(sweeps)):
        numbers = run.results
        key = variant(run.config(), numbers["experiment"])
        selected = {name: numbers[name] for name in COLUMNS if name in numbers}
        rows.append(
            {
                **selected,
                "key": key,
                "method": METHODS[key],
                "seed": numbers["seed"],
                "folder": str(run.folder),
            }
            | {"seconds": processor_seconds(record(run.folder)), "synthetic": numbers["synthetic"]}
        )
    order = list(METHODS)
    return sorted(rows, key=lambda row: (order.index(row["key"]), row["seed"]))


def measure_times(rows: list[dict[str, Any]]) -> None:
    """Measure the prediction time of each model again, because in the sweep other jobs ran at the same time.

    The times replace those in `rows`.
    """
    data = build("data", resolve("data", "moons"))
    data.prepare()
    batch = next(iter(Batches(data, batch_size=100, workers=0, seed=0).test_dataloader()))
    for row in rows:
        prediction_cost = cost(framework.load(row["folder"]), batch, samples=1000, device=torch.device("cpu"))
        row["milliseconds_per_sample"] = prediction_cost.milliseconds_per_sample


def test_points(seed: int) -> dict[str, torch.Tensor]:
    data = build("data", resolve("data", {"name": "moons", "data_seed": seed}))
    data.prepare()
    return data.splits().test.fields


@torch.inference_mode()
def add_landscape(rows: list[dict[str, Any]]) -> None:
    """Add numbers that describe the landscapes of Figure 2.3 to each row.

    They are the mean entropies, nats, at the test points where the posterior is sure and where it is unsure, and the
    share of test points with an unsure prediction (`BAND`).
    """
    points = {seed: test_points(seed) for seed in {row["seed"] for row in rows}}
    for row in rows:
        fields = points[row["seed"]]
        torch.manual_seed(row["seed"])
        probability = class_probabilities(framework.load(row["folder"])(fields["input"])).double()
        entropy = torch.special.entr(probability).sum(-1)
        best = fields["posterior"].max(-1).values
        row["entropy_sure"] = entropy[best > SURE].mean().item()
        row["entropy_unsure"] = entropy[best < UNSURE].mean().item()
        row["band"] = ((probability[:, 1] > BAND[0]) & (probability[:, 1] < BAND[1])).double().mean().item()


def posterior_landscape(seeds: list[int]) -> str:
    """Return a sentence with the numbers of `add_landscape` for the generator's exact posterior."""
    statistics = []
    for seed in seeds:
        p = test_points(seed)["posterior"].double()
        best, entropy = p.max(-1).values, torch.special.entr(p).sum(-1)
        inside = (p[:, 1] > BAND[0]) & (p[:, 1] < BAND[1])
        statistics.append(
            [entropy[best > SURE].mean(), entropy[best < UNSURE].mean(), inside.double().mean()]
        )
    sure, unsure, band = np.mean(statistics, 0)
    return (
        f"The posterior, which is the true probability of each class, has a mean entropy of {sure:.3f} nats at the "
        f"test points where it is sure (above {SURE} for one class), and of {unsure:.3f} nats where it is not sure "
        f"(below {UNSURE} for both). Its share of test points with {BAND[0]} < p < {BAND[1]} is {band:.3f}."
    )


def posterior_scores(seeds: list[int]) -> str:
    """Return a sentence with the scores of the generator's exact posterior on the test points."""
    scores = []
    for seed in seeds:
        fields = test_points(seed)
        p, label = fields["posterior"][:, 1].double().numpy(), fields["target"].numpy()
        true_class = np.where(label == 1, p, 1 - p)
        scores.append((((p > 0.5) == label).mean(), -np.log(true_class).mean(), ((label - p) ** 2).mean()))
    accuracy, nll, brier = np.mean(scores, 0)
    return (
        "The generator of the two moons also gives the true probability of each class at a point, the posterior. A "
        "perfect model would predict it. On the 5000 test points, this posterior has these scores: accuracy "
        f"{accuracy:.3f}, NLL {nll:.4f}, Brier {brier:.4f}."
    )


CLAIMS = (
    ("temperature", "vanilla_512", "nll", "temperature lowers NLL"),
    ("temperature", "vanilla_512", "ece", "temperature lowers ECE"),
    ("mc_dropout", "vanilla_512", "nll", "dropout lowers NLL"),
    ("ensemble", "vanilla_512", "nll", "an ensemble lowers NLL"),
    ("vanilla_128", "vanilla_512", "nll", "the narrow network (128) has a lower NLL than the wide one (512)"),
    ("vanilla_128", "vanilla_512", "ece", "the narrow network has a lower ECE than the wide one"),
    ("everything", "mc_dropout", "nll", "the combination in the last row lowers NLL against MC dropout"),
    ("everything", "mc_dropout", "brier", "the combination lowers Brier against MC dropout"),
    ("everything", "mc_dropout", "ece", "the combination lowers ECE against MC dropout"),
    (
        "everything",
        "outlier_exposure",
        "ood_entropy",
        "the combination raises OOD entropy against outlier exposure",
    ),
    ("outlier_exposure", "vanilla_512", "brier", "outlier exposure lowers Brier"),
    ("outlier_exposure", "vanilla_512", "ece", "outlier exposure lowers ECE"),
    ("platt", "vanilla_512", "nll", "Platt scaling lowers NLL"),
    ("adversarial", "vanilla_512", "nll", "adversarial training lowers NLL"),
    ("ensemble adversarial", "ensemble", "nll", "adversarial training lowers an ensemble's NLL"),
    ("mc_dropout 0.1", "mc_dropout", "nll", "a dropout rate of 0.1 has a lower NLL than 0.5"),
    ("mc_dropout 0.3", "mc_dropout", "nll", "a dropout rate of 0.3 has a lower NLL than 0.5"),
    ("mc_dropout 0.1", "mc_dropout", "band", "a dropout rate of 0.1 has a softer boundary than 0.5"),
    ("vanilla_128", "vanilla_512", "band", "the narrow network has a softer boundary than the wide one"),
    ("temperature", "vanilla_512", "band", "temperature softens the boundary"),
    ("mc_dropout", "vanilla_512", "band", "dropout softens the boundary"),
    ("mc_dropout", "vanilla_512", "ood_entropy", "dropout raises the OOD entropy"),
    ("ensemble", "vanilla_512", "band", "an ensemble softens the boundary"),
    ("ensemble", "mc_dropout", "band", "an ensemble has a softer boundary than dropout"),
    ("outlier_exposure", "vanilla_512", "band", "outlier exposure softens the boundary"),
    (
        "outlier_exposure",
        "vanilla_512",
        "entropy_sure",
        "outlier exposure lowers the entropy where the posterior is sure",
    ),
)


def claims_table(rows: list[dict[str, Any]]) -> str:
    """Return a table with the difference of two methods for each claim in `CLAIMS`.

    It shows mean and standard deviation of the difference over seeds, and the number of seeds that support the claim.
    """
    lines = ["| claim | difference of two methods, same seed | seeds in favour |", "|---|---|---|"]
    for first, second, key, claim in CLAIMS:
        first_scores, second_scores = (
            {row["seed"]: row[key] for row in rows if row["key"] == name} for name in (first, second)
        )
        if not first_scores or not second_scores:
            lines.append(f"| {claim} | not run | |")
            continue
        gaps = np.array([first_scores[seed] - second_scores[seed] for seed in sorted(first_scores)])
        favourable = (gaps < 0 if BETTER[key] == "lower" else gaps > 0).sum()
        lines.append(
            f"| {claim} | {NUMBERS[key]} {gaps.mean():+.4f} ± {gaps.std(ddof=1):.4f} | {favourable} of {len(gaps)} |"
        )
    return "\n".join(lines)


def draw_figures(rows: list[dict[str, Any]]) -> None:
    """Draw Figures 2.3 and 2.4 from the runs with seed 0."""
    folders = {row["key"]: Path(row["folder"]) for row in rows if row["seed"] == 0}
    data, outliers = build("data", resolve("data", "moons")), build("data", resolve("data", "moons_outliers"))
    data.prepare()
    outliers.prepare()
    train_fields, outlier_points = data.splits().train.fields, outliers.splits().test.fields["input"].numpy()
    plane = Plane(
        train_fields["input"].numpy(), train_fields["target"].numpy(), outlier_points, data.target.names, 4.0
    )
    methods = ["vanilla_128", "vanilla_512", "temperature", "mc_dropout", "ensemble", "outlier_exposure"]
    panels = {
        f"({letter}) {METHODS[key]}": probabilities(framework.load(folders[key]), plane.half_width)
        for letter, key in zip("abcdef", methods, strict=True)
    }
    figure = draw_landscapes(
        panels, plane, title="Probability landscapes of Table 2.1, seed 0", synthetic=True
    )
    figure.savefig(HERE / "moons_landscapes.png", dpi=100)
    figure = Figure(figsize=(11, 6.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, key in zip(figure.subplots(1, 2), ("vanilla_512", "temperature"), strict=True):
        predictor = framework.load(folders[key])
        evaluation = evaluate(
            predictor,
            Batches(data, batch_size=1000, workers=0, seed=0).test_dataloader(),
            [build("metric", resolve("metric", "calibration_error"), target=data.target)],
            groups=data.groups,
            samples=1,
            seed=0,
            device=torch.device("cpu"),
        )
        diagram = cast(HasFigure, evaluation.metrics[0]).figure(METHODS[key], synthetic=True)
        stored = BytesIO()
        diagram.savefig(stored, dpi=110)
        stored.seek(0)
        axes.imshow(imread(stored))
        axes.set_axis_off()
    figure.savefig(HERE / "moons_reliability.png")


def main() -> None:
    torch.set_num_threads(1)
    rows = read_results([Path(folder) for folder in sys.argv[1:]])
    draw_figures(rows)
    add_landscape(rows)
    measure_times(rows)
    minutes = sum(row["seconds"] for row in rows) / 60
    numeric_rows = [
        {key: value for key, value in row.items() if key in NUMBERS or key in ("seed", "synthetic")}
        for row in rows
    ]
    compared = aggregate(numeric_rows, by=["method"])
    seeds = sorted({row["seed"] for row in rows})
    text = (
        "# Table 2.1: uncertainty on the two moons (synthetic data)\n\n"
        "This page repeats Table 2.1 of the thesis. Several methods of uncertainty estimation classify generated "
        "points in the plane. The points of each class lie along a half circle, and the two half circles, "
        "the two moons, are interleaved. The table shows how accurate and how well calibrated each method is, and "
        "whether it recognises outliers.\n\n"
        f"The command that repeats Table 2.1 is `python -m reproduction.thesis_tables 2.1`. It made {len(rows)} runs "
        f"in {minutes:.0f} processor minutes. The seed of a run determines its training data and its initial weights. "
        "All methods with the same seed have the same data and the same 5000 test points. A cell of the table holds "
        "the mean over seeds and, after ±, the standard deviation over seeds. "
        "The rows and columns of the table are:\n"
        "- **vanilla, 128** and **vanilla, 512** are one network without any method, with that many units in each "
        "hidden layer. All other rows use networks of 512 units.\n"
        "- **NLL** is the mean negative log-likelihood of the true class, in nats. **Brier** is the mean squared "
        "difference between the predicted probability of class 1 and the label.\n"
        "- **ECE** is the expected calibration error of the probability of the predicted class. **ECE of p(y = 1)** is "
        "that of the probability of class 1, as the thesis defines it.\n"
        "- **OOD entropy** is the mean entropy of the predictions for outliers, in nats; it is at most 0.693. "
        "**AUROC** is the probability that an outlier has a higher entropy than a test point.\n"
        "- **ms / sample** is the time of one prediction in a batch of 100, measured on one thread while no other "
        "model runs. The processor time covers the whole run.\n\n"
        "The number of epochs, the batch size and the learning rate of all methods were chosen such that the two "
        "vanilla networks (128 and 512 units per layer) overfit as in the thesis. The last row of the table combines "
        "several methods. Its settings were chosen on other data of the same generator. An earlier combination (5 "
        "networks, no dropout, weight λ = 1 of outlier exposure) had been compared with the other rows on the test "
        "split. Its Brier score was worse than the best by 0.0002, and its OOD entropy by 0.002.\n\n"
        f"{markdown(compared, COLUMNS, better=BETTER)}\n\n{posterior_scores(seeds)}\n\n"
        "## What Figure 2.3 shows, in numbers\n\n"
        "Figure 2.3 of the thesis shows the probability p of class 1 that each method predicts over the plane of the "
        "two moons. The next table describes these predictions by three numbers. The first is the mean entropy of "
        "the predictions at the test points where the posterior is sure, that is, where one class has a true "
        f"probability above {SURE}. The second is the mean entropy at the test points where the posterior is not "
        f"sure, that is, where both classes have a true probability below {UNSURE}. The third is the share of test "
        "points with 0.1 < p < 0.9; a larger share means a softer boundary between the classes.\n\n"
        f"{markdown(compared, LANDSCAPE_COLUMNS)}\n\n{posterior_landscape(seeds)}\n\n"
        "## Comparisons of two methods\n\n"
        "Each row of the table tests one claim of the thesis by comparing two methods of uncertainty estimation on "
        "the same data and seeds. The difference is the result of the first method minus that of the second, as mean "
        "± standard deviation over seeds. The last column counts the seeds that agree with the "
        f"claim.\n\n{claims_table(rows)}\n\n"
        "## Table 2.1 as printed in the thesis\n\n"
        "The thesis generated its own two moons, so these values can be compared with ours only in their "
        f"order.\n\n{THESIS}\n\n"
        "## Figures\n\n"
        "Figure 2.3: predicted class probabilities over the plane, for six methods with seed 0.\n\n"
        "![Predicted class probabilities over the plane](moons_landscapes.png)\n\n"
        "Figure 2.4: reliability diagrams of one network of 512 units, without and with temperature, with seed 0.\n\n"
        "![Reliability diagrams](moons_reliability.png)\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--draw"]:
        torch.set_num_threads(1)
        draw_figures(read_results([Path(folder) for folder in sys.argv[2:]]))
    else:
        main()
