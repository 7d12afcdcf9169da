"""Time registration on one core, measure the rank that it needs, and make Table 6.4.

    python -m reproduction.thesis_tables 6.4
    python -m reproduction.chapter6.registration [<run of registration/quick> [<run of faust/registration>]] \\
        [--scan <file>]

Writes registration.md beside this file; of the first run also its error and, of both, those of the correspondences that
FAUST's challenges ask for, on people generated in its layout; of a scan (one is in the folder REAL_DATA_ROOT) the
figure registration.png. Times are the processor's, of one thread.
"""

import argparse
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median as middle

import numpy as np
import torch
from jaxtyping import Float

import framework
from benchmarks.pages import machine, write_page
from benchmarks.sweeps import record, settings, wall_seconds
from benchmarks.timing import milliseconds
from framework.bodies.default_body import load_default_body
from framework.configuration.schema import build, resolve
from framework.distributions.protocol import median
from framework.reports.table import format_number
from plugins.data.registration.correspond import RegisterScan, model, write_correspondences
from plugins.data.registration.faust import Challenge

HERE = Path(__file__).parent
RANKS = (16, 32, 48, 64, 96, 128)
BODIES, HELD = 3_000, 500
WANTED_MS = 5.0
ROOT = os.environ.get("REAL_DATA_ROOT")
REAL_SCAN = Path(ROOT) / "clouds/demo_scan.ply" if ROOT else None
THESIS: dict[Challenge, float] = {"intra": 2.33, "inter": 4.53}
"""Table 6.4's last row, centimetres."""


def timed(call: Callable[[], object], repeats: int = 100) -> float:
    """Median milliseconds of processor time of a call, of all its threads."""
    return milliseconds(call, repeats, time.process_time)


def residuals(data) -> dict[int, float]:
    """Mean vertex error, cm, of held-out bodies projected onto as many principal components of training bodies."""
    # every k-th sample's target is the mesh in its scan's own frame, as a model has to predict it
    parts = {}
    for name, split, count in (("fitted", data.splits().train, BODIES), ("held", data.splits().test, HELD)):
        batches = [split.__getitems__(range(first, first + 100)) for first in range(0, count, 100)]
        parts[name] = {
            key: torch.cat([batch[key].float() for batch in batches]) for key in ("target", "scale")
        }
    fitted, held = parts["fitted"]["target"], parts["held"]["target"]
    mean = fitted.mean(0)
    fitted = fitted - mean
    values, vectors = torch.linalg.eigh((fitted @ fitted.T).double())
    found = {}
    for rank in RANKS:
        basis = (fitted.T @ vectors[:, -rank:].float()) / values[-rank:].float().sqrt()
        left = (held - mean) - (held - mean) @ basis @ basis.T
        norm = torch.linalg.vector_norm(left.unflatten(1, (-1, 3)), dim=-1) * parts["held"]["scale"][:, None]
        found[rank] = 100 * norm.mean().item()
    return found


def speeds(data) -> list[tuple[str, float]]:
    """Milliseconds of every step for one scan, one thread."""
    split = data.splits().test
    batch = split.__getitems__([0])
    cloud = batch["input"][:, : int((~batch["input"].isnan()).all(-1).sum())]
    shape, pose = split.shape[:64], split.pose[:64]
    encoder = build(
        "encoder",
        resolve("encoder", {"name": "bps", "points": 1024, "normalise": "none"}),
        input_shape=tuple(cloud.shape[1:]),
        input_columns=("x", "y", "z"),
    )
    rows = [
        ("pose one body of 64 (linear blend skinning)", timed(lambda: split.model(shape, pose), 20) / 64),
        ("pose and scan one body of 32", timed(lambda: split.__getitems__(range(32)), 10) / 32),
        (f"encode {cloud.shape[1]} points, 1024 basis points", timed(lambda: encoder(cloud))),
    ]
    features = encoder(cloud)
    numbers = len(data.target.names)
    for rank in (32, 64, 128):
        part = {"name": "dense_blocks", "bottleneck": rank, "standardise": True}
        blocks = build("encoder", resolve("encoder", part), input_shape=(1024,)).eval()
        last = torch.nn.Linear(rank, numbers)
        rows.append((f"forward, rank {rank}", timed(lambda b=blocks, n=last: n(b(features)))))
        rows.append(
            (f"encode and forward, rank {rank}", timed(lambda b=blocks, n=last: n(b(encoder(cloud)))))
        )
    return rows


