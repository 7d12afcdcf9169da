"""Make Tables 6.1 to 6.3 on synthetic CAD models, with errors, run times and the thesis's claims.

    python -m reproduction.thesis_tables 6.1-6.3          # with --tell: print the commands only

The command trains three seeds of every row that takes at most five minutes of one core (`modelnet40_quick`), and one
seed of the others (`modelnet40_slow`). Two rows take hours each and are left out (`thesis_tables.BY_HAND`). Add
`--bfloat16` if /proc/cpuinfo lists avx512_bf16; other processors emulate it and are much slower. To evaluate sweeps
that have already run, also ones with fewer rows:

    python -m reproduction.chapter6.modelnet40 outputs/thesis_tables/modelnet40_quick \\
        outputs/thesis_tables/modelnet40_slow

The script measures latencies on one thread, with the encoding included. It lets every model predict the test clouds
again, so that methods are compared cloud by cloud, which takes some minutes more. It writes modelnet40.md beside this
file.
"""

import math
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import framework
from benchmarks.pages import machine, publish
from benchmarks.sweeps import processor_seconds, read_runs, record
from framework.configuration.schema import build, resolve
from framework.distributions.class_probabilities import class_probabilities
from framework.errors import DataError
from framework.evaluation.cost import wall_time
from framework.reports.table import Better, aggregate, markdown

ROWS = {  # table and row, name, then accuracy, FLOPs and parameters in the thesis
    "voxnet": ("6.1, 1", "VoxNet (32³ occupancy)", "83.0 %", "> 1e8", "9.0e5"),
    "occ_mlp_32": ("6.1, 2", "Occ-MLP (32³)", "79.9 %", "3.4e7", "1.7e7"),
    "occ_mlp_8": ("6.1, 3", "Occ-MLP (8³)", "74.5 %", "1.1e6", "5.5e5"),
    "tdf_mlp_32": ("6.1, 4", "TDF-MLP (32³)", "80.0 %", "3.4e7", "1.7e7"),
    "tdf_mlp_8": ("6.1, 5", "TDF-MLP (8³)", "75.9 %", "1.1e6", "5.5e5"),
    "bps_mlp_grid_32": ("6.1, 6", "BPS-MLP (32³ grid)", "88.3 %", "3.4e7", "1.7e7"),
    "bps_mlp_grid_8": ("6.1, 7", "BPS-MLP (8³ grid)", "87.6 %", "1.1e6", "5.5e5"),
    "bps_mlp_ball_grid": ("6.1, 8", "BPS-MLP (512, ball grid)", "87.7 %", "1.1e6", "5.5e5"),
    "bps_mlp": ("6.1, 9", "BPS-MLP (512, random)", "88.0 %", "1.1e6", "5.5e5"),
    "bps_mlp_hexagonal": ("6.1, 10", "BPS-MLP (512, hexagonal)", "88.1 %", "1.1e6", "5.5e5"),
    "bps_conv3d": ("6.1, 11", "BPS-Conv3D", "89.8 %", "3.5e8", "1.7e7"),
    "bps_mlp_delta": ("6.1, 12", "BPS-MLP, deltas", "86.2 %", "2.2e6", "1.1e6"),
    "bps_conv3d_delta": ("6.1, 13", "BPS-Conv3D, deltas", "90.8 %", "3.8e8", "1.7e7"),
    "bps_extra_trees": ("6.1, 14", "BPS-ERT (16³ grid)", "85.4 %", "-", "-"),
    "bps_xgboost": ("6.1, 15", "BPS-XGBoost (32³ grid)", "86.1 %", "-", "-"),
    "pointnet": ("6.2", "PointNet", "89.3 %", "4.4e8", "3.5e6"),
    "pointnet_vanilla": ("6.2", "PointNet (vanilla)", "87.2 %", "1.4e8", "8.0e5"),
    "pointnet2": ("6.2; 6.3", "PointNet++, balls of three sizes", "90.7 %", "1.6e9", "1.7e6"),
    "pointnet2_single": ("beyond", "PointNet++, balls of one size", "-", "-", "-"),
    "deepsets": ("6.2", "DeepSets", "90.0 %", "1.5e9", "2.1e5"),
    "deepsets_micro": ("6.2", "DeepSets (micro)", "82.0 %", "3.8e7", "2.1e5"),
    "bps_mlp_400": ("6.2; 6.3", "BPS-MLP (512, random), two layers of 400", "89.0 %", "7.6e5", "3.8e5"),
    "bps_conv3d_unpadded": ("6.2; 6.3", "BPS-Conv3D, deltas, unpadded", "90.8 %", "3.5e8", "4.4e6"),
    "bps_conv3d_ensemble": ("6.2", "BPS-Conv3D, ten networks", "91.6 %", "3.5e9", "4.4e7"),
    "bps_mlp_ensemble": ("beyond", "BPS-MLP, ten networks", "-", "-", "-"),
}
COLUMNS = {
    "method": "method",
    "table": "table, row",
    "accuracy": "accuracy",
    "nll": "NLL (nats)",
    "ece": "ECE",
    "flops_per_sample": "FLOPs",
    "parameters": "parameters",
    "megabytes": "checkpoint, MB",
    "one_ms": "ms, batch of 1",
    "many_ms": "ms / cloud, batch of 256",
    "seconds": "processor time of the run, s",
    "epochs": "epochs",
    "n": "seeds",
    "thesis": "thesis: accuracy (ModelNet40), FLOPs, parameters",
}
BETTER: Better = {"accuracy": "higher", "nll": "lower", "ece": "lower", "one_ms": "lower", "many_ms": "lower"}
SCORES = ("accuracy", "nll")
"""Scores whose standard errors are computed here, from the scores of single clouds."""
BLOCK = 256
"""Number of clouds in a batch."""


