"""Make Tables 6.1 to 6.3 on synthetic CAD models, with errors, run times and the thesis's claims.

    python -m reproduction.thesis_tables 6.1-6.3          # with --tell it prints its sweeps, to run one by one

That is three seeds of every row that takes at most five minutes of one core (`modelnet40_quick`), and one of the
others (`modelnet40_slow`), but for two that take hours by themselves (`thesis_tables.BY_HAND`). Add `--bfloat16` where
/proc/cpuinfo lists avx512_bf16; elsewhere it is emulated, and slower by far. Of sweeps that have run, these or others
with fewer rows:

    python -m reproduction.chapter6.modelnet40 outputs/thesis_tables/modelnet40_quick \\
        outputs/thesis_tables/modelnet40_slow

Latencies are measured here, on one thread; encoding is in them. Every model predicts the test clouds again, so that
methods are compared cloud by cloud: minutes more. Writes modelnet40.md beside this file.
"""

import json
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
import yaml
from jaxtyping import Float
from torch import Tensor

import framework
from benchmarks.pages import machine, write_page
from benchmarks.sweeps import processor_seconds, record
from framework.configuration.schema import build, resolve
from framework.distributions.class_probabilities import class_probabilities
from framework.errors import DataError
from framework.evaluation.cost import wall_time
from framework.reports.table import Better, aggregate, markdown

ROWS = {  # table and row, what the thesis reports: accuracy, FLOPs, parameters
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
    "many_ms": "ms / cloud, 256",
    "seconds": "whole run, processor s",
    "epochs": "epochs",
    "n": "seeds",
    "thesis": "thesis: accuracy (ModelNet40), FLOPs, parameters",
}
BETTER: Better = {"accuracy": "higher", "nll": "lower", "ece": "lower", "one_ms": "lower", "many_ms": "lower"}
SCORES = ("accuracy", "nll")
"""Means over test clouds; their errors are computed here, from the clouds' own numbers."""
BLOCK = 256
"""Clouds that are predicted at once."""


class Contrast(NamedTuple):
    """A comparison of the thesis: `margin` + Σ weight · accuracy is above 0.

    Attributes:
        claim: in words.
        thesis: what it reports, in points.
        weights: of methods, by their experiments.
        margin: a share of the clouds.
    """

    claim: str
    thesis: str
    weights: Mapping[str, float]
    margin: float = 0.0


def better(one: str, other: str) -> dict[str, float]:
    return {one: 1.0, other: -1.0}


def cheaper(grid: str, other: str) -> dict[str, float]:
    """How much more `other` loses than `grid` does, from 32³ to 8³."""
    return {f"{other}_32": 1.0, f"{other}_8": -1.0, f"{grid}_32": -1.0, f"{grid}_8": 1.0}