def main(runs: list[Path], scan: Path | None) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    data = build("data", resolve("data", {"name": "registration"}))
    data.prepare()
    _, traits = load_default_body()
    with torch.inference_mode():
        rows, ranks = speeds(data), residuals(data)
    lines = [
        "# Table 6.4, and the run time of registration",
        "",
        machine("torch", "numba"),
        "",
        f"The default body's vertices are at most {1e6 * traits.largest_error:.2g} µm from where its package puts them "
        "(8 bodies of random shape and pose, float32 against float64).",
        "",
        "| one core | ms |",
        "|---|---:|",
        *(f"| {name} | {value:.2f} |" for name, value in rows),
        "",
        f"Wanted: encode and forward within {WANTED_MS:g} ms.",
        "",
        f"Mean vertex error of {HELD} held-out bodies (synthetic) projected onto principal components of {BODIES} "
        "others: what a last layer of that rank cannot be better than.",
        "",
        "| rank | cm |",
        "|---:|---:|",
        *(f"| {rank} | {value:.2f} |" for rank, value in ranks.items()),
    ]
    if runs:
        lines += ["", *trained(runs[0], data.splits().test)]
        if scan is not None:
            picture(runs[0], scan)
            lines += ["", "![A real scan and the mesh registered to it](registration.png)"]
        lines += ["", *table_64(runs)]
    write_page(__file__, lines)


def trained(run: Path, split) -> list[str]:
    """The errors that a run's own test stage wrote, how long it took, and what one scan costs its model."""
    found = json.loads((run / "results.json").read_text(encoding="utf-8"))
    minutes = format_number(wall_seconds(record(run)) / 60)
    (threads,) = settings([run], "threads")
    model = framework.load(run)
    batch = split.__getitems__([0])
    cloud = batch["input"][:, : int((~batch["input"].isnan()).all(-1).sum())]
    with torch.inference_mode():
        vertices = timed(lambda: median(model(cloud), 1))
    rows = {"all": found, **found.get("groups", {})}
    keys = ("vertex_error_median_cm", "vertex_error_95_cm")
    return [
        f"`experiment={found['experiment']}`: {minutes} minutes from start to report, threads={threads}, "
        f"computing its features included. From a cloud of {cloud.shape[1]} points to a density of all vertices and "
        f"its median, by `framework.load`, one core: {vertices:.2f} ms. Vertex error of held-out bodies (synthetic), "
        "centimetres (± standard error over scans):",
        "",
        "| scans | mean | median | 95 % |",
        "|---|---:|---:|---:|",
        *(
            f"| {name} | {row['vertex_error_cm']:.2f} ± {row['vertex_error_cm_sem']:.2f} | "
            f"{' | '.join(f'{row[key]:.2f}' for key in keys)} |"
            for name, row in rows.items()
        ),
    ]


def table_64(runs: list[Path]) -> list[str]:
    """Correspondences of FAUST's challenges, of people generated in its layout, whose registrations are known."""
    took: list[float] = []
    rows = []
    for run in runs:
        registered, generated = model(str(run))

        def timed_registered(
            scan: Path, registered: RegisterScan = registered
        ) -> Float[np.ndarray, "vertex 3"]:
            start = time.process_time()
            found = registered(scan)
            took.append(time.process_time() - start)
            return found

        experiment = json.loads((run / "results.json").read_text(encoding="utf-8"))["experiment"]
        with tempfile.TemporaryDirectory() as folder:
            for challenge, thesis in THESIS.items():
                errors = np.array(
                    write_correspondences(timed_registered, generated(), challenge, Path(folder)).error_cm
                )
                spread = errors.std(ddof=1) / len(errors) ** 0.5
                shown = f"{errors.mean():.2f} ± {spread:.2f} | {errors.max():.2f}"
                rows.append(f"| `{experiment}` | {challenge} | {len(errors)} | {shown} | {thesis:.2f} |")
    return [
        "## Table 6.4: correspondences (synthetic data)",
        "",
        "People generated in FAUST's layout (`data=faust`; scans of people and poses that no model saw, read as "
        "files): each vertex of the first scan's registration through both registered meshes to the second, mean "
        "distance from its true place there, centimetres; ± standard error over pairs, which share scans and people. "
        "`intra`: one person in two poses, `inter`: two people. `registration/quick` learned from bodies generated by "
        "the thousand, `faust/registration` from the 70 training scans of that layout alone. The thesis's figures are "
        f"of FAUST's real scans and another body. Reading a scan, encoding, registering: {1e3 * middle(took):.0f} ms, "
        "one core.",
        "",
        "| learned by | challenge | pairs | mean error, cm | worst pair, cm | thesis, cm (FAUST) |",
        "|---|---|---:|---:|---:|---:|",
        *rows,
    ]


def picture(run: Path, scan: Path) -> None:
    from plugins.data.registration.__main__ import register

    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        written = register(str(run), [scan], Path(folder))
        shutil.copy(next(file for file in written if file.suffix == ".png"), HERE / "registration.png")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("runs", nargs="*", type=Path)
    arguments.add_argument("--scan", type=Path, default=REAL_SCAN, help=f"default: {REAL_SCAN}")
    given = arguments.parse_args()
    main(given.runs, given.scan)