class Contrast(NamedTuple):
    """A comparison that the thesis makes: `margin` + Σ weight · accuracy is above 0.

    Attributes:
        claim: The comparison in words.
        thesis: The difference that the thesis reports, in percentage points.
        weights: Weight of the accuracy of each method, by the name of its experiment.
        margin: Allowed loss of accuracy, between 0 and 1.
    """

    claim: str
    thesis: str
    weights: Mapping[str, float]
    margin: float = 0.0


def accuracy_gain(first: str, second: str) -> dict[str, float]:
    return {first: 1.0, second: -1.0}


def extra_loss(grid: str, other: str) -> dict[str, float]:
    """Return weights of accuracies, with which their weighted sum is the loss of `other` minus the loss of `grid`.

    A loss is the accuracy with 32³ cells or basis points minus the accuracy with 8³.
    """
    return {f"{other}_32": 1.0, f"{other}_8": -1.0, f"{grid}_32": -1.0, f"{grid}_8": 1.0}


CLAIMS: dict[str, tuple[Contrast, ...]] = {
    "Basis point sets are better than occupancy and truncated distances (§6.5.1)": (
        Contrast("better than occupancy, 32³", "+8.4", accuracy_gain("bps_mlp_grid_32", "occ_mlp_32")),
        Contrast("better than occupancy, 8³", "+13.1", accuracy_gain("bps_mlp_grid_8", "occ_mlp_8")),
        Contrast(
            "better than truncated distances, 32³", "+8.3", accuracy_gain("bps_mlp_grid_32", "tdf_mlp_32")
        ),
        Contrast(
            "better than truncated distances, 8³", "+11.7", accuracy_gain("bps_mlp_grid_8", "tdf_mlp_8")
        ),
    ),
    "A plain network on basis point sets is better than VoxNet on occupancy (§6.5.1)": (
        Contrast("32³: better than VoxNet", "+5.3", accuracy_gain("bps_mlp_grid_32", "voxnet")),
    ),
    "A small grid of basis points costs little accuracy (§6.5.1)": (
        Contrast(
            "8³ loses less than two points against 32³",
            "0.7",
            accuracy_gain("bps_mlp_grid_8", "bps_mlp_grid_32"),
            0.02,
        ),
        Contrast("8³ loses less than occupancy does", "0.7, 5.4", extra_loss("bps_mlp_grid", "occ_mlp")),
        Contrast(
            "8³ loses less than truncated distances do", "0.7, 4.1", extra_loss("bps_mlp_grid", "tdf_mlp")
        ),
    ),
    "Truncated distances are hardly better than occupancy (§6.5.1)": (
        Contrast(
            "32³: better by less than two points", "+0.1", accuracy_gain("occ_mlp_32", "tdf_mlp_32"), 0.02
        ),
        Contrast("8³: better by less than two points", "+1.4", accuracy_gain("occ_mlp_8", "tdf_mlp_8"), 0.02),
    ),
    "A small grid costs other encodings accuracy (§6.5.1)": (
        Contrast("occupancy: 32³ better than 8³", "5.4", accuracy_gain("occ_mlp_32", "occ_mlp_8")),
        Contrast("truncated distances: 32³ better than 8³", "4.1", accuracy_gain("tdf_mlp_32", "tdf_mlp_8")),
    ),
    "With occupancy the plain network is below VoxNet (Table 6.1)": (
        Contrast("32³: VoxNet better", "+3.1", accuracy_gain("voxnet", "occ_mlp_32")),
    ),
    "Other arrangements of 512 points are better than a grid (Table 6.1)": (
        Contrast("random better than grid", "+0.4", accuracy_gain("bps_mlp", "bps_mlp_grid_8")),
        Contrast("hexagonal better than grid", "+0.5", accuracy_gain("bps_mlp_hexagonal", "bps_mlp_grid_8")),
    ),
    "Boosting is better than extremely randomised trees (Table 6.1)": (
        Contrast(
            "boosting on 32³ better than trees on 16³",
            "+0.7",
            accuracy_gain("bps_xgboost", "bps_extra_trees"),
        ),
    ),
    "3D convolutions are better than the plain network (§6.5.1)": (
        Contrast(
            "convolutions better than plain, distances, 32³",
            "+1.5",
            accuracy_gain("bps_conv3d", "bps_mlp_grid_32"),
        ),
    ),
    "Vectors harm the plain network and help the convolutions (§6.5.1)": (
        Contrast(
            "plain network: distances better than vectors", "+1.8", accuracy_gain("bps_mlp", "bps_mlp_delta")
        ),
        Contrast(
            "convolutions: vectors better than distances",
            "+1.0",
            accuracy_gain("bps_conv3d_delta", "bps_conv3d"),
        ),
    ),
    "Rotated copies of the training clouds help (§6.5.1)": (
        Contrast(
            "four copies better than one", "+1.0, with a schedule", accuracy_gain("bps_mlp turned", "bps_mlp")
        ),
    ),
    "PointNet's transforms help (Table 6.2)": (
        Contrast("with better than without", "+2.1", accuracy_gain("pointnet", "pointnet_vanilla")),
    ),
    "Basis points and a plain network are as accurate as PointNet (§6.5.1)": (
        Contrast(
            "less than two points below PointNet", "-0.3", accuracy_gain("bps_mlp_400", "pointnet"), 0.02
        ),
    ),
    "DeepSets is better than other networks (Table 6.2)": (
        Contrast(
            "better than the plain network of 400 units", "+1.0", accuracy_gain("deepsets", "bps_mlp_400")
        ),
        Contrast("better than PointNet", "+0.7", accuracy_gain("deepsets", "pointnet")),
        Contrast("2048 points better than 100 points", "+8.0", accuracy_gain("deepsets", "deepsets_micro")),
    ),
    "3D convolutions on vectors are as accurate as PointNet++ (Table 6.2)": (
        Contrast(
            "less than two points below PointNet++ with balls of one size",
            "+0.1, balls of three sizes",
            accuracy_gain("bps_conv3d_unpadded", "pointnet2_single"),
            0.02,
        ),
    ),
    "Ten convolutional networks are better than one (Table 6.2)": (
        Contrast(
            "mean of ten probabilities better than one network",
            "+0.8",
            accuracy_gain("bps_conv3d_ensemble", "bps_conv3d_unpadded"),
        ),
    ),
}