CLAIMS: dict[str, tuple[Contrast, ...]] = {
    "Basis point sets are better than occupancy and truncated distances (§6.5.1)": (
        Contrast("than occupancy, 32³", "+8.4", better("bps_mlp_grid_32", "occ_mlp_32")),
        Contrast("than occupancy, 8³", "+13.1", better("bps_mlp_grid_8", "occ_mlp_8")),
        Contrast("than truncated distances, 32³", "+8.3", better("bps_mlp_grid_32", "tdf_mlp_32")),
        Contrast("than truncated distances, 8³", "+11.7", better("bps_mlp_grid_8", "tdf_mlp_8")),
    ),
    "A plain network on them is better than VoxNet on occupancy (§6.5.1)": (
        Contrast("32³", "+5.3", better("bps_mlp_grid_32", "voxnet")),
    ),
    "A small grid costs them little (§6.5.1)": (
        Contrast(
            "8³ instead of 32³: less than two points",
            "0.7",
            better("bps_mlp_grid_8", "bps_mlp_grid_32"),
            0.02,
        ),
        Contrast("less than it costs occupancy", "0.7, 5.4", cheaper("bps_mlp_grid", "occ_mlp")),
        Contrast("less than it costs truncated distances", "0.7, 4.1", cheaper("bps_mlp_grid", "tdf_mlp")),
    ),
    "Truncated distances are hardly better than occupancy (§6.5.1)": (
        Contrast("32³: by less than two points", "+0.1", better("occ_mlp_32", "tdf_mlp_32"), 0.02),
        Contrast("8³: by less than two points", "+1.4", better("occ_mlp_8", "tdf_mlp_8"), 0.02),
    ),
    "A small grid costs others (§6.5.1)": (
        Contrast("occupancy", "5.4", better("occ_mlp_32", "occ_mlp_8")),
        Contrast("truncated distances", "4.1", better("tdf_mlp_32", "tdf_mlp_8")),
    ),
    "With occupancy the plain network is below VoxNet (Table 6.1)": (
        Contrast("32³", "+3.1", better("voxnet", "occ_mlp_32")),
    ),
    "Other arrangements of 512 points are better than a grid (Table 6.1)": (
        Contrast("random", "+0.4", better("bps_mlp", "bps_mlp_grid_8")),
        Contrast("hexagonal", "+0.5", better("bps_mlp_hexagonal", "bps_mlp_grid_8")),
    ),
    "Boosting is better than extremely randomised trees (Table 6.1)": (
        Contrast("of other grids", "+0.7", better("bps_xgboost", "bps_extra_trees")),
    ),
    "3D convolutions are better than the plain network (§6.5.1)": (
        Contrast("distances, 32³", "+1.5", better("bps_conv3d", "bps_mlp_grid_32")),
    ),
    "Vectors harm the plain network and help the convolutions (§6.5.1)": (
        Contrast("plain: distances above vectors", "+1.8", better("bps_mlp", "bps_mlp_delta")),
        Contrast("convolutions: vectors above distances", "+1.0", better("bps_conv3d_delta", "bps_conv3d")),
    ),
    "Turned copies of the training clouds help (§6.5.1)": (
        Contrast("four instead of one", "+1.0, with a schedule", better("bps_mlp turned", "bps_mlp")),
    ),
    "PointNet's transforms help (Table 6.2)": (
        Contrast("with and without", "+2.1", better("pointnet", "pointnet_vanilla")),
    ),
    "Basis points and a plain network are as accurate as PointNet (§6.5.1)": (
        Contrast("less than two points below", "-0.3", better("bps_mlp_400", "pointnet"), 0.02),
    ),
    "DeepSets is better than (Table 6.2)": (
        Contrast("the plain network of 400 units", "+1.0", better("deepsets", "bps_mlp_400")),
        Contrast("PointNet", "+0.7", better("deepsets", "pointnet")),
        Contrast("itself with 100 points", "+8.0", better("deepsets", "deepsets_micro")),
    ),
    "3D convolutions on vectors are as accurate as PointNet++ (Table 6.2)": (
        Contrast(
            "less than two points below, balls of one size",
            "+0.1, balls of three sizes",
            better("bps_conv3d_unpadded", "pointnet2_single"),
            0.02,
        ),
    ),
    "Ten convolutional networks are better than one (Table 6.2)": (
        Contrast("mean of their probabilities", "+0.8", better("bps_conv3d_ensemble", "bps_conv3d_unpadded")),
    ),
}


class Method(NamedTuple):
    """What the runs of one row say of each test cloud.

    Attributes:
        accuracy: 1 where the likeliest class is the true one, else 0.
        nll: of the true class, nats.
    """

    accuracy: Float[np.ndarray, "seeds clouds"]
    nll: Float[np.ndarray, "seeds clouds"]


def seed_variance(values: Float[np.ndarray, "seeds clouds"]) -> float:
    """Of a run's mean over all clouds there are, among seeds, without bias: it may come out below 0.

    Two-way analysis of variance without replication: the means of seeds also differ because on each cloud they differ
    by chance, by the residual variance over the number of clouds.
    """
    seeds, clouds = values.shape
    residual = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    chance = (residual**2).sum() / ((seeds - 1) * (clouds - 1))
    return float(values.mean(1).var(ddof=1) - chance / clouds)


def pooled(methods: Mapping[str, Method], score: str) -> float:
    """The mean of it over all rows of several seeds: three seeds of one row know little. NaN where there are none."""
    found = [seed_variance(getattr(own, score)) for own in methods.values() if len(own.accuracy) > 1]
    return max(0.0, float(np.mean(found))) if found else math.nan


