"""Remove the suspected cause of each contradicted claim and run its models again.

    python -m reproduction.thesis_tables            (first: it is compared with their runs)
    python -m reproduction.contradictions

Less than an hour of two cores; what has run in outputs/contradictions does not run again. Writes contradictions.md
beside this file.
"""

import json
import math
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, write_page
from benchmarks.sweeps import record
from framework.errors import DataError
from framework.reports.table import Row, aggregate, markdown
from plugins.data.head_pose.idiap import Idiap
from plugins.data.head_pose.idiap_labels import LABELS, Label, read_labels, write_labels
from reproduction import thesis_tables

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/contradictions"
NOISY = FOLDER / "noisy_heads"
NOISE_DEG = 6.0
"""Standard deviation of the angles' errors."""
COMMON = (*thesis_tables.SAID, "threads=1")
MOONS = {
    "ece": "ECE",
    "brier": "Brier",
    "entropy_test": "entropy, test points (nats)",
    "ood_entropy": "entropy, outliers (nats)",
    "auroc": "AUROC",
}
CLASSES = {"accuracy": "accuracy", "nll": "NLL (nats)", "ece": "ECE"}
VIEWS = {"log_likelihood": "log-likelihood (nats)", "acc_pi_6": "Acc π/6", "mederr_deg": "MedErr °"}
SPLIT = {"log_likelihood": "log-likelihood (nats)", "mode_mass_min": "mass at the weaker azimuth"}
HEADS = {"log_likelihood": "log-likelihood (nats)", "maad_deg": "MAAD °"}
LONGER = "trainer.max_epochs=40"


class Part(NamedTuple):
    """A question, what is run for it, and the rows that answer.

    Attributes:
        text: the question.
        claims: those of claims.md that it is about.
        sweep: its folder in outputs/contradictions.
        words: what its multirun is told.
        rows: by label, the folder of a sweep, of the tables or this one's, and words that its runs have been told.
        columns: key → header.
    """

    text: str
    claims: str
    sweep: str
    words: tuple[str, ...]
    rows: Mapping[str, tuple[str, ...]]
    columns: Mapping[str, str]


PARTS = (
    Part(
        "Outliers drawn from the whole square also lie among the data. `clearance` leaves out those that are nearer "
        "to a sample of the batch.",
        "2-48, 2-49, 2-51",
        "clearance",
        (
            "experiment=moons/outlier_exposure",
            "objective.outlier_exposure.clearance=0.25,0.5",
            "seed=0,1,2,3,4",
        ),
        {
            "a network, 512": ("moons", "experiment=moons/vanilla_512"),
            "outlier exposure": ("moons", "experiment=moons/outlier_exposure"),
            "… clearance 0.25": ("clearance", "objective.outlier_exposure.clearance=0.25"),
            "… clearance 0.5": ("clearance", "objective.outlier_exposure.clearance=0.5"),
        },
        MOONS,
    ),
    Part(
        "Distances are truncated after the edge of one cell, which is four times as long in 8³ cells as in 32³; four "
        "edges of a small cell are the one of a large cell.",
        "6-30, 6-34",
        "truncation",
        ("experiment=modelnet40/tdf_mlp_32", "encoder.tdf.truncation=4", "seed=0,1,2"),
        {
            "8³, one edge": ("modelnet40_quick", "experiment=modelnet40/tdf_mlp_8"),
            "32³, one edge": ("modelnet40_quick", "experiment=modelnet40/tdf_mlp_32"),
            "32³, four edges": ("truncation",),
            "32³, not truncated (basis points)": (
                "modelnet40_quick",
                "experiment=modelnet40/bps_mlp_grid_32",
            ),
        },
        CLASSES,
    ),
    Part(
        "Labels of drawn heads are exact, those of real ones are not. To every angle of both splits a normal error of "
        f"{NOISE_DEG:g}° is added.",
        "3-32, 3-33, 3-34",
        "label_noise",
        (
            "experiment=idiap/fixed_kappa,idiap/von_mises,idiap/cvae",
            "data.angles=[pan],[roll]",
            thesis_tables.SMALL,
            f"data.root={NOISY}",
            "seed=0,1,2",
        ),
        {
            f"{angle}: {name}{noise}": (folder, f"experiment=idiap/{method}", f"data.angles=[{angle}]")
            for angle in ("pan", "roll")
            for folder, noise in (("idiap", ""), ("label_noise", ", noise"))
            for method, name in (
                ("fixed_kappa", "one κ"),
                ("von_mises", "von Mises"),
                ("cvae", "CVAE"),
            )
        },
        HEADS,
    ),
    Part(
        "Twice as many epochs: cars, which look different from every side.",
        "3-11",
        "cars",
        ("experiment=pascal3d/scvae", "data.category=car", LONGER, "seed=0,1,2"),
        {
            "one κ, 20 epochs": ("pascal3d", "experiment=pascal3d/fixed_kappa", "data.category=car"),
            "sCVAE, 20 epochs": ("pascal3d", "experiment=pascal3d/scvae", "data.category=car"),
            "sCVAE, 40 epochs": ("cars",),
        },
        VIEWS,
    ),
    Part(
        "The same of tables, which look alike after half a turn.",
        "3-27",
        "tables",
        ("experiment=pascal3d/cvae,pascal3d/scvae", "data.category=diningtable", LONGER, "seed=0,1,2"),
        {
            f"{name}, {epochs} epochs": (folder, f"experiment=pascal3d/{method}", "data.category=diningtable")
            for method, name in (("cvae", "CVAE"), ("scvae", "sCVAE"))
            for folder, epochs in (("pascal3d", 20), ("tables", 40))
        },
        SPLIT,
    ),
    Part(
        "The row's boosting has 50 rounds, each of a fiftieth of the features, to take minutes. Four times as many "
        "rounds.",
        "6-42",
        "boosting",
        ("experiment=modelnet40/bps_xgboost", "density_head.rounds=200", "seed=0"),
        {
            "50 rounds": ("modelnet40_quick", "experiment=modelnet40/bps_xgboost"),
            "200 rounds": ("boosting",),
            "extremely randomised trees": ("modelnet40_quick", "experiment=modelnet40/bps_extra_trees"),
        },
        CLASSES,
    ),
    Part(
        "Twice as many epochs of DeepSets, beside the networks that it is compared with.",
        "6-52, 6-56, 6-57",
        "deepsets",
        ("experiment=modelnet40/deepsets", LONGER, "seed=0"),
        {
            "DeepSets, 20 epochs": ("modelnet40_slow", "experiment=modelnet40/deepsets"),
            "DeepSets, 40 epochs": ("deepsets",),
            "PointNet, 20 epochs": ("modelnet40_slow", "experiment=modelnet40/pointnet"),
            "basis points, two layers of 400": ("modelnet40_quick", "experiment=modelnet40/bps_mlp_400"),
            "basis points, two layers of 512, four turns": ("modelnet40_turned",),
        },
        CLASSES,
    ),
)


