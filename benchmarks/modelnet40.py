"""Tables 6.1, 6.2 and 6.3 on the synthetic CAD set: every row, error and run time, from one multirun.

    python -m framework -m pictures=false logger=none threads=1 trainer.precision=bf16-mixed hydra.launcher.jobs=2 \\
        hydra.sweep.dir=outputs/sweeps/modelnet40 experiment=$(ls conf/experiment/modelnet40 | grep -v base | \\
        sed 's|^|modelnet40/|; s|.yaml$||' | paste -sd,)
    python benchmarks/modelnet40.py outputs/sweeps/modelnet40

An hour on two cores, and some two more with PointNet++; the multirun prints its own table at its end. Leave out
`trainer.precision` on a processor without bfloat16 instructions. Further sweeps (more seeds) are named beside the
first. Latencies are measured here, on one thread; encoding is in them. Writes modelnet40.md beside this file.
"""

import json
import sys
from pathlib import Path
from typing import Any

import torch
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import framework
from benchmarks.machine import machine
from framework.configuration.schema import build, resolve
from framework.evaluation.cost import wall_time
from framework.reports.table import aggregate, markdown

ROWS = {  # table and row, what the thesis reports: accuracy, FLOPs, parameters
    "voxnet": ("6.1, 1", "VoxNet (32³ flags)", "83.0 %", "> 1e8", "9.0e5"),
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
    "seconds": "whole run, s",
    "epochs": "epochs",
    "n": "seeds",
    "thesis": "thesis: accuracy (ModelNet40), FLOPs, parameters",
}
BETTER = {"accuracy": "higher", "nll": "lower", "ece": "lower", "one_ms": "lower", "many_ms": "lower"}


def found(sweep: Path, clouds: torch.Tensor) -> list[dict[str, Any]]:
    rows = []
    for path in sorted(sweep.glob("*/results.json")):
        numbers = json.loads(path.read_text(encoding="utf-8"))
        job = json.loads((path.parent / "job.json").read_text(encoding="utf-8"))
        config = yaml.safe_load((path.parent / "config.yaml").read_text(encoding="utf-8"))
        key = numbers["experiment"].rpartition("/")[2]
        table, method, *thesis = ROWS[key]
        if "conv3d" in key:
            method = f"{method} ({round(config['encoder']['bps']['points'] ** (1 / 3))}³ grid)"
        cut = config["encoder"].get("tdf", {}).get("truncation", 1.0)
        method += "" if cut == 1 else f", cut off at {cut:g} cells"
        model = framework.load(path.parent)
        with torch.inference_mode():
            one = wall_time(lambda model=model: model(clouds[:1]), torch.device("cpu"), budget_seconds=2)
            many = wall_time(lambda model=model: model(clouds), torch.device("cpu"), repeats=5)
        fitted = config["density_head"]["name"] in ("extra_trees", "xgboost")
        rows.append(
            {name: value for name, value in numbers.items() if name.removesuffix("_sem") in COLUMNS}
            | {
                "key": key,
                "seed": numbers["seed"],
                "method": method,
                "table": table,
                "thesis": ", ".join(thesis),
            }
            | {"one_ms": 1e3 * one, "many_ms": 1e3 * many / len(clouds)}
            | {"megabytes": (path.parent / "checkpoints" / "model.ckpt").stat().st_size / 1e6}
            | {"seconds": job["ended"] - job["started"], "synthetic": numbers["synthetic"]}
            | {"from": job["started"], "to": job["ended"]}
            | {"epochs": "at once" if fitted else str(config["trainer"]["max_epochs"])}
        )
    return rows


def main() -> None:
    torch.set_num_threads(1)
    data = build("data", resolve("data", "modelnet40"))
    data.prepare()
    count = min(256, len(data.splits().test))
    clouds = torch.stack([data.splits().test[index]["input"] for index in range(count)])
    order = list(ROWS)
    rows = [row for folder in sys.argv[1:] for row in found(Path(folder), clouds)]
    rows.sort(key=lambda row: order.index(row.pop("key")))
    several = len({row["method"] for row in rows}) < len(rows)
    compared = aggregate(rows, by=["method"]) if several else [{**row, "n": 1} for row in rows]
    fingerprint = data.fingerprint()
    minutes = (max(row["to"] for row in rows) - min(row["from"] for row in rows)) / 60
    text = (
        "# Tables 6.1 to 6.3: classes of CAD models (synthetic data)\n\n"
        f"The generated set of `data=modelnet40`: {len(data.target.names)} classes, {fingerprint['train']} clouds for "
        f"training, {fingerprint['test']} for the test, 2048 points each. The thesis's figures are of ModelNet40 "
        "and a GPU's thousands of epochs: orderings compare, numbers do not. ± is the standard error over test clouds "
        "of one run, over runs where there are several seeds. Latencies on one thread, encoding included. FLOPs are "
        f"those of matrix products and convolutions. {len(rows)} runs took {minutes:.0f} minutes, two at a time on one "
        "core each, matrix products and convolutions of training in bfloat16. Epochs are what that allows; rates were "
        "chosen on the validation split. Commands in `modelnet40.py`.\n\n"
        f"{markdown(compared, COLUMNS, better=BETTER)}\n\n"
        f"{machine('torch', 'pytorch-lightning', 'scikit-learn', 'xgboost')}\n"
    )
    Path(__file__).with_suffix(".md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