class Method(NamedTuple):
    """Scores of the runs of one row for each test cloud.

    Attributes:
        accuracy: 1 where the likeliest class is the true one, else 0.
        nll: Negative log-likelihood of the true class, in nats.
    """

    accuracy: Float[np.ndarray, "seeds clouds"]
    nll: Float[np.ndarray, "seeds clouds"]


def seed_variance(values: Float[np.ndarray, "seeds clouds"]) -> float:
    """Return an unbiased estimate of the variance among seeds of a mean over all possible clouds; it may be below 0.

    This is a two-way analysis of variance without replication. The means of seeds also differ by chance on each cloud,
    which adds the residual variance divided by the number of clouds; this part is subtracted.
    """
    seeds, clouds = values.shape
    residual = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    chance = (residual**2).sum() / ((seeds - 1) * (clouds - 1))
    return float(values.mean(1).var(ddof=1) - chance / clouds)


def pooled_seed_variance(methods: Mapping[str, Method], score: str) -> float:
    """Return the mean of `seed_variance` over methods with several seeds: 0 if negative, NaN if there are none.

    Args:
        methods: Scores of each method.
        score: Name of the score, "accuracy" or "nll".
    """
    variances = [
        seed_variance(getattr(method, score)) for method in methods.values() if len(method.accuracy) > 1
    ]
    return max(0.0, float(np.mean(variances))) if variances else math.nan