def compared(
    methods: Mapping[str, Method], weights: Mapping[str, float], score: str = "accuracy"
) -> tuple[float, float]:
    """Σ weight · mean score, and its standard error over new test clouds and new seeds.

    Clouds: the same for all methods, hence the variance of Σ weight · score over clouds, of means over seeds; what
    differs by chance from seed to seed on each cloud is in it. Seeds: of every method its own, hence
    Σ weight² · (pooled variance) / seeds. Without a row of several seeds only the clouds are in it.
    """
    among_seeds = np.nan_to_num(pooled(methods, score))
    each = sum(weight * getattr(methods[key], score).mean(0) for key, weight in weights.items())
    assert isinstance(each, np.ndarray)
    variance = each.var(ddof=1) / len(each)
    variance += sum(w**2 * among_seeds / len(methods[key].accuracy) for key, w in weights.items())
    return float(each.mean()), math.sqrt(variance)


def verdict(value: float, error: float) -> str:
    """Of a claim that the value is above 0, at two standard errors."""
    return "held" if value > 2 * error else "contradicted" if value < -2 * error else "open"


def claims(methods: Mapping[str, Method]) -> str:
    """A table: each comparison, and what the claim amounts to: held where all are, contradicted where any is."""
    lines = [
        "| claim | thesis, points | here, points | standard errors | verdict |",
        "|---|---:|---:|---:|---|",
    ]
    for claim, contrasts in CLAIMS.items():
        said, rows = [], []
        for words, thesis, weights, margin in contrasts:
            missing = [key for key in weights if key not in methods]
            if missing:
                said.append("open")
                rows.append(f"| … {words} | {thesis} | not run: {', '.join(missing)} | | open |")
                continue
            value, error = compared(methods, weights)
            shown = f"{100 * value:+.1f} ± {100 * error:.1f}"
            size = (value + margin) / error if error else math.copysign(math.inf, value + margin)
            said.append(verdict(value + margin, error))
            rows.append(f"| … {words} | {thesis} | {shown} | {size:+.1f} | {said[-1]} |")
        whole = "contradicted" if "contradicted" in said else "open" if "open" in said else "held"
        lines += [f"| **{claim}** | | | | **{whole}** |", *rows]
    return "\n".join(lines)


def on_test(model: Any, clouds: Tensor, labels: Tensor) -> tuple[np.ndarray, np.ndarray, float]:
    """Of every test cloud whether its class is found, and the true class's negative log-likelihood.

    The seconds are those of a cloud in the median of the blocks: the first of them warms up.
    """
    right, nll, seconds = [], [], []
    with torch.inference_mode():
        for some, label in zip(clouds.split(BLOCK), labels.split(BLOCK), strict=True):
            began = time.perf_counter()
            density = model(some)
            seconds.append((time.perf_counter() - began) / len(some))
            probability = class_probabilities(density)
            right.append(probability.argmax(-1) == label)
            nll.append(-probability.gather(1, label[:, None])[:, 0].log())
    return torch.cat(right).double().numpy(), torch.cat(nll).numpy(), statistics.median(seconds)


def found(sweep: Path, clouds: Tensor, labels: Tensor) -> list[dict[str, Any]]:
    """A row for each run that is done, with its scores on each test cloud; "key" tells variants of a row apart.

    Raises:
        DataError: a run was tested on other data than those made now.
    """
    rows = []
    for path in sorted(sweep.glob("*/results.json")):
        numbers = json.loads(path.read_text(encoding="utf-8"))
        config = yaml.safe_load((path.parent / "config.yaml").read_text(encoding="utf-8"))
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
            method, key = f"{method}, {config['data']['rotations']} turns of each cloud", f"{key} turned"
        model = framework.load(path.parent)
        right, nll, many = on_test(model, clouds, labels)
        if abs(right.mean() - numbers["accuracy"]) > 2 / len(right):
            raise DataError(
                f"{path.parent}: accuracy {right.mean():.4f} on the test clouds made now, {numbers['accuracy']:.4f} in "
                "its results; wanted the same. It was run on other data: run it anew."
            )
        with torch.inference_mode():
            one = wall_time(lambda model=model: model(clouds[:1]), torch.device("cpu"), budget_seconds=2)
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
            | {"one_ms": 1e3 * one, "many_ms": 1e3 * many}
            | {"megabytes": (path.parent / "checkpoints" / "model.ckpt").stat().st_size / 1e6}
            | {"seconds": processor_seconds(record(path.parent)), "synthetic": numbers["synthetic"]}
            | {"epochs": "at once" if fitted else str(config["trainer"]["max_epochs"])}
        )
    return rows