def write_noisy_heads() -> None:
    """The drawn heads' figures, and their labels with errors, unless they are there."""
    if (NOISY / LABELS).exists():
        return
    drawn = Idiap().source.folder()
    random = np.random.default_rng(0)
    shutil.copytree(drawn, NOISY, dirs_exist_ok=True, ignore=shutil.ignore_patterns(LABELS))
    labels = {
        split: [Label(label.name, wrong(label.angles, random)) for label in some]
        for split, some in read_labels(drawn / LABELS, "radians").items()
    }
    unfinished = NOISY / f"{LABELS}.unfinished"
    write_labels(unfinished, labels)
    unfinished.replace(NOISY / LABELS)


def wrong(angles: tuple[float, float, float], random: np.random.Generator) -> tuple[float, float, float]:
    """Of radians."""
    pan, tilt, roll = random.normal(angles, math.radians(NOISE_DEG))
    return float(pan), float(tilt), float(roll)


def runs(part: Part, label: str) -> list[Path]:
    """Of a row.

    Raises:
        DataError: there is none.
    """
    sweep, *words = part.rows[label]
    folder = (FOLDER if sweep == part.sweep else thesis_tables.FOLDER) / sweep
    paths = [path.parent for path in sorted(folder.glob("*/results.json"))]
    told = {path: set(record(path)["overrides"]) for path in paths}
    # what is compared has one precision
    found = [path for path in paths if set(words) <= told[path] and thesis_tables.BFLOAT16 not in told[path]]
    if not found:
        raise DataError(
            f"{folder}: no run of {' '.join(words) or 'it'} in float32; wanted one. Run thesis_tables.py first, "
            "without --bfloat16."
        )
    return found


def answers(part: Part) -> Iterator[Row]:
    """Results of its rows, each under its label."""
    for label in part.rows:
        for run in runs(part, label):
            found = json.loads((run / "results.json").read_text(encoding="utf-8"))
            wanted = {"seed", "synthetic", *part.columns, *(f"{key}_sem" for key in part.columns)}
            kept = {key: value for key, value in found.items() if key in wanted}
            yield {"method": label, **kept}


def section(part: Part) -> str:
    rows = aggregate(list(answers(part)), ["method"])
    columns = {"method": "", "n": "seeds", **part.columns}
    words = " ".join(word for word in part.words if not word.startswith("data.root"))
    return f"## Claims {part.claims}\n\n{part.text} `{words}`\n\n{markdown(rows, columns)}"


def main() -> None:
    for part in PARTS:  # what is compared with is wanted before an hour of runs, not after
        for label, (sweep, *_) in part.rows.items():
            if sweep != part.sweep:
                runs(part, label)
    write_noisy_heads()
    for part in PARTS:
        thesis_tables.put_aside(FOLDER / part.sweep, (*part.words, *COMMON))
        told = [sys.executable, "-m", "framework", "-m", *part.words, *COMMON]
        carry_out([*told, "hydra.launcher.jobs=2", f"hydra.sweep.dir={FOLDER / part.sweep}"])
    text = (
        "# Contradicted claims, with the suspected cause removed (synthetic data)\n\n"
        "`python -m reproduction.contradictions`. Numbers of the claims in [claims.md](claims.md), which draws the "
        "conclusions; rows without a change are the runs of [its tables](thesis_tables.md).\n\n"
        + "\n".join(section(part) for part in PARTS)
        + f"\n{machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