def weighted_score(
    methods: Mapping[str, Method], weights: Mapping[str, float], score: str = "accuracy"
) -> tuple[float, float]:
    """Return Σ weight · mean score, and its standard error for new test clouds and new seeds.

    All methods have the same clouds. The part of the variance that the clouds cause is therefore that of Σ weight ·
    score over clouds, with scores averaged over seeds. Every method has seeds of its own, so that the part that the
    seeds cause is Σ weight² · (pooled variance) / seeds. The second part is left out if no row has several seeds.
    """
    among_seeds = np.nan_to_num(pooled_seed_variance(methods, score))
    cloud_scores = sum(weight * getattr(methods[key], score).mean(0) for key, weight in weights.items())
    assert isinstance(cloud_scores, np.ndarray)
    variance = cloud_scores.var(ddof=1) / len(cloud_scores)
    variance += sum(w**2 * among_seeds / len(methods[key].accuracy) for key, w in weights.items())
    return float(cloud_scores.mean()), math.sqrt(variance)


def verdict(value: float, error: float) -> str:
    """Return the verdict on the claim that a value is above 0, at two standard errors."""
    return "held" if value > 2 * error else "contradicted" if value < -2 * error else "open"


def claims_table(methods: Mapping[str, Method]) -> str:
    """Return a table of all comparisons, with the verdict of each claim before its comparisons."""
    lines = [
        "| claim | thesis, points | here, points | standard errors | verdict |",
        "|---|---:|---:|---:|---|",
    ]
    for claim, contrasts in CLAIMS.items():
        verdicts, rows = [], []
        for words, thesis, weights, margin in contrasts:
            missing = [key for key in weights if key not in methods]
            if missing:
                verdicts.append("open")
                rows.append(f"| … {words} | {thesis} | not run: {', '.join(missing)} | | open |")
                continue
            value, error = weighted_score(methods, weights)
            shown = f"{100 * value:+.1f} ± {100 * error:.1f}"
            distance = (value + margin) / error if error else math.copysign(math.inf, value + margin)
            verdicts.append(verdict(value + margin, error))
            rows.append(f"| … {words} | {thesis} | {shown} | {distance:+.1f} | {verdicts[-1]} |")
        claim_verdict = (
            "contradicted" if "contradicted" in verdicts else "open" if "open" in verdicts else "held"
        )
        lines += [f"| **{claim}** | | | | **{claim_verdict}** |", *rows]
    return "\n".join(lines)


def score_clouds(model: Any, clouds: Tensor, labels: Tensor) -> tuple[np.ndarray, np.ndarray, float]:
    """Score the predictions of a model for all test clouds, and measure their time.

    Returns:
        For each cloud 1 if the likeliest class is the true one and 0 otherwise; for each cloud the negative
        log-likelihood of the true class, nats; and the seconds per cloud. The time is the median over batches, because
        the first batch also warms up.
    """
    right, nll, seconds = [], [], []
    with torch.inference_mode():
        for block, label in zip(clouds.split(BLOCK), labels.split(BLOCK), strict=True):
            began = time.perf_counter()
            density = model(block)
            seconds.append((time.perf_counter() - began) / len(block))
            probability = class_probabilities(density)
            right.append(probability.argmax(-1) == label)
            nll.append(-probability.gather(1, label[:, None])[:, 0].log())
    return torch.cat(right).double().numpy(), torch.cat(nll).numpy(), statistics.median(seconds)