def by_method(rows: Sequence[dict[str, Any]]) -> dict[str, Method]:
    """The clouds' scores of each row of the tables; takes them out of `rows`."""
    kept: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for row in rows:
        kept.setdefault(row["key"], []).append((row.pop("right"), row.pop("nlls")))
    return {key: Method(*map(np.stack, zip(*pairs, strict=True))) for key, pairs in kept.items()}


def main() -> None:
    torch.set_num_threads(1)
    data = build("data", resolve("data", "modelnet40"))
    data.prepare()
    test = data.splits().test
    batch = test.__getitems__(range(len(test)))
    order = list(ROWS)
    rows = [row for folder in sys.argv[1:] for row in found(Path(folder), batch["input"], batch["target"])]
    rows.sort(key=lambda row: (order.index(row["key"].split()[0]), row["seed"]))
    methods = by_method(rows)
    table = aggregate(rows, by=["method", "key"])
    for row in table:  # its own errors instead of the deviation among runs
        for name in [name for name in row if name.endswith("_std")]:
            del row[name]
        for score in SCORES:
            row[score], row[f"{score}_sem"] = compared(methods, {str(row["key"]): 1.0}, score)
    missing = [words for key, (_, words, *_) in ROWS.items() if key not in methods]
    fingerprint = data.fingerprint()
    among_seeds = pooled(methods, "accuracy")
    boosting = packages_distributions()["xgboost"] if "bps_xgboost" in methods else []
    known = (
        "No row has several: it is not in the errors."
        if math.isnan(among_seeds)
        else f"One run's accuracy has {100 * math.sqrt(among_seeds):.2f} points of it."
    )
    text = (
        "# Tables 6.1 to 6.3: classes of CAD models (synthetic data)\n\n"
        f"The generated set of `data=modelnet40` ({fingerprint['version']}): {len(data.target.names)} classes, "
        f"{fingerprint['train']} clouds for training, {fingerprint['test']} for the test, 2048 points each. The "
        "thesis trains on ModelNet40 for thousands of epochs on a GPU, so orderings compare and absolute numbers do "
        "not. Latencies are measured on one thread and include the encoding. FLOPs count matrix products and "
        "convolutions. The number of epochs is what two cores allow; learning rates were chosen on the validation "
        "split of an earlier, easier generated set. The commands are in `modelnet40.py`. Numbers are means over "
        f"seeds. {'Not run: ' + '; '.join(missing) + '.' if missing else 'Every row was run.'}\n\n"
        f"{markdown(table, COLUMNS, better=BETTER)}\n\n"
        "± of accuracy and NLL is the standard error over new test clouds and new seeds: the variance over clouds of "
        "the mean over seeds, and the variance among seeds beyond what clouds explain over the number of seeds. The "
        "latter is estimated once, over all rows of several seeds (two-way analysis of variance), and so it also "
        f"stands for rows of one. {known}\n\n"
        "## The thesis's claims\n\n"
        "Differences of accuracy on the same test clouds (paired), ± as above; at two standard errors a comparison is "
        "held or contradicted, else open. A claim is held where all its comparisons are, contradicted where one is. "
        "The column before the verdict is the distance from the bound: 0, or two points where less is said.\n\n"
        f"{claims(methods)}\n\n"
        f"{len(rows)} runs took {sum(row['seconds'] for row in rows) / 3600:.1f} hours of one core. "
        f"{machine('torch', 'pytorch-lightning', 'scikit-learn', *boosting)}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