def score_runs(sweep: Path, clouds: Tensor, labels: Tensor) -> list[dict[str, Any]]:
    """Return a row for each finished run, with its scores on each test cloud; "key" distinguishes variants of a method.

    Raises:
        DataError: A run was tested on other data than the present test split.
    """
    rows = []
    for run in read_runs(sweep):
        numbers, config = run.results, run.config()
        key = numbers["experiment"].rpartition("/")[2]
        table, method, *thesis = ROWS[key]
        if "conv3d" in key:
            side = round(config["encoder"]["bps"]["points"] ** (1 / 3))
            method += f" ({side}³ grid)"
            key += "" if side == 32 else f" {side}"
        cut = config["encoder"].get("tdf", {}).get("truncation", 1.0)
        if cut != 1:
            method, key = f"{method}, cut off at {cut:g} cells", f"{key} {cut:g}"
        if key == "bps_mlp" and config["data"]["rotations"] > 1:
            method, key = (
                f"{method}, {config['data']['rotations']} rotated copies of each cloud",
                f"{key} turned",
            )
        model = framework.load(run.folder)
        right, nll, block_seconds = score_clouds(model, clouds, labels)
        if abs(right.mean() - numbers["accuracy"]) > 2 / len(right):
            raise DataError(
                f"{run.folder}: the accuracy on the present test clouds is {right.mean():.4f}, but results.json holds "
                f"{numbers['accuracy']:.4f}. The run was made on other data. Repeat the run."
            )
        with torch.inference_mode():
            single_seconds = wall_time(
                lambda model=model: model(clouds[:1]), torch.device("cpu"), budget_seconds=2
            )
        fitted = config["density_head"]["name"] in ("extra_trees", "xgboost")
        rows.append(
            {name: value for name, value in numbers.items() if name in COLUMNS}
            | {
                "key": key,
                "seed": numbers["seed"],
                "method": method,
                "table": table,
                "thesis": ", ".join(thesis),
                "right": right,
                "nlls": nll,
            }
            | {"one_ms": 1e3 * single_seconds, "many_ms": 1e3 * block_seconds}
            | {"megabytes": (run.folder / "checkpoints" / "model.ckpt").stat().st_size / 1e6}
            | {"seconds": processor_seconds(record(run.folder)), "synthetic": numbers["synthetic"]}
            | {"epochs": "at once" if fitted else str(config["trainer"]["max_epochs"])}
        )
    return rows


def collect_scores(rows: Sequence[dict[str, Any]]) -> dict[str, Method]:
    """Remove the scores of single clouds from `rows` and return them by method."""
    pairs_by_key: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for row in rows:
        pairs_by_key.setdefault(row["key"], []).append((row.pop("right"), row.pop("nlls")))
    return {key: Method(*map(np.stack, zip(*pairs, strict=True))) for key, pairs in pairs_by_key.items()}


def main() -> None:
    torch.set_num_threads(1)
    data = build("data", resolve("data", "modelnet40"))
    data.prepare()
    test = data.splits().test
    batch = test.__getitems__(range(len(test)))
    order = list(ROWS)
    rows = [
        row for folder in sys.argv[1:] for row in score_runs(Path(folder), batch["input"], batch["target"])
    ]
    rows.sort(key=lambda row: (order.index(row["key"].split()[0]), row["seed"]))
    methods = collect_scores(rows)
    table = aggregate(rows, by=["method", "key"])
    for row in table:  # replace the deviation among runs by the standard error of this page
        for name in [name for name in row if name.endswith("_std")]:
            del row[name]
        for score in SCORES:
            row[score], row[f"{score}_sem"] = weighted_score(methods, {str(row["key"]): 1.0}, score)
    missing = [words for key, (_, words, *_) in ROWS.items() if key not in methods]
    fingerprint = data.fingerprint()
    among_seeds = pooled_seed_variance(methods, "accuracy")
    boosting = packages_distributions()["xgboost"] if "bps_xgboost" in methods else []
    seed_sentence = (
        "No row has several seeds, so the second variance is missing here."
        if math.isnan(among_seeds)
        else "It corresponds to a standard deviation of the accuracy between seeds of "
        f"{100 * math.sqrt(among_seeds):.2f} points."
    )
    text = (
        "# Tables 6.1 to 6.3: classes of CAD models (synthetic data)\n\n"
        "This page repeats Tables 6.1 to 6.3 of the thesis: point clouds of CAD models are classified. It compares "
        "encodings of a cloud (occupancy, truncated distances, basis point sets) and networks by accuracy and cost.\n\n"
        f"The networks are trained on the generated data set `data=modelnet40` ({fingerprint['version']}): "
        f"{len(data.target.names)} classes, {fingerprint['train']} clouds for training and {fingerprint['test']} for "
        "the test, with 2048 points each. The thesis trains on the real ModelNet40 for thousands of epochs on a GPU. "
        "The order of the methods can therefore be compared with the thesis; absolute numbers cannot. The numbers of "
        "epochs were chosen so that two cores can train all models in a few hours. Learning rates were chosen on the "
        "validation split of an earlier, easier generated set. The text at the top of `modelnet40.py` lists the "
        "commands that train the models. Numbers are means over seeds. "
        f"{'The following methods were not run: ' + '; '.join(missing) + '.' if missing else 'Every row was run.'} A "
        '"ball" is the neighbourhood of a point that PointNet++ reads. '
        "The terms in the tables mean:\n"
        "- **Method** names the encoding and the network: Occ is occupancy, TDF truncated distances, BPS a basis point "
        "set. Deltas are the vectors to the nearest points, in place of distances. MLP is a multilayer perceptron and "
        "Conv3D a convolutional network.\n"
        "- **Micro** means 100 points per cloud, **unpadded** convolutions without zeros around the grid, and **ERT** "
        "extremely randomised trees.\n"
        '- **Table, row** is the place of the method in the thesis; "beyond" means that the thesis has no such '
        "row.\n"
        "- **FLOPs** are per cloud and count matrix products and convolutions.\n"
        "- **ms, batch of 1** is the time of one cloud predicted alone, and **ms / cloud, batch of 256** that of a "
        "cloud in a batch. Both are measured on one thread and include the encoding.\n\n"
        f"{markdown(table, COLUMNS, better=BETTER)}\n\n"
        "In the table above, the number after ± of accuracy and NLL (negative log-likelihood) is the standard error "
        "for new test clouds and new seeds. Its square is the sum of two variances:\n"
        "- The first variance is for the choice of test clouds. The result of each cloud is averaged over seeds; the "
        "variance of these averages over the clouds is divided by the number of clouds.\n"
        "- The second variance is for the choice of seeds: the variance of a result between seeds, without the part "
        "that comes from the finite number of clouds, divided by the number of seeds. The variance between seeds is "
        "estimated once from all rows with several seeds (two-way analysis of variance) and is also used for rows "
        f"with one seed. {seed_sentence}\n\n"
        "## The thesis's claims\n\n"
        "In the table, each claim of the thesis (bold) is tested by one or several comparisons below it. A "
        "comparison is a difference of accuracies on the same test clouds, in percentage points, ± the standard "
        'error as above. The difference must be above 0, or above -2 points where the claim says "less than two '
        'points". **Standard errors** is the difference minus this limit, divided by the standard error. A '
        "comparison is held if this number is above 2, contradicted if it is below -2, and otherwise open. A claim "
        "is held if all its comparisons are held, and contradicted if at least one of them is contradicted.\n\n"
        f"{claims_table(methods)}\n\n"
        f"The {len(rows)} training runs of this page took {sum(row['seconds'] for row in rows) / 3600:.1f} hours on "
        f"one core. {machine('torch', 'pytorch-lightning', 'scikit-learn', *boosting)}\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
